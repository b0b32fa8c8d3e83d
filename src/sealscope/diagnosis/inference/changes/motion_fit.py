"""Robust fit of the pressures over the samples in which the piston moves.

A pressure, or p_A - p_B, is fitted by

    p = level(x) + half sign(v) + b v + c dv/dt + drift t/T,

with position x, speed v, and the time t over the recording's duration T. The level is free in each of `BINS` bins of
the position. The fit is iteratively reweighted least squares with Cauchy weights, so that contact with a workpiece
hardly counts. Standard errors allow for residuals that are correlated within each of `PARTS` parts of the recording
(cluster-robust). Called for friction and drifts (`healthy_levels`) and for the viscous drop (`viscous_drop`).

Sources: P. W. Holland, R. E. Welsch, Communications in Statistics A6 (1977) 813 (the weights); K.-Y. Liang, S. L.
Zeger, Biometrika 73 (1986) 13 (the standard error).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from sealscope.diagnosis.inference.changes.levels import motion_columns, motion_scales
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array, Recording, compute_once

#: Number of bins of the position.
BINS = 24
#: Maximum and minimum number of rows of a fit, and its number of iterations.
MAX_ROWS, MIN_ROWS, ITERATIONS = 4000, 200, 8
#: Scale of the weights' decrease with the residual, over the median residual.
WEIGHT_SCALE = 2.0
#: Smallest length that is divided by, and smallest scale of residuals [Pa].
TINY, MIN_RESIDUAL = 1e-300, 1.0
#: Relative rounding error of a double; a singular value below it times the number of rows counts as zero.
ROUNDING = float(np.finfo(float).eps)
#: Number of parts of a recording whose residuals count as independent.
PARTS = 20
#: Indices of the columns sign(v), t/T and v in a design matrix.
DIRECTION, TIME, SPEED = 0, 1, 2


class Motion(NamedTuple):
    """Samples in which the piston moves, with the design matrix of their fit.

    `rows` (n,): indices of the samples; `design` (n, m): sign of the speed, time, speed, acceleration, and a column of
    0 and 1 for each bin of the position; `top_speed`: speed that counts as 1 in the column of the speed.
    """

    rows: NDArray[np.intp]
    design: Array
    top_speed: float


def select_motion(recording: Recording) -> Motion | None:
    """Select the samples in which the piston moves, and build the design matrix of their fit (`Motion`).

    The piston moves if its speed exceeds a fraction (`healthy.slowest` in `priors.toml`) of the 99 % quantile of its
    speed. Samples in motion are thinned out if they are many. Return None if a chamber pressure or a signal of the
    motion is not recorded, or if the piston moves in fewer than `MIN_ROWS` samples.
    """
    if len(recording) < MIN_ROWS or not set(CHAMBERS) <= set(recording.channels):
        return None
    motion = motion_columns(recording.channels, recording.rate)
    if motion is None:
        return None
    scales = motion_scales(motion)
    motion = motion / scales
    is_known = np.isfinite(motion).all(axis=1) & np.isfinite(recording["p_A"]) & np.isfinite(recording["p_B"])
    rows = np.flatnonzero(is_known & (np.abs(motion[:, 0]) > CHANGES.healthy.slowest))
    if len(rows) < MIN_ROWS:
        return None
    rows = rows[:: max(1, len(rows) // MAX_ROWS)]
    speed = motion[rows, 0]
    time = (recording.t[rows] - recording.t[rows].mean()) / recording.duration
    position = motion[rows, 2] if motion.shape[1] > 2 else np.zeros(len(rows))
    bins = np.minimum(BINS * (position - position.min()) / max(float(np.ptp(position)), TINY), BINS - 1).astype(int)
    is_in_bin = np.eye(BINS)[bins]
    is_used = is_in_bin.any(axis=0)
    design = np.column_stack([np.sign(speed), time, motion[rows, :2], is_in_bin[:, is_used]])
    return Motion(rows, design, top_speed=float(scales[0]))


def stack_equations(design: Array, values: Array) -> Array:
    """Stack the columns of a design matrix (n, m) and the values (n,) as rows (m + 1, n), for `solve_weighted`."""
    return np.ascontiguousarray(np.vstack([design.T, values]))


def solve_weighted(equations: Array, weight: Array) -> Array:
    """Solve a weighted least-squares problem by a QR decomposition; return the coefficients c (m,).

    The coefficients minimise sum((weight (values - design c))^2). If the weighted design matrix does not have full
    rank, c is the shortest of all solutions, as from `numpy.linalg.lstsq`. `equations` (m + 1, n): columns of the
    design and values (`stack_equations`), with n > m; `weight` (n,): factors of the rows.
    """
    _, triangle = qr((equations * weight).T, mode="raw", overwrite_a=True, check_finite=False)
    solution = np.linalg.lstsq(triangle[:-1, :-1], triangle[:-1, -1], rcond=ROUNDING * len(weight))
    return np.asarray(solution[0])


def fit_robustly(design: Array, values: Array) -> tuple[Array, Array]:
    """Fit coefficients c (m,) of `design` (n, m) to `values` (n,), values = design c, by reweighted least squares.

    The weights are 1/sqrt(1 + (residual/scale)^2), where the scale is `WEIGHT_SCALE` times the median of abs(residual),
    plus `MIN_RESIDUAL`. Returns the coefficients and the weights (n,).
    """
    equations, weight = stack_equations(design, values), np.ones(len(values))
    for _ in range(ITERATIONS):
        coefficients = solve_weighted(equations, weight)
        residual = np.abs(values - design @ coefficients)
        scale = WEIGHT_SCALE * float(np.median(residual)) + MIN_RESIDUAL
        weight = 1.0 / np.hypot(1.0, residual / scale)
    return coefficients, weight


def cluster_errors(design: Array, residual: Array, columns: Sequence[int]) -> Array:
    """Compute standard errors of some coefficients of a weighted least-squares fit.

    The residuals may be correlated within each of P = `PARTS` parts of the recording:

        error^2 = P / (P - 1) sum over parts of influence^2,    influence = (X' X)^-1 (X' residual of the part).

    `design` (n, m): the matrix X; `residual` (n,): residuals in the order of time; both are multiplied by the weights
    of the fit. `columns`: indices of the coefficients.
    """
    edges = np.linspace(0, len(residual), PARTS + 1).astype(int)[:-1]
    scores = np.add.reduceat(design * residual[:, None], edges, axis=0)
    influences = np.linalg.pinv(design.T @ design)[list(columns)] @ scores.T
    return np.asarray(np.sqrt(PARTS / (PARTS - 1.0) * (influences**2).sum(axis=1)))


class DifferenceFit(NamedTuple):
    """Fit of p_A - p_B by friction, which reverses with the motion, and a drop proportional to the speed.

    `friction`: half the difference between the directions of motion [Pa]; `drop`: viscous pressure drop per speed, in
    Pa per unit of the speed of `motion_columns`; `friction_error`, `drop_error`: standard errors of both.
    """

    friction: float
    friction_error: float
    drop: float
    drop_error: float


def fit_difference(recording: Recording) -> DifferenceFit | None:
    """Fit p_A - p_B of a recording by friction, which reverses with the motion, and a viscous drop.

    The result is None without enough motion. It is computed only once for a recording.
    """
    return compute_once(recording, ("motion fit of p_A - p_B",), _fit_difference)


@np.errstate(all="ignore")
def _fit_difference(recording: Recording) -> DifferenceFit | None:
    """Fit friction and viscous drop to p_A - p_B in motion, with their standard errors; None without enough motion.

    The standard errors allow for residuals that are correlated within parts of the recording (`cluster_errors`).
    """
    motion = select_motion(recording)
    if motion is None:
        return None
    rows, design, top_speed = motion
    difference = recording["p_A"][rows] - recording["p_B"][rows]
    coefficients, weight = fit_robustly(design, difference)
    weighted = design * weight[:, None]
    residual = (difference - design @ coefficients) * weight
    friction_error, speed_error = cluster_errors(weighted, residual, [DIRECTION, SPEED])
    fit = DifferenceFit(
        friction=float(coefficients[DIRECTION]),
        friction_error=float(friction_error),
        drop=float(coefficients[SPEED] / top_speed),
        drop_error=float(speed_error / top_speed),
    )
    return fit if np.isfinite(fit).all() else None
