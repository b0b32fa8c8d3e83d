"""Probability of detection: published fits, closed forms, an independent maximum, and bounds that cover."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.evaluation.pod import detection_by_size, fit_hit_miss, proven_size

# Dalal, Fowlkes, Hoadley, JASA 84 (1989) 945-957: launch temperature [F], O-ring distress, before the Challenger's last
CHALLENGER_F = np.array([53, 57, 58, 63, 66, 67, 67, 67, 68, 69, 70, 70, 70, 70, 72, 73, 75, 75, 76, 76, 78, 79, 81.0])
CHALLENGER_SIZES = np.exp(CHALLENGER_F)  # the curve is over the logarithm
CHALLENGER_DISTRESS = np.array([1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0])


SIZES = np.array([0.0005, 0.001, 0.0042, 0.0075, 0.015])


def drawn(seed: int, n: int = 60, a50: float = 0.003, slope: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    size = np.repeat(SIZES, n)
    return size, rng.random(size.size) < 1 / (1 + (size / a50) ** -slope)


def test_the_challenger_s_o_rings():
    """No distress is the hit, temperature the size. Estimates as printed with the data in many texts: -15.0429
    (7.3786)
    and 0.2322 (0.1082), deviances 28.267 and 20.315; at the last flight's 31 F distress is all but certain."""
    fit = fit_hit_miss(CHALLENGER_SIZES, 1 - CHALLENGER_DISTRESS)
    assert (fit.intercept, fit.slope) == pytest.approx((-15.0429, 0.2322), abs=5e-5)
    assert np.sqrt(np.diag(fit.covariance)) == pytest.approx((7.3786, 0.1082), abs=5e-5)
    assert (-2 * fit.null, -2 * fit.log_likelihood) == pytest.approx((28.267, 20.315), abs=5e-4)
    assert fit.estimator == "maximum likelihood"
    assert math.log(fit.a50) == pytest.approx(15.0429 / 0.232163, abs=1e-3)
    assert math.log(fit.a90) == pytest.approx((15.0429 + math.log(9)) / 0.232163, abs=1e-3)
    assert 1 - fit.detection(math.exp(31.0)) == pytest.approx(0.9996, abs=5e-5)


def test_without_a_rise_there_is_no_bound():
    size, hit = np.repeat([1.0, 2.0, 3.0], 4), np.array([0, 1, 1, 0] * 3)
    hit[0] = 1
    assert fit_hit_miss(size, hit).a90_95 == math.inf
    weak = fit_hit_miss(size, 1 - hit)
    assert weak.slope > 0
    assert weak.a90_95 == math.inf


def log_likelihood(fit, intercept, slope) -> np.ndarray:
    x = np.log(fit.size)
    eta = np.add.outer(intercept, 0 * x) + np.multiply.outer(slope, x)
    return np.sum(fit.hits * eta - fit.tested * np.logaddexp(0, eta), axis=-1)


def test_the_likelihood_ratio_bound_against_a_search_of_the_whole_plane():
    """Among all slopes on a grid, no line through log odds 9 : 1 at a90/95 is likelier than allowed, one just is."""
    fit = fit_hit_miss(CHALLENGER_SIZES, 1 - CHALLENGER_DISTRESS)
    slopes = np.linspace(0.001, 1.0, 20001)
    for confidence, z in ((0.95, 1.6448536), (0.90, 1.2815516)):
        bound = fit.size_bound(0.9, confidence)
        best = log_likelihood(fit, math.log(9) - slopes * math.log(bound), slopes).max()
        assert fit.log_likelihood - best == pytest.approx(z * z / 2, abs=1e-6)
    assert fit.size_bound(0.9, 0.5) == pytest.approx(fit.a90)


def test_the_bound_is_that_of_the_band_on_many_records():
    fit = fit_hit_miss(*drawn(2, n=2000))
    assert fit.a90 == pytest.approx(0.009, rel=0.05)
    assert fit.a90 < fit.a90_95 < 1.1 * fit.a90
    low, _ = fit.detection_band(fit.a90_95, 0.90)
    assert low == pytest.approx(0.9, abs=1e-3)


@pytest.mark.slow
def test_the_bound_covers():
    """a90 of the truth is 0.003 * 3 = 0.009; 95 % bounds lie above it in about 95 % of the campaigns."""
    above = sum(fit_hit_miss(*drawn(seed, n=25)).a90_95 >= 0.009 for seed in range(200))
    assert 0.90 <= above / 200 <= 0.99


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6), st.floats(1e-3, 1e3))
def test_another_unit_of_size_changes_nothing_else(seed, unit):
    size, hit = drawn(seed, n=10)
    fit, other = fit_hit_miss(size, hit), fit_hit_miss(size * unit, hit)
    assert other.a90 == pytest.approx(fit.a90 * unit, rel=1e-6)
    assert other.a90_95 == pytest.approx(fit.a90_95 * unit, rel=1e-5)
    assert other.slope == pytest.approx(fit.slope, rel=1e-6)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6))
def test_sizes_rise_with_probability_and_confidence(seed):
    fit = fit_hit_miss(*drawn(seed, n=12))
    assert fit.a50 < fit.a90
    assert fit.a90 <= fit.size_bound(0.9, 0.8) <= fit.a90_95 <= fit.size_bound(0.95)
    assert np.all(np.diff(fit.detection(SIZES)) > 0)
    assert fit.detection(fit.a90) == pytest.approx(0.9)


def test_firth_s_fit_is_half_a_count_more_in_a_table_of_two_sizes():
    """With two sizes the model is saturated, and Firth's estimate adds 1/2 to each cell (Heinze and Schemper 2002)."""
    fit = fit_hit_miss(np.repeat([1.0, 10.0], 20), np.r_[np.zeros(20), np.ones(17), np.zeros(3)])
    assert fit.estimator == "firth"
    assert fit.detection(np.array([1.0, 10.0])) == pytest.approx((0.5 / 21, 17.5 / 21), abs=1e-8)


def test_hits_and_misses_apart_still_give_a_curve_and_a_wide_bound():
    few = fit_hit_miss([1, 2, 3, 4, 5, 6, 7, 8], [0, 0, 0, 0, 1, 1, 1, 1])
    many = fit_hit_miss(np.repeat([1.0, 2, 3, 4, 5, 6, 7, 8], 40), np.repeat([0, 0, 0, 0, 1, 1, 1, 1], 40))
    for fit in (few, many):
        assert fit.estimator == "firth"
        assert 4.0 < fit.a50 < 5.0
        assert fit.a90 < fit.a90_95
    assert many.a90_95 < 5.2 < few.a90_95


def penalised(fit, intercept, slope) -> float:
    x = np.log(fit.size)
    eta = intercept + slope * x
    p = 1 / (1 + np.exp(-eta))
    design = np.column_stack([np.ones_like(x), x])
    information = design.T @ (design * (fit.tested * p * (1 - p))[:, None])
    return float(log_likelihood(fit, intercept, slope)) + 0.5 * np.linalg.slogdet(information)[1]


def test_firth_s_fit_and_bound_are_those_of_the_penalised_likelihood():
    fit = fit_hit_miss(np.repeat([1.0, 2, 3, 4, 5, 6, 7, 8], 3), np.repeat([0, 0, 1, 1, 1, 1, 1, 1], 3))
    best = penalised(fit, fit.intercept, fit.slope)
    assert fit.log_likelihood == pytest.approx(best)
    for d_intercept, d_slope in ((1e-3, 0.0), (-1e-3, 0.0), (0.0, 1e-3), (0.0, -1e-3)):
        assert penalised(fit, fit.intercept + d_intercept, fit.slope + d_slope) < best
    without_slope = max(penalised(fit, intercept, 0.0) for intercept in np.linspace(-3, 3, 6001))
    assert fit.null == pytest.approx(without_slope, abs=1e-6)
    # curves through 90 % at a90/95 are less likely by half the square of the normal quantile of 95 %
    log_size, log_odds = math.log(fit.a90_95), math.log(9)
    at_bound = max(penalised(fit, log_odds - slope * log_size, slope) for slope in np.linspace(0.05, 30, 6001))
    assert best - at_bound == pytest.approx(1.6448536**2 / 2, abs=1e-5)


def test_detection_that_does_not_rise_has_no_size():
    falling = fit_hit_miss(np.repeat(SIZES, 10), np.tile([1, 0, 0, 0, 0, 0, 0, 0, 0, 0], 5)[::-1])
    assert falling.a90_95 == math.inf
    turned = fit_hit_miss(CHALLENGER_SIZES, CHALLENGER_DISTRESS)
    assert turned.slope == pytest.approx(-0.2322, abs=5e-5)
    assert (turned.a50, turned.a90_95) == (math.inf, math.inf)


def test_detection_by_size_and_what_it_proves():
    size = np.repeat([1.0, 2.0, 3.0, 4.0], [29, 29, 29, 10])
    hit = np.ones(size.size)
    hit[:20] = 0
    hit[40] = 0
    rows = detection_by_size(size, hit)
    assert [(row.size, row.proportion.count, row.proportion.n) for row in rows] == [
        (1.0, 9, 29),
        (2.0, 28, 29),
        (3.0, 29, 29),
        (4.0, 10, 10),
    ]
    assert proven_size(rows) == math.inf  # ten of ten prove nothing, so nothing above 3.0 is proven
    assert proven_size(rows[:3]) == 3.0
    assert proven_size(rows, 0.7) == 2.0
