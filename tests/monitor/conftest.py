"""What the tests of the monitor share: a broker, and the rows of a monitor that nothing disturbed."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from sealscope.monitor.settings import MonitorSettings

from .plant import LINES, Rows, rows_of, served, settings_in
from .servers import Broker


@pytest.fixture(scope="session")
def undisturbed_folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a monitor that has taken `LINES`, and the lines that it wrote."""
    folder = tmp_path_factory.mktemp("undisturbed")
    _, out = served(settings_in(folder), LINES)
    return folder, out


@pytest.fixture(scope="session")
def undisturbed_run(undisturbed_folder: tuple[Path, str]) -> tuple[Rows, str]:
    """The rows of a monitor that has taken `LINES`, and the lines that it wrote."""
    folder, out = undisturbed_folder
    return rows_of(str(folder / "monitor.db")), out


@pytest.fixture
def taken(undisturbed_folder: tuple[Path, str], tmp_path: Path) -> MonitorSettings:
    """Settings of a monitor that has taken `LINES`, with a database of its own."""
    shutil.copytree(undisturbed_folder[0], tmp_path, dirs_exist_ok=True)
    return settings_in(tmp_path)


@pytest.fixture
def undisturbed(undisturbed_run: tuple[Rows, str]) -> Rows:
    return undisturbed_run[0]


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.stop()
