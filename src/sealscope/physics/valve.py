"""The servo valve: a spool of the second order with a limited speed, and four edges that it opens."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import contracted
from sealscope.physics.lanes import select
from sealscope.physics.restrictors import orifice_flow

if TYPE_CHECKING:
    from sealscope.parameters.valve import ServoValve


@contracted
def spool_target(u: float, u_N: float, x_max: float) -> float:
    """Position [m] that the command u [V] asks of the spool: x_max u/u_N, within its stroke +-x_max."""
    return x_max * min(max(u / u_N, -1.0), 1.0)


@contracted
def spool_speed(v_s: float, v_max: float) -> float:
    """dx_s/dt [m/s]: the spool's speed, held within +-v_max (the rate limit of its drive)."""
    return min(max(v_s, -v_max), v_max)


@contracted
def spool_acceleration(x_s: float, v_s: float, x_d: float, omega_s: float, zeta_s: float, v_max: float) -> float:
    """dv_s/dt [m/s^2] = omega_s^2 (x_d - x_s) - 2 zeta_s omega_s v_s; the drive lets the speed grow no further.

    `x_d` [m] target of the spool, `omega_s` [rad/s], `zeta_s` damping ratio, `v_max` [m/s].

    Source: Merritt, Hydraulic Control Systems, 1967, chapter 7: a servo valve as a second-order lag.
    """
    a = omega_s * omega_s * (x_d - x_s) - 2.0 * zeta_s * omega_s * v_s
    held = ((v_s >= v_max) & (a > 0.0)) | ((v_s <= -v_max) & (a < 0.0))
    return select(held, 0.0, a)  # type: ignore[no-any-return]


@contracted
def spool_within_stroke(x_s: float, v_s: float, x_max: float, v_max: float) -> tuple[float, float]:
    """Return position [m] and speed [m/s] of a spool that its stroke and its drive hold; at its stop it stands."""
    v = min(max(v_s, -v_max), v_max)
    v = select(x_s >= x_max, min(v, 0.0), select(x_s <= -x_max, max(v, 0.0), v))
    return min(max(x_s, -x_max), x_max), v


@contracted
def edge_flow(dp: float, way: float, overlap: float, Q_N: float, dp_N: float, x_max: float, dp_lam: float) -> float:
    """Flow [m^3/s] through an edge under `dp` [Pa], with the spool moved `way` [m] to where it opens.

    c = Q_N/sqrt(dp_N) max(way - overlap, 0)/x_max in the orifice law (`orifice_flow`): the area grows evenly beyond
    the overlap, and an edge without one passes `Q_N` at `dp_N` and full stroke. An underlap is an overlap < 0.

    Source: Merritt, Hydraulic Control Systems, 1967, section 5.2, general valve analysis.
    """
    c = Q_N / math.sqrt(dp_N) * max(way - overlap, 0.0) / x_max
    return orifice_flow(dp, c, dp_lam)


def spool_series(u: NDArray[np.float64], valve: ServoValve, rate: float, parts: int) -> NDArray[np.float64]:
    """Return the spool's place [m] in the middles of `parts` parts of each sample, (parts (n - 1),), from rest.

    The command u (n,) [V] is held from sample to sample at `rate` [Hz], and the spool is the lag of the second order of
    `spool_acceleration`, exact between the parts; its limit of speed is left out.
    """
    from scipy.signal import cont2discrete, lfilter

    target = valve.x_max * np.clip(u / valve.u_N, -1.0, 1.0)
    lag = (np.array([valve.omega_s**2]), np.array([1.0, 2.0 * valve.zeta_s * valve.omega_s, valve.omega_s**2]))
    numerator, denominator, _ = cont2discrete(lag, 1.0 / (rate * parts))
    place = lfilter(numerator.ravel(), denominator, np.repeat(target, parts))
    middles = 0.5 * (place[1:] + place[:-1])[: (u.size - 1) * parts]
    return np.asarray(np.clip(middles, -valve.x_max, valve.x_max))
