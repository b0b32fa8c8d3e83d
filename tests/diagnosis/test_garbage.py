"""What is no recording of a machine gets `cannot tell` with the reason, and nothing else is written anywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.recordings.recording import Recording

Change = Callable[[Recording], Recording]


def put(recording: Recording, **channels: np.ndarray) -> Recording:
    return replace(recording, channels={**recording.channels, **channels})


def noise(recording: Recording, size: float) -> np.ndarray:
    return size * np.random.default_rng(0).standard_normal(len(recording))


GARBAGE: dict[str, tuple[Change, str]] = {
    "white noise": (lambda r: put(r, p_A=3e5 + noise(r, 1e5), p_B=3e5 - noise(r, 1e5)), "p_A - p_B is noise"),
    "a copy": (lambda r: put(r, p_B=r["p_A"]), "p_B is a copy of p_A"),
    "a noisy copy": (lambda r: put(r, p_B=r["p_A"] + noise(r, 4e3)), "p_A - p_B is noise"),
    "bar": (lambda r: put(r, p_A=1e-5 * r["p_A"], p_B=1e-5 * r["p_B"]), "is their unit right"),
    "ms": (lambda r: replace(r, t=1e3 * r.t, rate=1e-3 * r.rate), "is the unit of the time right"),
}


@pytest.mark.parametrize("kind", GARBAGE)
def test_garbage_gets_cannot_tell_with_the_true_reason(kind: str, healthy: Recording, leaky: Recording, capfd) -> None:  # type: ignore[no-untyped-def]
    make, reason = GARBAGE[kind]
    for recording in (healthy, leaky):
        diagnosis = diagnose(make(recording))
        assert diagnosis.verdict == "cannot tell"
        assert diagnosis.reason.startswith("this is no recording of a hydraulic machine: ")
        assert reason in diagnosis.reason
    assert tuple(capfd.readouterr()) == ("", "")


def test_pressures_beyond_any_sensor_are_not_judged(leaky: Recording) -> None:
    """Pa labelled bar: 100 000 times too much."""
    diagnosis = diagnose(put(leaky, p_A=1e5 * leaky["p_A"], p_B=1e5 * leaky["p_B"]))
    assert diagnosis.verdict == "cannot tell"
    assert "beyond what any sensor reads" in diagnosis.reason


def test_raw_counts_have_any_range(leaky: Recording) -> None:
    counts = {name: "count" for name in ("p_A", "p_B")}
    small = put(leaky, p_A=1e-5 * leaky["p_A"], p_B=1e-5 * leaky["p_B"])
    assert diagnose(replace(small, units={**small.units, **counts})).verdict == diagnose(leaky).verdict


@pytest.mark.parametrize("kind", ["white noise", "a copy"])
def test_a_baseline_of_garbage_is_left_out(kind: str, healthy: Recording, leaky: Recording) -> None:
    pressures = ["u", "p_A", "p_B"]
    diagnosis = diagnose(healthy.only(pressures), GARBAGE[kind][0](leaky).only(pressures))
    assert diagnosis.verdict == "cannot tell"
    assert "no baseline recording can be used: this is no recording of a hydraulic machine" in diagnosis.reason
