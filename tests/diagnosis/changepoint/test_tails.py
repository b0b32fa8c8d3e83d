"""Tails of the largest statistic: rare draws against exact tails, the tables against fresh draws, seeds of records."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from sealscope.diagnosis.changepoint.random_walk import WalkScan
from sealscope.diagnosis.changepoint.smooth_drift import STRENGTHS, DriftFamily, find_step
from sealscope.diagnosis.changepoint.tails import (
    largest_normal,
    null_threshold,
    rare_draws,
    seed_of,
    weighted_quantile,
)

#: Probabilities between those that a detector may be asked for.
PROBABILITIES = (0.2, 0.01, 1e-3, 1e-4, 1e-6)


@pytest.mark.parametrize("probability", PROBABILITIES)
def test_largest_of_independent_normals(probability: float) -> None:
    """P(largest of 30 > c) = 1 - Phi(c)^30: right within 4 % (one deviation), and centred, at any probability."""
    thresholds = np.array([largest_normal(np.eye(30), probability, seed)[0] for seed in range(40)])
    obtained = -np.expm1(30.0 * np.log1p(-ndtr(-thresholds))) / probability
    assert obtained.mean() == pytest.approx(1.0, abs=0.03)
    assert obtained.std() < 0.06


@pytest.mark.parametrize("probability", PROBABILITIES)
def test_largest_of_one_normal_repeated(probability: float) -> None:
    """Wholly correlated: the tail of a single normal."""
    threshold = largest_normal(np.ones((30, 30)), probability, 3)[0]
    assert ndtr(-threshold) == pytest.approx(probability, rel=0.15)


def test_thresholds_of_two_records_do_not_share_one_error() -> None:
    """Errors of 40 records scatter about zero: their mean is smaller than one of them by the root of their number."""
    random = np.random.default_rng(1)
    seeds = [seed_of(random.standard_normal(50)) for _ in range(40)]
    errors = np.array([largest_normal(np.eye(30), 0.01, seed)[0] for seed in seeds]) - 3.4029  # Phi(3.4029)^30 = 0.99
    assert len(set(errors)) == 40
    assert abs(errors.mean()) < 4.0 * errors.std() / np.sqrt(40.0)
    assert largest_normal(np.eye(30), 0.01, seeds[0]) == largest_normal(np.eye(30), 0.01, seeds[0])


def test_weights_make_rare_draws_normal() -> None:
    directions = np.linalg.qr(np.random.default_rng(0).standard_normal((6, 6)))[0][:3]
    z, weights = rare_draws(directions, np.array([0.1, 1e-3]), 40_000, 5)
    assert weights.mean() == pytest.approx(1.0, abs=0.02)
    assert (z * weights).mean(axis=1) == pytest.approx(np.zeros(6), abs=0.05)
    assert (z**2 * weights).mean(axis=1) == pytest.approx(np.ones(6), abs=0.05)
    rare = np.mean(weights * (directions[0] @ z > 4.0))
    assert rare == pytest.approx(ndtr(-4.0), rel=0.06)


def test_weighted_quantile_of_equal_weights_is_the_order_statistic() -> None:
    values = np.random.default_rng(0).permutation(1000.0 * np.arange(1.0, 101.0))
    assert weighted_quantile(values, np.ones(100), 0.05) == 96_000.0


def drift_null(
    n: int, number: int, draws: int, seed: int, table: str = "smooth_drift"
) -> tuple[np.ndarray, np.ndarray]:
    length = 2.0 if table == "overlapping_drift" else 1.0
    quiet = table != "smooth_drift"
    family = DriftFamily(np.arange(n, dtype=float), np.ones(n), np.zeros((n, 1)), quiet=quiet, length=length)
    assert family.table == table
    drift = family.drifts[number]
    z, weights = rare_draws(drift.steps @ drift.root, 0.3 * 0.1 ** np.arange(8.0), draws, seed)
    return family.scores(drift.root @ z, 1)[0].max(axis=0), weights


def obtained(threshold: float, values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Share over the threshold and its standard deviation."""
    over = weights * (values > threshold)
    return float(over.mean()), float(over.std() / np.sqrt(over.size))


@pytest.mark.parametrize(("n", "number"), [(16, 0), (20, 12), (37, 5), (57, 0), (57, 20)])
def test_drift_table_against_fresh_draws(n: int, number: int) -> None:
    """At the blocks of the table and between them: within 15 % and three deviations of the fresh draws."""
    values, weights = drift_null(n, number, 6000, 11)
    for probability in (0.1, 0.01, 1e-3, 1e-4):
        share, deviation = obtained(null_threshold("smooth_drift", probability, n, number), values, weights)
        assert abs(share - probability) < 0.15 * probability + 3.0 * deviation


@pytest.mark.parametrize("table", ["quiet_drift", "overlapping_drift"])
@pytest.mark.parametrize(("n", "number"), [(20, 28), (30, 35), (39, 37), (57, 33)])
def test_tables_of_quiet_series_against_fresh_draws(table: str, n: int, number: int) -> None:
    """Strong and smooth drifts, at the blocks of the table and between them: within 20 % and three deviations."""
    values, weights = drift_null(n, number, 6000, 12, table)
    for probability in (0.1, 0.01, 1e-3):
        share, deviation = obtained(null_threshold(table, probability, n, number), values, weights)
        assert abs(share - probability) < 0.2 * probability + 3.0 * deviation


def test_beyond_the_table_a_threshold_is_exceeded_more_rarely_than_stated() -> None:
    """Of one table's line, as far as weighted draws reach; nor is it twice as far out as they say."""
    family = DriftFamily(np.arange(20.0), np.ones(20), np.zeros((20, 1)))
    drift = family.drifts[12]
    z, weights = rare_draws(drift.steps @ drift.root, 0.3 * 0.1 ** np.arange(11.0), 20_000, 3)
    values = family.scores(drift.root @ z, 1)[0].max(axis=0)
    for probability in (1e-8, 1e-9):
        threshold = null_threshold("smooth_drift", probability, 20, 12)
        share, deviation = obtained(threshold, values, weights)
        assert share < probability + 3.0 * deviation
        assert weighted_quantile(values, weights, probability) > 0.6 * threshold


@pytest.mark.parametrize(("n", "number", "expected"), [(16, 0, 3.0), (30, 4, 0.03), (50, 8, 0.05), (50, 3, 4.0)])
def test_walk_table_against_fresh_draws(n: int, number: int, expected: float) -> None:
    scan = WalkScan(np.ones(n), expected)
    y = scan.walks[number].root @ np.random.default_rng(12).standard_normal((n, 20_000))
    t = scan.scores(y)[0].max(axis=0)
    for probability in (0.1, 0.01, 1e-3):
        share = float(np.mean(t > null_threshold("random_walk", probability, n, number, expected)))
        assert abs(share - probability) < 0.1 * probability + 3.0 * np.sqrt(probability / t.size)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "number", "expected"), [(16, 2, 3.0), (30, 4, 0.03)])
def test_walk_table_at_one_in_ten_thousand(n: int, number: int, expected: float) -> None:
    scan, random = WalkScan(np.ones(n), expected), np.random.default_rng(13)
    threshold = null_threshold("random_walk", 1e-4, n, number, expected)
    over = sum(
        np.count_nonzero(
            scan.scores(scan.walks[number].root @ random.standard_normal((n, 5000)))[0].max(axis=0) > threshold
        )
        for _ in range(120)
    )
    assert 60 - 3 * 8 - 18 < over < 60 + 3 * 8 + 18  # 60 of 600 000, three deviations and 30 % of the table


def test_tables_have_every_strength_and_rise_with_rarity() -> None:
    for number in range(len(STRENGTHS)):
        thresholds = [null_threshold("smooth_drift", p, 60, number) for p in (0.2, 0.05, 0.01, 1e-3, 1e-4, 1e-5, 1e-7)]
        assert thresholds == sorted(thresholds)
    for number in range(14):
        thresholds = [null_threshold("random_walk", p, 50, number, 0.05) for p in (0.2, 0.05, 0.01, 1e-3, 1e-4, 5e-5)]
        assert thresholds == sorted(thresholds)


def test_the_threshold_does_not_depend_on_noise_but_on_its_kind() -> None:
    """Series of one kind share the table's threshold; it is no random number of the record."""
    t = np.arange(40.0)
    draws = [np.random.default_rng(k).standard_normal(40) for k in range(12)]
    found = {find_step(t, g, np.ones(40), 0.01).threshold for g in draws}
    assert found <= {null_threshold("smooth_drift", 0.01, 40, number) for number in range(len(STRENGTHS))}
