"""The streaming twin: its kernel against plain loops, against the batch, over any split, saved and restored."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.errors import InputError
from sealscope.signals.details import details
from sealscope.signals.filters import decomposition_filters
from sealscope.signals.streams import DetailStream

from ..refusals import refusal


def slow_stream(x, levels, wavelet="db8"):
    """The causal a trous filters on a signal that was zero before, plain loops, every level late to the deepest one."""
    low, high = decomposition_filters(wavelet)
    taps, n = low.size, len(x)
    a, rows = [float(value) for value in x], []
    for j in range(levels):
        hole, late = 2**j, taps // 2 * (2**levels - 2 ** (j + 1))
        d, coarser = [0.0] * n, [0.0] * n
        for i in range(n):
            for k in range(taps):
                if i - k * hole >= 0:
                    d[i] += high[k] * a[i - k * hole]
                    coarser[i] += low[k] * a[i - k * hole]
        rows.append([0.0] * late + d[: n - late])
        a = coarser
    return np.array(rows)


def split(x, cuts):
    """`x` cut at the given sample numbers along its last axis."""
    ends = [*sorted(min(cut, x.shape[-1]) for cut in cuts), x.shape[-1]]
    return [x[..., start:end] for start, end in zip([0, *ends[:-1]], ends, strict=True)]


@pytest.mark.parametrize(("wavelet", "levels"), [("db8", 4), ("db8", 1), ("db3", 3), ("haar", 5), ("db7", 2)])
def test_kernel_is_the_plain_loops(wavelet, levels):
    """To rounding: products and sums may be contracted to fused multiply-adds."""
    x = np.random.default_rng(1).normal(size=1500)  # longer than a buffer, so that it wraps
    result = DetailStream(1, levels, wavelet=wavelet).update(x)
    np.testing.assert_allclose(result, slow_stream(x, levels, wavelet), rtol=0.0, atol=2e-14)


@settings(deadline=None, max_examples=60)
@given(
    n=st.integers(226, 3000),
    cuts=st.lists(st.integers(0, 3000), max_size=40),
    levels=st.integers(1, 5),
    scale=st.floats(1e-3, 1e6),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_split_equals_the_batch_away_from_the_edges(n, cuts, levels, scale, seed):
    stream = DetailStream(1, levels)
    x = np.random.default_rng(seed).normal(loc=3.0, size=max(n, stream.settling + 1)) * scale
    streamed = np.concatenate([stream.update(block) for block in split(x, cuts)], axis=-1)
    whole = DetailStream(1, levels).update(x)
    assert np.array_equal(streamed, whole)
    assert stream.samples == x.size

    batch = details(x, levels=levels)
    inside = batch.inside()
    assert (inside.start, x.size - inside.stop) == (stream.first, stream.delay)
    expected = batch.values[:, inside]
    assert np.abs(whole[:, stream.settling :] - expected).max() <= 1e-12 * np.abs(x).max()


def test_one_sample_at_a_time_and_empty_blocks():
    x = np.random.default_rng(2).normal(size=1300)
    stream = DetailStream()
    columns = []
    for value in x:
        columns.append(stream.update([value]))
        assert stream.update([]).shape == (4, 0)
    assert np.array_equal(np.concatenate(columns, axis=-1), DetailStream().update(x))


def test_channels_do_not_touch_each_other():
    x = np.random.default_rng(3).normal(size=(7, 1500))
    together = DetailStream(7)
    result = np.concatenate([together.update(block) for block in split(x, [1, 2, 500, 501, 1200])], axis=-1)
    for channel in range(7):
        assert np.array_equal(result[channel], DetailStream().update(x[channel]))
    assert together.update(np.empty((7, 0))).shape == (7, 4, 0)
    assert DetailStream(1).update(x[:1]).shape == (1, 4, 1500)


def test_any_kind_of_array_is_a_block():
    x = np.random.default_rng(4).normal(size=(800, 3))
    expected = DetailStream(3).update(np.ascontiguousarray(x.T))
    assert np.array_equal(DetailStream(3).update(x.T), expected)
    frozen = np.ascontiguousarray(x.T)
    frozen.setflags(write=False)
    assert np.array_equal(DetailStream(3).update(frozen), expected)
    assert frozen.flags.writeable is False
    counts = np.arange(300, dtype=np.int16)
    assert np.array_equal(DetailStream().update(counts), DetailStream().update(counts.astype(float)))
    mine = np.zeros(10)
    DetailStream().update(mine)
    assert mine.flags.writeable


def test_out_is_filled_and_nothing_else_is_allocated():
    x = np.random.default_rng(5).normal(size=(2, 50_000))
    stream, out = DetailStream(2), np.empty((2, 4, 50_000))
    stream.update(x[:, :10])
    tracemalloc.start()
    try:
        returned = stream.update(x, out=out)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert returned is out
    assert peak < 20_000
    again = DetailStream(2)
    again.update(x[:, :10])
    assert np.array_equal(again.update(x), out)


@settings(deadline=None, max_examples=25)
@given(cut=st.integers(0, 2000), levels=st.integers(1, 4), seed=st.integers(0, 2**32 - 1))
def test_a_saved_stream_goes_on_with_the_same_bits(cut, levels, seed):
    x = np.random.default_rng(seed).normal(size=(2, 2000))
    stream = DetailStream(2, levels)
    stream.update(x[:, :cut])
    state = stream.state_dict()
    restored = DetailStream.from_state(state)
    expected = stream.update(x[:, cut:])
    assert np.array_equal(restored.update(x[:, cut:]), expected)  # and the saved state was a copy
    assert restored.samples == stream.samples == 2000


def test_a_missing_sample_is_forgotten():
    x = np.random.default_rng(6).normal(size=2000)
    holed = x.copy()
    holed[900] = np.nan
    stream = DetailStream()
    result, whole = stream.update(holed), DetailStream().update(x)
    spoiled = np.flatnonzero(np.isnan(result).any(axis=0))
    assert spoiled[0] >= 900
    assert spoiled[-1] == 900 + stream.settling
    clean = np.r_[0:900, 900 + stream.settling + 1 : 2000]
    assert np.array_equal(result[:, clean], whole[:, clean])


def test_bad_calls_are_one_clear_line():
    with refusal("channels", "0"):
        DetailStream(0)
    with refusal("levels"):
        DetailStream(1, 0)
    with refusal("db8"):
        DetailStream(wavelet="db8x")
    with refusal("block", "(5,)"):
        DetailStream(2).update(np.zeros(5))
    with refusal("block", "(3, 5)"):
        DetailStream(2).update(np.zeros((3, 5)))
    with refusal("block", "()"):
        DetailStream().update(1.0)
    with refusal("out", "(4, 5)", "(4, 6)"):
        DetailStream().update(np.zeros(5), out=np.empty((4, 6)))
    with refusal("out"):
        DetailStream().update(np.zeros(5), out=np.empty((5, 4)).T)
    state = DetailStream().state_dict()
    with refusal("'history'"):
        DetailStream.from_state({key: value for key, value in state.items() if key != "history"})
    with refusal("history", "(1, 4, 126, 1)"):
        DetailStream.from_state({**state, "history": state["history"][:, :, 1:]})
    with refusal("samples", "'many'"):
        DetailStream.from_state({**state, "samples": "many"})
    with refusal("list"):
        DetailStream.from_state([1, 2])
    with refusal("table"):
        DetailStream((2, 3, 4))


def test_a_refused_block_leaves_the_stream_as_it_was():
    x = np.random.default_rng(7).normal(size=(2, 600))
    stream = DetailStream(2)
    stream.update(x[:, :300])
    with pytest.raises(InputError):
        stream.update(np.zeros((3, 10)))
    assert np.array_equal(stream.update(x[:, 300:]), DetailStream(2).update(x)[..., 300:])
