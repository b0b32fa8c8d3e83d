"""The total leakage: conductances of the states of a pump, each times the pressure of its state."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.estimate.interval import WITHIN_95
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.equations.balances import equations, shut_at_rest
from sealscope.diagnosis.inference.equations.terms import BIAS, HOLDING, LEAK, TURNING
from sealscope.diagnosis.inference.leak_flow import StateLoad, StateLoads, estimate_total_flow
from sealscope.parameters import load_rig

N_BLOCKS, N_ROWS, NOISE = 40, 24, 2e-7
MOTION = "motion out, A carries"


def draw_press(seed: int, onset: int | None = None) -> tuple[Blocks, ColumnRoles, StateLoads, float]:
    """Draw blocks of a press whose valves shut at rest, with the loads of its states and its total leakage [m^3/s].

    `onset`: block in which a leak past the piston begins, None for a leak from the start or none.
    """
    rng = np.random.default_rng(seed)
    equation = shut_at_rest(equations(load_rig("single-rod-eha"), frozenset({"omega", "x", "p_A", "p_B"}))[0])
    roles = ColumnRoles(equation)
    column = roles.names.index
    state = rng.choice(3, (N_BLOCKS, N_ROWS), p=[0.4, 0.4, 0.2])  # resting, moving, holding
    pressure = np.where(state == 1, rng.uniform(5e5, 20e5, state.shape), rng.uniform(60e5, 90e5, state.shape))
    speed = np.where(state == 1, rng.uniform(0.02, 0.1, state.shape), 0.0)
    piston, pump = rng.uniform(0.0, 2e-13), rng.uniform(3e-13, 1e-12)
    leak = piston * np.ones(state.shape) if onset is None else piston * (np.arange(N_BLOCKS) >= onset)[:, None]
    flow = leak * pressure + pump * pressure * (state > 0)
    rows = np.zeros((N_BLOCKS, N_ROWS, roles.left + 1))
    rows[..., column(MOTION)], rows[..., column(LEAK)] = speed, pressure
    rows[..., column(TURNING)], rows[..., column(HOLDING)] = pressure * (state == 1), pressure * (state == 2)
    rows[..., column(BIAS)] = state == 1
    rows[..., roles.left] = 5e-3 * speed + flow + rng.normal(0.0, NOISE, state.shape)
    start = 3.0 * np.arange(N_BLOCKS)
    blocks = Blocks(
        start=start,
        end=start + 3.0,
        gram=np.einsum("kri,krj->kij", rows, rows)[:, None],
        rows=np.full(N_BLOCKS, float(N_ROWS)),
        flow=np.abs(rows[..., roles.left]).mean(axis=1),
        pressures=pressure,
        zero=np.zeros(N_BLOCKS),
    )
    loads = StateLoads(*(StateLoad.measure(pressure.ravel(), state.ravel() == k) for k in range(3)))
    return blocks, roles, loads, float(flow.mean())


@pytest.mark.parametrize("onset", [None, 12])
def test_the_interval_of_a_total_holds_whatever_the_valves_do(onset: int | None) -> None:
    is_after = None if onset is None else np.arange(N_BLOCKS) >= onset
    holds = []
    for seed in range(60):
        blocks, roles, loads, total = draw_press(seed, onset)
        estimate = estimate_total_flow(blocks, roles, loads, is_after)
        holds.append(abs(estimate.value - total) < WITHIN_95 * estimate.deviation)
        assert estimate.deviation < total
    assert np.mean(holds) > 0.9


def test_rests_behind_shut_valves_add_no_leakage_of_the_pump() -> None:
    """One conductance of all states would count the pump's leakage while valves cut it off."""
    blocks, roles, loads, total = draw_press(3)
    everywhere = loads._replace(moving=StateLoad(sum(load.pressure for load in loads), 0.0))
    nowhere = StateLoad(0.0, 0.0)
    as_turning = everywhere._replace(resting=nowhere, holding=nowhere)
    assert estimate_total_flow(blocks, roles, as_turning).value > 1.2 * total
    assert estimate_total_flow(blocks, roles, loads).value == pytest.approx(total, rel=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_loads_of_states_add_up_and_a_constant_pressure_tells_no_law(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pressure = rng.uniform(1e5, 1e7, 500)
    is_counted = rng.random(500) < 0.3
    pressure[rng.random(500) < 0.05] = np.nan
    parts = [StateLoad.measure(pressure, flags) for flags in (is_counted, ~is_counted)]
    assert sum(load.pressure for load in parts) == pytest.approx(np.nanmean(pressure))
    assert all(load.turbulent_excess > 0.0 for load in parts)
    assert StateLoad.measure(np.full(20, 3e6), np.ones(20, dtype=bool)).turbulent_excess == pytest.approx(0.0, abs=1e-9)
    assert StateLoad.measure(pressure, np.zeros(500, dtype=bool)) == (0.0, 0.0)
