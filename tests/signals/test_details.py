"""The three transforms: against a slow oracle, perfect reconstruction, noise law, bands, edges, bad input."""

import numpy as np
import pytest
import pywt
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.errors import InputError
from sealscope.signals.details import details, edge_samples, min_samples
from sealscope.signals.filters import decomposition_filters
from sealscope.signals.windows import rms

from ..refusals import refusal

TRANSFORMS = ("stationary", "decimated", "reconstructed")


def slow_details(x, wavelet, levels):
    """The formula of `details`, sample by sample and tap by tap; the ends of the signal are joined."""
    low, high = decomposition_filters(wavelet)
    taps, n = low.size, len(x)
    a, rows = np.array(x, dtype=float), []
    for j in range(1, levels + 1):
        hole = 2 ** (j - 1)
        d, coarser = np.zeros(n), np.zeros(n)
        for i in range(n):
            for k in range(taps):
                value = a[(i + hole * (taps // 2 - k)) % n]
                d[i] += high[k] * value
                coarser[i] += low[k] * value
        a = coarser
        rows.append(d)
    return np.array(rows)


@pytest.mark.parametrize(("wavelet", "levels"), [("db8", 4), ("db3", 3), ("haar", 2), ("sym5", 1)])
def test_stationary_is_the_formula(wavelet, levels):
    x = np.random.default_rng(1).normal(size=400)
    result = details(x, wavelet=wavelet, levels=levels)
    inside = result.inside()
    np.testing.assert_allclose(result.values[:, inside], slow_details(x, wavelet, levels)[:, inside], atol=1e-13)


@settings(deadline=None, max_examples=40)
@given(n=st.integers(451, 900), levels=st.integers(1, 4), seed=st.integers(0, 2**32 - 1))
def test_reconstructed_details_and_the_low_pass_part_sum_up_to_the_signal(n, levels, seed):
    x = np.random.default_rng(seed).normal(size=n)
    low_pass, *others = pywt.wavedec(x, "db8", level=levels)
    approximation = pywt.waverec([low_pass, *map(np.zeros_like, others)], "db8")[:n]
    result = details(x, levels=levels, transform="reconstructed")
    np.testing.assert_allclose(result.values.sum(axis=0) + approximation, x, atol=1e-9)


def test_white_noise_has_its_sigma_in_every_level_but_not_when_reconstructed():
    sigma, n = 1.23, 200_000
    x = np.random.default_rng(2).normal(scale=sigma, size=n)
    for transform in ("stationary", "decimated"):
        result = details(x, transform=transform)
        for level, within in zip((1, 2, 3, 4), (0.01, 0.015, 0.02, 0.03), strict=True):
            assert rms(result[level][result.inside()]) == pytest.approx(sigma, rel=within), (transform, level)
    result = details(x, transform="reconstructed")
    assert rms(result[1]) == pytest.approx(sigma / np.sqrt(2), rel=0.01)
    assert rms(result[2]) / rms(result[1]) == pytest.approx(0.71, abs=0.01)


def test_each_level_has_unit_norm_exactly():
    x = np.zeros(1024)
    x[512] = 1.0
    np.testing.assert_allclose((details(x).values ** 2).sum(axis=1), 1.0, rtol=1e-12)


@pytest.mark.parametrize(("rate", "levels"), [(500.0, (2, 3)), (1000.0, (3, 4))])
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_the_rigs_70_hz_ringing_falls_into_two_levels(rate, levels, transform):
    t = np.arange(20_000) / rate
    result = details(np.sin(2 * np.pi * 70.0 * t), transform=transform)
    energy = (result.values[:, result.inside()] ** 2).mean(axis=1)
    assert sum(energy[level - 1] for level in levels) > 0.95 * energy.sum()
    assert energy.argmax() + 1 == levels[0]


def test_a_slow_trend_and_the_charge_pressure_are_invisible():
    t = np.linspace(0.0, 1.0, 5000)
    result = details(3e5 + 1e5 * t - 4e4 * t**2)
    assert np.abs(result.values[:, result.inside()]).max() < 1e-7


@pytest.mark.parametrize(
    ("transform", "early", "within"),
    [
        ("stationary", (5.42, 7.09, 9.21, 13.23), 0.01),
        ("decimated", (5.0, 5.5, 5.5, 5.5), 0.5),
        ("reconstructed", (0.0, 0.0, 0.0, 0.0), 0.5),
    ],
)
def test_where_the_energy_of_an_event_stands_in_each_level(transform, early, within):
    result = []
    for at in range(700, 716):  # every phase of the deepest level
        x = np.zeros(1500)
        x[at] = 1.0
        power = details(x, transform=transform).values ** 2
        result.append(at - power @ np.arange(1500) / power.sum(axis=1))
    np.testing.assert_allclose(np.mean(result, axis=0), early, atol=within)


def test_decimated_holds_every_second_to_sixteenth_stationary_coefficient():
    x = np.random.default_rng(3).normal(size=2000)
    fine, coarse = details(x), details(x, transform="decimated")
    for level in (1, 2, 3, 4):
        step = 2**level
        held = (np.arange(2000) + 7 * (step - 1)) // step * step - 7 * (step - 1)
        inside = coarse.inside(level)
        np.testing.assert_allclose(coarse[level][inside], fine[level][held[inside]], atol=1e-12)


@pytest.mark.parametrize("n", [500, 501, 509, 512, 1000])
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_the_edges_are_what_the_padding_touches_and_nothing_more(transform, n):
    longer = np.random.default_rng(4).normal(size=16 * 50 + n)
    # the decimated levels have their coefficients at multiples of 16 samples of either signal
    padded, known = details(longer[400 : 400 + n], transform=transform), details(longer, transform=transform)
    for level in (1, 2, 3, 4):
        inside = padded.inside(level)
        assert np.array_equal(padded.edges, edge_samples(transform=transform))
        difference = np.abs(padded[level] - known[level][400 : 400 + n])
        assert difference[inside].max() < 1e-12
        if transform != "reconstructed":  # tight: the very next sample does see the padding
            assert difference[inside.start - 1] > 0
        if transform == "stationary":
            assert difference[inside.stop] > 0


@pytest.mark.parametrize("n", [226, 300, 511])
def test_odd_lengths_keep_the_length(n):
    x = np.random.default_rng(5).normal(size=n)
    result = details(x)
    assert result.values.shape == (4, n)
    reference = details(np.concatenate([np.zeros(300), x, np.zeros(300)]))
    inside = result.inside()
    np.testing.assert_allclose(result[4][inside], reference[4][300 : 300 + n][inside], atol=1e-12)


def test_product_is_the_sample_product():
    result = details(np.random.default_rng(6).normal(size=500))
    assert np.array_equal(result.product(), result.values[2] * result.values[3])
    assert result.inside(1) == slice(7, 492)
    assert result.inside(4) == result.inside() == slice(105, 380)


@pytest.mark.parametrize("level", [0, -1, 5])
def test_a_level_without_details_has_no_inside(level):
    result = details(np.ones(500))
    with refusal("level", "4", level):
        result.inside(level)
    with refusal("level", "4", level):
        result[level]


def test_counts_are_taken_as_numbers():
    counts = np.random.default_rng(7).integers(-8192, 8191, size=400, dtype=np.int16)
    assert np.array_equal(details(counts).values, details(counts.astype(float)).values)


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_the_shortest_signal_leaves_one_sample_inside(transform):
    n = min_samples(transform=transform)
    result = details(np.ones(n), transform=transform)
    assert result.inside().stop - result.inside().start == 1
    with pytest.raises(
        InputError, match=f"signal must have at least {n} samples for 4 {transform} levels of db8, got 30"
    ):
        details(np.ones(30), transform=transform)
    with pytest.raises(InputError, match=f"got {n - 1}$"):
        details(np.ones(n - 1), transform=transform)


def test_bad_input_is_one_clear_line():
    x = np.ones(1000)
    holed = x.copy()
    holed[[17, 400]] = np.nan
    with refusal("signal", "nan", "sample 17", "2 of 1000"):
        details(holed)
    with refusal("transform", "'swt'"):
        details(x, transform="swt")
    with refusal("signal"):
        details(x.reshape(2, 500))
    with refusal("226", "0"):
        details([])
    for level in (0, 5):
        with refusal("level", "4"):
            details(x)[level]
