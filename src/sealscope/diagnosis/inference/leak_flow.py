"""Flow of a leak whose law is unknown: within a recording, above healthy recordings, and the total of pump and piston.

The law of a leak is the exponent e of its flow c |p_A - p_B|^e. Such a leak changes the conductance of block k by c
r_k, where r_k is the regression coefficient of |p_A - p_B|^e on the pressure difference within the block. A step test
with a size proportional to r_k in each block thus covers every law, and the healthy laminar leakage does not enter.

A step of the leak's conductance is fitted at each possible onset, with each law and each growth after the onset: a seal
that continues to wear leaks more towards the end, and a leak may grow from nothing. The flow is a mixture over them,
weighted by likelihood and prior (`estimate_step_flow`).

If a leak began or grew within the recording, the rise over healthy recordings contains only a part of it. `fit_rise`
therefore estimates the flow from the rise and from the changes within the recording together, and bounds it if no leak
is found.

The arguments `blocks` and `columns` are Gram matrices of the volume balance in K blocks of the recording, and for each
equation the roles of their columns (`blocks.ColumnRoles`).

The total of pump and piston (`estimate_total_flow`) depends on what the pump does. At rest, valves may cut the pump
off, and only the piston leaks; while the pump moves the piston, or turns to hold a load, pump and piston leak. Let d be
abs(p_A - p_B) without the sensor offset, and p_s the mean of d over the recording, where d counts as 0 outside state s.
With the conductance G_s in each state s, the total is

    Q = sum over s of G_s p_s.

All coefficients of the volume balance are constants of the recording here. A drift that is free would take the place of
a leakage that the machine shows at a few moments only, as a press does while it builds up its pressure. The covariance
of the fit is the larger of two: that of equal, independent errors of the rows, and that of errors which differ from
block to block and are correlated between neighbours. The conductances while the pump moves the piston and while it
holds a load differ by the relative standard deviation `rest.scatter_if_open` (`priors.toml`); a leak that begins within
the recording adds one conductance to all states. Conductances are measured at the pressures at which they show. Where
these differ from the others, the fraction `healthy.turbulent` of a leakage that flows as through an orifice makes the
total uncertain. Terms and rows leave some flow unexplained, the fraction `total.misfit` of the pump's flow.

Source: W. K. Newey, K. D. West, Econometrica 55 (1987) 703 (covariance of correlated errors).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.change import Information, StepTest, bound_steps, step_shapes, step_sizes, step_test
from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.linear import Gaussian, limit_precisions
from sealscope.diagnosis.estimate.population import BOUND_PROBABILITY, normal_log_density, weigh_alternatives
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.equations.terms import HOLDING, ORIFICE, TURNING
from sealscope.diagnosis.inference.hypotheses import GROWTHS, LAWS
from sealscope.diagnosis.inference.rows import OVERLAP
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array

#: Smallest divisor, and base of a power, where a block has no pressure difference.
_TINY = float(np.finfo(float).tiny)


def apparent_conductances(blocks: Blocks, columns: Sequence[ColumnRoles]) -> dict[float, Array]:
    """Compute the conductance that a leak with the flow |p_A - p_B|^e appears to have in each of K blocks.

    For an orifice, e = 1/2, it is the regression coefficient r of its column on that of the laminar leak. For the other
    exponents it is approximated by r^(2 (1 - e)), which is 1 for laminar flow, e = 1. The result maps each exponent e
    of `LAWS` to an array (K,) [Pa^(e - 1)].
    """
    leak, orifice = columns[0].leak, columns[0].names.index(ORIFICE)
    gram = blocks.gram.sum(axis=1)  # sum over the equations
    energy = np.maximum(gram[:, leak, leak], _TINY)
    orifice_slope = np.maximum(gram[:, orifice, leak] / energy, _TINY)  # r
    return {exponent: orifice_slope ** (2.0 * (1.0 - exponent)) for exponent in LAWS}


def law_flows(blocks: Blocks) -> dict[float, Array]:
    """Compute the mean of |p_A - p_B|^e in each of K blocks: the flow of a leak with the coefficient 1.

    With dp = p_A - p_B, and <> for the mean over a block, it is approximated by <|dp|>^(2 e - 1) <|dp|^(1/2)>^(2 - 2
    e), exact for e = 1 (laminar) and e = 1/2 (orifice). The result maps each exponent e of `LAWS` to (K,) [Pa^e].
    """
    pressure, root = blocks.mean_pressure(), blocks.mean_root()
    return {exponent: pressure ** (2.0 * exponent - 1.0) * root ** (2.0 - 2.0 * exponent) for exponent in LAWS}


def with_turbulence(leak: Information, blocks: Blocks, columns: Sequence[ColumnRoles]) -> Information:
    """Add a prior for a turbulent part of the healthy leakage to `leak`, the likelihood of the conductance in K blocks.

    This part flows as through an orifice: it adds an unknown constant times the apparent conductance of an orifice,
    scaled to the mean 1 (`Information.shape`). The prior standard deviation of the constant (`Information.disturbance`)
    is the fraction `healthy.turbulent` (`priors.toml`) of the mean conductance. Without information on the conductance,
    `leak` is returned unchanged.
    """
    shape = apparent_conductances(blocks, columns)[0.5]
    weights = np.maximum(leak.precision.sum(axis=0), 0.0)  # information of each block; it may be negative
    total_weight = float(leak.precision.sum())
    mean_shape = float(weights @ shape) / max(float(weights.sum()), _TINY)
    if not (mean_shape > 0.0 and total_weight > 0.0):
        return leak
    # mean conductance; its sign does not matter, since it scales a standard deviation
    conductance = abs(float(leak.vector.sum())) / total_weight
    return leak._replace(disturbance=INFERENCE.healthy.turbulent * conductance, shape=shape / mean_shape)


def find_leak_step(blocks: Blocks, columns: Sequence[ColumnRoles], leak: Information) -> StepTest | None:
    """Test for a leak that begins within a recording, with a flow proportional to a power of |p_A - p_B|.

    A step is tested for each exponent of `LAWS`. The joint p-value is the harmonic mean of theirs, P = 1 / sum(w / p),
    weighted by the prior probabilities w of the exponents: laws that the pressures hardly tell apart share no false
    alarms. The test with the smallest p / w is returned. For an exponent other than 1 the step varies with the
    pressure, and its size is the mean over the blocks, weighted by their information. `leak`: likelihood of the leak's
    coefficient in the blocks. Return None if too few blocks determine this coefficient.

    Source: D. J. Wilson, PNAS 116 (2019) 1195, doi 10.1073/pnas.1814092116.
    """
    weights = np.maximum(leak.precision.sum(axis=0), 0.0)  # information of each block; it may be negative
    shapes = apparent_conductances(blocks, columns)
    tests = []
    for exponent, prior in LAWS.items():
        mean_shape = float(weights @ shapes[exponent]) / max(float(weights.sum()), _TINY)
        test = step_test(leak, shape=shapes[exponent] / max(mean_shape, _TINY))
        if test is not None:
            tests.append((test, prior))
    if not tests:
        return None
    # of equal p-values, such as 1, the highest score counts
    best, _ = min(tests, key=lambda pair: (pair[0].chance / pair[1], -pair[0].score))
    least = max(best.chance, _TINY)  # a p-value may be too small for a float
    return best.share_alarms(sum(prior * least / max(test.chance, _TINY) for test, prior in tests))


def mixture_flow(probabilities: Array, flows: Array, deviations: Array) -> Estimate:
    """Compute mean and standard deviation of a mixture of k estimates of a flow [m^3/s] or another quantity.

    `probabilities`, `flows`, `deviations` (k,): those of the estimates, and these with their standard errors.
    """
    value = float(probabilities @ flows)
    return Estimate(value, float(np.sqrt(probabilities @ (deviations**2 + (flows - value) ** 2))))


#: Probability of an onset, relative to the most probable one, below which it is omitted.
NEGLIGIBLE = 1e-3
#: Standard error of a step, over that of the prior on its size, above which it counts as unknown.
MAX_ERROR = 1e6
#: Smallest mean flow of a unit step after an onset, over that of other onsets.
MIN_UNIT = 1e-6
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


#: Number of blocks over which errors are correlated.
N_CORRELATED = 3


class TotalFlow(NamedTuple):
    """Mean leakage of pump and piston over a recording [m^3/s], as computed with the assumed sizes.

    Its standard deviation has two parts: `noise` differs from recording to recording, while `systematic` errors, by the
    law of the leakage and by flow that no term describes, are alike in those of one machine.
    """

    value: float
    noise: float
    systematic: float

    @property
    def deviation(self) -> float:
        """Standard deviation of the flow, which does not include the uncertain scale of the flows."""
        return float(np.hypot(self.noise, self.systematic))


class StateLoad(NamedTuple):
    """Pressure that drives the leakage in one state of the machine.

    - `pressure`: mean of abs(p_A - p_B) over the recording [Pa], where it counts as 0 outside the state;
    - `turbulent_excess`: flow of an orifice over that of the laminar leak that fits it best, minus 1. It is 0 at a
      constant pressure, and grows as the pressure varies.
    """

    pressure: float
    turbulent_excess: float

    @classmethod
    def measure(cls, pressure: Array, is_counted: NDArray[np.bool_]) -> StateLoad:
        """Measure the load of a state, with abs(p_A - p_B) = `pressure` (n,) [Pa] where the state `is_counted` (n,).

        An orifice's flow p^0.5 is fitted by g p, with g = sum p^1.5 / sum p^2.
        """
        values = pressure[is_counted & np.isfinite(pressure)]
        share = len(values) / max(int(np.isfinite(pressure).sum()), 1)
        if not (values.size and values.any()):
            return cls(0.0, 0.0)
        means = [float((values**exponent).mean()) for exponent in (0.5, 1.0, 1.5, 2.0)]
        return cls(share * means[1], means[0] * means[3] / (means[2] * means[1]) - 1.0)


class StateLoads(NamedTuple):
    """Loads of the states: a `resting` pump, one that is `moving` the piston, and one that is `holding` a load."""

    resting: StateLoad
    moving: StateLoad
    holding: StateLoad


def estimate_total_flow(
    blocks: Blocks, roles: ColumnRoles, loads: StateLoads, is_after_onset: NDArray[np.bool_] | None = None
) -> TotalFlow:
    """Estimate the mean leakage of pump and piston over a recording.

    Parameters
    ----------
    blocks : Blocks
        Blocks of the volume balance. If they have the columns `TURNING` and `HOLDING`, each state has a conductance of
        its own, otherwise there is one for all states.
    roles : ColumnRoles
        Roles of the columns.
    loads : StateLoads
        Pressure in each state.
    is_after_onset : array of bool (K,), optional
        Blocks after the onset of a leak, None without one.

    Returns
    -------
    TotalFlow
        The flow, with the parts of its standard deviation.
    """
    gram, pressure = blocks.gram[:, 0], sum(load.pressure for load in loads)
    weights, excesses = {roles.leak: pressure}, {roles.leak: _mean_excess(*loads)}
    states = [roles.names.index(name) for name in (TURNING, HOLDING) if name in roles.names]
    if states:
        turning, holding = states
        is_separate = float(gram[:, holding, holding].sum()) > 0.0  # else `apply_regime` counts holds as motion
        in_motion = (loads.moving,) if is_separate else (loads.moving, loads.holding)
        for column, parts in ((roles.leak, (loads.resting,)), (turning, in_motion), (holding, (loads.holding,))):
            weights[column], excesses[column] = sum(load.pressure for load in parts), _mean_excess(*parts)
        if not is_separate:
            weights[holding] = 0.0
    if is_after_onset is not None:
        # a leak past the piston acts in all states
        gram = _append_step(gram, roles.leak, is_after_onset)
        block_pressure = blocks.mean_pressure() * blocks.pressure_weights
        share_after = float(block_pressure[is_after_onset].sum()) / max(float(block_pressure.sum()), _TINY)
        weights[gram.shape[1] - 1] = share_after * pressure
    if states:  # the leak's column is that of all states: without the others it is that of a resting pump
        gram = _subtract_columns(gram, roles.leak, states)
    coefficients, value, deviation = _weigh_coefficients(replace(blocks, gram=gram[:, None]), roles, weights, states)
    by_law = sum(abs(coefficients.get(column, 0.0) * weights[column]) * excess for column, excess in excesses.items())
    misfit = INFERENCE.total.misfit * blocks.moving_flow
    return TotalFlow(value, deviation, float(np.hypot(INFERENCE.healthy.turbulent * by_law, misfit)))


def _mean_excess(*loads: StateLoad) -> float:
    """Average `StateLoad.turbulent_excess` over several states, weighted by their pressures; 0 without pressure."""
    pressure = sum(load.pressure for load in loads)
    return sum(load.pressure * load.turbulent_excess for load in loads) / max(pressure, _TINY)


def _append_step(gram: Array, column: int, is_after: NDArray[np.bool_]) -> Array:
    """Append a copy of a `column` of Gram matrices (K, m, m), which is 0 in blocks that `is_after` (K,) does not flag.

    The new column is the last one, behind the left side.
    """
    index = [*range(gram.shape[1]), column]
    factors = np.ones((len(gram), len(index)))
    factors[:, -1] = is_after
    return np.asarray(gram[:, index][:, :, index] * factors[:, :, None] * factors[:, None, :])


def _subtract_columns(gram: Array, column: int, subtracted: list[int]) -> Array:
    """Subtract columns `subtracted` from one `column` of the regression whose Gram matrices (K, m, m) are given."""
    transform = np.eye(gram.shape[1])
    transform[subtracted, column] = -1.0
    return np.asarray(transform.T @ gram @ transform)


def _weigh_coefficients(
    blocks: Blocks, roles: ColumnRoles, weights: Mapping[int, float], states: list[int]
) -> tuple[dict[int, float], float, float]:
    """Fit constant coefficients to blocks, and compute the sum of some of them times their `weights`, with its error.

    Returns the coefficients by their columns, the sum and its standard deviation. `states`: columns of the leakage
    while the pump moves the piston, and while it holds a load; empty without them.
    """
    gram, left = blocks.gram[:, 0], roles.left
    total = gram.sum(axis=0)
    columns = [k for k in sorted({*roles.nuisance, *weights}) if total[k, k] > 0.0]
    data = Gaussian(total[np.ix_(columns, columns)], total[columns, left], float(total[left, left]))
    n_rows = max(float(blocks.rows.sum()), 1.0)
    min_variance = 1e-14 * data.square / n_rows  # rounding errors of the sums
    variance = OVERLAP * max(data.residual_square / n_rows, min_variance)
    prior = Gaussian(_prior_precision(roles, total, columns, states, variance), np.zeros(len(columns)))
    posterior = data + prior
    inverse = posterior.covariance
    coefficients = inverse @ data.moment
    scores = gram[:, columns, left] - gram[:, columns][:, :, columns] @ coefficients  # (K, c)
    spread = scores.T @ scores
    for lag in range(1, min(N_CORRELATED, len(scores))):
        product = scores[lag:].T @ scores[:-lag]
        spread += (1.0 - lag / N_CORRELATED) * (product + product.T)
    contrast = inverse @ np.array([weights.get(k, 0.0) for k in columns])
    robust = float(contrast @ spread @ contrast) * len(scores) / max(len(scores) - 1.0, 1.0)
    by_rows = float(contrast @ posterior.precision @ contrast) * variance
    fitted = dict(zip(columns, coefficients.tolist(), strict=True))
    return fitted, float(contrast @ data.moment), float(np.sqrt(max(robust, by_rows, 0.0)))


def _prior_precision(roles: ColumnRoles, total: Array, columns: list[int], states: list[int], variance: float) -> Array:
    """Compute the prior precision (c, c) of c coefficients times the variance of a row.

    Priors are those of the constant parts (`ColumnRoles.level_deviations`), and that of the difference of the leakages
    in the two `states` of a turning pump, over the leakage that both have together.
    """
    deviations = np.full(len(total), np.inf)
    deviations[: roles.left] = roles.level_deviations(total[: roles.left + 1, : roles.left + 1])
    deviations[roles.leak] = np.inf  # the total is what is estimated
    with np.errstate(over="ignore"):
        precision = np.diag(limit_precisions(variance / deviations[columns] ** 2, total[np.ix_(columns, columns)]))
    if len(states) == 2 and all(state in columns for state in states):
        pair = [columns.index(state) for state in states]
        # one coefficient for both states: the sum of their columns takes the place of the first
        joint = np.delete(np.eye(len(columns)), pair[1], axis=1)
        joint[pair[1], pair[0] - (pair[1] < pair[0])] = 1.0
        data = Gaussian(total[np.ix_(columns, columns)], total[columns, roles.left])
        common = data.transform(joint).mean[pair[0] - (pair[1] < pair[0])]
        difference = np.zeros(len(columns))
        difference[pair] = 1.0, -1.0
        deviation = max(INFERENCE.rest.scatter_if_open * abs(float(common)), _TINY**0.25)
        precision += np.outer(difference, difference) * variance / deviation**2
    return precision
