"""Smooth drifts of a series, and how much better than any of them a step or a growth explains it.

A series of n blocks is a + b t + walk + noise, walk a random walk plus an integrated random walk (the local level and
the local linear trend of structural time series: Harvey, Forecasting, structural time series models and the Kalman
filter, 1989, ch. 2). Their strengths are unknown: likelihoods, restricted to what a and b leave (REML), are compared
over a grid of them, the scale of the noise being profiled out. All that depends on the time axis alone is computed
once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array

#: Durations of the rise, as a share of the series: at once, and a growth. Slower ones look like drifts that only bend:
#: with 0.3 half of all false alarms on a bench that wanders were such.
RISES = (0.0, 0.1)
#: Time constants of a warm-up, as a share of the series.
_WARM_UPS = (0.03, 0.06, 0.12, 0.25)
#: Periods of a swing, as a share of the series.
_SWINGS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18)
#: Strengths of the walk and of the integrated walk: variance of one block's move over that of one block's noise.
_WALKS = (0.0, 1e-3, 4e-3, 1.6e-2, 6e-2, 0.25, 1.0, 4.0, 20.0, 200.0)
_SLOPES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
_WALKS_BESIDE_SLOPES = (0.0, 1e-2, 0.25)
#: Onsets tried in a block.
_FRACTIONS = 3
#: What else may explain a series: `scores` numbers them so.
RIVALS = ("drift", "warm-up", "pulse", "swing")


@dataclass(frozen=True, eq=False)
class Drift:
    """One strength of drift, ready for use.

    `whiten` (n - p, n) takes out a + b t and the drift's correlation; `steps`, `warm_ups`, `pulses`, `swings` (., n):
    unit vectors of the interventions after that, a swing in two rows; `norms`: lengths of the steps; `weight`: factor
    of the sum of squares that makes likelihoods comparable; `root` (n, n): Cholesky factor of the covariance; `drift`
    (n, n): the part of it that is not noise.
    """

    whiten: Array
    steps: Array
    warm_ups: Array
    pulses: Array
    swings: Array
    norms: Array
    weight: float
    root: Array
    drift: Array


@dataclass(frozen=True, eq=False)
class Posterior:
    """For every drift and intervention (d, k): log likelihood, height of the step, its variance, noise variance."""

    log_l: Array
    size: Array
    variance: Array
    scale: Array


def strengths() -> list[tuple[float, float]]:
    """Strengths of the random walk and of the wandering slope that are tried together."""
    return [(walk, 0.0) for walk in _WALKS] + [(walk, slope) for walk in _WALKS_BESIDE_SLOPES for slope in _SLOPES]


def interventions(t: Array, onsets: Array, rise: float) -> Array:
    """S (k, n): 0 before each onset (k,), 1 after onset + rise, a straight line between; all in blocks.

    A block covers one unit around its t, so that a step at once within a block moves it by the share that remains.
    """
    lead, width = (0.5, 1.0) if rise == 0.0 else (0.0, rise)
    return np.clip((t[None, :] + lead - onsets[:, None]) / width, 0.0, 1.0)


class DriftFamily:
    """All drifts for one time axis (in blocks) and one set of relative deviations."""

    def __init__(self, t: Array, sd: Array, shared: Array) -> None:
        n = t.size
        self.n, self.t = n, t
        self.nulls: dict[tuple[int, bool, int], Array] = {}
        least = max(3, round(0.03 * n))
        starts, rises = [], []
        for share in RISES:
            rise = share * float(t[-1] - t[0])
            if 0.0 < rise < 2.0:
                continue
            begin, end = t[0] - 0.5 + (least if rise == 0 else 1), t[-1] + 0.5 - max(float(least), rise)
            every = 1.0 / _FRACTIONS if rise == 0 else max(1.0, rise / 6.0)
            usable = np.arange(begin, end + 1e-9, every)
            starts.append(usable)
            rises.append(np.full(usable.size, rise))
        self.onsets, self.rises = np.concatenate(starts), np.concatenate(rises)
        shapes = np.concatenate([interventions(t, some, float(r[0])) for some, r in zip(starts, rises, strict=True)])
        u = t - t[0]
        length = u[-1]
        turns = 2.0 * np.pi * u / length
        swings = np.array([[np.sin(turns / share), np.cos(turns / share)] for share in _SWINGS])
        warm = np.array([np.exp(-u / (share * length)) for share in _WARM_UPS])
        fixed = np.stack([np.ones(n), u / length], axis=1)
        relative = sd / np.median(sd)
        some = shared / np.median(sd)
        noise = np.diag(relative**2) + some @ some.T
        low, high = np.minimum.outer(u, u), np.maximum.outer(u, u)
        walk, slope = low, low**2 * (3.0 * high - low) / 6.0
        self.freedom = n - fixed.shape[1]
        self.shapes, self.fixed = shapes, fixed
        self.drifts = [
            self._drift(noise, q1 * walk + q2 * slope, fixed, shapes, warm, swings) for q1, q2 in strengths()
        ]

    def _drift(self, noise: Array, drift: Array, fixed: Array, shapes: Array, warm: Array, swings: Array) -> Drift:
        root = np.linalg.cholesky(noise + drift)
        inverse = np.linalg.inv(root)
        basis, triangle = np.linalg.qr(inverse @ fixed, mode="complete")
        rest = basis[:, fixed.shape[1] :]
        whiten = rest.T @ inverse
        log_det = 2.0 * np.sum(np.log(np.diag(root))) + 2.0 * np.sum(np.log(np.abs(np.diag(triangle))))

        def units(rows: Array) -> tuple[Array, Array]:
            white = whiten @ rows.T
            norms = np.sqrt(np.sum(white**2, axis=0))
            return (white / np.maximum(norms, 1e-12)).T, norms

        steps, norms = units(shapes)
        return Drift(
            whiten,
            steps @ whiten,
            units(warm)[0] @ whiten,
            units(np.eye(self.n))[0] @ whiten,
            np.asarray(
                np.concatenate([np.linalg.qr(whiten @ pair.T)[0].T for pair in swings]) @ whiten, dtype=np.float64
            ),
            np.asarray(norms, dtype=np.float64),
            float(np.exp(log_det / self.freedom)),
            np.asarray(root, dtype=np.float64),
            drift,
        )

    def scores(self, y: Array, sign: int) -> tuple[Array, NDArray[np.intp], NDArray[np.intp]]:
        """Of series y (n, m): the score of every intervention (k, m), the best rival's number (m,) and the drift (m,)
        that fits best without a step."""
        best = np.full((self.onsets.size, y.shape[1]), np.inf)
        rivals = np.full((len(RIVALS), y.shape[1]), np.inf)
        plain = np.zeros(y.shape[1], dtype=np.intp)
        for number, one in enumerate(self.drifts):
            squares = np.sum((one.whiten @ y) ** 2, axis=0)
            moved = one.steps @ y
            if sign:
                moved = np.maximum(sign * moved, 0.0)
            np.minimum(best, one.weight * (squares - moved**2), out=best)
            plain[one.weight * squares < rivals[0]] = number
            gains = (
                0.0,
                np.max((one.warm_ups @ y) ** 2, axis=0),
                np.max((one.pulses @ y) ** 2, axis=0),
                np.max(((one.swings @ y) ** 2).reshape(len(_SWINGS), 2, -1).sum(axis=1), axis=0),
            )
            for row, gain in enumerate(gains):
                np.minimum(rivals[row], one.weight * (squares - gain), out=rivals[row])
        least = np.min(rivals, axis=0)
        tiny = np.finfo(float).tiny
        score = self.freedom * np.log(np.maximum(least, tiny) / np.maximum(best, tiny))
        return np.asarray(score), np.argmin(rivals, axis=0), plain

    def posterior(self, y: Array, sign: int, near: NDArray[np.intp]) -> Posterior:
        """What one series y (n,) says of every drift with every intervention of `near` (k,), the block in which a step
        begins left out: how far it is moved depends on more than when within it the step came."""
        shape = (len(self.drifts), near.size)
        log_l, size, variance, scale = (np.empty(shape) for _ in range(4))
        hit = np.argmin(np.abs(self.t[None, :] - np.floor(self.onsets[near] + 0.5)[:, None]), axis=1)
        for row, one in enumerate(self.drifts):
            target = one.whiten @ y
            squares = float(target @ target)
            rise = one.whiten @ self.shapes[near].T
            spare = one.whiten[:, hit] * (self.rises[near] == 0.0)
            spare /= np.maximum(np.sqrt(np.sum(spare**2, axis=0)), 1e-12)
            outside = target @ spare
            rise -= spare * np.sum(spare * rise, axis=0)
            norms = np.maximum(np.sqrt(np.sum(rise**2, axis=0)), 1e-9)
            moved = (target @ rise) / norms
            rest = np.maximum(squares - outside**2 - moved**2, np.finfo(float).tiny)
            if sign:
                rest = np.where(sign * moved < 0, squares, rest)
            size[row] = moved / norms
            scale[row] = rest / (self.freedom - 2)
            variance[row] = scale[row] / norms**2
            log_l[row] = -0.5 * self.freedom * np.log(one.weight * rest)
        return Posterior(log_l, size, variance, scale)

    def level(self, y: Array, number: int, best: int) -> Array:
        """The smooth drift (n,), its mean and slope included, beside the intervention `best`."""
        one = self.drifts[number]
        columns = np.column_stack([self.fixed, self.shapes[best]])
        white, target = np.linalg.solve(one.root, columns), np.linalg.solve(one.root, y)
        found, *_ = np.linalg.lstsq(white, target, rcond=None)
        rest = np.linalg.solve(one.root.T, target - white @ found)
        return np.asarray(self.fixed @ found[:-1] + one.drift @ rest)
