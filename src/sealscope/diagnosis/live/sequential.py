"""Detect a step of a coefficient in a stream: an e-detector over all onsets, with a random walk of any size.

Each block k gives an estimate g_k of the coefficient with a variance V_k. In a healthy machine the level of g follows
a random walk, whose increment in a block has the variance q. The Kalman filter for this walk predicts g_k from the
earlier blocks. Its prediction errors (innovations) e_k have the variance kappa S_k with an unknown scale kappa, and so
follow Student's t. A step of size delta that begins in block j adds f_k delta to e_k, where f is the filter's response
to a unit step; the step may begin within block j (`PARTS`). Let a = sum f e / S, b = sum f^2 / S and T = sum e^2 / S,
where T is over n innovations, including those before block j with fading memory. With a half-normal prior on delta of
the variance v kappa, and kappa integrated out, the likelihood ratio of the step to no step is about

    R_j = 2 (1 + v b)^(-1/2) exp(r^2/2) Phi(r),    r^2 = -n log(1 - a^2 / ((b + 1/v) T)),

with the normal distribution function Phi (`estimate.change`). Student's would be exact; a test shows that E[R_j] <= 1
without a step. R_j is set to 0 unless a > 0. q is one of `WALKS`. Its prior pi_j is the probability of each q
given the blocks before j; a small part is shared equally by all q, as the walk may change. With the likelihood
p_q(e_j..e_k) of the innovations without a step, numerator and denominator are both averaged over q:

    M_k = sum_j  sum_q pi_j(q) p_q(e_j..e_k) mean_v R_j  /  sum_q pi_j(q) p_q(e_j..e_k).

This is an e-detector for any level and noise: E[M at a stopping time] <= E[blocks until then]. An alarm where M >
1/alpha therefore occurs at most once in 1/alpha blocks of a healthy machine. Fewer onsets only make M smaller, and so
old onsets are thinned out, which bounds the memory.

Starts after a rest, oil that warms and other duties depart from a random walk, and raise M. While the baseline is
learned, the largest M of each `WINDOW` blocks is therefore stored (`StepNull`). As for healthy recordings, the
posterior of an inflation (`decision.case`) turns these values into the chance that M rises as high once more, by which
the threshold is set.

The arithmetic is that of kernels on a record of fixed size (`kernel.step`), which controllers run, too.

Sources: J. Shin, A. Ramdas, A. Rinaldo, arXiv 2203.03532 (e-detectors); A. S. Willsky and H. L. Jones, IEEE Trans.
Automat. Contr. 21 (1976) 108 (step in a filter).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from sealscope.diagnosis.decision.case import HealthyNull
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.estimate.special import LOG_ZERO
from sealscope.diagnosis.live.explanation import WINDOW
from sealscope.diagnosis.live.kernel.step import (
    ARRAYS,
    LAYOUT,
    MAX_OLD,
    MAX_RECENT,
    PARTS,
    RECENT,
    WALKS,
    find_bound,
    forget_steps,
    start_step_detector,
    take_block,
    weigh_all,
)
from sealscope.diagnosis.priors.live import LIVE
from sealscope.errors import InputError
from sealscope.storage.plain_state import SavedAttributes, plain_array, require_part, restore_array

#: Names of the tests: for a step within the stream, and for a level above that of the healthy machine.
STEP, LEVEL = "step", "level"


class LiveRise(NamedTuple):
    """An increase of a running machine's leakage conductance, with its test; an `observable.DatedTest`."""

    test: str  # `STEP` or `LEVEL`
    score: float  # score of the test: twice the logarithm of an e-value for a step, a normal quantile for a level
    interval: Interval = Interval(math.nan, math.nan, math.nan)  # onset with its 95 % interval [s]
    # the increase and its standard deviation [m^3/(s Pa)]
    size: float = 0.0
    deviation: float = math.inf

    @property
    def log_chance(self) -> float:
        """Logarithm of the probability that a healthy machine has at least this score in the test.

        For a step the result is an upper bound, -score/2 by Ville's inequality. For a level it follows from the normal
        distribution.
        """
        from scipy.special import log_ndtr

        return -0.5 * max(self.score, 0.0) if self.test == STEP else float(log_ndtr(-self.score))

    @property
    def chance(self) -> float:
        """Probability that a healthy machine has at least this score in the test; for a step an upper bound."""
        return math.exp(self.log_chance)

    def threshold(self, chance: float) -> float:
        """Return the score that a healthy machine exceeds with the probability `chance`, for a step at most."""
        from scipy.special import ndtri

        return -2.0 * math.log(chance) if self.test == STEP else -float(ndtri(chance))

    def onset(self) -> Interval:
        """Return the onset of the increase of the leakage [s] with its 95 % interval."""
        return self.interval

    def detectable_step(self, chance: float) -> float:
        """Return infinity: the smallest step that is detectable depends on the conductance's unknown random walk."""
        return math.inf


__all__ = ["RECENT", "StepDetector"]

_PRIORS = LIVE.step
#: Index of the walk whose filter measures the noise: in each block, a tenth of the first estimate's variance.
_NOISE_WALK = WALKS.index(0.1)
#: Largest estimate, in the unit of the first block, whose square fits into a float.
_MAX_NUMBER = 1e60
#: Saved numbers of the record, whole ones, and arrays of the walks.
_NUMBERS, _WHOLE_NUMBERS = (
    ("unit", "count", "log_evidence", "end"),
    ("n_blocks", "n_onsets", "n_stored", "n_old", "has_level"),
)
_ARRAYS = ("level", "level_variance", "squares", "log_variances", "log_weights")


class StepDetector:
    """Detect an increase of one coefficient from its estimates block by block, in bounded memory.

    The module's docstring gives the formulas, whose symbols are used here. Fields of the record `_memory` (1,), whose
    arrays have an entry for each variance q of the coefficient's random walk in a block:

    - `level`, `level_variance`: state of each Kalman filter,
    - `squares`, `count`: T and n of all innovations, with fading memory,
    - `log_weights`: log probability of each q,
    - `log_variances`: sum of log S over all innovations,
    - `sums` (5, q, b) and `blocks` (b, 5): by the indices of `kernel.step`, for each of `n_stored` blocks b with
      onsets; `firsts` (2, q, b) and `variances` (b,): the same of the recent ones, those but the first `n_old`,
    - `log_evidence`: log probability density of all innovations since `forget` without a step, where q may change,
    - `unit`: standard deviation of the first block, the unit in which estimates are stored,
    - `n_blocks`: number of blocks,
    - `end`: end of the last block [s]; `has_level`: 0 until the first block after `forget`.
    """

    def __init__(self) -> None:
        self._memory = np.zeros(1, LAYOUT)
        start_step_detector(self._memory)

    def forget(self) -> None:
        """Drop the evidence of all blocks so far, and keep the learned noise and random walk."""
        forget_steps(self._memory)

    def _number(self, name: str) -> float:
        """Return the number that the kernel's record stores as `name`."""
        return float(self._memory[name][0])

    def is_representable(self, g: float, deviation: float) -> bool:
        """Return True if an estimate `g` and its standard `deviation` > 0 can be squared without overflow."""
        unit = self._number("unit") or deviation  # estimates are stored in the unit of the first block's deviation
        return unit > 0.0 and abs(g) < _MAX_NUMBER * unit and unit / _MAX_NUMBER < deviation < _MAX_NUMBER * unit

    def take(self, begin: float, end: float, g: float, deviation: float) -> None:
        """Update the evidence of a step by the estimate `g` of the coefficient in the block from `begin` to `end` [s].

        `deviation` is the standard error of `g`. The first block after `forget` only sets the level of the filters.
        """
        elapsed = np.round((begin - self._number("end")) / (end - begin)) + 1.0  # whole blocks, against rounding
        take_block(self._memory, elapsed, begin, end, g, deviation)

    def log_e(self, min_log_e: float = -np.inf) -> float:
        """Compute log M, the evidence that the coefficient has risen.

        The result is -inf if no rise can have begun yet, or if a quick bound of log M is at most `min_log_e`.
        """
        weigh_all(self._memory, max(min_log_e, LOG_ZERO))
        log_e = self._number("log_e")
        return log_e if log_e > LOG_ZERO else -np.inf

    def rise(self) -> LiveRise:
        """Estimate the onset [s] and the size of a rise, as posterior means over sizes, walks and onsets.

        Onset j has the likelihood of all innovations: that of those before j without a step (`log_evidence`), and that
        of the others with a step. The terms of M cannot be compared between onsets, as their denominators differ. Each
        onset stands for the time up to its neighbours, as old ones are thinned out.
        """
        score = 2.0 * self.log_e()
        onset = Interval(*(self._number(name) for name in ("onset", "onset_low", "onset_high")))
        return LiveRise(STEP, score, onset, self._number("size"), self._number("size_deviation"))

    def bound(self) -> float:
        """Compute the 95 % upper bound of an undetected rise of the coefficient, in the coefficient's unit.

        It is a quantile of the posterior of the rise, limited to rises > 0, and infinite until there have been enough
        blocks to test for a rise. Each walk and onset has the probability of the walk times the likelihood ratio of the
        step; its size is the least-squares one with its standard error.
        """
        return find_bound(self._memory) if self._memory["n_onsets"][0] else math.inf

    @property
    def noise(self) -> float:
        """Ratio of the actual to the predicted variance of the innovations, by the filter with the walk `_NOISE_WALK`.

        It is averaged over the blocks with fading memory, and with `step.stated` (`priors.toml`) blocks of the ratio 1.
        """
        squares = float(self._memory["squares"][0, _NOISE_WALK])
        return (squares + _PRIORS.stated) / (self._number("count") + _PRIORS.stated)

    def state(self) -> dict[str, Any]:
        """Return the numbers and arrays to save as plain values for JSON, which `load_state` restores exactly."""
        record = self._memory[0]
        n_stored, n_old = int(record["n_stored"]), int(record["n_old"])
        return {
            **{name: float(record[name]) for name in _NUMBERS},
            **{name: int(record[name]) for name in _WHOLE_NUMBERS},
            **{name: plain_array(record[name]) for name in _ARRAYS},
            **{name: plain_array(record[name][part]) for name, part in _stored_parts(n_stored, n_old).items()},
        }

    def load_state(self, state: Any) -> None:
        """Restore the evidence that `state` saved; raise InputError if it does not fit."""
        memory = np.zeros(1, LAYOUT)
        for name in (*_NUMBERS, *_WHOLE_NUMBERS):
            memory[name] = require_part(state, name, int if name in _WHOLE_NUMBERS else (float, int))
        n_onsets, n_stored, n_old = (int(memory[name][0]) for name in ("n_onsets", "n_stored", "n_old"))
        is_possible = 0 <= n_old <= min(n_stored, MAX_OLD) and n_stored - n_old <= MAX_RECENT
        if not is_possible or n_onsets != n_old + len(PARTS) * (n_stored - n_old):
            raise InputError(f"saved state's n_onsets must fit its blocks, got {n_onsets} of {n_stored}, {n_old} old")
        parts = {**{name: (slice(None),) for name in _ARRAYS}, **_stored_parts(n_stored, n_old)}
        for name, part in parts.items():
            values, shape = restore_array(require_part(state, name, object), name), memory[name][0][part].shape
            if values.shape != shape:
                raise InputError(f"saved state's {name} must have the shape {shape}, got {values.shape}")
            memory[name][0][part] = values
        self._memory = memory


def _stored_parts(n_stored: int, n_old: int) -> dict[str, tuple[slice, ...]]:
    """Return the used part of each array that has an entry for each stored block, by name."""
    recent = slice(n_stored - n_old)
    used = {"sums": slice(n_stored), "firsts": recent, "variances": recent}
    return {
        **{name: (*[slice(None)] * (len(ARRAYS[name]) - 1), size) for name, size in used.items()},
        "blocks": (slice(n_stored),),
    }


_MIN_WINDOWS: int = LIVE.step.windows
_LOG_WINDOW = math.log(WINDOW)


class StepNull(SavedAttributes):
    """Largest evidence of a step in each window of a healthy machine, and the threshold of the alarm that follows.

    If the random walk is right, P(max M > A) <= `WINDOW` / A in a window. The surprisal of a window is therefore u =
    log max M - log `WINDOW`, or 0 if that is negative.
    """

    SAVED = ("_count", "_surprisal", "_highest", "_blocks")

    def __init__(self) -> None:
        self._count, self._surprisal = 0, 0.0  # number of windows, and sum of their surprisals
        # largest log M, at least 0 (`add_window` counts larger ones only), and number of blocks in the present window
        self._highest, self._blocks = 0.0, 0

    def add(self, log_e: float) -> None:
        """Add log M (`log_e`), the evidence of a step after a block of a healthy machine."""
        self._highest = max(self._highest, log_e)
        self._blocks += 1
        if self._blocks == WINDOW:
            self.add_window(self._highest)
            self._highest, self._blocks = 0.0, 0

    def add_window(self, log_e: float) -> None:
        """Add a window of blocks whose largest log M is `log_e`, such as the window of a withdrawn alarm."""
        self._count += 1
        self._surprisal += max(log_e - _LOG_WINDOW, 0.0)

    def log_threshold(self, probability: float) -> float:
        """Compute the threshold of log M, the log e-value of a step, for a false-alarm `probability` per block."""
        return _find_threshold(self._count, self._surprisal, probability)


@lru_cache(maxsize=1024)
def _find_threshold(count: int, surprisal: float, probability: float) -> float:
    """Compute the threshold of log M for a false-alarm `probability` per block: at least -log(probability).

    `count` is the number of windows of a healthy machine, and `surprisal` the sum of their surprisals. With fewer than
    `_MIN_WINDOWS` the threshold is the lower limit, else that of a window with the false-alarm probability `WINDOW` *
    `probability`.
    """
    if count < _MIN_WINDOWS:
        return -math.log(probability)
    null = HealthyNull({STEP: [surprisal / count] * count})  # of the surprisals, only sum and number matter
    # probability of a window, kept below 1 by the limit
    chance = null.uncalibrated_chance(STEP, min(WINDOW * probability, 0.5))
    return max(_LOG_WINDOW - math.log(chance), -math.log(probability))
