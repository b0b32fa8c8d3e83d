"""The leakage between the chambers, estimated sample by sample from what a controller measures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from sealscope.compiled import law
from sealscope.recordings.recording import Array

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
#: Places in the observer's block: what it assumes, then what it remembers. From _BEGIN and _AVERAGED on stand angle,
#: position and both pressures; from _G on the three states, from _P on the rows of their covariance.
_D, _AREA_A, _AREA_B, _V_A, _V_B, _K, _X_STEP, _NOISE, _SHUT, _RATE, _LENGTH, _SHARE = range(12)
_COUNT, _SUM_DP, _LOW, _HIGH, _FORWARD, _BACK, _SURPRISED, _USED, _BEGIN, _AVERAGED = *range(12, 21), 24
_G, _P = 28, 31
OBSERVER_BLOCK = _P + 9


@law
def observed(m: Any, theta: float, x: float, p_A: float, p_B: float) -> None:
    """Take a sample into the observer's block `m`: angle [rad], position [m], pressures [Pa]."""
    now = (theta, x, p_A, p_B)
    if m[_COUNT] == 0.0:
        for k in range(4):
            m[_AVERAGED + k] = m[_BEGIN + k] = now[k]
    before = m[_AVERAGED]
    for k in range(4):
        m[_AVERAGED + k] = m[_AVERAGED + k] + m[_SHARE] * (now[k] - m[_AVERAGED + k])
    dp, turned = m[_AVERAGED + 2] - m[_AVERAGED + 3], m[_AVERAGED] - before
    m[_LOW], m[_HIGH] = min(m[_LOW], dp), max(m[_HIGH], dp)
    m[_SUM_DP] += dp
    m[_FORWARD] += max(turned, 0.0)
    m[_BACK] += max(-turned, 0.0)
    m[_COUNT] += 1.0
    if m[_COUNT] > m[_LENGTH]:
        _close(m, m[_SUM_DP] - 0.5 * dp)
        m[_COUNT], m[_SUM_DP], m[_LOW], m[_HIGH], m[_FORWARD], m[_BACK] = 1.0, 0.5 * dp, dp, dp, 0.0, 0.0
        for k in range(4):
            m[_BEGIN + k] = m[_AVERAGED + k]


@law
def _close(m: Any, total: float) -> None:
    """Take a block into the filter; `total`: sum of p_A - p_B [Pa] over its samples."""
    integral = total / m[_RATE]
    if abs(integral) < LEAST_DP * m[_LENGTH] / m[_RATE] or m[_LOW] * m[_HIGH] <= 0.0:
        return
    if min(abs(m[_LOW]), abs(m[_HIGH])) < m[_SHUT]:
        return
    turned, moved = m[_D] * (m[_AVERAGED] - m[_BEGIN]), m[_AVERAGED + 1] - m[_BEGIN + 1]
    middle = 0.5 * (m[_AVERAGED + 1] + m[_BEGIN + 1])
    if integral > 0.0:
        area_of, drawn = m[_AREA_A], m[_FORWARD]
        V, change = m[_V_A] + area_of * middle, m[_AVERAGED + 2] - m[_BEGIN + 2]
    else:
        area_of, drawn = m[_AREA_B], m[_BACK]
        V, change = m[_V_B] - area_of * middle, m[_BEGIN + 3] - m[_AVERAGED + 3]
    area = area_of * moved
    pressed = (V * change + m[_D] * drawn * integral * m[_RATE] / m[_LENGTH]) / m[_K]
    measured = turned - area - pressed
    # a count of the encoder at both ends, the pressures' noise over the average, and what the laws leave out
    noise = (area_of * m[_X_STEP]) ** 2 / 6.0 + 0.1 * (V / m[_K] * m[_NOISE]) ** 2
    variance = noise + (0.02 * pressed) ** 2 + (2e-4 * area) ** 2
    row = (integral, pressed, area)
    innovation = measured - (row[0] * m[_G] + row[1] * m[_G + 1] + row[2] * m[_G + 2])
    walk = (_WALK + _WALK_SHARE * abs(m[_G])) ** 2
    spread = row[0] * row[0] * walk + variance
    for i in range(3):
        for k in range(3):
            spread += row[i] * m[_P + 3 * i + k] * row[k]
    if innovation**2 > _SURPRISE**2 * spread:
        before = m[_SURPRISED]
        m[_SURPRISED] = innovation / integral
        if before * m[_SURPRISED] <= 0.0:
            return
        more = m[_SURPRISED] ** 2
        walk, spread = walk + more, spread + row[0] * row[0] * more
    else:
        m[_SURPRISED] = 0.0
    m[_P] += walk
    g_0 = (m[_P] * row[0] + m[_P + 1] * row[1] + m[_P + 2] * row[2]) / spread
    g_1 = (m[_P + 3] * row[0] + m[_P + 4] * row[1] + m[_P + 5] * row[2]) / spread
    g_2 = (m[_P + 6] * row[0] + m[_P + 7] * row[1] + m[_P + 8] * row[2]) / spread
    gain = (g_0, g_1, g_2)
    for i in range(3):
        m[_G + i] += gain[i] * innovation
        for k in range(3):  # P is symmetric: its product with the row is gain times spread
            m[_P + 3 * i + k] -= gain[i] * gain[k] * spread
    m[_USED] += 1.0


@law
def conductance(m: Any) -> tuple[float, float, float]:
    """Return the estimated conductance [m^3/(s Pa)], its deviation, and how many blocks were used."""
    return m[_G], math.sqrt(m[_P]), m[_USED]


@dataclass(frozen=True)
class Balance:
    """What the observer assumes: displacement `D` [m^3/rad], areas [m^2], volumes at mid-stroke [m^3], `K` [Pa].

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


class LeakObserver:
    """A Kalman filter of the conductance between the chambers, a block of `BLOCK` seconds at a time.

    Over a block, on the side with the higher pressure (the other may be fed by its check valve):
    D dtheta - A dx - (V(x)/K) dp_side - (|p_A - p_B|/K) D dtheta_in = G integral of (p_A - p_B) dt, with signs turned
    for side B; dtheta_in is what the pump turned towards that side, whose oil it draws at the other pressure. Beside G
    the filter holds the errors of 1/K and of the area, as shares. Friction and load do not enter.

    The law is `observed`, compiled.
    """

    def __init__(self, balance: Balance, rate: float) -> None:
        self._block = observer_block(balance, rate)

    def update(self, theta: float, x: float, p_A: float, p_B: float) -> tuple[float, float, float]:
        """Take a sample in: angle [rad], position [m], pressures [Pa]; return the estimate (`conductance`)."""
        observed(self._block, float(theta), float(x), float(p_A), float(p_B))
        return conductance(self._block)  # type: ignore[no-any-return]


def observer_block(balance: Balance, rate: float) -> Array:
    """Return the numbers of an observer that has seen nothing, as `observed` takes them."""
    b, m = balance, np.zeros(OBSERVER_BLOCK)
    m[: _RATE + 1] = b.D, b.area_A, b.area_B, b.V_A, b.V_B, b.K, b.x_step, b.noise, b.shut, rate
    m[_LENGTH], m[_SHARE] = max(2, round(BLOCK * rate)), 1.0 - math.exp(-1.0 / (rate * _LAG))
    m[_LOW], m[_HIGH] = math.inf, -math.inf
    m[_P::4] = np.square([_SD_G, _SD_C, _SD_AREA])
    return m
