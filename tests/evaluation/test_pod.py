"""Probability of detection: published fits, closed forms, an independent maximum, and bounds that cover."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.errors import InputError
from sealscope.evaluation.hit_miss import fit_hit_miss
from sealscope.evaluation.pod import by_size, proven_size
from sealscope.evaluation.signal_response import fit_signal_response
from sealscope.evaluation.tobit import fit_tobit

# Dalal, Fowlkes, Hoadley, JASA 84 (1989) 945-957: launch temperature [F], O-ring distress, before the Challenger's last
CHALLENGER_F = np.array([53, 57, 58, 63, 66, 67, 67, 67, 68, 69, 70, 70, 70, 70, 72, 73, 75, 75, 76, 76, 78, 79, 81.0])
CHALLENGER_DISTRESS = np.array([1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0])

# Schmee and Hahn, Technometrics 21 (1979) 417-432 (Nelson and Hahn 1972): hours to failure of 40 motorettes; True where
# the test ended before the failure
MOTORETTE_C = np.repeat([150.0, 170.0, 190.0, 220.0], 10)
MOTORETTE_H = np.array(
    [8064.0] * 10
    + [1764, 2772, 3444, 3542, 3780, 4860, 5196, 5448, 5448, 5448]
    + [408, 408, 1344, 1344, 1440] + [1680] * 5
    + [408, 408, 504, 504, 504] + [528] * 5
)  # fmt: skip
MOTORETTE_RAN_ON = np.array([1] * 10 + [0] * 7 + [1] * 3 + ([0] * 5 + [1] * 5) * 2, dtype=bool)


SIZES = np.array([0.0005, 0.001, 0.0042, 0.0075, 0.015])


def drawn(seed: int, n: int = 60, a50: float = 0.003, slope: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    size = np.repeat(SIZES, n)
    return size, rng.random(size.size) < 1 / (1 + (size / a50) ** -slope)


def test_the_challenger_s_o_rings():
    """No distress is the hit, temperature the size. Estimates as printed with the data in many texts: -15.0429
    (7.3786)
    and 0.2322 (0.1082), deviances 28.267 and 20.315; at the last flight's 31 F distress is all but certain."""
    fit = fit_hit_miss(CHALLENGER_F, 1 - CHALLENGER_DISTRESS, "linear")
    assert (fit.intercept, fit.slope) == pytest.approx((-15.0429, 0.2322), abs=5e-5)
    assert np.sqrt(np.diag(fit.covariance)) == pytest.approx((7.3786, 0.1082), abs=5e-5)
    assert (-2 * fit.null, -2 * fit.log_likelihood) == pytest.approx((28.267, 20.315), abs=5e-4)
    assert (fit.estimator, fit.separated) == ("maximum likelihood", False)
    assert fit.a50 == pytest.approx(15.0429 / 0.232163, abs=1e-3)
    assert fit.a90 == pytest.approx((15.0429 + math.log(9)) / 0.232163, abs=1e-3)
    assert 1 - fit.detection(31.0)[0] == pytest.approx(0.9996, abs=5e-5)


def test_an_interval_has_the_bounds_of_half_its_doubt_for_ends():
    """Both ends drop the profile log-likelihood by as much; an interval of 90 % ends at a90/95."""
    fit = fit_hit_miss(CHALLENGER_F, 1 - CHALLENGER_DISTRESS, "linear")
    slopes = np.linspace(0.001, 1.0, 20001)
    low, high = fit.size_interval(0.9, 0.90)
    assert high == fit.a90_95
    assert low < fit.a90 < high
    for end in (low, high):
        best = log_likelihood(fit, math.log(9) - slopes * end, slopes).max()
        assert fit.log_likelihood - best == pytest.approx(1.6448536**2 / 2, abs=1e-6)
    for bounds in ("likelihood ratio", "wald"):
        narrow, wide = (fit.size_interval(0.9, c, bounds) for c in (0.5, 0.9))
        assert wide[0] < narrow[0] < fit.a90 < narrow[1] < wide[1]


def test_an_interval_without_a_rise_is_everything():
    size, hit = np.repeat([1.0, 2.0, 3.0], 4), np.array([0, 1, 1, 0] * 3)
    hit[0] = 1
    assert fit_hit_miss(size, hit).size_interval() == (0.0, math.inf)
    assert fit_hit_miss(size, hit, "linear").size_interval() == (-math.inf, math.inf)
    weak = fit_hit_miss(size, 1 - hit)
    assert weak.slope > 0
    for bounds in ("likelihood ratio", "wald"):
        assert weak.size_interval(bounds=bounds) == (0.0, math.inf)


def test_intervals_cover():
    """a90 of the truth is 0.009; 90 % intervals hold it in about 90 % of the campaigns, and miss it on both sides."""
    ends = np.array([fit_hit_miss(*drawn(seed, n=25)).size_interval(0.9, 0.9) for seed in range(200)])
    below, above = np.mean(ends[:, 1] < 0.009), np.mean(ends[:, 0] > 0.009)
    assert 0.01 <= below <= 0.10
    assert 0.01 <= above <= 0.10


def log_likelihood(fit, intercept, slope) -> np.ndarray:
    x = np.log(fit.size) if fit.scale == "log" else fit.size
    eta = np.add.outer(intercept, 0 * x) + np.multiply.outer(slope, x)
    return np.sum(fit.found * eta - fit.tested * np.logaddexp(0, eta), axis=-1)


def test_the_likelihood_ratio_bound_against_a_search_of_the_whole_plane():
    """Among all slopes on a grid, no line through log odds 9 : 1 at a90/95 is likelier than allowed, one just is."""
    fit = fit_hit_miss(CHALLENGER_F, 1 - CHALLENGER_DISTRESS, "linear")
    slopes = np.linspace(0.001, 1.0, 20001)
    for confidence, z in ((0.95, 1.6448536), (0.90, 1.2815516)):
        bound = fit.size_bound(0.9, confidence)
        best = log_likelihood(fit, math.log(9) - slopes * bound, slopes).max()
        assert fit.log_likelihood - best == pytest.approx(z * z / 2, abs=1e-6)
    assert fit.size_bound(0.9, 0.5) == pytest.approx(fit.a90)


def test_wald_s_bound_is_where_the_band_reaches_the_probability():
    fit = fit_hit_miss(*drawn(1))
    for p in (0.5, 0.9):
        low, _ = fit.detection_band(fit.size_bound(p, 0.95, "wald"), 0.90)
        assert low[0] == pytest.approx(p)


def test_both_bounds_agree_on_many_records():
    fit = fit_hit_miss(*drawn(2, n=2000))
    assert fit.a90 == pytest.approx(0.009, rel=0.05)
    assert fit.a90 < fit.a90_95 < 1.1 * fit.a90
    assert fit.size_bound(bounds="wald") == pytest.approx(fit.a90_95, rel=2e-3)


def test_the_bound_covers():
    """a90 of the truth is 0.003 * 3 = 0.009; 95 % bounds lie above it in about 95 % of the campaigns."""
    above = sum(fit_hit_miss(*drawn(seed, n=25)).a90_95 >= 0.009 for seed in range(200))
    assert 0.90 <= above / 200 <= 0.99


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.floats(1e-3, 1e3))
def test_another_unit_of_size_changes_nothing_else(seed, unit):
    size, hit = drawn(seed, n=10)
    fit, other = fit_hit_miss(size, hit), fit_hit_miss(size * unit, hit)
    assert other.a90 == pytest.approx(fit.a90 * unit, rel=1e-6)
    assert other.a90_95 == pytest.approx(fit.a90_95 * unit, rel=1e-5)
    assert other.slope == pytest.approx(fit.slope, rel=1e-6)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_sizes_rise_with_probability_and_confidence(seed):
    fit = fit_hit_miss(*drawn(seed, n=12))
    assert fit.a50 < fit.a90
    assert fit.a90 <= fit.size_bound(0.9, 0.8) <= fit.a90_95 <= fit.size_bound(0.95)
    assert np.all(np.diff(fit.detection(SIZES)) > 0)
    assert fit.detection(fit.a90)[0] == pytest.approx(0.9)


def test_firth_s_fit_is_half_a_count_more_in_a_table_of_two_sizes():
    """With two sizes the model is saturated, and Firth's estimate adds 1/2 to each cell (Heinze and Schemper 2002)."""
    fit = fit_hit_miss(np.repeat([1.0, 10.0], 20), np.r_[np.zeros(20), np.ones(17), np.zeros(3)])
    assert fit.separated
    assert fit.estimator == "firth"
    assert fit.detection(np.array([1.0, 10.0])) == pytest.approx((0.5 / 21, 17.5 / 21), abs=1e-8)


def test_hits_and_misses_apart_still_give_a_curve_and_a_wide_bound():
    few = fit_hit_miss([1, 2, 3, 4, 5, 6, 7, 8], [0, 0, 0, 0, 1, 1, 1, 1])
    many = fit_hit_miss(np.repeat([1.0, 2, 3, 4, 5, 6, 7, 8], 40), np.repeat([0, 0, 0, 0, 1, 1, 1, 1], 40))
    for fit in (few, many):
        assert fit.separated
        assert 4.0 < fit.a50 < 5.0
        assert fit.a90 < fit.a90_95
    assert many.a90_95 < 5.2 < few.a90_95


def penalised(fit, intercept, slope) -> float:
    x = np.log(fit.size)
    eta = intercept + slope * x
    p = 1 / (1 + np.exp(-eta))
    design = np.column_stack([np.ones_like(x), x])
    information = design.T @ (design * (fit.tested * p * (1 - p))[:, None])
    return float(log_likelihood(fit, intercept, slope)) + 0.5 * np.linalg.slogdet(information)[1]


def test_firth_s_fit_and_bound_are_those_of_the_penalised_likelihood():
    fit = fit_hit_miss(np.repeat([1.0, 2, 3, 4, 5, 6, 7, 8], 3), np.repeat([0, 0, 1, 1, 1, 1, 1, 1], 3))
    best = penalised(fit, fit.intercept, fit.slope)
    assert fit.log_likelihood == pytest.approx(best)
    for a, b in ((1e-3, 0.0), (-1e-3, 0.0), (0.0, 1e-3), (0.0, -1e-3)):
        assert penalised(fit, fit.intercept + a, fit.slope + b) < best
    assert fit.null == pytest.approx(max(penalised(fit, a, 0.0) for a in np.linspace(-3, 3, 6001)), abs=1e-6)
    x = math.log(fit.a90_95)
    found = max(penalised(fit, math.log(9) - b * x, b) for b in np.linspace(0.05, 30, 6001))
    assert best - found == pytest.approx(1.6448536**2 / 2, abs=1e-5)


def test_detection_that_does_not_rise_has_no_size():
    falling = fit_hit_miss(np.repeat(SIZES, 10), np.tile([1, 0, 0, 0, 0, 0, 0, 0, 0, 0], 5)[::-1])
    assert falling.a90_95 == math.inf
    turned = fit_hit_miss(CHALLENGER_F, CHALLENGER_DISTRESS, "linear")
    assert turned.slope == pytest.approx(-0.2322, abs=5e-5)
    assert (turned.a50, turned.a90_95, turned.size_bound(bounds="wald")) == (math.inf,) * 3


def test_rates_by_size_and_what_they_prove():
    size = np.repeat([1.0, 2.0, 3.0, 4.0], [29, 29, 29, 10])
    hit = np.ones(size.size)
    hit[:20] = 0
    hit[40] = 0
    rows = by_size(size, hit)
    assert [(row.size, row.rate.count, row.rate.n) for row in rows] == [
        (1.0, 9, 29),
        (2.0, 28, 29),
        (3.0, 29, 29),
        (4.0, 10, 10),
    ]
    assert proven_size(rows) == math.inf  # ten of ten prove nothing, so nothing above 3.0 is proven
    assert proven_size(rows[:3]) == 3.0
    assert proven_size(rows, 0.7) == 2.0


def test_the_motorettes():
    """Log10 hours over 1000/K with units that ran on: maximum likelihood -6.019, 4.311, 0.259 (Schmee, Hahn 1979)."""
    x = 1000 / (MOTORETTE_C + 273.2)
    fit = fit_tobit(np.column_stack([np.ones(40), x]), np.log10(MOTORETTE_H), MOTORETTE_RAN_ON.astype(int))
    assert (*fit.coefficients, fit.sigma) == pytest.approx((-6.019, 4.311, 0.259), abs=5e-4)


def test_left_and_right_mirror_each_other():
    rng = np.random.default_rng(5)
    x = rng.uniform(0, 2, 80)
    y = 1 + 2 * x + rng.normal(0, 0.7, 80)
    low = fit_signal_response(x + 1, y, "linear", lowest=2.0)
    high = fit_signal_response(x + 1, -y, "linear", highest=-2.0)
    assert low.below == high.above > 5
    assert (high.intercept, high.slope, high.sigma) == pytest.approx((-low.intercept, -low.slope, low.sigma))
    assert low.log_likelihood == pytest.approx(high.log_likelihood)


def test_a_censored_fit_is_the_maximum_of_its_likelihood():
    """Against the same likelihood written with erfc, and the covariance against its numerical curvature."""
    rng = np.random.default_rng(9)
    x = rng.uniform(-1, 1, 120)
    y = np.clip(0.5 + 1.5 * x + rng.normal(0, 0.8, 120), -0.5, 1.6)
    side = np.where(y <= -0.5, -1, np.where(y >= 1.6, 1, 0))
    fit = fit_tobit(np.column_stack([np.ones(120), x]), y, side)

    def value(b0, b1, sigma):
        z = (y - b0 - b1 * x) / sigma
        below = [math.log(0.5 * math.erfc(-one / math.sqrt(2))) for one in z[side < 0]]
        above = [math.log(0.5 * math.erfc(one / math.sqrt(2))) for one in z[side > 0]]
        known = z[side == 0]
        return sum(below) + sum(above) - np.sum(known**2) / 2 - known.size * math.log(sigma * math.sqrt(2 * math.pi))

    at = np.array([*fit.coefficients, fit.sigma])
    assert fit.log_likelihood == pytest.approx(value(*at))
    h, e = 1e-4, np.eye(3)
    curve = np.empty((3, 3))
    for i in range(3):
        assert value(*(at + h * e[i])) - value(*(at - h * e[i])) == pytest.approx(0.0, abs=1e-5)
        for j in range(3):
            curve[i, j] = sum(s * t * value(*(at + h * (s * e[i] + t * e[j]))) for s in (1, -1) for t in (1, -1)) / (
                4 * h * h
            )
    assert fit.covariance == pytest.approx(np.linalg.inv(-curve), rel=1e-3)


def test_without_limits_the_signal_s_line_is_least_squares_and_its_bound_the_handbook_s():
    """Closed form: beta by least squares, sigma^2 = RSS/n, covariances sigma^2 (X'X)^-1 and sigma^2/2n."""
    rng = np.random.default_rng(2)
    size = np.repeat(SIZES, 20)
    signal = 10 + 2.5 * np.log(size / 0.001) + rng.normal(0, 1.2, size.size)
    fit = fit_signal_response(size, signal)
    design = np.column_stack([np.ones(size.size), np.log(size)])
    beta, rss, *_ = np.linalg.lstsq(design, signal, rcond=None)
    sigma = math.sqrt(rss[0] / size.size)
    assert (fit.intercept, fit.slope, fit.sigma) == pytest.approx((*beta, sigma))
    expected = np.zeros((3, 3))
    expected[:2, :2] = sigma**2 * np.linalg.inv(design.T @ design)
    expected[2, 2] = sigma**2 / (2 * size.size)
    assert fit.covariance == pytest.approx(expected, rel=1e-6, abs=1e-12)
    pod = fit.pod(12.0)
    x90 = (12.0 + 1.2815516 * sigma - beta[0]) / beta[1]
    assert pod.a90 == pytest.approx(math.exp(x90), rel=1e-6)
    gradient = np.array([-1 / beta[1], -x90 / beta[1], 1.2815516 / beta[1]])
    error = math.sqrt(gradient @ expected @ gradient)
    assert pod.a90_95 == pytest.approx(math.exp(x90 + 1.6448536 * error), rel=1e-6)
    assert pod.detection([pod.a50, pod.a90]) == pytest.approx((0.5, 0.9))


def test_the_signal_s_bound_covers_with_both_limits():
    """Signal 10 + 2 ln(a/0.001) + 1.5 e, decision 12: a90 = 0.001 exp(1 + 1.2816 * 0.75)."""
    truth = 0.001 * math.exp(1 + 1.2815516 * 0.75)
    rng = np.random.default_rng(6)
    size = np.repeat(SIZES, 12)
    above = 0
    for _ in range(300):
        signal = 10 + 2 * np.log(size / 0.001) + rng.normal(0, 1.5, size.size)
        above += fit_signal_response(size, signal, lowest=9.0, highest=14.0).pod(12.0).a90_95 >= truth
    assert 0.90 <= above / 300 <= 0.98


def test_the_covariance_of_the_curve_is_the_delta_method_s():
    """With a limit below, the line and its scatter are correlated; derivatives by differences."""
    rng = np.random.default_rng(3)
    size = np.repeat(SIZES, 8)
    fit = fit_signal_response(size, 10 + 2 * np.log(size / 0.001) + rng.normal(0, 1.5, size.size), lowest=10.0)
    assert abs(fit.covariance[0, 2]) > 0.01
    names, h = ("intercept", "slope", "sigma"), 1e-6
    jacobian = np.empty((2, 3))
    for i, name in enumerate(names):
        up, down = (replace(fit, **{name: getattr(fit, name) + s * h}).pod(12.0) for s in (1, -1))
        jacobian[:, i] = (up.location - down.location) / (2 * h), (up.spread - down.spread) / (2 * h)
    assert fit.pod(12.0).covariance == pytest.approx(jacobian @ fit.covariance @ jacobian.T, rel=1e-5)


def test_log_signals_and_a_higher_decision():
    rng = np.random.default_rng(12)
    size = np.repeat(SIZES, 30)
    signal = np.exp(1 + 0.8 * np.log(size) + rng.normal(0, 0.4, size.size))
    fit = fit_signal_response(size, signal, signal_scale="log")
    low, high = fit.pod(0.02), fit.pod(0.04)
    assert high.a90 == pytest.approx(low.a90 * 2 ** (1 / fit.slope))


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (
            lambda: fit_hit_miss([0.0, 1.0], [0, 1]),
            "leak sizes must be > 0, got 0.0 (a record without a leak is no size of leak)",
        ),
        (lambda: fit_hit_miss([1.0, 2.0], [1, 1]), "a curve needs hits and misses, got 2 hits of 2"),
        (lambda: fit_hit_miss([1.0, 1.0], [0, 1]), "a curve needs leaks of at least 2 sizes, got 2 of one size"),
        (lambda: fit_hit_miss([1.0, 2.0], [0, 0.5]), "hits must be yes or no (1 or 0), got 0.5"),
        (lambda: fit_hit_miss([1.0, 2.0], [0]), "hits must be as many as the records, got 1 for 2"),
        (lambda: fit_hit_miss([1.0, 2.0], [0, 1], "cubic"), "the scale must be 'log' or 'linear', got 'cubic'"),
        (
            lambda: fit_signal_response([1.0, 2.0, 3.0], [1.0, 2.0]),
            "signals must be as many as the leak sizes, got 2 for 3",
        ),
        (
            lambda: fit_signal_response([1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0], "linear"),
            "the responses lie exactly on a line: there is no scatter to judge a detection by",
        ),
        (
            lambda: fit_signal_response([1.0, 2.0, 3.0, 4.0], [0.0, 0.0, 0.0, 4.0], lowest=0.0),
            "a censored fit needs more than 2 known responses at different sizes, got 1",
        ),
        (
            lambda: fit_signal_response([1.0, 2.0, 3.0, 4.0], [4.0, 3.5, 2.0, 1.0]).pod(2.0),
            "the signal must rise with the size of the leak, got a slope of -2.15",
        ),
    ],
)
def test_impossible_data(call, line):
    with pytest.raises(InputError) as error:
        call()
    assert str(error.value) == line
