"""An actuator watched from its pressures and the command: L/min and an alarm, disorder, restarts, other duties."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import sealscope as ss
from sealscope.diagnosis.live.estimates import BlockEstimate
from sealscope.diagnosis.live.watch import Watch
from sealscope.errors import InputError
from sealscope.recordings.recording import CHANNEL_UNITS, Recording
from sealscope.simulation.changes import ParameterDrift, linear_path

from .plant import moved

#: Leak of the worn machine [L/min], and since when [s].
LEAK, OPENS, LENGTH = 0.015, 620.0, 780.0
LEARN = 0.08
CHANNELS = ("p_A", "p_B", "u")


def simulated(**values: object) -> Recording:
    return ss.simulate(command="5 sin(2t)", seed=1, set={"pump.G_pump": 2e-13}, **values).only(CHANNELS)


@cache
def worn() -> Recording:
    return simulated(duration=LENGTH, leak=f"{LEAK} L/min from {OPENS} s")


def run(recording: Recording, size: int, watch: Watch | None = None) -> tuple[Watch, list[BlockEstimate]]:
    """The watch and its estimates after samples in pieces of this size."""
    watch = watch or ss.watch("thesis", learn_hours=LEARN)
    estimates = []
    for first in range(0, len(recording), size):
        estimates += watch.update(recording.samples(slice(first, first + size)))
    return watch, estimates


#: Seconds of healthy running, after which the baseline is known, and the state then.
HEALTHY = 500.0


def part(first: float, last: float) -> Recording:
    return worn().samples(slice(round(first * 500.0), round(last * 500.0)))


@pytest.mark.slow
def test_a_leak_is_stated_in_litres_per_minute_with_its_onset():
    watch, estimates = whole(LENGTH)
    assert watch.method == "pressures"
    assert watch.leak is not None and watch.baseline is not None
    assert OPENS < watch.leak.raised_s < OPENS + 120.0
    low, high = watch.leak.onset_interval_s
    assert low <= OPENS <= high
    low_lpm, high_lpm = estimates[-1].leak_interval_lpm
    assert low_lpm <= LEAK <= high_lpm
    assert estimates[-1].leak_lpm == pytest.approx(LEAK, rel=0.3)
    assert watch.leak.cause == "piston, pump or external leak"
    healthy = [estimate for estimate in estimates if estimate.status == "watched" and estimate.t < OPENS]
    assert len(healthy) > 20
    assert all(estimate.leak_interval_lpm[0] == 0.0 for estimate in healthy)
    assert all(estimate.total_lpm is None for estimate in estimates)  # the level is not known well enough
    assert watch.baseline.lpm is None
    assert watch.baseline.level == pytest.approx(2e-13, abs=1.5e-12)


@cache
def whole(seconds: float) -> tuple[Watch, list[BlockEstimate]]:
    return run(part(0, seconds), 500_000)


def cut(seconds: float, size: int, stop: int) -> None:
    """Compare the watch of the first seconds with that of pieces between which it was saved and restored."""
    first, before = run(part(0, seconds).samples(slice(0, stop)), size)
    again = Watch.from_state(json.loads(json.dumps(first.state(), allow_nan=False)))
    _, after = run(part(0, seconds).samples(slice(stop, None)), size, again)
    assert before + after == whole(seconds)[1]
    assert json.dumps(again.state()) == json.dumps(whole(seconds)[0].state())


@pytest.mark.slow
@pytest.mark.parametrize("stop", [20_000, pytest.param(47_000, marks=pytest.mark.long)])  # before the first fit, after
def test_cuts_and_restarts_change_nothing(stop: int):
    cut(105.0, 7_001, stop)


@pytest.mark.long
@pytest.mark.slow
@settings(max_examples=2, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(size=st.integers(1_000, 60_000), stop=st.integers(3_000, 350_000))
def test_cuts_and_restarts_change_no_leak(size: int, stop: int):
    cut(LENGTH, size, stop)


@pytest.fixture(scope="module")
def learned() -> str:
    return json.dumps(run(part(0, HEALTHY), 50_000)[0].state())


def test_a_short_gap_is_bridged_and_after_a_pause_nothing_before_counts(learned: str):
    watch = Watch.from_state(json.loads(learned))
    level = watch.baseline.level
    _, bridged = run(part(510, 580), 5_000, watch)
    assert [estimate.status for estimate in bridged][:4] == ["settling"] * 3 + ["watched"]
    shown = [estimate.leak_lpm for estimate in bridged if estimate.leak_lpm is not None]
    assert abs(np.mean(shown)) < 0.004
    _, paused = run(moved(part(640, 780), 3600.0), 5_000, watch)  # it leaks, and the onset lies within the pause
    statuses = [estimate.status for estimate in paused]
    assert statuses[:10] == ["settling"] * 10
    assert set(statuses[10:]) <= {"conductance not resolved", "watched"}
    assert watch.leak is None and watch.baseline.level == level
    assert watch.counters["gap"] == 2


def test_another_clock_and_a_long_loss_of_samples_begin_anew(learned: str):
    watch = Watch.from_state(json.loads(learned))
    again = part(0, 140)
    estimates = watch.update(replace(again, t=again.t + HEALTHY - 70.0), follows=False)
    assert [estimate.status for estimate in estimates[:10]] == ["settling"] * 10
    assert watch._since >= HEALTHY - 10.0  # blocks before are not compared
    lost = replace(again, t=again.t + HEALTHY + 70.0, channels={**again.channels, "p_A": np.full(len(again), np.nan)})
    for k in range(3):
        watch.update(replace(lost, t=lost.t + 140.0 * k))
    estimates = watch.update(replace(again, t=again.t + HEALTHY + 490.0))
    assert [estimate.status for estimate in estimates[:10]] == ["settling"] * 10
    assert watch.leak is None


@pytest.mark.slow
def test_a_leak_to_the_outside_is_stated_as_what_leaves_its_chamber():
    """The response shows it as a leak past the piston of two to four times its flow."""
    recording = ss.simulate(
        command="3 sin(4t)",
        duration=400.0,
        seed=5,
        set={"makeup.check_valves": "present", "p_charge": "0.3 MPa"},
        fault="rod seal A 0.0042 L/min from 330 s",
    )
    watch = ss.watch("thesis", learn_hours=0.04)
    estimate = watch.update(recording.only(("p_A", "p_B", "u")))[-1]
    assert watch.leak.cause == "external leak"
    leaves = 0.0042 * float(recording.between(330.0, 400.0)["p_A"].mean()) / 0.3e6
    for low, high in (estimate.leak_interval_lpm, watch.leak.leak_interval_lpm):
        assert low <= leaves <= high < 4.0 * leaves


def test_another_duty_and_a_lost_machine_are_not_judged(learned: str):
    watch = Watch.from_state(json.loads(learned))
    half = part(500, 560)
    faster = Recording(half.t, {**half.channels, "u": 1.4 * half["u"]}, half.units, half.rate)
    _, estimates = run(faster, 5_000, watch)
    assert {estimate.status for estimate in estimates} <= {"not described by the model", "settling", "another duty"}
    broken = Recording(
        half.t + 60.0, {**half.channels, "p_A": np.where(half.t > 530.0, np.nan, half["p_A"])}, half.units, half.rate
    )
    _, estimates = run(broken, 5_000, watch)
    assert "missing values" in {estimate.status for estimate in estimates}
    assert watch.leak is None


def test_a_fit_lost_to_impossible_readings_begins_anew(learned: str):
    watch, half = Watch.from_state(json.loads(learned)), part(500, 610)
    is_wrong = (half.t >= 506.0) & (half.t < 512.0)
    wrong = {name: np.where(is_wrong, 1e20 * np.sin(2.0 * half.t), half[name]) for name in ("u",)}
    _, estimates = run(Recording(half.t, {**half.channels, **wrong}, half.units, half.rate), 5_000, watch)
    assert "not described by the model" in {estimate.status for estimate in estimates}
    _, later = run(moved(part(510, 610), 100.0), 5_000, watch)
    assert later[-1].status == "watched"
    assert watch.leak is None


def test_the_motion_is_the_pumps_flow(learned: str):
    """Of which a bound is a fraction; in volts any bound would have been small beside it."""
    rig = ss.load_rig("thesis")
    flow = rig.motor.omega_per_volt * 5.0 * (2.0 / np.pi) * rig.pump.q_b / (2.0 * np.pi)
    assert np.exp(Watch.from_state(json.loads(learned)).baseline.duty_high[1]) == pytest.approx(flow, rel=0.05)


def at_rate(recording: Recording, rate: float) -> Recording:
    kept = recording.samples(slice(None, None, round(recording.rate / rate)))
    return Recording(kept.t, dict(kept.channels), kept.units, rate)


@pytest.mark.slow
def test_another_rate_is_no_leak_and_hides_none(learned: str):
    watch = Watch.from_state(json.loads(learned))
    _, estimates = run(at_rate(part(500, 620), 250.0), 5_000, watch)
    assert watch.leak is None
    assert [estimate.status for estimate in estimates] == ["settling"] * 3 + ["watched"] * 17
    run(at_rate(part(620, 780), 250.0), 5_000, watch)
    assert watch.leak is not None
    low, high = watch.leak.onset_interval_s
    assert low <= OPENS <= high


@pytest.mark.slow
@pytest.mark.long
def test_a_rate_too_slow_costs_its_blocks_only(learned: str):
    watch = Watch.from_state(json.loads(learned))
    _, slow = run(at_rate(part(500, 530), 125.0), 5_000, watch)
    _, estimates = run(part(530, 620), 5_000, watch)
    assert {estimate.status for estimate in slow} == {"sampled at less than 200 Hz"}
    assert estimates[-1].status == "watched"
    assert watch.leak is None
    late = ss.watch("thesis", learn_hours=LEARN)
    run(at_rate(part(0, 30), 125.0), 5_000, late)
    _, estimates = run(part(30, 200), 5_000, late)
    assert estimates[-1].status == "learning"


def test_what_is_not_resolved_is_not_said_to_stand_still():
    recording = ss.simulate(command="1 sin(1t)", duration=120.0, seed=1).only(CHANNELS)  # too slow to tell G
    _, estimates = run(recording, 10_000)
    assert {estimate.status for estimate in estimates} == {"settling", "conductance not resolved"}


def test_a_machine_without_a_command_that_changes_is_at_standstill(learned: str):
    watch = Watch.from_state(json.loads(learned))
    still = ss.simulate(command="step 0 at 1 s", duration=60.0, seed=2).only(CHANNELS)
    _, estimates = run(moved(still, HEALTHY), 10_000, watch)
    assert estimates[-1].status == "at standstill"
    assert watch.leak is None


@pytest.mark.parametrize(
    ("rig", "names"),
    [
        ("thesis", ("p_A", "p_B", "theta")),
        ("thesis", ("p_A", "p_B", "omega")),
        ("single-rod-eha", ("p_A", "p_B", "u")),
        ("servo-valve", ("p_A", "p_B", "u")),
    ],
)
def test_channels_that_do_not_suffice_are_refused_with_those_that_do(rig: str, names: tuple[str, ...]):
    t = np.arange(0.0, 100.0, 0.002)
    units = {name: CHANNEL_UNITS[name] for name in names}
    watch = ss.watch(rig)
    assert watch.update(Recording(t, {name: np.sin(t) for name in names}, units, 500.0)) == []
    ((reason, number),) = watch.counters.items()
    assert number == len(t)
    assert reason.startswith("samples without p_A, p_B")
    assert watch.evidence.verdict == "cannot tell" and reason in watch.evidence.reason


def test_slow_samples_are_said_to_be_too_slow():
    slow = simulated(duration=90.0, rate=100.0)
    watch, estimates = run(slow, 10_000)
    assert {estimate.status for estimate in estimates} == {"sampled at less than 200 Hz"}
    assert watch.leak is None


def test_a_position_that_comes_with_the_second_block_is_used():
    watch = ss.watch("thesis", learn_hours=LEARN)
    whole = ss.simulate(command="5 sin(2t)", duration=70.0, seed=2)
    watch.update(whole.between(0, 1).only(CHANNELS))
    assert watch.method == "pressures"
    watch.update(whole.between(1, 70))
    assert watch.method == "volumes"
    assert watch.counters == {"began anew: a position is recorded, too": 1}


@pytest.mark.slow
def test_oil_that_warms_is_no_leak():
    warm = [
        ParameterDrift("pump.G_pump", linear_path(0.5, 600.0)),
        ParameterDrift("friction.F_v", linear_path(-0.3, 600.0)),
        ParameterDrift("fluid.K_oil", linear_path(-0.05, 600.0)),
    ]
    watch, estimates = run(simulated(duration=600.0, drifts=warm), 50_000)
    assert watch.leak is None
    assert estimates[-1].status == "watched"


@pytest.mark.parametrize("damage", ["follower", "end", "settling"])
def test_a_damaged_state_is_refused_in_one_line(damage: str, learned: str):
    state = json.loads(learned)
    estimator = {**state["estimator"], damage: {"x": 1}}
    with pytest.raises(InputError) as raised:
        Watch.from_state({**state, "estimator": estimator})
    assert "\n" not in str(raised.value)


@pytest.mark.slow
def test_a_rig_of_assumptions_states_no_litres():
    watch = ss.watch(ss.load_rig("thesis").as_assumed("for this test"), learn_hours=LEARN)
    _, estimates = run(part(0, 420), 50_000, watch)
    assert watch.baseline is not None
    assert all(replace(estimate, status="") == BlockEstimate(estimate.number, estimate.t, "") for estimate in estimates)
