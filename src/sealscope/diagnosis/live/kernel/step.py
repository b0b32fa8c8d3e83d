"""Kernels of the detector of steps (`live.sequential`, whose docstring derives the formulas) on a record of fixed size.

`take_estimate` adds the estimate of a block. `weigh_onset` computes what one possible onset says; when all have been
weighed, `sum_evidence` computes log M, the onset and the size. `add_exceedance` sums P(rise > x) over the onsets, from
which `bisect_bound` finds the bound of an undetected rise. Each does little at a time, so that a controller can spread
them over its cycles.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sealscope.compiled import kernel, large_law, law
from sealscope.diagnosis.inference.onset import BOUND_PROBABILITY
from sealscope.diagnosis.live.kernel.special import LOG_ZERO, add_logs, log_gamma, normal_probability
from sealscope.diagnosis.priors.live import LIVE

_PRIORS = LIVE.step
#: q: variances of the walk in a block, over that of the first block's estimate.
WALKS: tuple[float, ...] = tuple(map(float, _PRIORS.walks))
#: v: prior variances of the step's size, in the same unit.
SIZES: tuple[float, ...] = tuple(map(float, _PRIORS.sizes))
#: Fractions of the step's first block in which the leak is open, the longest first: onsets are in order of time.
PARTS: tuple[float, ...] = tuple(sorted(map(float, _PRIORS.parts), reverse=True))
_N_WALKS, _N_SIZES, _N_PARTS = len(WALKS), len(SIZES), len(PARTS)
#: All onsets of the last `RECENT` blocks are stored, then `RECENT / 4` of each doubling of age, up to `HORIZON` blocks.
RECENT, HORIZON = int(_PRIORS.recent), int(_PRIORS.horizon)
#: Factor per block by which the weight of earlier innovations decays; probability that the walk changes in a block.
_MEMORY, _CHANGES = float(_PRIORS.memory), float(_PRIORS.changes)
_STAYS = math.log1p(-_CHANGES)
_CHANGED = math.log(_CHANGES / _N_WALKS)
_JUMP_SQUARE = float(LIVE.coefficients.jump) ** 2
#: Lower limit of an innovation's square over its variance; repeated samples give 0, whose logarithm is not finite.
_MIN_SQUARE = 1e-12
#: Number of innovations from which on onsets are possible, and the probabilities of the walks are updated.
_N_WARM = 4
#: Number of blocks from one thinning of the onsets to the next.
_SELECT_EVERY = 8
#: Most onsets that are stored: those of the last blocks until the next thinning, and those of older ones.
MAX_ONSETS = (RECENT + _SELECT_EVERY) * _N_PARTS + (RECENT // 4 + 1) * math.ceil(math.log2(HORIZON / RECENT))
_LOG_CHOICES = math.log(_N_SIZES * _N_PARTS)
_LOG_PI = math.log(math.pi)
#: Least positive number, against division by 0.
_TINY = float(np.finfo(float).tiny)
#: Share of T that a step explains at most, so that its logarithm is finite.
_MOST_EXPLAINED = 1.0 - 1e-15
#: Standard deviations beyond which a size has practically no probability, and steps of the search for the bound.
_FAR, BISECTIONS = 12.0, 50
#: Tail of the posterior on either side of the interval of the onset.
_TAIL = 0.025

#: Rows of `sums`, for each walk and onset: part of a unit step that the filter has followed (1 - f of the next block),
#: a, b, T, and log pi_j minus the log likelihood of the blocks before the onset.
FOLLOWED, A, B, T, LOG_PRIOR = range(5)
#: Columns of `onsets`: n of the innovations in T, number of the block, time, begin of the block [s], and log evidence
#: of the blocks before it.
N, BLOCK, TIME, BLOCK_BEGIN, EVIDENCE = range(5)
#: Columns of `views`, what an onset says: log of its part of M; log of its posterior probability, but for the time that
#: it stands for; mean and mean square of the size given the onset.
_LOG_M, _LOG_POSTERIOR, _SIZE, _SIZE_SQUARE = range(4)

#: Arrays of the record, with their shapes, and its numbers: see `live.sequential.StepDetector`.
ARRAYS: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(("level", "level_variance", "squares", "log_variances", "log_weights"), (_N_WALKS,)),
    **dict.fromkeys(("log_prior", "innovation", "variance", "gain", "square", "likelihood"), (_N_WALKS,)),
    "sums": (5, _N_WALKS, MAX_ONSETS),
    "onsets": (MAX_ONSETS, 5),
    "views": (MAX_ONSETS, 4),
    "weights": (_N_WALKS, MAX_ONSETS),
}
NUMBERS = (
    *("unit", "count", "log_evidence", "end", "log_e", "onset", "onset_low", "onset_high", "size", "size_deviation"),
    *("heaviest", "largest", "rising", "exceedance", "low", "high", "bound"),
)
WHOLE_NUMBERS = ("n_blocks", "n_onsets", "has_level")
LAYOUT = np.dtype(
    [
        *((name, "f8") for name in NUMBERS),
        *((name, "i8") for name in WHOLE_NUMBERS),
        *((name, "f8", shape) for name, shape in ARRAYS.items()),
    ]
)


@law
def start_detector(d: Any) -> None:
    """Set the record of a detector to its beginning, without blocks."""
    d.unit = d.count = d.log_evidence = d.end = 0.0
    d.n_blocks = 0
    for q in range(_N_WALKS):
        d.level[q] = d.level_variance[q] = d.squares[q] = d.log_variances[q] = 0.0
        d.log_weights[q] = -math.log(_N_WALKS)
    forget_onsets(d)


@law
def forget_onsets(d: Any) -> None:
    """Drop the evidence of all blocks so far, and keep the learned noise and random walk."""
    d.has_level = d.n_onsets = 0
    d.log_evidence = 0.0


@law
def _log_normalisation(n: float) -> float:
    """Compute log Gamma(n/2) - n/2 log(pi): its difference between two n is the log factor of Student's t."""
    return log_gamma(0.5 * n) - 0.5 * n * _LOG_PI


@large_law
def take_estimate(d: Any, begin: float, end: float, g: float, deviation: float) -> None:
    """Add the estimate g of the coefficient in the block from `begin` to `end` [s], of the standard error `deviation`.

    The first block after `forget_onsets` only sets the level of the filters.
    """
    if d.unit == 0.0:
        d.unit = deviation
    y, relative = g / d.unit, deviation / d.unit
    variance = relative * relative
    d.n_blocks += 1
    elapsed = max((begin - d.end) / (end - begin) + 1.0, 1.0)  # blocks since the last one; 1: should they overlap
    d.end = end
    if d.has_level == 0:
        d.has_level = 1
        for q in range(_N_WALKS):
            d.level[q], d.level_variance[q] = y, variance
        return
    may_begin = d.count >= _N_WARM
    if may_begin:
        for q in range(_N_WALKS):
            d.log_prior[q] = add_logs(_STAYS + d.log_weights[q], _CHANGED)
        _add_onsets(d, begin, end)
    for q in range(_N_WALKS):
        level_variance = d.level_variance[q] + WALKS[q] * elapsed
        d.innovation[q], d.variance[q] = y - d.level[q], level_variance + variance
        d.gain[q] = level_variance / d.variance[q]
        d.square[q] = d.innovation[q] * d.innovation[q] / d.variance[q]
    if may_begin:
        _add_evidence(d)
    _add_innovation(d, may_begin)
    _update_walks(d)
    for q in range(_N_WALKS):
        d.level[q] += d.gain[q] * d.innovation[q]
        d.level_variance[q] = d.gain[q] * variance


@large_law
def _add_onsets(d: Any, begin: float, end: float) -> None:
    """Add possible onsets of a step, one for each of `PARTS`, in the block from `begin` to `end` [s]."""
    if d.n_onsets + _N_PARTS > MAX_ONSETS or d.n_blocks % _SELECT_EVERY == 0:
        _select_onsets(d)
    for part in range(_N_PARTS):
        j = int(d.n_onsets)
        for q in range(_N_WALKS):
            d.sums[FOLLOWED, q, j] = d.sums[A, q, j] = d.sums[B, q, j] = 0.0
            # T begins with its value before the onset; the log likelihood until then is subtracted from the log prior
            d.sums[T, q, j] = d.squares[q]
            before = d.count * math.log(d.squares[q]) + d.log_variances[q]
            d.sums[LOG_PRIOR, q, j] = d.log_prior[q] + 0.5 * before
        d.onsets[j, N], d.onsets[j, BLOCK], d.onsets[j, BLOCK_BEGIN] = d.count, d.n_blocks, begin
        d.onsets[j, TIME], d.onsets[j, EVIDENCE] = end - PARTS[part] * (end - begin), d.log_evidence
        d.n_onsets += 1


@large_law
def _select_onsets(d: Any) -> None:
    """Keep all onsets of the last `RECENT` blocks, and older ones at the start of blocks on a coarser grid."""
    n_kept = 0
    for j in range(int(d.n_onsets)):
        age = d.n_blocks - int(d.onsets[j, BLOCK])
        spacing, reach = 2, RECENT
        while reach < age:
            spacing, reach = 2 * spacing, 2 * reach
        is_on_grid = int(d.onsets[j, BLOCK]) % spacing == 0 and d.onsets[j, TIME] <= d.onsets[j, BLOCK_BEGIN]
        if age < RECENT or (is_on_grid and age < HORIZON):
            for row in range(5):
                d.onsets[n_kept, row] = d.onsets[j, row]
                for q in range(_N_WALKS):
                    d.sums[row, q, n_kept] = d.sums[row, q, j]
            n_kept += 1
    d.n_onsets = n_kept


@law
def _add_evidence(d: Any) -> None:
    """Add the log density of the block's innovation given the earlier ones to the evidence without a step."""
    n, total = d.count, LOG_ZERO
    scale = _log_normalisation(n + 1.0) - _log_normalisation(n)
    for q in range(_N_WALKS):
        density = scale - 0.5 * math.log(d.variance[q] * d.squares[q])
        density -= 0.5 * (n + 1.0) * math.log1p(d.square[q] / d.squares[q])
        total = add_logs(total, d.log_prior[q] + density)
    d.log_evidence += total


@large_law
def _add_innovation(d: Any, may_begin: bool) -> None:
    """Add the block's innovation to the sums of each onset; a step that begins in this block acts in a part of it."""
    n_onsets = int(d.n_onsets)
    first_new = n_onsets - _N_PARTS if may_begin else n_onsets
    for q in range(_N_WALKS):
        for j in range(n_onsets):
            f = PARTS[j - first_new] if j >= first_new else 1.0 - d.sums[FOLLOWED, q, j]
            d.sums[FOLLOWED, q, j] += d.gain[q] * f
            d.sums[A, q, j] += f / d.variance[q] * d.innovation[q]
            d.sums[B, q, j] += f / d.variance[q] * f
            d.sums[T, q, j] += d.square[q]
    for j in range(n_onsets):
        d.onsets[j, N] += 1.0


@large_law
def _update_walks(d: Any) -> None:
    """Update the noise and the probability of each random walk by the block's innovation."""
    total = LOG_ZERO
    for q in range(_N_WALKS):
        square = max(d.square[q], _MIN_SQUARE)
        if d.count >= _N_WARM:
            # clipped, as a large innovation is a step, which must not count as noise or walk
            square = min(square, _JUMP_SQUARE * d.squares[q] / d.count)
            # Bayes' rule with the log density of Student's t; the earlier probabilities fade
            weight = _MEMORY * d.log_weights[q] - 0.5 * math.log(d.variance[q] * d.squares[q])
            d.log_weights[q] = weight - 0.5 * (d.count + 1.0) * math.log1p(square / d.squares[q])
            total = add_logs(total, d.log_weights[q])
        d.squares[q] = _MEMORY * d.squares[q] + square
        d.log_variances[q] += math.log(d.variance[q])
    if d.count >= _N_WARM:
        for q in range(_N_WALKS):
            d.log_weights[q] -= total
    d.count = _MEMORY * d.count + 1.0


@large_law
def limit_log_e(d: Any) -> float:
    """Compute a quick upper bound of log M: the largest likelihood ratio of a step of the best size, times the onsets.

    `LOG_ZERO` if no step can have begun yet.
    """
    largest = LOG_ZERO
    for j in range(int(d.n_onsets)):
        for q in range(_N_WALKS):
            a = max(d.sums[A, q, j], 0.0)
            explained = min(a * a / (d.sums[B, q, j] * d.sums[T, q, j]), _MOST_EXPLAINED)
            largest = max(largest, -0.5 * d.onsets[j, N] * math.log1p(-explained))
    return float(largest + math.log(d.n_onsets / _N_PARTS)) if d.n_onsets > 0 else LOG_ZERO


@large_law
def weigh_onset(d: Any, j: int) -> None:
    """Compute what onset j says: its part of M, its posterior, the size given it, and the weights of each walk."""
    n, total = d.onsets[j, N], LOG_ZERO
    for q in range(_N_WALKS):
        log_likelihood = n * math.log(d.sums[T, q, j]) + d.log_variances[q]
        d.likelihood[q] = d.sums[LOG_PRIOR, q, j] - 0.5 * log_likelihood
        total = add_logs(total, d.likelihood[q])
    n_before = n - (d.n_blocks - d.onsets[j, BLOCK] + 1.0)
    log_before = d.onsets[j, EVIDENCE] + _log_normalisation(n) - _log_normalisation(n_before)
    freedom = max(n - 2.0, 1.0)  # the variance is n/(n - 2) times the squared scale
    log_m, weight_sum, size_sum, square_sum = LOG_ZERO, 0.0, 0.0, 0.0
    reference = LOG_ZERO  # the largest logarithm so far, by which the sums are scaled
    for q in range(_N_WALKS):
        a, b, rest = d.sums[A, q, j], d.sums[B, q, j], d.sums[T, q, j]
        log_ratio = LOG_ZERO  # of all sizes together; a step down has the size 0
        for v in range(_N_SIZES):
            precision = b + 1.0 / SIZES[v]
            rise = max(a, 0.0)
            ratio = -0.5 * (math.log1p(SIZES[v] * b) + n * math.log1p(-(rise * rise) / (precision * rest)))
            log_ratio = add_logs(log_ratio, ratio)
            if a > 0.0:
                log_weight = ratio + d.likelihood[q]
                log_m = add_logs(log_m, log_weight)
                size = a / precision
                variance = max(rest - a * size, 0.0) / freedom / precision
                if log_weight > reference:
                    shrink = math.exp(reference - log_weight) if reference > LOG_ZERO else 0.0
                    weight_sum, size_sum, square_sum = weight_sum * shrink, size_sum * shrink, square_sum * shrink
                    reference = log_weight
                weight = math.exp(log_weight - reference)
                weight_sum += weight
                size_sum += weight * size
                square_sum += weight * (variance + size * size)
        d.weights[q, j] = d.likelihood[q] - total + log_ratio
    has_rise = weight_sum > 0.0
    d.views[j, _LOG_M] = log_m - total - _LOG_CHOICES if has_rise else LOG_ZERO
    d.views[j, _LOG_POSTERIOR] = log_m + log_before if has_rise else LOG_ZERO
    d.views[j, _SIZE] = size_sum / weight_sum if has_rise else 0.0
    d.views[j, _SIZE_SQUARE] = square_sum / weight_sum if has_rise else 0.0


@law
def _spacing(d: Any, j: int) -> float:
    """Compute the time [s] that onset j stands for, up to the middles between it and its neighbours."""
    last = int(d.n_onsets) - 1
    before, after = max(j - 1, 0), min(j + 1, last)
    if after == before:
        return 1.0
    return float(max((d.onsets[after, TIME] - d.onsets[before, TIME]) / (after - before), _TINY))


@large_law
def sum_evidence(d: Any) -> None:
    """Compute log M (`log_e`), and the posterior of onset [s] and size [unit of g], once all onsets are weighed."""
    n_onsets = int(d.n_onsets)
    d.log_e, heaviest = LOG_ZERO, LOG_ZERO
    for j in range(n_onsets):
        d.log_e = add_logs(d.log_e, d.views[j, _LOG_M])
        heaviest = max(heaviest, d.views[j, _LOG_POSTERIOR] + math.log(_spacing(d, j)))
    d.onset = d.onset_low = d.onset_high = d.size = d.size_deviation = 0.0
    if not heaviest > LOG_ZERO:
        return
    total = onset = size = square = 0.0
    for j in range(n_onsets):
        weight = math.exp(d.views[j, _LOG_POSTERIOR] - heaviest) * _spacing(d, j)
        total += weight
        onset += weight * (d.onsets[j, TIME] - d.end)  # relative to the present, against rounding
        size += weight * d.views[j, _SIZE]
        square += weight * d.views[j, _SIZE_SQUARE]
    mean = size / total
    d.onset, d.size = d.end + onset / total, d.unit * mean
    d.size_deviation = d.unit * math.sqrt(max(square / total - mean * mean, 0.0))
    below, first, last = 0.0, -1, n_onsets - 1
    for j in range(n_onsets):
        below += math.exp(d.views[j, _LOG_POSTERIOR] - heaviest) * _spacing(d, j)
        if first < 0 and below >= _TAIL * total:
            first = j
        if below >= (1.0 - _TAIL) * total:
            last = j
            break
    first = max(first, 0)
    d.onset_low = d.onsets[first, TIME] - _spacing(d, first)
    d.onset_high = d.onsets[last, TIME] + _spacing(d, last)


@law
def start_bound(d: Any) -> None:
    """Begin the search for the bound: find the largest weight, which scales the others, and the largest size."""
    d.heaviest, d.largest = LOG_ZERO, 0.0
    for j in range(int(d.n_onsets)):
        for q in range(_N_WALKS):
            d.heaviest = max(d.heaviest, d.weights[q, j])
            size = d.sums[A, q, j] / d.sums[B, q, j]
            d.largest = max(d.largest, size + _FAR * _size_deviation(d, q, j, size))
    d.rising = d.exceedance = 0.0
    d.low, d.high = 0.0, d.largest


@law
def _size_deviation(d: Any, q: int, j: int, size: float) -> float:
    """Compute the standard error of the least-squares size of a step at onset j with walk q."""
    squares = max(d.sums[T, q, j] - d.sums[A, q, j] * size, _TINY)
    return max(math.sqrt(squares / d.onsets[j, N] / d.sums[B, q, j]), _TINY)


@large_law
def add_exceedance(d: Any, j: int, x: float) -> None:
    """Add to `exceedance` the weighted probability, given onset j, that the size is larger than x."""
    for q in range(_N_WALKS):
        size = d.sums[A, q, j] / d.sums[B, q, j]
        weight = math.exp(d.weights[q, j] - d.heaviest)
        d.exceedance += weight * normal_probability((size - x) / _size_deviation(d, q, j, size))


@law
def bisect_bound(d: Any) -> None:
    """Halve the interval of the bound, by the `exceedance` of its middle; at first that of 0 is stored as `rising`."""
    if d.rising == 0.0:
        d.rising = d.exceedance
    elif d.exceedance > (1.0 - BOUND_PROBABILITY) * d.rising:
        d.low = 0.5 * (d.low + d.high)
    else:
        d.high = 0.5 * (d.low + d.high)
    d.exceedance = 0.0
    # without a probability of a rise, the largest conceivable size
    d.bound = d.unit * d.high if d.rising > 0.0 else d.unit * d.largest


@kernel
def start_step_detector(memory: Any) -> None:
    """Set the record `memory` (1,) to its beginning."""
    start_detector(memory[0])


@kernel
def forget_steps(memory: Any) -> None:
    """Drop the evidence of all blocks so far."""
    forget_onsets(memory[0])


@kernel
def take_block(memory: Any, begin: float, end: float, g: float, deviation: float) -> None:
    """Add the estimate of a block."""
    take_estimate(memory[0], begin, end, g, deviation)


@kernel
def weigh_all(memory: Any, min_log_e: float) -> None:
    """Weigh all onsets and sum their evidence, unless a quick bound of log M is at most `min_log_e`."""
    d = memory[0]
    if limit_log_e(d) <= min_log_e:
        d.log_e = LOG_ZERO
        return
    for j in range(int(d.n_onsets)):
        weigh_onset(d, j)
    sum_evidence(d)


@kernel
def find_bound(memory: Any) -> float:
    """Weigh all onsets, and compute the bound of an undetected rise."""
    d = memory[0]
    n_onsets = int(d.n_onsets)
    for j in range(n_onsets):
        weigh_onset(d, j)
    start_bound(d)
    for k in range(BISECTIONS + 1):
        x = 0.5 * (d.low + d.high) if k > 0 else 0.0
        for j in range(n_onsets):
            add_exceedance(d, j, x)
        bisect_bound(d)
    return float(d.bound)
