"""What the tests of the monitor share: a broker, and the rows of a monitor that nothing disturbed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from .plant import LINES, Rows, rows_of, served, settings_in
from .servers import Broker


@pytest.fixture(scope="session")
def undisturbed_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rows, str]:
    """The rows of a monitor that has taken `LINES`, and the lines that it wrote."""
    folder = tmp_path_factory.mktemp("undisturbed")
    _, out = served(settings_in(folder), LINES)
    return rows_of(str(folder / "monitor.db")), out


@pytest.fixture
def undisturbed(undisturbed_run: tuple[Rows, str]) -> Rows:
    return undisturbed_run[0]


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.stop()
