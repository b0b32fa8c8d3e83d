"""Tails of the largest statistic: rare draws against exact tails, the tables against fresh draws, seeds of records."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from sealscope.diagnosis.changepoint.tails import (
    largest_normal,
    rare_draws,
    seed_of,
    weighted_quantile,
)

#: Probabilities between those that a detector may be asked for.
PROBABILITIES = (0.2, 0.01, 1e-3, 1e-4, 1e-6)


@pytest.mark.parametrize("probability", PROBABILITIES)
def test_largest_of_independent_normals(probability: float) -> None:
    """P(largest of 30 > c) = 1 - Phi(c)^30: right within 4 % (one deviation), and centred, at any probability."""
    thresholds = np.array([largest_normal(np.eye(30), probability, seed) for seed in range(40)])
    obtained = -np.expm1(30.0 * np.log1p(-ndtr(-thresholds))) / probability
    assert obtained.mean() == pytest.approx(1.0, abs=0.03)
    assert obtained.std() < 0.06


@pytest.mark.parametrize("probability", PROBABILITIES)
def test_largest_of_one_normal_repeated(probability: float) -> None:
    """Wholly correlated: the tail of a single normal."""
    threshold = largest_normal(np.ones((30, 30)), probability, 3)
    assert ndtr(-threshold) == pytest.approx(probability, rel=0.15)


def test_thresholds_of_two_records_do_not_share_one_error() -> None:
    """Errors of 40 records scatter about zero: their mean is smaller than one of them by the root of their number."""
    random = np.random.default_rng(1)
    seeds = [seed_of(random.standard_normal(50)) for _ in range(40)]
    errors = np.array([largest_normal(np.eye(30), 0.01, seed) for seed in seeds]) - 3.4029  # Phi(3.4029)^30 = 0.99
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
