"""Sine waves over many times at once, such as a run's command: a polynomial on the processor's vector registers."""

from __future__ import annotations

import math

import numpy as np

from sealscope.compiled import contracted, kernel
from sealscope.physics.lanes import nearest_integer

# pi in three parts, each but the last of 33 bits, so that n times such a part is exact for n < 2^20
_PI_HIGH, _PI_MIDDLE, _PI_LOW = 3.1415926534682512, 1.2154201012607932e-10, 4.044532497591901e-21
#: Coefficients of r^3, r^5, ..., r^19 in Taylor's polynomial, whose remainder for |r| <= pi/2 is below 3e-16.
_SINE = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(1, 10))


@contracted
def _sine(x: float) -> float:
    """Compute sin(x), for |x| up to 3e6 within 1e-15.

    With n the whole number nearest to x/pi and r = x - n pi it is (-1)^n sin(r). Source: W. J. Cody, W. Waite, Software
    Manual for the Elementary Functions, 1980 (reduction by pi in parts).
    """
    n = nearest_integer(x * (1.0 / math.pi))
    r = ((x - n * _PI_HIGH) - n * _PI_MIDDLE) - n * _PI_LOW
    s = r * r
    total = _SINE[-1]
    for k in range(2, 10):
        total = total * s + _SINE[-k]
    half = 0.5 * n
    sign = 1.0 - 4.0 * abs(half - nearest_integer(half))  # 1 for an even n, -1 for an odd one
    return sign * (r + r * (s * total))  # type: ignore[no-any-return]


@kernel
def _fill(t: np.ndarray, amplitude: float, omega: float, phase: float, offset: float, wave: np.ndarray) -> None:
    """Write offset + amplitude sin(omega t + phase) at the times `t` (n,) to `wave` (n,)."""
    for k in range(t.size):
        wave[k] = offset + amplitude * _sine(omega * t[k] + phase)


def sine_wave(t: np.ndarray, amplitude: float, omega: float, phase: float, offset: float) -> np.ndarray:
    """Compute offset + amplitude sin(omega t + phase) at times `t` [s] of any shape; `omega` [rad/s], `phase` [rad]."""
    times = np.ascontiguousarray(t, dtype=np.float64)
    wave = np.empty(np.shape(t))
    _fill(times.reshape(-1), float(amplitude), float(omega), float(phase), float(offset), wave.reshape(-1))
    return wave
