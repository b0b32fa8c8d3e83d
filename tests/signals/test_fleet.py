"""Details of many actuators at once: the single actuator's, over any split."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.signals.streams import DetailStream


def pieces(x, cuts):
    ends = [*sorted(min(cut, x.shape[-1]) for cut in cuts), x.shape[-1]]
    return [x[..., a:b] for a, b in zip([0, *ends[:-1]], ends, strict=True)]


@pytest.mark.parametrize(("wavelet", "levels"), [("db8", 4), ("db8", 1), ("db3", 3), ("haar", 5)])
@pytest.mark.parametrize("actuators", [1, 8, 11])
def test_details_are_those_of_the_single_stream(wavelet, levels, actuators):
    x = 3.0 + np.random.default_rng(1).normal(size=(2, actuators, 1100))
    fleet = DetailStream((2, actuators), levels, wavelet=wavelet)
    result = fleet.update(x)
    for c in range(2):
        for a in range(actuators):
            assert np.array_equal(result[c, a], DetailStream(1, levels, wavelet=wavelet).update(x[c, a]))
    single = DetailStream(1, levels, wavelet=wavelet)
    assert (fleet.delay, fleet.first, fleet.settling) == (single.delay, single.first, single.settling)


@settings(deadline=None, max_examples=40)
@given(
    actuators=st.integers(1, 19),
    n=st.integers(1, 1500),
    cuts=st.lists(st.integers(0, 1500), max_size=25),
    threads=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_split_gives_the_same_bits(actuators, n, cuts, threads, seed):
    x = np.random.default_rng(seed).normal(size=(2, actuators, n)) * 1e5
    whole, parts = DetailStream((2, actuators)), DetailStream((2, actuators), threads=threads)
    streamed = np.concatenate([parts.update(block) for block in pieces(x, cuts)], axis=-1)
    assert np.array_equal(streamed, whole.update(x))
