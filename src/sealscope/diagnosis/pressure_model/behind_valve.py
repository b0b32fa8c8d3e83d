"""The cylinder behind a servo valve: two chambers, each fed and emptied by edges whose flow gives way to its pressure.

A pump's flow is the same in both lines, so that p_A and p_B move against each other; four edges pass what their own
pressure drops ask for, and the chambers are two states. The supply is not recorded: with like edges p_A + p_B = p_s +
p_r, so the slow part of that sum shows it. The chambers' volumes differ as the piston moves off mid-stroke. What the
valve passes at no command is the bias, so that the piston of an open loop creeps.

Source: Merritt, Hydraulic Control Systems, 1967, section 5.2, general valve analysis.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import contracted
from sealscope.parameters import Rig
from sealscope.physics.cylinder import piston_acceleration, pressure_rate
from sealscope.physics.rig import RigNumbers
from sealscope.physics.valve import edge_flow, spool_acceleration, spool_speed
from sealscope.recordings.recording import Array

State = tuple[float, float, float, float, float]
#: |p_A - p_B| as a share of the supply at which the piston does not move, and for how long [s] it must stay there.
STALLED, _STALLED_S = 0.7, 0.02
#: The mean of p_A - p_B over its deviation from which a load stands on the piston: 0.17 at most on 60 sound machines of
#: `bench-valve`, which have none, 20 at least on 30 of `duty-valve`, under 2 kN. Loads between were not looked at.
STANDING = 1.0


def flow_per_volt(rig: Rig) -> float:
    """Return the flow [m^3/(s V)] that a valve's command asks for without a load: Q_N sqrt(p_set/(2 dp_N))/u_N."""
    valve = rig.valve
    return valve.Q_N * math.sqrt(0.5 * rig.supply.p_set / valve.dp_N) / valve.u_N


def supply_of(pressures: Array, m: RigNumbers) -> Array:
    """Return the pressure (n,) between supply and return [Pa], from the slow part of p_A + p_B (n,) [Pa]."""
    return np.maximum(pressures - 2.0 * m.p_return, 0.0)


def stalled(dp: Array, supply: Array, rate: float) -> int | None:
    """Return the first sample from which p_A - p_B (n,) takes nearly all of the supply (n,), None where it never does.

    Then the piston is at an end of its stroke, or a load holds it: no law of its motion describes that.
    """
    held: NDArray[np.bool_] = np.abs(dp) > STALLED * float(np.median(supply))
    length = max(1, int(_STALLED_S * rate))
    runs = np.convolve(held, np.ones(length), "valid") > length - 0.5
    return int(np.argmax(runs)) if np.any(runs) else None


def standing_load(dp: Array) -> float:
    """Return the mean of p_A - p_B (n,) over its deviation; above `STANDING` a load stands on the piston.

    Edges are as wide as the load leaves them, and what they pass under it rises as a leak does: of 139 sound machines
    under 2 kN 12 were called leaks, and 126 were not followed.
    """
    return abs(float(np.mean(dp))) / max(float(np.std(dp)), np.finfo(float).tiny)


@contracted
def _edge_flow(opening: float, drop: float, m: RigNumbers) -> float:
    """Flow [m^3/s] through an edge under `drop` [Pa], which `opening` [m^3/s] opens where it is positive."""
    return edge_flow(drop, opening, 0.0, 1.0, 0.5 * m.p_set, 1.0, m.dp_lam)


@contracted
def rates_behind_a_valve(
    y: State,
    target: float,
    gain: float,
    friction: float,
    past: float,
    stiffness: float,
    aside: float,
    supply: float,
    m: RigNumbers,
) -> State:
    """Return dy/dt of y = (dp, v, opening, its rate, over).

    The opening [m^3/s] is the flow without a load at the rig's supply; `over` [Pa] is what p_A + p_B has beyond supply
    and return. `target` [m^3/s] and `gain` [m^3/(s V)] of the opening; `friction` [N]; `past` [m^3/s]: what leaves
    chamber A by motion and leakage; `stiffness` of the oil [Pa]; `aside`: share of V by which chamber A is larger and B
    smaller; `supply` [Pa]: between supply and return.
    """
    dp, _, opening, opened, over = y
    full = gain * m.u_N
    fastest = full * m.v_max / m.x_max
    into_A = _edge_flow(opening, 0.5 * (supply - over - dp), m) - _edge_flow(-opening, 0.5 * (supply + over + dp), m)
    into_B = _edge_flow(-opening, 0.5 * (supply - over + dp), m) - _edge_flow(opening, 0.5 * (supply + over - dp), m)
    rate_A = pressure_rate(into_A - past, m.V * (1.0 + aside), stiffness)
    rate_B = pressure_rate(into_B + past, m.V * (1.0 - aside), stiffness)
    return (
        rate_A - rate_B,
        piston_acceleration(0.5 * dp, -0.5 * dp, friction, 0.0, 0.0, m.A_A, m.A_A, m.M_eq),
        spool_speed(opened, fastest),
        spool_acceleration(opening, opened, min(max(target, -full), full), m.omega_s, m.zeta_s, fastest),
        rate_A + rate_B,
    )
