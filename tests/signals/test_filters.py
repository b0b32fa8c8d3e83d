"""The wavelet's filters against the published table, and how far the levels reach."""

import numpy as np
import pytest

from sealscope.signals.details import MAX_LEVELS, decomposition_filters, reach, require_finite, require_levels

from ..refusals import refusal

# Daubechies, Ten Lectures on Wavelets, SIAM (1992), Table 6.1, N = 8; the same numbers are PyWavelets' rec_lo of db8.
PUBLISHED_DB8 = [
    0.0544158422431072,
    0.3128715909143166,
    0.6756307362973195,
    0.5853546836542159,
    -0.0158291052563823,
    -0.2840155429615824,
    0.0004724845739124,
    0.1287474266204893,
    -0.0173693010018090,
    -0.0440882539307971,
    0.0139810279174001,
    0.0087460940474065,
    -0.0048703529934520,
    -0.0003917403733770,
    0.0006754494064506,
    -0.0001174767841248,
]


def test_db8_taps_are_the_published_ones():
    low, high = decomposition_filters("db8")
    np.testing.assert_allclose(low, PUBLISHED_DB8[::-1], atol=1e-12, rtol=0)
    # the quadrature mirror of the low-pass, up to sign
    mirror = np.array(PUBLISHED_DB8) * (-1.0) ** np.arange(16)
    assert min(np.abs(high - mirror).max(), np.abs(high + mirror).max()) < 1e-12


def test_db8_is_orthonormal_and_blind_to_polynomials_of_degree_7():
    low, high = decomposition_filters("db8")
    for shift in range(0, 16, 2):
        expected = float(shift == 0)
        assert low[shift:] @ low[: 16 - shift] == pytest.approx(expected, abs=1e-12)
        assert high[shift:] @ high[: 16 - shift] == pytest.approx(expected, abs=1e-12)
    k = np.linspace(-1.0, 1.0, 16)
    for degree in range(8):
        assert abs(high @ k**degree) < 1e-11
    assert abs(high @ k**8) > 1e-6


def test_reach_of_db8_and_of_haar():
    assert reach("db8", 4).tolist() == [[7, 8], [21, 24], [49, 56], [105, 120]]
    assert reach("haar", 3).tolist() == [[0, 1], [0, 3], [0, 7]]


@pytest.mark.parametrize("wavelet", ["db99", ["db8"], 8, None])
def test_a_wavelet_that_is_none_is_refused(wavelet):
    with refusal("wavelet", repr(wavelet)):
        decomposition_filters(wavelet)


@pytest.mark.parametrize("levels", [0, -1, MAX_LEVELS + 1, 2.0, True, "4", None])
def test_levels_that_are_refused(levels):
    with refusal("levels", "12"):
        require_levels(levels)


def test_an_unknown_wavelet_names_a_near_one():
    with refusal("wavelet", "'dab8'", "db8"):
        decomposition_filters("dab8")
    with refusal("wavelet"):
        decomposition_filters("morl")  # continuous


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([1.0, 2.0, np.nan, np.nan], "x, nan, sample 2, 2 of 4"),
        ([1.0, -np.inf], "x, -inf, sample 1, 1 of 2"),
        (["a", "b"], "x"),
        ([1 + 2j, 0], "x"),
        ([[1.0], [2.0, 3.0]], "x"),
        (np.zeros((3, 2)), "x, 1-dimensional, shape"),
        (3.0, "x, 1-dimensional, shape ()"),
    ],
)
def test_arrays_that_are_refused(values, words):
    with refusal(*words.split(", ")):
        require_finite(values, "x", ndim=1)
