"""Regression of the volumes in closed chambers on the properties of their oil, and on leaks.

The compressed oil and the free air of the stroke and of the dead volumes take up what the piston displaces; the rest
has leaked. The logarithms of compressibility and free air, and the dead volumes, have normal priors (`held_oil` in
`priors.toml`); the regression is linearised about the estimate, iteratively.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.circuit.holds.hold import LockedHold
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM

#: Largest decrease of a property of the oil in a linearised fit, in prior standard deviations of its logarithm.
MAX_DECREASE = 2.0
#: Maximum number of iterations of a fit; largest relative change of variance and properties in the last iteration.
MAX_ITERATIONS, TOLERANCE = 20, 1e-3
#: Ridge that is added to the unit diagonal of a scaled matrix.
RIDGE = 1e-12
#: Relative rounding error that a property may lie outside of its limits.
ROUNDING = 1e-9
#: Largest change of a property of the oil in one iteration.
MAX_STEP = 0.5


class CylinderSides(NamedTuple):
    """Piston areas of both sides [m^2], and ends `low` and `high` of the recorded stroke [m].

    The areas are measured with the pump's assumed displacement; they are negative if the position x is reversed.
    `deviation_A`, `deviation_B`: standard deviations of the logarithms of their magnitudes.
    """

    area_A: float
    area_B: float
    low: float
    high: float
    deviation_A: float = 0.0
    deviation_B: float = 0.0


class OilRegression(NamedTuple):
    """Regression of displaced volumes on the properties of the oil, over r readings (sample means) of all holds.

    The unknowns are `changes` (4,) from the usual properties, with a normal prior about 0: logarithm of the
    compressibility, relative changes of the dead volumes of A and B, and logarithm of the free air.

    - `displaced` (r,): volume displaced by the piston [m^3].
    - `strained`, `aired` (r, 3): volumes [m^3] taken up by the compression of the oil and of the free air, with the
      usual properties, in the stroke, in the dead volume of A, and in that of B.
    - `inflation`: number of readings over the number of independent readings.
    - `misfit_variance`: variance of a reading [m^6] in addition to the noise, as the model is not exact.
    """

    displaced: Array
    strained: Array
    aired: Array
    inflation: float
    misfit_variance: float

    def leaked(self, changes: Array) -> Array:
        """Compute the volume that left a chamber up to each reading (r,) [m^3]; `changes` (4,): as in the class."""
        oil, air, volumes = _oil_factors(changes)
        return self.displaced - (oil * self.strained + air * self.aired) @ volumes

    def slopes(self, changes: Array) -> Array:
        """Compute the derivatives (r, 4) of the compressed volumes [m^3] by `changes` (4,), as in the class."""
        oil, air, volumes = _oil_factors(changes)
        strained, aired = oil * self.strained, air * self.aired
        dead = strained[:, 1:] + aired[:, 1:]  # derivatives by the relative changes of the dead volumes of A and B
        return np.column_stack([strained @ volumes, dead, aired @ volumes])


def _oil_factors(changes: Array) -> tuple[float, float, Array]:
    """Convert `changes` (4,) of the oil's properties (`OilRegression`) to factors on compressed volumes.

    Returns factors on the compressibility and on the free air, and factors (3,) on the volumes of the stroke (1, since
    it is not estimated) and on the dead volumes of A and B.
    """
    compressibility, dead_A, dead_B, air = changes
    return float(np.exp(compressibility)), float(np.exp(air)), np.array([1.0, 1.0 + dead_A, 1.0 + dead_B])


def _oil_deviations() -> Array:
    """Return prior standard deviations (4,) of the changes of compressibility, dead volumes A and B, and free air."""
    prior = INFERENCE.held_oil
    return np.array([prior.deviation, prior.dead_deviation, prior.dead_deviation, prior.air_deviation])


def _lowest_changes() -> Array:
    """Return lower limits (4,) of the changes of compressibility, dead volumes A and B, and free air."""
    prior = INFERENCE.held_oil
    lowest_volume_change = prior.least_dead / prior.dead - 1.0
    return np.array([-np.inf, lowest_volume_change, lowest_volume_change, -np.inf])


class LeakRegression(NamedTuple):
    """Fit of c leaks to the holds: `coefficients` (c,), their covariance (c, c), and `variance` of a reading [m^6].

    A reading is a mean of samples. The covariance is the sum of two parts: `by_noise`, due to the noise of the
    readings, and `by_oil`, due to the uncertain properties of the oil.
    """

    coefficients: Array
    by_noise: Array
    by_oil: Array
    variance: float


def build_regression(
    holds: Sequence[LockedHold], flags: Sequence[NDArray[np.bool_]], sides: CylinderSides, n_readings: float
) -> OilRegression:
    """Build the regression of displaced volumes on the oil's properties from all holds (`OilRegression`).

    The rows are the readings (sample means) of each hold, side A before side B, relative to their mean over the hold.

    `flags` (2, n), for each hold of n samples: true in samples in which A (row 0) or B (row 1) is closed, so that
    displacement and compression of that side count; `n_readings`: effective number of independent readings.
    """
    prior, stroke = INFERENCE.held_oil, sides.high - sides.low
    displaced, strained, aired = list[Array](), list[Array](), list[Array]()
    for hold, is_closed in zip(holds, flags, strict=True):
        # A grows with the position, and B shrinks
        for index, area, p in ((0, sides.area_A, hold.p_A), (1, -sides.area_B, hold.p_B)):
            stroke_end = sides.low if area > 0.0 else sides.high  # where the chamber is smallest
            volumes = np.zeros(3)  # volume in the stroke, dead volumes of A and B
            volumes[0] = abs(area) * abs(float(hold.x.mean()) - stroke_end)
            volumes[1 + index] = abs(area) * prior.dead * stroke
            # changes while the side is closed, as displaced and compressed volumes count only then
            courses = (hold.mean(_sum_changes(values, is_closed[index])) for values in (hold.x, p, 1.0 / p))
            moved, compressed_by, expanded_by = courses
            for columns, values in (
                (displaced, -area * moved),
                (strained, np.outer(compressed_by, prior.compressibility * volumes)),
                (aired, np.outer(expanded_by, -prior.air * P_ATM * volumes)),  # Boyle's law
            ):
                columns.append(hold.centre(values, is_A=index == 0))
    strained_volumes, aired_volumes = np.vstack(strained), np.vstack(aired)
    compressed = (strained_volumes + aired_volumes).sum(axis=1)
    misfit_variance = prior.misfit**2 * float(compressed @ compressed) / len(compressed)
    return OilRegression(
        np.concatenate(displaced),
        strained_volumes,
        aired_volumes,
        inflation=max(len(compressed) / n_readings, 1.0),
        misfit_variance=max(misfit_variance, float(np.finfo(float).tiny)),
    )


def _sum_changes(values: Array, is_closed: NDArray[np.bool_]) -> Array:
    """Sum the changes of `values` (n,) from sample to sample that happen while the side is closed (`is_closed`)."""
    return np.cumsum(np.diff(values, prepend=values[0]) * is_closed)


def fit_leaks(regression: OilRegression, columns: Array, n_readings: float) -> LeakRegression:
    """Fit the coefficients of c leaks together with the properties of the oil.

    `columns` (r, c): volume [m^3] that has left a chamber up to each of r readings, for each leak with a coefficient of
    1; `n_readings`: effective number of independent readings. The properties are found by iteration, and so is the
    variance of a reading, which weights their priors. A dead volume that reaches its lower limit stays there.
    """
    n_leaks = columns.shape[1]
    changes = np.zeros(4)  # changes of the oil's properties, at first none
    leaked, misfit_variance = regression.leaked(changes), regression.misfit_variance
    degrees_of_freedom = max(n_readings - n_leaks, 1.0)
    variance = max(float(leaked @ leaked) / len(leaked), misfit_variance)
    # precisions of the priors (0 for leaks, which have none). The fit counts all r readings as independent; to correct
    # this, the covariance is multiplied by `inflation` below. Hence the precisions are multiplied by it, too.
    precisions = np.append(np.zeros(n_leaks), regression.inflation / _oil_deviations() ** 2)
    lowest = _lowest_changes()
    is_lowest = np.zeros(4, dtype=bool)  # properties that stay at their lower limit
    for _ in range(MAX_ITERATIONS):  # each is a linear fit of the leaks and of corrections of `changes`
        slopes = np.where(is_lowest, 0.0, regression.slopes(changes))  # 0: no correction
        leaked, design = regression.leaked(changes), np.column_stack([columns, slopes])
        scale = np.sqrt((design**2).sum(axis=0))
        scale[~(scale > 0.0)] = 1.0
        scales = np.outer(scale, scale)
        prior_weights = variance * precisions  # weights in a sum of squares of the readings
        # the prior mean of `changes` is 0, so that of a correction is -`changes`
        means = np.append(np.zeros(n_leaks), np.where(is_lowest, 0.0, -changes))
        matrix = (design.T @ design + np.diag(prior_weights)) / scales
        matrix.flat[:: len(scale) + 1] += RIDGE  # this stride selects the diagonal
        inverse = np.linalg.inv(matrix) / scales
        solution = inverse @ (design.T @ leaked + prior_weights * means)
        residual = leaked - design @ solution
        distances = np.append(np.zeros(n_leaks), changes) + solution  # distances from the means of the priors
        squares = float(residual @ residual) + float(prior_weights[n_leaks:] @ distances[n_leaks:] ** 2)
        mean_square = squares / len(leaked)  # per degree of freedom below, since the leaks are fitted
        previous, variance = variance, mean_square * n_readings / degrees_of_freedom + misfit_variance
        steps = np.clip(solution[n_leaks:], -MAX_STEP, MAX_STEP)
        was_lowest, is_lowest = is_lowest, is_lowest | (changes + steps < lowest)
        changes = np.maximum(changes + steps, lowest)
        if (
            np.array_equal(was_lowest, is_lowest)
            and abs(variance - previous) <= TOLERANCE * previous
            and np.abs(steps).max() <= TOLERANCE
        ):
            break
    covariance = variance * regression.inflation * inverse
    # part of the covariance that would vanish if the properties of the oil were known
    gain = covariance[:n_leaks, n_leaks:] @ np.linalg.pinv(covariance[n_leaks:, n_leaks:])
    by_oil = gain @ covariance[n_leaks:, :n_leaks]
    return LeakRegression(solution[:n_leaks], covariance[:n_leaks, :n_leaks] - by_oil, by_oil, variance)


def residual_squares(regression: OilRegression, columns: Array, variance: float) -> Array:
    """Compute the residual sum of squares of the fit of a leak with a coefficient >= 0, for each of o onsets, (o,).

    The changes of the oil's properties, at whose usual values the `regression` is linearised, are fitted as well, and
    their weighted squares, by the priors, are part of the sum. Each may fall by at most `MAX_DECREASE` standard
    deviations of its logarithm, and a dead volume not below its least. `columns` (r, o): volume lost up to each reading
    through a leak with a coefficient of 1 since each onset; `variance`: variance of a reading, which weights the
    priors.
    """
    usual = np.zeros(4)
    leaked, oil = regression.leaked(usual), regression.slopes(usual)
    products = oil.T @ oil + np.diag(variance * regression.inflation / _oil_deviations() ** 2)
    scale = np.sqrt(np.diag(products))  # from here on the properties are measured in units of 1 / scale
    products /= np.outer(scale, scale)
    oil = oil / scale
    with_leaked, with_columns = oil.T @ leaked, oil.T @ columns  # (4,), (4, o)
    # without a limit, a linear decrease to nothing would be hardly less probable than a small one
    lowest = scale * np.maximum(_lowest_changes(), np.expm1(-MAX_DECREASE * _oil_deviations()))
    # The least squares within the limits are the smallest of c = 16 cases: some properties are at their limits, and the
    # others are free and within them.
    is_free = np.array(list(itertools.product((True, False), repeat=4)))  # (c, 4)
    limits = np.where(is_free, 0.0, lowest)
    # (c, 4): products of `oil` with `leaked` minus the contribution of the properties at their limits
    remainder = with_leaked - limits @ products
    matrices = np.where(is_free[:, :, None] & is_free[:, None, :], products, np.eye(4))
    right_sides = np.concatenate(
        [remainder[:, :, None], np.broadcast_to(with_columns, (len(remainder), *with_columns.shape))], axis=2
    )
    solutions = np.linalg.solve(matrices, np.where(is_free[:, :, None], right_sides, 0.0))
    # (c, 4), (c, 4, o): changes of the free properties without a leak, and decrease of these changes for a leak with a
    # coefficient of 1
    without_leak, per_leak = solutions[:, :, 0], solutions[:, :, 1:]
    # Sum of squares without a leak. With b = `leaked`, w = `with_leaked`, P = `products`, limits l and free changes f
    # it is b'b - 2 l'w + l'P l - f'(w - P l); a leak with the coefficient g changes it by -2 g moment + g^2 energy.
    total = leaked @ leaked - (limits * (with_leaked + remainder)).sum(axis=1) - (remainder * without_leak).sum(axis=1)
    energy = np.einsum("ro,ro->o", columns, columns) - np.einsum("ko,cko->co", with_columns, per_leak)
    moment = columns.T @ leaked - limits @ with_columns - np.einsum("ck,cko->co", remainder, per_leak)
    moment = np.maximum(moment, 0.0)  # (c, o); the coefficient of a leak is not negative
    # a leak that no reading shows, such as one after the last hold, has the coefficient 0
    is_informative = energy > RIDGE * np.maximum(energy.max(axis=1, keepdims=True), np.finfo(float).tiny)
    leak = np.where(is_informative, moment / np.where(is_informative, energy, 1.0), 0.0)
    changes = without_leak[:, :, None] - leak[:, None] * per_leak
    is_within = ((changes >= (1.0 + ROUNDING) * lowest[:, None]) | ~is_free[:, :, None]).all(axis=1)
    squares = np.where(is_within, np.maximum(total[:, None] - leak * moment, 0.0), np.inf)
    return np.asarray(squares.min(axis=0))
