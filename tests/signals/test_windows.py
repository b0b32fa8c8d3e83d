"""Windowed RMS: against plain windows, long drifting series, batch and stream with the same bits."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.signals.details import details
from sealscope.signals.streams import DetailStream
from sealscope.signals.windows import RmsStream, rms, windowed_rms

from ..refusals import refusal
from ..representatives import few


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


@settings(deadline=None, max_examples=50)
@given(
    n=st.integers(0, 1500),
    size=st.integers(1, 300),
    step=st.integers(1, 400),
    cuts=st.lists(st.integers(0, 1500), max_size=20),
    skip=st.integers(0, 300),
    rows=st.sampled_from([(), (1,), (3,), (2, 2)]),
    seed=st.integers(0, 2**32 - 1),
)
def test_stream_and_batch_have_the_same_bits(n, size, step, cuts, skip, rows, seed):
    x = np.random.default_rng(seed).normal(size=(*rows, n))
    stream = RmsStream(size, step, skip=skip, first=7)
    ends = [*sorted(min(cut, n) for cut in cuts), n]
    result = [stream.update(x[..., a:b]) for a, b in zip([0, *ends[:-1]], ends, strict=True)]
    batch = windowed_rms(x[..., skip:], size, step, first=7)
    assert np.array_equal(np.concatenate([part.ends for part in result]), batch.ends)
    assert np.array_equal(np.concatenate([part.rms for part in result], axis=-1), batch.rms)


@pytest.mark.parametrize(("size", "step"), few([(1000, 300), (100, 2000), (1000, 500), (1000, 1000), (999, 500)]))
def test_stream_and_batch_have_the_same_bits_at_the_real_sizes(size, step):
    x = np.random.default_rng(1).normal(size=(4, 8_000))
    batch = windowed_rms(x, size, step)
    for block in (1, 7, 500, 4096, 8_000):
        if block == 1 and size != 1000:
            continue
        stream = RmsStream(size, step)
        result = [stream.update(x[:, a : a + block]) for a in range(0, 8_000, block)]
        assert np.array_equal(np.concatenate([part.rms for part in result], axis=-1), batch.rms)
        assert np.array_equal(np.concatenate([part.ends for part in result]), batch.ends)


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


@settings(deadline=None, max_examples=8)
@given(block=st.integers(1, 3000), seed=st.integers(0, 2**32 - 1))
def test_the_live_chain_gives_the_windows_of_the_whole_recording(block, seed):
    x = 3e5 + 1e3 * np.random.default_rng(seed).normal(size=6000)
    stream = DetailStream()
    windows = RmsStream(skip=stream.settling, first=stream.first)
    products = RmsStream(skip=stream.settling, first=stream.first)
    result, found_products = [], []
    for start in range(0, x.size, block):
        live = stream.update(x[start : start + block])
        result.append(windows.update(live))
        found_products.append(products.update(live[2] * live[3]))
    batch = details(x)
    expected = windowed_rms(batch)
    assert np.array_equal(np.concatenate([part.ends for part in result]), expected.ends)
    np.testing.assert_allclose(np.concatenate([part.rms for part in result], axis=-1), expected.rms, rtol=1e-12)
    inside = batch.inside()
    expected = windowed_rms(batch.product()[inside], first=inside.start)
    assert np.array_equal(np.concatenate([part.ends for part in found_products]), expected.ends)
    np.testing.assert_allclose(np.concatenate([part.rms for part in found_products]), expected.rms, rtol=1e-12)


@pytest.mark.parametrize(("size", "step"), [(1000, 500), (60, 400)])
def test_a_saved_stream_goes_on_with_the_same_bits(size, step):
    x = np.random.default_rng(4).normal(size=5000)
    for cut in (0, 1, 130, 999, 1000, 2750):
        stream = RmsStream(size, step, skip=100)
        stream.update(x[:cut])
        state = stream.state_dict()
        as_text = json.loads(json.dumps({k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in state.items()}))
        restored, again, expected = RmsStream.from_state(state), RmsStream.from_state(as_text), stream.update(x[cut:])
        for other in (restored, again):
            result = other.update(x[cut:])
            assert np.array_equal(result.ends, expected.ends)
            assert np.array_equal(result.rms, expected.rms)
    assert np.array_equal(RmsStream.from_state(RmsStream().state_dict()).update(x).rms, windowed_rms(x).rms)


def test_a_value_that_is_not_finite_spoils_its_own_windows_only():
    x = np.ones(4000)
    x[2100] = np.nan
    with refusal("series", "nan", "sample 2100", "1 of 4000"):
        windowed_rms(x)
    ends, values = RmsStream().update(x)
    assert ends[np.isnan(values)].tolist() == [2500, 3000]
    assert np.all(values[~np.isnan(values)] == 1.0)


def test_rms_of_one_and_of_several_series():
    assert rms([3.0, -4.0, 0.0, 0.0]) == pytest.approx(2.5)
    assert isinstance(rms([1, 2]), float)
    np.testing.assert_allclose(rms([[1.0, 1.0], [2.0, -2.0]]), [1.0, 2.0])


def test_bad_input_is_one_clear_line():
    with refusal("size", "0"):
        windowed_rms(np.ones(10), 0, 1)
    with refusal("step", "2.5"):
        RmsStream(10, 2.5)
    with refusal("skip", "-1"):
        RmsStream(skip=-1)
    with refusal("series", "0"):
        rms([])
    with refusal("series"):
        rms([1.0, np.inf])
    stream = RmsStream(4, 2)
    stream.update(np.ones((2, 3)))
    with refusal("block", "(2,)", "()"):
        stream.update(np.ones(3))
    with refusal("number"):
        stream.update(1.0)
    with refusal("'size'"):
        RmsStream.from_state({})
    for wrong in ({"sums": None}, {"rest": 1.0, "sums": 2.0}, {"rest": [[1.0], [2.0, 3.0]]}):
        with refusal("axes"):
            RmsStream.from_state({**stream.state_dict(), **wrong})
