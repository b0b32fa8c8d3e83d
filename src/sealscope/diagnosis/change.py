"""Has the mean of a series of vectors changed, and when? A scan over every instant, and what the scan gives when
nothing has changed.

The series x_1..x_n (blocks) has a covariance S, estimated from the differences of neighbours, which a single step
does not inflate. For a step after block k,

    T2(k) = n / (k (n - k)) c_k' S^-1 c_k,   c_k = sum_{i <= k} (x_i - mean)

is twice the log likelihood ratio of "the mean changed after k" against "it did not" (Srivastava & Worsley, Likelihood
ratio tests for a change in the multivariate normal mean, JASA 81 (1986) 199-204). The threshold is the quantile of
max T2 over random orders of the same blocks: without a change every order is as likely as the one observed. Pairs of
neighbours are moved together, so that the short memory of the blocks (the filters reach from one into the next) stays
in the null distribution; longer runs would carry the very step that is looked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sealscope.recordings.recording import Array

#: 95 % of the time the likelihood ratio at the true instant is within this of its maximum: P(2 log LR <= x) = (1 -
#: exp(-x/2))^2 (Eo & Morley, Likelihood-ratio-based confidence sets for the timing of structural breaks, Quantitative
#: Economics 6 (2015) 463-497).
ONSET_CUT = -2.0 * np.log(1.0 - np.sqrt(0.95))
_BATCH = 250
_RUN = 2


@dataclass(frozen=True)
class Scan:
    """`joint`: (n - 1,) T2 for a step after block k = 1..n-1; `single`: (n - 1, f) its square root, signed, for each
    column alone: > 0 where the mean rises; `trend`: T2 of an even drift from the first to the last block."""

    joint: Array
    single: Array
    trend: float

    def step_wins(self) -> bool:
        """Whether a step describes the change better than an even drift does."""
        return float(self.joint.max()) > self.trend


def _statistics(x: np.ndarray, joint: list[int], least: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T2 (m, n-1), single (m, n-1, f) and trend T2 (m,) of a stack of series x (m, n, f); steps nearer than `least`
    blocks to an end are left out."""
    _, n, _ = x.shape
    centred = x - x.mean(axis=1, keepdims=True)
    differences = np.diff(x, axis=1)
    covariance = np.einsum("mni,mnj->mij", differences, differences) / (2.0 * (n - 1))
    sums = np.cumsum(centred, axis=1)[:, :-1]
    k = np.arange(1, n)
    weight = n / (k * (n - k))
    weight[: least - 1] = 0.0
    weight[n - least :] = 0.0
    deviation = np.sqrt(np.einsum("mii->mi", covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        single = np.nan_to_num(-sums / deviation[:, None, :] * np.sqrt(weight)[:, None])
    inverse = np.linalg.pinv(covariance[:, joint][:, :, joint], rcond=1e-8, hermitian=True)
    chosen = sums[..., joint]
    t2 = np.einsum("mkj,mkj->mk", chosen @ inverse, chosen) * weight
    time = np.arange(n) - (n - 1) / 2.0
    slope = np.einsum("n,mnj->mj", time, centred[..., joint])
    trend = np.einsum("mi,mij,mj->m", slope, inverse, slope) / np.sum(time**2)
    return t2, single, trend


def least_blocks(n: int) -> int:
    """Fewest blocks on either side of a step."""
    return max(3, round(0.03 * n))


def scan(x: Array, joint: list[int]) -> Scan:
    """Scan a series x (n, f) for a step; `joint`: the columns that are judged together."""
    t2, single, trend = _statistics(x[None], joint, least_blocks(len(x)))
    return Scan(t2[0], single[0], float(trend[0]))


def _orders(n: int, count: int, random: np.random.Generator) -> np.ndarray:
    """`count` random orders of n blocks in which neighbours stay together in pairs."""
    starts = np.arange(0, n, _RUN)
    orders = np.empty((count, n), dtype=np.int64)
    for row in orders:
        shifted = np.roll(np.arange(n), int(random.integers(n)))
        row[:] = np.concatenate([shifted[start : start + _RUN] for start in random.permutation(starts)])
    return orders


def permutations_for(false_alarm_probability: float) -> int:
    """Number of random orders: at least 20 beyond the quantile, so that its own relative error is under 25 %."""
    return max(999, int(np.ceil(20.0 / false_alarm_probability)) - 1)


def null_maxima(x: Array, joint: list[int], count: int, seed: int = 0) -> tuple[Array, Array]:
    """Largest T2 (count,) and largest |single| (count, f) of `count` random orders of the blocks x (n, f)."""
    random = np.random.default_rng(seed)
    t2_max, single_max = np.empty(count), np.empty((count, x.shape[1]))
    least = least_blocks(len(x))
    for first in range(0, count, _BATCH):
        orders = _orders(len(x), min(_BATCH, count - first), random)
        t2, single, _ = _statistics(x[orders], joint, least)
        t2_max[first : first + len(orders)] = t2.max(axis=1)
        single_max[first : first + len(orders)] = np.abs(single).max(axis=1)
    return t2_max, single_max


def upper_quantile(null: Array, probability: float) -> Array:
    """Threshold that a null sample (m, ...) exceeds with `probability`: its order statistic of rank ceil((1 - p)(m +
    1)), so that the rate is at most p."""
    m = null.shape[0]
    rank = min(m, int(np.ceil((1.0 - probability) * (m + 1) - 1e-9)))
    return np.asarray(np.sort(null, axis=0)[rank - 1])


def two_samples(x: Array, split: int, joint: list[int], count: int, seed: int = 0) -> tuple[float, Array, Array, Array]:
    """T2 and single statistics for a step after block `split` alone, and their null samples over random orders: (t2,
    single (f,), t2 null, |single| null)."""
    random = np.random.default_rng(seed)
    t2, single, _ = _statistics(x[None], joint, 1)
    t2_null, single_null = np.empty(count), np.empty((count, x.shape[1]))
    for first in range(0, count, _BATCH):
        orders = _orders(len(x), min(_BATCH, count - first), random)
        some_t2, some_single, _ = _statistics(x[orders], joint, 1)
        t2_null[first : first + len(orders)] = some_t2[:, split - 1]
        single_null[first : first + len(orders)] = np.abs(some_single[:, split - 1])
    return float(t2[0, split - 1]), single[0, split - 1], t2_null, single_null


def onset_interval(joint: Array) -> tuple[int, int]:
    """First and last step (number of blocks before it) that 95 % confidence cannot tell from the best one."""
    near = np.flatnonzero(joint >= joint.max() - ONSET_CUT)
    return int(near[0]) + 1, int(near[-1]) + 1
