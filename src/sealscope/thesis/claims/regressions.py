"""What the features of a sheet say about the leak beyond what the operating condition says.

The regressions leave out the answer: a left-out test takes no part in its own prediction.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.claims.evidence import SENSITIVE
from sealscope.thesis.sheet import APPENDIX_C, DataSheet

if TYPE_CHECKING:
    from sealscope.campaigns.held_out.classifiers import MeasuredSamples


def condition_columns() -> Array:
    """Return the operating condition as columns (n, commands + 1): one indicator a command, and the closed share."""
    commands = sorted({row.command for row in APPENDIX_C})
    indicators = [[float(row.command == command) for command in commands] for row in APPENDIX_C]
    return np.column_stack([np.array(indicators), [row.closed_pct / 100.0 for row in APPENDIX_C]])


def mean_leaks() -> Array:
    """Return the mean leak of each test [L/min], (n,)."""
    return np.array([row.mean_leak_lpm for row in APPENDIX_C])


def partial_correlation(x: Array, y: Array, given: Array) -> float:
    """Return the correlation of what is left of `x` and `y`, (n,), after least squares on `given`, (n, k)."""
    left = [v - given @ np.linalg.lstsq(given, v, rcond=None)[0] for v in (x, y)]
    return float(np.corrcoef(left[0], left[1])[0, 1])


def left_out_r2(columns: Array, y: Array) -> float:
    """Return R^2 of least squares on `columns`, (n, k), with each test predicted from the others.

    ``1 - sum (r_i/(1 - h_i))^2 / sum (y_i - mean y)^2`` with residuals r and leverages h. Source: Allen,
    Technometrics 16 (1974) 125-127, doi 10.1080/00401706.1974.10489157.
    """
    hat = columns @ np.linalg.pinv(columns)
    residuals = (y - hat @ y) / (1.0 - np.diag(hat))
    return float(1.0 - np.sum(residuals**2) / np.sum((y - y.mean()) ** 2))


def change_columns(sheet: DataSheet) -> Array:
    """Return a column of ones and the six log changes of Table 5.1, (n, 7)."""
    changes = [sheet.log_change(chamber, name) for chamber in CHAMBERS for name in SENSITIVE]
    return np.column_stack([np.ones_like(changes[0]), *changes])


def samples_of(sheet: DataSheet) -> MeasuredSamples:
    """Return the sheet as samples: log RMS of each detail, each test without and with its leak."""
    from sealscope.campaigns.held_out.classifiers import MeasuredSamples

    leaks = [row.mean_leak_lpm for row in APPENDIX_C]
    return MeasuredSamples(
        features={
            f"{quantity} of {chamber}": np.log(values).T.ravel()
            for chamber, quantities in sheet.rms.items()
            for quantity, values in quantities.items()
        },
        leak_lpm=np.array([0.0] * len(leaks) + leaks),
        tests=[row.number for row in APPENDIX_C] * 2,
        levels=[{"command": row.command, "closed": f"{row.closed_pct:g} %"} for row in APPENDIX_C] * 2,
    )


def told_apart_by_levels(sheet: DataSheet, leave_out: str) -> tuple[float, float]:
    """Tell leak from no leak by the absolute log RMS of d1..d4 of both chambers, without the test's own baseline.

    Logistic regression with a ridge of 1; `leave_out`: every "test" or every "condition" is left out in turn. Returns
    the accuracy and the area under the curve.
    """
    from sealscope.campaigns.held_out.classifiers import held_out_scores
    from sealscope.campaigns.plans.model import LogisticClassifier
    from sealscope.evaluation.roc import auc

    samples = samples_of(sheet)
    features = tuple(f"d{level} of {chamber}" for chamber in CHAMBERS for level in range(1, 5))
    scores = held_out_scores(samples, LogisticClassifier("levels", features, 1.0), leave_out)
    leaking = samples.leak_lpm > 0
    return float(np.mean((scores > 0) == leaking)), auc(scores[~leaking], scores[leaking]).value
