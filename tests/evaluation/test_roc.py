"""The area under the curve and the curve itself: published data, a count over all pairs, and bands that hold."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.evaluation.roc import auc, kolmogorov_margin, roc_curve

# Hanley and McNeil, Radiology 143 (1982) 29-36, table I: ratings 1 (definitely normal) to 5 of 109 CT images
HANLEY_NORMAL = np.repeat([1, 2, 3, 4, 5], [33, 6, 6, 11, 2])
HANLEY_ABNORMAL = np.repeat([1, 2, 3, 4, 5], [3, 2, 2, 11, 33])

# DeLong, DeLong and Clarke-Pearson, Biometrics 44 (1988) 837-845: albumin, total protein, K-G score and outcome of the
# 43 patients with all of them, as in the SAS/STAT User's Guide, LOGISTIC procedure, "Comparing ROC curves"
_DELONG = """
    3.0 5.8 10 0  3.2 6.3 5 1  3.9 6.8 3 1  2.8 4.8 6 0  3.2 5.8 3 1  0.9 4.0 5 0  2.5 5.7 8 0  1.6 5.6 5 1
    3.8 5.7 5 1  3.7 6.7 6 1  3.2 5.4 4 1  3.8 6.6 6 1  4.1 6.6 5 1  3.6 5.7 5 1  4.3 7.0 4 1  3.6 6.7 4 0
    2.3 4.4 6 1  4.2 7.6 4 0  4.0 6.6 6 0  3.5 5.8 6 1  3.8 6.8 7 1  3.0 4.7 8 0  4.5 7.4 5 1  3.7 7.4 5 1
    3.1 6.6 6 1  4.1 8.2 6 1  4.3 7.0 5 1  4.3 6.5 4 1  3.2 5.1 5 1  2.6 4.7 6 1  3.3 6.8 6 0  1.7 4.0 7 0
    3.7 6.1 5 1  3.3 6.3 7 1  4.2 7.7 6 1  3.5 6.2 5 1  2.9 5.7 9 0  2.1 4.8 7 1  2.8 6.2 8 0  4.0 7.0 7 1
    3.3 5.7 6 1  3.7 6.9 5 1  3.6 6.6 5 1
"""
DELONG = np.array(_DELONG.split(), dtype=float).reshape(-1, 4)


def delong_pair(column: int, sign: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Scores of the patients without and with the outcome."""
    good = DELONG[:, 3] == 1
    return sign * DELONG[~good, column], sign * DELONG[good, column]


scores = st.lists(st.integers(-6, 6).map(float), min_size=2, max_size=25)


def standard_error(area) -> float:
    """The standard error by which an interval of 95 % was made that neither 0 nor 1 cuts off."""
    return (area.high - area.low) / (2 * 1.959963985)


def by_pairs(a, b) -> float:
    difference = np.subtract.outer(np.asarray(b, float), np.asarray(a, float))
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))


def test_hanley_and_mcneil_s_ct_images():
    """Their area is 0.893 with error 0.032; DeLong's error and interval as Stata's manual prints them ([R] roctab:
    0.8932, 0.0307, 0.83295 to 0.95339)."""
    area = auc(HANLEY_NORMAL, HANLEY_ABNORMAL)
    assert area.value == pytest.approx(0.8932, abs=5e-5)
    assert standard_error(area) == pytest.approx(0.0307, abs=5e-5)
    assert (area.low, area.high) == pytest.approx((0.83295, 0.95339), abs=5e-6)


@pytest.mark.parametrize(
    ("column", "sign", "area", "error", "low", "high"),
    [
        (0, 1.0, 0.7366, 0.0927, 0.5549, 0.9182),
        (2, -1.0, 0.7258, 0.1028, 0.5243, 0.9273),
        (1, 1.0, 0.6478, 0.1000, 0.4518, 0.8439),
    ],
    ids=["albumin", "K-G score", "total protein"],
)
def test_delong_s_ovarian_cancer_patients(column, sign, area, error, low, high):
    result = auc(*delong_pair(column, sign))
    assert (result.value, standard_error(result), result.low, result.high) == pytest.approx(
        (area, error, low, high), abs=5.1e-5
    )


@settings(deadline=None)
@given(scores, scores)
def test_the_area_is_the_count_over_pairs_and_of_the_curve(a, b):
    area = auc(a, b)
    assert area.value == pytest.approx(by_pairs(a, b))
    curve = roc_curve(a, b)
    heights = (curve.detection[1:] + curve.detection[:-1]) / 2
    assert np.diff(curve.false_alarm) @ heights == pytest.approx(area.value)
    assert 0.0 <= area.low <= area.value + 1e-9
    assert area.value <= area.high + 1e-9 <= 1.0 + 1e-9


@settings(deadline=None)
@given(scores, scores)
def test_the_area_turns_with_the_score_and_is_blind_to_its_scale(a, b):
    a, b = np.array(a), np.array(b)
    area = auc(a, b)
    turned, swapped, distorted = auc(-a, -b), auc(b, a), auc(np.exp(a) + 3, np.exp(b) + 3)
    assert turned.value == pytest.approx(1 - area.value)
    assert (turned.low, turned.high) == pytest.approx((1 - area.high, 1 - area.low), abs=1e-8)
    assert swapped.value == pytest.approx(1 - area.value)
    assert distorted.value == pytest.approx(area.value)
    assert (distorted.low, distorted.high) == pytest.approx((area.low, area.high), abs=1e-12)


def test_delong_s_error_is_the_jackknife_s():
    """For a two-sample statistic of pairs, leaving out one record at a time gives the same variance."""
    rng = np.random.default_rng(4)
    a, b = rng.normal(size=30), rng.normal(0.8, 1.0, 25)
    left_a = [by_pairs(np.delete(a, i), b) for i in range(a.size)]
    left_b = [by_pairs(a, np.delete(b, i)) for i in range(b.size)]
    variance = sum((x.size - 1) ** 2 / x.size * np.var(left, ddof=1) for x, left in ((a, left_a), (b, left_b)))
    assert standard_error(auc(a, b)) == pytest.approx(math.sqrt(variance))


def test_scores_that_are_all_apart_still_have_an_interval():
    """The normal interval has no width there; Newcombe's has, narrower with more records, and mirrors."""
    few, many = auc([1, 2, 3], [4, 5, 6, 7]), auc(range(100), range(100, 200))
    assert (few.value, few.high) == (1.0, 1.0)
    assert few.low < many.low < 1.0
    none = auc([4, 5, 6, 7], [1, 2, 3])
    assert none.high == pytest.approx(1.0 - auc([1, 2, 3], [4, 5, 6, 7]).low)


def test_newcombe_s_limits_solve_their_equation():
    area = auc(range(58), range(58, 109))
    q = (1 - area.low) / (2 - area.low) + area.low / (1 + area.low)
    variance = area.low * (1 - area.low) * (1 + (54.5 - 1) * q) / (58 * 51)
    assert 1.0 - area.low == pytest.approx(1.959964 * math.sqrt(variance), rel=1e-5)


def test_the_interval_of_the_area_covers():
    """Two normal distributions one apart: the true area is Phi(1/sqrt 2)."""
    truth = 0.5 * (1 + math.erf(0.5))
    rng = np.random.default_rng(11)
    held = 0
    for _ in range(400):
        result = auc(rng.normal(size=40), rng.normal(1.0, 1.0, 40), 0.9)
        held += result.low <= truth <= result.high
    assert 0.86 <= held / 400 <= 0.94


@settings(deadline=None)
@given(scores, scores)
def test_the_curve_rises_from_corner_to_corner_inside_its_band(a, b):
    curve = roc_curve(a, b)
    assert (curve.false_alarm[0], curve.detection[0]) == (0.0, 0.0)
    assert (curve.false_alarm[-1], curve.detection[-1]) == (1.0, 1.0)
    assert np.all(np.diff(curve.false_alarm) >= 0)
    assert np.all(np.diff(curve.detection) >= 0)
    assert np.all((curve.low <= curve.detection) & (curve.detection <= curve.high))
    thresholds = sorted({*a, *b}, reverse=True)
    assert curve.false_alarm[1:].tolist() == [np.mean(np.array(a) >= threshold) for threshold in thresholds]
    assert curve.detection[1:].tolist() == [np.mean(np.array(b) >= threshold) for threshold in thresholds]


def test_the_band_is_the_envelope_of_the_corners_rectangles():
    rng = np.random.default_rng(6)
    curve = roc_curve(rng.normal(size=80), rng.normal(1.5, 1, 60), 0.9)
    d, e = kolmogorov_margin(80, math.sqrt(0.9)), kolmogorov_margin(60, math.sqrt(0.9))
    for f, low, high in zip(curve.false_alarm, curve.low, curve.high, strict=True):
        near = curve.detection[np.abs(curve.false_alarm - f) <= d]
        assert (low, high) == pytest.approx((max(0.0, near.min() - e), min(1.0, near.max() + e)))


def test_the_band_holds_the_whole_curve():
    """Uniform scores against uniform scores squared upwards: the true curve is sqrt(false alarm)."""
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(200):
        curve = roc_curve(1 - rng.random(50), 1 - rng.random(60) ** 2, 0.9)
        truth = np.sqrt(curve.false_alarm)
        held += bool(np.all((curve.low <= truth) & (truth <= curve.high)))
    assert held >= 180
    assert kolmogorov_margin(100, 0.95) == pytest.approx(0.13581, abs=1e-5)
