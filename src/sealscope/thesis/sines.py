"""Fit sines of known frequencies to a signal by least squares."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array


class SineFit(NamedTuple):
    """Result of `sine_fit`: complex amplitudes of the sines, linear trend, and residual.

    `amplitudes` (k,): a_k of Re(a_k exp(i omega_k t)), one for each sine; `slope` [unit of the signal/s]; `residual`
    (n,): the signal minus constant, trend and sines.
    """

    amplitudes: NDArray[np.complex128]
    slope: float
    residual: Array


def sine_fit(t: Array, values: Array, *omegas: float) -> SineFit:
    """Fit a constant, a linear trend and sines of known frequencies to a signal by least squares.

    ``values = c + slope t + sum Re(a_k exp(i omega_k t)) + residual``, with `values` (n,) at the times `t` (n,) [s]
    and the angular frequencies `omegas` [rad/s].
    """
    phases = np.outer(t, omegas)
    # the time is centred, which makes the fit more accurate and does not change the slope
    basis = np.column_stack([np.ones(t.size), t - t.mean(), np.cos(phases), np.sin(phases)])
    fitted = np.linalg.lstsq(basis, values, rcond=None)[0]
    cosines, sines = np.split(fitted[2:], 2)
    # Re((c - i s) exp(i omega t)) = c cos(omega t) + s sin(omega t)
    return SineFit(cosines - 1j * sines, slope=float(fitted[1]), residual=values - basis @ fitted)
