"""Scan for a rise in a series that walks about as much as expected of a healthy machine.

The series g_1..g_n (one estimate of the conductance a block) is taken as level + walk + noise + size S(onset): noise
of the stated relative deviations and unknown scale, a random walk whose variance a block is `walk` times that of the
noise, S the share of a block that lies behind the onset. `walk` is estimated beside every onset (restricted maximum
likelihood), with a log-normal prior (a factor e) around the ratio that is expected of a healthy machine. With this
knowledge a smaller step is found than by `smooth_drift.find_step`, which allows any smooth drift.

The score is the largest t of the size over all onsets, where only a rise counts. The threshold is the quantile of the
same maximum over series drawn from the walk estimated beside the step and, where the caller is `wary`, from the one
estimated without a step too, whichever is higher. It depends on the number of blocks, the expected and the estimated
walk and is interpolated in a table (`tails.null_threshold`). Unequal deviations, which the table does not know, made
the probability 0.6 to 1.9 times the stated one where they were tried (docs/notes/null-tables.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.changepoint.shapes import rises, warm_ups
from sealscope.diagnosis.changepoint.tails import ONSET_CUT, null_chance, null_threshold
from sealscope.errors import InputError
from sealscope.recordings.recording import Array

#: Fewest blocks in which a step can be looked for, and fewest on either side of it.
FEWEST, LEAST = 16, 4
#: Walks tried: variance a block over the noise's.
_WALKS = np.geomspace(1e-3, 100.0, 14)
#: Onsets lie half a block apart, and in the end this share of a block.
_FINE = 0.05
#: A block is not resolved finer than this share of it: its leak need not act in proportion to its share of the block.
_RESOLUTION = 0.25
#: The block of the onset and the next, whose other states still settle, are left out of the size: their weight.
_UNSETTLED = 1e6
#: Time constants of a warm-up, as shares of the series.
_WARM_UPS = (0.03, 0.06, 0.12, 0.25, 0.5)
_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class WalkStep:
    """The best step of a series.

    `chance`: probability of a score as high without a step; `onset`, `onset_interval` (95 %): in blocks from the
    beginning of the first; `size`, `size_sd`: in the unit of the series; `freedom`: degrees of freedom of `size_sd`;
    `scale`: of the noise over the stated deviations; `warms_up`: an exponential approach from the beginning on is
    likelier than the step.
    """

    score: float
    threshold: float
    chance: float
    onset: float
    onset_interval: tuple[float, float]
    size: float
    size_sd: float
    freedom: int
    scale: float
    warms_up: bool

    @property
    def alarm(self) -> bool:
        """Whether the score is over the threshold and no warm-up explains the series better."""
        return self.score > self.threshold and not self.warms_up

    def spread_over(self, merge: int) -> WalkStep:
        """Return the same step, counted in blocks of which `merge` make one of this series."""
        first, last = self.onset_interval
        return replace(self, onset=self.onset * merge, onset_interval=(first * merge, last * merge))


class _Walk:
    """One strength of the walk: `whiten` (n, n) takes out correlation and level."""

    def __init__(self, relative: Array, walk: float) -> None:
        n = relative.size
        number = np.arange(n)
        self.root = np.linalg.cholesky(np.diag(relative**2) + walk * np.minimum.outer(number, number))
        inverse = np.linalg.inv(self.root)
        level = inverse.sum(axis=1)
        length = float(np.linalg.norm(level))
        unit = level / length
        self.whiten = inverse - np.outer(unit, unit @ inverse)
        self.log_det = 2.0 * float(np.log(np.diag(self.root)).sum()) + 2.0 * float(np.log(length))

    def fit(self, y: Array, shapes: Array) -> tuple[Array, Array, Array]:
        """Fit steps `shapes` (k, n) to series y (n, m).

        Returns the moves along each step (k, m), the sum of squares left (k, m), and the steps' lengths (k,).
        """
        white = self.whiten @ shapes.T
        lengths = np.sqrt(np.sum(white**2, axis=0))
        target = self.whiten @ y
        moved = (white / lengths).T @ target
        return moved, np.maximum(np.sum(target**2, axis=0) - moved**2, _TINY), lengths


class WalkScan:
    """All strengths of the walk and all onsets, for blocks of the relative deviations `relative` (n,)."""

    def __init__(self, relative: Array, expected: float) -> None:
        self.n = relative.size
        self.freedom = self.n - 2
        self.onsets = np.arange(LEAST, self.n - LEAST + 0.25, 0.5)
        self.middles: Array = np.arange(self.n, dtype=np.float64) + 0.5
        self.shapes = rises(self.middles, self.onsets)
        self.walks = [_Walk(relative, float(walk)) for walk in _WALKS]
        self.prior = np.log(_WALKS / expected) ** 2

    def scores(self, y: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return for every onset (k, m) of series y (n, m) the t of a rise and the number of the likeliest walk."""
        size = (self.onsets.size, y.shape[1])
        best, t, number = np.full(size, np.inf), np.zeros(size), np.zeros(size, dtype=np.int64)
        for row, walk in enumerate(self.walks):
            moved, rest, lengths = walk.fit(y, self.shapes)
            deviance = self.freedom * np.log(rest) + walk.log_det + 2.0 * np.log(lengths)[:, None] + self.prior[row]
            better = deviance < best
            best = np.where(better, deviance, best)
            t = np.where(better, moved / np.sqrt(rest / self.freedom), t)
            number[better] = row
        return np.maximum(t, 0.0), number

    def deviance(self, y: Array, shapes: Array) -> float:
        """Return the least -2 log likelihood of one series y (n, 1) with any of the shapes (k, n) and any walk."""
        return float(
            min(
                np.min(self.freedom * np.log(walk.fit(y, shapes)[1])) + walk.log_det + self.prior[row]
                for row, walk in enumerate(self.walks)
            )
        )

    def without_step(self, y: Array) -> int:
        """Return the number of the walk that is likeliest for one series y (n, 1) without a step."""
        deviance = [
            (self.n - 1) * np.log(np.sum((walk.whiten @ y) ** 2) + _TINY) + walk.log_det + self.prior[row]
            for row, walk in enumerate(self.walks)
        ]
        return int(np.argmin(deviance))


def find_leak_step(
    g: Array,
    sd: Array,
    false_alarm_probability: float,
    expected_walk: float,
    *,
    wary: bool = False,
) -> WalkStep:
    """Look for a rise in a series g (n,) whose blocks have the deviations sd (n,), of unknown common scale.

    `expected_walk`: variance of a block's walk over that of a block's noise;
    `wary`: the threshold must also hold for the walk that explains the series without a step.

    Raises InputError where there are fewer than 16 blocks or values that are not finite.
    """
    n = g.size
    if n < FEWEST:
        raise InputError(f"a step needs {FEWEST} blocks or more to be found, got {n}")
    if g.shape != sd.shape or not (np.all(np.isfinite(g)) and np.all(np.isfinite(sd)) and np.all(sd > 0)):
        raise InputError("estimates and their deviations must be finite and of one shape, and deviations > 0")
    unit = float(np.median(sd))
    relative = sd / unit
    scan = WalkScan(relative, expected_walk)
    y = g[:, None] / unit
    t, number = (column[:, 0] for column in scan.scores(y))
    best = int(np.argmax(t))
    walk = scan.walks[number[best]]
    rows = (int(number[best]), *([scan.without_step(y)] if wary else []))
    threshold = max(null_threshold("random_walk", false_alarm_probability, n, row, expected_walk) for row in rows)

    fine: Array = np.clip(scan.onsets[best] + np.arange(-0.75, 0.75 + 1e-9, _FINE), 1.0, n - 1.0)
    sharp = scan.freedom * np.log(walk.fit(y, rises(scan.middles, fine))[1][:, 0])
    onset = float(fine[np.argmin(sharp)])
    cut = float(sharp.min()) + ONSET_CUT
    coarse = scan.freedom * np.log(walk.fit(y, scan.shapes)[1][:, 0])
    near = np.concatenate([fine[sharp <= cut], scan.onsets[(coarse <= cut) & (t > 0)]])

    settled = relative.copy()
    settled[int(np.floor(onset)) : int(np.floor(onset)) + 2] *= _UNSETTLED
    warm = warm_ups(scan.middles - 0.5, n, _WARM_UPS)
    warms_up = scan.deviance(y, warm) < scan.deviance(y, rises(scan.middles, fine))
    moved, rest, lengths = _Walk(settled, float(_WALKS[number[best]])).fit(y, rises(scan.middles, np.array([onset])))
    freedom = scan.freedom - 2
    scale = float(np.sqrt(rest[0, 0] / freedom))
    return WalkStep(
        score=float(t[best]),
        threshold=threshold,
        chance=max(null_chance("random_walk", float(t[best]), n, row, expected_walk) for row in rows),
        onset=onset,
        onset_interval=(float(near.min()) - _RESOLUTION, float(near.max()) + _RESOLUTION),
        size=float(moved[0, 0] / lengths[0]) * unit,
        size_sd=scale / float(lengths[0]) * unit,
        freedom=freedom,
        scale=scale,
        warms_up=warms_up,
    )
