"""Regression of the volumes in closed chambers on the properties of their oil, and on leaks.

The compressed oil and the free air of the stroke and of the dead volumes take up what the piston displaces; the rest
has leaked. The logarithms of compressibility and free air, and the dead volumes, have normal priors (`held_oil` in
`priors.toml`); the regression is linearised about the estimate, iteratively.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.circuit.holds.onset_sums import (
    N_REGRESSORS,
    FitWorkspace,
    HoldSamples,
    OnsetPriors,
    fit_oil,
)
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM

#: Largest decrease of a property of the oil in a linearised fit, in prior standard deviations of its logarithm.
MAX_DECREASE = 2.0
#: Maximum number of iterations of a fit; largest relative change of variance and properties in the last iteration.
MAX_ITERATIONS, TOLERANCE = 20, 1e-3
#: Ridge that is added to the unit diagonal of a scaled matrix.
RIDGE = 1e-12
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


@dataclass(frozen=True, eq=False)
class OilRegression:
    """Regression of displaced volumes on the properties of the oil, over r readings (sample means) of all holds.

    The unknowns are `changes` (4,) from the usual properties, with a normal prior about 0: logarithm of the
    compressibility, relative changes of the dead volumes of A and B, and logarithm of the free air. With them the
    volume that left a chamber up to each reading is

        displaced - sum over j of (exp(changes[0]) strained_j + exp(changes[3]) aired_j) v_j,

    with the factors v = (1, 1 + changes[1], 1 + changes[2]) on the volumes (`onset_sums`).

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

    @cached_property
    def regressors(self) -> Array:
        """Displaced volume, and volumes taken up by oil and by air, of each reading [m^3], (r, 7)."""
        return np.column_stack([self.displaced, self.strained, self.aired])

    @cached_property
    def products(self) -> Array:
        """Products of the regressors [m^6], (7, 7)."""
        return np.asarray(self.regressors.T @ self.regressors)

    @property
    def precisions(self) -> Array:
        """Precisions (4,) of the priors on the changes of the properties.

        A fit counts all r readings as independent; to correct this, its covariance is multiplied by `inflation`. Hence
        the precisions are multiplied by it, too.
        """
        return np.asarray(self.inflation / _oil_deviations() ** 2)

    def onset_priors(self, variance: float, n_readings: float) -> OnsetPriors:
        """Collect the numbers by which onsets of a leak are scored; the leak's coefficient is not negative.

        The regression is linearised at the usual properties. Each may fall by at most `MAX_DECREASE` standard
        deviations of its logarithm, and a dead volume not below its least: without a limit, a linear decrease to
        nothing would be hardly less probable than a small one. `variance`: variance of a reading without a leak;
        `n_readings`: effective number of independent readings.
        """
        lowest = np.maximum(_lowest_changes(), np.expm1(-MAX_DECREASE * _oil_deviations()))
        n_rows = float(len(self.displaced))
        return OnsetPriors(
            self.products, self.precisions, lowest, self.misfit_variance, variance, n_rows, float(n_readings)
        )


def _oil_deviations() -> Array:
    """Return prior standard deviations (4,) of the changes of compressibility, dead volumes A and B, and free air."""
    prior = INFERENCE.held_oil
    return np.array([prior.deviation, prior.dead_volume_deviation, prior.dead_volume_deviation, prior.air_deviation])


def _lowest_changes() -> Array:
    """Return lower limits (4,) of the changes of compressibility, dead volumes A and B, and free air."""
    prior = INFERENCE.held_oil
    lowest_volume_change = prior.least_dead_volume / prior.dead_volume - 1.0
    return np.array([-np.inf, lowest_volume_change, lowest_volume_change, -np.inf])


def relative_compression(p: Array) -> Array:
    """Compute the relative volumes that usual oil and its free air lose at absolute pressures `p` (n,) [Pa].

    They are the rows (2, n) c p and -a p_0/p, with the compressibility c, the free air a (Boyle's law) and the
    atmospheric pressure p_0. Only differences have a meaning.
    """
    prior = INFERENCE.held_oil
    return np.array([prior.compressibility * p, -prior.air * P_ATM / p])


class LeakRegression(NamedTuple):
    """Fit of a leak to the holds: its `coefficient`, the variance of this, and the `variance` of a reading [m^6].

    A reading is a mean of samples. The variance of the coefficient is the sum of two parts: `by_noise`, due to the
    noise of the readings, and `by_oil`, due to the uncertain properties of the oil.
    """

    coefficient: float
    by_noise: float
    by_oil: float
    variance: float


def build_regression(
    samples: HoldSamples, is_closed: NDArray[np.bool_], sides: CylinderSides, n_readings: float
) -> OilRegression:
    """Build the regression of displaced volumes on the oil's properties from all holds (`OilRegression`).

    The rows are the readings (sample means) of each hold, side A before side B, relative to their mean over the hold.

    `is_closed` (2, N): true in `samples` in which A (row 0) or B (row 1) is closed, so that displacement and
    compression of that side count; `n_readings`: effective number of independent readings.
    """
    prior, stroke = INFERENCE.held_oil, sides.high - sides.low
    counts = np.diff(samples.first_edge) - 1  # readings of one side in each hold
    positions = np.add.reduceat(samples.x, samples.begin[:-1]) / samples.sizes  # mean of each hold
    # rows of side A: those of a hold begin after the readings of both sides of the holds before it
    rows_of_A = np.arange(counts.sum()) + np.repeat(np.cumsum(counts) - counts, counts)
    n_rows = 2 * len(rows_of_A)
    displaced, strained, aired = np.empty(n_rows), np.empty((n_rows, 3)), np.empty((n_rows, 3))
    # A grows with the position, and B shrinks
    for index, area, p in ((0, sides.area_A, samples.p_A), (1, -sides.area_B, samples.p_B)):
        stroke_end = sides.low if area > 0.0 else sides.high  # where the chamber is smallest
        volumes = np.zeros((len(positions), 3))  # of each hold: volume in the stroke, dead volumes of A and B
        volumes[:, 0] = abs(area) * np.abs(positions - stroke_end)
        volumes[:, 1 + index] = abs(area) * prior.dead_volume * stroke
        volumes = np.repeat(volumes, counts, axis=0)
        # changes while the side is closed, as displaced and compressed volumes count only then
        moved, compressed_by, expanded_by = (
            samples.readings(_sum_changes(values, is_closed[index], samples)) for values in (samples.x, p, 1.0 / p)
        )
        rows = rows_of_A + index * np.repeat(counts, counts)
        displaced[rows] = samples.centre(-area * moved, is_A=index == 0)
        strained[rows] = samples.centre(prior.compressibility * volumes * compressed_by[:, None], is_A=index == 0)
        # Boyle's law
        aired[rows] = samples.centre(-prior.air * P_ATM * volumes * expanded_by[:, None], is_A=index == 0)
    compressed = (strained + aired).sum(axis=1)
    misfit_variance = prior.misfit**2 * float(compressed @ compressed) / len(compressed)
    return OilRegression(
        displaced,
        strained,
        aired,
        inflation=max(len(compressed) / n_readings, 1.0),
        misfit_variance=max(misfit_variance, float(np.finfo(float).tiny)),
    )


def _sum_changes(values: Array, is_closed: NDArray[np.bool_], samples: HoldSamples) -> Array:
    """Sum the changes of `values` (N,) from sample to sample of a hold that happen while the side is closed, (N,)."""
    changes = np.diff(values, prepend=values[0]) * is_closed
    changes[samples.begin[:-1]] = 0.0
    course = np.cumsum(changes)
    return np.asarray(course - np.repeat(course[samples.begin[:-1]], samples.sizes))


def fit_leak(regression: OilRegression, sums: Array, n_readings: float) -> LeakRegression:
    """Fit the coefficient of a leak, if any, together with the properties of the oil.

    `sums`: products of the leak's readings with the regressors and with themselves (8,), as by `sum_onset_products`, or
    empty without a leak; `n_readings`: effective number of independent readings. The properties are found by iteration,
    and so is the variance of a reading, which weights their priors. A dead volume that reaches its lower limit stays
    there.
    """
    products, n = regression.products, N_REGRESSORS
    if sums.size:
        products = np.empty((n + 1, n + 1))
        products[:n, :n], products[n], products[:, n] = regression.products, sums, sums
    work = FitWorkspace.with_leaks(len(products) - n)
    variance = fit_oil(
        products, regression.precisions, _lowest_changes(), regression.misfit_variance,
        float(len(regression.displaced)), float(n_readings), MAX_ITERATIONS, MAX_STEP, TOLERANCE, RIDGE, work,
    )  # fmt: skip
    if not sums.size:
        return LeakRegression(0.0, 0.0, 0.0, variance)
    total = variance * regression.inflation * float(work.inverse[0, 0])
    # if the properties of the oil were known, only the leak's own element of the normal matrix would count
    by_noise = variance * regression.inflation / (float(work.gram[0, 0]) * (1.0 + RIDGE))
    return LeakRegression(float(work.solution[0]), by_noise, total - by_noise, variance)
