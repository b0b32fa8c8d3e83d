"""Gaps are bridged to within the noise, by the method that their length and the duty allow, and marked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.recordings import CHANNEL_UNITS, Recording
from sealscope.recordings.gaps import bridge, touched

RATE, NOISE = 500.0, 1e3
NEEDED = ("u", "p_A", "p_B")


def machine(seconds: float = 60.0, seed: int = 0, drift: float = 0.0) -> Recording:
    """A duty of 1.6 s with ringing at 40 Hz after each reversal, an angle that drifts, and noise."""
    random, t = np.random.default_rng(seed), np.arange(round(seconds * RATE)) / RATE
    angle = 2 * np.pi * t / 1.6
    since = t % 0.8
    swing = 6e4 * np.tanh(8 * np.cos(angle)) + 2e4 * np.exp(-10 * since) * np.sin(2 * np.pi * 40 * since)
    channels = {
        "u": 3 * np.sin(angle),
        "p_A": 3e5 + swing + NOISE * random.standard_normal(t.size),
        "p_B": 3e5 - swing + NOISE * random.standard_normal(t.size),
        "theta": 20 * np.sin(angle) + drift * t,
    }
    return Recording(t, channels, CHANNEL_UNITS, RATE)


def holed(recording: Recording, rows: np.ndarray, *names: str) -> Recording:
    own = {name: np.where(rows, np.nan, recording[name]) for name in names or recording.channels}
    return replace(recording, channels={**recording.channels, **own})


def error(recording: Recording, whole: Recording, name: str) -> float:
    assert recording.bridged is not None
    rest = (recording[name] - whole[name])[recording.bridged]
    return float(np.sqrt(np.mean(rest**2)))


def test_a_recording_without_a_gap_stays_the_same_object() -> None:
    recording = machine()
    assert bridge(recording, NEEDED) is recording


@pytest.mark.parametrize(("length", "allowed"), [(1, 2.0), (3, 4.0), (9, 2.0), (400, 2.0), (1500, 2.0)])
def test_what_is_bridged_differs_from_what_was_there_by_noise(length: int, allowed: float) -> None:
    whole = machine(drift=0.5)
    at = np.arange(len(whole))
    rows = (at >= 14_950) & (at < 14_950 + length)
    recording = bridge(holed(whole, rows), NEEDED)
    assert recording.bridged is not None
    assert np.array_equal(recording.bridged, rows)
    for name in ("p_A", "p_B"):
        assert error(recording, whole, name) < allowed * NOISE
    assert error(recording, whole, "theta") < 0.05
    assert all(np.array_equal(recording[name][~rows], whole[name][~rows]) for name in whole.channels)


def test_rows_that_a_logger_lost_come_back_at_their_times() -> None:
    whole = machine()
    kept = np.ones(len(whole), dtype=bool)
    kept[[5000, *range(9000, 9700)]] = False
    cut = replace(whole, t=whole.t[kept], channels={name: values[kept] for name, values in whole.channels.items()})
    recording = bridge(cut, NEEDED)
    assert recording.bridged is not None
    assert np.array_equal(recording.bridged, ~kept)
    assert np.allclose(recording.t, whole.t, atol=1e-9)
    assert error(recording, whole, "p_A") < 2 * NOISE


def test_without_a_cycle_only_a_short_gap_is_bridged() -> None:
    whole = machine()
    walk = np.cumsum(np.random.default_rng(3).standard_normal((3, len(whole))), axis=1)
    whole = replace(whole, channels=dict(zip(NEEDED, walk, strict=True)))
    at = np.arange(len(whole))
    recording = bridge(holed(whole, ((at >= 5000) & (at < 5010)) | ((at >= 9000) & (at < 9011))), NEEDED)
    assert recording.bridged is not None
    assert np.flatnonzero(recording.bridged).tolist() == list(range(5000, 5010))
    assert np.isnan(recording["p_A"][9000:9011]).all()


def test_a_cycle_is_not_taken_from_another_duty() -> None:
    """The duty comes back from the gap in another phase: no cycle on either side goes on through it."""
    first, second = machine(), machine(seed=1)
    at = np.arange(len(first))
    later = {name: np.where(at < 10_000, first[name], np.roll(second[name], 300)) for name in first.channels}
    recording = holed(replace(first, channels=later), (at >= 10_000) & (at < 10_100))
    assert bridge(recording, NEEDED) is recording


@pytest.mark.parametrize("share", [0.12, 0.5])
def test_a_recording_of_gaps_is_not_bridged(share: float) -> None:
    whole = machine()
    recording = holed(whole, np.random.default_rng(0).random(len(whole)) < share)
    assert bridge(recording, NEEDED) is recording


def test_infinity_is_a_missing_value_and_time_that_goes_back_stays() -> None:
    whole = machine()
    p_A, t = np.array(whole["p_A"]), np.array(whole.t)
    p_A[4000] = np.inf
    t[8000:] -= 1.0
    recording = bridge(replace(whole, t=t, channels={**whole.channels, "p_A": p_A}), NEEDED)
    assert np.isfinite(recording["p_A"]).all()
    assert np.array_equal(recording.t, t)


def test_a_block_is_touched_by_more_than_a_hundredth() -> None:
    recording = machine()
    bridged = np.zeros(len(recording), dtype=bool)
    bridged[[*range(1000, 1010), *range(2000, 2011)]] = True
    recording = replace(recording, bridged=bridged)
    assert np.flatnonzero(touched(recording, np.arange(0, 30_001, 1000))).tolist() == [2]
    assert recording.samples(slice(2000, 3000)).bridged is not None
    assert recording.samples(slice(3000, 4000)).bridged is None
