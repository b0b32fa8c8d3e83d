"""Kernels of the detector of steps (`live.sequential`, whose docstring derives the formulas) on a record of fixed size.

`take_estimate` adds the estimate of a block. After `start_evidence`, `weigh_onset` adds what one possible onset says;
when all have been weighed, `finish_evidence` computes onset and size. `add_exceedance` sums P(rise > x) over the
onsets, from which `bisect_bound` finds the bound of an undetected rise. Each does little at a time, so that a
controller can spread them over its cycles.

The filter is linear: a step that acts in the part p of its first block, whose gain is G_1, follows it by the fraction
p G_1, and then as any other step of the size 1 - p G_1 does. Hence all onsets within a block share the sums over the
blocks after it, and with the first block's innovation e_1 of the variance S_1

    a = p e_1/S_1 + (1 - p G_1) a',    b = p^2/S_1 + (1 - p G_1)^2 b'.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sealscope.compiled import kernel, large_law, law
from sealscope.diagnosis.estimate.change import log_size_mixture
from sealscope.diagnosis.estimate.population import BOUND_PROBABILITY
from sealscope.diagnosis.estimate.special import LOG_ZERO, add_logs, log_gamma, normal_probability
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
#: Logarithms that are summed over all blocks begin anew beyond this, so that their differences stay exact.
_MOST_LOG = 4096.0
#: Number of blocks from one thinning of the onsets to the next.
_SELECT_EVERY = 8
#: Most recent and older blocks with onsets: those since the last thinning, and those that it keeps.
MAX_RECENT, MAX_OLD = RECENT + _SELECT_EVERY, (RECENT // 4 + 1) * math.ceil(math.log2(HORIZON / RECENT))
MAX_BLOCKS, MAX_ONSETS = MAX_RECENT + MAX_OLD, MAX_RECENT * _N_PARTS + MAX_OLD
_LOG_CHOICES = math.log(_N_SIZES * _N_PARTS)
_LOG_PI = math.log(math.pi)
#: Least positive number, against division by 0.
TINY = float(np.finfo(float).tiny)
#: Share of T that a step explains at most, so that its logarithm is finite.
MOST_EXPLAINED = 1.0 - 1e-15
#: Standard deviations beyond which a size has practically no probability, and steps of the search for the bound.
_FAR, BISECTIONS = 12.0, 50
#: Tail of the posterior on either side of the interval of the onset.
_TAIL = 0.025

#: Rows of `sums`, for each walk and block with onsets: f of the next block, for a step that the filter has not followed
#: in the first block; a' and b' of the blocks after the first; T; log pi_j minus the log likelihood of the blocks
#: before. Of an old block with one onset, f, a and b are those of this onset.
RESPONSE, A, B, T, LOG_PRIOR = range(5)
#: Rows of `firsts`, for each walk and recent block: e_1/S_1 and 1/S_1.
_FIRST_A, _FIRST_B = range(2)
#: Columns of `blocks`: n of the innovations in T, number, begin and end [s] of the block with the onsets, and log
#: evidence of the blocks before it.
N, BLOCK, BEGIN, END, EVIDENCE = range(5)

#: Arrays of the record, with their shapes, and its numbers: see `live.sequential.StepDetector`. `variances`: of the
#: first estimate of recent blocks; `posteriors`, `weights`: of each onset, and of each walk and onset.
ARRAYS: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(("level", "level_variance", "squares", "log_variances", "log_weights"), (_N_WALKS,)),
    **dict.fromkeys(("log_prior", "innovation", "variance", "gain", "square", "likelihood"), (_N_WALKS,)),
    "sums": (5, _N_WALKS, MAX_BLOCKS),
    "firsts": (2, _N_WALKS, MAX_RECENT),
    "variances": (MAX_RECENT,),
    "blocks": (MAX_BLOCKS, 5),
    "posteriors": (MAX_ONSETS,),
    "weights": (_N_WALKS, MAX_ONSETS),
}
NUMBERS = (
    *("unit", "count", "log_evidence", "end", "log_e", "onset", "onset_low", "onset_high", "size", "size_deviation"),
    *("heaviest", "largest", "rising", "exceedance", "low", "high", "bound"),
    # sums over onsets by their posterior weights, relative to the largest, whose logarithm is `reference`
    *("reference", "weight_sum", "onset_sum", "size_sum", "square_sum"),
)
#: `n_stored`: blocks with onsets, of which the first `n_old` have one onset, and the others one for each of `PARTS`.
WHOLE_NUMBERS = ("n_blocks", "n_onsets", "n_stored", "n_old", "has_level")
#: Arrays of the record that are used only while onsets are weighed and the bound is found.
SCRATCH = ("posteriors", "weights")


def detector_layout(gap: int = 0, sums: int = 0) -> np.dtype[Any]:
    """Build the layout of the record, with a `gap` of so many numbers before `sums`, which takes `sums` or more.

    A record around it may use the gap. The arrays of `SCRATCH` are the last.
    """
    sizes = {name: int(np.prod(shape)) for name, shape in ARRAYS.items()}
    small = [name for name in ARRAYS if name not in ("sums", *SCRATCH)]
    formats: list[Any] = [*("f8" for _ in NUMBERS), *("i8" for _ in WHOLE_NUMBERS)]
    names = [*NUMBERS, *WHOLE_NUMBERS, *small, "sums", *SCRATCH]
    spans = [1] * len(formats) + [sizes[name] for name in small]
    spans[-1] += gap
    spans += [max(sizes["sums"], sums), *(sizes[name] for name in SCRATCH)]
    places = np.cumsum([0, *spans]) * 8
    formats += [("f8", ARRAYS[name]) for name in names[len(formats) :]]
    offsets, end = places[:-1].tolist(), int(places[-1])
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": end})


LAYOUT = detector_layout()


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
    d.has_level = d.n_onsets = d.n_stored = d.n_old = 0
    d.log_evidence = 0.0


@law
def _log_normalisation(n: float) -> float:
    """Compute log Gamma(n/2) - n/2 log(pi): its difference between two n is the log factor of Student's t."""
    return log_gamma(0.5 * n) - 0.5 * n * _LOG_PI


@large_law
def take_estimate(d: Any, elapsed: float, begin: float, end: float, g: float, deviation: float) -> None:
    """Add the estimate g of the coefficient in the block from `begin` to `end` [s], of the standard error `deviation`.

    `elapsed`: blocks since the last one, 1 if none is left out, and at least 1. The first block after `forget_onsets`
    only sets the level of the filters.
    """
    if d.unit == 0.0:
        d.unit = deviation
    y, relative = g / d.unit, deviation / d.unit
    variance = relative * relative
    d.n_blocks += 1
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
        level_variance = d.level_variance[q] + WALKS[q] * max(elapsed, 1.0)
        d.innovation[q], d.variance[q] = y - d.level[q], level_variance + variance
        d.gain[q] = level_variance / d.variance[q]
        d.square[q] = d.innovation[q] * d.innovation[q] / d.variance[q]
    if may_begin:
        _add_evidence(d)
    _add_innovation(d)
    if may_begin:
        _add_first(d, variance)
    _update_walks(d)
    for q in range(_N_WALKS):
        d.level[q] += d.gain[q] * d.innovation[q]
        d.level_variance[q] = d.gain[q] * variance


@large_law
def _add_onsets(d: Any, begin: float, end: float) -> None:
    """Add possible onsets of a step, one for each of `PARTS`, in the block from `begin` to `end` [s]."""
    if d.n_stored >= MAX_BLOCKS or d.n_stored - d.n_old >= MAX_RECENT or d.n_blocks % _SELECT_EVERY == 0:
        _select_blocks(d)
    b = int(d.n_stored)
    for q in range(_N_WALKS):
        d.sums[RESPONSE, q, b], d.sums[A, q, b], d.sums[B, q, b] = 1.0, 0.0, 0.0
        # T begins with its value before the onset; the log likelihood until then is subtracted from the log prior
        d.sums[T, q, b] = d.squares[q]
        before = d.count * math.log(d.squares[q]) + d.log_variances[q]
        d.sums[LOG_PRIOR, q, b] = d.log_prior[q] + 0.5 * before
    d.blocks[b, N], d.blocks[b, BLOCK], d.blocks[b, EVIDENCE] = d.count, d.n_blocks, d.log_evidence
    d.blocks[b, BEGIN], d.blocks[b, END] = begin, end
    d.n_stored += 1
    d.n_onsets += _N_PARTS


@large_law
def _select_blocks(d: Any) -> None:
    """Keep all onsets of the last `RECENT` blocks, and the first one of older blocks on a coarser grid."""
    n_kept = n_old = 0
    for b in range(int(d.n_stored)):
        age, recent = d.n_blocks - int(d.blocks[b, BLOCK]), b - int(d.n_old)  # recent: place in `firsts`
        spacing, reach = 2, RECENT
        while reach < age:
            spacing, reach = 2 * spacing, 2 * reach
        is_recent = age < RECENT and n_kept - n_old < MAX_RECENT - 1
        if is_recent or (int(d.blocks[b, BLOCK]) % spacing == 0 and age < HORIZON and n_kept < MAX_OLD):
            for column in range(5):
                d.blocks[n_kept, column] = d.blocks[b, column]
            for q in range(_N_WALKS):
                for row in range(5):
                    d.sums[row, q, n_kept] = d.sums[row, q, b]
                if is_recent:
                    d.firsts[_FIRST_A, q, n_kept - n_old] = d.firsts[_FIRST_A, q, recent]
                    d.firsts[_FIRST_B, q, n_kept - n_old] = d.firsts[_FIRST_B, q, recent]
                elif recent >= 0:  # from now on a single onset, at the block's begin
                    d.sums[A, q, n_kept], d.sums[B, q, n_kept] = _step_sums(d, q, b, 1.0)
                    d.sums[RESPONSE, q, n_kept] *= _unfollowed(d, q, recent, 1.0)
            if is_recent:
                d.variances[n_kept - n_old] = d.variances[recent]
            else:
                n_old += 1
            n_kept += 1
    d.n_stored, d.n_old = n_kept, n_old
    d.n_onsets = n_old + (n_kept - n_old) * _N_PARTS


@law
def _unfollowed(d: Any, q: int, recent: int, part: float) -> float:
    """Compute 1 - p G_1: how much of a step in the `part` p of a recent block the filter has not followed in it."""
    return float(1.0 - part * (1.0 - d.variances[recent] * d.firsts[_FIRST_B, q, recent]))


@law
def _step_sums(d: Any, q: int, b: int, part: float) -> tuple[float, float]:
    """Compute a and b of a step that acts in a `part` of the stored block b, by the module's docstring."""
    recent = b - int(d.n_old)
    later_a, later_b = d.sums[A, q, b], d.sums[B, q, b]
    if recent < 0:
        return later_a, later_b
    rest = _unfollowed(d, q, recent, part)
    a = part * d.firsts[_FIRST_A, q, recent] + rest * later_a
    return a, part * part * d.firsts[_FIRST_B, q, recent] + rest * rest * later_b


@law
def _block_of(d: Any, j: int) -> int:
    """Return the place of the block of onset j."""
    n_old = int(d.n_old)
    return j if j < n_old else n_old + (j - n_old) // _N_PARTS


@law
def _part_of(d: Any, j: int) -> float:
    """Return the part of its first block in which a step at onset j acts."""
    n_old = int(d.n_old)
    return PARTS[(j - n_old) % _N_PARTS] if j >= n_old else 1.0


@law
def _time_of(d: Any, j: int) -> float:
    """Compute the time [s] of onset j."""
    b, part = _block_of(d, j), _part_of(d, j)
    return float(d.blocks[b, END] - part * (d.blocks[b, END] - d.blocks[b, BEGIN]))


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
    if abs(d.log_evidence) > _MOST_LOG:
        for b in range(int(d.n_stored)):
            d.blocks[b, EVIDENCE] -= d.log_evidence
        d.log_evidence = 0.0


@large_law
def _add_innovation(d: Any) -> None:
    """Add the block's innovation to the sums of each stored block."""
    n_stored = int(d.n_stored)
    for q in range(_N_WALKS):
        rest = 1.0 - d.gain[q]
        for b in range(n_stored):
            f = d.sums[RESPONSE, q, b]
            d.sums[RESPONSE, q, b] = f * rest
            d.sums[A, q, b] += f / d.variance[q] * d.innovation[q]
            d.sums[B, q, b] += f / d.variance[q] * f
            d.sums[T, q, b] += d.square[q]
    for b in range(n_stored):
        d.blocks[b, N] += 1.0


@law
def _add_first(d: Any, variance: float) -> None:
    """Set the newest block aside in `firsts`: a step may begin within it; `variance`: that of its estimate."""
    b, recent = int(d.n_stored) - 1, int(d.n_stored - d.n_old) - 1
    d.variances[recent] = variance
    for q in range(_N_WALKS):
        d.firsts[_FIRST_A, q, recent], d.firsts[_FIRST_B, q, recent] = d.sums[A, q, b], d.sums[B, q, b]
        d.sums[RESPONSE, q, b], d.sums[A, q, b], d.sums[B, q, b] = 1.0, 0.0, 0.0


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
        if abs(d.log_variances[q]) > _MOST_LOG:
            for b in range(int(d.n_stored)):
                d.sums[LOG_PRIOR, q, b] -= 0.5 * d.log_variances[q]
            d.log_variances[q] = 0.0
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
        k, part = _block_of(d, j), _part_of(d, j)
        for q in range(_N_WALKS):
            a, b = _step_sums(d, q, k, part)
            a = max(a, 0.0)
            explained = min(a * a / (b * d.sums[T, q, k]), MOST_EXPLAINED)
            largest = max(largest, -0.5 * d.blocks[k, N] * math.log1p(-explained))
    return float(largest + math.log(d.n_onsets / _N_PARTS)) if d.n_onsets > 0 else LOG_ZERO


@law
def start_evidence(d: Any) -> None:
    """Begin to weigh all onsets."""
    d.log_e = d.heaviest = d.reference = LOG_ZERO
    d.largest = d.weight_sum = d.onset_sum = d.size_sum = d.square_sum = 0.0


@large_law
def weigh_onset(d: Any, j: int) -> None:
    """Add what onset j says: its part of M, its posterior with the size given it, and the weights of each walk."""
    k, part = _block_of(d, j), _part_of(d, j)
    n, total = d.blocks[k, N], LOG_ZERO
    for q in range(_N_WALKS):
        log_likelihood = n * math.log(d.sums[T, q, k]) + d.log_variances[q]
        d.likelihood[q] = d.sums[LOG_PRIOR, q, k] - 0.5 * log_likelihood
        total = add_logs(total, d.likelihood[q])
    n_before = n - (d.n_blocks - d.blocks[k, BLOCK] + 1.0)
    log_before = d.blocks[k, EVIDENCE] + _log_normalisation(n) - _log_normalisation(n_before)
    freedom = max(n - 2.0, 1.0)  # the variance is n/(n - 2) times the squared scale
    weight_sum, size_sum, square_sum = 0.0, 0.0, 0.0
    reference = LOG_ZERO  # the largest logarithm so far, by which the sums are scaled
    for q in range(_N_WALKS):
        a, b = _step_sums(d, q, k, part)
        rest = d.sums[T, q, k]
        log_ratio = LOG_ZERO  # of all sizes together; a step down has the size 0
        for v in range(_N_SIZES):
            precision = b + 1.0 / SIZES[v]
            rise = max(a, 0.0)
            score = -n * math.log1p(-(rise * rise) / (precision * rest))
            ratio = log_size_mixture(SIZES[v] * b, math.sqrt(score))
            log_ratio = add_logs(log_ratio, ratio)
            if a > 0.0:
                log_weight = ratio + d.likelihood[q]
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
        d.heaviest = max(d.heaviest, d.weights[q, j])
        d.largest = max(d.largest, a / b + _FAR * _size_deviation(a, b, rest, n))
    d.posteriors[j] = LOG_ZERO
    if weight_sum > 0.0:
        log_m = reference + math.log(weight_sum)
        d.log_e = add_logs(d.log_e, log_m - total - _LOG_CHOICES)
        _add_posterior(d, j, log_m + log_before, size_sum / weight_sum, square_sum / weight_sum)


@law
def _add_posterior(d: Any, j: int, log_density: float, size: float, square: float) -> None:
    """Add onset j to the sums for means over onsets; `size`, `square`: mean of the step's size, and of its square."""
    d.posteriors[j] = log_density + math.log(_spacing(d, j))
    if d.posteriors[j] > d.reference:
        shrink = math.exp(d.reference - d.posteriors[j]) if d.reference > LOG_ZERO else 0.0
        d.weight_sum *= shrink
        d.onset_sum *= shrink
        d.size_sum *= shrink
        d.square_sum *= shrink
        d.reference = d.posteriors[j]
    weight = math.exp(d.posteriors[j] - d.reference)
    d.weight_sum += weight
    d.onset_sum += weight * (_time_of(d, j) - d.end)  # relative to the present, against rounding
    d.size_sum += weight * size
    d.square_sum += weight * square


@law
def _spacing(d: Any, j: int) -> float:
    """Compute the time [s] that onset j stands for, up to the middles between it and its neighbours."""
    last = int(d.n_onsets) - 1
    before, after = max(j - 1, 0), min(j + 1, last)
    if after == before:
        return 1.0
    return float(max((_time_of(d, after) - _time_of(d, before)) / (after - before), TINY))


@law
def finish_evidence(d: Any) -> None:
    """Compute the posterior of onset [s] and size [unit of g], once all onsets are weighed."""
    d.onset = d.size = d.size_deviation = 0.0
    if d.weight_sum > 0.0:
        mean = d.size_sum / d.weight_sum
        d.onset, d.size = d.end + d.onset_sum / d.weight_sum, d.unit * mean
        d.size_deviation = d.unit * math.sqrt(max(d.square_sum / d.weight_sum - mean * mean, 0.0))


@law
def find_onset_interval(d: Any) -> None:
    """Find the 95 % interval of the onset [s], once all onsets are weighed."""
    d.onset_low = d.onset_high = 0.0
    if not d.weight_sum > 0.0:
        return
    n_onsets = int(d.n_onsets)
    below, first, last = 0.0, -1, n_onsets - 1
    for j in range(n_onsets):
        below += math.exp(d.posteriors[j] - d.reference)
        if first < 0 and below >= _TAIL * d.weight_sum:
            first = j
        if below >= (1.0 - _TAIL) * d.weight_sum:
            last = j
            break
    first = max(first, 0)
    d.onset_low = _time_of(d, first) - _spacing(d, first)
    d.onset_high = _time_of(d, last) + _spacing(d, last)


@law
def start_bound(d: Any) -> None:
    """Begin the search for the bound, once all onsets are weighed."""
    d.rising = d.exceedance = 0.0
    d.low, d.high = 0.0, d.largest


@law
def _size_deviation(a: float, b: float, squares: float, n: float) -> float:
    """Compute the standard error of the least-squares size a/b of a step, from T (`squares`) of n innovations."""
    return max(math.sqrt(max(squares - a * (a / b), TINY) / n / b), TINY)


@large_law
def add_exceedance(d: Any, j: int, x: float) -> None:
    """Add to `exceedance` the weighted probability, given onset j, that the size is larger than x."""
    k, part = _block_of(d, j), _part_of(d, j)
    for q in range(_N_WALKS):
        a, b = _step_sums(d, q, k, part)
        weight = math.exp(d.weights[q, j] - d.heaviest)
        deviation = _size_deviation(a, b, d.sums[T, q, k], d.blocks[k, N])
        d.exceedance += weight * normal_probability((a / b - x) / deviation)


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
def take_block(memory: Any, elapsed: float, begin: float, end: float, g: float, deviation: float) -> None:
    """Add the estimate of a block to the record `memory` (1,) of a detector (`take_estimate`)."""
    take_estimate(memory[0], elapsed, begin, end, g, deviation)


@large_law
def weigh_onsets(d: Any) -> None:
    """Compute the likelihood ratio of a step at each stored onset, and their sum, the evidence (`weigh_onset`)."""
    start_evidence(d)
    for j in range(int(d.n_onsets)):
        weigh_onset(d, j)


@kernel
def weigh_all(memory: Any, min_log_e: float) -> None:
    """Weigh all onsets and sum their evidence, unless a quick bound of log M is at most `min_log_e`."""
    d = memory[0]
    if limit_log_e(d) <= min_log_e:
        d.log_e = LOG_ZERO
        return
    weigh_onsets(d)
    finish_evidence(d)
    find_onset_interval(d)


@kernel
def find_bound(memory: Any) -> float:
    """Weigh all onsets, and compute the bound of an undetected rise."""
    d = memory[0]
    weigh_onsets(d)
    start_bound(d)
    for k in range(BISECTIONS + 1):
        x = 0.5 * (d.low + d.high) if k > 0 else 0.0
        for j in range(int(d.n_onsets)):
            add_exceedance(d, j, x)
        bisect_bound(d)
    return float(d.bound)
