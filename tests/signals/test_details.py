"""The stationary transform: against a slow oracle, noise law, bands, edges, bad input."""

import numpy as np
import pytest

from sealscope.errors import InputError
from sealscope.signals.details import decomposition_filters, details, min_samples, reach
from sealscope.signals.windows import rms

from ..refusals import refusal


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


def test_white_noise_has_its_sigma_in_every_level():
    sigma, n = 1.23, 200_000
    result = details(np.random.default_rng(2).normal(scale=sigma, size=n))
    for level, within in zip((1, 2, 3, 4), (0.01, 0.015, 0.02, 0.03), strict=True):
        assert rms(result[level][result.inside()]) == pytest.approx(sigma, rel=within), level


def test_each_level_has_unit_norm_exactly():
    x = np.zeros(1024)
    x[512] = 1.0
    np.testing.assert_allclose((details(x).values ** 2).sum(axis=1), 1.0, rtol=1e-12)


@pytest.mark.parametrize(("rate", "levels"), [(500.0, (2, 3)), (1000.0, (3, 4))])
def test_the_rigs_70_hz_ringing_falls_into_two_levels(rate, levels):
    t = np.arange(20_000) / rate
    result = details(np.sin(2 * np.pi * 70.0 * t))
    energy = (result.values[:, result.inside()] ** 2).mean(axis=1)
    assert sum(energy[level - 1] for level in levels) > 0.95 * energy.sum()
    assert energy.argmax() + 1 == levels[0]


def test_a_slow_trend_and_the_charge_pressure_are_invisible():
    t = np.linspace(0.0, 1.0, 5000)
    result = details(3e5 + 1e5 * t - 4e4 * t**2)
    assert np.abs(result.values[:, result.inside()]).max() < 1e-7


def test_where_the_energy_of_an_event_stands_in_each_level():
    result = []
    for at in range(700, 716):  # every phase of the deepest level
        x = np.zeros(1500)
        x[at] = 1.0
        power = details(x).values ** 2
        result.append(at - power @ np.arange(1500) / power.sum(axis=1))
    np.testing.assert_allclose(np.mean(result, axis=0), (5.42, 7.09, 9.21, 13.23), atol=0.01)


@pytest.mark.parametrize("n", [500, 501, 509, 512, 1000])
def test_the_edges_are_what_the_padding_touches_and_nothing_more(n):
    longer = np.random.default_rng(4).normal(size=16 * 50 + n)
    padded, known = details(longer[400 : 400 + n]), details(longer)
    for level in (1, 2, 3, 4):
        inside = padded.inside(level)
        assert np.array_equal(padded.edges, reach())
        difference = np.abs(padded[level] - known[level][400 : 400 + n])
        assert difference[inside].max() < 1e-12
        # tight: the very next sample does see the padding
        assert difference[inside.start - 1] > 0
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


def test_the_shortest_signal_leaves_one_sample_inside():
    n = min_samples()
    result = details(np.ones(n))
    assert result.inside().stop - result.inside().start == 1
    with pytest.raises(InputError, match=f"signal must have at least {n} samples for 4 levels of db8, got 30"):
        details(np.ones(30))
    with pytest.raises(InputError, match=f"got {n - 1}$"):
        details(np.ones(n - 1))


def test_bad_input_is_one_clear_line():
    x = np.ones(1000)
    holed = x.copy()
    holed[[17, 400]] = np.nan
    with refusal("signal", "nan", "sample 17", "2 of 1000"):
        details(holed)
    with refusal("signal"):
        details(x.reshape(2, 500))
    with refusal("226", "0"):
        details([])
    for level in (0, 5):
        with refusal("level", "4"):
            details(x)[level]
