"""Samples of the times in which shut valves hold the load of a cylinder, and the charge pressure of its circuit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import law
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.motion import find_runs
from sealscope.recordings.recording import Array
from sealscope.signals.smoothing import average_over

#: Length of a hold's first reading [s], ratio of the lengths of successive readings, minimum number of readings.
FIRST_READING, GROWTH, MIN_READINGS = 0.05, 1.2, 8
#: Rate [Hz] to which samples are averaged, or up to twice as much; enough for pressures in shut chambers.
MAX_RATE = 100.0
#: Quantile of the lower chamber pressure that counts as charge pressure.
LOWEST = 0.02


@law
def small_difference_factor(difference: Any, resolved: float) -> Any:
    """Compute the factor d^2 / (d^2 + r^2) of a pressure difference d, with the smallest resolved one r [Pa]."""
    return difference**2 / (difference**2 + resolved**2)


@dataclass(frozen=True, eq=False)
class LockedHold:
    """Samples of one hold, in which shut valves hold the load.

    `t`: time [s]; `p_A`, `p_B`: absolute pressures [Pa]; `x`: position [m], (n,) each. `edges` (k + 1,): indices of the
    samples that bound k intervals, whose means are readings. In the first one the valves may still be shutting.
    """

    t: Array
    p_A: Array
    p_B: Array
    x: Array
    edges: NDArray[np.intp]

    def mean(self, values: Array) -> Array:
        """Average `values` (..., n) of n samples over the intervals between `edges`, to k readings, shape (..., k)."""
        return np.asarray(np.add.reduceat(values, self.edges[:-1], axis=-1) / self.sizes)

    @cached_property
    def sizes(self) -> NDArray[np.intp]:
        """Number of samples of each reading, shape (k,)."""
        return np.diff(self.edges)

    @cached_property
    def difference(self) -> Array:
        """Recorded p_A - p_B [Pa] at each sample, shape (n,)."""
        return self.p_A - self.p_B

    @cached_property
    def is_A_loaded(self) -> bool:
        """True if A has the higher pressure in the first interval."""
        settling = slice(self.edges[0], self.edges[1])
        return float(self.p_A[settling].mean()) > float(self.p_B[settling].mean())

    @cached_property
    def last_pressures(self) -> tuple[float, float]:
        """Mean pressures of A and B [Pa] in the last interval."""
        return float(self.p_A[self.edges[-2] :].mean()), float(self.p_B[self.edges[-2] :].mean())

    @cached_property
    def steady_pressures(self) -> Array:
        """Pressures of A and B [Pa], averaged over `held_oil.averaging_time` (`priors.toml`), shape (2, n)."""
        rate = 1.0 / float(np.diff(self.t).mean())
        return average_over(INFERENCE.held_oil.averaging_time, np.array([self.p_A, self.p_B]), rate)

    def steepest_time(self) -> float:
        """Find the start [s] of the window in which p_A - p_B changes most.

        Its length is `held_oil.equalising_time` (`priors.toml`), the time in which a large leak equalises the
        pressures. Every hold is longer.
        """
        n_equalising = int(np.searchsorted(self.t, self.t[0] + INFERENCE.held_oil.equalising_time))  # [samples]
        difference = self.difference
        return float(self.t[np.abs(difference[n_equalising:] - difference[:-n_equalising]).argmax()])


def estimate_hold_offsets(
    last_A: Array | float, last_B: Array | float, offset: Array | float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Estimate the sensor offset of p_A - p_B [Pa] in holds, given the recording's `offset` [Pa].

    If the two sensors differ in gain, the offset of a hold is normal about `offset`, with a standard deviation s of
    `held_oil.gain` (`priors.toml`) times the higher pressure at the end of the hold. The more probable of two cases is
    assumed: a leak has equalised the pressures, and the recorded p_A - p_B at the end is the offset of the hold; or a
    load causes p_A - p_B, equally probable up to the higher pressure, and the offset is `offset`.

    `last_A`, `last_B`: pressures at the end of each hold (`LockedHold.last_pressures`). Returns the offset of the hold,
    ((offset of the hold - `offset`) / s)^2, and True in the first case, each in the joint shape of the arguments.
    """
    pressure, difference = np.maximum(last_A, last_B), np.subtract(last_A, last_B)
    deviation = INFERENCE.held_oil.gain * pressure
    cost = ((difference - offset) / deviation) ** 2
    # log densities of `difference` in the two cases
    is_equalised = -0.5 * cost - np.log(deviation * math.sqrt(2.0 * math.pi)) > -np.log(pressure)
    return np.where(is_equalised, difference, offset), np.where(is_equalised, cost, 0.0), np.asarray(is_equalised)


def find_charge_pressure(lower_pressure: Array, rests: NDArray[np.bool_], rate: float) -> float:
    """Find the pressure [Pa] that check valves maintain in a chamber without load.

    It is the lowest pressure (the quantile `LOWEST` of averaged samples) while the pump rests, but at most the median
    while the pump turns, since a leak may equalise the pressures in every rest. If the pump never rests, it is the
    lowest of all, which may be too low by the drop of check valves through which a moving piston draws oil.
    `lower_pressure` (n,): lower chamber pressure [Pa]; `rests` (n - 1,): flags of the intervals in which the pump
    rests; `rate`: sampling rate [Hz].
    """
    steady_pressure = average_over(INFERENCE.held_oil.averaging_time, lower_pressure, rate)
    if not rests.any():
        return float(np.nanquantile(steady_pressure, LOWEST))
    # the pressure of a sampling interval is that of the sample at its start
    at_rest, turning = steady_pressure[:-1][rests], steady_pressure[:-1][~rests]
    lowest = float(np.nanquantile(at_rest, LOWEST))
    return min(lowest, float(np.nanmedian(turning))) if np.isfinite(turning).any() else lowest


def find_locked_holds(channels: Sequence[Array], rests: NDArray[np.bool_], rate: float) -> list[LockedHold]:
    """Find the holds of a recording, i.e. the rests of the pump during which shut valves hold the load.

    The time in which the valves open is left out, and so are holds that are too short or have missing samples.
    `channels`: time [s], absolute pressures of A and B [Pa], and position [m], (n,) each; `rests` (n - 1,): flags of
    the sampling intervals in which the pump rests; `rate`: sampling rate [Hz]. Neighbouring samples are averaged to a
    rate below 2 `MAX_RATE`.
    """
    prior, holds = INFERENCE.held_oil, list[LockedHold]()
    decimation = max(1, int(rate / MAX_RATE))  # number of samples that are averaged to one
    # samples of the first interval, and samples to omit at the end: those in which the valves open, and those over
    # which the flow was averaged to find the rest
    settling, opening = (
        max(1, round(s * rate)) for s in (prior.shutting_time, prior.shutting_time + INFERENCE.rest.averaging_time)
    )
    for first, n_intervals in find_runs(rests).tolist():
        if n_intervals + 1 < prior.shortest * rate:
            continue
        begin, end = first, first + n_intervals + 1 - opening
        n_samples = (end - begin) // decimation
        t, p_A, p_B, x = (
            values[begin : begin + n_samples * decimation].reshape(n_samples, decimation).mean(axis=1)
            for values in channels
        )
        n_settling = max(1, settling // decimation)
        edges = np.append(0, n_settling + _reading_edges(n_samples - n_settling, FIRST_READING * rate / decimation))
        # one interval of settling, and at least `MIN_READINGS` further ones
        if len(edges) > MIN_READINGS + 1 and np.isfinite([p_A, p_B, x]).all():
            holds.append(LockedHold(t, p_A, p_B, x, edges))
    return holds


def _reading_edges(n_samples: int, width: float) -> NDArray[np.intp]:
    """Divide `n_samples` of a hold into k intervals that lengthen geometrically; return their bounds, shape (k + 1,).

    The first interval has `width` samples (rounded, at least 1), each later one `GROWTH` times as many; the last one
    takes the rest.
    """
    edges = [0]
    while edges[-1] + max(round(width), 1) < n_samples:
        edges.append(edges[-1] + max(round(width), 1))
        width *= GROWTH
    return np.array([*edges[:-1], n_samples])  # the incomplete last interval is joined to the one before
