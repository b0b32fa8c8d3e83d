"""Scan for a step in the mean of a series of vectors, beyond its scatter and a slow drift.

The series x_1..x_n (blocks) is

    x_i = mean + B b_i + e_i,   b_i - b_{i-1} ~ N(0, I),

scatter e with a covariance S, estimated from the differences of neighbours, which a single step does not inflate, and
random walks b, whose columns B give the drift of each quantity of a healthy machine in a block (`HealthyDrift`; none:
B = 0). For a step of the height h after block k, T2(k) is twice the log likelihood ratio of "the mean changed after k"
against "it did not", by generalised least squares; without drift

    T2(k) = n / (k (n - k)) c_k' S^-1 c_k,   c_k = sum_{i <= k} (x_i - mean)

(Srivastava & Worsley, Likelihood ratio tests for a change in the multivariate normal mean, JASA 81 (1986) 199-204).
Cosines (DCT-II) are the Karhunen-Loeve functions of a random walk whose level is unknown: scatter and walk are
independent from cosine to cosine, with the variance 1 + lambda / (4 sin^2(pi m / 2n)). The denominators are the
eigenvalues of D'D, D the differences of neighbours, so that the scores of all steps solve one tridiagonal system,

    (D D' + lambda I) score = D x,   an even drift's being their mean,

in time and memory linear in n.

The threshold is the quantile of max T2 over random orders of the same blocks with random walks of B added: without an
abrupt change every order is as likely as the one observed. Pairs of neighbours are moved together, so that the short
memory of the blocks (the filters reach from one into the next) stays in the null distribution; longer runs would carry
the very step that is looked for.

A machine may wander more than B says: a step is then the largest of many changes. Beside the best step, the series has
the likelihood of its cosines; which of B, 2 B and 4 B makes it likeliest says how much it wanders (`likeliest`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.changepoint.shapes import least_blocks
from sealscope.diagnosis.changepoint.tails import seed_of, upper_quantile, upper_rank
from sealscope.recordings.recording import Array

#: Directions whose scatter is less than this share of the largest are sums of others.
_RANK = 1e-8
_BATCH = 250
_RUN = 2
#: How many times as much as a healthy one's a series' drift may be.
WANDERS = (1.0, 2.0, 4.0)
#: A larger drift must be likelier by so much of twice the log likelihood, which it is by chance once in seventy times.
_LIKELIER = 6.0


@dataclass(frozen=True, eq=False)
class HealthyDrift:
    """The drift of the columns of a series without the step that is looked for.

    `walks` (f, q): deviation by which each of q independent random walks moves each column in one block; `other` (f,
    c): directions of steps that are not looked for, and fitted beside them.
    """

    walks: Array
    other: Array


@dataclass(frozen=True)
class Scan:
    """Statistics of one series.

    `joint` (n - 1,): T2 for a step after block k = 1..n-1; `single` (n - 1, f): its square root, signed, for each
    column alone: > 0 where the mean rises; `trend`: T2 of an even drift from the first to the last block.
    """

    joint: Array
    single: Array
    trend: float

    def step_wins(self) -> bool:
        """Return whether a step describes the change better than an even drift does."""
        return float(self.joint.max()) > self.trend


class StepScan:
    """The statistics of series of n blocks that scatter and drift as `x` (n, f) does.

    `joint`: the columns that are judged together; `drift`: theirs without a step (default: none), `wander` times as
    large. Columns in which `drift.other` has a share are read beside them. Steps nearer than `least` blocks to an end
    are left out.
    """

    def __init__(
        self,
        x: Array,
        joint: list[int],
        drift: HealthyDrift | None = None,
        *,
        least: int | None = None,
        wander: float = 1.0,
    ) -> None:
        n, f = x.shape
        self.n, self.f, self.x, self.joint, self.wander = n, f, x, joint, wander
        self.drift = HealthyDrift(np.zeros((f, 0)), np.zeros((f, 0))) if drift is None else drift
        if wander != 1.0:
            self.drift = replace(self.drift, walks=wander * self.drift.walks)
        self.least = least_blocks(n) if least is None else least
        self.used = sorted({*joint, *np.flatnonzero(np.any(self.drift.other != 0, axis=1)).tolist()})
        differences = np.diff(x, axis=0)
        scatter = differences.T @ differences / (2.0 * (n - 1))
        walks = self.drift.walks @ self.drift.walks.T
        unit = np.sqrt(np.diag(scatter))
        unit[unit == 0] = 1.0
        m = np.arange(1, n)
        self.walk = np.concatenate([[0.0], 0.25 / np.sin(0.5 * np.pi / n * m) ** 2])
        self.single_strength = np.diag(walks) / unit**2
        self.single_gain = self._gain(self._passed(self.single_strength))
        part = np.ix_(self.used, self.used)
        self.to, self.strength = _independent(scatter[part], walks[part], unit[self.used])
        self.passed = self._passed(self.strength)
        place = [self.used.index(column) for column in joint]
        self.steps = np.concatenate([self.to[place].T, self.to.T @ self.drift.other[self.used]], axis=1)
        self.quadratic = _quadratic(self.steps, self._gain(self.passed), len(joint))
        ramp = _cosines(np.linspace(0.0, 1.0, n)[:, None])
        ramp_gain = np.sum(self.passed * ramp**2, axis=0)
        self.ramp_quadratic = _quadratic(self.steps, ramp_gain[None], len(joint))[0]

    def _passed(self, strength: Array) -> Array:
        """Return the precision (n, j) of each cosine of series whose walks have the variance `strength` (j,) a block.

        In units of the scatter's precision; 0 for the mean, which is unknown.
        """
        passed = 1.0 / (1.0 + self.walk[:, None] * strength)
        passed[0] = 0.0
        return np.asarray(passed)

    def _gain(self, passed: Array) -> Array:
        """Return the information (n - 1, j) on a step after k = 1..n-1.

        The cosines of a step are s_m^2 = 2/n sin^2(pi m k/n) / (4 sin^2(pi m / 2n)), and the sum over passed s^2 is a
        Fourier transform.
        """
        share = passed * self.walk[:, None]
        return np.asarray((share.sum(axis=0) - np.fft.fft(share, axis=0).real[1:]) / self.n)

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return T2 (m, n-1), single (m, n-1, f) and trend T2 (m,) of a stack of series x (m, n, f).

        Each is first brought to the scatter of the series that this scan was made for, so that each is judged by its
        own scatter, as that one is.
        """
        return self._of_differences(np.diff(x, axis=1))

    def _of_differences(self, differences: Array) -> tuple[Array, Array, Array]:
        """Return what a call does, of the differences (m, n-1, f) of neighbours in the series."""
        unit = np.sqrt(0.5 / (self.n - 1) * np.einsum("mkf,mkf->mf", differences, differences))
        unit[unit == 0] = np.inf
        single = _scores(differences, self.single_strength).transpose(1, 2, 0) / unit[:, None]
        single /= np.sqrt(self.single_gain)
        judged = differences[..., self.used] @ self.to
        score = np.tensordot(_scores(judged @ _to_unit_scatter(judged), self.strength), self.steps, axes=(0, 0))
        by_step = score.transpose(1, 0, 2)
        t2 = np.einsum("kmb,kmb->mk", np.matmul(by_step, self.quadratic), by_step)
        for series in (t2, single):
            series[:, : self.least - 1] = 0.0
            series[:, self.n - self.least :] = 0.0
        slope = score.mean(axis=1)
        return t2, single, np.einsum("ma,ab,mb->m", slope, self.ramp_quadratic, slope)

    def observed(self) -> Scan:
        """Return the statistics of x itself."""
        t2, single, trend = self(self.x[None])
        return Scan(t2[0], single[0], float(trend[0]))

    def cost(self) -> float:
        """Return twice the negative log likelihood of x, beside its best step, but for a constant."""
        judged = self.x[:, self.used] @ self.to
        squares = _cosines(judged @ _to_unit_scatter(np.diff(judged, axis=0)[None])[0])[1:] ** 2
        passed = self.passed[1:]
        return float(np.sum(squares * passed - np.log(passed)) - self.observed().joint.max())

    def likeliest(self) -> StepScan:
        """Return the scan with the drift, of `WANDERS` times this one's, under which x is likeliest.

        This one's own where no other is likelier by a margin (`_LIKELIER`).
        """
        own = replace(self.drift, walks=self.drift.walks / self.wander)
        scans = [StepScan(self.x, self.joint, own, least=self.least, wander=wander) for wander in WANDERS]
        return min(scans, key=lambda scan: scan.cost() - _LIKELIER * (scan.wander == self.wander))

    def _orders(self, count: int, random: np.random.Generator) -> Array:
        """Return `count` series as x would be without a step, as the differences (count, n-1, f) of neighbours.

        The blocks of x come in a random order, and walks are added.
        """
        differences = np.diff(self.x[_orders(self.n, count, random)], axis=1)
        walks = self.drift.walks
        if walks.any():
            differences += random.standard_normal((count, self.n, walks.shape[1]))[:, 1:] @ walks.T
        return differences

    def null(self, count: int, *, after: int | None = None) -> tuple[Array, Array, Array]:
        """Return T2 (count,), |single| (count, f) and trend T2 (count,) of `count` series without a step.

        The largest over all steps, or those of a step after the block `after` alone. The seed is that of the series.
        """
        steps = slice(None) if after is None else slice(after - 1, after)
        batches = [
            (t2[:, steps].max(axis=1), np.abs(single[:, steps]).max(axis=1), trend)
            for t2, single, trend in self._nulls(count)
        ]
        joint, alone, trends = zip(*batches, strict=True)
        return np.concatenate(joint), np.concatenate(alone), np.concatenate(trends)

    def _nulls(self, count: int) -> Iterator[tuple[Array, Array, Array]]:
        """Yield the statistics of `count` series without a step, some at a time."""
        random = np.random.default_rng(seed_of(self.x))
        for first in range(0, count, _BATCH):
            yield self._of_differences(self._orders(min(_BATCH, count - first), random))

    def thresholds(self, probability: float, *, after: int | None = None) -> tuple[float, Array, float]:
        """Return what T2, |single| (f,) and trend T2 exceed with `probability` without a step, as `null` has them.

        From so many random orders that at least 20 exceed the threshold: a relative error of its tail under 25 %.
        """
        nulls = self.null(_count(probability), after=after)
        self._joint = nulls[0]
        t2, single, trend = (upper_quantile(null, probability) for null in nulls)
        return float(t2), single, float(trend)

    def alarms(self, probability: float) -> bool:
        """Return whether the largest T2 of x exceeds the threshold of `thresholds`.

        Orders are made until so many exceed it as the threshold cannot: few, where x has no step.
        """
        count, largest = _count(probability), float(self.observed().joint.max())
        exceeding = count - upper_rank(count, probability)
        for t2, *_ in self._nulls(count):
            exceeding -= int(np.count_nonzero(t2.max(axis=1) >= largest))
            if exceeding < 0:
                return False
        return True

    def chance(self, score: float) -> float:
        """Return the probability of a T2 of `score` or more without a step, by the random orders of `thresholds`."""
        return float((1 + np.count_nonzero(self._joint >= score)) / (1 + self._joint.size))


def _count(probability: float) -> int:
    """Return the number of random orders of which 20 exceed the threshold, 999 at least."""
    return max(999, int(np.ceil(20.0 / probability)) - 1)


def _cosines(x: Array) -> Array:
    """Return the orthonormal DCT-II over the second axis from the end."""
    from scipy.fft import dct

    return np.asarray(dct(x, axis=-2, norm="ortho"))


def _scores(differences: Array, strength: Array) -> Array:
    """Return the score (j, m, n-1) of a step after each block, from differences (m, n-1, j) of neighbours.

    It is (D D' + lambda I)^-1 D x, with the walk's variance a block lambda = `strength` (j,), in units of the scatter.
    """
    from scipy.linalg.lapack import dpttrf, dpttrs

    scores = np.array(differences.transpose(2, 0, 1), order="C")
    for own, walk in zip(scores, strength, strict=True):
        diagonal, beside, _ = dpttrf(np.full(own.shape[1], 2.0 + walk), np.full(own.shape[1] - 1, -1.0))
        dpttrs(diagonal, beside, own.T, overwrite_b=True)
    return scores


def _to_unit_scatter(differences: Array) -> Array:
    """Return what turns and stretches each of a stack of series as little as gives it the scatter I: (m, r, r).

    From the differences (m, n-1, r) of neighbours.
    """
    scatter = np.matmul(differences.transpose(0, 2, 1), differences) / (2.0 * differences.shape[1])
    values, vectors = np.linalg.eigh(scatter)
    root = vectors / np.sqrt(np.maximum(values, _RANK))[:, None, :]
    return np.asarray(root @ vectors.transpose(0, 2, 1))


def _independent(scatter: Array, walks: Array, unit: Array) -> tuple[Array, Array]:
    """Diagonalise both covariances at once.

    Returns sums of the columns, as columns of (u, r), that scatter by 1 and walk independently of one another, and the
    variances (r,) of their walks.
    """
    values, vectors = np.linalg.eigh(scatter / np.outer(unit, unit))
    regular = values > _RANK * max(float(values[-1]), np.finfo(float).tiny)
    white = vectors[:, regular] / np.sqrt(values[regular]) / unit[:, None]
    strength, turn = np.linalg.eigh(white.T @ walks @ white)
    return white @ turn, np.maximum(strength, 0.0)


def _quadratic(steps: Array, gain: Array, wanted: int) -> Array:
    """Return the form (k, a, a) that makes T2 of scores.

    The inverse of the information on all heights, less that on those beyond the first `wanted` alone.
    """
    information = np.einsum("ja,kj,jb->kab", steps, gain, steps)
    form = np.linalg.pinv(information, rcond=_RANK, hermitian=True)
    form[:, wanted:, wanted:] -= np.linalg.pinv(information[:, wanted:, wanted:], rcond=_RANK, hermitian=True)
    return np.asarray(form)


def _orders(n: int, count: int, random: np.random.Generator) -> NDArray[np.int64]:
    """Return `count` random orders of n blocks in which neighbours stay together in pairs."""
    starts = np.arange(0, n, _RUN)
    shifts, chosen = np.empty((count, 1), dtype=np.int64), np.empty((count, starts.size), dtype=np.int64)
    for k in range(count):
        shifts[k] = random.integers(n)
        chosen[k] = random.permutation(starts)
    places = (chosen[:, :, None] + np.arange(_RUN)).reshape(count, -1)
    places = places[places < n].reshape(count, n)  # the last run may be a short one
    return np.asarray((places - shifts) % n)
