"""The servo valve: a spool that follows the command as a second-order lag, and the four edges that it opens."""

from __future__ import annotations

import math

from sealscope.compiled import contracted
from sealscope.physics.lanes import select
from sealscope.physics.restrictors import orifice_flow


@contracted
def spool_target(u: float, u_N: float, x_max: float) -> float:
    """Compute the position x_max u/u_N [m] of the spool for a command u [V], limited to the stroke +-x_max."""
    return x_max * min(max(u / u_N, -1.0), 1.0)


@contracted
def spool_acceleration(x_s: float, v_s: float, x_d: float, omega_s: float, zeta_s: float, v_max: float) -> float:
    """Compute the rate dv_s/dt [m/s^2] of the spool's speed, as a second-order lag with a limited speed.

    dv_s/dt = omega_s^2 (x_d - x_s) - 2 zeta_s omega_s v_s with position `x_s` and target position `x_d` [m], speed
    `v_s` [m/s], natural frequency `omega_s` [rad/s] and damping ratio `zeta_s`. It is 0 where the speed would
    leave +-`v_max` [m/s].

    Source: Merritt, Hydraulic Control Systems, 1967, chapter 7: a servo valve as a second-order lag.
    """
    a = omega_s * omega_s * (x_d - x_s) - 2.0 * zeta_s * omega_s * v_s
    at_limit = ((v_s >= v_max) & (a > 0.0)) | ((v_s <= -v_max) & (a < 0.0))
    return select(at_limit, 0.0, a)  # type: ignore[no-any-return]


@contracted
def spool_within_stroke(x_s: float, v_s: float, x_max: float, v_max: float) -> tuple[float, float]:
    """Limit the spool's position `x_s` to its stroke +-`x_max` [m], its speed `v_s` to +-`v_max` [m/s]; return both.

    At an end of the stroke, a speed that points outwards becomes 0.
    """
    v = min(max(v_s, -v_max), v_max)
    v = select(x_s >= x_max, min(v, 0.0), select(x_s <= -x_max, max(v, 0.0), v))
    return min(max(x_s, -x_max), x_max), v


@contracted
def edge_flow(dp: float, travel: float, overlap: float, Q_N: float, dp_N: float, x_max: float, dp_lam: float) -> float:
    """Compute the flow [m^3/s] through one metering edge of the valve under the pressure difference `dp` [Pa].

    `travel`: position [m] of the spool, positive if it opens this edge; `overlap` [m]: travel at which the edge
    opens, < 0 for an underlap. The flow is that of an orifice (`orifice_flow`, laminar below about `dp_lam` [Pa])
    with the coefficient c = Q_N/sqrt(dp_N) max(travel - overlap, 0)/x_max. An edge without overlap passes the rated
    flow `Q_N` [m^3/s] under `dp_N` [Pa] at full stroke `x_max` [m].

    Source: Merritt, Hydraulic Control Systems, 1967, section 5.2, general valve analysis.
    """
    c = Q_N / math.sqrt(dp_N) * max(travel - overlap, 0.0) / x_max
    return orifice_flow(dp, c, dp_lam)
