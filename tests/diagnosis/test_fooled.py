"""A healthy machine whose sensors, wiring or logger changed is not called leaking: what changed is named instead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.decision.explanations import load_events
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.rms_change.rms_detector import RmsChange
from sealscope.recordings.recording import Recording

from ..representatives import few
from .judging import judge

Change = Callable[[Recording], Recording]
CHAMBERS = ("p_A", "p_B")


def from_half(recording: Recording, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    late = recording.t > 0.5 * recording.t[-1]
    own = {name: np.where(late, change(recording[name]), recording[name]) for name in CHAMBERS}
    return replace(recording, channels={**recording.channels, **own})


def smoothed(values: np.ndarray) -> np.ndarray:
    return np.convolve(np.pad(values, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")


def humming(recording: Recording, hertz: float) -> Recording:
    size = 0.03 * float(np.std(recording["p_A"] - recording["p_B"]))
    return from_half(recording, lambda values: values + size * np.sin(2 * np.pi * hertz * recording.t))


def swapped(recording: Recording) -> Recording:
    late = recording.t > 0.5 * recording.t[-1]
    p_A, p_B = (recording[name] for name in CHAMBERS)
    own = {"p_A": np.where(late, p_B, p_A), "p_B": np.where(late, p_A, p_B)}
    return replace(recording, channels={**recording.channels, **own})


FOOLING: dict[str, tuple[Change, str]] = {
    "a smoother filter": (lambda r: from_half(r, smoothed), "noise of a pressure"),
    "hum of 50 Hz": (lambda r: humming(r, 50.0), "logger"),
    "hum of 60 Hz": (lambda r: humming(r, 60.0), "logger"),
}


@pytest.mark.parametrize("kind", FOOLING)
def test_what_changed_in_the_readings_is_no_leak(kind: str, healthy: Recording) -> None:
    make, name = FOOLING[kind]
    diagnosis = diagnose(make(healthy.only(CHAMBERS)))
    assert diagnosis.verdict != "leak"
    assert diagnosis.cause == "sensor fault"
    words = {event.name: event.description for event in load_events()}
    assert words[name] in diagnosis.reason or words["logger"] in diagnosis.reason


@pytest.mark.parametrize("seed", few([0, 1], 1))
def test_a_filter_that_damps_the_response_is_no_leak(seed: int, records) -> None:  # type: ignore[no-untyped-def]
    """Smoothed over 9 samples, p_A - p_B rings as if oil passed the piston; the noise tells that nothing leaks."""
    wide = np.full(9, 1.0 / 9.0)
    healthy = records(seed, duration=120.0, throttled=True).only(("u", *CHAMBERS))
    diagnosis = diagnose(from_half(healthy, lambda p: np.convolve(np.pad(p, 4, mode="edge"), wide, "valid")))
    assert diagnosis.verdict != "leak"
    assert diagnosis.cause == "sensor fault"


@pytest.mark.parametrize(
    "names", [CHAMBERS, pytest.param(("u", *CHAMBERS), marks=pytest.mark.slow), ("u", *CHAMBERS, "x", "theta")]
)
def test_swapped_chambers_are_no_leak_and_nothing_is_written(names: tuple[str, ...], healthy: Recording, capfd) -> None:  # type: ignore[no-untyped-def]
    """Models of the machine diverge on such a recording: that is no message for the terminal."""
    diagnosis = diagnose(swapped(healthy.only(names)))
    if "theta" in names:  # the balance names what compresses: the sign of the pressures' rates
        assert diagnosis.verdict != "leak"
        assert diagnosis.cause is not None
        return
    assert diagnosis.verdict != "leak"
    assert diagnosis.cause == "sensor fault"
    assert not any("left out" in method.reason for method in diagnosis.methods)
    assert tuple(capfd.readouterr()) == ("", "")


@pytest.mark.slow
def test_a_leak_is_still_found_from_pressures_and_command(records) -> None:  # type: ignore[no-untyped-def]
    leaking = records(1, leak="0.05 L/min from 61 s", duration=120.0, throttled=True)
    assert diagnose(leaking.only(("u", *CHAMBERS))).verdict == "leak"


@pytest.mark.slow
def test_a_leak_is_still_found_from_the_ringing_by_its_own_rule(records) -> None:  # type: ignore[no-untyped-def]
    """Weighed against all else that makes the ringing fall it is an alarm that is not explained."""
    leaking = records(1, leak="0.05 L/min from 61 s", duration=120.0, throttled=True).only(CHAMBERS)
    assert judge(RmsChange(), leaking).verdict == "leak"
    weighed = diagnose(leaking)
    assert weighed.verdict == "cannot tell" and weighed.alarmed
