"""The volume balance of a stream: blocks of any size give what one block gives; alarms stay, and are rare."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from scipy.special import pdtr

from sealscope.diagnosis.volume_balance.detector import VolumeBalance
from sealscope.diagnosis.volume_balance.live import BalanceState
from sealscope.diagnosis.volume_balance.stream import SequentialBalance
from sealscope.errors import InputError
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.simulate import simulate

from .balance_machine import machine, step

RIG = load_rig("thesis")
WORN = machine(1, G=step(0.0, 3.0e-13, at=80.0), duration=130.0, rate=50.0)
SOUND = machine(2, duration=130.0, rate=50.0)


def stream(recording: Recording, sizes: list[int], **options: float) -> list[BalanceState]:
    """Every state the stream goes through, for blocks of these sizes over and over."""
    detector = SequentialBalance(RIG, **options)  # type: ignore[arg-type]
    states, start, turn = [], 0, 0
    while start < len(recording):
        size = sizes[turn % len(sizes)]
        states.append(detector.update(recording.samples(slice(start, start + size))))
        start, turn = start + size, turn + 1
    return states


def told(state: BalanceState) -> tuple[object, ...]:
    one = state.evidence
    alarm = state.alarm
    return (
        state.t,
        state.blocks,
        state.refused,
        one.verdict,
        one.reason,
        one.score,
        one.threshold,
        one.onset_s,
        one.leak_lpm,
        state.total_lpm,
        None if alarm is None else (alarm.score, alarm.onset_s, alarm.leak_lpm),
    )


@settings(
    max_examples=4,
    deadline=None,
    phases=(Phase.explicit, Phase.reuse, Phase.generate),
    suppress_health_check=[HealthCheck.too_slow],
)
@given(sizes=st.lists(st.integers(min_value=1, max_value=3000), min_size=1, max_size=5).filter(lambda s: sum(s) > 1000))
def test_any_blocks_give_what_one_gives(sizes: list[int]) -> None:
    whole = stream(WORN, [len(WORN)], window=24)[-1]
    assert told(stream(WORN, sizes, window=24)[-1]) == told(whole)
    assert whole.alarm is not None


def test_every_state_on_the_way_is_the_same() -> None:
    small = {state.blocks: told(state) for state in stream(WORN, [50])}
    large = {state.blocks: told(state) for state in stream(WORN, [410])}
    assert len(large) >= 10
    for blocks in (large.keys() & small.keys()) - {0}:
        assert small[blocks] == large[blocks]


def test_the_last_window_is_judged_as_a_recording_would_be() -> None:
    """Same blocks, same statistic: only the probability is another.

    A recording's samples date the onset, and its pressures' zero error is taken out, which a stream's interval holds.
    """
    rate = 0.01 / (3.14 / 3600.0)
    final = stream(WORN, [len(WORN)], window=100, alarms_per_hour=rate)[-1]
    detector = VolumeBalance(RIG)
    batch = detector.examine(WORN, [], 0.01)
    assert final.evidence.score == pytest.approx(batch.score, rel=5e-3)
    low, high = final.evidence.leak_interval_lpm
    assert low < batch.leak_lpm < high
    assert final.evidence.leak_lpm == pytest.approx(batch.leak_lpm, rel=0.02)
    # a recording is dated by the samples about the onset, a stream by its blocks of 3.14 s and with their interval
    assert batch.onset_s == pytest.approx(80.0, abs=0.05)
    low, high = final.evidence.onset_interval_s
    assert low < batch.onset_s < high
    assert high - low < 2.0 * 3.14
    assert final.evidence.onset_s == pytest.approx(batch.onset_s, abs=0.5 * 3.14)


def test_alarm_soon_after_the_onset_and_stays() -> None:
    states = stream(WORN, [250], alarms_per_hour=0.1)
    first = next(state for state in states if state.alarm is not None)
    assert 80.0 < first.t < 105.0
    assert all(state.alarm is None for state in states if state.t < 80.0)
    last = states[-1]
    assert last.alarm is not None
    assert last.alarm.onset_s == pytest.approx(80.0, abs=2.0)
    assert last.alarm.leak_lpm == pytest.approx(3.0e-13 * 1.1e5 * 6e4, rel=0.15)


def test_an_alarm_of_oil_that_leaves_becomes_one_to_the_outside_and_stays_one() -> None:
    """Which side loses oil shows when the lower pressure has fallen, some windows after the alarm."""
    recording = simulate(
        rig="thesis-closed-loop",
        command="position 35 mm sin(1.8t)",
        controller="pi",
        fault="rod seal A 0.02 L/min from 60 s",
        duration="110 s",
        seed=3,
    )
    detector = SequentialBalance("thesis-closed-loop", alarms_per_hour=0.3)
    alarms = [detector.update(recording.between(second, second + 1.0)).alarm for second in range(110)]
    causes = [alarm.cause for alarm in alarms if alarm is not None]
    assert causes[0] in ("piston or pump leak", "piston leak")
    assert causes[-1] == "external leak"
    outside = causes.index("external leak")
    assert set(causes[outside:]) == {"external leak"}
    assert outside < 30
    assert detector.state.alarm is not None
    assert detector.state.alarm.verdict == "no leak"


def test_no_alarm_without_a_leak() -> None:
    final = stream(SOUND, [700], alarms_per_hour=1.0)[-1]
    assert final.alarm is None
    assert final.evidence.verdict == "no leak"
    assert final.total_lpm == pytest.approx(2.4e-13 * 1.1e5 * 6e4, rel=0.15)


def test_an_acknowledged_alarm_is_gone_and_the_past_with_it() -> None:
    detector = SequentialBalance(RIG, alarms_per_hour=0.1)
    detector.update(WORN)
    assert detector.state.alarm is not None
    detector.acknowledge()
    assert detector.state.alarm is None
    more = machine(3, G=3.0e-13, duration=100.0, rate=50.0)
    assert detector.update(replace(more, t=more.t + 130.0)).alarm is None


def test_gaps_and_missing_values_cost_their_blocks_only() -> None:
    x = np.array(WORN["x"])
    x[1000:1010] = np.nan
    holed = replace(WORN, t=WORN.t + np.where(WORN.t > 50.0, 600.0, 0.0), channels={**WORN.channels, "x": x})
    final = stream(holed, [333], alarms_per_hour=0.1)[-1]
    assert final.refused == 2
    assert final.alarm is not None
    assert final.alarm.onset_s == pytest.approx(680.0, abs=3.0)


def test_memory_does_not_grow() -> None:
    import pickle

    detector = SequentialBalance(RIG, window=20)
    sizes = []
    for turn in range(4):
        detector.update(replace(SOUND, t=SOUND.t + 130.0 * turn))
        sizes.append(len(pickle.dumps(detector)))
    assert max(sizes) < 1.5 * min(sizes)


@pytest.mark.parametrize(
    "options, named",
    [({"window": 10}, "window"), ({"block_seconds": 0.0}, "block_seconds"), ({"alarms_per_hour": 1e9}, "alarms_per")],
)
def test_options_that_make_no_sense_are_told(options: dict[str, float], named: str) -> None:
    with pytest.raises(InputError, match=named):
        SequentialBalance(RIG, **options)  # type: ignore[arg-type]


def test_a_stream_must_stay_what_it_was() -> None:
    detector = SequentialBalance(RIG)
    with pytest.raises(InputError, match="needs x"):
        detector.update(WORN.only(["p_A", "p_B", "theta"]))
    detector.update(WORN.samples(slice(0, 100)))
    with pytest.raises(InputError, match="rate"):
        detector.update(replace(WORN, rate=100.0))
    with pytest.raises(InputError, match="x is not in"):
        detector.update(WORN.only(["p_A", "p_B", "theta", "p_1", "p_2", "u"]))


@pytest.mark.slow
@pytest.mark.long
def test_false_alarms_per_hour_are_at_most_the_stated_ones() -> None:
    """Eight sound machines with a pump that wanders, some five minutes each, at a rate that allows 4 alarms in all."""
    alarms, hours, rate = 0, 0.0, 6.0
    for seed in range(8):
        random = np.random.default_rng(seed)
        weight, k = random.standard_normal(6), np.arange(6) + 0.5

        def wander(t: np.ndarray, weight: np.ndarray = weight, k: np.ndarray = k) -> np.ndarray:
            return np.asarray(2.4e-13 * (1.0 + 0.04 * np.sin(np.outer(np.pi * t / 300.0, k)) @ (weight / k)))

        sound = machine(seed, G_pump=wander, duration=300.0, rate=50.0)
        detector = SequentialBalance(RIG, alarms_per_hour=rate, window=40)
        for start in range(0, len(sound), 157):
            if detector.update(sound.samples(slice(start, start + 157))).alarm is not None:
                alarms += 1
                detector.acknowledge()
        hours += 300.0 / 3600.0
    assert alarms == 0 or 1.0 - pdtr(alarms - 1, rate * hours) > 1e-3
