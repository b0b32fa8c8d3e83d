"""Table 5.1 counted anew, and what the columns of the sheet say of the leak."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from sealscope.errors import MissingExtra
from sealscope.evaluation.binomial import clopper_pearson
from sealscope.recordings.channels import CHAMBERS
from sealscope.thesis.chapters.success_rates import (
    CLAIMED,
    RATES,
    UNCLAIMED,
    column_tests,
    count_rules,
    count_with_thresholds,
    d1_threshold,
    drift_threshold,
)
from sealscope.thesis.claims.evidence import (
    change_design,
    classify_without_baseline,
    condition_design,
    leave_one_out_r2,
    partial_correlation,
)
from sealscope.thesis.sheet import DataSheet, mean_leaks

from ..refusals import refusal
from .conftest import made_sheet, needs_sheet


@needs_sheet
def test_table_5_1_from_the_sheet(measured_sheet: DataSheet) -> None:
    counts = {rule.name: int(rule.fires(measured_sheet).sum()) for rule in (*CLAIMED, *UNCLAIMED)}
    assert counts == {
        "P_A d3 down": 41, "P_A d4 down": 27, "P_A d3d4 down": 35,
        "P_B d3 up": 21, "P_B d4 up": 31, "P_B d3d4 up": 32, "both d3d4": 26,
        "P_A d1 down": 25, "P_A d2 down": 35, "P_B d1 up": 22, "P_B d2 up": 15,
    }  # fmt: skip


@needs_sheet
def test_what_the_columns_of_the_sheet_show_beyond_chance(measured_sheet: DataSheet) -> None:
    rows = {(row[0], row[1]): row for row in column_tests(measured_sheet)}
    assert {key for key, row in rows.items() if row[-1] == "yes"} == {
        ("p_A", "d2"), ("p_A", "d3"), ("p_A", "d3d4"), ("p_B", "d4"), ("p_B", "d3d4"),
    }  # fmt: skip
    assert rows["p_A", "d3"][5] == pytest.approx(2 * 0.5**41)
    assert rows["p_A", "d4"][6] > 0.25  # 27 of 41 is no more than chance


@needs_sheet
def test_with_a_threshold_from_d1_the_sheet_s_d3_finds_35_of_41(measured_sheet: DataSheet) -> None:
    rows = {row[0]: row for row in count_with_thresholds(measured_sheet, made_sheet(1), made_sheet(2))}
    assert rows["P_A d3 down"][2] == "35/41"
    assert d1_threshold(measured_sheet, "p_A") == pytest.approx(0.0723, abs=5e-4)


@needs_sheet
def test_the_condition_tells_more_of_the_leak_than_the_features_do(measured_sheet: DataSheet) -> None:
    """The fall of d3 goes with the leak, but only as far as both go with the operating condition."""
    leaks, conditions = mean_leaks(), condition_design()
    without, with_leak = measured_sheet.rms["p_A"]["d3"].T
    fall = np.log(with_leak / without)
    assert np.corrcoef(fall, leaks)[0, 1] < -0.6
    assert abs(partial_correlation(fall, leaks, conditions)) < 0.1
    assert leave_one_out_r2(conditions, leaks) == pytest.approx(0.76, abs=0.01)
    assert leave_one_out_r2(change_design(measured_sheet), leaks) == pytest.approx(0.45, abs=0.01)


@pytest.mark.slow
@needs_sheet
def test_absolute_levels_of_both_chambers_tell_leak_from_none(measured_sheet: DataSheet) -> None:
    accuracy, auc = classify_without_baseline(measured_sheet, "test")
    accuracy_by_condition, auc_by_condition = classify_without_baseline(measured_sheet, "condition")
    assert (accuracy, accuracy_by_condition) == (78 / 82, 73 / 82)
    assert (auc, auc_by_condition) == pytest.approx((0.990, 0.980), abs=0.001)


def test_rates_stand_beside_their_controls() -> None:
    leak = made_sheet(1, {("p_A", "d3"): -0.3, ("p_A", "d3d4"): -0.5, ("p_B", "d3d4"): 0.5})
    drift = made_sheet(3, n=123)
    rows = {str(row[0]): dict(zip(RATES, row, strict=True)) for row in count_rules(None, leak, made_sheet(2), drift)}
    assert rows["P_A d3 down"]["simulated leak: fires"] == "41/41"
    assert rows["both d3d4"]["simulated leak: rate [%]"] == 100.0
    assert rows["P_A d3 down"]["sheet: fires"] is None
    assert rows["always fires"]["simulated, drift only: fires"] == "123/123"
    assert rows["never fires"]["simulated leak: fires"] == "0/41"
    for rule in ("always fires", "never fires"):
        assert rows[rule]["simulated leak less drift [points]"] == 0.0
    chance = rows["P_A d4 down"]
    assert 25.0 < chance["simulated, drift only: rate [%]"] < 75.0  # type: ignore[operator]
    low, high = clopper_pearson(41, 41)
    assert rows["P_A d3 down"]["simulated leak: 95 % low [%]"] == pytest.approx(100 * low)
    assert rows["P_A d3 down"]["simulated leak: 95 % high [%]"] == pytest.approx(100 * high)


def test_thresholds_let_the_stated_share_of_leak_free_tests_through() -> None:
    still = made_sheet(4, n=20_000)
    for chamber in CHAMBERS:
        assert d1_threshold(still, chamber) == pytest.approx(1.645 * 0.05, rel=0.03)
        assert d1_threshold(still, chamber, either_side=True) == pytest.approx(1.960 * 0.05, rel=0.03)
        limit = drift_threshold(still, chamber, "d4")
        change = np.log(still.rms[chamber]["d4"][:, 1] / still.rms[chamber]["d4"][:, 0])
        way = -1 if chamber == "p_A" else 1
        assert np.mean(change * way > limit) == pytest.approx(0.05, abs=1e-3)


def test_column_tests_find_what_moves_and_little_else() -> None:
    moved = {(row[0], row[1]) for row in column_tests(made_sheet(5, {("p_B", "d4"): 0.2})) if row[-1] == "yes"}
    assert moved == {("p_B", "d4")}
    false = sum(any(row[-1] == "yes" for row in column_tests(made_sheet(seed))) for seed in range(100, 300))
    assert false <= 20  # 200 sheets of nothing: at most 5 % of them name any column, 20 is four deviations above


def test_leave_one_out_r2_is_that_of_leaving_each_out() -> None:
    random = np.random.default_rng(6)
    X = np.column_stack([np.ones(30), random.standard_normal((30, 2))])
    y = X @ np.array([1.0, 2.0, -1.0]) + random.standard_normal(30)
    predicted = np.array(
        [X[k] @ np.linalg.lstsq(np.delete(X, k, 0), np.delete(y, k), rcond=None)[0] for k in range(30)]
    )
    assert leave_one_out_r2(X, y) == pytest.approx(1 - np.sum((y - predicted) ** 2) / np.sum((y - y.mean()) ** 2))


def test_partial_correlation_takes_the_common_cause_out() -> None:
    random = np.random.default_rng(7)
    cause = random.standard_normal(5000)
    x, y = cause + random.standard_normal(5000), cause + random.standard_normal(5000)
    given_cause = np.column_stack([np.ones(5000), cause])
    assert np.corrcoef(x, y)[0, 1] > 0.45
    assert abs(partial_correlation(x, y, given_cause)) < 0.05


def test_without_scikit_learn_the_claim_says_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.linear_model", None)
    with refusal("sealscope[learn]", error=MissingExtra):
        classify_without_baseline(made_sheet(8), "test")


@pytest.mark.slow
def test_levels_without_information_tell_nothing() -> None:
    _, auc = classify_without_baseline(made_sheet(8, scatter=0.4), "test")
    assert 0.3 < auc < 0.7
