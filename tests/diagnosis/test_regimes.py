"""What rests tell: a machine whose valves shut while it rests, and one whose valves stay open."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sealscope.diagnosis.inference.balance import recorded_blocks
from sealscope.diagnosis.inference.terms import find_rests
from sealscope.diagnosis.inference.volumes.detector import VolumeBalance
from sealscope.diagnosis.inference.volumes.recorded import RecordedBalance
from sealscope.parameters import load_rig
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.recording import Array, Recording

from .judging import judge

RIG = load_rig("thesis")
RATE, AREA, DISPLACEMENT = 100.0, 633e-6, 4.9e-6 / (2.0 * np.pi)
PUMP, STORED, LOAD = 4e-13, 1.7e-13, 8e6
CYCLE = 12.0


def press(seed: int, leak: float = 0.0, since: float = 0.0, shut: bool = True, seconds: float = 96.0) -> Recording:
    """Record a press that moves out and loads, holds with the pump at rest, and comes back.

    A dx = D omega dt - S d(p_A - p_B) - (G_pump [moves or open] + G) (p_A - p_B) dt.
    """
    random = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    phase = t % CYCLE
    moves = (phase < 2.5) | (phase > 9.5)
    stroke = np.interp(phase, [0.0, 0.4, 2.1, 2.5, 9.5, 9.9, 11.6, 12.0], [0.0, 1.0, 1.0, 0.0, 0.0, -1.0, -1.0, 0.0])
    force = np.interp(phase, [0.0, 0.4, 1.5, 2.4, 9.6, 10.0, 12.0], [-0.05, 0.05, 0.1, 1.0, 1.0, -0.05, -0.05])
    omega, dp = 60.0 * stroke, LOAD * force * (1.0 + 0.1 * np.sin(0.7 * t))
    passes = PUMP * (moves if shut else np.ones(t.size)) + leak * (t >= since)
    rate = DISPLACEMENT * omega - STORED * np.gradient(dp) * RATE - passes * dp
    x = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]))]) / (RATE * AREA)
    channels = {
        "omega": omega + 0.01 * random.standard_normal(t.size),
        "x": x + 2e-6 * random.standard_normal(t.size),
        "p_A": 5e5 + 0.5 * dp + 2e3 * random.standard_normal(t.size),
        "p_B": 5e5 - 0.5 * dp + 2e3 * random.standard_normal(t.size) + LOAD,
    }
    channels["p_A"] += LOAD
    return Recording(t, channels, {name: CHANNEL_UNITS[name] for name in channels}, RATE)


@cache
def balance(seed: int, **what: float) -> RecordedBalance:
    own = VolumeBalance(RIG).balance(press(seed, **what))
    assert own is not None
    return own


def test_a_valve_that_shuts_is_told_from_one_that_stays_open() -> None:
    for seed in range(3):
        shut, opened = (recorded_blocks(press(seed, shut=way), RIG) for way in (True, False))
        assert shut is not None and opened is not None
        assert shut.odds > 1.0 > -1.0 > opened.odds
    assert balance(0).shut and not balance(0, shut=False).shut


def test_behind_a_shut_valve_the_leak_is_the_pistons_alone() -> None:
    assert balance(0).level.high < 0.05 * PUMP
    own = VolumeBalance(RIG).balance(press(0, leak=2e-13), odds=10.0)
    assert own is not None and own.shut
    assert own.level.value == pytest.approx(2e-13, rel=0.01)


@pytest.mark.parametrize("shut", [True, False])
def test_rests_are_no_step_and_hide_none(shut: bool) -> None:
    for seed in range(3):
        healthy, leaking = balance(seed, shut=shut).test, balance(seed, shut=shut, leak=0.5e-13, since=50.0).test
        assert healthy is not None and leaking is not None
        assert healthy.chance > 0.01 and leaking.chance < 1e-4
        assert leaking.onset().low < 50.0 < leaking.onset().high


def test_healthy_recordings_tell_which_it_is_for_a_leaking_one() -> None:
    detector = VolumeBalance(RIG)
    lessons = [detector.learn(press(seed)) for seed in range(4)]
    known = [lesson for lesson in lessons if lesson is not None]
    assert sum(lesson["shut_odds"] for lesson in known) > 4.0
    leaking = press(7, leak=1e-13)
    own = detector.balance(leaking, sum(lesson["shut_odds"] for lesson in known))
    assert own is not None and own.shut
    healthy = [press(seed) for seed in range(4)]
    assert judge(detector, leaking, healthy).verdict == "leak"


@pytest.mark.parametrize("leak", [0.0, 1e-13])
def test_a_locked_hold_measures_the_seal_alone(leak: float) -> None:
    own = VolumeBalance(RIG).balance(press(3, leak=leak), odds=10.0)
    assert own is not None and own.chambers is not None
    assert own.chambers.leaks.piston == pytest.approx(leak, rel=0.35, abs=2e-15)


def test_a_reversal_is_no_rest_and_a_missing_sample_neither() -> None:
    t = np.arange(2000) / RATE
    assert not find_rests(np.sin(2.0 * t) / RATE, RATE, 0.05).any()
    stopped = np.where((t > 5.0) & (t < 9.0), 0.0, 1.0) / RATE
    rests: Array = find_rests(stopped, RATE, 0.05)
    assert 3.8 < np.count_nonzero(rests) / RATE < 4.2
    stopped[700] = np.nan
    assert not find_rests(stopped, RATE, 0.05)[690:711].all()
