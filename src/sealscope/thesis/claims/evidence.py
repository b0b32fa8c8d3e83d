"""Evidence for the claims on detection: sheets and shown tests, counts, correlations and regressions.

The regressions leave out the answer: a left-out test takes no part in its own prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sealscope.diagnosis.inference.onset import WITHIN_95
from sealscope.errors import MissingExtra
from sealscope.evaluation.binomial import clopper_pearson
from sealscope.evaluation.roc import auc
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.appendix_c_runs import simulated_sheet
from sealscope.thesis.chapters.chapter5 import TESTS, ShownMeasures, measure_test
from sealscope.thesis.chapters.success_rates import DIRECTION, Rule, column_tests
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.products import Claim, ThesisTable
from sealscope.thesis.engine.texts import judge_claim
from sealscope.thesis.sheet import APPENDIX_C, DataSheet

NO_SHEET = "the thesis's data sheet was not given"
#: The details that chapter 5 calls sensitive.
SENSITIVE = ("d3", "d4", "d3d4")


@dataclass(frozen=True, eq=False)
class ClaimEvidence:
    """The data by which the claims are judged.

    The measured sheet (None: not given), the simulated sheets with leak, with none and with drift only, the table of
    the first, the ten tests of chapter 5 by section, and the first of them without its leak.
    """

    measured: DataSheet | None
    leak: DataSheet
    still: DataSheet
    drift: DataSheet
    table: ThesisTable
    shown: dict[str, ShownMeasures]
    control: ShownMeasures


def gather(context: Context) -> ClaimEvidence:
    """Gather the evidence from the context's items and runs."""
    table, leak = simulated_sheet(context, "leak")
    _, still = simulated_sheet(context, "no-leak")
    _, drift = simulated_sheet(context, "drift")
    control = measure_test(context, TESTS["5.2a"], leak=False)
    shown = {section: measure_test(context, test) for section, test in TESTS.items()}
    return ClaimEvidence(context.sheet, leak, still, drift, table, shown, control)


#: A finding on a sheet, measured or simulated: its words, and which of the claim's parts hold.
Finding = tuple[str, Sequence[bool]]
#: Finds in a sheet what a claim says of it.
SheetTest = Callable[[DataSheet], Iterable[Finding]]


@dataclass(frozen=True)
class SheetClaim:
    """A claim's test on a sheet.

    `test` gives the findings, written after `head` with `joint` between them; `values` of the other texts of the claim.
    """

    test: SheetTest
    head: str = ""
    joint: str = "; "
    values: Callable[[ClaimEvidence, DataSheet], Mapping[str, Any]] = lambda evidence, sheet: {}

    def judge(self, evidence: ClaimEvidence, id: str, kind: str = "") -> Claim:
        """Judge by the measured sheet, and state the same test on the simulated sheet."""

        def findings(sheet: DataSheet) -> tuple[str, list[bool]]:
            texts, parts = zip(*self.test(sheet), strict=True)
            return self.head + self.joint.join(texts), [part for found in parts for part in found]

        result, parts = (NO_SHEET, []) if evidence.measured is None else findings(evidence.measured)
        values = self.values(evidence, evidence.measured or evidence.leak)
        return judge_claim(id, parts, kind, sheet=result, simulation=findings(evidence.leak)[0], **values)


def fired_share(sheet: DataSheet, rule: Rule) -> str:
    """Format `k/n = share %` of the tests that a rule fires in, with its exact 95 % interval."""
    return counted_share(rule.fires(sheet))


def counted_share(tests: Sequence[bool] | np.ndarray) -> str:
    """Format `k/n = share % (low to high)` of the tests that are true, with the exact 95 % interval."""
    k, n = int(np.sum(tests)), len(tests)
    low, high = clopper_pearson(k, n)
    return f"{k}/{n} = {100 * k / n:.1f} % ({100 * low:.0f} to {100 * high:.0f} %)"


def in_percent(change: Array | float) -> float:
    """Convert a log change, or the mean of several, to percent."""
    return float(100.0 * np.expm1(np.mean(change)))


def corrected_p(sheet: DataSheet) -> dict[tuple[str, str], float]:
    """Compute the sign-test p of every column, corrected (Holm) for all ten."""
    return {(str(row[0]), str(row[1])): float(row[-2]) for row in column_tests(sheet)}  # type: ignore[arg-type]


def moves_beyond_chance(sheet: DataSheet, chamber: str, name: str) -> bool:
    """Return True if a column moves in the chamber's direction beyond chance (5 %, corrected for ten columns)."""
    change = sheet.log_change(chamber, name) * DIRECTION[chamber]
    return bool(np.sum(change > 0) > np.sum(change < 0) and corrected_p(sheet)[chamber, name] < 0.05)


def correlated(r: float, n: int, controls: int = 0) -> bool:
    """Return True if a (partial) correlation of n points differs from 0 at 5 %, with `controls` columns taken out.

    By Fisher's z: ``|artanh r| sqrt(n - 3 - controls) > 1.96``. Source: Fisher, Metron 3 (1924) 329-332.
    """
    return bool(abs(np.arctanh(np.clip(r, -0.999999, 0.999999))) * np.sqrt(n - 3 - controls) > WITHIN_95)


def condition_columns() -> Array:
    """Build the operating condition as columns (n, commands + 1): one indicator a command, and the closed share."""
    commands = sorted({row.command for row in APPENDIX_C})
    indicators = [[float(row.command == command) for command in commands] for row in APPENDIX_C]
    return np.column_stack([np.array(indicators), [row.closed_pct / 100.0 for row in APPENDIX_C]])


def partial_correlation(x: Array, y: Array, controls: Array) -> float:
    """Compute the correlation of `x` and `y`, (n,), after least squares of both on `controls`, (n, k)."""
    residuals = [v - controls @ np.linalg.lstsq(controls, v, rcond=None)[0] for v in (x, y)]
    return float(np.corrcoef(residuals[0], residuals[1])[0, 1])


def left_out_r2(columns: Array, y: Array) -> float:
    """Compute R^2 of least squares on `columns`, (n, k), with each test predicted from the others.

    ``1 - sum (r_i/(1 - h_i))^2 / sum (y_i - mean y)^2`` with residuals r and leverages h. Source: Allen,
    Technometrics 16 (1974) 125-127, doi 10.1080/00401706.1974.10489157.
    """
    hat = columns @ np.linalg.pinv(columns)
    residuals = (y - hat @ y) / (1.0 - np.diag(hat))
    return float(1.0 - np.sum(residuals**2) / np.sum((y - y.mean()) ** 2))


def change_columns(sheet: DataSheet) -> Array:
    """Build a column of ones and the six log changes of Table 5.1, (n, 7)."""
    changes = [sheet.log_change(chamber, name) for chamber in CHAMBERS for name in SENSITIVE]
    return np.column_stack([np.ones_like(changes[0]), *changes])


def separation_by_levels(sheet: DataSheet, leave_out: Literal["test", "condition"]) -> tuple[float, float]:
    """Tell leak from no leak by the log RMS of d1..d4 of both chambers, without a baseline of the test's own.

    A logistic regression with a ridge of 1 on standardised levels judges each test, or each operating condition, by a
    fit that saw none of its samples. Return the accuracy and the area under the ROC. Raises MissingExtra where
    scikit-learn is absent.
    """
    try:
        from sklearn.linear_model import LogisticRegression
        from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler
    except ImportError:
        raise MissingExtra("a regression on levels needs scikit-learn: pip install 'sealscope[learn]'") from None

    levels = [sheet.rms[chamber][f"d{level}"] for chamber in CHAMBERS for level in range(1, 5)]
    columns = np.column_stack([np.log(rms).T.ravel() for rms in levels])  # all tests without, then with their leaks
    leaking = np.repeat([False, True], len(APPENDIX_C))
    groups = [row.number if leave_out == "test" else f"{row.command} at {row.closed_pct:g} %" for row in APPENDIX_C] * 2
    regression = make_pipeline(StandardScaler(), LogisticRegression(C=1.0, tol=1e-9))
    odds = cross_val_predict(
        regression, columns, leaking, groups=groups, cv=LeaveOneGroupOut(), method="decision_function"
    )
    return float(np.mean((odds > 0) == leaking)), auc(odds[~leaking], odds[leaking]).value
