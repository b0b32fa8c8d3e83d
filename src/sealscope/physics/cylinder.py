"""The cylinder: chamber volumes, pressure build-up, end stops, loads on the piston, and the piston's acceleration."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sealscope.compiled import contracted, law
from sealscope.physics.lanes import select
from sealscope.units import P_ATM


@law
def mid_stroke_volumes(c: Any) -> tuple[float, float]:
    """Compute the oil volumes [m^3] of sides A and B at mid-stroke, with hoses; `c`: `Rig.cylinder` or `RigValues`."""
    return c.V + c.V_hose_A, c.V - c.V_rod + c.V_hose_B


@contracted
def chamber_volumes(
    x: float, V_A: float, V_B: float, A_A: float, A_B: float, position_dependent: bool
) -> tuple[float, float]:
    """Compute the oil volumes of sides A and B [m^3] at piston position x [m] from mid-stroke.

    They are V_A + A_A x and V_B - A_B x if `position_dependent`, else V_A and V_B (Table 4.1 of the thesis). `V_A`,
    `V_B` [m^3]: volumes at mid-stroke; `A_A`, `A_B` [m^2]: piston areas.
    """
    if position_dependent:
        return V_A + A_A * x, V_B - A_B * x
    return V_A, V_B


@contracted
def pressure_rate(inflow: float, volume: float, K_oil: float) -> float:
    """Compute the rate dp/dt = K_oil/V Q [Pa/s] of the pressure in an oil volume, eqs. (4.16)-(4.19).

    `inflow` Q [m^3/s]: flow in, minus flow out, minus growth of the volume V [m^3]; `K_oil`: bulk modulus [Pa].
    """
    return K_oil / volume * inflow


@contracted
def hard_stop_force(x: float, v: float, L: float, k_stop: float, d_stop: float) -> float:
    """Compute the force [N] that the end stops of the cylinder exert on the piston, positive along +x.

    The stops are at x = +-L/2. Each is a stiff spring `k_stop` [N/m] with a damper `d_stop` [N s/m]. It acts only while
    the piston touches it, and never pulls. `x` [m]: position from mid-stroke; `v` [m/s]: velocity.
    """
    side = math.copysign(1.0, x)  # the nearer stop: +1 at L/2, -1 at -L/2
    depth = abs(x) - 0.5 * L
    force = max(k_stop * depth + d_stop * (side * v), 0.0)
    return select(depth > 0.0, -side * force, 0.0)  # type: ignore[no-any-return]


@contracted
def load_force(x: float, F_l: float, k_load: float) -> float:
    """Compute the load F_l [N] + k_load [N/m] x [m] on the piston against +x, with a spring relaxed at mid-stroke."""
    return F_l + k_load * x


@contracted
def piecewise_linear_force(s: float, breakpoints: np.ndarray) -> float:
    """Compute a load [N] that is a piecewise linear function of a position s [m] or a velocity s [m/s].

    F = a + b s + sum of c_k max(s - s_k, 0). Row 0 of `breakpoints` (n, 2) is (a, b). Each later row k is (s_k, c_k):
    the slope changes by c_k at s_k.
    """
    force = breakpoints[0, 0] + breakpoints[0, 1] * s
    for k in range(1, breakpoints.shape[0]):
        force = force + breakpoints[k, 1] * max(s - breakpoints[k, 0], 0.0)
    return force  # type: ignore[no-any-return]


@contracted
def piston_acceleration(
    p_A: float, p_B: float, friction: float, load: float, stop: float, A_A: float, A_B: float, M_eq: float
) -> float:
    """Compute the piston's acceleration [m/s^2] from the forces on it, eq. (4.15) with end stops added.

    `p_A`, `p_B` [Pa]: chamber pressures; `A_A`, `A_B` [m^2]: piston areas; `friction`, `load` [N]: forces against +x;
    `stop` [N]: force of the end stops along +x; `M_eq` [kg]: moving mass.
    """
    return (p_A * A_A - p_B * A_B - load + stop - friction) / M_eq  # friction, known last, is subtracted last


@contracted
def opposing_force(v: float, A_opp: float, p_opp: float, C_opp: float) -> float:
    """Compute the force A_opp p [N] with which a second cylinder pushes the piston against +x.

    The second cylinder, of piston area `A_opp` [m^2], moves at the piston's velocity `v` [m/s]. It is fed at the
    pressure `p_opp` [Pa] through an orifice of flow coefficient `C_opp` [m^3/(s Pa^0.5)]. For incompressible oil its
    pressure p [Pa gauge] is p_opp + v |v| (A_opp/C_opp)^2, but at least -P_ATM, vacuum.

    Source: Merritt, Hydraulic Control Systems, 1967, section 3.4, orifice.
    """
    drop_coefficient = A_opp / C_opp
    return A_opp * max(p_opp + v * abs(v) * drop_coefficient * drop_coefficient, -P_ATM)


def mechanical_power(p_A: Any, p_B: Any, v: Any, A_A: float, A_B: float) -> Any:
    """Compute the power (p_A A_A - p_B A_B) v [W] of the chamber pressures [Pa] on the piston, velocity `v` [m/s]."""
    return (p_A * A_A - p_B * A_B) * v
