"""Gaps are bridged to within the noise, by the method that their length and the duty allow, and marked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.recordings import CHANNEL_UNITS, Recording
from sealscope.recordings.corrections.gaps import (
    bridge,
    flag_bridged,
    flag_holes,
    order_recording,
    remove_unsupplied,
    resample_evenly,
)

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
    recording = bridge(resample_evenly(cut), NEEDED)
    assert recording.bridged is not None
    assert np.array_equal(recording.bridged, ~kept)
    assert np.allclose(recording.t, whole.t, atol=1e-9)
    assert error(recording, whole, "p_A") < 2 * NOISE


def test_a_channel_that_begins_late_is_not_filled_before() -> None:
    whole = machine()
    at = np.arange(len(whole))
    gap = (at >= 5000) & (at < 5003)
    late = holed(holed(whole, gap), (at < 5002), "theta")
    recording = bridge(late, NEEDED)
    assert np.isnan(recording["theta"][:5003]).all()
    assert np.isfinite(recording["p_A"][5000:5003]).all()


def test_the_one_row_with_a_time_is_the_one_that_stays() -> None:
    times = np.full(5, np.nan)
    times[3] = 7.0
    recording = Recording(times, {"p_A": np.arange(5.0)}, CHANNEL_UNITS, RATE)
    evened = resample_evenly(recording)
    assert evened.t.tolist() == [7.0] and evened["p_A"].tolist() == [3.0]


def test_without_a_cycle_a_line_joins_both_ends() -> None:
    whole = machine()
    walk = np.cumsum(np.random.default_rng(3).standard_normal((3, len(whole))), axis=1)
    whole = replace(whole, channels=dict(zip(NEEDED, walk, strict=True)))
    at = np.arange(len(whole))
    recording = bridge(holed(whole, ((at >= 5000) & (at < 5010)) | ((at >= 9000) & (at < 9050))), NEEDED)
    assert recording.bridged is not None
    assert np.flatnonzero(recording.bridged).tolist() == [*range(5000, 5010), *range(9000, 9050)]
    line = np.linspace(whole["p_A"][8999], whole["p_A"][9050], 52)[1:-1]
    assert np.allclose(recording["p_A"][9000:9050], line)
    assert np.flatnonzero(flag_holes(recording)).tolist() == [*range(9000, 9050)]  # over a tenth of a test function


def test_a_cycle_is_not_taken_from_another_duty() -> None:
    """The duty comes back from the gap in another phase: no cycle on either side goes on through it."""
    first, second = machine(), machine(seed=1)
    at = np.arange(len(first))
    later = {name: np.where(at < 10_000, first[name], np.roll(second[name], 300)) for name in first.channels}
    recording = bridge(holed(replace(first, channels=later), (at >= 10_000) & (at < 10_100)), NEEDED)
    assert np.abs(np.diff(recording["p_A"][10_000:10_100], 2)).max() < 1e-6


@pytest.mark.parametrize("share", [0.12, 0.5])
def test_a_recording_of_short_gaps_is_bridged(share: float) -> None:
    whole = machine()
    recording = bridge(holed(whole, np.random.default_rng(0).random(len(whole)) < share), NEEDED)
    assert np.isfinite(recording["p_A"][10:-10]).all()
    assert not flag_holes(recording).any()


def test_infinity_is_a_missing_value() -> None:
    whole = machine()
    p_A = np.array(whole["p_A"])
    p_A[4000] = np.inf
    assert np.isfinite(bridge(replace(whole, channels={**whole.channels, "p_A": p_A}), NEEDED)["p_A"]).all()


def cut(recording: Recording, kept: np.ndarray, t: np.ndarray | None = None) -> Recording:
    t = recording.t if t is None else t
    return replace(recording, t=t[kept], channels={name: values[kept] for name, values in recording.channels.items()})


def test_late_rows_are_sorted_and_repeated_ones_dropped() -> None:
    whole = machine()
    order = np.arange(len(whole))
    order[8000:8003] = [8002, 8000, 8001]
    ordered = order_recording(cut(whole, np.insert(order, 500, 500)))
    assert [finding.code for finding in ordered.findings] == ["rows_sorted"]
    recording = resample_evenly(ordered.recording)
    assert np.array_equal(recording["p_A"], whole["p_A"])
    assert np.allclose(recording.t, whole.t, atol=1e-9)


def test_of_two_recordings_hours_apart_in_one_file_the_longer_is_kept() -> None:
    whole = machine()
    leapt = resample_evenly(replace(whole, t=whole.t + 3600.0 * (np.arange(len(whole)) >= 12_000)))
    assert leapt.t[0] == pytest.approx(3624.0)
    assert len(leapt) == len(whole) - 12_000


def test_an_uneven_clock_is_evened_and_its_holes_are_missing() -> None:
    whole = machine(seconds=20.0)
    random = np.random.default_rng(5)
    steps = random.integers(10, 21, 1000) * 1e-3
    steps[400] = 0.2
    t = np.cumsum(steps)
    t = t[t < 19.9]
    taken = {name: np.interp(t, whole.t, values) for name, values in whole.channels.items()}
    even = resample_evenly(Recording(t, taken, CHANNEL_UNITS, 1.0 / 0.015))
    assert np.allclose(np.diff(even.t), 0.015)
    missing = even.t[np.isnan(even["u"])]
    assert missing.min() > t[399] - 1e-9
    assert missing.max() < t[400]
    known = np.isfinite(even["u"])
    assert np.allclose(even["u"][known], 3 * np.sin(2 * np.pi * even.t[known] / 1.6), atol=6e-3)


def test_many_gaps_cost_no_more_than_one() -> None:
    """A file of bursts: each gap is as long as the recording of its burst, and the rows stay few."""
    whole = machine()
    at = np.arange(len(whole))
    recording = resample_evenly(cut(whole, at, t=whole.t + 40.0 * (at // 10)))
    assert len(recording) == 10


def test_a_block_is_touched_by_more_than_a_hundredth() -> None:
    recording = machine()
    bridged = np.zeros(len(recording), dtype=bool)
    bridged[[*range(1000, 1010), *range(2000, 2011)]] = True
    recording = replace(recording, bridged=bridged)
    assert np.flatnonzero(flag_bridged(recording, np.arange(0, 30_001, 1000))).tolist() == [2]
    assert recording.samples(slice(2000, 3000)).bridged is not None
    assert recording.samples(slice(3000, 4000)).bridged is None


def switched_on_late(recording: Recording, seconds: float, **readings: float) -> Recording:
    """Replace the first samples of some channels by what a sensor without a supply reads."""
    is_off = recording.t < seconds
    dead = {name: np.where(is_off, value, recording[name]) for name, value in readings.items()}
    return replace(recording, channels={**recording.channels, **dead})


def with_position(recording: Recording) -> Recording:
    x = 0.1 * np.sin(2 * np.pi * recording.t / 1.6)
    return replace(recording, channels={**recording.channels, "x": x}, units={**recording.units, "x": "m"})


def test_sensors_without_a_supply_read_a_quarter_of_their_range_below_zero() -> None:
    recording = with_position(machine())
    dead = switched_on_late(recording, 5.0, p_A=-25e5, p_B=-25e5, x=-0.2)
    cleaned = remove_unsupplied(dead)
    is_off = recording.t < 5.0
    for name in recording.channels:
        assert np.isnan(cleaned[name][is_off]).all()
        assert np.array_equal(cleaned[name][~is_off], recording[name][~is_off])


def test_a_zero_that_is_some_bar_too_low_is_no_missing_supply() -> None:
    recording = machine()
    low = replace(recording, channels={**recording.channels, "p_B": recording["p_B"] - 7e5})
    assert remove_unsupplied(low) is low


@pytest.mark.parametrize(("value", "is_dead"), [(-0.2, True), (0.25, True), (-0.12, False), (0.0, False)])
@pytest.mark.parametrize("ends", ["first", "last", "first and last"])
def test_a_position_that_jumps_out_of_its_range_is_dead_before(value: float, is_dead: bool, ends: str) -> None:
    recording = with_position(machine())
    is_off = ("first" in ends) & (recording.t < 5.0) | ("last" in ends) & (recording.t > 55.0)
    held = replace(recording, channels={**recording.channels, "x": np.where(is_off, value, recording["x"])})
    cleaned = remove_unsupplied(held)
    assert np.isnan(cleaned["x"][is_off]).all() == is_dead
    assert np.isfinite(cleaned["x"][~is_off]).all()
    assert np.isfinite(cleaned["p_A"]).all()


def test_an_encoder_that_moves_by_one_count_is_not_dead_before() -> None:
    recording = machine()
    counts = np.where(recording.t < 5.0, 0.0, 1e-3)
    still = replace(recording, channels={**recording.channels, "x": counts}, units={**recording.units, "x": "m"})
    assert remove_unsupplied(still) is still
