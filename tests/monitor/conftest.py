"""What the tests of the monitor share: a broker, and the rows of a monitor that nothing disturbed."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import sealscope as ss
from sealscope.diagnosis.commissioned.machine_file import write_machine
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.monitor.settings import MonitorSettings

from ..diagnosis.balance_machine import machine
from .plant import LINES, MAP, Rows, log, rows_of, served, settings_in
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


@pytest.fixture(scope="session")
def commissioned(tmp_path_factory):
    """A machine's file of which areas, map and rate alone are stated."""
    folder = tmp_path_factory.mktemp("machine")
    days = ((seed, folder / f"healthy/run_2026-03-{10 + seed}_0600.csv") for seed in range(1, 6))
    files = [log(path, machine(seed, rate=100.0, duration=60.0)) for seed, path in days]
    rig = unstated_rig()
    areas = rig.cylinder.A_A, rig.cylinder.A_B
    rig = rig.with_areas(*areas, source="data sheet").with_overrides({"pump.q_b": 7.0e-6}, source="assumed: a guess")
    known = ss.commission(files, rig=rig, map=MAP, rate=100.0, limit="20 mL/min", name="press")
    return write_machine(known, folder / "press.toml")
