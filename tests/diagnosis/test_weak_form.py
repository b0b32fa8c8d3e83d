"""Rows of the weak form against closed forms: value, order of convergence, noise, and samples that are missing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import spherical_jn

from sealscope.diagnosis.inference.rows import SPAN, STRIDE, stride_samples, weak_form_rows

RATES = (80.0, 160.0, 320.0, 640.0)  # whole samples a stride


def half_width(rate: float) -> float:
    return 0.5 * SPAN * stride_samples(rate) / rate


def low_pass(omega: float, rate: float) -> float:
    """Mean of cos(omega t) weighted by (1 - s^2)^4: 945 j_4(k) / k^4 with k = omega h (Poisson's integral)."""
    k = omega * half_width(rate)
    return 945.0 * float(spherical_jn(4, k)) / k**4 if k else 1.0


def product_row(a: float, b: float, time: np.ndarray, rate: float) -> np.ndarray:
    """Weighted mean of f dg/dt for f = sin(a t), g = sin(b t): a sum of two cosines' products."""
    high, low = a + b, a - b
    return 0.5 * b * (np.sin(high * time) * low_pass(high, rate) + np.sin(low * time) * low_pass(low, rate))


def product_rows(a: float, b: float, rate: float, start: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    t = start + np.arange(round(6.0 * rate)) / rate
    f, g = np.sin(a * t), np.sin(b * t)
    made = weak_form_rows([0.5 * (f[1:] + f[:-1]) * np.diff(g)], rate)
    return start + made.time, made.values[:, 0]


@pytest.mark.parametrize(("a", "b"), [(3.0, 2.0), (1.0, 9.0), (12.0, 4.0), (5.0, 5.0)])
def test_rows_are_the_analytic_integrals_and_converge_by_the_second_order(a: float, b: float) -> None:
    errors = []
    for rate in RATES:
        time, values = product_rows(a, b, rate)
        errors.append(np.abs(values - product_row(a, b, time, rate)).max())
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert orders == pytest.approx(2.0, abs=0.1)
    assert errors[-1] < 1e-3 * b


@pytest.mark.parametrize("rate", [97.0, 333.0, 1000.0])
def test_any_rate_serves(rate: float) -> None:
    time, values = product_rows(3.0, 2.0, rate, start=7.0)
    assert time[0] == pytest.approx(7.0 + half_width(rate))
    assert values == pytest.approx(product_row(3.0, 2.0, time, rate), abs=2e-3 * (100.0 / rate) ** 2)


@pytest.mark.parametrize("rate", [50.0, 97.0, 500.0])
def test_a_constant_rate_is_itself(rate: float) -> None:
    t = np.arange(400) / rate
    assert weak_form_rows([np.diff(4.0 - 3.0 * t)], rate).values == pytest.approx(-3.0, rel=1e-12)


def test_noise_of_a_channel_weighs_as_the_derivative_of_the_test_function() -> None:
    """var = sigma^2 dt integral phi'^2 (summation by parts); the variance falls with the sampling interval."""
    random = np.random.default_rng(0)
    for rate in (160.0, 640.0):
        noise = random.standard_normal(round(1500.0 * rate))
        made = weak_form_rows([np.diff(noise)], rate).values[:, 0]
        s = np.linspace(-1.0, 1.0, 20001)
        slope = -8.0 * s * (1.0 - s * s) ** 3 * 315.0 / 256.0
        expected = np.trapezoid(slope**2, s) / half_width(rate) ** 3 / rate
        assert np.var(made) == pytest.approx(expected, rel=0.1)


def test_a_missing_sample_costs_the_rows_that_rest_on_it_and_no_other() -> None:
    rate, at = 200.0, 1000
    t = np.arange(2000) / rate
    g = np.sin(3.0 * t)
    lost = g.copy()
    lost[at] = np.nan
    whole, gap = weak_form_rows([np.diff(g), np.diff(t)], rate), weak_form_rows([np.diff(lost), np.diff(t)], rate)
    h = half_width(rate)
    # of the sample the increments on either side are lost, and with them the pieces of a stride that they lie in
    touched = np.abs(whole.time - t[at]) < h + STRIDE
    assert not gap.whole[np.abs(whole.time - t[at]) < h].any()
    assert gap.whole[~touched].all()
    np.testing.assert_array_equal(gap.values[gap.whole], whole.values[gap.whole])
    assert SPAN <= np.count_nonzero(~gap.whole) <= SPAN + 1


@pytest.mark.parametrize(("strides", "count"), [(SPAN - 1, 0), (SPAN, 1), (SPAN + 5, 6)])
def test_rows_fit_into_the_samples(strides: int, count: int) -> None:
    made = weak_form_rows([np.ones(strides * stride_samples(100.0))], 100.0)
    assert made.values.shape == (count, 1) and len(made.time) == len(made.whole) == count
