"""The cylinder: chamber volumes, pressure build-up, hard stops at both caps, its load, the piston's acceleration."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sealscope.compiled import contracted, law
from sealscope.physics.lanes import select
from sealscope.units import P_ATM


@law
def volumes_at_middle(c: Any) -> tuple[float, float]:
    """Compute the oil volumes of both sides [m^3] at mid-stroke, chamber and hose.

    `c`: a cylinder, or other numbers with its V, V_rod, V_hose_A and V_hose_B [m^3].
    """
    return c.V + c.V_hose_A, c.V - c.V_rod + c.V_hose_B


@contracted
def chamber_volumes(
    x: float, V_A: float, V_B: float, A_A: float, A_B: float, position_dependent: bool
) -> tuple[float, float]:
    """Compute the oil volumes of both sides [m^3] at piston position x [m] from mid-stroke.

    V_A and V_B at mid-stroke (Table 4.1: V each, and the hoses), or V_A + A_A x and V_B - A_B x.
    """
    if position_dependent:
        return V_A + A_A * x, V_B - A_B * x
    return V_A, V_B


@contracted
def pressure_rate(inflow: float, volume: float, K_oil: float) -> float:
    """Compute dp/dt = K_oil/V (net inflow - volume growth) [Pa/s], eqs. (4.16)-(4.19).

    `inflow` [m^3/s] is already net of both.
    """
    return K_oil / volume * inflow


@contracted
def hard_stop_force(x: float, v: float, L: float, k_stop: float, d_stop: float) -> float:
    """Compute the force [N] of the cap on the piston, against +x at x = +L/2 and against -x at x = -L/2.

    A stiff spring k_stop [N/m] with a damper d_stop [N s/m] that acts in contact only and never pulls.
    """
    side = math.copysign(1.0, x)
    depth = abs(x) - 0.5 * L
    return select(depth > 0.0, -side * max(k_stop * depth + d_stop * (side * v), 0.0), 0.0)  # type: ignore[no-any-return]


@contracted
def load_force(x: float, F_l: float, k_load: float) -> float:
    """Compute the force [N] of the load against +x, a weight and a spring about mid-stroke: F_l + k_load x."""
    return F_l + k_load * x


@contracted
def force_over(s: float, bends: np.ndarray) -> float:
    """Compute the force [N] of a load over a position s [m] or a velocity [m/s], linear between bends.

    a + b s + sum of c_k max(s - s_k, 0). `bends` (n, 2): (a, b), then (s_k, c_k), the change c_k of the slope at s_k.
    """
    force = bends[0, 0] + bends[0, 1] * s
    for k in range(1, bends.shape[0]):
        force = force + bends[k, 1] * max(s - bends[k, 0], 0.0)
    return force  # type: ignore[no-any-return]


@contracted
def piston_acceleration(
    p_A: float, p_B: float, friction: float, load: float, stop: float, A_A: float, A_B: float, M_eq: float
) -> float:
    """Compute the acceleration a = (p_A A_A - p_B A_B - F_f - F_l + F_stop)/M_eq [m/s^2], eq. (4.15) with the caps."""
    return (p_A * A_A - p_B * A_B - friction - load + stop) / M_eq


@contracted
def opposing_force(v: float, A_opp: float, p_opp: float, C_opp: float) -> float:
    """Compute the force [N] against +x of an opposing cylinder, fed at p_opp [Pa] through an orifice: A_opp p.

    p = p_opp + v |v| (A_opp/C_opp)^2, the orifice's law solved for the pressure; it falls no lower than vacuum. The oil
    of that cylinder is taken as stiff (Merritt, Hydraulic Control Systems, 1967, section 3.4, orifice).
    """
    ratio = A_opp / C_opp
    return A_opp * max(p_opp + v * abs(v) * ratio * ratio, -P_ATM)


def mechanical_power(p_A: Any, p_B: Any, v: Any, A_A: float, A_B: float) -> Any:
    """Compute the power [W] of the pressures on the piston: (p_A A_A - p_B A_B) v."""
    return (p_A * A_A - p_B * A_B) * v
