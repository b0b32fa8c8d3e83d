"""Tails of the largest statistic of a scan, and the interval of the onset at which it is largest."""

from __future__ import annotations

import zlib
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array

#: 95 % of the time the likelihood ratio at the true instant is within this of its maximum: P(2 log LR <= x) = (1 -
#: exp(-x/2))^2 (Eo & Morley, Likelihood-ratio-based confidence sets for the timing of structural breaks, Quantitative
#: Economics 6 (2015) 463-497).
ONSET_CUT = -2.0 * float(np.log(1.0 - np.sqrt(0.95)))
#: Share of plain draws, and tail probabilities of one direction from which the others are drawn, over the probability
#: that the largest statistic shall exceed the threshold with.
_PLAIN = 0.2
_LEVELS = np.array([1.0, 0.3, 0.1, 0.03, 0.01])
_LARGEST_LEVEL = 0.3
#: Beyond the least probability of a table its thresholds grow by so much for each factor e: about twice what weighted
#: draws of `smooth_drift` grow by down to 1e-10 (`benchmarks/null_tables.py beyond`; single draws scatter).
RARER = 1.5


def near_best(profile: Array, scale: float = 1.0) -> NDArray[np.intp]:
    """Return the places of a profile of twice the log likelihood (k,) that 95 % confidence cannot exclude.

    `scale`: variance of the scatter over the stated one.
    """
    return np.flatnonzero(profile >= profile.max() - scale * ONSET_CUT)


def upper_quantile(null: Array, probability: float) -> Array:
    """Return the threshold that a null sample (m, ...) exceeds with `probability`.

    Its order statistic of rank ceil((1 - p)(m + 1)), so that the probability is at most p.
    """
    return np.asarray(np.sort(null, axis=0)[upper_rank(null.shape[0], probability) - 1])


def upper_rank(m: int, probability: float) -> int:
    """Return the rank of the order statistic of a sample of m that is `upper_quantile`, the least being 1."""
    return min(m, int(np.ceil((1.0 - probability) * (m + 1) - 1e-9)))


def seed_of(series: Array) -> int:
    """Return a seed that depends on the order of the values (n, ...) along the first axis alone.

    So each record's threshold has a random error of its own, which repeats and does not depend on the units.
    """
    return zlib.crc32(np.argsort(series, axis=0, kind="stable").astype("<i8").tobytes())


def rare_draws(directions: Array, levels: Array, count: int, seed: int) -> tuple[Array, Array]:
    """Draw standard normal vectors in which the projection on one of some directions is often extreme.

    `directions` (k, r): unit vectors; `levels` (l,): tail probabilities of one projection. Returns vectors z (r, count)
    and weights w (count,), so that the mean of w f(z) is the expectation of f under N(0, I). A fifth of the draws is
    plain; in the others the projection on one direction is drawn from the upper tail of one level, each as often, so
    that

        w = 1 / (s + (1 - s) mean_kl([d_k z > q(level l)] / level l)),   s = 1/5.

    The relative error of a tail probability hardly depends on how small that is. Source: D. Q. Naiman, C. E. Priebe,
    Computing scan statistic p values using importance sampling, J. Computational and Graphical Statistics 10 (2001)
    296-328.
    """
    from scipy.special import ndtri

    random = np.random.default_rng(seed)
    k, r = directions.shape
    z = random.standard_normal((r, count))
    plain = round(_PLAIN * count)
    rest = np.arange(count - plain)
    chosen = directions[((rest + random.random()) * k / rest.size).astype(np.int64) % k].T
    extreme = -ndtri((1.0 - random.random(rest.size)) * levels[random.permutation(rest % levels.size)])
    z[:, plain:] += chosen * (extreme - np.sum(chosen * z[:, plain:], axis=0))
    projections = directions @ z
    ratio = np.zeros(count)
    for level in levels:
        ratio += np.mean(projections > -ndtri(level), axis=0) / (level * levels.size)
    return z, 1.0 / (plain / count + (1.0 - plain / count) * ratio)


def weighted_quantile(values: Array, weights: Array, probability: float) -> float:
    """Return what weighted draws (m,) exceed with `probability`."""
    order = np.argsort(-values)
    tail = np.cumsum(weights[order]) / values.size
    return float(values[order[min(int(np.searchsorted(tail, probability)), values.size - 1)]])


def largest_normal(correlation: Array, probability: float, seed: int, score: float = np.inf) -> tuple[float, float]:
    """Return what the largest of standard normals with this correlation (k, k) exceeds with `probability`.

    And the probability that it exceeds `score`, by the same draws, so that the two agree: 2000 `rare_draws`, by which
    the first probability is right within 4 % (one standard deviation), however small it is; the second one
    is at least a hundredth of it, as far out as they are drawn.
    """
    root = np.asarray(np.linalg.cholesky(correlation + 1e-9 * np.eye(len(correlation))), dtype=np.float64)
    levels = np.asarray(np.minimum(probability * _LEVELS, _LARGEST_LEVEL), dtype=np.float64)
    z, weights = rare_draws(root, levels, 2000, seed)
    largest = (root @ z).max(axis=0)
    chance = float(np.sum(weights[largest >= score])) / largest.size
    return weighted_quantile(largest, weights, probability), float(np.clip(chance, levels.min(), 1.0))


@cache
def _null_table(scan: str) -> tuple[tuple[Array, ...], Array]:
    """Return the axes of a table, positive ones as logarithms, the probabilities last, and its values on their grid."""
    text = (resources.files(__package__) / f"{scan}.csv").read_text(encoding="utf-8").splitlines()
    rows = np.array([[float(value) for value in line.split(",")] for line in text[1:]])
    probabilities = [float(name) for name in text[0].split(",")[1:] if name[0].isdigit()]
    places = rows.shape[1] - len(probabilities)
    axes = [np.unique(column) for column in rows[:, :places].T] + [np.array(probabilities)]
    values = rows[:, places:].reshape([axis.size for axis in axes])
    axes[-1], values = axes[-1][::-1], values[..., ::-1]
    return tuple(np.log(axis) if axis[0] > 0 else axis for axis in axes), values


def null_chance(scan: str, score: float, *place: float) -> float:
    """Return the probability that the largest score of a scan exceeds `score` in series without a step.

    The inverse of `null_threshold` over its table's probabilities; 1 for scores that are exceeded more often than the
    largest of them, and the smallest for all beyond it.
    """
    axis = _null_table(scan)[0][-1]
    values = np.array([null_threshold(scan, float(np.exp(at)), *place) for at in axis])
    if score <= values[-1]:
        return 1.0
    return float(np.exp(np.interp(-score, -values, axis)))


def null_threshold(scan: str, probability: float, *place: float) -> float:
    """Return what the largest score of a scan exceeds with `probability` in series without a step.

    Interpolated in the table `scan`.csv beside this file, which `benchmarks/null_tables.py` makes and whose accuracy
    stands there; rarer ones exceed `RARER` more for each factor e. `place`: what the null distribution depends on, in
    the order of the table's columns.
    """
    axes, values = _null_table(scan)
    beyond = RARER * max(0.0, float(axes[-1][0] - np.log(probability)))
    for axis, wanted in zip(axes, (*place, probability), strict=True):
        at = np.log(wanted) if axis[0] != 0 else wanted
        k = int(np.clip(np.searchsorted(axis, at) - 1, 0, axis.size - 2))
        share = float(np.clip((at - axis[k]) / (axis[k + 1] - axis[k]), 0.0, 1.0))
        values = (1.0 - share) * values[k] + share * values[k + 1]
    return float(values) + beyond
