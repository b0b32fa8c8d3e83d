"""Collect the evidence for the claims on detection: data sheets, measured tests, counts, correlations, regressions."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sealscope.diagnosis.estimate.interval import WITHIN_95
from sealscope.errors import MissingExtra
from sealscope.evaluation.binomial import clopper_pearson
from sealscope.evaluation.roc import auc
from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.appendix_c_runs import simulated_sheet
from sealscope.thesis.chapters.chapter5 import TESTS, LeakTestMeasures, measure_test
from sealscope.thesis.chapters.success_rates import DIRECTION, column_tests
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.products import Claim, ThesisTable
from sealscope.thesis.engine.texts import judge_claim
from sealscope.thesis.sheet import APPENDIX_C, GROUPS, DataSheet

NO_SHEET = "the thesis's data sheet was not given"
#: The details that chapter 5 calls sensitive.
SENSITIVE = ("d3", "d4", "d3d4")


@dataclass(frozen=True, eq=False)
class ClaimEvidence:
    """The data by which the claims on detection are judged.

    `measured_sheet`: measured data sheet of Appendix C, None if not given; `leak_sheet`, `no_leak_sheet`,
    `drift_sheet`: its tests simulated with their leak, without, and with drifting parameters instead; `leak_table`: the
    runs of `leak_sheet`; `test_measures`: of the ten simulated tests of chapter 5 by section, such as "5.2a";
    `no_leak_measures`: of test 5.2a without its leak.
    """

    measured_sheet: DataSheet | None
    leak_sheet: DataSheet
    no_leak_sheet: DataSheet
    drift_sheet: DataSheet
    leak_table: ThesisTable
    test_measures: dict[str, LeakTestMeasures]
    no_leak_measures: LeakTestMeasures


def gather_evidence(context: Context) -> ClaimEvidence:
    """Gather the evidence for the claims on detection; the ten tests of chapter 5 are simulated here."""
    leak_table, leak_sheet = simulated_sheet(context, "leak")
    return ClaimEvidence(
        measured_sheet=context.sheet,
        leak_sheet=leak_sheet,
        no_leak_sheet=simulated_sheet(context, "no-leak")[1],
        drift_sheet=simulated_sheet(context, "drift")[1],
        leak_table=leak_table,
        test_measures={section: measure_test(context, test) for section, test in TESTS.items()},
        no_leak_measures=measure_test(context, TESTS["5.2a"], leak=False),
    )


#: A finding on a sheet: its text, and True or False for each part of the claim on which it decides.
Finding = tuple[str, Sequence[bool]]


def judge_on_sheets(
    evidence: ClaimEvidence,
    id: str,
    test: Callable[[DataSheet], Iterable[Finding]],
    head: str = "",
    separator: str = "; ",
    kind: str = "",
    **values: Any,
) -> Claim:
    """Judge a claim by the measured data sheet, and state the findings on the measured and the simulated sheet.

    `test`: yields the findings on a sheet; `head`, `separator`: text before and between the texts of the findings;
    `kind`: key of the texts in `claims.toml` if claims share them, by default `id`; `values`: values of placeholders
    in the claim's other texts. Without a measured sheet the claim `cannot be tested`.
    """

    def state_findings(sheet: DataSheet) -> tuple[str, list[bool]]:
        """Format all findings on a sheet as one text, and collect the results of all parts of the claim."""
        texts, parts = zip(*test(sheet), strict=True)
        return head + separator.join(texts), list(itertools.chain.from_iterable(parts))

    measured = evidence.measured_sheet
    sheet_text, parts = (NO_SHEET, []) if measured is None else state_findings(measured)
    simulation_text, _ = state_findings(evidence.leak_sheet)
    return judge_claim(id, parts, kind, sheet=sheet_text, simulation=simulation_text, **values)


def format_rate(tests: Sequence[bool] | np.ndarray) -> str:
    """Format the number of tests (n,) that passed, as in `34/41 = 82.9 % (68 to 93 %)` with the exact 95 % interval."""
    k, n = int(np.sum(tests)), len(tests)
    low, high = clopper_pearson(k, n)
    return f"{k}/{n} = {100 * k / n:.1f} % ({100 * low:.0f} to {100 * high:.0f} %)"


def holm_p_values(sheet: DataSheet) -> dict[tuple[str, str], float]:
    """Return the p-values of `column_tests`, corrected by Holm, by (chamber, detail)."""
    # a row begins with chamber and detail, and ends with the corrected p-value and whether it is below 5 %
    return {(str(chamber), str(name)): float(p) for chamber, name, *_, p, _ in column_tests(sheet)}  # type: ignore[arg-type]


def moves_beyond_chance(sheet: DataSheet, chamber: str, name: str) -> bool:
    """Return True if a detail's RMS moves as the thesis states in most tests, with a p-value below 5 % (Holm)."""
    change = sheet.log_change(chamber, name) * DIRECTION[chamber]  # > 0: in the thesis's direction
    return bool(np.sum(change > 0) > np.sum(change < 0) and holm_p_values(sheet)[chamber, name] < 0.05)


def is_correlated(r: float, n: int, controls: int = 0) -> bool:
    """Return True if a correlation coefficient `r` of n points differs from 0 at the 5 % level (two-sided).

    Fisher's z: ``|artanh r| sqrt(n - 3 - controls) > 1.96``, with `controls` the number of columns on which both
    variables were regressed before. Source: Fisher, Metron 3 (1924) 329-332.
    """
    z = np.arctanh(np.clip(r, -0.999999, 0.999999))  # clipped, as artanh(1) is infinite
    return bool(abs(z) * np.sqrt(n - 3 - controls) > WITHIN_95)


def condition_design() -> Array:
    """Build the design matrix (tests, commands + 1): indicators of the commands, and the throttles' closed fraction."""
    commands = sorted({row.command for row in APPENDIX_C})
    indicators = [[float(row.command == command) for command in commands] for row in APPENDIX_C]
    return np.column_stack([np.array(indicators), [row.closed_pct / 100.0 for row in APPENDIX_C]])


def partial_correlation(x: Array, y: Array, controls: Array) -> float:
    """Correlate the residuals of `x` and of `y` (n,) from least-squares fits by the columns of `controls` (n, k)."""
    residuals = [v - controls @ np.linalg.lstsq(controls, v, rcond=None)[0] for v in (x, y)]
    return float(np.corrcoef(residuals[0], residuals[1])[0, 1])


def leave_one_out_r2(columns: Array, y: Array) -> float:
    """Compute the leave-one-out R^2 of a least-squares fit of `y` (n,) by `columns` (n, k).

    With residuals r and leverages h, R^2 is ``1 - sum (r_i/(1 - h_i))^2 / sum (y_i - mean y)^2``. Source:
    Allen, Technometrics 16 (1974) 125-127, doi 10.1080/00401706.1974.10489157.
    """
    hat = columns @ np.linalg.pinv(columns)  # its diagonal has the leverages h
    residuals = (y - hat @ y) / (1.0 - np.diag(hat))
    return float(1.0 - np.sum(residuals**2) / np.sum((y - y.mean()) ** 2))


def change_design(sheet: DataSheet) -> Array:
    """Build the design matrix (tests, 7): a constant, and the log changes with the leak of d3, d4, d3d4 of p_A, p_B."""
    changes = [sheet.log_change(chamber, name) for chamber in CHAMBERS for name in SENSITIVE]
    return np.column_stack([np.ones_like(changes[0]), *changes])


def classify_without_baseline(sheet: DataSheet, leave_out: Literal["test", "condition"]) -> tuple[float, float]:
    """Classify the halves of the tests as leaking or not by the RMS of wavelet details, without a healthy baseline.

    The inputs for a half of a test, without or with the leak, are the logarithms of the RMS of d1 to d4 of p_A and p_B.
    They are standardised and classified by a logistic regression with an L2 penalty (C = 1). Each half is judged by a
    regression without its test (`leave_out` "test") or without all tests of its command and closing of the throttles
    ("condition"). Returns the fraction of halves classified correctly, and the area under the ROC curve. Raises
    MissingExtra if scikit-learn is not installed.
    """
    try:
        from sklearn.linear_model import LogisticRegression
        from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler
    except ImportError:
        raise MissingExtra("a regression on levels needs scikit-learn: pip install 'sealscope[learn]'") from None

    detail_rms = [sheet.rms[chamber][f"d{level}"] for chamber in CHAMBERS for level in range(1, 5)]
    # rows: the leak-free halves of all tests, then the leaking halves
    columns = np.column_stack([np.log(rms).T.ravel() for rms in detail_rms])
    is_leaking = np.repeat([False, True], len(APPENDIX_C))
    groups = [row.number if leave_out == "test" else GROUPS.index(row.group) for row in APPENDIX_C] * 2  # both halves
    regression = make_pipeline(StandardScaler(), LogisticRegression(C=1.0, tol=1e-9))
    log_odds = cross_val_predict(
        regression, columns, is_leaking, groups=groups, cv=LeaveOneGroupOut(), method="decision_function"
    )
    return float(np.mean((log_odds > 0) == is_leaking)), auc(log_odds[~is_leaking], log_odds[is_leaking]).value
