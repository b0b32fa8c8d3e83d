"""Detect a step of a coefficient in a stream: an e-detector over all onsets, with a random walk of any size.

Each block k gives an estimate g_k of the coefficient with a variance V_k. In a healthy machine the level of g follows
a random walk, whose increment in a block has the variance q. The Kalman filter for this walk predicts g_k from the
earlier blocks. Its prediction errors (innovations) e_k have the variance kappa S_k with an unknown scale kappa, and so
follow Student's t. A step of size delta that begins in block j adds f_k delta to e_k, where f is the filter's response
to a unit step; the step may begin within block j (`PARTS`). Let a = sum f e / S, b = sum f^2 / S and T = sum e^2 / S,
where T is over n innovations, including those before block j with fading memory. With the prior delta ~ N(0, v kappa)
and kappa integrated out, the likelihood ratio of the step to no step is

    R_j = (1 + v b)^(-1/2) (1 - a^2 / ((b + 1/v) T))^(-n/2).

R_j is set to 0 unless a > 0, as only rises count. q is one of `WALKS`. Its prior pi_j is the probability of each q
given the blocks before j; a small part is shared equally by all q, as the walk may change. With the likelihood
p_q(e_j..e_k) of the innovations without a step, numerator and denominator are both averaged over q:

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
from sealscope.storage.plain_state import SavedAttributes

_PRIORS = LIVE.step
#: q of the module's docstring: variances of the walk in a block, over that of the first block's estimate; shape (q, 1).
WALKS = np.array(_PRIORS.walks)[:, None]
#: Index of the walk whose filter measures the noise: in each block, a tenth of the first estimate's variance.
_NOISE_WALK = _PRIORS.walks.index(0.1)
#: v of the module's docstring: prior variances of the step's size, in the same unit.
SIZES = np.array(_PRIORS.sizes)
#: Fractions of the step's first block in which the leak is open.
PARTS = np.array(_PRIORS.parts)
#: Factor per block by which the weight of earlier innovations decays.
MEMORY: float = _PRIORS.memory
#: All onsets of the last `RECENT` blocks are stored, then `RECENT / 4` of each doubling of age, up to `HORIZON` blocks.
RECENT, HORIZON = _PRIORS.recent, _PRIORS.horizon
#: Largest estimate, in the unit of the first block, whose square fits into a float.
_MAX_NUMBER = 1e60
#: Lower limit of an innovation's square over its variance; repeated samples give 0, whose logarithm is not finite.
_MIN_SQUARE = 1e-12
#: Number of innovations from which on onsets are possible, and the probabilities of the walks are updated.
_N_WARM = 4
#: Number of blocks from one thinning of the onsets to the next.
_SELECT_EVERY = 8
#: Rows of the sums over innovations, for each walk and onset: part of a unit step that the filter has followed (1 - f
#: of the next block), a, b, T, and log pi_j minus the log likelihood of the blocks before the onset (`_add_onsets`).
_FOLLOWED, _A, _B, _T, _LOG_PRIOR = range(5)
_N_ROWS = _LOG_PRIOR + 1
#: Columns of the onsets: n of the innovations in T, number of the block, time, begin of the block [s], and log evidence
#: of the blocks before it (`StepDetector._log_evidence`).
_N, _BLOCK, _TIME, _BLOCK_BEGIN, _EVIDENCE = range(5)


class StepDetector(SavedAttributes):
    """Detect an increase of one coefficient from its estimates block by block, in bounded memory.

    The module's docstring gives the formulas, whose symbols are used here. Attributes, of which arrays have a row for
    each variance q of the coefficient's random walk in a block:

    - `_level`, `_level_variance`: state of each Kalman filter,
    - `_squares`, `_count`: T and n of all innovations, with fading memory,
    - `_log_weights`: log probability of each q,
    - `_log_variances`: sum of log S over all innovations,
    - `_sums` (5, q, j): rows `_FOLLOWED` to `_LOG_PRIOR` for each onset j,
    - `_onsets` (j, 5): columns `_N` to `_EVIDENCE` for each onset,
    - `_log_evidence`: log probability density of all innovations since `forget` without a step, where q may change,
    - `_unit`: standard deviation of the first block, the unit in which estimates are stored,
    - `_blocks`: number of blocks,
    - `_end`: end of the last block [s], minus infinity after `forget`.
    """

    SAVED = (
        *("_level", "_level_variance", "_squares", "_log_weights", "_log_variances", "_sums", "_onsets"),
        *("_unit", "_count", "_blocks", "_end", "_log_evidence"),
    )

    def __init__(self) -> None:
        self._unit, self._count, self._blocks = 0.0, 0.0, 0
        self._level, self._level_variance, self._squares, self._log_variances = np.zeros((4, *WALKS.shape))
        self._log_weights = np.full(WALKS.shape, -np.log(len(WALKS)))
        self.forget()

    def forget(self) -> None:
        """Drop the evidence of all blocks so far, and keep the learned noise and random walk."""
        self._end, self._log_evidence = -np.inf, 0.0
        self._sums, self._onsets = np.zeros((_N_ROWS, len(WALKS), 0)), np.zeros((0, _EVIDENCE + 1))

    def is_representable(self, g: float, deviation: float) -> bool:
        """Return True if an estimate `g` and its standard `deviation` > 0 can be squared without overflow."""
        unit = self._unit or deviation  # estimates are stored in the unit of the first block's deviation
        return unit > 0.0 and abs(g) < _MAX_NUMBER * unit and unit / _MAX_NUMBER < deviation < _MAX_NUMBER * unit

    def take(self, begin: float, end: float, g: float, deviation: float) -> None:
        """Update the evidence of a step by the estimate `g` of the coefficient in the block from `begin` to `end` [s].

        `deviation` is the standard error of `g`. The first block after `forget` only sets the level of the filters.
        """
        self._unit = self._unit or deviation  # deviation of the first block, the unit of stored estimates
        g, variance = g / self._unit, (deviation / self._unit) ** 2
        self._blocks += 1
        elapsed_blocks = (begin - self._end) / (end - begin) + 1.0  # between the ends of the last block and this one
        self._end = end
        if not np.isfinite(elapsed_blocks):  # the first block after `forget`
            self._level[:], self._level_variance[:] = g, variance
            return
        level_variance = self._level_variance + WALKS * max(elapsed_blocks, 1.0)  # 1: should blocks overlap
        e, S = g - self._level, level_variance + variance  # innovation and its variance
        gain = level_variance / S
        square = e**2 / S
        may_begin = self._count >= _N_WARM
        if may_begin:
            log_prior = self._log_walk_prior()
            self._add_onsets(begin, end, log_prior)
            self._log_evidence += float(np.logaddexp.reduce((log_prior + self._log_density(S, square)).ravel()))
        f = 1.0 - self._sums[_FOLLOWED]
        if may_begin:  # a step that begins in this block (the last onsets) acts in a part of the block
            f[:, -len(PARTS) :] = PARTS
        self._sums[_FOLLOWED] += gain * f
        self._sums[_A] += f / S * e
        self._sums[_B] += f / S * f
        self._sums[_T] += square
        self._onsets[:, _N] += 1.0
        self._update_walks(S, square)
        self._level = self._level + gain * e
        self._level_variance = gain * variance

    def _update_walks(self, variance: Array, square: Array) -> None:
        """Update the noise (`_squares`, `_count`) and the probability of each random walk by the data of a block.

        `variance` (q, 1) is S, the variance of the innovation e under each walk, and `square` (q, 1) is e^2 / S.
        """
        square = np.maximum(square, _MIN_SQUARE)
        if self._count >= _N_WARM:
            # clipped, as a large innovation is a step, which must not count as noise or walk
            square = np.minimum(square, LIVE.coefficients.jump**2 * self._squares / self._count)
            # Bayes' rule with the log density of Student's t; the earlier probabilities fade
            log_weights = MEMORY * self._log_weights - 0.5 * np.log(variance * self._squares)
            log_weights -= 0.5 * (self._count + 1.0) * np.log1p(square / self._squares)
            self._log_weights = log_weights - np.logaddexp.reduce(log_weights, axis=0)
        self._squares = MEMORY * self._squares + square
        self._count = MEMORY * self._count + 1.0
        self._log_variances = self._log_variances + np.log(variance)

    def _log_walk_prior(self) -> Array:
        """Compute log pi (q, 1) for the next block: the walk may change, and then all `WALKS` are equally likely."""
        stays, changes = np.log1p(-_PRIORS.changes) + self._log_weights, np.log(_PRIORS.changes / len(WALKS))
        return np.asarray(np.logaddexp(stays, changes))

    def _log_density(self, variance: Array, square: Array) -> Array:
        """Compute the log density (q, 1) of a block's innovation given the earlier ones, Student's t with n = `_count`.

        `variance` (q, 1) is S and `square` (q, 1) is e^2 / S.
        """
        n = self._count
        scale = _log_normalisation(n + 1.0) - _log_normalisation(n)
        return np.asarray(
            scale - 0.5 * np.log(variance * self._squares) - 0.5 * (n + 1.0) * np.log1p(square / self._squares)
        )

    def _add_onsets(self, begin: float, end: float, log_prior: Array) -> None:
        """Add possible onsets of a step, one for each of `PARTS`, in the block from `begin` to `end` [s].

        `log_prior` (q, 1) is log pi_j.
        """
        # T begins with its value before the onset; the log likelihood until then is subtracted from the log prior, so
        # that only later innovations count in `_log_likelihoods`
        sums = np.zeros((_N_ROWS, len(WALKS), len(PARTS)))
        sums[_T] = self._squares
        sums[_LOG_PRIOR] = log_prior + 0.5 * (self._count * np.log(self._squares) + self._log_variances)
        onsets = np.array(
            [[self._count, self._blocks, end - part * (end - begin), begin, self._log_evidence] for part in PARTS]
        )
        self._sums = np.concatenate([self._sums, sums], axis=2)
        self._onsets = np.concatenate([self._onsets, onsets])
        if self._blocks % _SELECT_EVERY == 0:
            is_selected = _select_onsets(self._blocks, self._onsets)
            self._sums, self._onsets = self._sums[:, :, is_selected], self._onsets[is_selected]

    def log_e(self, min_log_e: float = -np.inf) -> float:
        """Compute log M, the evidence that the coefficient has risen.

        The result is -inf if no rise can have begun yet, or if a quick bound of log M is at most `min_log_e`.
        """
        if not len(self._onsets):
            return -np.inf
        a, b, T = self._sums[_A : _T + 1]
        # fraction of T that a step of the best size explains, less than 1 so that its logarithm is finite
        explained = np.minimum(np.maximum(a, 0.0) ** 2 / (b * T), 1.0 - 1e-15)
        max_log_ratio = -0.5 * float(np.min(self._onsets[:, _N] * np.log1p(-explained)))
        # M is at most the largest ratio times the number of onsets, each of which has the prior 1/len(PARTS)
        if max_log_ratio + np.log(len(self._onsets) / len(PARTS)) <= min_log_e:
            return -np.inf
        return float(np.logaddexp.reduce(self._log_terms().ravel()))

    def _log_likelihoods(self) -> Array:
        """Compute the log of prior times likelihood (q, j) of each random walk q, given no step since each onset j.

        All n innovations have the log likelihood -(n log T + sum of log S) / 2, up to a constant equal for all q. The
        row `_LOG_PRIOR` subtracts that of the innovations before the onset (`_add_onsets`).
        """
        n, log_T = self._onsets[:, _N], np.log(self._sums[_T])
        return np.asarray(self._sums[_LOG_PRIOR] - 0.5 * (n * log_T + self._log_variances))

    def _step_log_ratios(self) -> Array:
        """Compute log R (v, q, j), the log likelihood ratio of a rise to no step, for `SIZES`, `WALKS` and onsets."""
        a, b, T = self._sums[_A : _T + 1]
        v = SIZES[:, None, None]
        explained = np.maximum(a, 0.0) ** 2 / ((b + 1.0 / v) * T)
        return np.asarray(-0.5 * (np.log1p(v * b) + self._onsets[:, _N] * np.log1p(-explained)))

    def _log_terms(self) -> Array:
        """Compute the logarithms (v, q, j) of the terms whose sum is M, -inf for a step down.

        `SIZES` and `PARTS` are equally likely each.
        """
        likelihoods = self._log_likelihoods()
        total = np.logaddexp.reduce(likelihoods, axis=0) + np.log(len(SIZES) * len(PARTS))
        return np.asarray(np.where(self._sums[_A] > 0.0, self._step_log_ratios(), -np.inf) + likelihoods - total)

    def rise(self) -> LiveRise:
        """Estimate the onset [s] and the size of a rise, as posterior means over `SIZES`, `WALKS` and onsets.

        Onset j has the likelihood of all innovations: that of those before j without a step (`_log_evidence`), and that
        of the others with a step. The terms of M cannot be compared between onsets, as their denominators differ. Each
        onset stands for the time up to its neighbours, as old ones are thinned out.
        """
        a, b, T = self._sums[_A : _T + 1]
        n, n_since = self._onsets[:, _N], self._blocks - self._onsets[:, _BLOCK] + 1.0
        log_before = self._onsets[:, _EVIDENCE] + _log_normalisation(n) - _log_normalisation(n - n_since)
        times = self._onsets[:, _TIME]
        order = np.argsort(times, kind="stable")
        spacing = np.empty_like(times)
        spacing[order] = np.maximum(np.gradient(times[order]), np.finfo(float).tiny)  # of the onsets [s]
        log_weights = np.where(a > 0.0, self._step_log_ratios(), -np.inf) + self._log_likelihoods()
        log_weights += log_before + np.log(spacing)
        weights = np.exp(log_weights - np.logaddexp.reduce(log_weights.ravel()))  # posterior probabilities (v, q, j)
        # mean and variance of the size's posterior, Student's t, for each v, q and j
        precision = b + 1.0 / SIZES[:, None, None]
        sizes = a / precision
        freedom = np.maximum(self._onsets[:, _N] - 2.0, 1.0)  # the variance is n/(n - 2) times the squared scale
        variances = np.maximum(T - a * sizes, 0.0) / freedom / precision
        size = float((weights * sizes).sum())
        deviation = float(np.sqrt((weights * (variances + (sizes - size) ** 2)).sum()))
        onset_probabilities = weights.sum(axis=(0, 1))
        # an index may be one too high by rounding of the cumulative sum
        indices = np.searchsorted(np.cumsum(onset_probabilities[order]), [0.025, 0.975]).clip(max=len(order) - 1)
        first, last = order[indices]
        interval = Interval(
            float(onset_probabilities @ times),
            float(times[first] - spacing[first]),
            float(times[last] + spacing[last]),
        )
        return LiveRise(STEP, 2.0 * self.log_e(), interval, self._unit * size, self._unit * deviation)

    def bound(self) -> float:
        """Compute the 95 % upper bound of an undetected rise of the coefficient, in the coefficient's unit.

        It is a quantile of the posterior of the rise, limited to rises > 0, and infinite until there have been enough
        blocks to test for a rise.
        """
        if not len(self._onsets):
            return np.inf
        a, b, T = self._sums[_A : _T + 1]
        # least-squares size of a step at each onset and for each walk, and its standard error; b > 0, as already
        # the first block after the onset responds to a step
        sizes = a / b
        residual_squares = np.maximum(T - a * sizes, np.finfo(float).tiny)
        deviations = np.sqrt(residual_squares / self._onsets[:, _N] / b)
        # weight of each walk and onset: probability of the walk times the likelihood ratio of the step
        likelihoods = self._log_likelihoods()
        log_walk_probabilities = likelihoods - np.logaddexp.reduce(likelihoods, axis=0)
        log_weights = log_walk_probabilities + np.logaddexp.reduce(self._step_log_ratios(), axis=0)
        weights = np.exp(log_weights - log_weights.max())
        return self._unit * bound_steps(weights.ravel(), sizes.ravel(), deviations.ravel(), BOUND_PROBABILITY)

    @property
    def noise(self) -> float:
        """Ratio of the actual to the predicted variance of the innovations, by the filter with the walk `_NOISE_WALK`.

        It is averaged over the blocks with fading memory, and with `step.stated` (`priors.toml`) blocks of the ratio 1.
        """
        return float((self._squares[_NOISE_WALK, 0] + _PRIORS.stated) / (self._count + _PRIORS.stated))

    def load_state(self, state: Any) -> None:
        """Restore the evidence that `state` saved; raise InputError if it does not fit."""
        super().load_state(state)
        if self._sums.shape[2] != len(self._onsets):
            raise InputError(f"saved state's onsets must be {len(self._onsets)}, got {self._sums.shape[2]}")


def _log_normalisation(n: Any) -> Any:
    """Compute log Gamma(n/2) - n/2 log(pi): its difference between two n is the log factor of Student's t."""
    from scipy.special import gammaln

    return gammaln(0.5 * n) - 0.5 * n * np.log(np.pi)


def _select_onsets(block: int, onsets: Array) -> NDArray[np.bool_]:
    """Select the possible onsets of a step to keep, as flags (j,): all of the last `RECENT` blocks, and fewer of older.

    Older onsets are kept only at the start of a block, on a grid of blocks that becomes coarser with age, up to the age
    `HORIZON`. `block` is the present block's number; `onsets` (j, 5) is as in `StepDetector`.
    """
    _, onset_block, time, block_begin, _ = onsets.T
    age = block - onset_block
    n_doublings = np.ceil(np.log2(np.maximum(age / RECENT, 1.0)))
    spacing = 2.0 * 2.0**n_doublings  # blocks; RECENT/4 onsets in each doubling of age
    is_on_grid = (onset_block % spacing == 0) & (time <= block_begin)
    return np.asarray((age < RECENT) | (is_on_grid & (age < HORIZON)))
