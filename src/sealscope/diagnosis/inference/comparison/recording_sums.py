"""Sums of one recording, and the coefficients of the volume balance that they and those of healthy recordings give.

The Gram matrices are divided by the residual variance of a row (`RecordingSums.sums`), so that their Schur complements
are precisions of coefficients. Those of the healthy recordings are added up and give the coefficients of all terms of
the balance. A recording's residual under these coefficients, projected on the leak's column, is its rise. The
recording's other coefficients may differ from the healthy ones within a prior (`priors.toml`). The flow offset repeats:
a free one would absorb a leak whose flow is nearly constant, and its changes from day to day are part of the scatter.
Load, speed and oil temperature outside of the range of the healthy recordings make a comparison less certain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple, Protocol

import numpy as np

from sealscope.diagnosis.estimate.linear import Gaussian, limit_precisions, solve
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
from sealscope.diagnosis.inference.equations.terms import LAG, LEAK
from sealscope.diagnosis.inference.hypotheses import RecordingOdds
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
        for index, width in enumerate(widths):
            leak = marginal_difference(residual, [roles.leak], nuisance, prior / width**2)
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
