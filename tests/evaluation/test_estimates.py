"""Quantiles, means and errors of estimates: published tables, hand counts and coverage."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.evaluation.estimates import estimate_errors, estimate_mean, estimate_quantile, order_ranks
from sealscope.evaluation.table import events_per_hour, poisson_interval

# Garwood, Biometrika 28 (1936) 437-442, as in Pearson and Hartley, Biometrika Tables for Statisticians, table 40: 95 %
GARWOOD = [
    (0, 0.0, 3.69),
    (1, 0.0253, 5.57),
    (2, 0.242, 7.22),
    (3, 0.619, 8.77),
    (5, 1.62, 11.67),
    (10, 4.80, 18.39),
    (20, 12.22, 30.89),
    (50, 37.11, 65.92),
]


@pytest.mark.parametrize(("count", "low", "high"), GARWOOD)
def test_garwood_s_table(count, low, high):
    assert poisson_interval(count) == pytest.approx((low, high), abs=6e-3)


@settings(deadline=None)
@given(st.integers(0, 300), st.floats(0.5, 0.999))
def test_the_limits_are_those_of_the_two_tails(count, confidence):
    low, high = poisson_interval(count, confidence)
    assert low <= count <= high
    tail = (1 - confidence) / 2
    log_terms = [i * math.log(high) - high - math.lgamma(i + 1) for i in range(count + 1)]
    assert math.fsum(map(math.exp, log_terms)) == pytest.approx(tail, rel=1e-6)
    if count:
        below = [i * math.log(low) - low - math.lgamma(i + 1) for i in range(count)]
        assert math.fsum(map(math.exp, below)) == pytest.approx(1 - tail, rel=1e-9)


def test_the_hourly_interval_covers():
    rng = np.random.default_rng(1)
    result = [events_per_hour(int(k), 20.0, 0.9) for k in rng.poisson(0.3 * 20.0, 400)]
    assert np.mean([one.low <= 0.3 <= one.high for one in result]) >= 0.88


# ranks of the 95 % interval of a median, as in Conover, Practical Nonparametric Statistics, 3rd ed. (1999), section 3.2
@pytest.mark.parametrize(("n", "r", "s"), [(5, 0, 6), (6, 1, 6), (10, 2, 9), (20, 6, 15), (30, 10, 21), (50, 18, 33)])
def test_the_ranks_around_a_median(n, r, s):
    assert order_ranks(n, 0.5) == (r, s)


@settings(deadline=None)
@given(st.integers(1, 80), st.floats(0.02, 0.98), st.floats(0.5, 0.99))
def test_the_ranks_hold_their_confidence_and_no_closer_ones_do(n, order, confidence):
    r, s = order_ranks(n, order, confidence)
    weights = [math.comb(n, i) * order**i * (1 - order) ** (n - i) for i in range(n + 1)]
    tail = (1 - confidence) / 2
    assert 0 <= r < s <= n + 1
    assert sum(weights[:r]) <= tail + 1e-12
    assert sum(weights[: r + 1]) >= tail - 1e-12
    assert sum(weights[s:]) <= tail + 1e-12
    assert sum(weights[s - 1 :]) >= tail - 1e-12


def test_quantiles_bear_values_that_were_never_reached():
    result = estimate_quantile([3.0, 1.0, math.inf, 2.0, math.inf], 0.5)
    assert result.value == 3.0
    assert estimate_quantile([3.0, 1.0, math.inf, 2.0, math.inf], 0.9).value == math.inf
    assert (result.low, result.high) == (-math.inf, math.inf)
    many = estimate_quantile(np.arange(1.0, 51.0), 0.5)
    assert (many.value, many.low, many.high) == (25.0, 18.0, 33.0)


@settings(deadline=None)
@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40), st.floats(0.05, 0.95))
def test_a_quantile_follows_its_values(values, order):
    result, turned = estimate_quantile(values, order), estimate_quantile([2 * v + 1 for v in values], order)
    assert turned.value == 2 * result.value + 1
    assert result.low <= result.value <= result.high
    assert np.mean(np.array(values) <= result.value) >= order - 1e-9


def test_the_quantile_s_interval_covers():
    rng = np.random.default_rng(2)
    result = [estimate_quantile(rng.exponential(size=40), 0.9, 0.9) for _ in range(400)]
    assert np.mean([one.low <= math.log(10) <= one.high for one in result]) >= 0.88


def test_student_s_sleep():
    """Student, Biometrika 6 (1908) 1-25: hours gained by ten patients, mean 1.58; 95 % interval 0.70 to 2.46."""
    result = estimate_mean([1.2, 2.4, 1.3, 1.3, 0.0, 1.0, 1.8, 0.8, 4.6, 1.4])
    assert (result.value, result.low, result.high) == pytest.approx((1.58, 0.70, 2.46), abs=5e-3)
    assert (estimate_mean([2.0]).low, estimate_mean([2.0]).high) == (-math.inf, math.inf)


def without_intervals(n):
    """Ends of the intervals of n estimates that state none."""
    return [math.nan] * n, [math.nan] * n


def test_errors_of_an_estimate_by_hand():
    result = estimate_errors(
        [1.0, 2.0, math.nan, 5.0], [1.0, 1.0, 1.0, 4.0], [0.5, 1.5, math.nan, 3.0], [1.5, 2.5, math.nan, 6.0]
    )
    assert result.without == 1
    assert result.bias.value == pytest.approx(2 / 3)
    assert result.rmse == pytest.approx(math.sqrt(2 / 3))
    assert (result.coverage.count, result.coverage.n) == (2, 3)
    assert estimate_errors([1.0, 2.0], [1.0, 2.5], *without_intervals(2)).coverage.n == 0


@settings(deadline=None)
@given(st.lists(st.floats(-50, 50), min_size=2, max_size=30), st.floats(-5, 5))
def test_a_constant_error_is_bias(errors, shift):
    truth = np.arange(len(errors), dtype=float)
    result = estimate_errors(truth + errors, truth, *without_intervals(truth.size))
    moved = estimate_errors(truth + errors + shift, truth, *without_intervals(truth.size))
    assert moved.bias.value == pytest.approx(result.bias.value + shift, abs=1e-9)
    assert result.rmse >= abs(result.bias.value) - 1e-9


def test_errors_of_an_onset():
    result = estimate_errors([92.0, math.nan, 85.0, 90.0], [90.0] * 4, [88, math.nan, 80, 91], [95, math.nan, 89, 93])
    assert (result.n, result.without) == (3, 1)
    assert result.median.value == 0.0
    assert (result.median_size.value, result.ninety_size.value) == (2.0, 5.0)
    assert (result.coverage.count, result.coverage.n) == (1, 3)
