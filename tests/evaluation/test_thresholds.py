"""Thresholds from leak-free scores: Wilks's numbers and the exact distribution of the true false-alarm probability."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sealscope.evaluation.thresholds import quantile_threshold, records_needed

distinct = st.lists(st.integers(-10_000, 10_000), min_size=25, max_size=120, unique=True)


@pytest.mark.parametrize(
    ("false_alarm", "confidence", "n"),
    [
        (0.05, 0.95, 59),
        (0.01, 0.95, 299),
        (0.10, 0.90, 22),
        (0.01, 0.99, 459),
        (0.01, 0.50, 69),
        (0.01, None, 99),
        (0.05, None, 19),
        (0.3, None, 3),
    ],
)
def test_wilks_s_numbers(false_alarm, confidence, n):
    """Wilks, Ann. Math. Stat. 12 (1941) 91-96; the one-sided number 59 for 95/95 is that of reactor safety (Guba, Makai
    and Pal, Reliab. Eng. Syst. Saf. 80 (2003) 217-232)."""
    promise = "average" if confidence is None else "bound"
    assert records_needed(false_alarm, confidence or 0.95, promise) == n
    assert quantile_threshold(range(n), false_alarm, confidence or 0.95, promise).rank == 1


@settings(deadline=None)
@given(st.floats(1e-4, 0.6), st.floats(0.01, 0.999))
def test_the_fewest_records_are_those_of_the_beta_distribution(false_alarm, confidence):
    n = records_needed(false_alarm, confidence, "bound")
    assert stats.beta.cdf(false_alarm, 1, n) >= confidence * (1 - 1e-9)
    assert n == 1 or stats.beta.cdf(false_alarm, 1, n - 1) < confidence * (1 + 1e-9)


def at_most(threshold, false_alarm):
    """Probability that the true false-alarm probability is at most this."""
    return stats.beta.cdf(false_alarm, threshold.rank, threshold.n + 1 - threshold.rank)


def test_the_rank_by_hand():
    scores = np.random.default_rng(1).permutation(np.arange(1.0, 200.0))
    result = quantile_threshold(scores, 0.05)
    assert (result.value, result.rank, result.n) == (190.0, 10, 199)
    assert result.expected == pytest.approx(0.05)
    assert np.count_nonzero(scores > result.value) == 9
    sure = quantile_threshold(scores, 0.05, promise="bound")
    assert sure.rank == 5
    assert at_most(sure, 0.05) >= 0.95 > at_most(result, 0.05)


def test_the_true_probability_is_beta_distributed():
    """Uniform scores have the true rate 1 - threshold: moments of Beta(k, n + 1 - k), and its interval covers."""
    rng = np.random.default_rng(7)
    result = [quantile_threshold(rng.random(99), 0.05, 0.9) for _ in range(2000)]
    true = np.array([1.0 - one.value for one in result])
    k, n = result[0].rank, 99
    assert (k, result[0].expected) == (5, 0.05)
    assert true.mean() == pytest.approx(0.05, abs=0.002)
    assert true.var() == pytest.approx(k * (n + 1 - k) / ((n + 1) ** 2 * (n + 2)), rel=0.1)
    assert np.mean((result[0].low <= true) & (true <= result[0].high)) == pytest.approx(0.9, abs=0.02)
    assert np.mean(true <= 0.05) == pytest.approx(at_most(result[0], 0.05), abs=0.03)


def test_the_bound_is_held_as_often_as_promised():
    rng = np.random.default_rng(3)
    true = np.array([1.0 - quantile_threshold(rng.random(150), 0.05, 0.9, "bound").value for _ in range(1500)])
    assert 0.885 <= np.mean(true <= 0.05) <= 0.96


@settings(deadline=None)
@given(distinct, st.floats(0.05, 0.5), st.integers(1, 9), st.integers(-100, 100))
def test_a_threshold_moves_with_its_scores_and_falls_with_the_probability(scores, false_alarm, scale, shift):
    result = quantile_threshold(scores, false_alarm)
    assert result.value in scores
    moved = quantile_threshold([scale * s + shift for s in scores], false_alarm)
    assert moved.value == scale * result.value + shift
    assert result.low < result.expected < result.high
    assert result.expected <= false_alarm + 1e-12
    assert quantile_threshold(scores, min(0.9, 1.5 * false_alarm)).value <= result.value
    assert quantile_threshold(scores[::-1], false_alarm) == result


def test_ties_never_raise_the_probability():
    result = quantile_threshold([0.0] * 50 + [1.0] * 50, 0.1)
    assert result.value == 1.0
    assert math.isclose(result.expected, 10 / 101)
