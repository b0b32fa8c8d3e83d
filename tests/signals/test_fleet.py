"""Many actuators at once: the single actuator's streams, over any split, saved and restored, in bounded memory."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.errors import InputError
from sealscope.signals.details import details
from sealscope.signals.streams import DetailStream, FleetRms
from sealscope.signals.windows import rms, windowed_rms


def pieces(x, cuts):
    ends = [*sorted(min(cut, x.shape[-1]) for cut in cuts), x.shape[-1]]
    return [x[..., a:b] for a, b in zip([0, *ends[:-1]], ends, strict=True)]


@pytest.mark.parametrize(("wavelet", "levels"), [("db8", 4), ("db8", 1), ("db3", 3), ("haar", 5)])
@pytest.mark.parametrize("actuators", [1, 8, 11])
def test_details_are_those_of_the_single_stream(wavelet, levels, actuators):
    x = 3.0 + np.random.default_rng(1).normal(size=(2, actuators, 1100))
    fleet = DetailStream((2, actuators), levels, wavelet=wavelet)
    found = fleet.update(x)
    for c in range(2):
        for a in range(actuators):
            assert np.array_equal(found[c, a], DetailStream(1, levels, wavelet=wavelet).update(x[c, a]))
    single = DetailStream(1, levels, wavelet=wavelet)
    assert (fleet.delay, fleet.first, fleet.settling) == (single.delay, single.first, single.settling)


@settings(deadline=None, max_examples=40)
@given(
    actuators=st.integers(1, 19),
    n=st.integers(1, 1500),
    cuts=st.lists(st.integers(0, 1500), max_size=25),
    window=st.sampled_from([(100, 50), (64, 64), (90, 60), (7, 3), (30, 100), (1, 1)]),
    threads=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_split_gives_the_same_bits(actuators, n, cuts, window, threads, seed):
    size, step = window
    x = np.random.default_rng(seed).normal(size=(2, actuators, n)) * 1e5
    whole, parts = DetailStream((2, actuators)), DetailStream((2, actuators), threads=threads)
    streamed = np.concatenate([parts.update(block) for block in pieces(x, cuts)], axis=-1)
    assert np.array_equal(streamed, whole.update(x))
    whole, parts = (FleetRms(actuators, size=size, step=step, threads=t) for t in (1, threads))
    expected = whole.update(x)
    found = [parts.update(block) for block in pieces(x, cuts)]
    assert np.array_equal(np.concatenate([one.ends for one in found]), expected.ends)
    assert np.array_equal(np.concatenate([one.rms for one in found]), expected.rms)


@pytest.mark.parametrize(("size", "step"), [(1000, 500), (90, 60), (50, 125), (64, 64)])
def test_windows_are_those_of_whole_recordings(size, step):
    x = 2.0 + np.random.default_rng(2).normal(size=(2, 9, 3100))
    fleet = FleetRms(9, size=size, step=step)
    found = fleet.update(x)
    assert fleet.quantities == ("d1", "d2", "d3", "d4", "d3d4", "signal")
    for c, a in ((0, 0), (1, 8)):
        one = details(x[c, a])
        expected = windowed_rms(one, size, step)
        assert np.array_equal(found.ends, expected.ends)
        np.testing.assert_allclose(found.rms[:, c, :4, a].T, expected.rms, rtol=1e-12)
        product = one.product()[one.inside()]
        np.testing.assert_allclose(found.rms[:, c, 4, a], windowed_rms(product, size, step).rms, rtol=1e-12)
        last = int(found.ends[-1])
        assert found.rms[-1, c, 5, a] == pytest.approx(rms(x[c, a, last - size : last]), rel=1e-12)


def test_a_missing_sample_spoils_its_own_windows_and_no_other():
    x = np.random.default_rng(3).normal(size=(2, 9, 2500))
    clean = FleetRms(9, size=100, step=50).update(x)
    x[1, 4, 1000] = np.nan
    holed = FleetRms(9, size=100, step=50).update(x)
    spoiled = np.isnan(holed.rms)
    assert np.array_equal(holed.rms[~spoiled], clean.rms[~spoiled])
    where = np.argwhere(spoiled.any(axis=2))
    assert {(c, a) for _, c, a in where.tolist()} == {(1, 4)}
    first, last = holed.ends[where[0, 0]] - 100, holed.ends[where[-1, 0]]
    assert 1000 - 120 - 100 < first <= 1000 <= last < 1000 + 105 + 100 + 50  # what d4 reads: 105 before, 120 after


def test_saved_and_restored_goes_on_with_the_same_bits():
    x = np.random.default_rng(4).normal(size=(2, 10, 2000))
    for cut in (0, 130, 777):
        whole = FleetRms(10, size=90, step=60)
        expected = [whole.update(x[..., :cut]), whole.update(x[..., cut:])][1]
        before = FleetRms(10, size=90, step=60)
        before.update(x[..., :cut])
        after = FleetRms(10, size=90, step=60)
        after.load_state(before.state_dict())
        found = after.update(x[..., cut:])
        assert np.array_equal(found.rms, expected.rms) and np.array_equal(found.ends, expected.ends)


def test_nothing_is_allocated_for_a_block():
    x = np.random.default_rng(5).normal(size=(2, 64, 500))
    stream = FleetRms(64)
    out = np.empty((1, 2, 6, 64))
    for _ in range(4):
        stream.update(x, out)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    for _ in range(50):
        stream.update(x, out)
    now, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak - before < 20_000 < x.nbytes / 20  # a few Python objects, no array of samples
    assert now - before < 5_000


@pytest.mark.parametrize(
    ("call", "rule"),
    [
        (lambda: FleetRms(0), "actuators must be a whole number >= 1"),
        (lambda: FleetRms(3, levels=1), "levels must be 2 or more"),
        (lambda: FleetRms(3, size=0), "size must be a whole number >= 1"),
        (lambda: FleetRms(3).update(np.zeros((2, 4, 5))), r"block must have shape \(2, 3, n\)"),
        (lambda: FleetRms(3).update(np.zeros((2, 3, 2000)), np.zeros((1, 2, 6, 3))), "out must be C-contiguous"),
        (lambda: FleetRms(3).load_state({}), "saved fleet must have 'size'"),
        (lambda: FleetRms(3).load_state(FleetRms(4).state_dict()), "opened must have shape"),
    ],
)
def test_bad_calls_name_the_rule(call, rule):
    with pytest.raises(InputError, match=rule):
        call()
