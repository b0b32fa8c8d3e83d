"""Wear within a recording: a conductance that grows slowly, like a drift, but by more than warm oil explains."""

from __future__ import annotations

import math

import numpy as np

from sealscope.diagnosis.changepoint.shapes import rises
from sealscope.diagnosis.changepoint.smooth_drift import DriftStep
from sealscope.diagnosis.volume_balance.fit import BalanceFit

#: A conductance goes with 1/viscosity: oil that warms by 30 K makes it four times what it was (ISO VG 46 from 20 to
#: 50 C: 117 to 30 mm^2/s, ISO 3448 with a viscosity index of 100).
WARMEST = 4.0
#: Share of the blocks at either end whose mean is the level there, and fewest of them.
_END, _FEWEST = 0.1, 3
#: Relative deviation of a level from what is not modelled, and what a growth must be of its own deviation.
_LEVEL, _SURE = 0.02, 6.0
#: Instants of begin and end that are tried.
_INSTANTS = 48
#: Twice the log likelihood that the 95 % interval of one number spans.
_SPAN = 3.84


def grown(fit: BalanceFit, probability: float) -> DriftStep | None:
    """Return the growth of a conductance that ends over `WARMEST` times what it was at the start, None where it is not.

    The score is (end - `WARMEST` start)/deviation, the threshold its normal quantile: with no worn seal the end is at
    most so many times the start. Begin and end of the growth, a straight line between two levels, are those of least
    squares.
    """
    from scipy.special import ndtr, ndtri

    n = len(fit.blocks)
    width = max(_FEWEST, round(_END * n))
    start, start_sd = _mean(fit, slice(0, width))
    end, end_sd = _mean(fit, slice(n - width, n))
    start = max(start, 0.0)
    score = (end - WARMEST * start) / math.hypot(end_sd, WARMEST * start_sd, _LEVEL * end)
    threshold = -float(ndtri(probability))
    if score <= threshold or end - start < _SURE * math.hypot(start_sd, end_sd):
        return None
    t = fit.blocks.t
    instants = np.linspace(t[0], t[-1], _INSTANTS)
    spacing = float(instants[1] - instants[0])
    # all begins of one duration at once
    apart = [steps for steps in range(1, _INSTANTS) if steps * spacing > 2.0 * fit.blocks.seconds]
    pairs = [(begin, begin + steps * spacing) for steps in apart for begin in instants[:-steps]]
    shapes = np.concatenate([rises(t, instants[:-steps], steps * spacing) for steps in apart])
    weight = 1.0 / fit.sd**2
    centred = shapes - (shapes @ weight / weight.sum())[:, None]
    g = fit.g - float(fit.g @ weight / weight.sum())
    size = (centred * weight) @ g / np.maximum((centred**2) @ weight, np.finfo(float).tiny)
    squares = np.sum(weight * (g - size[:, None] * centred) ** 2, axis=1)
    best = int(np.argmin(squares))
    variance = float(squares[best]) / (n - 4)
    begins = np.array([pairs[k][0] for k in np.flatnonzero(squares - squares[best] <= _SPAN * variance)])
    begin, stop = pairs[best]
    return DriftStep(
        score=score,
        threshold=threshold,
        chance=float(ndtr(-score)),
        index=int(np.searchsorted(t, begin)),
        onset=float(begin),
        onset_interval=(float(begins.min()) - spacing, float(begins.max()) + spacing),
        rise=float(stop - begin),
        size=float(size[best]),
        size_sd=math.sqrt(variance / float((centred[best] ** 2) @ weight)),
        freedom=float(n - 4),
        level=np.full(n, float(np.average(fit.g - size[best] * shapes[best], weights=weight))),
        noise=math.sqrt(variance),
    )


def _mean(fit: BalanceFit, blocks: slice) -> tuple[float, float]:
    """Return mean conductance of some blocks and its deviation, with the shared errors."""
    g = fit.g[blocks]
    scatter = max(float(np.std(g, ddof=1)), float(np.median(fit.sd[blocks]))) / math.sqrt(g.size)
    common = fit.shared[blocks].mean(axis=0)
    return float(g.mean()), math.hypot(scatter, float(np.sqrt(common @ common)))
