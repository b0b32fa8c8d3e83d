"""The leakage between the chambers, estimated sample by sample from what a controller measures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from sealscope.compiled import law, layout_of, record_of

#: Length of a block [s] over which volumes are balanced.
BLOCK = 0.5
#: Blocks are used where the mean difference of pressure is at least this [Pa].
LEAST_DP = 20e3
#: A pilot-operated valve is shut beyond so many times its pressures to open.
SHUT = 2.0
#: Prior deviations of the compliance and of the area, as shares, and of the conductance [m^3/(s Pa)].
_SD_C, _SD_AREA, _SD_G = 0.3, 0.01, 1e-11
#: Walks of the conductance, as a deviation a block: absolute [m^3/(s Pa)] and as a share of the estimate.
_WALK, _WALK_SHARE = 1e-15, 0.03
#: A block beyond so many deviations is left out; a second one in turn, on the same side, is a leak that opened at once.
_SURPRISE = 4.0
#: Time [s] over which all four signals are averaged alike.
_LAG = 0.01
#: What the observer assumes (`Balance`) and remembers. `begin`, `averaged`: angle, position and both pressures;
#: `state`: conductance, errors of 1/K and of the area, with their covariance `P`.
OBSERVER = layout_of(
    *("D", "area_A", "area_B", "V_A", "V_B", "K", "x_step", "noise", "shut", "rate", "length", "share"),
    *("count", "sum_dp", "low", "high", "forward", "back", "surprised", "used"),
    begin=(4,),
    averaged=(4,),
    state=(3,),
    P=(3, 3),
)


@law
def update_observer(m: Any, theta: float, x: float, p_A: float, p_B: float) -> None:
    """Take a sample into the observer `m` (`OBSERVER`): angle [rad], position [m], pressures [Pa].

    A Kalman filter of the conductance between the chambers, a block of `BLOCK` seconds at a time. Over a block, on the
    side with the higher pressure (the other may be fed by its check valve):
    D dtheta - A dx - (V(x)/K) dp_side - (|p_A - p_B|/K) D dtheta_in = G integral of (p_A - p_B) dt, with signs turned
    for side B; dtheta_in is the pump's turn towards that side, with oil drawn at the other pressure. Besides G
    the filter holds the errors of 1/K and of the area, as shares. Friction and load do not enter.
    """
    sample, mean = (theta, x, p_A, p_B), m.averaged
    if m.count == 0.0:
        for k in range(4):
            mean[k] = m.begin[k] = sample[k]
    before = mean[0]
    for k in range(4):
        mean[k] = mean[k] + m.share * (sample[k] - mean[k])
    dp, turned = mean[2] - mean[3], mean[0] - before
    m.low, m.high = min(m.low, dp), max(m.high, dp)
    m.sum_dp += dp
    m.forward += max(turned, 0.0)
    m.back += max(-turned, 0.0)
    m.count += 1.0
    if m.count > m.length:
        _close(m, m.sum_dp - 0.5 * dp)
        m.count, m.sum_dp, m.low, m.high, m.forward, m.back = 1.0, 0.5 * dp, dp, dp, 0.0, 0.0
        for k in range(4):
            m.begin[k] = mean[k]


@law
def _close(m: Any, total: float) -> None:
    """Take a block into the filter; `total`: sum of p_A - p_B [Pa] over its samples."""
    integral = total / m.rate
    if abs(integral) < LEAST_DP * m.length / m.rate or m.low * m.high <= 0.0:
        return
    if min(abs(m.low), abs(m.high)) < m.shut:
        return
    begin, end, state, P = m.begin, m.averaged, m.state, m.P
    turned, travel = m.D * (end[0] - begin[0]), end[1] - begin[1]
    middle = 0.5 * (end[1] + begin[1])
    if integral > 0.0:
        area_of, intake = m.area_A, m.forward
        V, change = m.V_A + area_of * middle, end[2] - begin[2]
    else:
        area_of, intake = m.area_B, m.back
        V, change = m.V_B - area_of * middle, begin[3] - end[3]
    area = area_of * travel
    pressed = (V * change + m.D * intake * integral * m.rate / m.length) / m.K
    measured = turned - area - pressed
    # a count of the encoder at both ends, the pressures' noise over the average, and what the laws leave out
    noise = (area_of * m.x_step) ** 2 / 6.0 + 0.1 * (V / m.K * m.noise) ** 2
    variance = noise + (0.02 * pressed) ** 2 + (2e-4 * area) ** 2
    row = (integral, pressed, area)
    innovation = measured - (row[0] * state[0] + row[1] * state[1] + row[2] * state[2])
    walk = (_WALK + _WALK_SHARE * abs(state[0])) ** 2
    spread = row[0] * row[0] * walk + variance
    for i in range(3):
        for k in range(3):
            spread += row[i] * P[i, k] * row[k]
    if innovation**2 > _SURPRISE**2 * spread:
        before = m.surprised
        m.surprised = innovation / integral
        if before * m.surprised <= 0.0:
            return
        more = m.surprised**2
        walk, spread = walk + more, spread + row[0] * row[0] * more
    else:
        m.surprised = 0.0
    P[0, 0] += walk
    g_0 = (P[0, 0] * row[0] + P[0, 1] * row[1] + P[0, 2] * row[2]) / spread
    g_1 = (P[1, 0] * row[0] + P[1, 1] * row[1] + P[1, 2] * row[2]) / spread
    g_2 = (P[2, 0] * row[0] + P[2, 1] * row[1] + P[2, 2] * row[2]) / spread
    gain = (g_0, g_1, g_2)
    for i in range(3):
        state[i] += gain[i] * innovation
        for k in range(3):  # P is symmetric: its product with the row is gain times spread
            P[i, k] -= gain[i] * gain[k] * spread
    m.used += 1.0


@law
def conductance(m: Any) -> tuple[float, float, float]:
    """Return the estimated conductance [m^3/(s Pa)], its deviation, and the number of blocks used."""
    return m.state[0], math.sqrt(m.P[0, 0]), m.used


@dataclass(frozen=True)
class Balance:
    """The observer's model: displacement `D` [m^3/rad], areas [m^2], volumes at mid-stroke [m^3], `K` [Pa].

    `x_step` [m]: a count of the encoder; `noise` [Pa]: deviation of a sample of the pressures; `shut` [Pa]: the least
    |p_A - p_B| at which the valve of the side with the higher pressure is shut.
    """

    D: float
    area_A: float
    area_B: float
    V_A: float
    V_B: float
    K: float
    x_step: float
    noise: float
    shut: float = 0.0


def observer_of(balance: Balance, rate: float) -> Any:
    """Make the record (1,) of an observer before its first sample."""
    return record_of(
        OBSERVER,
        balance,
        rate=rate,
        length=max(2, round(BLOCK * rate)),
        share=1.0 - math.exp(-1.0 / (rate * _LAG)),
        low=math.inf,
        high=-math.inf,
        P=np.diag(np.square([_SD_G, _SD_C, _SD_AREA])),
    )
