"""What the features of a sheet say about the leak beyond what the operating condition says: regressions without leakage
of the answer (a left-out test takes no part in its own prediction)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.appendix_c.simulated_sheet import log_change
from sealscope.thesis.conditions import APPENDIX_C, Condition, groups
from sealscope.thesis.sheet import Sheet

Groups = NDArray[np.int64]


def condition_columns(conditions: tuple[Condition, ...] = APPENDIX_C) -> Array:
    """The operating condition as columns (n, commands + 1): one indicator a command, and the closed share."""
    commands = sorted({row.command for row in conditions})
    indicators = [[float(row.command == command) for command in commands] for row in conditions]
    return np.column_stack([np.array(indicators), [row.closed_pct / 100.0 for row in conditions]])


def condition_groups(conditions: tuple[Condition, ...] = APPENDIX_C) -> Groups:
    """Number of the operating condition (command and throttle) of each test, (n,)."""
    order = groups(conditions)
    return np.array([order.index(row.group) for row in conditions])


def mean_leaks(conditions: tuple[Condition, ...] = APPENDIX_C) -> Array:
    """Mean leak of each test [L/min], (n,)."""
    return np.array([row.mean_leak_lpm for row in conditions])


def partial_correlation(x: Array, y: Array, given: Array) -> float:
    """Correlation of what is left of `x` and `y`, (n,), after least squares on the columns of `given`, (n, k)."""
    left = [v - given @ np.linalg.lstsq(given, v, rcond=None)[0] for v in (x, y)]
    return float(np.corrcoef(left[0], left[1])[0, 1])


def left_out_r2(columns: Array, y: Array) -> float:
    """R^2 of least squares on `columns`, (n, k), with each test predicted from the others.

    ``1 - sum (r_i/(1 - h_i))^2 / sum (y_i - mean y)^2`` with residuals r and leverages h. Source: Allen,
    Technometrics 16 (1974) 125-127, doi 10.1080/00401706.1974.10489157.
    """
    hat = columns @ np.linalg.pinv(columns)
    residuals = (y - hat @ y) / (1.0 - np.diag(hat))
    return float(1.0 - np.sum(residuals**2) / np.sum((y - y.mean()) ** 2))


def change_columns(sheet: Sheet) -> Array:
    """A column of ones and the six log changes of Table 5.1, (n, 7)."""
    changes = [log_change(sheet, chamber, name) for chamber in CHAMBERS for name in ("d3", "d4", "d3d4")]
    return np.column_stack([np.ones_like(changes[0]), *changes])


@dataclass(frozen=True)
class Told:
    """How well a classifier told leak from no leak on what it had not seen."""

    accuracy: float
    true_positives: float
    false_positives: float
    auc: float


def _logistic(X: Array, y: Array, ridge: float) -> Array:
    """Weights of a logistic regression with an L2 penalty on all but the first, by Newton's method."""
    weights = np.zeros(X.shape[1])
    penalty = np.diag([0.0, *[ridge] * (X.shape[1] - 1)])
    for _ in range(50):
        p = 1.0 / (1.0 + np.exp(-np.clip(X @ weights, -30.0, 30.0)))
        hessian = X.T @ ((p * (1.0 - p))[:, None] * X) + penalty
        step = np.linalg.solve(hessian, X.T @ (y - p) - penalty @ weights)
        weights = weights + step
        if np.abs(step).max() < 1e-10:
            break
    return weights


def area_under_curve(positive: Array, negative: Array) -> float:
    """Probability that a positive scores above a negative, ties half (Mann-Whitney U over its greatest value)."""
    above = positive[:, None] > negative[None, :]
    return float(np.mean(above + 0.5 * (positive[:, None] == negative[None, :])))


def told_by_levels(sheet: Sheet, held_together: Groups, ridge: float = 1.0) -> Told:
    """Leak or no leak from the absolute log RMS of d1..d4 of both chambers, by logistic regression, without the test's
    own baseline; tests of one number in `held_together` are left out together.

    Features are scaled by the training tests alone.
    """
    names = [(chamber, f"d{level}") for chamber in CHAMBERS for level in range(1, 5)]
    halves = [np.column_stack([np.log(sheet.rms[c][name][:, k]) for c, name in names]) for k in (0, 1)]
    X, y = np.concatenate(halves), np.repeat([0.0, 1.0], len(held_together))
    fold = np.tile(held_together, 2)
    scores = np.empty(y.size)
    for out in np.unique(fold):
        train = fold != out
        mean, scale = X[train].mean(axis=0), X[train].std(axis=0)
        Z = np.column_stack([np.ones(y.size), (X - mean) / scale])
        scores[~train] = Z[~train] @ _logistic(Z[train], y[train], ridge)
    said, true = scores > 0, y == 1
    return Told(
        float(np.mean(said == true)),
        float(np.mean(said[true])),
        float(np.mean(said[~true])),
        area_under_curve(scores[true], scores[~true]),
    )
