"""Comparison of recordings: coefficients by their sums, and the rise of the leakage over healthy ones that scatter.

The Gram matrices are divided by the residual variance of a row (`RecordingSums.sums`), so that their Schur complements
are precisions of coefficients. Those of the healthy recordings are added up and give the coefficients of all terms of
the balance. A recording's residual under these coefficients, projected on the leak's column, is its rise. The
recording's other coefficients may differ from the healthy ones within a prior (`priors.toml`). The flow offset repeats:
a free one would absorb a leak whose flow is nearly constant, and its changes from day to day are part of the scatter.
Load, speed and oil temperature outside of the range of the healthy recordings make a comparison less certain.

The rise r_j of each healthy recording over the n - 1 others measures the scatter, including all
effects that the model does not describe. The comparison uses y_j = r_j (n - 1)/n, the rise over the mean of all n, and
for the judged recording y, its rise.

The width of the prior on the other coefficients is known only to within a factor: one machine, held at one temperature,
repeats its coefficients to a thousandth; another changes by a tenth from run to run. With too narrow a prior the rises
scatter, with too wide a prior they are imprecise. Therefore y is computed for several widths, each weighted by its
prior and by the likelihood of the healthy recordings, p(y_1 .. y_n).

Levels that are clearly above zero are compared as logarithms: z = asinh(a / 2 c). Here a = mean level + y is the level
(leak coefficient) of a recording, and c, which follows from the errors of a, is the level below which z is linear. For
each width all z are normal about an unknown mean. These effects contribute to their covariance:

- Scatter of single recordings: sigma^2 on the diagonal. sigma has a log-uniform prior from a part of a recording's
  standard error to a tenth of the flow, so five recordings that agree allow a smaller sigma than two do.
- Sessions: recordings of one session share oil and set-up. The deviation tau of a session has a half-normal prior.
  Sessions are separated by date; undated recordings form one session.
- Oil (`oil_hypotheses`): leakage is proportional to the inverse of the viscosity. If the oil's temperature is known for
  all recordings, z has an uncertain slope in the temperature; otherwise the viscous pressure drop of the motion
  (`changes.motion_fit`) may show the viscosity. A recording is the less certain the further its oil is from the mean;
  unknown oil is covered by tau.
- Conditions (`find_unusual_conditions`): load and speed outside of the known range make a recording less certain.

The rise follows the mixture over all of these (`Rise`). The flow by which the recording exceeds the healthy ones also
compares laws of a leak, and other terms (`compare_laws`). The priors are in `priors.toml`.

Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 3.2, 5.4 and 5.7; C. E. Rasmussen and C. K.
I. Williams, Gaussian Processes for Machine Learning (2006), section 2.7 (an unknown mean).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol

import numpy as np

from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.estimate.linear import Gaussian, limit_precisions, solve
from sealscope.diagnosis.estimate.population import BOUND_PROBABILITY, NODES, Mixture, Population, number_sessions
from sealscope.diagnosis.healthy import (
    MAX_NUMBER,
    Magnitude,
    Number,
    Summary,
    Texts,
    Time,
    Values,
    stored_array,
)
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, sum_blocks
from sealscope.diagnosis.inference.equations.terms import AIR, LAG, LEAK, ORIFICE
from sealscope.diagnosis.inference.hypotheses import RecordingOdds, compare_residuals
from sealscope.diagnosis.inference.rows import MAX_READING
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.verdict.evidence import VOLUME_BALANCE
from sealscope.recordings.recording import Array
from sealscope.signals.smoothing import TINY

#: Largest ratio of a squared sum of products to the product of the sums of squares: 1 (Cauchy), plus rounding errors.
_ROUNDING = 1.0 + 1e-6


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


@dataclass(frozen=True, eq=False)
class RecordingSums:
    """Sums of one recording, for the comparison with other recordings of the same machine.

    - `sums` (E, m, m): Gram matrix of the m columns of each of E equations, divided by the residual variance of a row,
      with the coefficients eliminated that recordings do not share (`eliminate_unshared`);
    - `flow`, `pressure`: mean magnitudes of the pump's flow [m^3/s] and of p_A - p_B [Pa];
    - `start_s`, `oil_degC`: date [s since 1970] and temperature of the oil, None if unknown;
    - `held` (6,): leaks while shut valves hold the load, in the order of `holds.leaks.HeldLeaks`, or None;
    - `held_pump` (2,): leakage of the pump [m^3/(s Pa)] just before such holds, with standard deviation, or None;
    - `resistance` (5,): what resists the motion (`Resistance`), or None.
    """

    sums: Values
    flow: Magnitude
    pressure: Magnitude
    start_s: Time | None = None
    oil_degC: Number | None = None
    held: Annotated[Array, stored_array(6)] | None = None
    held_pump: Annotated[Array, stored_array(2)] | None = None
    resistance: Annotated[Array, stored_array(5)] | None = None

    @classmethod
    def from_blocks(
        cls, blocks: Blocks, columns: Sequence[ColumnRoles], start_s: float | None = None, oil_degC: float | None = None
    ) -> RecordingSums:
        """Summarise a recording by the sum of its Gram matrices, its mean flow and its mean pressure difference.

        Columns that recordings do not share are eliminated. The flow is weighted by the numbers of rows, `Blocks.rows`.
        """
        flow = float(np.average(blocks.flow, weights=np.maximum(blocks.rows, 1e-9)))  # positive, so that a mean exists
        pressure = float(np.average(blocks.mean_pressure(), weights=blocks.pressure_weights))
        return cls(eliminate_unshared(sum_blocks(blocks, columns), columns), flow, pressure, start_s, oil_degC)

    @property
    def conductance_of_flow(self) -> float:
        """Conductance [m^3/(s Pa)] of a leak as large as the pump's mean flow; 0 if the mean pressure is 0."""
        return self.flow / self.pressure if self.pressure > 0.0 else 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class BalanceSummary(RecordingSums, RecordingOdds, Summary):
    """Summary of a healthy recording by the volume balance (`VolumeBalance.learn`).

    A single recording may leave open whether valves cut the pump off from the cylinder while it rests. The summary
    therefore has Gram matrices for both cases, and log odds, which are later combined over all healthy recordings:

    - the sums of a recording whose pump stays connected at rest, and its evidence for the machine's unknowns;
    - `terms`: names of the balance's terms, the columns of `sums` but the last;
    - `scale`: factor from computed to true flows (`Size`), 0 if no flow can be stated in L/min;
    - `delivered`: mean flow of the pump in motion [m^3/s], as computed with the assumed sizes;
    - `stroke` (2,): ends of the recorded motion [m], None without a position;
    - `shut_sums` (1, m + 2, m + 2): Gram matrix for a pump that valves cut off at rest, which needs two more columns;
      None if the machine never rests.
    """

    method: ClassVar[str] = VOLUME_BALANCE

    terms: Texts
    scale: Magnitude
    delivered: Number = 0.0
    stroke: Annotated[Array, stored_array(2)] | None = None
    shut_sums: Values | None = None

    def check(self) -> None:
        """Check shapes, terms and sums; raise ValueError if they do not fit.

        Leak and left side must have positive sums of squares, and obey Cauchy's inequality.
        """
        size, shut = len(self.terms) + 1, self.shut_sums
        if self.sums.ndim != 3 or not len(self.sums) or self.sums.shape[1:] != (size, size):
            raise ValueError(f"sums must be of the shape (E, {size}, {size}), got {self.sums.shape}")
        if shut is not None and shut.shape != (1, size + 2, size + 2):
            raise ValueError(f"shut_sums must be of the shape (1, {size + 2}, {size + 2}), got {shut.shape}")
        if self.stroke is not None and self.stroke[0] > self.stroke[1]:
            raise ValueError(f"stroke must hold the lower and the upper end of the motion, got {self.stroke}")
        if self.resistance is not None:
            fit = Resistance(*self.resistance)
            if min(fit.friction_error, fit.drop_error, fit.top_speed) < 1.0 / MAX_NUMBER:  # these are divisors
                raise ValueError("resistance must hold positive standard errors and a positive speed")
        if LEAK not in self.terms:
            raise ValueError(f"terms must include {LEAK!r}, got {', '.join(self.terms)}")
        leak = self.terms.index(LEAK)
        squares = self.sums[:, [leak, -1], [leak, -1]]  # (E, 2): sums of squares of leak and left side
        product = self.sums[:, leak, -1]
        if not (squares > 0.0).all() or not (product**2 <= _ROUNDING * squares.prod(axis=1)).all():
            raise ValueError("sums must be sums of squares and products of a leak and a flow, got other numbers")


class ComparedColumns(Protocol):
    """Columns of Gram matrices that are compared between recordings, with their priors, such as `ColumnRoles`.

    - `names`: names of the coefficients; that of a laminar leak is `terms.LEAK`;
    - `compared`: columns whose coefficients are fitted; `leak`, `left`: columns of the leak and of the left side;
    - `healthy_conductance`: standard deviation of a healthy machine's leak [m^3/(s Pa)], infinite if unknown;
    - `between_deviation`: prior standard deviations of differences between recordings, infinite without a prior.
    """

    names: tuple[str, ...]
    compared: tuple[int, ...]
    leak: int
    left: int
    healthy_conductance: float
    between_deviation: Array

    def difference_precisions(self, indices: Sequence[int], coefficients: Array, leak_coefficient: float) -> Array:
        """Compute the prior precisions of differences between recordings."""


def coefficient_level(gram: Array, columns: Sequence[ComparedColumns]) -> tuple[float, float]:
    """Estimate the leak coefficient, at least 0, and its standard error from Gram matrices of the volume balance.

    `gram` (E, m, m): Gram matrices of E equations after `eliminate_unshared`. All other coefficients are free; the
    precisions and moments of the equations are added up. Both results are 0 without information on the leak.
    """
    precision, moment = 0.0, 0.0
    for e, roles in enumerate(columns):
        nuisance = [k for k in roles.compared if k != roles.leak and np.isfinite(roles.between_deviation[k])]
        leak = Gaussian.from_gram(gram[e]).marginal([roles.leak], nuisance)
        precision, moment = precision + leak.precision[0, 0], moment + leak.moment[0]
    return (max(moment, 0.0) / precision, precision**-0.5) if precision > 0.0 else (0.0, 0.0)


def motion_change(judged: Array, healthy: Array, roles: ColumnRoles) -> tuple[float, float]:
    """Estimate the log ratio of a recording's motion coefficient (area of the piston) to that of healthy recordings.

    Returns the log ratio and its standard error, which excludes the error of the healthy fit. The ratio differs from 1
    if piston area over pump displacement changed, as on another machine or by another scale of a sensor.

    `judged`, `healthy`: Gram matrices (m, m) of the volume balance, after `eliminate_unshared`, in the recording and of
    the sum of the healthy ones. Each of the two fits gives a coefficient for each direction of the motion and each
    loaded side. Their mean, weighted by the sums of squares of these columns in the recording, is the motion
    coefficient [m^2]. In the recording's fit the coefficients of the motion, of its delay (`terms.LAG`) and of the leak
    are free: otherwise the motion would absorb leakage. All other coefficients have normal priors about the healthy
    ones (`between` in `priors.toml`).
    """
    motion = [k for k in roles.motion if roles.names[k] != LAG]
    fitted = [k for k in roles.compared if k == roles.leak or np.isfinite(roles.between_deviation[k])]
    reference = Gaussian.from_gram(healthy).among(fitted).mean
    is_free = np.isin(fitted, [*roles.motion, roles.leak])
    leak_coefficient = reference[fitted.index(roles.leak)]
    precision = roles.difference_precisions(fitted, reference, leak_coefficient)
    data = Gaussian.from_gram(judged).among(fitted)
    weights = np.where(np.isin(fitted, motion), np.diag(data.precision), 0.0)
    # means of the motion coefficients, times the sum of the weights, which cancels in both results; magnitudes above 0,
    # for their logarithm
    judged_sum, variance = data.with_prior(np.where(is_free, 0.0, precision), reference).contrast(weights)
    motion_sum, healthy_sum = (max(abs(total), TINY) for total in (judged_sum, float(weights @ reference)))
    return math.log(motion_sum / healthy_sum), math.sqrt(max(variance, 0.0)) / motion_sum


def eliminate_unshared(gram: Array, columns: Sequence[ColumnRoles]) -> Array:
    """Eliminate the coefficients that recordings do not share, such as a constant loss of oil, from each equation.

    Their `between_deviation` is infinite; the leak is kept in any case. The leakage of a pump that holds the load
    counts only within a recording and is set to zero first (`ColumnRoles.hold_leak`). `gram` (E, m, m): Gram matrices
    of E equations. In the result the rows and columns of these coefficients are zero.
    """
    reduced = _remove_hold_leaks(gram, columns)
    for e, roles in enumerate(columns):
        reduced[e] = Gaussian.from_gram(reduced[e]).drop(roles.unshared).gram
    return reduced


def _remove_hold_leaks(gram: Array, columns: Sequence[ColumnRoles]) -> Array:
    """Return Gram matrices (..., E, m, m) with zeros for the leakage of a pump that only holds the load."""
    reduced = gram.copy()
    for e, roles in enumerate(columns):
        if roles.hold_leak is not None:
            reduced[..., e, roles.hold_leak, :] = reduced[..., e, :, roles.hold_leak] = 0.0
    return reduced


def subtract_reference(
    gram: Array, reference: Array, roles: ComparedColumns, *, has_leak: bool = False
) -> tuple[Gaussian, list[int], Array]:
    """Compute the residual of a recording under the coefficients fitted to reference recordings.

    `gram`, `reference` (m, m): Gram matrices of the recording and of the sum of the reference recordings, both after
    `eliminate_unshared`. Returns

    - the likelihood of the differences of the recording's coefficients from the reference, by column;
    - indices of the c columns whose coefficients may differ between recordings, with the leak only if `has_leak`;
    - precisions (c,) of the priors on these differences; that of a laminar leak is the pump's (`between.pump`).

    The leak is always fitted to the reference recordings. Behind a servo valve, whose overlap can look like a leak, it
    then has the prior of a healthy piston. Other columns are fitted unless they may differ between recordings without
    limit (infinite `between_deviation`).
    """
    compared = [k for k in roles.compared if k == roles.leak or np.isfinite(roles.between_deviation[k])]
    # precision of the leak's prior: 0 if the healthy leakage is unknown
    healthy = np.where(np.array(compared) == roles.leak, roles.healthy_conductance**-2, 0.0)
    fit = Gaussian.from_gram(reference).among(compared) + Gaussian(np.diag(healthy), np.zeros(len(compared)))
    coefficients = np.zeros(len(gram) - 1)
    coefficients[compared] = fit.mean
    # of the laminar leak, even if another term takes its place in `roles.leak` (`ColumnRoles.replace_leak`)
    leak_coefficient = coefficients[roles.names.index(LEAK)]
    nuisance = [k for k in compared if has_leak or k != roles.leak]
    prior = roles.difference_precisions(nuisance, coefficients[nuisance], leak_coefficient)
    return Gaussian.from_gram(gram).subtract(coefficients), nuisance, prior


def marginal_difference(residual: Gaussian, tested: Sequence[int], nuisance: Sequence[int], prior: Array) -> Gaussian:
    """Compute the likelihood of the `tested` differences, with those of the columns `nuisance` (c,) integrated out.

    A difference is the coefficient of a column in the judged recording less that in the healthy ones. `residual`: their
    likelihood in all columns; `prior` (c,): precisions of the nuisance differences about zero. All three arguments are
    as `subtract_reference` returns them.
    """
    differences = residual.among(nuisance).with_prior(prior)
    return differences.integrate_out(residual.precision[np.ix_(tested, nuisance)], residual.among(tested))


def estimate_leak_excess(
    gram: Array, reference: Array, columns: Sequence[ComparedColumns], widths: Array
) -> tuple[Array, Array]:
    """Estimate the excess of a recording's leak coefficient over that of reference recordings, and the standard errors.

    `gram`, `reference` (E, m, m): Gram matrices of the recording, and of the sum of the reference recordings, for E
    equations after `eliminate_unshared`; `widths` (s,): factors on the prior standard deviations of the differences
    between recordings in the coefficients of all terms but the leak. Both results (s,) are 0 where there is no
    information. The excess is fitted to the residual under the coefficients of the reference recordings
    (`subtract_reference`); the precisions and moments of the equations are added up.
    """
    precision, moment = np.zeros((2, len(widths)))
    for e, roles in enumerate(columns):
        residual, nuisance, prior = subtract_reference(gram[e], reference[e], roles)
        differences, tested = residual.among(nuisance), residual.among([roles.leak])
        coupling = residual.precision[roles.leak, nuisance][None]
        for index, width in enumerate(widths):  # `marginal_difference`
            leak = differences.with_prior(prior / width**2).integrate_out(coupling, tested)
            precision[index] += leak.precision[0, 0]
            moment[index] += leak.moment[0]
    is_known = precision > 0.0
    divisor = np.where(is_known, precision, 1.0)
    return np.where(is_known, moment / divisor, 0.0), np.where(is_known, divisor**-0.5, 0.0)


def block_weights(grams: Array, reference: Array, columns: Sequence[ColumnRoles]) -> Array:
    """Compute the weights (K,) of K blocks in a recording's excess over reference recordings; their sum is 1.

    A leak with the coefficient g_k in block k causes the excess sum_k w_k g_k (`estimate_leak_excess` for the width 1).
    With N_k, the sum of squares of the leak's column in the block, and C_k, its products with the columns of the other
    terms,

        w_k = sum_e (N_k - C (G + P)^-1 C_k') / sum_e (N - C (G + P)^-1 C'),

    where sum_e is over E equations. N and C are the sums over the blocks, G is the Gram matrix of the other columns,
    and P the prior precision of their coefficients. The weight of a block in which the other terms explain the leak is
    small, and may be negative. Without information all weights are equal.

    `grams` (K, E, m, m): Gram matrices of the blocks (`blocks.scale_grams`); `reference` (E, m, m): sum of those of the
    reference recordings, after `eliminate_unshared`.
    """
    grams = _remove_hold_leaks(grams, columns)
    totals = grams.sum(axis=0)
    shared = eliminate_unshared(totals, columns)
    weights = np.zeros(len(grams))
    for e, roles in enumerate(columns):
        _, nuisance, prior = subtract_reference(shared[e], reference[e], roles)  # the residual has no effect on weights
        eliminated = [*nuisance, *roles.unshared]
        matrix = totals[e][np.ix_(eliminated, eliminated)]
        n = len(nuisance)  # only these have a prior, limited as in `estimate_leak_excess`
        matrix[:n, :n] += np.diag(limit_precisions(prior, shared[e][np.ix_(nuisance, nuisance)]))
        factors = solve(matrix, totals[e][eliminated, roles.leak])
        weights += grams[:, e, roles.leak, roles.leak] - grams[:, e, roles.leak][:, eliminated] @ factors
    total = float(weights.sum())
    return weights / total if total > 0.0 else np.full(len(grams), 1.0 / len(grams))


class UnusualCondition(NamedTuple):
    """Operating condition of a recording that lies outside of the range `low` to `high` of the healthy recordings.

    `name`: "load" [Pa], "speed" (of the pump, as mean flow [m^3/s]) or "oil" (temperature [degC]), with its `value` in
    the recording; `log_excess`: magnitude of the log ratio of load or speed to the nearer end of the range. It is 0 for
    oil, whose effect has an uncertain slope in temperature (`levels.oil_hypotheses`), which already covers it.
    """

    name: str
    value: float
    low: float
    high: float
    log_excess: float = 0.0


def find_unusual_conditions(judged: RecordingSums, baseline: Sequence[RecordingSums]) -> list[UnusualCondition]:
    """List the conditions (load, speed, oil temperature) of a recording outside of the range of healthy recordings.

    The load is the mean pressure difference, the speed the mean flow. They may exceed the range by the factor
    exp(`ratio`), and the temperature by `oil` [K] (`conditions` in `priors.toml`). Unknown temperatures are not
    compared, and loads (or speeds) are not compared if any of them is 0.
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


#: `Observable.data` of the leakage against healthy recordings.
RISE = "rise"
#: Reach of a grid of rises [standard deviations].
MAX_LOG = 4.0
#: Parts of a mixture are omitted if their log weight is lower than the largest by more than this.
NEGLIGIBLE = 16.0


class Rise(NamedTuple):
    """Amount by which a recording's leak coefficient exceeds that of healthy recordings, with its distribution.

    - `value`, `deviation`: estimate and standard deviation, in the unit of the coefficient;
    - `mixture`: distribution of `value` in a healthy recording. If None, `value` / `deviation` is Student's t with
      `degrees_of_freedom`;
    - `share`: fraction of the allowed false alarms that is left to this rise, by which its p-value is divided. It must
      be 1 for `bound`, `interval` and `log_ratio_within`.
    """

    value: float
    deviation: float
    degrees_of_freedom: float
    mixture: Mixture | None = None
    share: float = 1.0

    def share_alarms(self, share: float) -> Rise:
        """Return a copy that gets only the fraction `share` of the allowed false alarms, as one of several tests."""
        return self._replace(share=share)

    def widen(self, variance: float) -> Rise:
        """Add an error with the given `variance` to the rise; unchanged for a variance <= 0 or without a mixture."""
        if self.mixture is None or not variance > 0.0:
            return self
        mixture = self.mixture._replace(deviations=np.sqrt(self.mixture.deviations**2 + variance))
        return self._replace(deviation=float(np.sqrt(self.deviation**2 + variance)), mixture=mixture)

    @property
    def score(self) -> float:
        """The estimated rise divided by its standard deviation."""
        return self.value / self.deviation

    @property
    def chance(self) -> float:
        """Probability that a healthy recording scores higher (one-sided p-value), divided by `share`; at most 1."""
        from scipy.special import ndtr, stdtr

        if self.mixture is None:
            chance = float(stdtr(self.degrees_of_freedom, -self.score))
        else:
            weights, deviations, centres = self.mixture
            chance = float(weights @ ndtr((centres - self.score * self.deviation) / deviations))
        return min(chance / max(self.share, TINY), 1.0)

    def threshold(self, chance: float) -> float:
        """Compute the score whose p-value (the property `chance`) is the argument `chance`, between 0 and 1."""
        from scipy.special import stdtrit

        probability = 1.0 - chance * self.share
        if self.mixture is None:
            return float(stdtrit(self.degrees_of_freedom, probability))
        return self.mixture.quantile(probability) / self.deviation

    def log_ratio(self, rise: float, log_deviation: float = 0.0) -> float:
        """Compute the log likelihood ratio of two hypotheses: the leak's coefficient rose by `rise`, and it did not.

        `log_deviation`: standard deviation of the logarithm of the true rise about log(`rise`); the true rise is
        exactly `rise`, in the unit of `value`, if it is 0 or if `rise` has no logarithm.
        """
        if log_deviation > 0.0 and rise > 0.0:
            return self._log_ratio_lognormal(rise, log_deviation)
        return self._log_density(self.value - rise) - self._log_density(self.value)

    def log_ratio_within(self, rise: float, tail: float) -> float:
        """Compute the log likelihood ratio of a rise by `rise` to no rise, robust to an outlying estimate `value`.

        Both densities of `value` are at least the smaller of those of a healthy recording at its quantiles `tail` and
        1 - `tail`: an estimate that is improbable with the rise and without it is evidence for neither.
        """
        tail_values = [self.threshold(chance) * self.deviation for chance in (tail, 1.0 - tail)]
        min_log_density = min(self._log_density(value) for value in tail_values)
        with_rise = max(self._log_density(self.value - rise), min_log_density)
        return with_rise - max(self._log_density(self.value), min_log_density)

    def _log_ratio_lognormal(self, rise: float, log_deviation: float) -> float:
        """Compute the log likelihood ratio of a true rise with a log-normal prior (`log_ratio`) to no rise.

        The integral over the prior uses a grid that resolves both the prior and the likelihood.
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
        """Compute the log probability density of the estimate `value` in a healthy recording, up to a constant."""
        if self.mixture is None:
            z = value / self.deviation
            if np.isinf(self.degrees_of_freedom):  # Student's t is then normal
                return -0.5 * z * z
            return float(-0.5 * (self.degrees_of_freedom + 1.0) * np.log1p(z * z / self.degrees_of_freedom))
        weights, deviations, centres = self.mixture
        log_weights = np.log(np.maximum(weights, np.finfo(float).tiny)) - np.log(deviations)
        return float(np.logaddexp.reduce(log_weights - 0.5 * ((value - centres) / deviations) ** 2))

    def bound(self) -> float:
        """Compute the 95 % upper bound of the true rise, in the unit of `value`; a negative `value` counts as zero."""
        # the score that a healthy recording exceeds with a probability of 95 % is negative
        return max(self.value, 0.0) - self.threshold(BOUND_PROBABILITY) * self.deviation

    def interval(self, probability: float = BOUND_PROBABILITY) -> tuple[float, float]:
        """Compute the central interval (low, high) that contains the true rise with the given `probability`."""
        tail = 0.5 - 0.5 * probability  # on either side of the interval
        max_error, min_error = (self.threshold(chance) * self.deviation for chance in (tail, 1.0 - tail))
        return self.value - max_error, self.value - min_error

    @property
    def normal_deviation(self) -> float:
        """Standard error of the rise: that of a normal distribution whose 95 % interval has the width of `interval`."""
        return Interval(self.value, *self.interval()).deviation


def rise_of_mixture(predicted: Mixture, values: Array) -> Rise:
    """Estimate the rise of a judged value over the value that healthy recordings predict for it.

    `values` (s,): the judged value by s alternative estimates; `predicted`: mixture of predicted values of shape (s,
    ...), with log weights. The rise is the median of judged minus predicted value over all estimates, and its standard
    deviation is half the width of the central 68 % interval, infinite if no part has finite numbers.
    """
    judged = np.reshape(values, (-1, *[1] * (predicted.centres.ndim - 1)))  # (s, 1, ..., 1)
    log_weights, deviations = predicted.weights.ravel(), predicted.deviations.ravel()
    centres = (predicted.centres - judged).ravel()
    max_log_weight = float(np.max(log_weights, initial=-np.inf, where=np.isfinite(log_weights + centres)))
    is_counted = (log_weights > max_log_weight - NEGLIGIBLE) & np.isfinite(centres)
    if not is_counted.any():  # impossible readings, of which nothing can be predicted
        return Rise(float(values.mean()), deviation=np.inf, degrees_of_freedom=1.0)
    weights = np.exp(log_weights[is_counted] - max_log_weight)
    mixture = Mixture(weights / weights.sum(), deviations[is_counted], centres[is_counted])  # predicted minus judged
    low, median, high = (mixture.quantile(probability) for probability in (0.16, 0.5, 0.84))
    errors = mixture._replace(centres=mixture.centres - median)
    return Rise(value=-median, deviation=0.5 * (high - low), degrees_of_freedom=np.inf, mixture=errors)


class OilHypothesis(NamedTuple):
    """Hypothesis on how the oil's viscosity changed the leakage of n + 1 recordings, the judged one last.

    - `thinning` (n + 1,): predicted logarithm of the leakage, relative to the mean over the n healthy recordings;
    - `variances` (n + 1,): variance of the error of each prediction, without the error of its slope;
    - `log_probability`: log probability of the hypothesis, given the resistances to the motion;
    - `slope_deviation`: relative standard deviation of the slope of `thinning` in temperature or pressure drop;
    - `session_deviation`: standard deviation of a session's log leakage by unknown oil, 0 if the oil is known.
    """

    thinning: Array
    variances: Array
    log_probability: float = 0.0
    slope_deviation: float = 0.0
    session_deviation: float = 0.0


def oil_hypotheses(recordings: Sequence[RecordingSums]) -> list[OilHypothesis]:
    """List the hypotheses on how the oil changed the leakage of `recordings`, the judged one last, most probable first.

    If all recordings have an oil temperature, it predicts the effect. Otherwise the viscous drop of the motion may show
    the viscosity (`_oils_by_drop`), or the oil is unknown.
    """
    prior, zeros = INFERENCE.oil, np.zeros(len(recordings))
    temperatures = [recording.oil_degC for recording in recordings if recording.oil_degC is not None]
    if len(temperatures) == len(recordings):
        warmer = np.array(temperatures) - np.mean(temperatures[:-1])
        slope_deviation = prior.per_kelvin_deviation / prior.per_kelvin
        return [OilHypothesis(prior.per_kelvin * warmer, zeros, slope_deviation=slope_deviation)]
    # half of log(warmest), the range, is the standard deviation of the difference of two sessions: sqrt(2) times that
    # of one session
    unknown = OilHypothesis(zeros, zeros, session_deviation=float(np.sqrt(0.125) * np.log(prior.warmest)))
    by_drop = _oils_by_drop(recordings, unknown.session_deviation)
    if not by_drop:
        return [unknown]
    oils = [*by_drop, unknown._replace(log_probability=float(np.log1p(-prior.drop_tells)))]
    return sorted(oils, key=lambda oil: -oil.log_probability)


def _oils_by_drop(recordings: Sequence[RecordingSums], unknown_deviation: float) -> list[OilHypothesis]:
    """List the hypotheses on the oil that follow from the viscous drop of the motion.

    `recordings`: the healthy ones, then the judged one. The resistance to the motion at the top speed v, friction +
    drop v, is known well. Friction and viscous drop are known less well, since friction varies with speed and load.
    There are two hypotheses, in which the healthy friction and v are medians over the healthy recordings. Only the
    first counts if the judged or the healthy friction is not positive:

    - Friction changed, as if seals wore, and the drop is the fitted one.
    - Friction was what it is in the healthy recordings, and drop = (resistance at v - healthy friction) / v.

    Their probabilities, with the sum `oil.drop_tells` of `priors.toml`, follow from the judged friction and from the n
    healthy drops. Splitting the resistance wrongly makes these drops scatter more. With an unknown scatter, their
    density is proportional to S^(-(n - 1) / 2), where S is the sum of two kinds of squares: of the logarithms of the
    drops about their mean, and of the relative errors of the drops.

    Each hypothesis is listed twice: once with the judged drop as a sign of the oil, and once, with the small prior
    probability `oil.drop_misleads`, without this sign, as if something else, such as a swollen seal, had changed the
    judged drop. That changes the friction, too, which therefore has the density of the first hypothesis.

    A drop predicts the thinning -`oil.per_drop` r (log drop - mean of the healthy ones), with the reliability r, the
    variance of true drops over that of measured ones. A drop below its standard error is replaced by this error. A
    recording without a drop gets the mean drop, and the error of unknown oil: `unknown_deviation`, the standard
    deviation of the logarithm of the leakage. The list is empty if the judged recording has no drop, or none of the
    healthy ones has.
    """
    prior, no_fit = INFERENCE.oil, np.full(len(Resistance._fields), np.nan)
    friction, friction_error, drop, drop_error, speed = np.array(
        [no_fit if recording.resistance is None else recording.resistance for recording in recordings]
    ).T  # (n + 1,) each, NaN where unknown
    is_known = np.isfinite(drop)
    if not (is_known[-1] and is_known[:-1].any()):
        return []
    healthy = np.flatnonzero(is_known[:-1])
    # friction resists the motion: the sign depends on the channel that shows the motion
    sign = np.sign((friction / friction_error)[healthy].sum()) or 1.0
    friction, drop = sign * friction, sign * drop
    healthy_friction, top_speed = (float(np.median(values[healthy])) for values in (friction, speed))
    drops, log_densities = [drop], np.zeros(1)  # one for each hypothesis
    if min(healthy_friction, friction[-1]) > 0.0:  # else their ratio has no logarithm
        drops.append(drop + (friction - healthy_friction) / top_speed)
        change = float(np.log(friction[-1] / healthy_friction))
        # prior deviations of this change under the two hypotheses: friction changed, or did not
        deviations = np.array([prior.friction_changes, prior.friction_session])
        log_densities = -0.5 * (change / deviations) ** 2 - np.log(deviations)
    drops_by_hypothesis = np.maximum(drops, drop_error)  # (hypotheses, n + 1)
    healthy_logs = np.log(drops_by_hypothesis[:, healthy])
    squares = (healthy_logs - healthy_logs.mean(axis=1, keepdims=True)) ** 2
    squares += (drop_error[healthy] / drops_by_hypothesis[:, healthy]) ** 2
    log_scatters = -0.5 * (len(healthy) - 1) * np.log(squares.sum(axis=1))
    log_misleads = np.log(prior.drop_misleads) + log_densities[0] + log_scatters
    log_tells = np.log1p(-prior.drop_misleads) + log_densities + log_scatters
    log_sum = np.logaddexp.reduce(np.concatenate([log_tells, log_misleads]))
    log_probabilities = np.log(prior.drop_tells) + np.column_stack([log_tells, log_misleads]) - log_sum
    variance = unknown_deviation**2
    judged_unknown = is_known.copy()
    judged_unknown[-1] = False
    oils = list[OilHypothesis]()
    for positive_drops, mean, probabilities in zip(
        drops_by_hypothesis, healthy_logs.mean(axis=1), log_probabilities.tolist(), strict=True
    ):
        error_variance = (prior.per_drop * drop_error / positive_drops) ** 2
        for is_informative, log_probability in zip((is_known, judged_unknown), probabilities, strict=True):
            # variance of the true drop over that of the measured one
            reliability = np.where(is_informative, variance / (variance + error_variance), 0.0)
            log_ratio = np.where(is_informative, np.log(positive_drops) - mean, 0.0)
            oils.append(
                OilHypothesis(
                    thinning=-prior.per_drop * reliability * log_ratio,
                    variances=(1.0 - reliability) * variance,
                    log_probability=log_probability,
                    slope_deviation=prior.per_drop_deviation / prior.per_drop,
                )
            )
    return oils


#: Largest standard deviation between sessions on the grid, over its prior.
MAX_SESSION_RATIO = 3.0
#: Number of widths of the prior on differences between recordings, and the largest log width [standard deviations].
SCALES, MAX_SCALE = 11, 2.5
#: Minimum number of healthy recordings with holds under pressure: for a mean and a scatter.
MIN_WITH_HOLDS = 2
#: A normal distribution of z is replaced by this number of narrower ones, with this fraction of its deviation.
PARTS, PART_WIDTH = 7, 0.5
#: Limit of abs(z), which keeps sinh(z) finite.
MAX_Z = 30.0


def rise(
    judged: RecordingSums,
    baseline: Sequence[RecordingSums],
    columns: Sequence[ComparedColumns],
    *,
    min_crossover: float = 0.0,
    session_deviation: float | None = None,
) -> Rise:
    """Estimate by how much a recording's leak coefficient exceeds that of healthy recordings of the same machine.

    The rise and its standard deviation are in the unit of the leak's coefficient, for the laminar leak m^3/(s Pa). The
    result is an average over widths of the prior on the differences of the other coefficients between recordings
    (`_compare_levels`, with `min_crossover` and `session_deviation`).
    """
    healthy_sums = np.sum([recording.sums for recording in baseline], axis=0)
    count, prior = len(baseline), INFERENCE.scatter
    # factors on the prior standard deviations; log(`prior.between`) is the standard deviation of their logarithm
    log_widths = np.linspace(-MAX_SCALE, MAX_SCALE, SCALES)
    widths = prior.between**log_widths
    rises, rise_errors = np.zeros((SCALES, count)), np.zeros((SCALES, 0))
    if count > 1:  # rises of each healthy recording over the others, scaled to its rise over the mean of all (else 0)
        excesses = [
            estimate_leak_excess(recording.sums, healthy_sums - recording.sums, columns, widths)
            for recording in baseline
        ]
        rises, rise_errors = np.array(excesses).transpose(1, 2, 0) * ((count - 1) / count)
    values, error = estimate_leak_excess(judged.sums, healthy_sums, columns, widths)
    level, level_error = coefficient_level(healthy_sums, columns)
    # smallest scatter of the rises for each width: a fraction of their median standard error, at least the fraction
    # `prior.finest` of the pump's mean flow, as a conductance, and never 0 (1 / MAX_READING)
    errors = prior.estimate * np.median(np.column_stack([error, rise_errors]), axis=1)
    errors = np.maximum(errors, max(prior.finest * judged.conductance_of_flow, 1.0 / MAX_READING))
    return _compare_levels(
        judged,
        baseline,
        values=values,
        rises=rises,
        errors=errors,
        log_widths=log_widths,
        level=level,
        level_error=level_error,
        min_crossover=min_crossover,
        session_deviation=session_deviation,
    )


def held_rise(judged: RecordingSums, baseline: Sequence[RecordingSums]) -> Rise | None:
    """Estimate the rise of the leakage past the piston over healthy recordings, measured while valves hold a load.

    Return None if no load is held in the judged recording, or in fewer than `MIN_WITH_HOLDS` healthy recordings.
    """
    # a healthy piston alone leaks about nothing: such levels compare by their differences, not by their ratios
    min_crossover = INFERENCE.scatter.largest * judged.conductance_of_flow
    return _compare_held(judged, baseline, "held", min_crossover=min_crossover)


def held_pump_rise(judged: RecordingSums, baseline: Sequence[RecordingSums]) -> Rise | None:
    """Estimate the rise of the pump's leakage over healthy recordings, measured just before valves shut to hold a load.

    Return None if it is unknown in the judged recording, or known in fewer than `MIN_WITH_HOLDS` healthy ones.
    """
    return _compare_held(judged, baseline, "held_pump", session_share=INFERENCE.held_oil.pump_session)


def _compare_held(
    judged: RecordingSums,
    baseline: Sequence[RecordingSums],
    name: str,
    *,
    min_crossover: float = 0.0,
    session_share: float | None = None,
) -> Rise | None:
    """Estimate the rise of a leak, measured while valves hold a load, over its mean in the healthy recordings.

    `name`: field of `RecordingSums` whose first two values are the leak's conductance and standard deviation
    [m^3/(s Pa)]; `min_crossover`: as in `_compare_levels`; `session_share`: standard deviation between sessions, over
    the healthy mean, or None for `scatter.session` of `priors.toml`. Return None if the field is None in the judged
    recording, or known in fewer than `MIN_WITH_HOLDS` healthy recordings.
    """
    baseline = [recording for recording in baseline if getattr(recording, name) is not None]
    if getattr(judged, name) is None or len(baseline) < MIN_WITH_HOLDS:
        return None
    leaks = np.array([getattr(recording, name)[:2] for recording in (*baseline, judged)])
    session_deviation = None if session_share is None else session_share * abs(float(leaks[:-1, 0].mean()))
    return leak_rise(
        [*baseline, judged], leaks, min_scatter=1.0, min_crossover=min_crossover, session_deviation=session_deviation
    )


def leak_rise(
    recordings: Sequence[RecordingSums],
    leaks: Array,
    *,
    min_scatter: float,
    min_crossover: float = 0.0,
    session_deviation: float | None = None,
) -> Rise:
    """Estimate by how much the leak of a recording, measured in each by itself, exceeds that of healthy recordings.

    `recordings` (n + 1): the healthy ones, then the judged one; `leaks` (n + 1, 2): conductance and standard deviation
    [m^3/(s Pa)] of each; `min_scatter`: smallest plausible scatter of the healthy leaks, over their median standard
    deviation; `min_crossover`, `session_deviation`: as in `_compare_levels`.
    """
    *baseline, judged = recordings
    *healthy_leaks, leak = leaks[:, 0]
    level = float(np.mean(healthy_leaks))
    # smallest scatter of a healthy leak: the fraction `finest` of the pump's mean flow, as a conductance, and never 0
    min_error = max(INFERENCE.scatter.finest * judged.conductance_of_flow, 1.0 / MAX_READING)
    error = max(float(np.median(leaks[:, 1])), min_error)  # median over all leaks, the judged one included
    rise = _compare_levels(
        judged,
        baseline,
        values=np.array([leak - level]),
        rises=(np.array(healthy_leaks) - level)[None],
        errors=np.array([max(min_scatter * error, min_error)]),
        level=max(level, 0.0),  # a mean below 0 is an error of the estimates
        level_error=error / np.sqrt(len(baseline)),
        min_crossover=min_crossover,
        session_deviation=session_deviation,
    )
    # the median `error` is included already; a less precise judged recording adds the difference
    return rise.widen(float(leaks[-1, 1]) ** 2 - error**2)


def _compare_levels(
    judged: RecordingSums,
    baseline: Sequence[RecordingSums],
    *,
    values: Array,
    rises: Array,
    errors: Array,
    log_widths: Array | float = 0.0,
    level: float,
    level_error: float,
    min_crossover: float = 0.0,
    session_deviation: float | None = None,
) -> Rise:
    """Estimate by how much the judged leak coefficient exceeds the coefficient that the healthy recordings predict.

    The coefficients a, the sums of healthy mean and rise, are compared as z = asinh(a / (2 c)), which is logarithmic
    for large a (`_LevelScale`). From z the predicted effect of the oil is subtracted. The rest is normal about an
    unknown mean, with an unknown standard deviation sigma of single recordings; sessions, oil and unusual conditions
    add covariances (see the module). In the unit of the coefficient, for s widths of the prior on the other
    coefficients, or s = 1 if there is no such prior:

    - `values` (s,): rises of the judged recording; `rises` (s, n): rises of n healthy recordings over their mean;
    - `errors` (s,): smallest plausible scatter of one rise, by its standard error; `log_widths` (s,): logarithms of the
      widths [standard deviations], 0 without the prior;
    - `level`, `level_error`: mean coefficient of the healthy recordings, and its standard error;
    - `min_crossover`: minimum of c, large where healthy levels are about zero, which makes z linear in them;
    - `session_deviation`: prior standard deviation between sessions with the same oil, None for that of the whole
      leakage (`scatter.session` of `priors.toml`).
    """
    prior = INFERENCE.scatter
    if session_deviation is None:
        session_deviation = prior.session * judged.conductance_of_flow
    recordings = [*baseline, judged]
    oils = oil_hypotheses(recordings)
    # scatter that the most probable oil does not explain: warmer oil is thinner and leaks more
    oil_factor = np.exp(oils[0].thinning[:-1])
    unexplained = rises - level * (oil_factor - oil_factor.mean())
    scatter = float(np.median(unexplained.std(axis=1)))
    # c, below which z is linear in a: the largest of errors, scatter, a tenth of the level, and `min_crossover`
    scale = _LevelScale(level, max(level_error, float(np.median(errors)), scatter, 0.1 * level, min_crossover))
    steepness = scale.slope(level)  # dz/da at the healthy mean
    relative_slope = steepness * level  # change of z for a relative change of a
    log_condition_excess = sum(condition.log_excess for condition in find_unusual_conditions(judged, baseline))
    pause = 3600.0 * INFERENCE.oil.shift  # from hours to seconds
    sessions = number_sessions([recording.start_s for recording in recordings], pause)
    # grid of sigma in z, for each row of the estimates: from the smallest plausible scatter to the largest, which is at
    # least ten times as large
    max_scatter = min(steepness * prior.largest * judged.conductance_of_flow, prior.relative)
    max_sigma = np.maximum(max_scatter, 10.0 * steepness * errors)
    sigma = np.geomspace(steepness * errors, max_sigma, NODES, axis=1)
    healthy_z = scale.transform(rises)
    # log Jacobian of z, plus log prior of the width, for each row
    log_priors = np.log(scale.slope(level + rises)).sum(axis=1) - 0.5 * np.square(log_widths)
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
        log_weights = (log_priors + oil.log_probability)[:, None]
        predicted = Population(*candidates).predict(healthy_z - shifts[:-1], sigma, log_weights)
        with_oil = predicted._replace(centres=predicted.centres + shifts[-1])
        predictions.append(scale.to_rises(with_oil))
    all_oils = Mixture(*(np.concatenate(parts, axis=1) for parts in zip(*predictions, strict=True)))
    return rise_of_mixture(all_oils, values)


def _candidate_covariances(
    sessions: Sequence[int],
    oil: OilHypothesis,
    relative_slopes: Array,
    *,
    oil_deviation: float,
    session_deviation: float,
    condition_deviation: float,
) -> tuple[Array, Array]:
    """Build g candidate covariances (g, n + 1, n + 1) of transformed leak coefficients, with log priors (g,).

    The candidates differ in the standard deviation between sessions. If the oil is unknown and no healthy recording is
    of the judged recording's session, they also differ in the oil of this session, which is either like that of the
    healthy sessions or unlike it. z is the transformed coefficient (`_LevelScale`).

    - `sessions` (n + 1,): session number of each recording, the judged one last;
    - `oil`: hypothesis on the oil's effect on the leakage of each recording;
    - `relative_slopes` (n + 1,): change of z per relative change of each recording's leak coefficient;
    - `oil_deviation`: standard deviation of z between sessions by unknown oil, 0 if the oil is known;
    - `session_deviation`: prior standard deviation of z between sessions with the same oil;
    - `condition_deviation`: standard deviation of the judged z due to unusual load and speed.
    """
    # grid of the standard deviation between sessions over its prior, denser near zero; the log priors are those of a
    # half-normal density times the distance of the grid points, which grows with the root of the ratio
    ratios = MAX_SESSION_RATIO * ((np.arange(NODES) + 0.5) / NODES) ** 2
    log_priors = 0.5 * np.log(ratios) - 0.5 * ratios**2
    if len(set(sessions)) == 1:  # the deviation of a single session is part of the unknown mean
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
        # like oil, or unlike oil, which adds the variance of a difference between two sessions
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
        """Compute z = asinh(a / (2 c)) of leak coefficients a = `level` + `excess`, of any shape."""
        return np.asarray(np.arcsinh((self.level + excess) / (2.0 * self.crossover)))

    def slope(self, level: Any) -> Any:
        """Compute dz/da = 1 / sqrt(a^2 + (2 c)^2) at leak coefficients a = `level`, a number or an array."""
        return 1.0 / np.hypot(level, 2.0 * self.crossover)

    def to_rises(self, predicted: Mixture) -> Mixture:
        """Convert a distribution of z to a distribution of the leak coefficient, relative to the healthy mean `level`.

        `predicted`: mixture of normal distributions, as from `Population.predict`. Each is split into `PARTS` narrower
        ones, along a new last axis, with the same mean and variance together.
        """
        x, part_weights = np.polynomial.hermite_e.hermegauss(PARTS)  # centres of the parts [standard deviations]
        deviations = predicted.deviations[..., None]
        z = predicted.centres[..., None] + np.sqrt(1.0 - PART_WIDTH**2) * deviations * x
        z = np.clip(z, -MAX_Z, MAX_Z)
        return Mixture(
            predicted.weights[..., None] + np.log(part_weights / part_weights.sum()),
            2.0 * self.crossover * np.cosh(z) * PART_WIDTH * deviations,  # da/dz times the deviation of a part
            2.0 * self.crossover * np.sinh(z) - self.level,
        )


def leak_deviations_from_mean(recordings: Sequence[RecordingSums], columns: Sequence[ColumnRoles]) -> Array:
    """Compute the deviation of each recording's leak coefficient from the mean of all n recordings, shape (n,).

    It is (n - 1)/n times the difference from the common leak coefficient of the others. The flow offset may differ by
    any amount between recordings, as it does behind valves that shut at rest: both assumptions on the valves, which
    are compared by these deviations, are thus treated alike.
    """
    columns = [roles.with_free_zero() for roles in columns]  # so that `eliminate_unshared` eliminates the flow offset
    all_sums = [eliminate_unshared(recording.sums, columns) for recording in recordings]
    total = np.sum(all_sums, axis=0)
    rises = [estimate_leak_excess(sums, total - sums, columns, widths=np.ones(1))[0] for sums in all_sums]
    return np.array(rises) * ((len(recordings) - 1) / len(recordings))


class LawFit(NamedTuple):
    """Comparison of an orifice's law with the laminar law, for leakage above that of healthy recordings.

    `regression`: slope of the flow sign(dp) sqrt(abs(dp)) of a unit orifice on dp = p_A - p_B [Pa^-0.5], with all other
    terms eliminated; `log_ratio`: log likelihood ratio of the orifice to the laminar leak.
    """

    regression: float
    log_ratio: float


def compare_laws(
    judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[ColumnRoles]
) -> LawFit | None:
    """Compare how well a turbulent leak through an orifice and a laminar leak explain a recording's excess flow.

    Both are fitted alone, with all other columns integrated out, in all balances together; the coefficient may be
    negative. The result is the log of the likelihood ratio of the orifice to the laminar leak (`compare_residuals`),
    and the laminar coefficient that fits an orifice of coefficient 1. Return None if a balance has no column
    of an orifice, if the recording has no information on one of the two leaks, or if their columns, both with the sign
    of p_A - p_B, are not positively correlated.
    """
    if any(ORIFICE not in roles.names for roles in columns):
        return None
    gram, moments, left_square = _fit_excess(judged, baseline, columns, [LEAK, ORIFICE])
    energies, cross = np.diag(gram), gram[0, 1]
    if not energies.min() > 0.0 or not cross > 0.0:
        return None
    min_square = 1e-9 * abs(left_square) + TINY  # above rounding errors
    square_laminar, square_orifice = np.maximum(left_square - moments**2 / energies, min_square)
    return LawFit(float(cross / energies[0]), compare_residuals(square_orifice, square_laminar))


def compare_with_leak(
    judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[ColumnRoles], rival: str
) -> float | None:
    """Compare how well the leak and another term of the volume balance, `rival`, explain a recording's excess flow.

    Returns the log likelihood ratio of rival to leak (`compare_residuals`). While the rival (for example an external
    leak) is fitted, the leak may differ as it does between healthy recordings. A negative coefficient is not fitted,
    except that of free air, of which there may be less. Return None if the balance has no column named `rival`, or if
    the recording has no information on the leak or on the rival.
    """
    if any(rival not in roles.names for roles in columns):
        return None
    squares = []
    for name in (LEAK, rival):
        gram, moments, left_square = _fit_excess(judged, baseline, columns, [name], has_leak=name == rival)
        energy, moment = float(gram[0, 0]), float(moments[0])
        if not energy > 0.0:
            return None
        if name != AIR:
            moment = max(moment, 0.0)
        # above rounding errors
        squares.append(max(left_square - moment**2 / energy, 1e-9 * abs(left_square) + TINY))
    return compare_residuals(squares[1], squares[0])


def _fit_excess(
    judged: RecordingSums,
    baseline: Sequence[RecordingSums],
    columns: Sequence[ColumnRoles],
    names: Sequence[str],
    *,
    has_leak: bool = False,
) -> tuple[Array, Array, float]:
    """Compute the sums of a fit of c tested terms, by `names`, to the residual of `judged` under the `baseline`.

    All other terms are eliminated, the leak only if `has_leak` (`subtract_reference`). Returns sums over the equations:
    Gram matrix (c, c) of the tested columns, their products (c,) with the residual, and the residual's sum of squares.
    """
    reference = np.sum([recording.sums for recording in baseline], axis=0)
    total = Gaussian(np.zeros((len(names), len(names))), np.zeros(len(names)))
    for e, roles in enumerate(columns):
        tested = [roles.names.index(name) for name in names]
        residual, nuisance, prior = subtract_reference(judged.sums[e], reference[e], roles, has_leak=has_leak)
        total += marginal_difference(residual, tested, nuisance, prior)
    return total.precision, total.moment, total.square
