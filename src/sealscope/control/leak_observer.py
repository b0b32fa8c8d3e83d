"""The leakage between the chambers, estimated sample by sample from what a controller measures."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

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

    `G` [m^3/(s Pa)] and `sd`, `blocks`: how many were used.
    """

    def __init__(self, balance: Balance, rate: float) -> None:
        self._b, self._rate = balance, rate
        self._length = max(2, round(BLOCK * rate))
        self._state = np.zeros(3)
        self._P = np.diag(np.square([_SD_G, _SD_C, _SD_AREA]))
        self._k, self._sum_dp, self._low, self._high = 0, 0.0, math.inf, -math.inf
        self._share = 1.0 - math.exp(-1.0 / (rate * _LAG))
        self._begin = self._averaged = (0.0, 0.0, 0.0, 0.0)
        self._forward = self._back = self._surprised = 0.0
        self.blocks = 0

    @property
    def G(self) -> float:
        """Estimated conductance [m^3/(s Pa)]."""
        return float(self._state[0])

    @property
    def sd(self) -> float:
        """Deviation of the estimate [m^3/(s Pa)]."""
        return float(math.sqrt(self._P[0, 0]))

    def update(self, theta: float, x: float, p_A: float, p_B: float) -> None:
        """Take a sample in: angle [rad], position [m], pressures [Pa]."""
        now = (theta, x, p_A, p_B)
        if self._k == 0:
            self._averaged = self._begin = now
        before = self._averaged
        theta, x, p_A, p_B = (old + self._share * (new - old) for old, new in zip(before, now, strict=True))
        self._averaged = (theta, x, p_A, p_B)
        dp = p_A - p_B
        self._low, self._high = min(self._low, dp), max(self._high, dp)
        self._sum_dp += dp
        self._forward += max(theta - before[0], 0.0)
        self._back += max(before[0] - theta, 0.0)
        self._k += 1
        if self._k > self._length:
            self._close(self._averaged, self._sum_dp - 0.5 * dp)
            self._k, self._sum_dp, self._low, self._high = 1, 0.5 * dp, dp, dp
            self._begin = self._averaged
            self._forward = self._back = 0.0

    def _close(self, end: tuple[float, float, float, float], total: float) -> None:
        b, begin = self._b, self._begin
        integral = total / self._rate
        if abs(integral) < LEAST_DP * self._length / self._rate or self._low * self._high <= 0.0:
            return
        if min(abs(self._low), abs(self._high)) < b.shut:
            return
        turned, moved = b.D * (end[0] - begin[0]), end[1] - begin[1]
        middle = 0.5 * (end[1] + begin[1])
        if integral > 0.0:
            area, V, change, drawn = b.area_A * moved, b.V_A + b.area_A * middle, end[2] - begin[2], self._forward
        else:
            area, V, change, drawn = b.area_B * moved, b.V_B - b.area_B * middle, begin[3] - end[3], self._back
        pressed = (V * change + b.D * drawn * integral * self._rate / self._length) / b.K
        measured = turned - area - pressed
        row = np.array([integral, pressed, area])
        # a count of the encoder at both ends, the pressures' noise over the average, and what the laws leave out
        area_of = b.area_A if integral > 0.0 else b.area_B
        noise = (area_of * b.x_step) ** 2 / 6.0 + 0.1 * (V / b.K * b.noise) ** 2
        variance = noise + (0.02 * pressed) ** 2 + (2e-4 * area) ** 2
        innovation = measured - float(row @ self._state)
        walk = _WALK + _WALK_SHARE * abs(self._state[0])
        P = self._P + np.diag([walk**2, 0.0, 0.0])
        spread = float(row @ P @ row) + variance
        if innovation**2 > _SURPRISE**2 * spread:
            before, self._surprised = self._surprised, innovation / integral
            if before * self._surprised <= 0.0:
                return
            P[0, 0] += self._surprised**2
            spread = float(row @ P @ row) + variance
        else:
            self._surprised = 0.0
        gain = P @ row / spread
        self._state = self._state + gain * innovation
        self._P = P - np.outer(gain, row @ P)
        self.blocks += 1
