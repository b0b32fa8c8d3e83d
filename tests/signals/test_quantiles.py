"""Quantiles and medians of short blocks equal those of NumPy, to the last bit."""

import numpy as np
import pytest

from sealscope.signals.smoothing import medians, quantiles

FRACTIONS = (0.0, 0.1, 0.5, 0.9, 0.99, 0.999, 1.0)


@pytest.mark.parametrize("n", [1, 2, 3, 10, 101, 1500])
def test_they_are_those_of_numpy(n: int) -> None:
    values = np.random.default_rng(n).standard_normal((3, n))
    np.testing.assert_array_equal(quantiles(values, *FRACTIONS), np.quantile(values, FRACTIONS, axis=1))
    np.testing.assert_array_equal(quantiles(values[0], *FRACTIONS), np.quantile(values[0], FRACTIONS))
    np.testing.assert_array_equal(medians(values), np.median(values, axis=1))


def test_without_values_there_is_no_quantile() -> None:
    assert np.isnan(quantiles(np.empty(0), 0.5)).all()
