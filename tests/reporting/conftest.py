"""A recording and a diagnosis to report; the diagnosis is any object with the attributes of the output contract."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from sealscope.recordings.recording import Recording


def _recording(seconds: float = 40.0, rate: float = 500.0, seed: int = 7) -> Recording:
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * rate)) / rate
    swing = np.sin(4 * t)
    ringing = np.where(t < seconds / 2, 9e3, 6e3) * np.sin(2 * np.pi * 70 * t)
    noise = rng.normal(0, 2e3, (4, t.size))
    channels = {
        "u": 3 * swing,
        "x": 0.05 * swing,
        "omega": 31 * swing,
        "p_1": 3.1e5 + 6e4 * swing + noise[0],
        "p_2": 3.1e5 - 6e4 * swing + noise[1],
        "p_A": 3e5 + 6e4 * swing + ringing + noise[2],
        "p_B": 3e5 - 6e4 * swing - ringing + noise[3],
        "q_leak": np.where(t < seconds / 2, 0.0, 7e-8),
    }
    units = {"u": "V", "x": "m", "omega": "rad/s", "q_leak": "m^3/s"} | dict.fromkeys(
        ("p_1", "p_2", "p_A", "p_B"), "Pa"
    )
    return Recording(t, channels, units, rate, {"rig": {"name": "bench 4"}, "day": 3}, ("converted with 14 bits",))


def _diagnosis(**changed):
    finding = SimpleNamespace(
        code="clipped", channel="p_1", count=12, first_t=3.25, text="12 samples stand at the rail", severity="warning"
    )
    method = SimpleNamespace(
        name="details", score=5.4375, threshold=3.21875, verdict="leak", reason="the RMS of d3 of p_A fell by 31 %"
    )
    values = {
        "file": "bench/log_17.csv",
        "verdict": "leak",
        "reason": "d3 fell in both chambers",
        "onset_s": 20.375,
        "onset_interval_s": (18.5, 21.75),
        "leak_lpm": 0.00421,
        "leak_interval_lpm": (0.0031, 0.0057),
        "false_alarm_probability": 0.001,
        "score": 5.4375,
        "threshold": 3.21875,
        "quality": (finding,),
        "methods": (method,),
        "cause": None,
        "next_check": "repeat the recording",
        "course": None,
    }
    return SimpleNamespace(**(values | changed))


@pytest.fixture(scope="session")
def make_recording():
    return _recording


@pytest.fixture(scope="session")
def recording():
    return _recording()


@pytest.fixture(scope="session")
def make_diagnosis():
    return _diagnosis


@pytest.fixture(scope="session")
def no_verdict():
    """A diagnosis in which all that may be None is None."""
    return _diagnosis(
        file=None,
        verdict="cannot tell",
        reason="the recording is too short",
        onset_s=None,
        onset_interval_s=None,
        leak_lpm=None,
        leak_interval_lpm=None,
        false_alarm_probability=None,
        score=None,
        threshold=None,
        quality=(
            SimpleNamespace(code="short", channel=None, count=None, first_t=None, text="30 samples", severity="fatal"),
        ),
        methods=(SimpleNamespace(name="details", score=None, threshold=None, verdict="cannot tell", reason=""),),
    )
