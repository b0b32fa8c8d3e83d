"""A campaign small enough for a test: short records of machines that are all alike."""

from __future__ import annotations

from pathlib import Path
from shutil import copytree

import pytest

from sealscope.campaigns.execution.run import run
from sealscope.campaigns.plans.reader import load_plan

TINY = """
[campaign]
name = "tiny"
title = "A tiny campaign"
duration = "6 s"
onset = "3 s"
false_alarm = 0.2
seed = 3
detectors = ["d3 of p_A changed", "d3 of p_A fell", "sign rule: d3 of p_A fell"]

[factors]
command = ["3 sin(4t)", "5 sin(2t)"]
closed = ["0 %", "50 %"]

[[records]]
use = "calibrate"
count = 10

[[records]]
count = 6

[[records]]
leak = "0.015 L/min"
count = 5

[[records]]
leak = "30 cm^3/min"
count = 5
"""

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def text():
    """The plan's text."""
    return TINY


@pytest.fixture
def tiny(tmp_path):
    """The plan's file."""
    path = tmp_path / "tiny.toml"
    path.write_text(TINY, encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def _finished(tmp_path_factory):
    """The tiny plan's folder as one process leaves it."""
    place = tmp_path_factory.mktemp("finished")
    (place / "tiny.toml").write_text(TINY, encoding="utf-8")
    state = run(load_plan(place / "tiny.toml"), place / "rows", jobs=1)
    assert (state.done, state.failed) == (26, 0)
    return place / "rows"


@pytest.fixture
def finished_tiny(_finished, tmp_path):
    """A copy of the finished campaign of the tiny plan."""
    return copytree(_finished, tmp_path / "finished")


@pytest.fixture
def sheet_folder():
    if not (SHARED / "appendix_c_pa.csv").is_file():
        pytest.skip(f"the thesis's data sheet is not at {SHARED}")
    return SHARED


@pytest.fixture
def real_folder():
    if not (SHARED / "real").is_dir():
        pytest.skip(f"the measured sets are not at {SHARED / 'real'}")
    return SHARED / "real"
