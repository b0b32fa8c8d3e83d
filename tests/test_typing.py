"""The types that a user's project sees: right calls pass mypy, wrong ones do not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import sealscope

RIGHT = """\
import sealscope as ss

recording: ss.Recording = ss.simulate(command="3 sin(4t)", leak="0.0042 L/min from 90 s", duration="3 min", rate=500)
experiment: ss.Experiment = ss.Experiment.of(rig=ss.load_rig("thesis"), set={"V_1": "50[cm^3]"}, error="20[Pa]")
reveal_type(ss.simulate_with_truth(leak="0.0042 L/min from 90 s").truth.onset_s)
reveal_type(ss.load_rig().cylinder.L)
"""
WRONG = """\
import sealscope as ss

ss.simulate(comand="3 sin(4t)")
ss.simulate(duration=[3])
ss.simulate(method="euler")
ss.simulte()
"""


@pytest.mark.slow
@pytest.mark.long
def test_types_reach_a_user_s_project(tmp_path):
    """What mypy says of a script outside the project; `py.typed` is all that it knows of Sealscope."""
    pytest.importorskip("mypy", reason="mypy is not installed")
    assert (Path(sealscope.__file__).parent / "py.typed").exists()
    for name, text in (("right.py", RIGHT), ("wrong.py", WRONG)):
        (tmp_path / name).write_text(text)
    place = Path(sealscope.__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), "right.py", "wrong.py"],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300,
        env={} if place.name == "site-packages" else {"MYPYPATH": str(place)},
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert [line.partition("note: ")[2] for line in lines if line.startswith("right.py")] == [
        'Revealed type is "float | None"',
        'Revealed type is "float"',
    ], done.stdout + done.stderr
    wrong = [line.split(":")[1] for line in lines if line.startswith("wrong.py") and ": error: " in line]
    assert wrong == ["3", "4", "5", "6"], lines
