"""The e-detector of a watch: its rate of false alarms, the delay and size of a step, and states that are restored."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.live.explanation import UNKNOWN
from sealscope.diagnosis.live.joining import SampleRun
from sealscope.diagnosis.live.live_balance import BLOCK_SECONDS, BlockConductance, BlockResult, LiveBalance, NotJudged
from sealscope.diagnosis.live.sequential import WINDOW, StepDetector, StepNull
from sealscope.diagnosis.live.watch import Watch
from sealscope.diagnosis.verdict.evidence import RAREST
from sealscope.parameters import load_rig

from .balance_machine import machine, step

RIG = load_rig("thesis")
#: Conductance of the leak [m^3/(s Pa)], and since when [s].
LEAK, OPENS = 3.0e-13, 80.0
WORN = machine(1, G=step(0.0, LEAK, at=OPENS), duration=130.0, rate=50.0)


def test_without_a_leak_there_is_a_bound():
    watch = Watch(RIG, 1000.0, 1000.0)
    watch.update(machine(2, duration=130.0, rate=50.0))
    assert watch.leak is None
    assert watch.evidence.verdict == "no leak"
    assert 0.0 < watch.evidence.bound_lpm < 2.4e-13 * 1.1e5 * 6e4  # what the pump passes


def test_a_slow_end_makes_no_bound_smaller():
    """It was a flow under the pressure of the last block alone."""

    def bound(end: float) -> float:
        watch = Watch(RIG, 1000.0, 1000.0)
        duty = {"speed": lambda t: np.where(t < 123.0, 12.0, end) * np.sin(4.0 * t)}
        watch.update(machine(2, **duty, duration=130.0, rate=50.0))
        return watch.evidence.bound_lpm

    assert bound(0.3) > 0.8 * bound(12.0)


def test_the_verdict_of_a_stream_is_decided_as_that_of_a_recording():
    """By the same function: with the chance of its score, and what it knows of the leak's size."""
    watch = Watch(RIG, 1000.0, 1000.0)
    assert not watch.evidence.usable
    watch.update(WORN)
    leak, evidence = watch.leak, watch.evidence
    assert (evidence.verdict, evidence.detector, evidence.cause) == ("leak", "watch", leak.cause)
    assert (evidence.leak_lpm, evidence.leak_interval_lpm) == (leak.leak_lpm, leak.leak_interval_lpm)
    assert evidence.chance == pytest.approx(np.exp(-0.5 * leak.score)) or evidence.chance == RAREST
    assert (evidence.onset_s, evidence.onset_interval_s) == (leak.onset_s, leak.onset_interval_s)


@pytest.mark.slow
def test_a_rise_that_nothing_explains_yet_scores_below_the_threshold(monkeypatch):
    monkeypatch.setattr("sealscope.diagnosis.live.watch.explain_rise", lambda *arguments: UNKNOWN)
    watch = Watch(RIG, 1000.0, 1000.0)
    watch.update(WORN)
    assert watch.leak is None
    assert watch.evidence.verdict != "leak"
    assert watch.evidence.bound_lpm > LEAK * 1e5 * 6e4  # the bound covers the rise
    assert 0.99 * watch.evidence.threshold < watch.evidence.score < watch.evidence.threshold


@pytest.mark.slow  # compiles a solver of its own
def test_behind_a_servo_valve_each_chamber_has_a_balance():
    import sealscope as ss

    recording = ss.simulate(
        rig="servo-valve", command="position 30 mm sin(3t)", duration=120.0, leak="0.05 L/min from 90 s", seed=3
    )
    watch = ss.watch("servo-valve", false_alarms_per_1000_h=400.0)
    watch.update(recording)
    assert watch.evidence.cause == "piston leak"
    assert watch.evidence.onset_s == pytest.approx(90.0, abs=2.0 * BLOCK_SECONDS)


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


@pytest.mark.parametrize(
    "q",
    [
        pytest.param(0.0, marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param(0.01, marks=[pytest.mark.slow, pytest.mark.long]),
        1.0,
    ],
)
@pytest.mark.slow
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


def highest(values: np.ndarray, window: int) -> list[float]:
    """The largest log M of the detector in each window of values."""
    detector, evidence = StepDetector(), []
    for k, value in enumerate(values):
        detector.take(3.0 * k, 3.0 * k + 3.0, value, 1.0)
        evidence.append(detector.log_e())
    return [max(evidence[k : k + window]) for k in range(0, len(evidence) - window + 1, window)]


def starts(random: np.random.Generator, count: int) -> np.ndarray:
    """A conductance that stands out by 28 deviations in each fourteenth block, as a clamp's after its rest."""
    values = walk(random, count, 0.0)
    values[7::14] += 28.0
    return values


def test_what_a_healthy_machine_shows_is_no_step():
    """The start of each cycle gave alarms after two cycles; learned over half an hour, it gives none."""
    random, null, probability = np.random.default_rng(8), StepNull(), 1e-6
    assert null.log_threshold(probability) == pytest.approx(-np.log(probability))
    for evidence in highest(starts(random, 600), WINDOW):
        null.add_window(evidence)
    assert max(highest(starts(random, 4000), WINDOW)) < null.log_threshold(probability)


def test_a_random_walk_leaves_the_threshold_as_it_is():
    random, null = np.random.default_rng(9), StepNull()
    for evidence in highest(walk(random, 1200, 0.1), WINDOW):
        null.add_window(evidence)
    for probability in (1e-4, 1e-6):
        assert null.log_threshold(probability) == pytest.approx(-np.log(probability), abs=0.5)


def test_windows_are_counted_block_by_block_and_restored():
    null, random = StepNull(), np.random.default_rng(10)
    evidence = random.exponential(6.0, 10 * WINDOW + 7)
    for k, value in enumerate(evidence):
        if k == 5 * WINDOW + 3:
            restored = StepNull()
            restored.load_state(json.loads(json.dumps(null.state())))
            null = restored
        null.add(value)
    at_once = StepNull()
    for k in range(10):
        at_once.add_window(evidence[k * WINDOW : (k + 1) * WINDOW].max())
    assert null.log_threshold(1e-6) == at_once.log_threshold(1e-6) > -np.log(1e-6)


@pytest.mark.slow
def test_a_step_that_was_no_leak_raises_the_threshold():
    watch = Watch(RIG, 1000.0, 1000.0)
    watch.update(WORN)
    before = watch._null.state()["count"]
    watch.dismiss()
    assert watch._null.state()["count"] == before + 1
    watch.relearn()
    assert watch._null.state()["count"] == 0


def test_a_step_has_its_size_and_its_onset_within_their_intervals():
    """Of steps that begin anywhere within a block."""
    random = np.random.default_rng(7)
    size, onset = [], []
    for _ in range(25):
        values, at = walk(random, 120, 0.0), 90.0 + random.uniform(0.0, 1.0)
        values += 15.0 * np.clip(np.arange(120) + 1.0 - at, 0.0, 1.0)
        detector = StepDetector()
        for k, value in enumerate(values):
            detector.take(3.0 * k, 3.0 * k + 3.0, value, 2.0)
        rise = detector.rise()
        size.append(abs(rise.size - 15.0) < 2.5 * rise.deviation)
        onset.append(rise.interval.low - 0.2 <= 3.0 * at <= rise.interval.high + 0.2)
    assert np.mean(size) > 0.85
    assert np.mean(onset) > 0.85


def test_an_onset_that_was_thinned_out_lies_within_the_interval():
    """Steps so small that they are found after a while, when fewer onsets are kept."""
    random = np.random.default_rng(3)
    held = []
    for _ in range(12):
        detector, at = StepDetector(), 100.0 + random.uniform(0.0, 64.0)
        for k in range(260):
            step = 1.3 * np.clip(k + 1.0 - at, 0.0, 1.0)
            detector.take(3.0 * k, 3.0 * k + 3.0, random.standard_normal() + step, 1.0)
        rise = detector.rise()
        held.append(rise.interval.low <= 3.0 * at <= rise.interval.high)
    assert np.mean(held) > 0.8


def test_a_large_step_beside_warming_oil_is_not_dated_back():
    """A filter without a walk lags behind the trend, and its terms of M explain the step by an onset long before."""
    random = np.random.default_rng(1)
    detector, unit = StepDetector(), 8e-15
    for k in range(640):
        g = 1.2e-12 + 4.6e-16 * k + 5e-15 * np.sin(0.05 * k) + (3.5e-13 if k >= 637 else 0.0)
        detector.take(3.0 * k, 3.0 * k + 3.0, g + unit * random.standard_normal(), unit)
    rise = detector.rise()
    assert 3.0 * 636 <= rise.interval.low <= 3.0 * 637 <= rise.interval.high <= 3.0 * 638
    assert rise.size == pytest.approx(3.5e-13, rel=0.1)


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
    again.load_state(json.loads(saved))
    for one in (detector, again):
        one.take(2500.0, 2501.0, 9.0, 1.0)
    assert json.dumps(again.state()) == json.dumps(detector.state())


def test_a_live_balance_is_restored_at_any_instant():
    def conductances(live: LiveBalance, first: int, last: int) -> list[BlockConductance]:
        piece = WORN.samples(slice(first, last))
        shown = live.take(SampleRun(piece.t, piece.channels, piece.rate, follows=first > 0))
        return [block for blocks in shown if isinstance(blocks, list) for block in blocks]

    names = tuple(WORN.channels)
    whole = conductances(LiveBalance(RIG, names), 0, len(WORN))
    for stop in (10, 4000):
        live = LiveBalance(RIG, names)
        before = conductances(live, 0, stop)
        again = LiveBalance(RIG, names)
        again.load_state(json.loads(json.dumps(live.state(), allow_nan=False)))
        assert before + conductances(again, stop, len(WORN)) == whole


@pytest.mark.slow
def test_a_stream_recovers_by_itself_from_readings_of_faulty_sensors():
    """Within half an hour of right ones, and whatever the messages: motion and noise of the fault had been learned."""
    random, rate, names = np.random.default_rng(1), 16.0, ("p_A", "p_B", "theta", "x")
    right = machine(2, duration=120.0, rate=rate)
    readings = np.stack([right[name] for name in names])
    wild = random.standard_normal((4, 1600)) * 10.0 ** random.uniform(-3.0, 8.0, (4, 1600))
    samples = np.concatenate([wild, np.tile(readings, (1, 17))], axis=1)

    def results(size: int) -> list[BlockResult]:
        live, shown = LiveBalance(RIG, names), list[BlockResult]()
        for first in range(0, samples.shape[1], size):
            channels = dict(zip(names, samples[:, first : first + size], strict=True))
            t = np.arange(first, first + len(channels["x"])) / rate
            shown.extend(live.take(SampleRun(t, channels, rate, follows=first > 0)))
        return shown

    with np.errstate(all="ignore"):
        whole = results(samples.shape[1])
        assert results(80) == whole
    assert sum(block.is_outdated for block in whole if isinstance(block, NotJudged)) == 1
    conductances = [block.g for blocks in whole if isinstance(blocks, list) for block in blocks]
    assert np.mean(conductances[-40:]) == pytest.approx(2.4e-13, rel=0.2)  # what the pump passes


def test_readings_beyond_all_pressures_are_counted_as_missing():
    watch = Watch(RIG, 1000.0, 1000.0)
    watch.update(replace(WORN, channels={**WORN.channels, "p_A": 1e90 * WORN["p_A"]}))
    assert watch.counters.keys() == {"blocks: missing values"}


def test_a_stream_restores_the_sign_of_a_speed_as_its_recording_does():
    """A pump's speed without a sign hid its leakage while the piston moves in."""
    recording = machine(1, G=3e-13, duration=120.0, rate=100.0)  # the pump leaks 2.4e-13
    speed = 12.0 * np.sin(4.0 * recording.t) + 0.02 * np.random.default_rng(1).standard_normal(len(recording))
    channels = {"omega": np.abs(speed), **{name: recording[name] for name in ("x", "p_A", "p_B")}}
    live = LiveBalance(RIG, tuple(channels))
    results = list(live.take(SampleRun(recording.t, channels, recording.rate, follows=False)))
    totals = [block.total for blocks in results if isinstance(blocks, list) for block in blocks]
    assert np.mean(totals) == pytest.approx(5.4e-13, rel=0.1)
