"""Windowed RMS: against plain windows, long drifting series, and where details depend on padding."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.signals.details import details
from sealscope.signals.windows import rms, windowed_rms

from ..refusals import refusal


def plain_windows(x, size, step):
    return [
        (start + size, float(np.sqrt(np.mean(x[start : start + size] ** 2))))
        for start in range(0, len(x) - size + 1, step)
    ]


@settings(deadline=None, max_examples=40)
@given(n=st.integers(0, 400), size=st.integers(1, 120), step=st.integers(1, 150), seed=st.integers(0, 2**32 - 1))
def test_windows_are_the_plain_ones(n, size, step, seed):
    x = np.random.default_rng(seed).normal(size=n)
    ends, values = windowed_rms(x, size, step)
    expected = plain_windows(x, size, step)
    assert ends.tolist() == [end for end, _ in expected]
    np.testing.assert_allclose(values, [value for _, value in expected], rtol=1e-13)


def test_a_quiet_end_after_a_violent_beginning_keeps_its_digits():
    rng = np.random.default_rng(2)
    x = np.concatenate([1e9 * rng.normal(size=100_000), 1e-3 * rng.normal(size=10_000)])
    ends, values = windowed_rms(x)
    quiet = ends > 101_000
    expected = [value for end, value in plain_windows(x, 1000, 500) if end > 101_000]
    np.testing.assert_allclose(values[quiet], expected, rtol=1e-13)
    # what a running sum would have made of it
    running = np.concatenate([[0.0], np.cumsum(x**2)])
    naive = np.sqrt(np.maximum(running[ends[quiet]] - running[ends[quiet] - 1000], 0.0) / 1000)
    assert np.abs(naive / expected - 1).max() > 0.1


def test_details_are_windowed_where_they_are_free_of_padding():
    x = np.random.default_rng(3).normal(size=6000)
    result = details(x)
    ends, values = windowed_rms(result)
    assert ends[0] == 105 + 1000
    assert values.shape == (4, ends.size)
    for level in (1, 2, 3, 4):
        for end, value in zip(ends, values[level - 1], strict=True):
            assert value == pytest.approx(rms(result[level][end - 1000 : end]), rel=1e-13)
    assert ends[-1] <= 6000 - 120


def test_a_value_that_is_not_finite_is_refused():
    x = np.ones(4000)
    x[2100] = np.nan
    with refusal("series", "nan", "sample 2100", "1 of 4000"):
        windowed_rms(x)


def test_rms_of_one_and_of_several_series():
    assert rms([3.0, -4.0, 0.0, 0.0]) == pytest.approx(2.5)
    assert isinstance(rms([1, 2]), float)
    np.testing.assert_allclose(rms([[1.0, 1.0], [2.0, -2.0]]), [1.0, 2.0])


def test_bad_input_is_one_clear_line():
    with refusal("size", "0"):
        windowed_rms(np.ones(10), 0, 1)
    with refusal("step", "2.5"):
        windowed_rms(np.ones(10), 10, 2.5)
    with refusal("series", "0"):
        rms([])
    with refusal("series"):
        rms([1.0, np.inf])
