"""Pauses: a pump that turns while the piston stands, a leak that equalises the pressures, one that begins later."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sealscope.diagnosis.estimate.change import Information, step_test
from sealscope.diagnosis.inference.equations.balances import equations, flag_circulation
from sealscope.diagnosis.inference.equations.terms import Signals
from sealscope.diagnosis.inference.hypotheses import HoldCounts
from sealscope.diagnosis.inference.machine_states import LoweringLimits, RestLimits, flag_lowering, largest_before
from sealscope.diagnosis.inference.volumes.balance_leak import BalanceLeak
from sealscope.parameters import load_rig

RATE, SPEED, AREA = 100.0, 0.05, 5e-3
EQUATION = equations(load_rig("single-rod-eha"), frozenset({"omega", "x", "p_A", "p_B"}))[0]


def press(held_flow: float, seed: int) -> tuple[Signals, float]:
    """Record a press that moves for 5 s, stands for 5 s while its pump delivers a part of the flow in motion, twice."""
    rng = np.random.default_rng(seed)
    t = np.arange(2000) / RATE
    is_held = (t % 10.0) > 5.0
    channels = {"p_A": np.where(is_held, 80e5, 10e5), "p_B": np.full(t.size, 5e5), "omega": np.ones(t.size)}
    channels["x"] = np.cumsum(np.where(is_held, 0.0, SPEED)) / RATE
    flow_per_speed = float(np.mean(EQUATION.left(Signals(channels, RATE)))) * RATE  # [m^3/s] for 1 rad/s
    flow = AREA * SPEED * np.where(is_held, held_flow, 1.0) * (1.0 + 0.01 * rng.standard_normal(t.size))
    limits = RestLimits(pump=1e-3 * AREA * SPEED, piston=1e-3 * SPEED)
    return Signals({**channels, "omega": flow / flow_per_speed}, RATE, rest_limits=limits), AREA * SPEED


@pytest.mark.parametrize("seed", range(4))
def test_a_press_that_a_leak_stalls_holds_its_load_where_healthy_holds_do(seed: int) -> None:
    """Its pump turned while the piston stood, and its flow was taken to circulate in a valve at neutral."""
    rng = np.random.default_rng(seed)
    signals, mean_flow = press(rng.uniform(0.3, 0.9), seed)
    is_held = signals.holding(EQUATION.left) > 0.0
    assert is_held.sum() > 600
    alone = flag_circulation(EQUATION, signals, mean_flow)
    assert alone[is_held].all() and not alone[~is_held].any()
    connected = HoldCounts(connected=int(rng.integers(8, 40)))
    assert not flag_circulation(EQUATION, signals, mean_flow, connected).any()
    neutral = HoldCounts(connected=int(rng.integers(0, 4)), circulating=int(rng.integers(8, 40)))
    assert flag_circulation(EQUATION, signals, mean_flow, neutral)[is_held].all()
    assert HoldCounts.measure(is_held, alone, RATE).circulating == 2
    healthy, _ = press(0.02, seed)
    connections = flag_circulation(EQUATION, healthy, mean_flow)
    assert HoldCounts.measure(is_held, connections, RATE) == HoldCounts(connected=2)


def test_healthy_holds_change_the_odds_of_a_valve_in_neutral_in_their_sense() -> None:
    odds = [HoldCounts(connected=n).log_odds for n in (0, 1, 5, 50)]
    assert odds == sorted(odds, reverse=True)
    assert HoldCounts(circulating=5).log_odds > HoldCounts(circulating=1, connected=1).log_odds > odds[2]


@pytest.mark.parametrize("seed", range(5))
def test_a_leak_that_equalises_the_pressures_lowers_no_load(seed: int) -> None:
    """The piston is as fast as the load was a moment before, and the load has gone."""
    rng = np.random.default_rng(seed)
    t = np.arange(1200) / RATE
    is_pause = t > 2.0
    load = np.where(is_pause, 30e5 * np.exp(-np.maximum(t - 2.0, 0.0) / rng.uniform(0.1, 0.6)), 30e5)
    sinking = np.where(is_pause, rng.uniform(0.1, 0.2) * SPEED * (load / 30e5) ** rng.choice([0.5, 0.75]), 0.0)
    x = np.cumsum(np.where(is_pause, -sinking, SPEED)) / RATE
    pumped = np.where(is_pause, 0.0, AREA * SPEED / RATE)[1:]
    limits = LoweringLimits(pump=1e-3 * AREA * SPEED, creep=0.25 * SPEED, load=30e5, noise=1e-4, time=2.0)
    assert not flag_lowering(pumped, x, load[1:].copy(), RATE, limits).any()
    fast = -np.cumsum(np.full(t.size, SPEED)) / RATE
    assert flag_lowering(pumped, fast, load[1:].copy(), RATE, limits)[is_pause[1:]].mean() > 0.8


@pytest.mark.parametrize("length", [1, 2, 5, 8])
def test_the_largest_value_before_is_that_of_a_window_which_ends_here(length: int) -> None:
    values = np.random.default_rng(length).random(40)
    expected = [values[max(0, k - length + 1) : k + 1].max() for k in range(40)]
    assert largest_before(values, length) == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(6))
def test_a_leak_that_begins_after_the_last_hold_is_within_the_bound(seed: int) -> None:
    """The holds showed none, and the bound was a hundredth of the leak."""
    rng = np.random.default_rng(seed)
    n_blocks, error, onset = 30, 2e-13, 3.0 * rng.integers(12, 20)
    time = 3.0 * np.arange(n_blocks) + 1.5
    leak = rng.uniform(2.0, 6.0) * error
    course = rng.normal(0.0, error, n_blocks) + leak * (time > onset)
    information = Information(time, np.eye(n_blocks) / error**2, course / error**2, level=np.inf)
    pressure = 20e5

    def bound(hold_begin: float) -> float:
        hold = SimpleNamespace(t=np.array([hold_begin, hold_begin + 8.0]))
        chambers = SimpleNamespace(holds=[hold])
        balance = SimpleNamespace(chambers=chambers, mean_pressure=lambda: pressure)
        measured: Any = SimpleNamespace(step=step_test(information), balance=balance)
        return BalanceLeak._bound_after_holds(measured)

    assert leak * pressure < bound(10.0) < 4.0 * leak * pressure
    assert bound(float(time[-1])) == 0.0
