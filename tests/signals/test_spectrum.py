"""Power spectra equal those of scipy."""

import numpy as np
import pytest
from scipy.signal import welch

from sealscope.signals.spectrum import average_power


@pytest.mark.parametrize("n", [100, 255, 256, 257, 384, 385, 10_000])
def test_average_power_equals_that_of_scipy(n):
    values = np.random.default_rng(n).normal(3.0, 1.0, (2, n))
    segment = min(256, n)
    _, expected = welch(values, nperseg=segment, nfft=1024, detrend=False)
    np.testing.assert_allclose(average_power(values, segment, 1024), expected, rtol=1e-10)
