"""The Gaussian of a linear model: against dense least squares, marginals of covariances, the density of the data."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sealscope.diagnosis.estimate.linear import Gaussian, solve

SEEDS = range(5)


def regression(seed: int, n_rows: int = 40, n: int = 6) -> tuple[np.ndarray, np.ndarray, Gaussian]:
    """Columns of very different sizes, a left side, and their likelihood."""
    random = np.random.default_rng(seed)
    columns = random.standard_normal((n_rows, n)) * 10.0 ** random.uniform(-8.0, 4.0, n)
    left = columns @ (random.standard_normal(n) / np.abs(columns).mean(axis=0)) + random.standard_normal(n_rows)
    rows = np.column_stack([columns, left])
    return columns, left, Gaussian.from_gram(rows.T @ rows)


@pytest.mark.parametrize("seed", SEEDS)
def test_mean_and_residual_are_those_of_least_squares(seed):
    columns, left, likelihood = regression(seed)
    expected, squares, *_ = np.linalg.lstsq(columns / np.abs(columns).mean(axis=0), left, rcond=None)
    np.testing.assert_allclose(likelihood.mean, expected / np.abs(columns).mean(axis=0), rtol=1e-6)
    assert likelihood.residual_square == pytest.approx(squares[0], rel=1e-7)
    random = np.random.default_rng(seed)
    other = likelihood.mean * random.uniform(0.0, 2.0, 6)
    moved = likelihood.subtract(other)
    assert moved.square == pytest.approx(((left - columns @ other) ** 2).sum(), rel=1e-6)
    np.testing.assert_allclose(moved.mean, likelihood.mean - other, rtol=1e-4)
    np.testing.assert_allclose(likelihood.gram, Gaussian.from_gram(likelihood.gram).gram)


@pytest.mark.parametrize("seed", SEEDS)
def test_what_is_integrated_out_leaves_the_covariance_of_the_others(seed):
    _, _, likelihood = regression(seed)
    kept, dropped = [1, 4, 5], [0, 2, 3]
    marginal = likelihood.marginal(kept, dropped)
    np.testing.assert_allclose(marginal.covariance, likelihood.covariance[np.ix_(kept, kept)], rtol=1e-6)
    np.testing.assert_allclose(marginal.mean, likelihood.mean[kept], rtol=1e-6)
    assert marginal.residual_square == pytest.approx(likelihood.residual_square, rel=1e-7)
    placed = likelihood.drop(dropped)
    assert not placed.precision[dropped].any() and not placed.moment[dropped].any()
    np.testing.assert_allclose(placed.precision[np.ix_(kept, kept)], marginal.precision, rtol=1e-9)
    one_by_one = likelihood.drop([0]).drop([3]).drop([2])
    np.testing.assert_allclose(one_by_one.mean[kept], marginal.mean, rtol=1e-6)
    assert likelihood.marginal(kept, []).precision.tolist() == likelihood.among(kept).precision.tolist()


@pytest.mark.parametrize("seed", SEEDS)
def test_rows_that_are_added_are_one_regression_and_priors_are_rows_too(seed):
    columns, left, _ = regression(seed, n_rows=60)
    rows = np.column_stack([columns, left])
    parts = [Gaussian.from_gram(part.T @ part) for part in (rows[:25], rows[25:])]
    whole = parts[0] + parts[1]
    np.testing.assert_allclose(whole.mean, Gaussian.from_gram(rows.T @ rows).mean, rtol=1e-7)
    random = np.random.default_rng(seed)
    mean, deviation = whole.mean * random.uniform(0.5, 1.5, 6), np.abs(whole.mean) * random.uniform(0.01, 1.0, 6)
    priors = np.column_stack([np.diag(1.0 / deviation), mean / deviation])
    expected = Gaussian.from_gram(rows.T @ rows + priors.T @ priors)
    result = whole.with_prior(deviation**-2, mean)
    np.testing.assert_allclose(result.mean, expected.mean, rtol=1e-7)
    assert result.square == pytest.approx(expected.square, rel=1e-12)
    fixed = whole.with_prior(np.where(np.arange(6) == 2, np.inf, 0.0), mean)
    assert fixed.mean[2] == pytest.approx(mean[2], rel=1e-6)
    weights = random.standard_normal(6)
    value, variance = result.contrast(weights)
    assert value == pytest.approx(weights @ result.mean, rel=1e-7)
    assert variance == pytest.approx(weights @ result.covariance @ weights, rel=1e-7)


@pytest.mark.parametrize("seed", SEEDS)
def test_errors_of_the_coefficients_add_to_their_covariance(seed):
    _, _, likelihood = regression(seed, n=4)
    variances = np.diag(likelihood.covariance) * np.random.default_rng(seed).uniform(0.0, 5.0, 4)
    wide = likelihood.widen(variances)
    np.testing.assert_allclose(wide.covariance, likelihood.covariance + np.diag(variances), rtol=1e-5)
    np.testing.assert_allclose(wide.mean, likelihood.mean, rtol=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_coefficients_that_are_sums_of_fewer_are_a_regression_on_fewer_columns(seed):
    columns, left, likelihood = regression(seed)
    matrix = np.random.default_rng(seed).integers(0, 2, (6, 3)) + np.eye(6, 3)
    rows = np.column_stack([columns @ matrix, left])
    expected, fewer = Gaussian.from_gram(rows.T @ rows), likelihood.transform(matrix)
    np.testing.assert_allclose(fewer.precision, expected.precision, rtol=1e-9)
    np.testing.assert_allclose(fewer.moment, expected.moment, rtol=1e-9)
    assert fewer.square == expected.square


def test_robust_covariance_is_that_of_errors_which_differ_between_blocks():
    """Over many draws of errors with another deviation in each block, the coefficients scatter as stated."""
    random = np.random.default_rng(3)
    columns, deviations = random.standard_normal((60, 20, 2)), np.geomspace(0.1, 3.0, 60)
    coefficients, stated = [], []
    for _ in range(400):
        left = deviations[:, None] * random.standard_normal((60, 20)) * np.abs(columns[..., 0])
        fit = Gaussian(np.einsum("kri,krj->ij", columns, columns), np.einsum("kri,kr->i", columns, left))
        residual = left - columns @ fit.mean
        scores = np.einsum("kri,kr->ki", columns, residual)
        coefficients.append(fit.mean)
        stated.append(np.diag(fit.robust_covariance(scores.T @ scores)))
    np.testing.assert_allclose(np.mean(stated, axis=0), np.var(coefficients, axis=0), rtol=0.2)


@pytest.mark.parametrize("seed", SEEDS)
def test_evidence_is_the_probability_of_the_data(seed):
    """With priors of n coefficients integrated out, the data are normal with the covariance s^2 I + X V X'."""
    random = np.random.default_rng(seed)
    columns, deviation, sigma = random.standard_normal((7, 3)), random.uniform(0.5, 2.0, 3), random.uniform(0.5, 2.0)
    left = random.standard_normal(7)
    rows = np.column_stack([columns, left]) / sigma
    posterior = Gaussian.from_gram(rows.T @ rows).with_prior(deviation**-2)
    constants = -3.5 * np.log(2 * np.pi) - 7 * np.log(sigma) - 1.5 * np.log(2 * np.pi) - np.log(deviation).sum()
    covariance = sigma**2 * np.eye(7) + columns * deviation**2 @ columns.T
    expected = multivariate_normal.logpdf(left, cov=covariance)
    assert posterior.evidence() + constants == pytest.approx(expected, rel=1e-7)


def test_columns_without_information_count_as_zero():
    columns, left, _ = regression(0)
    columns[:, 3] = 0.0
    rows = np.column_stack([columns, left])
    likelihood = Gaussian.from_gram(rows.T @ rows)
    assert likelihood.mean[3] == 0.0
    assert likelihood.with_prior(np.full(6, np.inf), 1.0).mean[3] == 0.0
    assert solve(np.zeros((0, 0)), np.zeros((0, 2))).shape == (0, 2)
