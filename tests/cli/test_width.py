"""What the commands print for a person fits 80 columns, with names of files as long as usual."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

#: Calls in a folder with leak.nc, healthy_1.nc to healthy_3.nc and those as days/press_2024-05-0N.nc.
CALLS = [
    "rigs", "parameters", "reproduce --list",
    "diagnose healthy_1.nc --rig thesis", "-v diagnose leak.nc healthy_1.nc",
    "inspect leak.nc", "trend days", "-v trend days --rig thesis", "convert leak.nc leak.csv",
    "commission days -o press.toml --rig thesis", "report healthy_1.nc healthy_2.nc -o pages",
    "rigs new press --area-A 500 --area-B 400 --stroke 300 --displacement 6", "plugin new stroke",
    "simulate -o run.nc --duration 20 --leak 0.01[L/min] --fault", "campaign status bench-thesis",
]  # fmt: skip
#: Calls that simulate, judge or draw more than one recording.
LONG = (CALLS[4], CALLS[6], CALLS[7], CALLS[9], CALLS[10], CALLS[13], CALLS[14])


@pytest.fixture
def folder(recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of recordings that is the working folder, on a terminal of 80 columns."""
    for name in ("COLUMNS", "TERMINAL_WIDTH"):
        monkeypatch.setenv(name, "80")
    (tmp_path / "days").mkdir()
    for k, name in enumerate(("healthy_1.nc", "healthy_2.nc", "healthy_3.nc", "leak.nc")):
        shutil.copy(recordings / name, tmp_path / name)
        shutil.copy(recordings / name, tmp_path / "days" / f"press_2024-05-0{k + 1}.nc")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def widest(text: str) -> str:
    return max(text.splitlines(), key=len, default="")


@pytest.mark.usefixtures("folder", "verbose")
@pytest.mark.parametrize(
    "words",
    [pytest.param(words, marks=[pytest.mark.slow, pytest.mark.long]) if words in LONG else words for words in CALLS],
)
def test_what_is_printed_fits_a_terminal(words: str, call) -> None:
    faults = ["sensor p_A offset 2 psi from 10 s"] if words.endswith("--fault") else []
    done = call(*words.split(), *faults)
    assert done.status == 0, done.err
    assert done.out
    assert len(widest(done.out)) <= 80, widest(done.out)


@pytest.mark.long
@pytest.mark.slow
def test_a_folder_beside_its_machine_fits_a_terminal(folder: Path, call) -> None:
    call("commission", *(f"healthy_{k}.nc" for k in (1, 2, 3)), "-o", "m.toml", "--rig", "thesis")
    (folder / "days" / "press_2024-05-04.nc").rename(folder / "days" / "press_7_of_hall_3_2024-05-04_10-15.nc")
    done = call("diagnose", "days", "--machine", "m.toml")
    assert done.status == 0 and "leak " in done.out
    assert len(widest(done.out)) <= 80, widest(done.out)
