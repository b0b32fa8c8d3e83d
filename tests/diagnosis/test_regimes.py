"""What rests tell: a machine whose valves shut while it rests, and one whose valves stay open."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from sealscope.diagnosis.inference.comparison import BalanceSummary, Rise
from sealscope.diagnosis.inference.equations.terms import TURNING
from sealscope.diagnosis.inference.hypotheses import MachineOdds, Valves
from sealscope.diagnosis.inference.machine_states import AVERAGING_TIME, find_rests, rest_limit
from sealscope.diagnosis.inference.regimes import recorded_blocks
from sealscope.diagnosis.inference.volumes.balance_leak import BalanceLeak
from sealscope.diagnosis.inference.volumes.recorded import RecordedBalance
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.inference.volumes.volume_detector import _fit_sums as fit_sums
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.parameters import load_rig
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.recording import Array, Recording

from ..representatives import few
from .judging import judge

RIG = load_rig("thesis")
RATE, AREA, DISPLACEMENT = 100.0, 633e-6, 4.9e-6 / (2.0 * np.pi)
PUMP, STORED, LOAD = 4e-13, 1.7e-13, 8e6
CYCLE = 12.0
#: Loads through a cycle, over `LOAD`; the fourth and fifth while it rests.
LOADS = (-0.05, 0.05, 0.1, 1.0, 1.0, -0.05, -0.05)


@cache
def press(
    seed: int,
    leak: float = 0.0,
    since: float = 0.0,
    shut: bool = True,
    seconds: float = 96.0,
    start: float = 0.0,
    pump: float = PUMP,
    servo: bool = False,
    loads: tuple[float, ...] = LOADS,
    speed_noise: float = 0.01,
    holds_until: float = 0.0,
    kept: tuple[float, float] = (0.0, 0.0),
) -> Recording:
    """Record a press that moves out and loads, holds with the pump at rest, and comes back.

    A dx = D omega dt - S d(p_A - p_B) - (G_pump [moves or open] + G) (p_A - p_B) dt. Before `start` [s] it is off, its
    valves shut under the load of a hold. A `servo` makes good what leaks, also during a hold. Until `holds_until` [s]
    the pump turns in holds, too, and makes good what leaks; later it is off in holds. At the beginning of each hold it
    keeps up the pressure for a time `kept` [s], of the first and of the second half of the recording.
    """
    random = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    phase = np.where(t < start, 6.0, (t - start + (9.0 if start else 0.0)) % CYCLE)
    moves = (phase < 2.5) | (phase > 9.5)
    stroke = np.interp(phase, [0.0, 0.4, 2.1, 2.5, 9.5, 9.9, 11.6, 12.0], [0.0, 1.0, 1.0, 0.0, 0.0, -1.0, -1.0, 0.0])
    force = np.interp(phase, [0.0, 0.4, 1.5, 2.4, 9.6, 10.0, 12.0], loads)
    omega, dp = 60.0 * stroke, LOAD * force * (1.0 + 0.1 * np.sin(0.7 * t))
    is_kept = (phase >= 2.5) & (phase < 2.5 + np.where(t < 0.5 * seconds, *kept))
    holds = ~moves & ((t < holds_until) | is_kept)
    passes = pump * (moves | holds if shut else t >= start) + leak * (t >= since)
    omega += passes * dp * ((t >= start) if servo else holds) / DISPLACEMENT
    rate = DISPLACEMENT * omega - STORED * np.gradient(dp) * RATE - passes * dp
    x = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]))]) / (RATE * AREA)
    channels = {
        "omega": omega + speed_noise * random.standard_normal(t.size),
        "x": x + 2e-6 * random.standard_normal(t.size),
        "p_A": 5e5 + 0.5 * dp + 2e3 * random.standard_normal(t.size),
        "p_B": 5e5 - 0.5 * dp + 2e3 * random.standard_normal(t.size) + LOAD,
    }
    channels["p_A"] += LOAD
    return Recording(t, channels, {name: CHANNEL_UNITS[name] for name in channels}, RATE)


@cache
def metered_press(seed: int, leak: float = 0.0, since: float = 0.0) -> Recording:
    """Record the press with a flow meter beyond its valve, which lets through 0.4 % of the flow while it is closed.

    In motion the meter reads too much in proportion to p_A - p_B.
    """
    recording = press(seed, leak=leak, since=since)
    omega = recording["omega"]
    is_closed = find_rests(DISPLACEMENT * omega / RATE, RATE, 1e-6)
    flow = DISPLACEMENT * omega * ~is_closed - 0.004 * DISPLACEMENT * 60.0 * is_closed
    x = recording["x"] + np.cumsum((flow - DISPLACEMENT * omega) * is_closed) / (RATE * AREA)
    channels = {"q_pump": flow, "x": x, "p_A": recording["p_A"], "p_B": recording["p_B"]}
    return Recording(recording.t, channels, {name: CHANNEL_UNITS[name] for name in channels}, RATE)


@cache
def balance(seed: int, odds: float = 0.0, **options: Any) -> RecordedBalance:
    judged = VolumeBalance(RIG).balance(press(seed, **options), MachineOdds(odds))
    assert judged is not None
    return judged


@cache
def summaries() -> list[BalanceSummary]:
    """Learn three healthy recordings."""
    learnt = [VolumeBalance(RIG).learn(press(seed)) for seed in range(3)]
    return [summary for summary in learnt if summary is not None]


def test_a_valve_that_shuts_is_told_from_one_that_stays_open() -> None:
    for seed in range(2):
        shut, opened = (recorded_blocks(press(seed, shut=way), RIG) for way in (True, False))
        assert shut is not None and opened is not None
        assert shut.odds > 1.0 > -1.0 > opened.odds
    assert balance(0).valves is Valves.SHUT and balance(0, shut=False).valves is Valves.OPEN


def relaxing_press(seed: int, ratio: float) -> Recording:
    """Record a press with open valves whose piston sticks while it rests, so that its leakage relaxes the pressures.

    p_A - p_B then falls from a small load, with the time constant of compliance over conductance. The compliance at
    rest is that in motion times `ratio`, as of oil with air at low pressures.
    """
    random = np.random.default_rng(seed)
    t = np.arange(round(96.0 * RATE)) / RATE
    phase = t % CYCLE
    rests = (phase >= 2.5) & (phase <= 9.5)
    stroke = np.interp(phase, [0.0, 0.4, 2.1, 2.5, 9.5, 9.9, 11.6, 12.0], [0.0, 1.0, 1.0, 0.0, 0.0, -1.0, -1.0, 0.0])
    load = np.interp(phase, [0.0, 0.4, 1.5, 2.4, 9.6, 10.0, 12.0], [-0.05, 0.05, 0.1, 1.0, 1.0, -0.05, -0.05])
    time_constant = 5.0  # [s]
    relaxing = 0.03 * np.exp(-(phase - 2.5) / time_constant)
    dp = LOAD * np.where(rests, relaxing, load * (1.0 + 0.1 * np.sin(0.7 * t)))
    stored = PUMP * time_constant / ratio  # compliance in motion [m^3/Pa]
    omega = np.where(rests, 0.0, 60.0 * stroke)
    rate = np.where(rests, 0.0, DISPLACEMENT * omega - stored * np.gradient(dp) * RATE - PUMP * dp)
    x = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]))]) / (RATE * AREA)
    noise = random.standard_normal((4, t.size))
    channels = {
        "omega": omega + 0.01 * noise[0],
        "x": x + 2e-6 * noise[1],
        "p_A": 5e5 + np.maximum(dp, 0.0) + 2e4 * noise[2],
        "p_B": 5e5 + np.maximum(-dp, 0.0) + 2e4 * noise[3],
    }
    return Recording(t, channels, {name: CHANNEL_UNITS[name] for name in channels}, RATE)


@pytest.mark.parametrize("ratio", [1.0, 3.0])
def test_pressures_that_relax_at_rest_do_not_tell_if_a_valve_shuts(ratio: float) -> None:
    """They show only the ratio of leakage to compliance, which air in the oil makes uncertain."""
    recorded = recorded_blocks(relaxing_press(0, ratio), RIG)
    assert recorded is not None and abs(recorded.odds) < 2.0


def test_behind_a_shut_valve_the_leak_is_the_pistons_alone() -> None:
    assert balance(0).conductance.high < 0.05 * PUMP
    own = balance(0, odds=10.0, leak=2e-13)
    assert own.valves is Valves.SHUT
    assert own.conductance.value == pytest.approx(2e-13, rel=0.01)


@pytest.mark.parametrize("odds", [10.0, -10.0])
def test_the_pressure_of_its_own_side_drives_an_external_leak(odds: float) -> None:
    """The machine is fed at 100 bar, so that p_A and p_B exceed their difference."""
    recording = press(0)
    channels = {**recording.channels, "p_A": recording["p_A"] + 1e7, "p_B": recording["p_B"] + 1e7}
    judged = VolumeBalance(RIG).balance(Recording(recording.t, channels, recording.units, RATE), MachineOdds(odds))
    assert judged is not None and (judged.valves is Valves.SHUT) == (odds > 0.0)
    assert judged.mean_pressure() < 6e6
    for side in "AB":
        expected = float(channels[f"p_{side}"].mean()) * judged.size.scale
        assert expected > 1.5e7
        assert judged.outside_unit_flows()[f"external leak {side}"] == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("shut", few([True, False], 1))
def test_rests_are_no_step_and_hide_none(shut: bool) -> None:
    for seed in range(2):
        healthy, leaking = balance(seed, shut=shut).test, balance(seed, shut=shut, leak=0.5e-13, since=50.0).test
        assert healthy is not None and leaking is not None
        assert healthy.chance > 0.01 and leaking.chance < 1e-4
        assert leaking.onset().low < 50.0 < leaking.onset().high


@pytest.mark.slow
def test_a_drive_that_no_longer_turns_in_holds_is_no_leak_that_ends() -> None:
    """Neither past the piston nor to the outside; a leak that begins shows beside it."""
    for seed in range(3):
        switched = balance(seed, odds=10.0, holds_until=50.0)
        assert switched.valves is Valves.SHUT
        assert switched.test is not None and switched.test.chance > 0.01
        assert min(test.chance for test in switched.observables if test.name != TURNING) > 1e-3
        leaking = balance(seed, odds=10.0, holds_until=50.0, leak=0.5e-13, since=60.0).test
        assert leaking is not None and leaking.chance < 1e-4
        assert leaking.onset().low < 60.0 < leaking.onset().high


def test_a_press_that_keeps_up_its_pressure_for_longer_does_not_leak() -> None:
    """The pump is still connected then, and its own leakage is none of the piston's."""
    made = balance(3, kept=(1.0, 2.0))
    assert made.valves is Valves.SHUT and made.test is not None
    assert made.test.chance > 0.01
    assert made.conductance.high < 1e-3 * PUMP


def test_behind_a_flow_meter_a_load_that_creeps_by_a_leak_does_not_move_by_the_valve() -> None:
    for seed in range(3):
        measured = VolumeBalance(RIG).balance(metered_press(seed, leak=2e-13, since=50.0), MachineOdds(10.0))
        assert measured is not None and measured.separates_pump and measured.test is not None
        assert measured.test.chance < 1e-4
        assert measured.test.onset().low < 50.0 < measured.test.onset().high
        assert measured.test.fitted.value == pytest.approx(2e-13, rel=0.1)
        assert measured.conductance.value == pytest.approx(2e-13 * 46.0 / 96.0, rel=0.1)


@pytest.mark.parametrize("start", [1.5, 20.0, 21.5])
def test_a_machine_that_is_switched_on_does_not_leak_from_then_on(start: float) -> None:
    """Wherever in a block it begins to run."""
    for seed in range(2):
        healthy = balance(seed, shut=False, start=start).test
        leaking = balance(seed, shut=False, start=start, leak=0.5e-13, since=60.0).test
        assert healthy is not None and leaking is not None
        assert healthy.chance > 0.01 and leaking.chance < 1e-4
        assert leaking.onset().low < 60.0 < leaking.onset().high


@pytest.mark.slow
def test_healthy_recordings_tell_which_it_is_for_a_leaking_one() -> None:
    detector = VolumeBalance(RIG)
    odds = sum(summary.shut_odds or 0.0 for summary in summaries())
    assert odds > 4.0
    leaking = press(7, leak=1e-13)
    assert balance(7, odds=odds, leak=1e-13).valves is Valves.SHUT
    healthy = [press(seed) for seed in range(4)]
    assert judge(detector, leaking, healthy).verdict == "leak"


@pytest.mark.slow
def test_a_hold_behind_valves_tells_a_leak_from_a_pump_that_differs_from_day_to_day() -> None:
    """While the machine is on, a servo holds the load and the pump's leakage is in the balance, at rest too."""
    detector = VolumeBalance(RIG)
    healthy = [
        press(seed, shut=False, start=20.0, pump=pump, servo=True) for seed, pump in enumerate((3e-13, 5e-13, 4e-13))
    ]
    summaries = [detector.learn(recording) for recording in healthy]
    assert all(
        summary is not None and min(summary.held_odds or 0.0, summary.shut_odds or 0.0) > INFERENCE.rest.sure_odds
        for summary in summaries
    )
    for leak in (0.0, 5e-14):
        judged = press(7, shut=False, start=20.0, pump=4.4e-13, servo=True, leak=leak)
        evidence = judge(detector, judged, healthy)
        assert evidence.verdict == ("leak" if leak else "no leak")
        assert evidence.cause == ("piston leak" if leak else None)


@pytest.mark.slow
def test_a_hold_before_the_onset_does_not_hide_the_rise_of_the_whole_recording() -> None:
    """The drive is off for 20 s, its valves shut; the leak begins later, while the pump holds the load."""
    pumps = (4e-13, 4.2e-13, 4.1e-13, 3.9e-13, 4e-13)
    healthy = [press(seed, shut=False, start=20.0, pump=pump, servo=True) for seed, pump in enumerate(pumps)]
    chances = []
    for leak in (0.0, 2e-13):
        judged = press(7, shut=False, start=20.0, pump=4.05e-13, servo=True, leak=leak, since=60.0)
        measured = VolumeBalance(RIG).observe(judged, healthy).leak
        assert measured is not None and measured.rise is not None
        chances.append(measured.rise.chance)
    assert chances[0] > 0.1 and chances[1] < 0.01


def test_holds_without_a_load_or_with_a_pump_that_makes_good_a_leakage_measure_none() -> None:
    """Equal pressures show no leak, and a pump that turns slower than its noise keeps up a load."""
    loaded = balance(0, odds=np.inf)
    unloaded = balance(0, odds=np.inf, loads=(-0.5, 0.5, 1.0, 0.01, 0.01, -0.5, -0.5))
    kept_up = balance(0, odds=np.inf, shut=False, servo=True, pump=5e-14, speed_noise=1.0)
    assert {each.valves for each in (loaded, unloaded, kept_up)} == {Valves.SURELY_SHUT}
    assert balance(0, odds=10.0).chambers is None
    assert loaded.chambers is not None and unloaded.chambers is None and kept_up.chambers is None


@pytest.mark.parametrize("leak", few([1e-13, 0.0], 1))
def test_a_locked_hold_measures_the_seal_alone(leak: float) -> None:
    own = balance(3, odds=np.inf, leak=leak)
    assert own.chambers is not None
    assert own.chambers.leaks.piston == pytest.approx(leak, rel=0.35, abs=2e-15)


@pytest.mark.slow
@pytest.mark.parametrize("leak", few([2e-14, 0.0], 1))
def test_the_bound_is_the_holds_where_they_know_better(leak: float) -> None:
    judged = balance(7, odds=np.inf, leak=leak)
    healthy = [fit_sums(summary, judged.columns) for summary in summaries()]
    held, wide = BalanceLeak(judged, healthy), Rise(leak, 5e-14, np.inf)
    held.__dict__["_motion_rise"] = wide
    assert leak * judged.mean_pressure() < held.bound_flow
    assert held.bound_flow < 0.7 * wide.bound() * judged.mean_pressure()


@pytest.mark.slow
def test_a_rise_that_began_within_the_recording_is_dated_by_the_holds() -> None:
    for leak, since in ((1e-13, 0.0), (1e-13, 50.0)):
        judged = balance(7, odds=np.inf, leak=leak, since=since)
        healthy = [fit_sums(summary, judged.columns) for summary in summaries()]
        onset = BalanceLeak(judged, healthy).rise_onset
        assert (onset is None) == (since == 0.0)
        assert onset is None or onset.low <= since <= onset.high


def test_healthy_recordings_tell_the_sign_of_the_flow() -> None:
    """A recording that may have either sign takes that of the healthy ones; one that is sure of its own keeps it."""
    recorded = recorded_blocks(press(3, shut=True), RIG)
    assert recorded is not None
    unsure = recorded._replace(sign_log_odds=(-0.3,))
    for one in (recorded, unsure):  # neither has been reversed yet
        assert one.with_sign_prior(np.zeros(1)) is one
    assert recorded.with_sign_prior(np.array([-2.0])) is recorded
    mirrored = unsure.with_sign_prior(np.array([5.0]))
    e, left = 0, recorded.open.columns[0].left
    before, after = recorded.open.blocks.gram[:, e], mirrored.open.blocks.gram[:, e]
    np.testing.assert_array_equal(after[:, left, left], before[:, left, left])
    np.testing.assert_array_equal(after[:, left, :left], -before[:, left, :left])
    np.testing.assert_array_equal(after[:, :left, :left], before[:, :left, :left])
    assert mirrored.shut is not None and not np.array_equal(mirrored.shut.blocks.gram, recorded.shut.blocks.gram)


def test_the_sense_of_a_flow_is_that_of_the_force_on_both_areas() -> None:
    """A lift throttles its rod side: p_A - p_B falls while it goes up, but the force of the pressures rises."""
    rig = load_rig("single-rod-eha")
    area_A, area_B = rig.cylinder.A_A, rig.cylinder.A_B
    random, t = np.random.default_rng(5), np.arange(round(90.0 * RATE)) / RATE
    way = np.sign(np.sin(0.5 * t))
    x = np.cumsum(0.02 * way) / RATE
    throttled = 5e5 + 3e6 * np.maximum(way, 0.0)
    force = 2e4 + 400.0 * way
    p_A = (force + area_B * throttled) / area_A
    assert np.corrcoef(p_A - throttled, way)[0, 1] < 0.0 < np.corrcoef(force, way)[0, 1]
    channels = {
        "p_A": p_A + 2e3 * random.standard_normal(len(t)),
        "p_B": throttled + 2e3 * random.standard_normal(len(t)),
        "x": x + 1e-6 * random.standard_normal(len(t)),
        "q_pump": 0.02 * way * area_A,
    }
    recording = Recording(t, channels, {name: CHANNEL_UNITS[name] for name in channels}, RATE)
    recorded = recorded_blocks(recording, rig)
    assert recorded is not None and recorded.sign_log_odds[0] > 1.0


def test_means_of_neighbouring_samples_do_not_hide_the_noise_of_a_resting_pump() -> None:
    """The volume of an interval is the mean of two samples of the speed, and half of its noise the next one's."""
    rate, random = 50.0, np.random.default_rng(2)
    speed = np.where(np.arange(6000) < 600, 1.0, 0.0) + 0.1 * random.standard_normal(6000)
    limit = rest_limit(0.5 * (speed[1:] + speed[:-1]) / rate, rate, fraction=0.0)
    averaged = np.convolve(speed[600:], np.ones(round(AVERAGING_TIME * rate)) / round(AVERAGING_TIME * rate), "valid")
    assert 2.0 * averaged.std() < limit < 5.0 * averaged.std()


def test_a_reversal_is_no_rest_and_a_missing_sample_neither() -> None:
    t = np.arange(2000) / RATE
    assert not find_rests(np.sin(2.0 * t) / RATE, RATE, 0.05).any()
    stopped = np.where((t > 5.0) & (t < 9.0), 0.0, 1.0) / RATE
    rests: Array = find_rests(stopped, RATE, 0.05)
    assert 3.8 < np.count_nonzero(rests) / RATE < 4.2
    stopped[700] = np.nan
    assert not find_rests(stopped, RATE, 0.05)[690:711].all()


def test_the_volumes_of_a_hold_begin_where_no_recording_moves() -> None:
    """A lift that made one short stroke had its dead volumes in proportion to it: its leak passed for one outside."""
    shifted = [
        Recording(healthy.t, {**healthy.channels, "x": healthy["x"] + shift}, healthy.units, RATE)
        for healthy, shift in ((press(0), 0.0), (press(1), -0.1), (press(2), 0.3))
    ]
    alone, beside = (
        VolumeBalance(RIG).observe(press(3), healthy).leak for healthy in ([press(0), press(1), press(2)], shifted)
    )
    assert isinstance(alone, BalanceLeak) and isinstance(beside, BalanceLeak)
    assert alone.balance.chambers is not None and beside.balance.chambers is not None
    sides, wider = alone.balance.chambers.sides, beside.balance.chambers.sides
    assert (wider.low, wider.high) == pytest.approx((sides.low - 0.1, sides.high + 0.3), abs=1e-3)
