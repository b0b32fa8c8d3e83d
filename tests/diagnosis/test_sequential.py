"""A balance that is watched: its rate of false alarms, the delay of a leak, and the same for pieces of any size."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from sealscope.diagnosis.inference.live.balance import BLOCK_SECONDS, BlockConductance, LiveBalance
from sealscope.diagnosis.inference.live.sequential import StepDetector
from sealscope.diagnosis.inference.live.stream import BalanceState, SequentialBalance
from sealscope.errors import InputError
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording

from .balance_machine import machine, step

RIG = load_rig("thesis")
#: Conductance of the leak [m^3/(s Pa)], and since when [s].
LEAK, OPENS = 3.0e-13, 80.0
WORN = machine(1, G=step(0.0, LEAK, at=OPENS), duration=130.0, rate=50.0)


def stream(recording: Recording, sizes: list[int], hourly: float = 0.1) -> list[BalanceState]:
    """Every state that the stream goes through, for pieces of these sizes over and over."""
    detector, states, start, turn = SequentialBalance(RIG, alarms_per_hour=hourly), [], 0, 0
    while start < len(recording):
        size = sizes[turn % len(sizes)]
        states.append(detector.update(recording.samples(slice(start, start + size))))
        start, turn = start + size, turn + 1
    return states


@cache
def whole() -> BalanceState:
    """The state after all samples at once; compiled when first asked for."""
    return stream(WORN, [len(WORN)])[-1]


def test_a_leak_raises_an_alarm_with_onset_and_size():
    states = stream(WORN, [50])
    first = next(state for state in states if state.alarm is not None)
    assert OPENS < first.t < OPENS + 3.0 * BLOCK_SECONDS
    low, high = whole().alarm.onset_interval_s
    assert low <= OPENS <= high
    assert high - low < 2.0 * BLOCK_SECONDS
    truth = LEAK * float(np.mean(np.abs((WORN["p_A"] - WORN["p_B"])[WORN.t > OPENS]))) * 6e4
    low, high = whole().alarm.leak_interval_lpm
    assert low <= truth <= high
    assert high - low < 0.3 * truth


@settings(
    max_examples=4,
    deadline=None,
    phases=(Phase.explicit, Phase.reuse, Phase.generate),
    suppress_health_check=[HealthCheck.too_slow],
)
@given(sizes=st.lists(st.integers(1, 3000), min_size=1, max_size=4).filter(lambda sizes: sum(sizes) > 200))
def test_pieces_of_any_size_give_what_one_gives(sizes: list[int]):
    last = stream(WORN, sizes)[-1]
    assert (last.t, last.blocks, last.alarm) == (whole().t, whole().blocks, whole().alarm)
    assert last.evidence == whole().evidence


def test_missing_samples_and_a_gap_cost_the_blocks_that_they_meet():
    missing = (WORN.t > 31.0) & (WORN.t < 38.0)
    with_gaps = Recording(
        WORN.t, {**WORN.channels, "p_A": np.where(missing, np.nan, WORN["p_A"])}, WORN.units, WORN.rate
    )
    detector = SequentialBalance(RIG, alarms_per_hour=0.1)
    detector.update(with_gaps.between(0.0, 60.0))
    state = detector.update(with_gaps.between(65.0, 130.0))
    assert 1 <= state.refused <= 2
    assert state.blocks <= whole().blocks - 1
    assert state.alarm.leak_lpm == pytest.approx(whole().alarm.leak_lpm, rel=0.1)
    low, high = state.alarm.onset_interval_s
    assert low <= OPENS <= high


def test_an_alarm_stays_until_it_is_acknowledged():
    detector = SequentialBalance(RIG, alarms_per_hour=0.1)
    detector.update(WORN)
    detector.acknowledge()
    assert detector.state.alarm is None
    more = machine(1, G=LEAK, duration=60.0, rate=50.0)
    moved = Recording(more.t + WORN.t[-1] + 1.0 / 50.0, more.channels, more.units, more.rate)
    assert detector.update(moved).alarm is None


def test_without_a_leak_there_is_a_bound():
    state = stream(machine(2, duration=130.0, rate=50.0), [700], hourly=1.0)[-1]
    assert state.alarm is None
    assert state.evidence.verdict == "no leak"
    truth = 2.4e-13 * 1.1e5 * 6e4  # what the pump passes
    assert 0.0 < state.evidence.bound_lpm < truth
    assert state.total_lpm == pytest.approx(truth, rel=0.15)


@pytest.mark.slow  # compiles a solver of its own
def test_behind_a_servo_valve_each_chamber_has_a_balance():
    import sealscope as ss

    recording = ss.simulate(
        rig="servo-valve", command="position 30 mm sin(3t)", duration=120.0, leak="0.05 L/min from 90 s", seed=3
    )
    state = SequentialBalance("servo-valve", alarms_per_hour=0.3).update(recording)
    assert state.alarm.cause == "piston leak"
    assert state.alarm.onset_s == pytest.approx(90.0, abs=2.0 * BLOCK_SECONDS)


@pytest.mark.parametrize("hourly", [0.0, -1.0, float("nan"), 1e9])
def test_a_rate_that_cannot_be_set_is_refused(hourly: float):
    with pytest.raises(InputError, match="alarms_per_hour must be"):
        SequentialBalance(RIG, alarms_per_hour=hourly)


def test_channels_units_and_rate_are_those_of_the_beginning():
    with pytest.raises(InputError, match="x, p_A, p_B and theta"):
        SequentialBalance(RIG).update(WORN.only(["p_A", "p_B", "u"]))
    detector = SequentialBalance(RIG)
    detector.update(WORN.between(0.0, 10.0))
    with pytest.raises(InputError, match="rate"):
        detector.update(Recording(WORN.t * 2.0, WORN.channels, WORN.units, 25.0))


def walk(random: np.random.Generator, count: int, q: float) -> np.ndarray:
    """A level with noise 1 and a random walk of the variance q a block."""
    return 5.0 + np.cumsum(np.sqrt(q) * random.standard_normal(count)) + random.standard_normal(count)


def run_length(values: np.ndarray, threshold: float, stated: float = 1.0) -> int | None:
    """Blocks until the detector's alarm; None for none."""
    detector = StepDetector()
    for k, value in enumerate(values):
        detector.take(3.0 * k, 3.0 * k + 3.0, value, stated)
        if detector.log_e(threshold) > threshold:
            return k
    return None


@pytest.mark.parametrize("q", [0.0, 0.01, 1.0])
def test_false_alarms_are_as_rare_as_stated(q: float):
    """Whatever noise and walk are: at 1/alpha = 200 blocks under 1 in 200 of 12 x 250 blocks, by its own account."""
    random = np.random.default_rng(5)
    alarms = [run_length(walk(random, 250, q), np.log(200.0), stated=0.3) is not None for _ in range(12)]
    assert sum(alarms) <= 5  # 15 expected at the stated rate


@pytest.mark.parametrize("q", [0.0, 0.01])
def test_a_step_of_ten_deviations_is_found_at_once(q: float):
    random = np.random.default_rng(6)
    for _ in range(5):
        values = walk(random, 160, q)
        values[120:] += 12.0
        assert run_length(values, np.log(1e6)) in (120, 121, 122)


def test_a_step_has_its_size_and_its_onset_within_their_intervals():
    """Of steps that begin anywhere within a block."""
    random = np.random.default_rng(7)
    size, onset = [], []
    for _ in range(40):
        values, at = walk(random, 120, 0.0), 90.0 + random.uniform(0.0, 1.0)
        values += 15.0 * np.clip(np.arange(120) + 1.0 - at, 0.0, 1.0)
        detector = StepDetector()
        for k, value in enumerate(values):
            detector.take(3.0 * k, 3.0 * k + 3.0, value, 2.0)
        rise = detector.rise()
        size.append(abs(rise.size - 15.0) < 2.5 * rise.deviation)
        onset.append(rise.onset[1] - 0.2 <= 3.0 * at <= rise.onset[2] + 0.2)
    assert np.mean(size) > 0.85
    assert np.mean(onset) > 0.85


def test_units_change_nothing():
    values = walk(np.random.default_rng(8), 100, 0.1)
    values[70:] += 8.0
    plain, scaled = StepDetector(), StepDetector()
    for k, value in enumerate(values):
        plain.take(k, k + 1.0, value, 1.0)
        scaled.take(k, k + 1.0, 1e-13 * value, 1e-13)
    assert scaled.log_e() == pytest.approx(plain.log_e(), rel=1e-9)
    assert scaled.rise().size == pytest.approx(1e-13 * plain.rise().size, rel=1e-6)


def test_a_detector_is_restored_with_the_same_bits_and_stays_small():
    random = np.random.default_rng(9)
    detector = StepDetector()
    for k, value in enumerate(walk(random, 2500, 0.1)):
        detector.take(k, k + 1.0, value, 1.0)
    saved = json.dumps(detector.state(), allow_nan=False)
    assert len(saved) < 100_000
    again = StepDetector()
    again.recall(json.loads(saved))
    for one in (detector, again):
        one.take(2500.0, 2501.0, 9.0, 1.0)
    assert json.dumps(again.state()) == json.dumps(detector.state())


def test_a_live_balance_is_restored_at_any_instant():
    def conductances(live: LiveBalance, first: int, last: int) -> list[BlockConductance]:
        piece = WORN.samples(slice(first, last))
        shown = live.take(piece.t, piece.channels, piece.rate)
        return [block for blocks in shown if isinstance(blocks, list) for block in blocks]

    names = tuple(WORN.channels)
    whole = conductances(LiveBalance(RIG, names), 0, len(WORN))
    for stop in (10, 900, 4000):
        live = LiveBalance(RIG, names)
        before = conductances(live, 0, stop)
        again = LiveBalance(RIG, names)
        again.recall(json.loads(json.dumps(live.state(), allow_nan=False)))
        assert before + conductances(again, stop, len(WORN)) == whole
