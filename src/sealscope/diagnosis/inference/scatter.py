"""Rise of a recording's leakage, i.e. the leakage above that of healthy recordings, whose scatter is estimated.

The Gram matrices of the healthy recordings are added up and give the coefficients of all terms of the volume balance.
A recording's residual under these coefficients, projected on the leak's column, is its rise. The recording's other
coefficients may differ from the healthy ones within a prior. The zero of the flow repeats: a free one would absorb a
leak whose flow is nearly constant, and what it changes from day to day is part of the scatter. The rise r_j of each
healthy recording over the n - 1 others measures this scatter, including all effects that the model does not describe.
The comparison uses y_j = r_j (n - 1)/n, the rise over the mean of all n, and for the judged recording y, its rise.

The width of the prior on the other coefficients is known only to within a factor: one machine, held at one temperature,
repeats its coefficients to a thousandth; another changes by a tenth from run to run. With too narrow a prior the rises
scatter, with too wide a prior they are imprecise. Therefore y is computed for several widths, each weighted by its
prior and by the likelihood of the healthy recordings, p(y_1 .. y_n).

Leakage is proportional to the inverse of the oil's viscosity. Levels that are clearly above zero are therefore compared
as logarithms: z = asinh(a / 2 c). Here a = mean level + y is the level (leak coefficient) of a recording, and c, which
follows from the errors of a, is the level below which z is linear. For each width all z are normal about an unknown
mean. These effects contribute to their covariance:

- Scatter of single recordings: sigma^2 on the diagonal. sigma has a log-uniform prior from a recording's standard error
  to a tenth of the flow, so five recordings that agree allow a smaller sigma than two do.
- Sessions: recordings of one session share oil and set-up. The deviation tau of a session has a half-normal prior.
  Sessions are separated by date; undated recordings form one session.
- Oil: if its temperature T is known for all recordings, z has a slope in T with a prior, and a recording with oil
  outside of the known range is less certain. Otherwise the viscous pressure drop of the motion
  (`changes.motion_fit`) may show the oil's viscosity, or tau covers its effect.
- Conditions: load and speed outside of the known range make a recording less certain.

The rise follows the mixture over all of these. The priors are in `priors.toml`.

Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 3.2, 5.4 and 5.7; C. E. Rasmussen and C. K.
I. Williams, Gaussian Processes for Machine Learning (2006), section 2.7 (an unknown mean).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, solve, sum_blocks
from sealscope.diagnosis.inference.onset import BOUND_PROBABILITY
from sealscope.diagnosis.inference.rows.weak_form import MAX_READING
from sealscope.diagnosis.inference.terms import AIR, LAG, LEAK, ORIFICE
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.evaluation.scalar_search import find_near_root, find_root
from sealscope.recordings.recording import Array

#: `Observable.data` of the leakage against healthy recordings.
RISE = "rise"
#: Number of points of each grid, of standard deviations or of rises.
NODES = 32
#: Largest standard deviation between sessions on the grid, over its prior.
MAX_SESSION_RATIO = 3.0
#: Maximum number of healthy recordings whose covariances are evaluated.
MAX_RECORDINGS = 60
#: Number of widths of the prior on differences between recordings, and the largest log width [standard deviations].
SCALES, MAX_SCALE = 11, 2.5
#: Minimum number of healthy recordings with holds under pressure: for a mean and a scatter.
MIN_WITH_HOLDS = 2
#: Reach of a grid of rises [standard deviations].
MAX_LOG = 4.0
#: Lower limit of divisors and of arguments of logarithms.
TINY = 1e-300
#: A normal distribution of z is replaced by this number of narrower ones, with this fraction of its deviation.
PARTS, PART_WIDTH = 7, 0.5
#: Limit of abs(z).
MAX_Z = 30.0
#: Parts of a mixture are omitted if their log weight is lower than the largest by more than this.
NEGLIGIBLE = 16.0
#: Number of parts of a large mixture that give the first estimate of a quantile, and step for the slope there.
SAMPLED, SLOPE_STEP = 1000, 1e-3


class Mixture(NamedTuple):
    """Mixture of k normal distributions: their `weights`, standard `deviations` and `centres`, (k,) each."""

    weights: Array
    deviations: Array
    centres: Array

    def quantile(self, probability: float) -> float:
        """Compute the quantile of the mixture: the value below which it lies with the given probability."""
        from scipy.special import ndtr, ndtri

        # scale by a typical deviation (very large ones count in part), so that the quantile is of the order of one
        scale = max(float(self.weights @ np.minimum(self.deviations, 1e3 * self.deviations.min())), TINY)
        scaled = self._replace(centres=self.centres / scale, deviations=self.deviations / scale)

        def excess(value: float, mixture: Mixture = scaled) -> float:
            """Compute the probability of values below `value`, minus the wanted `probability`."""
            return float(mixture.weights @ ndtr((value - mixture.centres) / mixture.deviations)) - probability

        part_quantiles = scaled.centres + ndtri(probability) * scaled.deviations
        low, high = float(part_quantiles.min()), float(part_quantiles.max())  # the quantile is between them
        root = None
        if len(self.weights) > 4 * SAMPLED:  # begin at the quantile of a sample of the normal distributions
            weights, deviations, centres = (values[:: len(values) // SAMPLED] for values in scaled)
            sample = Mixture(weights / weights.sum(), deviations, centres)
            sample_excess = partial(excess, mixture=sample)
            if sample_excess(low) < 0.0 < sample_excess(high):
                start = find_root(sample_excess, low, high)
                difference = sample_excess(start + SLOPE_STEP) - sample_excess(start - SLOPE_STEP)
                root = find_near_root(excess, start, difference / (2.0 * SLOPE_STEP), low, high)
        if root is None:
            root = low if not excess(low) < 0.0 < excess(high) else find_root(excess, low, high)
        return scale * root


class Rise(NamedTuple):
    """Amount by which a recording's leak coefficient exceeds that of healthy recordings, with its distribution.

    `value`: the estimate, and `deviation`: its standard deviation, both in the unit of the coefficient (of a laminar
    leak m^3/(s Pa)). In a healthy recording `value` has the distribution `mixture`. If `mixture` is None, `value` over
    `deviation` has Student's t distribution with `degrees_of_freedom`. `may_be_partial`: the leak may have begun within
    the recording, whose mean then contains only a part of the rise. `share`: fraction of the allowed false alarms that
    is left to this rise, by which its p-value is divided (`share_alarms`).
    """

    value: float
    deviation: float
    degrees_of_freedom: float
    mixture: Mixture | None = None
    may_be_partial: bool = False
    share: float = 1.0

    def share_alarms(self, share: float) -> Rise:
        """Return this rise with its p-value divided by `share`, for use beside another rise of which the best counts.

        `share`: fraction of the false-alarm probability of both that this rise may use.
        """
        return self._replace(share=share)

    def widen(self, variance: float) -> Rise:
        """Return the rise with an additional independent error of the given variance, in the square of its unit.

        The variance is added to the variance of the rise and to the variance of each part of its mixture. The rise
        remains unchanged if it has no mixture, or if the variance is not positive.
        """
        if self.mixture is None or not variance > 0.0:
            return self
        mixture = self.mixture._replace(deviations=np.sqrt(self.mixture.deviations**2 + variance))
        return self._replace(deviation=float(np.sqrt(self.deviation**2 + variance)), mixture=mixture)

    @property
    def score(self) -> float:
        """The estimated rise, `value`, divided by its standard deviation."""
        return self.value / self.deviation

    @property
    def chance(self) -> float:
        """Probability that a healthy recording has a higher score (a one-sided p-value), over `share`, at most 1.

        The score is the estimated rise over its standard deviation.
        """
        from scipy.special import ndtr, stdtr

        if self.mixture is None:
            chance = float(stdtr(self.degrees_of_freedom, -self.score))
        else:
            weights, deviations, centres = self.mixture
            chance = float(weights @ ndtr((centres - self.score * self.deviation) / deviations))
        return min(chance / max(self.share, TINY), 1.0)

    def threshold(self, chance: float) -> float:
        """Compute the score whose p-value (`chance`) is the argument `chance`, between 0 and 1.

        The score is the estimated rise of the leakage over its standard deviation.
        """
        from scipy.special import stdtrit

        probability = 1.0 - chance * self.share
        if self.mixture is None:
            return float(stdtrit(self.degrees_of_freedom, probability))
        return self.mixture.quantile(probability) / self.deviation

    def log_ratio(self, rise: float, log_deviation: float = 0.0) -> float:
        """Compute the log likelihood ratio of a true rise of the leak's coefficient by `rise` to no rise.

        Both hypotheses are compared with the estimate `value`; `rise` is in its unit. `log_deviation`: standard
        deviation of the logarithm of the true rise about log(`rise`); 0 if the true rise is known to be `rise`. If the
        true rise is known and `may_be_partial`, `value` may contain any fraction of it.
        """
        if log_deviation > 0.0 and rise > 0.0:
            return self._log_ratio_lognormal(rise, log_deviation)
        if self.may_be_partial and rise > 0.0:
            return self._log_ratio_partial(rise)
        return self._log_density(self.value - rise) - self._log_density(self.value)

    def _log_ratio_partial(self, rise: float) -> float:
        """Compute the log likelihood ratio of a true rise by `rise` to none, if the recording shows a fraction of it.

        `rise` is in the unit of `value`. The likelihood is averaged over fractions from 0 to 1.
        """
        densities = [self._log_density(self.value - part) for part in np.linspace(0.0, rise, NODES)]
        if 0.0 < self.value < rise:  # the likeliest fraction, which the grid may miss
            densities.append(self._log_density(0.0))
        return float(np.logaddexp.reduce(densities) - np.log(len(densities))) - self._log_density(self.value)

    def log_ratio_within(self, rise: float, tail: float) -> float:
        """Compute the log likelihood ratio of a true rise by `rise` to no rise, robust to outlying estimates.

        Each of the two densities of `value` is at least the density at the quantiles `tail` and 1 - `tail` of a healthy
        recording. An estimate that is improbable with the rise and without it is therefore evidence for neither.
        """
        tail_values = [self.threshold(chance) * self.deviation for chance in (tail, 1.0 - tail)]
        min_log_density = min(self._log_density(value) for value in tail_values)
        with_rise = max(self._log_density(self.value - rise), min_log_density)
        return with_rise - max(self._log_density(self.value), min_log_density)

    def _log_ratio_lognormal(self, rise: float, log_deviation: float) -> float:
        """Compute the log likelihood ratio of a true rise with a log-normal prior about `rise` to no rise.

        `log_deviation`: standard deviation of the logarithm of the true rise. The likelihood is integrated over a
        grid of true rises, which resolves both the prior and the likelihood.
        """
        grid_deviations = np.linspace(-MAX_LOG, MAX_LOG, NODES)
        grid = np.concatenate(
            [rise * np.exp(log_deviation * grid_deviations), self.value + self.deviation * grid_deviations]
        )
        grid = np.unique(grid[grid > TINY])
        z = np.log(grid / rise) / log_deviation
        log_prior = -0.5 * z**2 - np.log(grid * log_deviation * np.sqrt(2.0 * np.pi))
        log_densities = [self._log_density(self.value - true_rise) for true_rise in grid]
        log_integrand = log_prior + log_densities - self._log_density(self.value)
        log_max = float(log_integrand.max())
        return log_max + float(np.log(max(np.trapezoid(np.exp(log_integrand - log_max), grid), TINY)))

    def _log_density(self, value: float) -> float:
        """Compute the log probability density at `value` of the estimated rise if the recording is healthy.

        `value` is in the unit of the leak's coefficient. A constant is left out.
        """
        if self.mixture is None:
            z = value / self.deviation
            if np.isinf(self.degrees_of_freedom):  # Student's t is then normal
                return -0.5 * z * z
            return float(-0.5 * (self.degrees_of_freedom + 1.0) * np.log1p(z * z / self.degrees_of_freedom))
        weights, deviations, centres = self.mixture
        log_weights = np.log(np.maximum(weights, np.finfo(float).tiny)) - np.log(deviations)
        return float(np.logaddexp.reduce(log_weights - 0.5 * ((value - centres) / deviations) ** 2))

    def bound(self, probability: float = BOUND_PROBABILITY) -> float:
        """Compute the upper bound of the true rise of the leakage, in the unit of the estimate.

        The true rise is below it with the given probability. A negative estimate counts as zero:

            bound = max(value, 0) - threshold(probability) deviation,

        where threshold(probability), usually negative, is the score that a healthy recording exceeds with this
        probability.
        """
        return max(self.value, 0.0) - self.threshold(probability) * self.deviation

    def interval(self, probability: float = BOUND_PROBABILITY) -> tuple[float, float]:
        """Compute the central interval (low, high) that contains the true rise with the given `probability`."""
        tail = 0.5 - 0.5 * probability  # on either side of the interval
        max_error, min_error = (self.threshold(chance) * self.deviation for chance in (tail, 1.0 - tail))
        return self.value - max_error, self.value - min_error


class Resistance(NamedTuple):
    """Pressure difference p_A - p_B that resists the motion: friction sign(v) + drop v at the speed v.

    `friction`: half the difference between the directions of motion [Pa]; `drop`: viscous pressure drop per speed, in
    Pa per unit of the speed; `friction_error`, `drop_error`: standard errors of both; `top_speed`: 99 % quantile of the
    magnitude of the speed, in m/s where the position is recorded, else in the unit of the channel that replaces it.
    """

    friction: float
    friction_error: float
    drop: float
    drop_error: float
    top_speed: float


class RecordingSums(NamedTuple):
    """Summary of one recording, for the comparison with other recordings of the same machine.

    - `sums` (E, m, m): Gram matrix of the m columns of each of E equations, divided by the residual variance of a row,
      with the coefficients eliminated that recordings do not share (`eliminate_unshared`);
    - `flow`, `pressure`: mean magnitudes of the pump's flow [m^3/s] and of p_A - p_B [Pa];
    - `start_s`, `oil_degC`: date [s since 1970] and temperature of the oil, None if unknown;
    - `held` (6,): leaks while shut valves hold the load, in the order of `holds.leaks.HeldLeaks`, or None;
    - `held_pump` (2,): leakage conductance of the pump [m^3/(s Pa)] just before such holds, and its standard deviation,
      or None;
    - `resistance` (5,): what resists the motion (`Resistance`), or None.
    """

    sums: Array
    flow: float
    pressure: float
    start_s: float | None = None
    oil_degC: float | None = None
    held: Array | None = None
    held_pump: Array | None = None
    resistance: Array | None = None

    @classmethod
    def from_blocks(
        cls,
        blocks: Blocks,
        columns: Sequence[ColumnRoles],
        start_s: float | None = None,
        oil_degC: float | None = None,
    ) -> RecordingSums:
        """Summarise a recording from its `blocks`: sum of the Gram matrices, mean flow and mean pressure.

        The sum is divided by the residual variance of a row; coefficients that recordings do not share are eliminated.
        The means are weighted by the numbers of rows. `columns`: for each equation the indices of its columns by role
        (leak, motion, left side); `start_s`, `oil_degC`: date [s since 1970] and oil temperature, None if unknown,
        which are stored as they are.
        """
        weights = np.maximum(blocks.rows, 1e-9)  # positive, so that the means exist
        flow = float(np.average(blocks.flow, weights=weights))
        pressure = float(np.average(blocks.mean_pressure(), weights=weights))
        return cls(eliminate_unshared(sum_blocks(blocks, columns), columns), flow, pressure, start_s, oil_degC)


def _conductance_of_flow(recording: RecordingSums) -> float:
    """Compute the conductance [m^3/(s Pa)] of a leak as large as the pump's mean flow; 0 if the mean pressure is 0."""
    return recording.flow / recording.pressure if recording.pressure > 0.0 else 0.0


def rise(judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[ColumnRoles]) -> Rise:
    """Estimate by how much a recording's leak coefficient exceeds that of healthy recordings of the same machine.

    `judged`: summary of the recording, i.e. Gram matrices of its volume balance, mean flow and mean pressure;
    `baseline`: summaries of the healthy recordings; `columns`: for each equation the indices of its columns by role
    (leak, motion, left side), the same for all recordings. The rise and its standard deviation are in the unit of the
    leak's coefficient, for the laminar leak m^3/(s Pa).

    The other coefficients may differ between recordings within a prior. As its width is uncertain, the rises are
    estimated for several widths, and the result is an average over them (`_compare_levels`).
    """
    healthy_sums = np.sum([recording.sums for recording in baseline], axis=0)
    count, prior = len(baseline), INFERENCE.scatter
    # factors on the prior standard deviations; log(`prior.between`) is the standard deviation of their logarithm
    widths = prior.between ** np.linspace(-MAX_SCALE, MAX_SCALE, SCALES)
    rises, rise_errors = np.zeros((SCALES, count)), np.zeros((SCALES, count))
    if count > 1:  # rises of each healthy recording over the others, scaled to its rise over the mean of all
        projections = [
            _estimate_leak_excess(recording.sums, healthy_sums - recording.sums, columns, widths)
            for recording in baseline
        ]
        rises, rise_errors = (
            np.array(estimates).T * ((count - 1) / count) for estimates in zip(*projections, strict=True)
        )
    values, error = _estimate_leak_excess(judged.sums, healthy_sums, columns, widths)
    level, level_error = coefficient_level(healthy_sums, columns)
    # error of a rise for each width: a fraction of the typical standard error, at least the fraction `prior.finest` of
    # the pump's mean flow, as a conductance, and never 0 (1 / MAX_READING)
    errors = prior.estimate * np.median(np.column_stack([error, rise_errors]), axis=1)
    errors = np.maximum(errors, max(prior.finest * _conductance_of_flow(judged), 1.0 / MAX_READING))
    return _compare_levels(judged, baseline, _Estimates(values, rises, errors, level, level_error))


def held_rise(judged: RecordingSums, baseline: Sequence[RecordingSums]) -> Rise | None:
    """Estimate the rise of the leakage past the piston over healthy recordings, from holds.

    A hold is a time in which shut valves keep the load in place. `judged`: summary of the recording; `baseline`:
    summaries of the healthy recordings. The leak may have begun within the recording, whose mean then contains only a
    part of it (`Rise.may_be_partial`). Return None if the judged recording has no holds, or if fewer than
    `MIN_WITH_HOLDS` healthy recordings have holds.
    """
    baseline = [recording for recording in baseline if recording.held is not None]
    if judged.held is None or len(baseline) < MIN_WITH_HOLDS:
        return None
    # the first two values of `HeldLeaks`: leak past the piston, and its standard deviation
    leaks = np.array([recording.held[:2] for recording in (*baseline, judged) if recording.held is not None])
    min_crossover = INFERENCE.scatter.largest * _conductance_of_flow(judged)
    return _compare_held(judged, baseline, leaks, min_crossover=min_crossover)._replace(may_be_partial=True)


def held_pump_rise(judged: RecordingSums, baseline: Sequence[RecordingSums]) -> Rise | None:
    """Estimate the rise of the pump's leakage over healthy recordings, from the time just before holds.

    `judged`: summary of the recording; `baseline`: summaries of the healthy recordings. Return None if the pump's
    leakage is unknown in the judged recording, or known in fewer than `MIN_WITH_HOLDS` healthy recordings.
    """
    baseline = [recording for recording in baseline if recording.held_pump is not None]
    if judged.held_pump is None or len(baseline) < MIN_WITH_HOLDS:
        return None
    leakages = np.array([r.held_pump for r in (*baseline, judged) if r.held_pump is not None])
    # the relative deviation between sessions, times the mean leakage of the healthy recordings
    session_deviation = INFERENCE.held_oil.pump_session * abs(float(leakages[:-1, 0].mean()))
    return _compare_held(judged, baseline, leakages, session_deviation=session_deviation)


def _compare_held(judged: RecordingSums, baseline: Sequence[RecordingSums], leaks: Array, **priors: float) -> Rise:
    """Estimate the rise of a leak that holds measure over its mean in the healthy recordings.

    `leaks` (n + 1, 2): conductance and standard deviation [m^3/(s Pa)] in each of the n recordings `baseline`, and last
    in the recording `judged`; `priors`: `min_crossover` and `session_deviation` of `_Estimates`.
    """
    *healthy_leaks, leak = leaks[:, 0]
    level = float(np.mean(healthy_leaks))
    min_error = max(INFERENCE.scatter.finest * _conductance_of_flow(judged), 1.0 / MAX_READING)  # above 0
    error = np.maximum(np.median(leaks[:, 1]), min_error)
    estimates = _Estimates(
        values=np.array([leak - level]),
        rises=(np.array(healthy_leaks) - level)[None],
        errors=error[None],
        level=max(level, 0.0),
        level_error=error / np.sqrt(len(baseline)),
        **priors,
    )
    # `error` is included already; a less precise judged recording adds the difference
    return _compare_levels(judged, baseline, estimates).widen(float(leaks[-1, 1]) ** 2 - float(error) ** 2)


class _Estimates(NamedTuple):
    """Rises of the leak coefficient, estimated with each of s prior standard deviations of the other coefficients.

    These priors are on the differences of the coefficients between recordings. `values` (s,): rises of the judged
    recording; `rises` (s, n): rises of n healthy recordings over their mean; `errors` (s,): standard error of one rise;
    `level`: mean coefficient of the healthy recordings; `level_error`: its standard error; `min_crossover`: minimum of
    `_LevelScale.crossover`, large where healthy levels are about zero; `session_deviation`: prior standard deviation
    between sessions with the same oil, None for that of the whole leakage (`scatter.session` of `priors.toml`). All
    have the unit of the coefficient.
    """

    values: Array
    rises: Array
    errors: Array
    level: float
    level_error: float
    min_crossover: float = 0.0
    session_deviation: float | None = None


def _compare_levels(judged: RecordingSums, baseline: Sequence[RecordingSums], estimates: _Estimates) -> Rise:
    """Estimate by how much the judged leak coefficient exceeds the coefficient that the healthy recordings predict.

    `judged`, `baseline`: summaries of the judged recording and of n healthy ones; `estimates`: rises of all of them
    over the healthy mean, with their errors. Each of its s rows belongs to one width of the prior on the other
    coefficients; there is one row if no such prior is used.

    The sum of healthy mean and rise is the leak coefficient a of a recording. Leak coefficients are compared as z =
    asinh(a / (2 c)), which is logarithmic for large a (`_LevelScale`). From z the predicted effect of the oil is
    subtracted. The rest is normal about an unknown mean, with an unknown standard deviation sigma of single recordings;
    sessions, oil and unusual conditions add covariances (see the module).
    """
    values, rises, errors, level, level_error, min_crossover, session_deviation = estimates
    prior = INFERENCE.scatter
    conductance_of_flow = _conductance_of_flow(judged)
    if session_deviation is None:
        session_deviation = prior.session * conductance_of_flow
    # log width of the prior in each row, in standard deviations; estimates from holds have no such prior
    log_widths = np.linspace(-MAX_SCALE, MAX_SCALE, SCALES) if len(values) == SCALES else np.zeros(len(values))
    recordings = [*baseline, judged]
    oils = _oil_hypotheses(recordings)
    # scatter that the oil does not explain: warmer oil is thinner and leaks more
    oil_factor = np.exp(oils[0].thinning[:-1])
    unexplained = rises - level * (oil_factor - oil_factor.mean())
    scatter = float(np.median(unexplained.std(axis=1)))
    # c, below which z is linear in a: the largest of the errors, the scatter and a tenth of the level
    scale = _LevelScale(level, max(level_error, float(np.median(errors)), scatter, 0.1 * level, min_crossover))
    steepness = scale.slope(level)  # dz/da at the healthy mean
    relative_slope = steepness * level  # change of z for a relative change of a
    log_condition_excess = sum(condition.log_excess for condition in find_unusual_conditions(judged, baseline))
    pause = 3600.0 * INFERENCE.oil.shift  # from hours to seconds
    sessions = number_sessions([recording.start_s for recording in recordings], pause)
    # grid of sigma in z, for each row of the estimates: from the standard error to the largest plausible scatter, at
    # least to ten standard errors
    max_scatter = min(steepness * prior.largest * conductance_of_flow, prior.relative)
    max_sigma = np.maximum(max_scatter, 10.0 * steepness * errors)
    sigma = np.geomspace(steepness * errors, max_sigma, NODES, axis=1)
    judged_z, healthy_z = scale.transform(values), scale.transform(rises)
    # log Jacobian of z, plus log prior of the width, for each row
    log_priors = np.log(scale.slope(level + rises)).sum(axis=1) - 0.5 * log_widths**2
    predictions = []
    for oil in oils:
        thinned = level * np.exp(oil.thinning)  # predicted levels
        candidates = _candidate_covariances(
            sessions,
            oil,
            scale.slope(thinned) * thinned,
            oil_deviation=relative_slope * oil.session_deviation,
            session_deviation=steepness * session_deviation,
            condition_deviation=relative_slope * (log_condition_excess * INFERENCE.conditions.leak),
        )
        shifts = scale.transform(thinned - level) - scale.transform(np.zeros(1))  # effect of the oil on z
        predicted = Population(*candidates).predict(
            judged_z - shifts[-1], healthy_z - shifts[:-1], sigma, log_priors + oil.log_probability
        )
        predictions.append(scale.to_levels(predicted, judged_z))
    all_oils = Mixture(*(np.concatenate(parts, axis=1) for parts in zip(*predictions, strict=True)))
    return _rise_of_mixture(all_oils, values)


def _candidate_covariances(
    sessions: Sequence[int],
    oil: _Oil,
    relative_slopes: Array,
    *,
    oil_deviation: float,
    session_deviation: float,
    condition_deviation: float,
) -> tuple[Array, Array]:
    """Build the candidate covariances of transformed leak coefficients z between recordings, with log priors.

    z = asinh(a / (2 c)) of a leak coefficient a (`_LevelScale`) is logarithmic for large coefficients.

    Parameters
    ----------
    sessions : sequence of int, length n + 1
        Session number of each recording, the judged one last.
    oil : _Oil
        Hypothesis on the oil of the recordings.
    relative_slopes : array of float, shape (n + 1,)
        Change of z per relative change of each recording's leak coefficient.
    oil_deviation : float
        Standard deviation of z between sessions by unknown oil; 0 if the oil is known.
    session_deviation : float
        Prior standard deviation of z between sessions with the same oil.
    condition_deviation : float
        Standard deviation of the judged z due to unusual load and speed.

    Returns
    -------
    covariances : array of float, shape (g, n + 1, n + 1)
    log_priors : array of float, shape (g,)
    """
    # grid of the standard deviation between sessions over its prior, denser near zero; the log priors are those of a
    # half-normal density times the distance of the grid points, which grows with the root of the ratio
    ratios = MAX_SESSION_RATIO * ((np.arange(NODES) + 0.5) / NODES) ** 2
    log_priors = 0.5 * np.log(ratios) - 0.5 * ratios**2
    if len(set(sessions)) == 1:
        ratios, log_priors = np.zeros(1), np.zeros(1)
    session_variances = (np.hypot(oil_deviation, session_deviation) * ratios) ** 2
    # recordings of one session share the deviation of the session
    covariances = session_variances[:, None, None] * np.equal.outer(np.array(sessions), np.array(sessions))
    # the predicted effect of the oil has errors of its slope and of its values
    effects = relative_slopes * oil.thinning
    covariances = covariances + np.outer(effects, effects) * oil.slope_deviation**2
    covariances += np.diag(relative_slopes**2 * oil.variances)
    covariances[:, -1, -1] += condition_deviation**2
    if oil_deviation > 0.0 and sessions[-1] not in sessions[:-1]:
        # two cases: the oil in the judged recording's session is like the oil in the healthy sessions, or unlike it;
        # unlike oil adds the variance of a difference between two sessions
        unlike = INFERENCE.scatter.unlike
        log_priors = (np.log([[1.0 - unlike], [unlike]]) + log_priors).ravel()
        covariances = np.tile(covariances, (2, 1, 1))
        covariances[len(ratios) :, -1, -1] += 2.0 * oil_deviation**2
    return covariances, log_priors


class _LevelScale(NamedTuple):
    """Transform z = asinh(a / (2 c)) of a leak coefficient a: logarithmic for a far above c, linear far below c.

    `level`: mean coefficient of the healthy recordings; `crossover`: c. Both are in the unit of the coefficient.
    """

    level: float
    crossover: float

    def transform(self, excess: Array) -> Array:
        """Compute z = asinh(a / (2 c)) of leak coefficients a = `level` + `excess`, of any shape, with c = `crossover`.

        `level` is the mean coefficient of the healthy recordings.
        """
        return np.asarray(np.arcsinh((self.level + excess) / (2.0 * self.crossover)))

    def slope(self, level: Any) -> Any:
        """Compute dz/da = 1 / sqrt(a^2 + (2 c)^2) of z = asinh(a / (2 c)) at leak coefficients a = `level`.

        c is the `crossover`. `level`: a number or an array; the result has the same shape.
        """
        return 1.0 / np.hypot(level, 2.0 * self.crossover)

    def to_levels(self, predicted: Mixture, transformed: Array) -> Mixture:
        """Convert a distribution of z to a distribution of the leak coefficient, relative to the healthy mean `level`.

        `predicted`: mixture of normal distributions of z, shape (s, g, nodes) as from `Population.predict`, whose
        weights are logarithms and whose centres are relative to `transformed` (s,), the z of the judged recording. Each
        normal distribution is split into `PARTS` narrower ones, along a new last axis, within which the coefficient is
        nearly linear in z. Their mixture has the mean and the variance of the original distribution.
        """
        x, part_weights = np.polynomial.hermite_e.hermegauss(PARTS)  # centres of the parts [standard deviations]
        centres, deviations = predicted.centres + transformed[:, None, None], predicted.deviations[..., None]
        z = np.clip(centres[..., None] + np.sqrt(1.0 - PART_WIDTH**2) * deviations * x, -MAX_Z, MAX_Z)
        return Mixture(
            predicted.weights[..., None] + np.log(part_weights / part_weights.sum()),
            2.0 * self.crossover * np.cosh(z) * PART_WIDTH * deviations,  # da/dz times the deviation of a part
            2.0 * self.crossover * np.sinh(z) - self.level,
        )


def _rise_of_mixture(predicted: Mixture, values: Array) -> Rise:
    """Estimate the rise of a judged value over the value that healthy recordings predict for it.

    `values` (s,): the judged value by s alternative estimates; `predicted`: mixture of predicted values of shape
    (s, ...), for each of these estimates along the first axis, with log weights. The difference of judged and predicted
    value follows the mixture over all estimates. The rise is its median, and the standard deviation half of its central
    68 % interval.
    """
    judged = np.reshape(values, (-1, *[1] * (predicted.centres.ndim - 1)))  # (s, 1, ..., 1)
    log_weights, deviations = predicted.weights.ravel(), predicted.deviations.ravel()
    centres = (predicted.centres - judged).ravel()
    is_counted = log_weights > log_weights.max() - NEGLIGIBLE
    weights = np.exp(log_weights[is_counted] - log_weights.max())
    mixture = Mixture(weights / weights.sum(), deviations[is_counted], centres[is_counted])  # predicted minus judged
    low, median, high = (mixture.quantile(probability) for probability in (0.16, 0.5, 0.84))
    errors = mixture._replace(centres=mixture.centres - median)
    return Rise(value=-median, deviation=0.5 * (high - low), degrees_of_freedom=np.inf, mixture=errors)


class UnusualCondition(NamedTuple):
    """Operating condition of a recording that lies outside of the range `low` to `high` of the healthy recordings.

    `name`: "load" [Pa], "speed" (of the pump, as mean flow [m^3/s]) or "oil" (temperature [degC]); `value`: load, speed
    or temperature in the recording; `log_excess`: log ratio of load or speed to the nearer end of the range. It is 0
    for oil, since the uncertain slope in temperature already covers it.
    """

    name: str
    value: float
    low: float
    high: float
    log_excess: float = 0.0


def find_unusual_conditions(judged: RecordingSums, baseline: Sequence[RecordingSums]) -> list[UnusualCondition]:
    """List the conditions (load, speed, oil temperature) of a recording outside of the range of healthy recordings.

    A condition counts if it lies outside of the healthy range by more than a tolerance (`conditions` in
    `priors.toml`). Unknown temperatures are not compared, nor loads (or speeds) if any of them is 0.
    """
    allowed = INFERENCE.conditions
    unusual: list[UnusualCondition] = []
    loads_and_speeds = (
        ("load", judged.pressure, [healthy.pressure for healthy in baseline]),
        ("speed", judged.flow, [healthy.flow for healthy in baseline]),
    )
    for name, value, healthy_values in loads_and_speeds:
        if not healthy_values or not min(value, *healthy_values) > 0.0:
            continue
        low, high = min(healthy_values), max(healthy_values)
        log_excess = float(max(np.log(value / high), np.log(low / value)))
        if log_excess > allowed.ratio:
            unusual.append(UnusualCondition(name, value, low, high, log_excess))
    oil_temperatures = [healthy.oil_degC for healthy in baseline if healthy.oil_degC is not None]
    if judged.oil_degC is not None and oil_temperatures:
        low, high = min(oil_temperatures), max(oil_temperatures)
        if max(judged.oil_degC - high, low - judged.oil_degC) > allowed.oil:
            unusual.append(UnusualCondition("oil", judged.oil_degC, low, high))
    return unusual


def leak_deviations_from_mean(recordings: Sequence[RecordingSums], columns: Sequence[ColumnRoles]) -> Array:
    """Compute the deviation of each recording's leak coefficient from the mean of all n recordings, shape (n,).

    It is (n - 1)/n times the difference of the recording's coefficient from the common coefficient of the other n - 1
    recordings. The coefficients of all other terms may differ between recordings within the usual prior; only the flow
    offset may differ freely. `columns`: for each equation the indices of its columns by role (leak, motion, left side).
    """
    usual_width, columns = np.ones(1), [roles.with_free_zero() for roles in columns]  # a factor of 1 on the priors
    all_sums = [eliminate_unshared(recording.sums, columns) for recording in recordings]
    total = np.sum(all_sums, axis=0)
    rises = [_estimate_leak_excess(sums, total - sums, columns, usual_width)[0] for sums in all_sums]
    return np.array(rises) * ((len(recordings) - 1) / len(recordings))


class Population:
    """Joint normal distribution of n healthy values and a judged one about an unknown common mean.

    Parameters
    ----------
    candidates : array of float, shape (g, n + 1, n + 1)
        Candidate covariances between the values, the judged one last. They are in addition to the variance sigma^2 of
        each value; n may be 0.
    log_priors : array of float, shape (g,)
        Log prior probability of each candidate.
    """

    def __init__(self, candidates: Array, log_priors: Array) -> None:
        n = candidates.shape[1] - 1
        # only a sample of the healthy values is used, which limits the time
        self._sample = np.unique(np.linspace(0, n - 1, min(n, MAX_RECORDINGS)).astype(int))
        healthy = candidates[:, self._sample[:, None], self._sample]
        eigen, basis = np.linalg.eigh(healthy)
        # the other quantities are stored along these eigenvectors; axes (g, 1, n): 1 for the grid of sigma; `_cross`:
        # covariance of each healthy value with the judged one; `_ones`: change of the values with their mean
        self._eigen, self._basis = np.maximum(eigen, 0.0)[:, None], basis
        self._cross = np.einsum("gij,gi->gj", basis, candidates[:, self._sample, n])[:, None]
        self._ones = basis.sum(axis=1)[:, None]
        self._judged_variance, self._log_priors = candidates[:, n, n, None], log_priors[:, None]

    def rise(self, values: Array, healthy_values: Array, prior_sigma: float, freedom: float) -> Rise:
        """Estimate by how much the judged value exceeds its prediction from healthy values of unknown scatter.

        Parameters
        ----------
        values : array of float, shape (s,)
            The judged value by s alternative estimates, which are weighted by the likelihood of the healthy values.
        healthy_values : array of float, shape (s, n)
            The healthy values by the same estimates.
        prior_sigma, freedom : float
            Scale and degrees of freedom of the prior on the scatter sigma of the values: sigma^2 has a scaled inverse
            chi-squared prior with scale `prior_sigma`^2.

        Returns
        -------
        Rise
            In the unit of the values; with an infinite deviation if the squares would overflow.
        """
        count = len(self._sample)
        healthy = healthy_values[:, self._sample]
        sums_of_squares = freedom * prior_sigma**2 + np.sum(
            (healthy - healthy.mean(axis=1, keepdims=True)) ** 2, axis=1
        )
        if not 1e4 * sums_of_squares.max() < MAX_READING:  # would overflow: return a rise without a bound
            return Rise(float(values.mean()), deviation=np.inf, degrees_of_freedom=freedom)
        # limits of a log-spaced grid of sigma, far below and far above the probable values
        min_sigma = np.sqrt(np.maximum(0.1 * freedom * prior_sigma**2, 1e-9 * sums_of_squares) / (freedom + count))
        max_sigma = np.maximum(100.0 * np.sqrt(sums_of_squares), 10.0 / MAX_READING)
        sigma = np.geomspace(np.maximum(min_sigma, 1.0 / MAX_READING), max_sigma, NODES, axis=1)
        log_prior = -0.5 * freedom * (np.log(sigma**2) + prior_sigma**2 / sigma**2)
        predicted = self.predict(values, healthy_values, sigma, np.zeros(len(values)), log_prior)
        return _rise_of_mixture(predicted._replace(centres=predicted.centres + values[:, None, None]), values)

    def predict(
        self,
        values: Array,
        healthy_values: Array,
        sigma: Array,
        log_priors: Array,
        sigma_log_prior: Array | float = 0.0,
    ) -> Mixture:
        """Predict the judged value from the healthy ones by kriging, as a mixture of normal distributions.

        The prediction is m + c' V^-1 (x - m) for the healthy values x: V is their covariance, c their covariance with
        the judged value, and m the generalised least-squares mean.

        Parameters
        ----------
        values : array of float, shape (s,)
            The judged value by s alternative estimates.
        healthy_values : array of float, shape (s, n)
            The healthy values x by the same estimates.
        sigma : array of float, shape (s, nodes)
            Standard deviations of the values: a log-spaced grid of `NODES` for each alternative estimate.
        log_priors : array of float, shape (s,)
            Log prior of each alternative estimate.
        sigma_log_prior : array of float, shape (s, nodes), or float
            Log prior density of log sigma at the grid points.

        Returns
        -------
        Mixture
            Log weights, standard deviations and centres of shape (s, g, nodes), for g candidate covariances and the
            grid of `sigma`. The centres are relative to `values`.
        """
        healthy = healthy_values[:, self._sample]
        variance = sigma[:, None] ** 2  # (s, 1, nodes)
        weight = 1.0 / (variance[..., None] + self._eigen)  # (s, g, nodes, n)
        weighted_ones, cross = weight * self._ones, self._cross
        precision = (weighted_ones * self._ones).sum(axis=-1)
        rotated = np.einsum("gij,si->sgj", self._basis, healthy)[:, :, None]  # along the eigenvectors
        mean = (weighted_ones * rotated).sum(axis=-1) / precision
        weighted_residual = weight * (rotated - mean[..., None] * self._ones)
        log_likelihood = 0.5 * (
            np.log(weight).sum(axis=-1) - np.log(precision) - (weighted_residual * rotated).sum(axis=-1)
        )
        log_likelihood += self._log_priors + np.reshape(log_priors, (-1, 1, 1))
        # add the log of the prior density of log sigma, times the spacing of its grid
        log_spacing = np.log(np.log(sigma[:, 1:2] / sigma[:, :1]))
        log_likelihood += np.broadcast_to(sigma_log_prior, sigma.shape)[:, None] + log_spacing[:, None]
        centres = mean + (weighted_residual * cross).sum(axis=-1) - values[:, None, None]
        mean_deficit = 1.0 - (weighted_ones * cross).sum(axis=-1)  # weight of the estimated mean in the prediction
        variances = variance + self._judged_variance - (weight * cross**2).sum(axis=-1) + mean_deficit**2 / precision
        return Mixture(log_likelihood, np.sqrt(variances), centres)


def number_sessions(starts: Sequence[float | None], pause: float) -> list[int]:
    """Assign each recording to a session; a gap above `pause` [s] between two dates begins a new session.

    `starts` (n,): dates of the recordings [s since 1970], None if unknown. Return the session number of each
    recording, from 1 on in the order of the dates; -1 for an undated recording.
    """
    dates = sorted(start for start in starts if start is not None)
    session_starts = [date for before, date in zip([-np.inf, *dates], dates, strict=False) if date - before > pause]
    return [-1 if start is None else int(np.searchsorted(session_starts, start, "right")) for start in starts]


class _Oil(NamedTuple):
    """Hypothesis on how the oil's viscosity changed the leakage of n + 1 recordings, the judged one last.

    - `thinning` (n + 1,): predicted logarithm of the leakage, relative to the mean over the n healthy recordings;
    - `variances` (n + 1,): variance of the error of each prediction, without the error of its slope;
    - `log_probability`: log prior probability of the hypothesis;
    - `slope_deviation`: relative standard deviation of the slope of `thinning` in temperature or pressure drop;
    - `session_deviation`: standard deviation of the logarithm between sessions, 0 if the oil is known.
    """

    thinning: Array
    variances: Array
    log_probability: float = 0.0
    slope_deviation: float = 0.0
    session_deviation: float = 0.0


def predict_thinning(recordings: Sequence[RecordingSums]) -> Array:
    """Predict by how much thin oil raised the log leakage of each recording (n + 1,), the judged one last.

    The predictions are relative to the mean over the n healthy recordings. They are all 0 if nothing shows the oil's
    viscosity.
    """
    return _oil_hypotheses(recordings)[0].thinning


def _oil_hypotheses(recordings: Sequence[RecordingSums]) -> list[_Oil]:
    """List the hypotheses on how the oil changed the leakage of `recordings`, the judged one last.

    If all recordings have an oil temperature, the temperature predicts the effect. Otherwise the viscous drop of the
    motion may show the viscosity (`_oils_by_drop`), or the oil is unknown. The most probable hypothesis is the first.
    """
    prior, zeros = INFERENCE.oil, np.zeros(len(recordings))
    temperatures = [recording.oil_degC for recording in recordings if recording.oil_degC is not None]
    if len(temperatures) == len(recordings):
        warmer = np.array(temperatures) - np.mean(temperatures[:-1])
        slope_deviation = prior.per_kelvin_deviation / prior.per_kelvin
        return [_Oil(prior.per_kelvin * warmer, zeros, slope_deviation=slope_deviation)]
    # half the log range is the standard deviation between two sessions, which is sqrt(2) times that of one session
    unknown = _Oil(zeros, zeros, session_deviation=float(np.sqrt(0.125) * np.log(prior.warmest)))
    by_drop = _oils_by_drop(recordings, unknown.session_deviation)
    if not by_drop:
        return [unknown]
    oils = [*by_drop, unknown._replace(log_probability=float(np.log1p(-prior.drop_tells)))]
    return sorted(oils, key=lambda oil: -oil.log_probability)


def _oils_by_drop(recordings: Sequence[RecordingSums], unknown_deviation: float) -> list[_Oil]:
    """List the hypotheses by which the viscous drop of the motion shows the oil of `recordings`, the judged one last.

    The resistance to the motion at the top speed v, friction + drop v, is known well. Friction and viscous drop are
    known less well, since friction varies with speed and load. There are two hypotheses:

    - Friction changed, as if seals wore, and the drop is the fitted one.
    - Friction was what it is in the healthy recordings, and drop = (resistance at v - healthy friction) / v.

    Their probabilities follow from the judged friction and from the n healthy drops. Splitting the resistance wrongly
    makes these drops scatter more. With an unknown scatter, their density is proportional to S^(-(n - 1) / 2), where S
    is the sum of the squares of their logarithms about the mean and of their relative errors.

    A drop below its standard error is replaced by this error. A recording without a drop gets the mean drop, and the
    error of unknown oil: `unknown_deviation`, the standard deviation of the logarithm of the leakage. The list is empty
    if the judged recording or all healthy ones have no drop.
    """
    prior, no_fit = INFERENCE.oil, np.full(len(Resistance._fields), np.nan)
    friction, friction_error, drop, drop_error, speed = np.array(
        [no_fit if recording.resistance is None else recording.resistance for recording in recordings]
    ).T
    is_known = np.isfinite(drop)
    if not (is_known[-1] and is_known[:-1].any()):
        return []
    healthy = np.flatnonzero(is_known[:-1])
    sign = np.sign((friction / friction_error)[healthy].sum()) or 1.0  # friction resists the motion
    friction, drop = sign * friction, sign * drop
    usual_friction, top_speed = (float(np.median(values[healthy])) for values in (friction, speed))
    drops, log_densities = [drop], np.zeros(1)
    if min(usual_friction, friction[-1]) > 0.0:  # else their ratio has no logarithm
        drops.append(drop + (friction - usual_friction) / top_speed)
        change = float(np.log(friction[-1] / usual_friction))
        # prior deviations of this change under the two hypotheses: friction changed, or did not
        deviations = np.array([prior.friction_changes, prior.friction_session])
        log_densities = -0.5 * (change / deviations) ** 2 - np.log(deviations)
    shown_drops = np.maximum(drops, drop_error)  # (hypotheses, n + 1)
    healthy_logs = np.log(shown_drops[:, healthy])
    squares = (healthy_logs - healthy_logs.mean(axis=1, keepdims=True)) ** 2
    squares += (drop_error[healthy] / shown_drops[:, healthy]) ** 2
    log_densities = log_densities - 0.5 * (len(healthy) - 1) * np.log(squares.sum(axis=1))
    log_probabilities = np.log(prior.drop_tells) + log_densities - np.logaddexp.reduce(log_densities)
    variance, oils = unknown_deviation**2, list[_Oil]()
    for shown, mean, log_probability in zip(
        shown_drops, healthy_logs.mean(axis=1).tolist(), log_probabilities.tolist(), strict=True
    ):
        error_variance = (prior.per_drop * drop_error / shown) ** 2
        # variance of the true drop over that of the measured one
        reliability = np.where(is_known, variance / (variance + error_variance), 0.0)
        thinning = -prior.per_drop * reliability * np.where(is_known, np.log(shown) - mean, 0.0)
        deviation = prior.per_drop_deviation / prior.per_drop
        oils.append(_Oil(thinning, (1.0 - reliability) * variance, log_probability, slope_deviation=deviation))
    return oils


def coefficient_level(gram: Array, columns: Sequence[ColumnRoles]) -> tuple[float, float]:
    """Estimate the leak coefficient, at least 0, and its standard error from the Gram matrices `gram` (E, m, m).

    `columns`: for each equation the indices of its columns by role (leak, motion, left side). The coefficients of the
    other terms (nuisances) are eliminated from each equation by the Schur complement, and the equations are added up;
    those that recordings do not share are already eliminated from `gram` (`eliminate_unshared`). Both results are 0 if
    the matrices have no information on the leak.
    """
    precision, moment = 0.0, 0.0
    for e, roles in enumerate(columns):
        nuisance = [k for k in roles.compared if k != roles.leak and np.isfinite(roles.between_deviation[k])]
        cross = gram[e][nuisance, roles.leak]
        solved = solve(gram[e][np.ix_(nuisance, nuisance)], np.column_stack([cross, gram[e][nuisance, roles.left]]))
        precision += float(gram[e][roles.leak, roles.leak] - cross @ solved[:, 0])
        moment += float(gram[e][roles.leak, roles.left] - cross @ solved[:, 1])
    return (max(moment, 0.0) / precision, precision**-0.5) if precision > 0.0 else (0.0, 0.0)


def motion_change(judged: Array, healthy: Array, roles: ColumnRoles) -> tuple[float, float]:
    """Estimate the log ratio of a recording's motion coefficient (area of the piston) to that of healthy recordings.

    Returns the logarithm and its standard error, which contains the error of the recording's fit but not the error of
    the healthy fit. The ratio differs from 1 if area over displacement changed: another machine, or another scale of a
    sensor.

    The regression is the volume balance. `judged`, `healthy`: its Gram matrices (m, m) of the recording and of the sum
    of the healthy ones; `roles`: indices of their columns by role (leak, motion, left side). Each of the two fits gives
    a coefficient for each direction of the motion and each loaded side. Their mean, weighted by the sums of squares of
    these columns in the recording, is the motion coefficient [m^2]. In the recording's fit the motion, its delay
    (`terms.LAG`) and the leak are free; without the leak, the motion would absorb leakage in proportion to the speed.
    The other coefficients differ from the healthy ones by a normal prior (`between` in `priors.toml`).
    """
    motion = [k for k in roles.motion if roles.names[k] != LAG]
    fitted = [k for k in roles.compared if k == roles.leak or np.isfinite(roles.between_deviation[k])]
    reference = solve(healthy[np.ix_(fitted, fitted)], healthy[fitted, roles.left])
    is_free = np.isin(fitted, [*roles.motion, roles.leak])
    leak_coefficient = reference[fitted.index(roles.leak)]
    precision = roles.difference_precisions(fitted, reference, leak_coefficient)
    gram = judged[np.ix_(fitted, fitted)]
    # limited to a precision that is enough to fix a coefficient
    prior = np.where(is_free, 0.0, np.minimum(precision, 1e9 * np.diag(gram)))
    weights = np.where(np.isin(fitted, motion), np.diag(gram), 0.0)
    # second right side: gives the variance of the weighted sum of the coefficients
    right_sides = np.column_stack([judged[fitted, roles.left] + prior * reference, weights])
    coefficients, error_weights = solve(gram + np.diag(prior), right_sides).T
    # means of the motion coefficients, times the sum of the weights, which cancels in both results
    motion_sum, healthy_sum = (max(abs(float(weights @ c)), TINY) for c in (coefficients, reference))
    return math.log(motion_sum / healthy_sum), math.sqrt(max(float(weights @ error_weights), 0.0)) / motion_sum


def student_rise(value: float, deviations: Sequence[float] | Array, prior_scatter: float) -> Rise:
    """Make a rise by `value` whose error follows Student's t, with the scatter of n healthy recordings as its scale.

    `deviations` (n,): deviation d_j of each healthy recording from the mean of the others; `prior_scatter`: prior
    standard deviation s of a recording, which counts as much as m recordings (`scatter.freedom` of `priors.toml`). All
    are in the unit of `value`. With m + n - 1 degrees of freedom,

        deviation^2 = (m s^2 + ((n - 1)/n)^2 sum d_j^2) / (m + n - 1) (1 + 1/n).
    """
    prior, count = INFERENCE.scatter, len(deviations)
    sum_of_squares = prior.freedom * prior_scatter * prior_scatter
    freedom = prior.freedom + count - 1
    if count > 1:
        sum_of_squares += float(np.sum(np.square(deviations))) * ((count - 1) / count) ** 2
    deviation = max(float(np.sqrt(sum_of_squares / freedom * (1.0 + 1.0 / count))), np.finfo(float).tiny)
    return Rise(value, deviation, degrees_of_freedom=freedom)


def eliminate_unshared(gram: Array, columns: Sequence[ColumnRoles]) -> Array:
    """Eliminate the coefficients that recordings do not share, such as a constant loss of oil, from each equation.

    These are the coefficients without a prior on differences between recordings. The leakage of a pump that holds the
    load is not eliminated, but set to zero first, since it counts only within a recording (`ColumnRoles.hold_leak`).
    `gram` (E, m, m): Gram matrices of E equations; `columns`: for each equation the indices of its columns by role
    (leak, motion, left side). The result is the Schur complement of the same shape, in which the rows and columns of
    the eliminated coefficients are zero.
    """
    reduced = gram.copy()
    for e, roles in enumerate(columns):
        if roles.hold_leak is not None:
            reduced[e][roles.hold_leak] = reduced[e][:, roles.hold_leak] = 0.0
        unshared = [k for k in roles.compared if k != roles.leak and not np.isfinite(roles.between_deviation[k])]
        cross = reduced[e][:, unshared].copy()
        reduced[e] -= cross @ solve(reduced[e][np.ix_(unshared, unshared)], cross.T)
        reduced[e][unshared] = reduced[e][:, unshared] = 0.0
    return reduced


class LawFit(NamedTuple):
    """Comparison of an orifice's law with the laminar law, for leakage above that of healthy recordings.

    `regression`: slope of the flow sign(dp) sqrt(abs(dp)) of a unit orifice on dp = p_A - p_B [Pa^-0.5], with all other
    terms eliminated; `log_ratio`: log likelihood ratio of the orifice to the laminar leak for one independent residual,
    -log(residual sum of squares with the orifice / the same with the laminar leak) / 2. A recording counts as
    `size.readings` independent residuals (`priors.toml`).
    """

    regression: float
    log_ratio: float


def compare_laws(
    judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[ColumnRoles]
) -> LawFit | None:
    """Compare how well a turbulent leak through an orifice and a laminar leak explain a recording's excess flow.

    Each leak is fitted to the residual of the recording `judged` under the coefficients of the healthy recordings,
    `baseline`. `columns`: for each equation the indices of its columns by role (leak, motion, left side). Return None
    if the volume balance has no column of an orifice, if the recording has no information on one of the two leaks, or
    if the columns of the two leaks are not positively correlated.
    """
    if any(ORIFICE not in roles.names for roles in columns):
        return None
    reference = np.sum([recording.sums for recording in baseline], axis=0)
    grams, moments, square_without_leak = np.zeros((2, 2)), np.zeros(2), 0.0
    for e, roles in enumerate(columns):
        gram, leaks = judged.sums[e], [roles.leak, roles.names.index(ORIFICE)]  # laminar, orifice
        residual, nuisance, prior = _residual_products(gram, reference[e], roles)
        regularised = gram[np.ix_(nuisance, nuisance)] + np.diag(prior)
        solved = solve(regularised, np.column_stack([gram[np.ix_(nuisance, leaks)], residual[nuisance]]))
        solved_leaks, solved_residual = solved[:, :2], solved[:, 2]
        grams += gram[np.ix_(leaks, leaks)] - gram[np.ix_(leaks, nuisance)] @ solved_leaks
        moments += residual[leaks] - gram[np.ix_(leaks, nuisance)] @ solved_residual
        square_without_leak += float(residual[-1] - residual[nuisance] @ solved_residual)
    energies, cross = np.diag(grams), grams[0, 1]
    if not energies.min() > 0.0 or not cross > 0.0:
        return None
    min_square = 1e-9 * abs(square_without_leak) + TINY  # above rounding errors
    laminar, orifice = np.maximum(square_without_leak - moments**2 / energies, min_square)
    return LawFit(regression=float(cross / energies[0]), log_ratio=float(-0.5 * np.log(orifice / laminar)))


def compare_with_leak(
    judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[ColumnRoles], rival: str
) -> float | None:
    """Compare how well the leak and another term of the volume balance, `rival`, explain a recording's excess flow.

    Each is fitted in turn to the residual of the recording under the coefficients of the healthy recordings,
    `baseline`. Returns the log likelihood ratio of the rival to the leak for one independent residual,

        -log(residual sum of squares with the rival / the same with the leak) / 2.

    The caller multiplies it by the number of independent residuals of a recording. While the rival (for example an
    external leak) is fitted, the leak may differ as it does between healthy recordings. A negative coefficient is not
    fitted, except that of free air, of which there may be less. `columns`: for each equation the indices of its columns
    by role (leak, motion, left side).
    Return None if the balance has no column named `rival`, or if the recording has no information on the leak or on the
    rival.
    """
    if any(rival not in roles.names for roles in columns):
        return None
    reference = np.sum([recording.sums for recording in baseline], axis=0)
    residual_squares = []
    for is_rival in (False, True):
        # sums over the equations: square of the tested column, its product with the residual, square of the residual
        energy = moment = square_without = 0.0
        for e, roles in enumerate(columns):
            gram = judged.sums[e]
            tested = roles.names.index(rival) if is_rival else roles.leak
            # `products`: of the residual with each column, and last with itself
            products, nuisance, prior = _residual_products(gram, reference[e], roles, has_leak=is_rival)
            regularised = gram[np.ix_(nuisance, nuisance)] + np.diag(prior)
            solved = solve(regularised, np.column_stack([gram[nuisance, tested], products[nuisance]]))
            energy += float(gram[tested, tested] - gram[tested, nuisance] @ solved[:, 0])
            moment += float(products[tested] - gram[tested, nuisance] @ solved[:, 1])
            square_without += float(products[-1] - products[nuisance] @ solved[:, 1])
        if not energy > 0.0:
            return None
        can_be_negative = is_rival and rival == AIR  # there may be less air, but oil only leaves
        gain = (moment if can_be_negative else max(moment, 0.0)) ** 2 / energy  # decrease of the residual square
        min_square = 1e-9 * abs(square_without) + TINY  # above rounding errors
        residual_squares.append(max(square_without - gain, min_square))
    with_leak, with_rival = residual_squares
    return float(-0.5 * np.log(with_rival / with_leak))


class _Residual(NamedTuple):
    """Residual of a recording's volume balance under the coefficients of healthy recordings.

    `products` (m,): scalar products of the residual with each column, and last with itself; `nuisance`: indices of
    the c columns whose coefficients may differ between recordings; `prior_precision` (c,): precisions of the priors
    on these differences.
    """

    products: Array
    nuisance: list[int]
    prior_precision: Array


def _residual_products(gram: Array, reference: Array, roles: ColumnRoles, *, has_leak: bool = False) -> _Residual:
    """Compute the residual of a recording under the coefficients fitted to other recordings (`_Residual`).

    `gram`, `reference` (m, m): Gram matrices of the recording and of the sum of the others; `roles`: indices of their
    columns by role (leak, motion, left side). Compared coefficients with a prior on their differences may differ from
    the coefficients of the other recordings within this prior. The leak's coefficient may differ only with `has_leak`,
    by the prior `between.pump`.
    """
    compared = [k for k in roles.compared if k == roles.leak or np.isfinite(roles.between_deviation[k])]
    coefficients = np.zeros(len(gram))
    coefficients[compared] = -solve(reference[np.ix_(compared, compared)], reference[compared, roles.left])
    nuisance = [k for k in compared if has_leak or k != roles.leak]
    prior = roles.difference_precisions(nuisance, coefficients[nuisance], coefficients[roles.names.index(LEAK)])
    coefficients[roles.left] = 1.0  # residual = left side - sum of the fitted terms
    products = gram @ coefficients
    products[roles.left] = coefficients @ products  # the residual's sum of squares
    # limited, as the prior on a coefficient of zero has an infinite precision
    prior = np.minimum(prior, 1e9 * np.diag(gram)[nuisance])
    return _Residual(products, nuisance, prior_precision=prior)


def _estimate_leak_excess(
    gram: Array, reference: Array, columns: Sequence[ColumnRoles], widths: Array
) -> tuple[Array, Array]:
    """Estimate by how much a recording's leak coefficient exceeds that of other recordings, and the standard errors.

    Both results have the shape (s,), for s widths of a prior, and are 0 where there is no information.

    - `gram`, `reference` (E, m, m): Gram matrices of the recording, and of the sum of the others, for E equations.
    - `columns`: for each equation the indices of its columns by role (leak, nuisances, left side).
    - `widths` (s,): factors on the prior standard deviations by which the nuisance coefficients, i.e. those of the
      other terms, differ between recordings.

    The excess is fitted to the residual under the coefficients of the others (`_residual_products`). The nuisance
    coefficients are eliminated (Schur complement). Each equation then states precision x excess = moment. Precisions
    and moments are summed over the equations, and the excess is moment / precision.
    """
    precision, moment = np.zeros((2, len(widths)))
    for e, roles in enumerate(columns):
        residual, nuisance, prior = _residual_products(gram[e], reference[e], roles)
        matrix, cross = gram[e][np.ix_(nuisance, nuisance)], gram[e][nuisance, roles.leak]
        right_sides = np.column_stack([cross, residual[nuisance]])
        for index, width in enumerate(widths):
            # the prior's precision is limited to 1e9 times the recording's, which is enough to fix a coefficient
            regularised = matrix + np.diag(np.minimum(prior / width**2, 1e9 * np.diag(matrix)))
            solved = solve(regularised, right_sides)
            precision[index] += float(gram[e][roles.leak, roles.leak] - cross @ solved[:, 0])
            moment[index] += float(residual[roles.leak] - cross @ solved[:, 1])
    is_known = precision > 0.0
    divisor = np.where(is_known, precision, 1.0)
    return np.where(is_known, moment / divisor, 0.0), np.where(is_known, divisor**-0.5, 0.0)
