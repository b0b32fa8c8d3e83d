"""The plan of a locked hold against holds simulated afresh, whose chambers leak into each other."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sealscope.campaigns import held
from sealscope.campaigns.held import BEFORE, N_HEALTHY, PlannedHold, has_shut_off, plan_hold
from sealscope.campaigns.smallest import DetectableLeak, PlannedDuty, RecordingPlan
from sealscope.diagnosis.inference.circuit.holds.chambers import HeldChambers
from sealscope.diagnosis.inference.circuit.holds.hold import MAX_RATE, find_locked_holds
from sealscope.diagnosis.inference.circuit.holds.oil import CylinderSides
from sealscope.diagnosis.inference.comparison.levels import held_rise
from sealscope.diagnosis.inference.comparison.recording_sums import RecordingSums
from sealscope.errors import InputError
from sealscope.parameters import Rig, load_rig

LOAD, FLOW, SECONDS, ALLOWED = 2e3, 3e-5, 3.0, 0.01
#: Compressibility of the simulated oil [1/Pa], dead volume over that of the stroke, stiffness of the frame [N/m].
GIVE, DEAD, FRAME = 7e-10, 0.25, 1e9


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("thesis")


@pytest.fixture(scope="module")
def hold(rig: Rig) -> PlannedHold:
    planned = plan_hold(rig, LOAD, FLOW, 1e-14, false_alarm=ALLOWED)
    assert planned.duration == SECONDS and planned.conductance <= 1e-14
    return planned


@cache
def simulate_hold(rig: Rig, hold: PlannedHold, conductance: float, seed: int) -> RecordingSums:
    """Integrate a cylinder against a stiff frame whose chambers A and B pass a conductance into each other."""
    random, cylinder, sensors = np.random.default_rng(1000 + seed), rig.cylinder, rig.sensors
    t = np.arange(round((BEFORE + hold.duration) * MAX_RATE)) / MAX_RATE
    areas = np.array([cylinder.A_A, -cylinder.A_B])
    stiffness = np.outer(areas, areas) / FRAME + np.diag(np.abs(areas) * cylinder.L * (0.5 + DEAD) * GIVE)
    step = np.linalg.inv(stiffness) @ [-1.0, 1.0] * conductance / MAX_RATE
    # each step moves the pressures along `step` and shrinks their difference by the same factor
    steps = np.maximum(np.arange(t.size) - np.count_nonzero(t <= BEFORE) + 1, 0)
    approach = step[1] - step[0]
    passed = hold.difference * (1.0 - (1.0 - approach) ** steps) / approach if conductance else np.zeros(t.size)
    pressures = np.array([[hold.pressure_A], [hold.pressure_B]]) + step[:, None] * passed
    x = areas @ pressures / FRAME
    x += sensors.x.noise * random.standard_normal(t.size) - x[0]
    p_A, p_B = (
        p + np.hypot(sensor.noise, sensors.common_noise) * random.standard_normal(t.size)
        for p, sensor in zip(pressures, (sensors.p_A, sensors.p_B), strict=True)
    )
    sides = CylinderSides(cylinder.A_A, cylinder.A_B, -0.5 * cylinder.L, 0.5 * cylinder.L)
    holds = find_locked_holds((t, p_A, p_B, x), t[1:] >= BEFORE, MAX_RATE)
    chambers = HeldChambers(holds, sides, float(t[0]), float(t[-1]), hold.pressure_B)
    return RecordingSums(np.zeros((1, 1, 1)), FLOW, hold.difference, held=np.array(chambers.leaks))


def count_leaks(rig: Rig, hold: PlannedHold, conductance: float, count: int) -> int:
    found = 0
    for k in range(count):
        first = k * (N_HEALTHY + 1)
        healthy = [simulate_hold(rig, hold, 0.0, first + day) for day in range(N_HEALTHY)]
        rise = held_rise(simulate_hold(rig, hold, conductance, first + N_HEALTHY), healthy)
        found += rise is not None and rise.chance < ALLOWED
    return found


@pytest.mark.slow
def test_a_leak_as_planned_is_found_in_simulated_holds(rig: Rig, hold: PlannedHold) -> None:
    assert count_leaks(rig, hold, 1.5 * hold.conductance, 5) >= 4
    assert count_leaks(rig, hold, 0.2 * hold.conductance, 5) <= 1
    assert count_leaks(rig, hold, 0.0, 8) <= 1


@pytest.mark.slow
def test_a_smaller_leak_takes_a_longer_hold(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held, "_N_DRAWS", 2)
    monkeypatch.setattr(held, "_N_BISECTIONS", 4)
    hold = plan_hold(rig, LOAD, FLOW, 1e-14, false_alarm=ALLOWED)
    assert hold.duration == SECONDS and hold.conductance <= 1e-14
    smaller = plan_hold(rig, LOAD, FLOW, 0.5 * hold.conductance, false_alarm=ALLOWED)
    assert smaller.duration > hold.duration and smaller.conductance < 0.5 * hold.conductance


def test_a_hold_needs_a_load(rig: Rig) -> None:
    with pytest.raises(InputError, match="load > 0 N"):
        plan_hold(rig, 0.0, FLOW)


def test_a_plan_names_the_hold_and_what_it_separates() -> None:
    found = DetectableLeak(PlannedDuty("3 sin(4t)"), 60.0, 1e-14, np.inf, 1e5)
    hold = PlannedHold(10.0, 3.5e6, 4e5, 2e-15)
    plan = RecordingPlan("bench", None, found, found, (found,), 1e5, 0.01, 0.9, hold)
    lines = [line for line in plan.text().splitlines() if "hold" in line or "separates" in line]
    assert "10 s from 3.5 and 0.4 MPa" in lines[0]
    assert "1.2e-05 L/min" in lines[1] and "piston from pump and rod seals" in lines[1]
    assert plan.as_dict()["locked_hold"]["duration_s"] == 10.0
    assert "locked hold" not in plan._replace(hold=None).text()
    useless = plan._replace(hold=hold._replace(conductance=np.inf))
    assert "finds no leak" in useless.text()
    assert useless.as_dict()["locked_hold"]["smallest_leak_lpm"] is None


def test_a_rig_without_valves_in_its_lines_has_no_hold() -> None:
    assert not has_shut_off(load_rig("thesis"))
