"""Differences from healthy recordings: Student's law, errors of a single value, and how large a change can be."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from sealscope.diagnosis.inference.differences import compare_with_healthy, excess_error

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


def test_a_vague_value_shows_less_than_a_precise_one() -> None:
    assert chance(1.5, error=1.0) > 10.0 * chance(1.5)
    assert excess_error(0.5, (0.3, 0.3, 9.0)) == pytest.approx(0.4)
    assert excess_error(0.2, (0.3, 0.3)) == 0.0
    assert excess_error(0.2, ()) == 0.2
