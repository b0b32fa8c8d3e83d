"""Did a coefficient step while it was watched? An e-detector over all onsets, beside a random walk of any size.

Each block gives an estimate g_k of the coefficient with a variance V_k. In a healthy machine g has a level that walks:
the innovations e_k of its Kalman filter, of variance kappa S_k with kappa unknown, are Student t given those before. A
step of size delta at block j adds f_k delta to e_k, f the filter's answer to a step, of which block j may have a part
only (`PARTS`). With a = sum f e / S, b = sum f^2 / S, T = sum e^2 / S and n innovations the ratio of the likelihoods,
delta ~ N(0, v kappa) and kappa integrated, is

    R_j = (1 + v b)^(-1/2) (1 - a^2 / ((b + 1/v) T))^(-n/2),

counted where a > 0 only, which makes it smaller. The walk's size q is one of `WALKS`; what was known of it before j is
its prior pi_j, in which each keeps a share, for the walk may change. Both sides average over it,

    M_k = sum_j  sum_q pi_j(q) p_q(e_j..e_k) mean_v R_j  /  sum_q pi_j(q) p_q(e_j..e_k),

an e-detector, whatever level and noise are: E[M at a stopping time] <= E[blocks until then]. An alarm where M > 1/alpha
comes once in 1/alpha blocks of a healthy machine, at most. Fewer onsets only make M smaller: they are thinned with
their age, so that memory is bounded.

Sources: J. Shin, A. Ramdas, A. Rinaldo, arXiv 2203.03532 (e-detectors); A. S. Willsky and H. L. Jones, IEEE
Trans. Automat. Contr. 21 (1976) 108 (step in a filter).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import kernel
from sealscope.diagnosis.priors import priors
from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.storage.plain_state import recall, saved

_PRIORS = priors("live")["step"]
WALKS = np.array(_PRIORS["walks"])[:, None]
SIZES = np.array(_PRIORS["sizes"])
PARTS = np.array(_PRIORS["parts"])
JUMP, MEMORY = priors("live")["coefficients"]["jump"], _PRIORS["memory"]
#: Onsets are all kept for `RECENT` blocks, then `RECENT / 4` of every doubling of age, up to `HORIZON` blocks.
RECENT, HORIZON = _PRIORS["recent"], _PRIORS["horizon"]
#: A block's numbers lie within so many units of the first one, or say nothing.
_FARTHEST = 1e60
#: Least square of an innovation over its variance: samples that repeat leave none, and a noise of zero no logarithm.
_LEAST_SQUARE = 1e-12
#: What is kept of each onset and walk, and of each onset.
_FIELDS = ("answer", "along", "square", "total", "lead")
_PLACES = ("number", "born", "onset", "begin")
_SAVED = tuple(f"_{name}" for name in ("level", "spread", "total", "weight", "widths", "onsets", "places", "unit",
                                       "known", "blocks", "last"))  # fmt: skip


class StepEstimate(NamedTuple):
    """A rise of a coefficient that a `test` shows, by a `score` over a `threshold` for a `reason`.

    `score`: of a step, twice log M; `onset`: value, low and high [s]; `size` and its `deviation`.
    """

    score: float
    onset: tuple[float, float, float]
    size: float
    deviation: float
    test: str = "step"
    threshold: float = np.nan
    reason: str = ""


class StepDetector:
    """An e-detector for a rise of one coefficient, block by block, in bounded memory."""

    def __init__(self) -> None:
        self._unit, self._known, self._blocks = 0.0, 0.0, 0
        self._level, self._spread, self._total, self._widths = (np.zeros(WALKS.shape) for _ in range(4))
        self._weight = np.full(WALKS.shape, -np.log(len(WALKS)))
        self.forget()

    def forget(self) -> None:
        """Compare with no block before now; keep the noise and the walk learned."""
        self._last = -np.inf
        self._onsets = np.zeros((len(_FIELDS), len(WALKS), 0))
        self._places = np.zeros((0, len(_PLACES)))

    def resolves(self, g: float, deviation: float) -> bool:
        """Test whether the squares of a block's numbers, in the unit of the first block, fit into floats."""
        unit = self._unit or deviation
        return unit > 0.0 and abs(g) < _FARTHEST * unit and unit / _FARTHEST < deviation < _FARTHEST * unit

    def take(self, begin: float, end: float, g: float, deviation: float) -> None:
        """Add a block from `begin` to `end` [s]: its estimate `g` and the `deviation` of `g`."""
        self._unit = self._unit or deviation
        g, variance = g / self._unit, (deviation / self._unit) ** 2
        self._blocks += 1
        elapsed, self._last = (begin - self._last) / (end - begin) + 1.0, end
        if not np.isfinite(elapsed):
            self._level[:], self._spread[:] = g, variance
            return
        spread = self._spread + WALKS * max(elapsed, 1.0)
        sigma, error = spread + variance, g - self._level
        square, gain = error**2 / sigma, spread / sigma
        is_warm = self._known >= 4
        if is_warm:
            self._begin_onset(begin, end)
        _follow(self._onsets, self._places, error, sigma, gain, PARTS if is_warm else PARTS[:0])
        self._learn(sigma, square)
        self._level = self._level + gain * error
        self._spread = gain * variance

    def _learn(self, sigma: Array, square: Array) -> None:
        """Learn noise and walk from `square`, that of an innovation over its variance `sigma`."""
        square = np.maximum(square, _LEAST_SQUARE)
        if self._known >= 4:
            square = np.minimum(square, JUMP**2 * self._total / self._known)
            weight = MEMORY * self._weight - 0.5 * np.log(sigma * self._total)
            weight -= 0.5 * (self._known + 1.0) * np.log1p(square / self._total)
            self._weight = weight - np.logaddexp.reduce(weight, axis=0)
        self._total = MEMORY * self._total + square
        self._known = MEMORY * self._known + 1.0
        self._widths = self._widths + np.log(sigma)

    def _begin_onset(self, begin: float, end: float) -> None:
        fresh = np.zeros((len(_FIELDS), len(WALKS), len(PARTS)))
        weight = np.logaddexp(np.log1p(-_PRIORS["changes"]) + self._weight, np.log(_PRIORS["changes"] / len(WALKS)))
        # p_q(e_j..e_k) = lead T_k^(-n/2) prod S^(-1/2) times what is the same for all q
        fresh[3], fresh[4] = self._total, weight + 0.5 * (self._known * np.log(self._total) + self._widths)
        places = np.array([[self._known, self._blocks, end - part * (end - begin), begin] for part in PARTS])
        self._onsets = np.concatenate([self._onsets, fresh], axis=2)
        self._places = np.concatenate([self._places, places])
        if self._blocks % 8 == 0:
            kept = _select_onsets(self._blocks, self._places)
            self._onsets, self._places = self._onsets[:, :, kept], self._places[kept]

    def log_e(self, least: float = -np.inf) -> float:
        """Return log M; minus infinity where it is surely not over `least`."""
        if not len(self._places):
            return -np.inf
        if _most(self._onsets, self._places) + np.log(len(self._places) / len(PARTS)) <= least:
            return -np.inf
        return float(np.logaddexp.reduce(self._terms().ravel()))

    def _healthy(self) -> Array:
        """Return log of the likelihood of each walk and onset while nothing stepped, up to a constant, shape (q, j)."""
        return np.asarray(self._onsets[4] - 0.5 * (self._places[:, 0] * np.log(self._onsets[3]) + self._widths))

    def _terms(self) -> Array:
        """Return log of each part of M, by size, walk and onset, shape (v, q, j)."""
        _, weighted, square, total, _ = self._onsets
        number, widest, healthy = self._places[:, 0], SIZES[:, None, None], self._healthy()
        rising = np.maximum(weighted, 0.0) ** 2 / ((square + 1.0 / widest) * total)
        ratio = -0.5 * (np.log1p(widest * square) + number * np.log1p(-rising))
        prior = np.logaddexp.reduce(healthy, axis=0) + np.log(len(SIZES) * len(PARTS))
        return np.asarray(np.where(weighted > 0.0, ratio, -np.inf) + healthy - prior)

    def rise(self) -> StepEstimate:
        """Estimate the step in the blocks: onset and size, averaged over all walks, onsets and sizes."""
        terms = self._terms()
        log_e = float(np.logaddexp.reduce(terms.ravel()))
        weights = np.exp(terms - log_e)
        _, weighted, square, total, _ = self._onsets
        precision = square + 1.0 / SIZES[:, None, None]
        mean, freedom = weighted / precision, np.maximum(self._places[:, 0] - 2.0, 1.0)
        variance = np.maximum(total - weighted * mean, 0.0) / freedom / precision
        value = float((weights * mean).sum())
        deviation = float(np.sqrt((weights * (variance + (mean - value) ** 2)).sum()))
        shares = weights.sum(axis=(0, 1))  # probability of each onset
        onset, begin = self._places[:, 2:].T
        order = np.argsort(onset, kind="stable")
        low, high = np.searchsorted(np.cumsum(shares[order]), [0.025, 0.975])
        last = order[min(high, len(order) - 1)]
        part = float((onset - begin)[-len(PARTS)]) / len(PARTS)  # a part of a block, about
        interval = float(shares @ onset), float(onset[order[low]]) - part, float(onset[last]) + part
        return StepEstimate(2.0 * log_e, interval, self._unit * value, self._unit * deviation)

    def bound(self, probability: float = 0.95) -> float:
        """Compute the rise exceeded with probability 1 - `probability`, given a rise."""
        from scipy.special import ndtr

        if not len(self._places):
            return np.inf
        _, weighted, square, total, _ = self._onsets
        healthy, size = self._healthy(), weighted / square
        least = np.finfo(float).tiny
        deviation = np.sqrt(np.maximum(total - weighted * size, least) / self._places[:, 0] / square)
        positive = np.maximum(ndtr(size / deviation), 1e-300)
        above = np.exp(healthy - np.logaddexp.reduce(healthy, axis=0)) * positive
        low, high = 0.0, float(np.max(size + 8.0 * deviation))
        for _ in range(50):
            middle = 0.5 * (low + high)
            chance = float((above * ndtr((size - middle) / deviation) / positive).sum())
            low, high = (middle, high) if chance > (1.0 - probability) * above.sum() else (low, middle)
        return self._unit * high

    @property
    def noise(self) -> float:
        """Ratio of the variance of a block's estimate to the stated one, with a walk of a tenth."""
        return float((self._total[3, 0] + _PRIORS["stated"]) / (self._known + _PRIORS["stated"]))

    def state(self) -> dict[str, Any]:
        """Return the state as plain values."""
        return saved(self, _SAVED)

    def recall(self, state: Any) -> None:
        """Continue from a `state` with the same bits; raises InputError where it does not fit."""
        recall(self, _SAVED, state)
        if self._onsets.shape[2] != len(self._places):
            raise InputError(f"saved state's onsets must be {len(self._places)}, got {self._onsets.shape[2]}")


@kernel
def _follow(onsets: Any, places: Any, error: Any, sigma: Any, gain: Any, fresh: Any) -> None:
    """Add innovations (q, 1) and their variances to the sums of all onsets; the last begin with a part."""
    answer, weighted, square, total, _ = onsets
    count, begun = len(places), len(places) - len(fresh)
    for q in range(len(sigma)):
        for j in range(count):
            part = fresh[j - begun] if j >= begun else 1.0 - answer[q, j]
            weighted[q, j] += part / sigma[q, 0] * error[q, 0]
            square[q, j] += part / sigma[q, 0] * part
            total[q, j] += error[q, 0] ** 2 / sigma[q, 0]
            answer[q, j] += gain[q, 0] * part
    for j in range(count):
        places[j, 0] += 1.0


@kernel
def _most(onsets: Any, places: Any) -> float:
    """Return the most that the logarithm of a ratio of likelihoods can be, for any size of a step."""
    _, weighted, square, total, _ = onsets
    most = 0.0
    for q in range(len(weighted)):
        for j in range(len(places)):
            if weighted[q, j] > 0.0:
                rising = min(weighted[q, j] ** 2 / (square[q, j] * total[q, j]), 1.0 - 1e-15)
                most = max(most, -0.5 * places[j, 0] * math.log1p(-rising))
    return most


def _select_onsets(now: int, places: Array) -> NDArray[np.bool_]:
    """Select the onsets to keep: of older blocks fewer and fewer, and at their beginning only."""
    _, born, onset, begin = places.T
    age = now - born
    step = 2.0 ** np.ceil(np.log2(np.maximum(age / RECENT, 1.0))) * 2.0
    return np.asarray((age < RECENT) | ((born % step == 0) & (age < HORIZON) & (onset <= begin)))
