"""Mean flow of a leak that begins within a recording, or of the leakage above that of healthy recordings.

A step of the leak's conductance is fitted at each possible onset, with each law of the leak's flow (`leak_law`) and
each growth after the onset: a seal that continues to wear leaks more towards the end, and a leak may grow from nothing.
The flow is a mixture over them, weighted by likelihood and prior (`estimate_step_flow`).

If a leak began or grew within the recording, the rise over healthy recordings contains only a part of it. `fit_rise`
therefore estimates the flow from the rise and from the changes within the recording together, and bounds it if no leak
is found.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.change import Information, StepTest, bound_steps, step_shapes, step_sizes
from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.population import BOUND_PROBABILITY, weigh_alternatives
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.hypotheses import GROWTHS, LAWS
from sealscope.diagnosis.inference.leak_law import apparent_conductances, law_flows, mixture_flow
from sealscope.diagnosis.inference.regimes import normal_log_density
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array

#: Probability of an onset, relative to the most probable one, below which it is omitted.
NEGLIGIBLE = 1e-3
#: Standard error of a step, over that of the prior on its size, above which it counts as unknown.
MAX_ERROR = 1e6
#: Smallest mean flow of a unit step after an onset, over that of other onsets.
MIN_UNIT = 1e-6
_TINY = np.finfo(float).tiny
_FROM_NOTHING: float = INFERENCE.growth.from_nothing
#: The `GROWTHS` of a leak that begins within a recording; a part of those that grow begin from nothing, infinitely.
STEP_GROWTHS: dict[float, float] = {
    **{growth: (1.0 - _FROM_NOTHING if growth else 1.0) * probability for growth, probability in GROWTHS.items()},
    math.inf: _FROM_NOTHING * (1.0 - GROWTHS[0.0]),
}


def _onset_positions(leak: Information, test: StepTest) -> Array:
    """Return the onsets (o,) of `test`, counted in blocks from the start of the recording."""
    # a prior on the level counts as one more block before the first (`StepTest.positions`)
    return test.positions - float(np.isfinite(leak.level))


class _StepFit(NamedTuple):
    """Steps of a leak with one law and one growth, fitted at each of o onsets.

    - `law`: index of the law in `LAWS`; `log_prior`: log probability of the growth;
    - `conductance` (K,): change of the conductance in K blocks by a leak with the coefficient 1 that is older than the
      recording; `course` (K, o): factor on it for each onset and this growth (`step_shapes`);
    - `log_ratio`, `size`, `error` (o,): log likelihood ratio to no step, coefficient and its standard error;
    - `unit_flow` (o,): mean flow after the onset [m^3/s] for a coefficient of 1.
    """

    law: int
    log_prior: float
    conductance: Array
    course: Array
    log_ratio: Array
    size: Array
    error: Array
    unit_flow: Array


def _fit_steps(
    blocks: Blocks, columns: Sequence[ColumnRoles], leak: Information, positions: Array, onsets: NDArray[np.intp]
) -> tuple[list[_StepFit], Array]:
    """Fit a step of the leak with each growth of `STEP_GROWTHS` and each law of `LAWS`, at each of o onsets.

    `positions` (o,): the onsets, counted in blocks; `onsets` (o,): their indices in the step test. Returns the fits,
    and for each onset the fraction of the blocks with a known pressure after it, (o,).
    """
    weights = blocks.pressure_weights / max(float(blocks.pressure_weights.sum()), _TINY)
    part_after = np.maximum(weights @ step_shapes(len(blocks), positions), _TINY)
    conductances, flows, fits = apparent_conductances(blocks, columns), law_flows(blocks), list[_StepFit]()
    for growth, probability in STEP_GROWTHS.items():
        steps = step_shapes(len(blocks), positions, growth)  # (K, o)
        for law, exponent in enumerate(LAWS):
            sizes = step_sizes(leak, onsets, conductances[exponent], growth)
            unit_flow = (weights * flows[exponent]) @ steps / part_after
            fits.append(_StepFit(law, math.log(probability), conductances[exponent], steps, *sizes, unit_flow))
    return fits, part_after


def estimate_step_flow(blocks: Blocks, columns: Sequence[ColumnRoles], leak: Information, test: StepTest) -> Estimate:
    """Estimate the mean flow [m^3/s] of a leak that begins within a recording, from its onset to the end.

    It is the mean over all combinations of law, growth and onset, weighted by their likelihood and, of the priors, only
    that of the growth. `leak`: likelihood of the leak's coefficient in the blocks; `test`: step test of this
    coefficient, whose onsets are used except improbable ones.
    """
    onsets = np.flatnonzero(test.weights > NEGLIGIBLE * test.weights.max())
    fits, _ = _fit_steps(blocks, columns, leak, _onset_positions(leak, test)[onsets], onsets)
    log_weights = np.concatenate([fit.log_prior + fit.log_ratio for fit in fits])
    flows = np.concatenate([fit.size * fit.unit_flow for fit in fits])
    deviations = np.concatenate([fit.error * fit.unit_flow for fit in fits])
    return mixture_flow(weigh_alternatives(log_weights), flows, deviations)


class RiseFits(NamedTuple):
    """Leak above healthy recordings under h hypotheses on its onset, growth and law (`fit_rise`).

    `log_weights` (h,), `log_none`: log probabilities of these and of no leak, up to a constant; `onsets` (h,): onsets
    [s], minus infinity for a leak that is older than the recording; `parts` (h,): fraction of the recording after the
    onset; `flows`, `deviations` (h,): mean flow after the onset and its standard error [m^3/s]; `by_rise` (h,): true if
    the rise shows the leak, false if it is no evidence.
    """

    log_weights: Array
    onsets: Array
    parts: Array
    flows: Array
    deviations: Array
    by_rise: NDArray[np.bool_]
    log_none: float

    @property
    def flow(self) -> Estimate:
        """Mean flow [m^3/s] of the leak that the rise shows, after its onset, averaged over the hypotheses."""
        return self._mean_flow(self.by_rise)

    @property
    def flow_within(self) -> Estimate | None:
        """Mean flow [m^3/s] of a leak that began within the recording, after its onset; None if this is excluded."""
        is_possible = np.isfinite(self.onsets) & np.isfinite(self.log_weights)
        return self._mean_flow(is_possible) if is_possible.any() else None

    def _mean_flow(self, is_counted: NDArray[np.bool_]) -> Estimate:
        """Average the flow [m^3/s] over the hypotheses flagged in `is_counted` (h,)."""
        weights = weigh_alternatives(self.log_weights[is_counted])
        return mixture_flow(weights, self.flows[is_counted], self.deviations[is_counted])

    @property
    def bound(self) -> float:
        """95 % upper bound of the leak's mean flow over the recording [m^3/s], 0 if there is hardly a leak.

        Hypotheses under which the rise is no evidence do not count: the step test covers them.
        """
        from scipy.special import ndtr

        log_weights = np.append(np.where(self.by_rise, self.log_weights, -np.inf), self.log_none)
        weights = weigh_alternatives(log_weights)[:-1]
        flows, deviations = self.parts * self.flows, np.maximum(self.parts * self.deviations, _TINY)
        chance, tail = float(weights.sum()), 1.0 - BOUND_PROBABILITY  # of a leak, and of one above the bound
        if chance <= tail:
            return 0.0
        # weights of whole normal densities, of which only the parts with a flow > 0 have the weights above
        truncated = weights / np.maximum(ndtr(flows / deviations), _TINY)
        # given a leak, `tail` / `chance` of it remains above the bound
        return bound_steps(truncated, flows, deviations, 1.0 - tail / chance)


def fit_rise(
    blocks: Blocks,
    columns: Sequence[ColumnRoles],
    leak: Information,
    weights: Array,
    test: StepTest | None,
    rise: Estimate,
    laws: Sequence[tuple[float, float]],
    max_flow: float,
) -> RiseFits:
    """Fit a leak to the rise over healthy recordings and to the changes of the leakage within the recording.

    - `blocks`, `columns`: the volume balance and the roles of its columns; `leak`: likelihood of the leak's coefficient
      in the blocks; `weights` (K,): weight of each block in the rise (`block_weights`); `test`: step test of the
      coefficient, None if the leak can only be older than the recording;
    - `rise`: mean rise of the coefficient over the recording [m^3/(s Pa)];
    - `laws`: for each law of `LAWS` the mean flow of an older leak for a rise of 1, and its log probability, up to
      a constant;
    - `max_flow`: mean flow of the pump in motion [m^3/s]; larger leaks are excluded, except an older one under the
      first law.

    With a given onset, growth and law, a leak with the coefficient s changes the conductance of block k by s c_k. The
    changes within the recording give the estimate s' with the standard error e, and the log likelihood ratio L of the
    leak to no leak (`step_sizes`). The flow has a half-normal prior, whose scale is the fraction `size.usual`
    (`priors.toml`) of the pump's flow; S is the coefficient of such a leak, and s'' and e'' are mean and standard
    deviation of s by this prior and s'. The rise r, with the standard deviation d, measures f s, where f is the sum of
    the weights times c_k.

    N(x; v) is the density of a normal distribution with the variance v, R the rise by an older leak of the usual flow,
    p = `size.present` the prior probability of a leak, and q = `size.within` that of its onset within the recording, 0
    without a step test, each onset being as probable. Up to the factors of law and growth, and for leaks of the
    probability of a positive flow, the weights of the hypotheses are

            leak within the recording: q exp(L) sqrt(2 pi) e N(s'; S^2 + e^2) N(r - f s''; d^2 + f^2 e''^2),
            older leak:                (1 - q) N(r; d^2 + R^2),
            no leak:                   N(r; d^2) (1 - p) / (2 p).

    The flow of an older leak follows from the rise alone. With the small probability 2 `scatter.tail` the rise is no
    evidence, as the recording is like none that the healthy ones predict. Its density is then 1 / R, and only s'' and
    e'' give the flow.
    """
    from scipy.special import log_ndtr

    unit_flows, law_log_weights = np.array(laws).T
    usual_flow = INFERENCE.size.usual * max_flow
    usual_rises = usual_flow / unit_flows
    log_weights = law_log_weights + normal_log_density(rise.value, rise.deviation**2 + usual_rises**2)
    present: float = INFERENCE.size.present
    within: float = INFERENCE.size.within
    # no leak gets the sum of the laws' weights, which are not normalised; 0.5: a half-normal density is twice a normal
    # one
    log_none = math.log(0.5 * (1.0 - present) / present) + float(np.logaddexp.reduce(law_log_weights))
    log_none += float(normal_log_density(rise.value, rise.deviation**2))
    if test is not None:
        log_weights = log_weights + math.log(1.0 - within)
    ones = np.ones(len(laws))
    # hypotheses in the order of the fields of `RiseFits`; first a leak that is older than the recording, under each law
    fits = [(log_weights, -np.inf * ones, ones, rise.value * unit_flows, rise.deviation * unit_flows, ones > 0.0)]
    if test is not None:
        positions = _onset_positions(leak, test)
        step_fits, part_after = _fit_steps(blocks, columns, leak, positions, np.arange(len(positions)))
        for step_fit in step_fits:
            usual_rise = float(usual_rises[step_fit.law])
            combined = _combine_with_rise(step_fit, rise, usual_flow, usual_rise, weights)
            log_prior = law_log_weights[step_fit.law] + math.log(within / len(positions))
            for by_rise, (likelihoods, flows, deviations) in zip((True, False), combined, strict=True):
                flags = np.full(len(positions), by_rise)
                fits.append((log_prior + likelihoods, test.onsets, part_after, flows, deviations, flags))
    log_weights, onsets, parts, flows, deviations, flags = map(np.concatenate, zip(*fits, strict=True))
    log_weights += log_ndtr(flows / np.maximum(deviations, _TINY))  # probability of a flow > 0
    is_excluded = np.abs(flows) > max_flow
    is_excluded[0] = False  # the older leak under the first law always counts, so that a hypothesis remains
    log_weights[is_excluded] = -np.inf
    return RiseFits(log_weights, onsets, parts, flows, deviations, flags, log_none)


def _combine_with_rise(
    fit: _StepFit, rise: Estimate, usual_flow: float, usual_rise: float, weights: Array
) -> Iterator[tuple[Array, Array, Array]]:
    """Combine a step, fitted to the changes within the recording, with the rise over healthy recordings (`fit_rise`).

    `usual_flow`: scale of the prior on a leak's flow [m^3/s]; `usual_rise`: rise of the conductance by such a leak, if
    it is older than the recording; `weights` (K,): those of `fit_rise`. Yields two triples of arrays (o,): log weight
    of each onset, without the priors of law and onset, mean flow after it, and the flow's standard error [m^3/s]. In
    the first the rise is evidence of the step, in the second it is not.
    """
    unit_flow = np.maximum(fit.unit_flow, MIN_UNIT * float(fit.unit_flow.max()))  # 0 where no pressure is known
    prior_deviation = usual_flow / unit_flow  # of the coefficient
    is_known = fit.error < MAX_ERROR * prior_deviation  # else the blocks tell nothing of a step at this onset
    size = np.where(is_known, fit.size, 0.0)
    error = np.where(is_known, fit.error, MAX_ERROR * prior_deviation)
    variance, prior_variance = error**2, prior_deviation**2
    # `log_ratio` counts steps down as 0; the likelihood of a step is that of a normal distribution about any `size`
    log_likelihood = fit.log_prior + fit.log_ratio + 0.5 * np.minimum(size / error, 0.0) ** 2
    log_likelihood += 0.5 * np.log(2.0 * np.pi * variance)
    log_likelihood += normal_log_density(size, prior_variance + variance)
    shrinkage = prior_variance / (prior_variance + variance)
    size, variance = size * shrinkage, variance * shrinkage  # by the step and the prior
    fraction = (weights * fit.conductance) @ fit.course
    rise_variance = rise.deviation**2 + fraction**2 * variance  # of the rise minus the fraction of the step
    excess = rise.value - fraction * size
    combined = size + fraction * variance / rise_variance * excess  # mean of both, weighted by their precisions
    # its standard error, and what remains as the course and the law are simplified
    error = np.hypot(rise.deviation * np.sqrt(variance / rise_variance), INFERENCE.growth.scatter * combined)
    yield log_likelihood + normal_log_density(excess, rise_variance), combined * unit_flow, error * unit_flow
    log_chance = math.log(2.0 * INFERENCE.scatter.tail / max(usual_rise, _TINY))
    yield log_likelihood + log_chance, size * unit_flow, np.sqrt(variance) * unit_flow
