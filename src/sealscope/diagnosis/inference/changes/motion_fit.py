"""Robust fit of the pressures over the samples in which the piston moves.

A pressure, or p_A - p_B, is fitted by

    p = level(x) + half sign(v) + b v + c dv/dt [+ drift t/T],

with position x, speed v, and the time t over the recording's duration T. The level is linear in the position between
`KNOTS` values. The drift is fitted only on request: few strokes do not distinguish it from friction. The fit is
iteratively reweighted least squares with redescending weights, so that contact with a workpiece hardly counts. Called
for friction and drifts (`healthy_levels`) and for the oil's viscosity (`volumes`).

Sources: S. Geman, D. E. McClure, Bull. Int. Stat. Inst. 52 (1987) 5 (the weights); B. Efron, C. Stein,
Ann. Statist. 9 (1981) 586 (the jackknife).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr
from scipy.linalg.lapack import dpotrf, dpotrs

from sealscope.compiled import kernel
from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.inference.changes.level_changes import find_motion_channel
from sealscope.diagnosis.inference.comparison import Resistance
from sealscope.diagnosis.inference.machine_states import AVERAGING_TIME, number_strokes, rest_limit
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Array, Recording, keep_with_recording
from sealscope.signals.smoothing import TINY, average_over, medians

#: Maximum number of positions between which the level is linear, and minimum number of rows for each.
KNOTS, ROWS_PER_KNOT = 24, 10
#: Maximum and minimum number of rows of a fit, and its number of iterations.
MAX_ROWS, MIN_ROWS, ITERATIONS = 4000, 60, 8
#: Scale of the weights' decrease with the residual, over the median residual.
WEIGHT_SCALE = 2.0
#: Smallest scale of residuals [Pa].
MIN_RESIDUAL = 1.0
#: Maximum number of groups of rows whose residuals count as independent.
GROUPS = 20
#: Eigenvalue of a normalised normal matrix, over the largest one, below which a combination of coefficients is free.
FREE = 1e-10
#: Condition of normal matrices below which their inverses serve, and no combination of coefficients is free.
MAX_CONDITION = 1e6
#: Smallest diagonal element of the Cholesky factor of normalised normal equations that are solved directly.
MIN_PIVOT = 1e-3
#: Index of the column t/T in the design matrix of a motion, and of sign(v) and v in that without t/T.
TIME, DIRECTION, SPEED = 1, 0, 1


class Motion(NamedTuple):
    """Samples in which the piston moves, with the design matrix of their fit.

    `rows` (n,): indices of the samples; `design` (n, m): sign of the speed; time over the duration; speed and
    acceleration, each over the 99 % quantile of its magnitude; and a hat function of the position for each knot
    (`_hat_functions`). `strokes` (n,): number of the stroke, a motion in one direction without a rest; `top_speed`: the
    quantile of the speed.
    """

    rows: NDArray[np.intp]
    design: Array
    strokes: NDArray[np.intp]
    top_speed: float


@keep_with_recording
def select_motion(recording: Recording) -> Motion | None:
    """Select the samples in which the piston moves, and build the design matrix of their fit.

    The piston moves if the speed, averaged over `AVERAGING_TIME`, exceeds both three standard deviations of its noise
    and the fraction `healthy.slowest` (`priors.toml`) of the mean speed (`rest_limit`). Samples at rest are left
    out, since friction may then have any value between those of both directions. Samples in motion are thinned out if
    they are many. Return None if a chamber pressure or the motion is not recorded, or if the piston moves in fewer than
    `MIN_ROWS` samples.
    """
    name = find_motion_channel(recording.channels)
    if name is None or len(recording) < MIN_ROWS or not set(CHAMBERS) <= set(recording.channels):
        return None
    values, rate = recording[name], recording.rate
    is_position = name in ("x", "theta")
    increments = np.diff(values) if is_position else values / rate  # changes of the position between samples
    slowest = rest_limit(increments, rate, fraction=CHANGES.healthy.slowest)
    del increments
    speed = _average_slope(values, rate) if is_position else average_over(AVERAGING_TIME, values, rate)
    acceleration = _average_slope(speed, rate)
    is_known = np.isfinite(speed) & np.isfinite(acceleration) & np.isfinite(values)
    is_known &= np.isfinite(recording["p_A"]) & np.isfinite(recording["p_B"])
    rows = np.flatnonzero(is_known & (np.abs(speed) > slowest))
    if len(rows) < MIN_ROWS:
        return None
    rows = rows[:: max(1, len(rows) // MAX_ROWS)]
    time = (recording.t[rows] - recording.t[rows].mean()) / recording.duration
    top_speed, top_acceleration = (
        max(float(np.percentile(np.abs(signal[rows]), 99.0)), TINY) for signal in (speed, acceleration)
    )
    position = values[rows] if name == "x" else np.zeros(len(rows))  # without x the level is constant
    design = np.column_stack(
        [
            np.sign(speed[rows]),
            time,
            speed[rows] / top_speed,
            acceleration[rows] / top_acceleration,
            _hat_functions(position, min(KNOTS, len(rows) // ROWS_PER_KNOT)),
        ]
    )
    return Motion(rows, design, number_strokes(speed[rows], recording.t[rows]), top_speed)


def _average_slope(values: Array, rate: float) -> Array:
    """Compute the time derivative of values (n,), averaged over `AVERAGING_TIME`, with one array alone."""
    slope = np.empty_like(values)
    np.subtract(values[2:], values[:-2], out=slope[1:-1])
    slope[1:-1] *= 0.5 * rate
    slope[0], slope[-1] = rate * (values[1] - values[0]), rate * (values[-1] - values[-2])
    return average_over(AVERAGING_TIME, slope, rate, in_place=True)


def _hat_functions(position: Array, n_knots: int) -> Array:
    """Evaluate hat functions at positions (n,), without those that are 0 at every position; shape (n, k).

    A hat function is 1 at its knot and falls linearly to 0 at the neighbouring knots. The `n_knots` knots are equally
    spaced from the least to the largest position.
    """
    distance = (n_knots - 1) * (position - position.min()) / max(float(np.ptp(position)), TINY)
    hats = np.maximum(1.0 - np.abs(distance[:, None] - np.arange(n_knots)), 0.0)
    return np.asarray(hats[:, hats.any(axis=0)])


class Equations(NamedTuple):
    """Rows of a linear regression, without the elements that are 0, as most of a hat function are.

    `values`, `columns` (n, k): elements of each of n rows, and their columns in increasing order, with elements 0 in
    place of missing ones; `n_columns`: number of columns, of which the last one is the left side.
    """

    values: Array
    columns: NDArray[np.intp]
    n_columns: int


def stack_equations(design: Array, values: Array) -> Equations:
    """Make the rows of a regression of `values` (n,) on the columns of `design` (n, m), for `solve_weighted`."""
    rows = np.column_stack([design, values])
    counts = np.count_nonzero(rows, axis=1)
    n_stored = int(counts.max(initial=1))
    stored, columns = np.empty((len(rows), n_stored)), np.empty((len(rows), n_stored), dtype=np.intp)
    _store_rows(rows, n_stored - counts, stored, columns)
    return Equations(stored, columns, rows.shape[1])


@kernel
def _store_rows(rows: Any, n_missing: Any, stored: Any, columns: Any) -> None:
    """Write the elements of `rows` (n, m) that are not 0, and the first `n_missing` (n,) others, to `stored` (n, k)."""
    for row in range(len(rows)):
        k, n_left = 0, n_missing[row]
        for column in range(rows.shape[1]):
            if rows[row, column] != 0.0 or n_left > 0:
                n_left -= 1 if rows[row, column] == 0.0 else 0
                stored[row, k], columns[row, k] = rows[row, column], column
                k += 1


@kernel
def _sum_products(rows: Any, weight: Any, edges: Any, products: Any) -> None:
    """Write the products of the columns of weighted `rows` (`sum_products`) to `products` (p, m, m)."""
    values, columns, size = rows.values, rows.columns, rows.n_columns
    n_stored = values.shape[1]
    for part in range(len(edges) - 1):
        sums = products[part]
        for i in range(size):
            for j in range(size):
                sums[i, j] = 0.0
        for row in range(edges[part], edges[part + 1]):
            square = weight[row] * weight[row]
            for k in range(n_stored):
                i, value = columns[row, k], square * values[row, k]
                for m in range(k + 1):
                    sums[i, columns[row, m]] += value * values[row, m]
        for i in range(size):
            for j in range(i):
                sums[j, i] = sums[i, j]


def sum_products(equations: Equations, weight: Array, edges: NDArray[np.intp]) -> Array:
    """Sum w_i^2 x_i x_i' over p parts of the rows x_i (m,) of the equations; shape (p, m, m).

    `weight` (n,): factors w_i of the rows; `edges` (p + 1,): index of the first row of each part, and past the last
    row.
    """
    size = equations.n_columns
    products = np.empty((len(edges) - 1, size, size))
    _sum_products(equations, weight, edges, products)
    return products


def solve_weighted(equations: Equations, weight: Array) -> Array:
    """Solve a weighted least-squares problem; return the coefficients c (m,).

    They minimise sum((weight (values - design c))^2); if several do, c is the shortest of them. `equations`: n rows of
    the design and the values (`stack_equations`), with n > m; `weight` (n,): factors of the rows. The normal equations,
    with columns of unit length, give c unless the design is nearly singular (`MIN_PIVOT`); then a QR decomposition
    does.
    """
    products = sum_products(equations, weight, np.array([0, len(weight)]))[0]
    length = np.sqrt(np.diag(products)[:-1])
    if (length > 0.0).all():
        normal = products[:-1, :-1] / np.outer(length, length)
        factor, info = dpotrf(normal, lower=True)
        if info == 0 and np.diag(factor).min() > MIN_PIVOT:
            return np.asarray(dpotrs(factor, products[:-1, -1] / length, lower=True)[0] / length)
    rows = np.zeros((len(weight), equations.n_columns))
    np.put_along_axis(rows, equations.columns, equations.values * weight[:, None], axis=1)
    _, triangle = qr(rows, mode="raw", overwrite_a=True, check_finite=False)
    # R of the design and, in the last column, the values multiplied by Q^T
    solution = np.linalg.lstsq(triangle[:-1, :-1], triangle[:-1, -1], rcond=np.finfo(float).eps * len(weight))
    return np.asarray(solution[0])


def fit_robustly(design: Array, values: Array, columns: Sequence[int], groups: NDArray[np.intp]) -> list[Estimate]:
    """Fit coefficients c of `design` (n, m) to `values` (n,), values = design c, by reweighted least squares.

    The weights, by which the rows are multiplied, are 1/(1 + (residual/scale)^2), where the scale is `WEIGHT_SCALE`
    times the median of abs(residual), plus `MIN_RESIDUAL`. The fit is run from equal weights, and from weights that are
    small for values far from their median, such as those in contact with a workpiece; the run with the smaller median
    counts. Returns the coefficients of the given `columns`, with the errors of a jackknife over `groups` of rows
    (`jackknife_errors`). An error is infinite if the motion does not determine the coefficient, such as the friction of
    a piston that moves in one direction only.
    """
    equations = stack_equations(design, values)
    fits = list[tuple[float, Array, Array]]()
    for first_residual in (np.ones(len(values)), np.abs(values - np.median(values))):
        residual = first_residual
        for _ in range(ITERATIONS):
            coefficients = solve_weighted(equations, _robust_weight(residual))
            residual = np.abs(values - design @ coefficients)
        fits.append((float(np.median(residual)), coefficients, _robust_weight(residual)))
    _, coefficients, weight = min(fits, key=lambda fit: fit[0])
    errors = jackknife_errors(equations, weight, columns, groups)
    # With u = residual / scale and w = 1/(1 + u^2), the robust coefficients make the sum of psi(u) times the row of the
    # design zero, where psi = u w^2. Its slope is 4 w^3 - 3 w^2, with the fixed weights of the jackknife w^2. The
    # errors are larger by the ratio of the means of both, at most by 10.
    squares, slopes = float((weight**2).mean()), float((4.0 * weight**3 - 3.0 * weight**2).mean())
    errors *= squares / max(slopes, 0.1 * squares)
    return [Estimate(*pair) for pair in zip(coefficients[columns].tolist(), errors.tolist(), strict=True)]


def _robust_weight(residual: Array) -> Array:
    """Compute the weights (n,) of rows from the magnitudes of their residuals (n,) [Pa] (`fit_robustly`)."""
    scale = WEIGHT_SCALE * float(medians(residual)) + MIN_RESIDUAL
    return np.asarray(1.0 / (1.0 + (residual / scale) ** 2))


def part_sizes(n_rows: int) -> NDArray[np.intp]:
    """Return the sizes of `GROUPS` consecutive parts of `n_rows` rows, equal or, of the first parts, larger by 1."""
    return n_rows // GROUPS + (np.arange(GROUPS) < n_rows % GROUPS)


def part_quantiles(values: Array, quantile: float) -> Array:
    """Compute the `quantile` of each of `GROUPS` consecutive parts (`part_sizes`) of n >= `GROUPS` values (n,)."""
    size, n_larger = divmod(len(values), GROUPS)
    first_smaller = n_larger * (size + 1)
    larger, smaller = values[:first_smaller].reshape(n_larger, size + 1), values[first_smaller:].reshape(-1, size)
    return np.concatenate([np.quantile(part, quantile, axis=1) for part in (larger, smaller) if part.size])


def equal_parts(n_rows: int) -> NDArray[np.intp]:
    """Assign `n_rows` rows to `GROUPS` parts of equal size, in the order of time; return the part of each row, (n,)."""
    return np.arange(n_rows) * GROUPS // n_rows


def jackknife_errors(equations: Equations, weight: Array, columns: Sequence[int], groups: NDArray[np.intp]) -> Array:
    """Compute standard errors of some coefficients of a weighted least-squares fit by leaving out groups of rows.

    With P groups, the coefficient c from all rows, and c_k from all rows but those of group k,

        error^2 = (P - 1) / P sum over groups of (c_k - c)^2.

    Residuals may be correlated within a group. An error is infinite if the coefficient is not determined by all rows,
    or by all but those of one group. `equations`, `weight` (n,): the rows in the order of time, and their
    weights in the fit (`solve_weighted`); `columns`: indices of the coefficients; `groups` (n,): number of each row's
    group, from 0, in increasing order. More than `GROUPS` groups are merged with their neighbours.
    """
    n_groups = min(int(groups[-1]) + 1, GROUPS)
    if n_groups < 2:
        return np.full(len(columns), np.inf)
    # first row of each of `n_groups` merged groups
    edges = np.searchsorted(groups * n_groups // (groups[-1] + 1), np.arange(n_groups + 1))
    products = sum_products(equations, weight, edges)
    scale = np.maximum(np.sqrt(np.einsum("kii->i", products)), TINY)  # of each column over all rows
    scale[-1] = 1.0  # the values
    products /= np.outer(scale, scale)
    # products without each of the groups in turn, and last those of all rows
    total = products.sum(axis=0)
    without_group = np.concatenate([total - products, total[None]])
    matrices, moments = without_group[:, :-1, :-1], without_group[:, :-1, -1]
    inverses = _invert_regular(matrices)
    if inverses is not None:
        values = (inverses @ moments[:, :, None])[:, :, 0] / scale[:-1]
        return np.asarray(_scatter(values, n_groups)[list(columns)])
    eigenvalues, vectors = np.linalg.eigh(matrices)
    is_free = eigenvalues < FREE * eigenvalues[:, -1:]  # combinations of coefficients that the rows do not determine
    inverse = np.where(is_free, 0.0, 1.0 / np.where(is_free, 1.0, eigenvalues))
    rotated = inverse * (vectors.swapaxes(1, 2) @ moments[:, :, None])[:, :, 0]
    coefficients = (vectors @ rotated[:, :, None])[:, :, 0] / scale[:-1]
    # a coefficient is undetermined if it takes part, beyond rounding, in a free combination
    is_undetermined = np.einsum("kij,kj->ki", vectors**2, is_free.astype(float)).max(axis=0) > np.sqrt(FREE)
    return np.asarray(np.where(is_undetermined, np.inf, _scatter(coefficients, n_groups))[list(columns)])


def _scatter(coefficients: Array, n_groups: int) -> Array:
    """Compute the errors (m,) of a jackknife from `coefficients` (P + 1, m) without each of P groups, and of all."""
    squares = ((coefficients[:-1] - coefficients[-1]) ** 2).sum(axis=0)
    return np.asarray(np.sqrt((n_groups - 1.0) / n_groups * squares))


def _invert_regular(matrices: Array) -> Array | None:
    """Invert symmetric matrices (k, m, m); return None unless the condition of each is below `MAX_CONDITION`.

    The condition is at most the product of the Frobenius norms of a matrix and its inverse.
    """
    try:
        inverses = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        return None
    condition = np.linalg.norm(matrices, axis=(1, 2)) * np.linalg.norm(inverses, axis=(1, 2))
    return np.asarray(inverses) if (condition < MAX_CONDITION).all() else None


@keep_with_recording
@np.errstate(all="ignore")
def fit_difference(recording: Recording) -> Resistance | None:
    """Fit p_A - p_B in motion by friction, which reverses with the motion, and a viscous pressure drop (`Resistance`).

    The result is None if too few samples are in motion (`select_motion`), or if a value or its error is not finite.
    """
    motion = select_motion(recording)
    if motion is None:
        return None
    difference = recording["p_A"][motion.rows] - recording["p_B"][motion.rows]
    # columns without the time: sign of the speed (DIRECTION), speed over `top_speed` (SPEED), ...
    design = np.delete(motion.design, TIME, axis=1)
    # residuals may be correlated within a part
    friction, drop = fit_robustly(design, difference, [DIRECTION, SPEED], equal_parts(len(difference)))
    fit = Resistance(*friction, drop.value / motion.top_speed, drop.deviation / motion.top_speed, motion.top_speed)
    return fit if np.isfinite(fit).all() else None
