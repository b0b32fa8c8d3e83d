"""Counts: published tables, exact coverage, and the properties that any interval of a proportion has."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sealscope.evaluation.binomial import (
    clopper_pearson,
    holm,
    lower_bound,
    proportion,
    sign_test,
    upper_tail,
)

# Newcombe, Statistics in Medicine 17 (1998) 857-872, table I: k, n, exact (Clopper-Pearson), 95 %
NEWCOMBE = [
    (81, 263, (0.2527, 0.3676)),
    (15, 148, (0.0578, 0.1617)),
    (0, 20, (0.0000, 0.1684)),
    (1, 29, (0.0009, 0.1776)),
]

counts = st.integers(1, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


def pmf(n: int, p: float) -> list[float]:
    return [math.comb(n, i) * p**i * (1 - p) ** (n - i) for i in range(n + 1)]


@pytest.mark.parametrize(("k", "n", "exact"), NEWCOMBE)
def test_newcombe_s_table(k, n, exact):
    assert clopper_pearson(k, n) == pytest.approx(exact, abs=5e-5)


@settings(deadline=None)
@given(counts, st.floats(0.5, 0.999))
def test_an_interval_is_a_mirror_holds_the_proportion_and_grows_with_confidence(kn, confidence):
    k, n = kn
    low, high = clopper_pearson(k, n, confidence)
    mirrored = clopper_pearson(n - k, n, confidence)
    assert 0.0 <= low <= k / n <= high <= 1.0
    assert (1 - mirrored[1], 1 - mirrored[0]) == pytest.approx((low, high), abs=1e-9)
    wider = clopper_pearson(k, n, (1 + confidence) / 2)
    assert wider[0] <= low
    assert high <= wider[1]
    if k < n:
        more = clopper_pearson(k + 1, n, confidence)
        assert more[0] >= low
        assert more[1] >= high


@pytest.mark.parametrize("n", [7, 20])
def test_coverage_by_counting_every_outcome(n):
    """Exact: no simulation. Clopper-Pearson never covers less than stated."""
    limits = [clopper_pearson(k, n, 0.9) for k in range(n + 1)]
    for p in np.linspace(0.01, 0.99, 99):
        assert sum(w for w, (low, high) in zip(pmf(n, p), limits, strict=True) if low <= p <= high) >= 0.9


def test_twenty_nine_of_twenty_nine_show_ninety_at_ninety_five():
    """The rule of MIL-HDBK-1823A: 29 hits of 29 are the fewest; 28 of 28 are not enough."""
    assert lower_bound(29, 29) == pytest.approx(0.05 ** (1 / 29))
    assert lower_bound(29, 29) >= 0.9 > lower_bound(28, 28)
    assert lower_bound(45, 46) >= 0.9 > lower_bound(44, 45)
    assert lower_bound(0, 5) == 0.0


@settings(deadline=None)
@given(counts, st.floats(0.01, 0.99))
def test_a_tail_is_a_sum(kn, p):
    k, n = kn[0] % 31, min(kn[1], 30)
    k = min(k, n)
    assert upper_tail(k, n, p) == pytest.approx(sum(pmf(n, p)[k:]), rel=1e-9)


@settings(deadline=None)
@given(counts)
def test_the_sign_test_is_the_two_sided_test_of_one_half(kn):
    k, n = kn
    assert sign_test(k, n) == sign_test(n - k, n)
    assert sign_test(k, n) == pytest.approx(stats.binomtest(k, n, 0.5).pvalue, rel=1e-6)


def test_holm_on_published_p_values():
    """Fifteen p-values of Neuhaus et al. (1992) as in Benjamini and Hochberg, J. R. Stat. Soc. B 57 (1995), section
    3.2: three are rejected at 5 %."""
    p = [
        0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344, 0.0459, 0.3240, 0.4262, 0.5719, 0.6528, 0.7590,
        1.0000,
    ]  # fmt: skip
    corrected = holm(p)
    assert corrected[:4] == pytest.approx((0.0015, 0.0056, 0.0247, 0.1140))
    assert sum(value <= 0.05 for value in corrected) == 3
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx((0.03, 0.06, 0.06, 0.02))
    assert holm([]) == ()


@settings(deadline=None)
@given(st.lists(st.floats(0, 1), min_size=1, max_size=12), st.randoms())
def test_holm_keeps_the_order_and_lies_between_the_raw_and_bonferroni_s(p, random):
    corrected = holm(p)
    assert all(min(1.0, raw) <= c <= min(1.0, len(p) * raw) + 1e-15 for raw, c in zip(p, corrected, strict=True))
    assert np.all(np.diff(np.array(corrected)[np.argsort(p, kind="stable")]) >= 0)
    order = list(range(len(p)))
    random.shuffle(order)
    assert sorted(holm([p[i] for i in order])) == sorted(corrected)


def test_nothing_counted_is_nothing_known():
    unknown = proportion(0, 0)
    assert math.isnan(unknown.value)
    assert (unknown.low, unknown.high) == (0.0, 1.0)
    assert proportion(1, 4).value == 0.25
