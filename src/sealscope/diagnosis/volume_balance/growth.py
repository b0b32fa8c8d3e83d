"""Wear within a recording: a conductance that grows slowly, like a drift, but by more than warm oil explains.

Oil that warms passes gaps as 1/viscosity, and viscous friction goes with the viscosity: where the conductance grows
from G_0 to G_1 because the oil becomes thinner, the machine loses F_v (1 - G_0/G_1) of its viscous friction F_v. That
loss is measured from the pressure difference over speed, and tells warm oil from wear.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from sealscope.diagnosis.changepoint.shapes import rises
from sealscope.diagnosis.changepoint.smooth_drift import DriftStep
from sealscope.diagnosis.volume_balance.fit import BalanceFit
from sealscope.recordings.recording import Array

#: What becomes of the oil within a recording, by the friction.
Oil = Literal["thinner", "as thick", "unknown"]
#: A conductance goes with 1/viscosity: oil that warms by 30 K makes it four times what it was (ISO VG 46 from 20 to
#: 50 C: 117 to 30 mm^2/s, ISO 3448 with a viscosity index of 100).
WARMEST = 4.0
#: The loss of viscous friction over that which thinner oil explains the growth by, from which the oil is thinner, and
#: up to which it is not: of 20 bench machines whose oil warms by 15 to 35 K it is 0.34 to 1.27, of 20 whose leak grows
#: as much -0.45 to 0.16 (development).
_THINNER, _AS_THICK = 0.25, 0.15
#: Means over so long take the ringing out of the pressures [s]; speeds under this share of the highest are left out,
#: where the breakaway is; fewest blocks, and the share of them at either end.
_MEAN_SECONDS, _SLOW, _BLOCKS, _EIGHTH = 0.05, 0.2, 9, 0.125
#: Share of the blocks at either end whose mean is the level there, and fewest of them.
_END, _FEWEST = 0.1, 3
#: Relative deviation of a level from what is not modelled, and what a growth must be of its own deviation.
_LEVEL, _SURE = 0.02, 6.0
#: Instants of begin and end that are tried.
_INSTANTS = 48
#: Twice the log likelihood that the 95 % interval of one number spans.
_SPAN = 3.84


def oil_of(fit: BalanceFit, lost: tuple[float, float] | None) -> Oil:
    """Return whether the oil becomes thinner by as much as the conductance grows, stays as it is, or may do either.

    `lost`: the viscous friction that the machine lost (`viscous_loss`) as a share of what it had, and its deviation;
    None where it is not known.
    """
    (start, _), (end, _) = _ends(fit)
    if lost is None or not end > start > 0.0:
        return "unknown"
    share, deviation = (value / (1.0 - start / end) for value in lost)
    if share - 2.0 * deviation > _THINNER:
        return "thinner"
    return "as thick" if share + 2.0 * deviation < _AS_THICK else "unknown"


def viscous_loss(force: Array, speed: Array, rate: float, block: int) -> tuple[float, float] | None:
    """Return by how much the viscous friction [N s/m] falls over a recording, and its deviation; None: too short.

    `force` (n,) of the pressures on the piston [N], its `speed` (n,) [m/s] as the pump gives it, at a `rate` [Hz];
    `block`: samples of whole cycles. In each block the force is fitted by F_v v beside dry friction, mass, spring and a
    constant; compared are the means of the first and the last eighth of the blocks.
    """
    from scipy.ndimage import uniform_filter1d

    width = max(1, round(_MEAN_SECONDS * rate))
    force, speed = uniform_filter1d(force, width), uniform_filter1d(speed - speed.mean(), width)
    force = force * np.sign(np.sum(force * speed))  # friction takes power, whichever way the signals count
    moves = np.abs(speed) > _SLOW * np.abs(speed).max()
    columns = [np.ones(speed.size), np.sign(speed), speed, np.gradient(speed), np.cumsum(speed)]
    rows, at = np.stack([*columns, force], axis=1)[moves], np.flatnonzero(moves) // block
    values = []
    for number in range(speed.size // block):
        here = rows[at == number]
        if len(here) <= 2 * len(columns) or not np.all(np.isfinite(here)):
            continue
        size = np.sqrt(np.mean(here**2, axis=0))
        values.append(np.linalg.lstsq(here[:, :-1] / size[:-1], here[:, -1], rcond=1e-6)[0][2] / size[2])
    if len(values) < _BLOCKS:
        return None
    end = max(_FEWEST, round(_EIGHTH * len(values)))
    scatter = float(np.std(np.diff(values))) / math.sqrt(2.0)
    return float(np.mean(values[:end]) - np.mean(values[-end:])), scatter * math.sqrt(2.0 / end)


def _ends(fit: BalanceFit) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the conductance at the start and at the end, each with its deviation."""
    n = len(fit.blocks)
    width = max(_FEWEST, round(_END * n))
    return _mean(fit, slice(0, width)), _mean(fit, slice(n - width, n))


def grown(fit: BalanceFit, probability: float) -> DriftStep | None:
    """Return the growth of a conductance that ends over `WARMEST` times what it was at the start, None where it is not.

    The score is (end - `WARMEST` start)/deviation, the threshold its normal quantile: with no worn seal the end is at
    most so many times the start. Begin and end of the growth, a straight line between two levels, are those of least
    squares.
    """
    from scipy.special import ndtr, ndtri

    n = len(fit.blocks)
    (start, start_sd), (end, end_sd) = _ends(fit)
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
