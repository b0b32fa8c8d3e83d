"""The servo valve: a spool of the second order with a limited speed, and four edges that it opens."""

from __future__ import annotations

import math

from sealscope.compiled import contracted
from sealscope.physics.lanes import select
from sealscope.physics.restrictors import orifice_flow


@contracted
def spool_target(u: float, u_N: float, x_max: float) -> float:
    """Compute the spool's target position x_max u/u_N [m] for the command u [V], limited to its stroke +-x_max."""
    return x_max * min(max(u / u_N, -1.0), 1.0)


@contracted
def spool_speed(v_s: float, v_max: float) -> float:
    """Compute the spool's dx_s/dt [m/s]: its speed state v_s, limited to +-v_max (the rate limit of its drive)."""
    return min(max(v_s, -v_max), v_max)


@contracted
def spool_acceleration(x_s: float, v_s: float, x_d: float, omega_s: float, zeta_s: float, v_max: float) -> float:
    """Compute the spool's dv_s/dt = omega_s^2 (x_d - x_s) - 2 zeta_s omega_s v_s [m/s^2]; 0 if it would pass +-v_max.

    `x_d` [m] target of the spool, `omega_s` [rad/s], `zeta_s` damping ratio, `v_max` [m/s].

    Source: Merritt, Hydraulic Control Systems, 1967, chapter 7: a servo valve as a second-order lag.
    """
    a = omega_s * omega_s * (x_d - x_s) - 2.0 * zeta_s * omega_s * v_s
    at_limit = ((v_s >= v_max) & (a > 0.0)) | ((v_s <= -v_max) & (a < 0.0))
    return select(at_limit, 0.0, a)  # type: ignore[no-any-return]


@contracted
def spool_within_stroke(x_s: float, v_s: float, x_max: float, v_max: float) -> tuple[float, float]:
    """Limit a spool's position [m] to its stroke and its speed [m/s] to +-v_max; at a stop it moves only inwards."""
    v = min(max(v_s, -v_max), v_max)
    v = select(x_s >= x_max, min(v, 0.0), select(x_s <= -x_max, max(v, 0.0), v))
    return min(max(x_s, -x_max), x_max), v


@contracted
def edge_flow(dp: float, travel: float, overlap: float, Q_N: float, dp_N: float, x_max: float, dp_lam: float) -> float:
    """Compute the flow [m^3/s] through a metering edge under `dp` [Pa] with the spool moved `travel` [m] towards open.

    The orifice law (`orifice_flow`) with c = Q_N/sqrt(dp_N) max(travel - overlap, 0)/x_max: the area grows linearly
    beyond the overlap, and an edge without overlap passes `Q_N` at `dp_N` and full stroke. Underlap: overlap < 0.

    Source: Merritt, Hydraulic Control Systems, 1967, section 5.2, general valve analysis.
    """
    c = Q_N / math.sqrt(dp_N) * max(travel - overlap, 0.0) / x_max
    return orifice_flow(dp, c, dp_lam)
