"""The double-rod cylinder: chamber volumes, pressure build-up, hard stops at both caps, the piston's acceleration."""

from __future__ import annotations

from sealscope.compiled import law


@law
def chamber_volumes(x: float, V: float, A_A: float, A_B: float, position_dependent: bool) -> tuple[float, float]:
    """Oil volumes (V_A, V_B) [m^3] at piston position x [m] from mid-stroke: V on both sides (Table 4.1), or V + A_A
    x and V - A_B x."""
    if position_dependent:
        return V + A_A * x, V - A_B * x
    return V, V


@law
def pressure_rate(inflow: float, volume: float, K_oil: float) -> float:
    """dp/dt [Pa/s] = K_oil/V (net inflow - volume growth), eqs. (4.16)-(4.19); `inflow` [m^3/s] is already net of
    both."""
    return K_oil / volume * inflow


@law
def hard_stop_force(x: float, v: float, L: float, k_stop: float, d_stop: float) -> float:
    """Force [N] of the cap on the piston, against +x at x = +L/2 and against -x at x = -L/2.

    A stiff spring k_stop [N/m] with a damper d_stop [N s/m] that acts in contact only and never pulls.
    """
    if x > 0.5 * L:
        return -max(0.0, k_stop * (x - 0.5 * L) + d_stop * v)
    if x < -0.5 * L:
        return -min(0.0, k_stop * (x + 0.5 * L) + d_stop * v)
    return 0.0


@law
def piston_acceleration(
    p_A: float, p_B: float, friction: float, load: float, stop: float, A_A: float, A_B: float, M_eq: float
) -> float:
    """a [m/s^2] = (p_A A_A - p_B A_B - F_f - F_l + F_stop)/M_eq, eq. (4.15) with the caps."""
    return (p_A * A_A - p_B * A_B - friction - load + stop) / M_eq
