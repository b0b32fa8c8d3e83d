"""A converter that is off writes zeros, or its last values: a recording and a stream miss the same samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.recordings.corrections.gaps import remove_dropouts
from sealscope.recordings.motion import find_holds
from sealscope.recordings.recording import Recording

from ..diagnosis.balance_machine import machine
from ..representatives import SLOW, few

VOLUMES, PRESSURES = ("p_A", "p_B", "x", "theta"), ("p_A", "p_B", "u")


def dropped(recording: Recording, begin: float, seconds: float, value: float | None = 0.0) -> Recording:
    """A recording of whose channels all have one value for a while; None: the last one before."""
    rows = np.flatnonzero((recording.t >= begin) & (recording.t < begin + seconds))
    channels = {}
    for name, values in recording.channels.items():
        channels[name] = values.copy()
        channels[name][rows] = values[rows[0] - 1] if value is None else value
    return replace(recording, channels=channels)


def watched(recording: Recording, size: int = 10**9) -> tuple[ss.Watch, list[object]]:
    watch, estimates = ss.watch("thesis", learn_hours=0.02), list[object]()
    for start in range(0, len(recording), size):
        estimates += watch.update(recording.samples(slice(start, start + size)))
    return watch, estimates


@pytest.mark.parametrize(
    "seed",
    [
        2,
        *(pytest.param(k, marks=pytest.mark.slow) for k in (0, 1, 3)),
        *(pytest.param(k, marks=[pytest.mark.slow, pytest.mark.long]) for k in (4, 5, 6, 7)),
    ],
)
@pytest.mark.parametrize("seconds", few([0.1, 15.0], 1, SLOW))
def test_zeros_in_all_channels_are_no_leak(seed: int, seconds: float):
    recording = machine(seed, duration=240.0, rate=200.0).only(VOLUMES)
    watch, _ = watched(dropped(recording, 150.0 + 0.37 * seed, seconds))
    assert watch.leak is None
    assert watch.counters.keys() <= {"blocks: missing values"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("value", "names"),
    [
        pytest.param(0.0, VOLUMES, id="zeros-volumes", marks=pytest.mark.long),
        pytest.param(0.0, PRESSURES, id="zeros-pressures"),
        pytest.param(None, VOLUMES, id="last values-volumes"),
        pytest.param(None, PRESSURES, id="last values-pressures", marks=pytest.mark.long),
    ],
)
def test_fifteen_seconds_of_a_simulated_machine_are_no_leak(names: tuple[str, ...], value: float | None):
    for seed in (0, 4):
        recording = ss.simulate(command="3 sin(4t)", duration="5 min", seed=seed).only(names)
        lost = dropped(recording, 150.0 + 0.37 * seed, 15.0, value)
        assert watched(lost)[0].leak is None
        assert ss.diagnose(lost).verdict != "leak"


@pytest.mark.slow
def test_a_recording_and_a_stream_miss_the_same_samples():
    recording = dropped(machine(3, duration=240.0, rate=200.0).only(VOLUMES), 100.0, 40.0)
    missing = np.isnan(remove_dropouts(recording)["p_A"])
    np.testing.assert_array_equal(missing, (recording.t >= 100.0) & (recording.t < 140.0))
    part = inspect_recording(recording).part  # both sides
    assert part.bridged is not None
    np.testing.assert_array_equal(part.bridged, missing)
    diagnosis = ss.diagnose(recording)
    assert diagnosis.verdict == "no leak"  # a leak that began in between would last
    assert "this rests on 83.1 % of the recording" in diagnosis.reason
    watch, estimates = watched(recording)
    lost = [each.t for each in estimates if each.status == "missing values"]  # type: ignore[attr-defined]
    assert 103.0 < lost[0] < 107.0 and 136.0 < lost[-1] < 144.0
    assert watch.counters == {"blocks: missing values": len(lost)}
    for size in (33, 500, 7001):
        again, others = watched(recording, size)
        assert others == estimates
        assert again.state() == watch.state()


def test_one_chamber_at_zero_is_a_reading():
    recording = machine(3, duration=20.0, rate=200.0)
    one = replace(recording, channels={**recording.channels, "p_B": np.zeros(len(recording))})
    assert remove_dropouts(one) is one
    assert remove_dropouts(recording.only(("p_A", "x"))) is not None


def test_a_hold_is_a_run_of_equal_samples_beyond_its_first():
    random = np.random.default_rng(1)
    values = random.standard_normal(4000)
    for begin, count in ((100, 70), (500, 750), (501, 751), (1500, 752), (2600, 900), (3800, 200)):
        values[begin : begin + count] = values[begin]
    held = np.zeros(len(values), dtype=bool)
    for first, count in ((1500, 752), (2600, 900)):
        held[first + 1 : first + count] = True
    held[501 : 501 + 751] = True  # the second of two that overlap is longer than 1.5 s
    np.testing.assert_array_equal(find_holds(values, 500.0), held)
    for empty in (np.empty(0), np.full(3, np.nan)):
        assert not find_holds(empty, 500.0).any()


@pytest.mark.slow
def test_held_pressures_are_missing_for_any_cuts():
    recording = ss.simulate(command="3 sin(4t)", duration="4 min", seed=4).only(PRESSURES)
    lost = dropped(recording, 151.0, 3.0, None)
    watch, estimates = watched(lost)
    assert watch.leak is None
    assert "blocks: missing values" in watch.counters
    for size in (77, 500, 4001):
        again, others = watched(lost, size)
        assert others == estimates
        assert again.state() == watch.state()
