"""Detect a step of a coefficient in a stream: an e-detector over all onsets, with a random walk of any size.

Each block gives an estimate g_k of the coefficient with a variance V_k. In a healthy machine the level of g follows a
random walk. Given the earlier blocks, the innovations e_k of its Kalman filter have the variance kappa S_k with kappa
unknown, and so follow Student's t. A step of size delta at block j adds f_k delta to e_k, where f is the filter's
response to a step, which may begin within block j (`PARTS`). With a = sum f e / S, b = sum f^2 / S, T = sum e^2 / S
and n innovations, and with delta ~ N(0, v kappa) and kappa integrated, the likelihood ratio is

    R_j = (1 + v b)^(-1/2) (1 - a^2 / ((b + 1/v) T))^(-n/2).

It is counted only where a > 0, which makes it smaller. The walk's size q is one of `WALKS`. What was known of q
before block j is its prior pi_j, in which each size keeps some probability, as the walk may change. Numerator and
denominator are both averaged over it:

    M_k = sum_j  sum_q pi_j(q) p_q(e_j..e_k) mean_v R_j  /  sum_q pi_j(q) p_q(e_j..e_k).

This is an e-detector for any level and noise: E[M at a stopping time] <= E[blocks until then]. An alarm where M >
1/alpha therefore occurs at most once in 1/alpha blocks of a healthy machine. Fewer onsets only make M smaller, and so
old onsets are thinned out, which bounds the memory.

Sources: J. Shin, A. Ramdas, A. Rinaldo, arXiv 2203.03532 (e-detectors); A. S. Willsky and H. L. Jones, IEEE Trans.
Automat. Contr. 21 (1976) 108 (step in a filter).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.onset import BOUND_PROBABILITY, Interval, bound_steps
from sealscope.diagnosis.live.rise import STEP, LiveRise
from sealscope.diagnosis.priors.live import LIVE
from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.storage.plain_state import restore_attributes, save_attributes

_PRIORS = LIVE.step
#: q of the module: variances of the walk in a block, over that of the first block's estimate (q, 1).
WALKS = np.array(_PRIORS.walks)[:, None]
#: v of the module: variances of the step's size; fractions of its first block in which the leak is open.
SIZES = np.array(_PRIORS.sizes)
PARTS = np.array(_PRIORS.parts)
#: Standard deviations beyond which an innovation is a step, not the walk; weight of earlier innovations per block.
JUMP, MEMORY = LIVE.coefficients.jump, _PRIORS.memory
#: All onsets of the last `RECENT` blocks are stored, then `RECENT / 4` of each doubling of age, up to `HORIZON` blocks.
RECENT, HORIZON = _PRIORS.recent, _PRIORS.horizon
#: Largest number of a block, in the unit of the first block, whose square fits into a float.
_MAX_NUMBER = 1e60
#: Smallest square of an innovation over its variance: repeated samples have none, and log 0 is not a number.
_MIN_SQUARE = 1e-12
#: Innovations after which the walks' probabilities are updated, and onsets begin.
_N_WARM = 4
#: Blocks between two selections of the onsets.
_SELECT_EVERY = 8
#: Rows of the sums over innovations, for each walk and onset: 1 - f of the next block, a, b, T, and log pi of the onset
#: with the likelihood of what came before it.
_REST, _A, _B, _T, _LOG_PRIOR = range(5)
_SAVED = tuple(f"_{name}" for name in ("level", "level_variance", "squares", "log_weights", "log_variances", "sums",
                                       "onsets", "unit", "count", "blocks", "end"))  # fmt: skip


class StepDetector:
    """Detect an increase of one coefficient from its estimates block by block, in bounded memory.

    In a healthy machine the coefficient follows a random walk, whose size q is unknown. For each of several sizes a
    Kalman filter predicts the next estimate. The detector sums the evidence of a step for each size q and each
    possible onset j. The module's docstring gives the formulas, whose symbols are used here.

    `_level` and `_level_variance` are the state of each filter. `_squares` and `_count` are T and n of the
    innovations, with fading memory, `_log_weights` the log probability of q, and `_log_variances` the sum of log S.
    `_sums` (5, q, j) has the rows `_REST` to `_LOG_PRIOR`. `_onsets` (j, 4) holds for each onset the number of
    innovations since, the number of its block, its time and the begin of its block [s]. `_unit` is the standard
    deviation of the first block, the unit in which estimates are stored.
    """

    def __init__(self) -> None:
        self._unit, self._count, self._blocks = 0.0, 0.0, 0
        self._level, self._level_variance, self._squares, self._log_variances = np.zeros((4, *WALKS.shape))
        self._log_weights = np.full(WALKS.shape, -np.log(len(WALKS)))
        self.forget()

    def forget(self) -> None:
        """Drop the evidence of all blocks so far, and keep the learned noise and random walk.

        Rises that may have begun in these blocks are not detected any more.
        """
        self._end = -np.inf
        self._sums, self._onsets = np.zeros((5, len(WALKS), 0)), np.zeros((0, 4))

    def is_representable(self, g: float, deviation: float) -> bool:
        """Test whether the squares of an estimate `g` and of its standard `deviation` can be stored as floats."""
        unit = self._unit or deviation
        return unit > 0.0 and abs(g) < _MAX_NUMBER * unit and unit / _MAX_NUMBER < deviation < _MAX_NUMBER * unit

    def take(self, begin: float, end: float, g: float, deviation: float) -> None:
        """Update the evidence of a step by the estimate `g` of the coefficient in the next block.

        `begin` and `end` [s] are the limits of the block, and `deviation` is the standard error of `g`. Let e be the
        innovation, i.e. g minus its prediction by the Kalman filter for a random walk, S its variance, and f the effect
        of a unit step on it. Then for each size of the walk and each possible onset, a += f e / S, b += f^2 / S and T
        += e^2 / S. The first block after `forget` only sets the level of the filter.
        """
        self._unit = self._unit or deviation
        g, variance = g / self._unit, (deviation / self._unit) ** 2
        self._blocks += 1
        elapsed_blocks, self._end = (begin - self._end) / (end - begin) + 1.0, end
        if not np.isfinite(elapsed_blocks):  # the first block after `forget`
            self._level[:], self._level_variance[:] = g, variance
            return
        level_variance = self._level_variance + WALKS * max(elapsed_blocks, 1.0)
        innovation, innovation_variance = g - self._level, level_variance + variance
        gain = level_variance / innovation_variance
        new_parts = PARTS if self._count >= _N_WARM else PARTS[:0]
        if len(new_parts):
            self._add_onsets(begin, end)
        # f: the whole step less what the filter has followed of it
        response = 1.0 - self._sums[_REST]
        response[:, len(self._onsets) - len(new_parts) :] = new_parts
        self._sums[_REST] += gain * response
        self._sums[_A] += response / innovation_variance * innovation
        self._sums[_B] += response / innovation_variance * response
        self._sums[_T] += innovation**2 / innovation_variance
        self._onsets[:, 0] += 1.0
        self._update_walks(innovation_variance, innovation**2 / innovation_variance)
        self._level = self._level + gain * innovation
        self._level_variance = gain * variance

    def _update_walks(self, variance: Array, square: Array) -> None:
        """Update the scale of the noise and the probability of each size of the random walk after a block.

        For each of the sizes, q in number, a Kalman filter has given the innovation e of the block (measured minus
        predicted estimate) and its variance S. `variance` (q, 1) is S, and `square` (q, 1) is e^2 / S.
        """
        square = np.maximum(square, _MIN_SQUARE)
        if self._count >= _N_WARM:
            # clipped, as a jump is a step and says nothing of noise and walk
            square = np.minimum(square, JUMP**2 * self._squares / self._count)
            # log density of Student's t, the probabilities flattened by the memory
            log_weights = MEMORY * self._log_weights - 0.5 * np.log(variance * self._squares)
            log_weights -= 0.5 * (self._count + 1.0) * np.log1p(square / self._squares)
            self._log_weights = log_weights - np.logaddexp.reduce(log_weights, axis=0)
        self._squares = MEMORY * self._squares + square
        self._count = MEMORY * self._count + 1.0
        self._log_variances = self._log_variances + np.log(variance)

    def _add_onsets(self, begin: float, end: float) -> None:
        """Add possible onsets of a step in the block from `begin` to `end` [s]; thin out old ones.

        There is one for each of `PARTS`, the fractions of the block in which the leak is open.
        """
        sums = np.zeros((5, len(WALKS), len(PARTS)))
        log_prior = np.logaddexp(np.log1p(-_PRIORS.changes) + self._log_weights, np.log(_PRIORS.changes / len(WALKS)))
        # pi_j(q) p_q(e_j..e_k) = exp(sums[_LOG_PRIOR]) T_k^(-n/2) prod S^(-1/2), up to a factor equal for all q
        sums[_T] = self._squares
        sums[_LOG_PRIOR] = log_prior + 0.5 * (self._count * np.log(self._squares) + self._log_variances)
        onsets = np.array([[self._count, self._blocks, end - part * (end - begin), begin] for part in PARTS])
        self._sums = np.concatenate([self._sums, sums], axis=2)
        self._onsets = np.concatenate([self._onsets, onsets])
        if self._blocks % _SELECT_EVERY == 0:
            is_selected = _select_onsets(self._blocks, self._onsets)
            self._sums, self._onsets = self._sums[:, :, is_selected], self._onsets[is_selected]

    def log_e(self, min_log_e: float = -np.inf) -> float:
        """Compute the logarithm of the evidence M that the coefficient has risen.

        M is the sum over all possible onsets of the likelihood ratio of a step to no step, averaged over the size of
        the random walk, the prior variance of the step and the part of the first block. In a healthy machine the mean
        number of blocks until M exceeds A is at least A. The result is minus infinity if no rise can have begun yet,
        or if a quick upper bound of log M is at most `min_log_e`.
        """
        if not len(self._onsets):
            return -np.inf
        a, b, T = self._sums[_A : _T + 1]
        explained = np.minimum(np.maximum(a, 0.0) ** 2 / (b * T), 1.0 - 1e-15)  # fraction of T, by the best size
        max_log_ratio = -0.5 * float(np.min(self._onsets[:, 0] * np.log1p(-explained)))
        if max_log_ratio + np.log(len(self._onsets) / len(PARTS)) <= min_log_e:
            return -np.inf
        return float(np.logaddexp.reduce(self._log_terms().ravel()))

    def _log_likelihoods(self) -> Array:
        """Compute the log likelihood (q, j) of each random walk q, given no step since each onset j.

        The prior of the walk at the onset is included. A constant equal for all q is left out.
        """
        n, log_T = self._onsets[:, 0], np.log(self._sums[_T])
        return np.asarray(self._sums[_LOG_PRIOR] - 0.5 * (n * log_T + self._log_variances))

    def _step_log_ratios(self) -> Array:
        """Compute the log likelihood ratios (v, q, j) of a step of the coefficient against none.

        v is the prior variance of the step's size (`SIZES`), q the variance of the random walk in a block (`WALKS`),
        and j the onset. With the sums a, b and T over the n innovations since the onset, which `take` updates,

            R = (1 + v b)^(-1/2) (1 - max(a, 0)^2 / ((b + 1/v) T))^(-n/2).
        """
        a, b, T = self._sums[_A : _T + 1]
        v = SIZES[:, None, None]
        explained = np.maximum(a, 0.0) ** 2 / ((b + 1.0 / v) * T)
        return np.asarray(-0.5 * (np.log1p(v * b) + self._onsets[:, 0] * np.log1p(-explained)))

    def _log_terms(self) -> Array:
        """Compute the logarithms (v, q, j) of the terms whose sum is the evidence that the coefficient has risen.

        A term is the likelihood ratio of a step to no step, for a prior variance v of the step (`SIZES`), a variance q
        of the random walk (`WALKS`) and an onset j, times the posterior probability of q without a step, over the
        numbers of v and of `PARTS`. It is 0, and its logarithm -inf, for a step down.
        """
        likelihoods = self._log_likelihoods()
        total = np.logaddexp.reduce(likelihoods, axis=0) + np.log(len(SIZES) * len(PARTS))
        return np.asarray(np.where(self._sums[_A] > 0.0, self._step_log_ratios(), -np.inf) + likelihoods - total)

    def rise(self) -> LiveRise:
        """Estimate the onset [s] and the size of a rise of the coefficient, in the coefficient's unit.

        Both are averages over the variance of the random walk in a block (`WALKS`), the possible onsets, and the prior
        variance of the step's size (`SIZES`), weighted by their posterior probabilities. The onset has a 95 % interval,
        and the size a standard deviation.
        """
        terms = self._log_terms()
        log_e = float(np.logaddexp.reduce(terms.ravel()))
        weights = np.exp(terms - log_e)
        a, b, T = self._sums[_A : _T + 1]
        precision = b + 1.0 / SIZES[:, None, None]
        sizes, freedom = a / precision, np.maximum(self._onsets[:, 0] - 2.0, 1.0)
        variances = np.maximum(T - a * sizes, 0.0) / freedom / precision
        size = float((weights * sizes).sum())
        deviation = float(np.sqrt((weights * (variances + (sizes - size) ** 2)).sum()))
        probabilities = weights.sum(axis=(0, 1))  # of the onsets
        onsets, begins = self._onsets[:, 2:].T
        order = np.argsort(onsets, kind="stable")
        low_index, high_index = np.searchsorted(np.cumsum(probabilities[order]), [0.025, 0.975])
        latest = onsets[order[min(high_index, len(order) - 1)]]
        resolution = float((onsets - begins)[-len(PARTS)]) / len(PARTS)  # about a part of a block
        mean = float(probabilities @ onsets)
        interval = Interval(mean, float(onsets[order[low_index]]) - resolution, float(latest) + resolution)
        return LiveRise(STEP, 2.0 * log_e, interval, self._unit * size, self._unit * deviation)

    def bound(self, probability: float = BOUND_PROBABILITY) -> float:
        """Compute an upper bound of an undetected rise of the coefficient, in the coefficient's unit.

        The bound is the quantile, at `probability`, of the rise under the condition that it is positive. It is
        infinite until there have been enough blocks in which a rise may begin.
        """
        if not len(self._onsets):
            return np.inf
        a, b, T = self._sums[_A : _T + 1]
        sizes, log_likelihoods = a / b, self._log_likelihoods()
        deviations = np.sqrt(np.maximum(T - a * sizes, np.finfo(float).tiny) / self._onsets[:, 0] / b)
        log_weights = log_likelihoods - np.logaddexp.reduce(log_likelihoods, axis=0)
        log_weights = log_weights + np.logaddexp.reduce(self._step_log_ratios(), axis=0)
        weights = np.exp(log_weights - log_weights.max())
        return self._unit * bound_steps(weights.ravel(), sizes.ravel(), deviations.ravel(), probability)

    @property
    def noise(self) -> float:
        """Variance of the estimates' prediction errors (innovations) over the variance that the Kalman filter predicts.

        The filter is the one whose random walk has a variance per block of a tenth of the first estimate's variance.
        The ratio is averaged over the blocks, with fading memory, and over `stated` more ones (`priors.toml`) with the
        ratio 1.
        """
        walk = 3  # index in `WALKS`
        return float((self._squares[walk, 0] + _PRIORS.stated) / (self._count + _PRIORS.stated))

    def state(self) -> dict[str, Any]:
        """Return the evidence of the detector as plain values for JSON, which `load_state` restores."""
        return save_attributes(self, _SAVED)

    def load_state(self, state: Any) -> None:
        """Restore the evidence saved by `state`, so that later results are identical to the last bit.

        Raises InputError if it does not fit.
        """
        restore_attributes(self, _SAVED, state)
        if self._sums.shape[2] != len(self._onsets):
            raise InputError(f"saved state's onsets must be {len(self._onsets)}, got {self._sums.shape[2]}")


def _select_onsets(block: int, onsets: Array) -> NDArray[np.bool_]:
    """Flag the possible onsets of a step to keep, (j,): all of the last `RECENT` blocks, and fewer of older blocks.

    Older onsets are kept only at the start of a block, on a grid of blocks that becomes coarser with age, up to the
    age `HORIZON`. `block` is the number of the present block. `onsets` (j, 4) holds for each onset the number of
    innovations since, the number of its block, its time and the begin of its block [s].
    """
    _, onset_block, onset, block_start = onsets.T
    age = block - onset_block
    n_doublings = np.ceil(np.log2(np.maximum(age / RECENT, 1.0)))
    spacing = 2.0 * 2.0**n_doublings  # blocks; RECENT/4 onsets in each doubling of age
    return np.asarray((age < RECENT) | ((onset_block % spacing == 0) & (age < HORIZON) & (onset <= block_start)))
