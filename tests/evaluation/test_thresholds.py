"""Thresholds from leak-free scores: Wilks's numbers, the exact distribution of the true rate, and groups."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.errors import InputError
from sealscope.evaluation.thresholds import conformal_p, group_thresholds, quantile_threshold, records_needed

distinct = st.lists(st.integers(-10_000, 10_000), min_size=25, max_size=120, unique=True)


@pytest.mark.parametrize(
    ("rate", "confidence", "rank", "n"),
    [
        (0.05, 0.95, 1, 59),
        (0.05, 0.95, 2, 93),
        (0.05, 0.95, 3, 124),
        (0.01, 0.95, 1, 299),
        (0.01, 0.95, 2, 473),
        (0.10, 0.90, 1, 22),
        (0.01, 0.99, 1, 459),
        (0.01, None, 1, 99),
        (0.05, None, 1, 19),
        (0.3, None, 1, 3),
    ],
)
def test_wilks_s_numbers(rate, confidence, rank, n):
    """Wilks, Ann. Math. Stat. 12 (1941) 91-96; the one-sided numbers 59, 93, 124 for 95/95 are those of reactor safety
    (Guba, Makai and Pal, Reliab. Eng. Syst. Saf. 80 (2003) 217-232)."""
    assert records_needed(rate, confidence, rank) == n


def test_the_rank_by_hand():
    scores = np.random.default_rng(1).permutation(np.arange(1.0, 200.0))
    found = quantile_threshold(scores, 0.05)
    assert (found.value, found.rank, found.n) == (190.0, 10, 199)
    assert found.expected == pytest.approx(0.05)
    assert np.count_nonzero(scores > found.value) == 9
    sure = quantile_threshold(scores, 0.05, promise="bound")
    assert sure.rank == 5
    assert sure.probability_at_most(0.05) >= 0.95 > found.probability_at_most(0.05)


def test_the_true_rate_is_beta_distributed():
    """Uniform scores have the true rate 1 - threshold: moments of Beta(k, n + 1 - k), and its interval covers."""
    rng = np.random.default_rng(7)
    found = [quantile_threshold(rng.random(99), 0.05, 0.9) for _ in range(2000)]
    true = np.array([1.0 - one.value for one in found])
    k, n = found[0].rank, 99
    assert (k, found[0].expected) == (5, 0.05)
    assert true.mean() == pytest.approx(0.05, abs=0.002)
    assert true.var() == pytest.approx(k * (n + 1 - k) / ((n + 1) ** 2 * (n + 2)), rel=0.1)
    assert np.mean((found[0].low <= true) & (true <= found[0].high)) == pytest.approx(0.9, abs=0.02)
    assert np.mean(true <= 0.05) == pytest.approx(found[0].probability_at_most(0.05), abs=0.03)


def test_the_bound_is_held_as_often_as_promised():
    rng = np.random.default_rng(3)
    true = np.array([1.0 - quantile_threshold(rng.random(150), 0.05, 0.9, "bound").value for _ in range(1500)])
    assert 0.885 <= np.mean(true <= 0.05) <= 0.96


@settings(deadline=None)
@given(distinct, st.floats(0.05, 0.5), st.integers(1, 9), st.integers(-100, 100))
def test_a_threshold_moves_with_its_scores_and_falls_with_the_rate(scores, rate, scale, shift):
    found = quantile_threshold(scores, rate)
    assert found.value in scores
    moved = quantile_threshold([scale * s + shift for s in scores], rate)
    assert moved.value == scale * found.value + shift
    assert found.low < found.expected < found.high
    assert found.expected <= rate + 1e-12
    assert quantile_threshold(scores, min(0.9, 1.5 * rate)).value <= found.value
    assert quantile_threshold(scores[::-1], rate) == found


@settings(deadline=None)
@given(distinct, st.floats(0.05, 0.5), st.integers(-11_000, 11_000))
def test_the_p_value_and_the_threshold_say_the_same(scores, rate, new):
    alarm = new > quantile_threshold(scores, rate).value
    assert (conformal_p(scores, [new])[0] <= rate * (1 + 1e-9)) == alarm


def test_p_values_by_hand():
    assert conformal_p([1, 2, 2, 3], [0, 2, 3, 4]) == pytest.approx([1.0, 0.8, 0.4, 0.2])


def test_each_group_has_its_own_threshold_and_small_ones_none():
    rng = np.random.default_rng(2)
    scores = np.r_[rng.normal(0, 1, 120), rng.normal(10, 1, 60), rng.normal(5, 1, 4)]
    groups = ["3 V"] * 120 + ["7 V"] * 60 + ["8 V"] * 4
    found = group_thresholds(scores, groups, 0.05)
    assert set(found.thresholds) == {"3 V", "7 V"}
    assert found.too_few == {"8 V": 4}
    assert found.needed == 19
    assert found.thresholds["3 V"] == quantile_threshold(scores[:120], 0.05)
    assert found.thresholds["7 V"].value > 10.0
    assert found.expected == pytest.approx((120 * 6 / 121 + 60 * 3 / 61) / 180)


def test_ties_never_raise_the_rate():
    found = quantile_threshold([0.0] * 50 + [1.0] * 50, 0.1)
    assert found.value == 1.0
    assert math.isclose(found.expected, 10 / 101)


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (
            lambda: quantile_threshold(range(50), 0.01),
            "leak-free records must be at least 99 for a false-alarm rate of 0.01, got 50",
        ),
        (
            lambda: quantile_threshold(range(298), 0.01, promise="bound"),
            "leak-free records must be at least 299 for a false-alarm rate of 0.01, got 298",
        ),
        (lambda: quantile_threshold(range(50), 1.5), "the false-alarm rate must be between 0 and 1, got 1.5"),
        (lambda: quantile_threshold([1.0, math.inf], 0.5), "leak-free scores must be finite, got inf (number 2 of 2)"),
        (
            lambda: quantile_threshold(range(50), 0.1, promise="hope"),
            "the promise must be 'average' or 'bound', got 'hope'",
        ),
        (lambda: group_thresholds([1.0, 2.0], ["a"], 0.5), "groups must be as many as the scores, got 1 for 2"),
        (
            lambda: group_thresholds(range(4), ["a", "a", "a", "b"], 0.05),
            "leak-free records must be at least 19 in a group for 0.05, got at most 3",
        ),
        (lambda: records_needed(0.0), "the false-alarm rate must be between 0 and 1, got 0.0"),
        (lambda: records_needed(0.1, rank=0), "the rank must be >= 1, got 0"),
    ],
)
def test_too_few_records_and_impossible_rates(call, line):
    with pytest.raises(InputError) as error:
        call()
    assert str(error.value) == line
