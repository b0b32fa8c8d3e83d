"""Differences from healthy recordings: Student's law, errors of a single value, and how large a change can be."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.stats import binom

from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.population import Population, ScatterPrior, estimate_variance, excess_error
from sealscope.diagnosis.inference.observable import compare_estimates, compare_with_healthy

from ..representatives import SLOW, few

HEALTHY = (1.0, 1.1, 0.9, 1.05, 0.95)


def chance(value: float, **options: float) -> float:
    observable = compare_with_healthy("a number", "test", value, HEALTHY, **options)
    assert observable is not None
    return observable.chance


def test_chances_are_uniform_under_the_null_and_no_smaller_with_a_prior_on_the_change() -> None:
    random, plain, bounded = np.random.default_rng(1), [], []
    for values in random.standard_normal((400, 6)):
        for prior_change, chances in ((np.inf, plain), (3.0, bounded)):
            observable = compare_with_healthy("a", "b", values[0], values[1:].tolist(), prior_change=prior_change)
            assert observable is not None
            chances.append(observable.chance)
    for level in (0.1, 0.01):
        expected = binom.ppf([0.001, 0.999], 400, level)
        assert expected[0] <= np.sum(np.array(plain) < level) <= expected[1]
        assert np.sum(np.array(bounded) < level) <= expected[1]
    assert all(own >= other for own, other in zip(bounded, plain, strict=True))


def test_a_value_that_no_possible_change_explains_is_no_evidence_of_one() -> None:
    assert chance(8.0) < 1e-4
    assert chance(8.0, prior_change=10.0) < 0.01
    assert chance(8.0, prior_change=0.01) > 0.5


def estimates_chance(value: float, healthy: list[Estimate], error: float = 0.05, scatter: float = 0.1) -> float:
    observable = compare_estimates("a", "b", Estimate(value, error), healthy, ScatterPrior(scatter, 3.0))
    assert observable is not None
    return observable.chance


@pytest.mark.parametrize("ratio", few([1.0, 0.3], 1, SLOW))
def test_chances_of_estimates_are_those_stated_where_the_scatter_is_no_larger_than_believed(ratio: float) -> None:
    """Errors differ tenfold from day to day; the scatter is drawn from its prior, or is smaller throughout."""
    random, chances = np.random.default_rng(2), []
    for _ in range(1000):
        scatter = ratio * 0.1 * np.sqrt(3.0 / random.chisquare(3.0))
        errors = 10.0 ** random.uniform(-2.0, -1.0, 7)
        values = random.normal(0.0, np.hypot(scatter, errors))
        healthy = [Estimate(*pair) for pair in zip(values[1:], errors[1:], strict=True)]
        chances.append(estimates_chance(values[0], healthy, errors[0]))
    for level in (0.1, 0.01):
        low, high = binom.ppf([0.0005, 0.9995], len(chances), level)
        count = np.sum(np.array(chances) < level)
        assert count <= high
        assert count >= low or ratio < 1.0


def test_a_day_with_a_large_error_hides_no_change() -> None:
    healthy = [Estimate(value, 0.05) for value in HEALTHY]
    expected = estimates_chance(2.0, healthy)
    assert expected < 1e-3
    assert estimates_chance(2.0, [*healthy, Estimate(3.0, 2.0)]) < 3.0 * expected
    assert estimates_chance(2.0, [*healthy, Estimate(3.0, 0.05)]) > 0.05
    assert estimates_chance(2.0, healthy, error=1.0) > 0.1
    assert compare_estimates("a", "b", Estimate(1.0, 0.1), healthy[:2], ScatterPrior(0.1, 3.0)) is None
    assert compare_estimates("a", "b", Estimate(np.nan, 0.1), healthy, ScatterPrior(0.1, 3.0)) is None


def test_a_vague_value_shows_less_than_a_precise_one() -> None:
    assert chance(1.5, error=1.0) > 10.0 * chance(1.5)
    assert excess_error(0.5, (0.3, 0.3, 9.0)) == pytest.approx(0.4)
    assert excess_error(0.2, (0.3, 0.3)) == 0.0
    assert excess_error(0.2, ()) == 0.2


def test_days_that_differ_by_more_than_their_errors_make_an_imprecise_day_unremarkable() -> None:
    """Errors ten times too small: a day of few strokes, whose error is five times the others', differs by five."""
    healthy = [Estimate(10.0 * value, 1.0) for value in HEALTHY]
    judged, prior = Estimate(60.0, 5.0), ScatterPrior(1.0, 1.0)
    believed = compare_estimates("a", "b", judged, healthy, prior)
    doubted = compare_estimates("a", "b", judged, healthy, prior._replace(inflation=30.0))
    precise = compare_estimates("a", "b", Estimate(60.0, 1.0), healthy, prior._replace(inflation=30.0))
    assert believed is not None and doubted is not None and precise is not None
    assert doubted.chance > 30.0 * believed.chance
    assert precise.chance < 0.01


def test_errors_that_healthy_recordings_show_to_be_too_large_hide_no_change() -> None:
    """Healthy values agree to a fiftieth of their errors: the errors contain what all recordings have in common."""
    healthy = [Estimate(value, 5.0) for value in (*HEALTHY, 1.02, 0.98)]
    believed, doubted = (
        compare_estimates("a", "b", Estimate(2.0, 5.0), healthy, ScatterPrior(0.05, 1.0, deflation=deflation))
        for deflation in (1.0, 100.0)
    )
    assert believed is not None and doubted is not None
    assert believed.chance > 0.5
    assert doubted.chance < 0.01


@pytest.mark.parametrize("excess", few([1.0, 5.0, 20.0], 2, SLOW))
def test_chances_hold_for_errors_that_may_be_too_large(excess: float) -> None:
    random, chances = np.random.default_rng(3), []
    for _ in range(500):
        errors = 10.0 ** random.uniform(-1.0, 0.0, 8)
        values = random.normal(0.0, errors / excess)
        healthy = [Estimate(*pair) for pair in zip(values[1:], errors[1:], strict=True)]
        observable = compare_estimates(
            "a", "b", Estimate(values[0], errors[0]), healthy, ScatterPrior(0.005, 1.0, deflation=20.0)
        )
        assert observable is not None
        chances.append(observable.chance)
    for level in (0.1, 0.01):
        assert np.sum(np.array(chances) < level) <= 2.0 * binom.ppf(0.999, len(chances), level)


@pytest.mark.parametrize("count", [3, 8])
def test_a_population_without_errors_is_students_t_with_the_estimated_variance(count: int) -> None:
    """The mixture over the scatter and the closed form give the same chances of the next value."""
    random = np.random.default_rng(count)
    values, prior = random.normal(5.0, 0.3, count), ScatterPrior(0.2, 4.0)
    predicted = Population(np.zeros((1, count + 1, count + 1)), np.zeros(1)).predict(
        values[None], np.geomspace(1e-3, 1e2, 2000)[None], prior.log_density(np.geomspace(1e-3, 1e2, 2000)[None])
    )
    variance, freedom = estimate_variance(((values - values.mean()) ** 2).sum(), count, prior)
    expected = stats.t(freedom, values.mean(), np.sqrt(variance * (1.0 + 1.0 / count)))
    for value in values.mean() + random.normal(0.0, 0.6, 5):
        assert predicted.normalise().chance_above(value) == pytest.approx(expected.sf(value), rel=1e-6)
