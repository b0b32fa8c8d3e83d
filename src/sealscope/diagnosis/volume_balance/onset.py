"""The instant at which a leak opens, from the samples about it: within one block the blocks do not tell."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.changepoint.smooth_drift import DriftStep
from sealscope.diagnosis.volume_balance.blocks import FLOW, I_AB, THETA, Geometry, balance_channels, volumes
from sealscope.diagnosis.volume_balance.fit import BalanceFit
from sealscope.recordings.recording import Array, Recording

#: Blocks on either side of the onset whose samples are looked at, how many of these at most, and instants tried in a
#: round.
_REACH = 2.0
_SAMPLES = 4096
_INSTANTS = 128
#: Blocks before and after whose mean conductance gives the levels, and fewest of them.
_NEAREST, _FEWEST = 4, 3
#: Twice the log likelihood that the 95 % interval of one number spans.
_SPAN = 3.84
#: Noise is taken for alike over this share of a block at most.
_LONGEST = 0.5
#: What a leak leaves in samples over what is left beside it, where motion goes with the integral of dp.
_LARGER = 4.0
#: A pump stands under this share of its largest flow.
_STANDS = 0.2


def date_step(fit: BalanceFit, step: DriftStep, recording: Recording, geometry: Geometry) -> DriftStep:
    """Return the step with the onset tau that the samples about it show; as it is where they do not, or it grows.

    With the shared coefficients and the levels before and after known, the balance of the samples leaves

        r(t) = a + b t - c dp - rise integral_tau^t dp dt + noise,

    with a share of the angle where the scale is in doubt (`BalanceFit.goes_together`), and tau is where the squares of
    the noise are least. Its interval is that of the likelihood, with so many samples less as the noise's
    autocorrelation shows. A leak through an orifice is dated alike: what its law changes within a stroke is small
    beside what opens.
    """
    seconds = fit.blocks.seconds
    low, high = (bound + side * _REACH * seconds for bound, side in zip(step.onset_interval, (-1, 1), strict=True))
    first, last = np.searchsorted(recording.t, [low + 0.25 / recording.rate, high + 0.25 / recording.rate])
    part = recording.samples(slice(int(first), int(last)))
    rows = {name: np.asarray(part[name], dtype=np.float64)[None] for name in balance_channels(recording)}
    before = fit.g[fit.blocks.t < step.onset - 0.5 * seconds][-_NEAREST:]
    after = fit.g[fit.blocks.t > step.onset + 0.5 * seconds][:_NEAREST]
    if step.rise > 0 or len(part) < fit.blocks.samples or min(before.size, after.size) < _FEWEST:
        return step
    if np.ptp(np.diff(part.t)) * recording.rate > 0.5 or not all(np.isfinite(row).all() for row in rows.values()):
        return step
    columns, dp, _ = volumes(rows, recording.rate, geometry)
    every_nth = -(-len(part) // _SAMPLES)
    sparse, between = slice(None, None, every_nth), every_nth / recording.rate
    t, columns, dp = part.t[sparse], columns[0][:, sparse], dp[0, sparse]
    level = float(before.mean())
    opened = fit.sense * (float(after.mean()) - level) * columns[I_AB]
    left = fit.weights @ columns + fit.sense * level * columns[I_AB]
    unknown = [np.ones(t.size), t - t.mean(), dp - dp.mean()]
    if fit.goes_together:  # the scale is not known either
        unknown.append(columns[THETA] - columns[THETA].mean())
    free, _ = np.linalg.qr(np.column_stack(unknown))

    def noise(at: NDArray[np.signedinteger[Any]]) -> Array:
        values = left + (np.arange(t.size) >= at[:, None]) * (opened - opened[at, None])
        return np.asarray(values - (values @ free) @ free.T)

    margin = round(0.25 * seconds / between)
    every = max(1, (t.size - 2 * margin) // _INSTANTS)
    at = np.arange(margin, t.size - margin, every)
    squares = np.sum(noise(at) ** 2, axis=1)
    best = int(at[np.argmin(squares)])
    if best in (at[0], at[-1]):
        return step
    near = np.arange(best - every, best + every + 1, max(1, every // 16))
    at, squares = np.concatenate([at, near]), np.concatenate([squares, np.sum(noise(near) ** 2, axis=1)])
    best = int(at[np.argmin(squares)])
    span = _SPAN * _alike(noise(np.array([best]))[0], round(_LONGEST * seconds / between))
    fitting = at[squares - squares.min() <= span * squares.min() / t.size]
    first, last = max(0, int(fitting.min()) - every), min(t.size - 1, int(fitting.max()) + every)
    if fit.goes_together:
        # what sensors do in every stroke is no noise that a likelihood knows: the leak must be larger
        if np.sum(noise(np.array([t.size - 1]))[0] ** 2) < _LARGER * squares.min():
            return step
        # without a load a leak that opens at rest shows with the next stroke
        first, last = _with_rests(columns[FLOW], first, last)
    if t[last] - t[first] > step.onset_interval[1] - step.onset_interval[0]:
        return step
    onset = float(t[best])
    return replace(
        step,
        index=int(np.searchsorted(fit.blocks.t, onset)),
        onset=onset,
        onset_interval=(float(t[first]), float(t[last])),
    )


def _with_rests(flow: Array, first: int, last: int) -> tuple[int, int]:
    """Return the samples from first to last, and those before and after at which a pump of this flow (n,) stands."""
    turns = np.abs(flow) > _STANDS * np.max(np.abs(flow))
    before, after = np.flatnonzero(turns[: first + 1]), np.flatnonzero(turns[last:])
    return int(before[-1]) if before.size else 0, last + int(after[0]) if after.size else flow.size - 1


def _alike(noise: Array, longest: int) -> float:
    """Return over how many samples noise is alike: 1 + 2 sum of its autocorrelation up to its first zero."""
    size = 1 << math.ceil(math.log2(2 * noise.size))
    spectrum = np.abs(np.fft.rfft(noise, size)) ** 2
    correlation = np.fft.irfft(spectrum, size)[: max(2, longest)]
    correlation = correlation / max(float(correlation[0]), np.finfo(float).tiny)
    ends = np.flatnonzero(correlation <= 0.0)
    return float(1.0 + 2.0 * np.sum(correlation[1 : ends[0] if ends.size else correlation.size]))
