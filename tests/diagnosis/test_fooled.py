"""A sound machine whose sensors, wiring or logger changed is not called leaking: what changed is named instead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.recordings.recording import Recording

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
    "a smoother filter": (lambda r: from_half(r, smoothed), "its filter or its sampling changed: sensor fault"),
    "hum of 50 Hz": (lambda r: humming(r, 50.0), "hum of 50 Hz began in p_"),
    "hum of 60 Hz": (lambda r: humming(r, 60.0), "hum of 60 Hz began in p_"),
}


@pytest.mark.parametrize("kind", FOOLING)
def test_what_changed_in_the_readings_is_no_leak(kind: str, sound: Recording) -> None:
    make, reason = FOOLING[kind]
    diagnosis = diagnose(make(sound.only(CHAMBERS)))
    assert diagnosis.verdict == "cannot tell"
    assert reason in diagnosis.reason
    assert diagnosis.cause == "sensor fault"


@pytest.mark.parametrize(
    "names", [CHAMBERS, pytest.param(("u", *CHAMBERS), marks=pytest.mark.slow), ("u", *CHAMBERS, "x", "theta")]
)
def test_swapped_chambers_are_no_leak_and_nothing_is_written(names: tuple[str, ...], sound: Recording, capfd) -> None:  # type: ignore[no-untyped-def]
    """Models of the machine diverge on such a recording: that is no message for the terminal."""
    diagnosis = diagnose(swapped(sound.only(names)))
    if "theta" in names:  # the balance names what compresses: the sign of the pressures' rates
        assert diagnosis.verdict != "leak"
        assert diagnosis.cause is not None
        return
    assert (diagnosis.verdict, diagnosis.cause) == ("cannot tell", "sensor fault")
    assert "as if p_A and p_B were swapped" in diagnosis.reason
    assert not any("left out" in method.reason for method in diagnosis.methods)
    assert tuple(capfd.readouterr()) == ("", "")


@pytest.mark.parametrize("names", [CHAMBERS, pytest.param(("u", *CHAMBERS), marks=pytest.mark.slow)])
def test_a_leak_is_still_found(names: tuple[str, ...], records) -> None:  # type: ignore[no-untyped-def]
    leaking = records(1, leak="0.05 L/min from 61 s", duration=120.0, throttled=True)
    assert diagnose(leaking.only(names)).verdict == "leak"


OTHERS: dict[str, tuple[Change, str]] = {
    "charge pressure": (
        lambda r: replace(r, channels={name: r[name] + 1e5 for name in CHAMBERS}),
        "what a leak does not move differs from the baseline, too (the chambers' means by up to",
    ),
    "filter": (
        lambda r: replace(r, channels={name: smoothed(r[name]) for name in CHAMBERS}),
        "than in the baseline, as by another filter: sensor fault",
    ),
    "hum": (
        lambda r: replace(r, channels={name: r[name] + 3e3 * np.sin(2 * np.pi * 50.0 * r.t) for name in CHAMBERS}),
        "hum of 50 Hz in p_A than in the baseline: sensor fault",
    ),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_a_baseline_made_otherwise_shows_no_leak(kind: str, records) -> None:  # type: ignore[no-untyped-def]
    """One recording says nothing of the scatter between days: where they show another state, `leak` is not said."""
    worn = records(1, leak="0.05 L/min from 1 s", duration=120.0, throttled=True).only(CHAMBERS)
    own = records(2, duration=120.0, throttled=True).only(CHAMBERS)
    assert diagnose(worn, own).verdict == "leak"
    make, reason = OTHERS[kind]
    diagnosis = diagnose(worn, make(own))
    assert diagnosis.verdict == "cannot tell"
    assert reason in diagnosis.reason


def test_from_three_baseline_recordings_on_their_scatter_counts(records) -> None:  # type: ignore[no-untyped-def]
    from sealscope.diagnosis.isolation import signatures, unlike

    own = records(2, duration=120.0, throttled=True).only(CHAMBERS)
    seen, other = signatures(own), signatures(OTHERS["charge pressure"][0](own))
    assert seen is not None and other is not None
    assert unlike(seen, [seen]) is None
    assert unlike(seen, [other]) is not None
    assert unlike(seen, [other, seen]) is None
    assert unlike(seen, [other] * 3) is None
    hum = signatures(OTHERS["hum"][0](own))
    assert hum is not None
    assert unlike(seen, [hum] * 3) is not None
    little = replace(seen, hum=seen.hum + 0.85)  # too little in either chamber, but it is in both
    assert "hum of 50 Hz in both" in unlike(seen, [little] * 3).text
    assert unlike(seen, [replace(seen, hum=seen.hum + np.array([0.85, 0.0])[None, :, None])] * 3) is None
