"""What is drawn: extremes survive decimation, gaps stay gaps, and the coding on the page gives the values back."""

from __future__ import annotations

from base64 import b64decode

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.reporting.series import choose_drawn_times, encode_times, encode_values

values_with_holes = st.lists(st.floats(-1e9, 1e9) | st.sampled_from([np.nan, np.inf]), min_size=1, max_size=400).map(
    np.array
)


def decoded(code):
    q = np.frombuffer(b64decode(code["q"]), dtype="<i2").astype(float)
    return np.where(q == -32768, np.nan, code["low"] + (q + 32767) * code["step"])


@settings(deadline=None)
@given(values_with_holes, st.integers(8, 60), st.none() | st.floats(0, 4), st.integers(0, 50))
def test_every_extreme_of_every_bucket_is_drawn(values, points, near, near_samples):
    t = np.arange(values.size) / 100
    base = choose_drawn_times(t, 100.0, points, near=near, near_samples=near_samples)
    drawn = base.reduce(values)
    assert drawn.shape == base.t.shape
    assert np.all(np.diff(base.t) >= 0)
    assert base.t[0] == t[0] and base.t[-1] == t[-1]
    position = 0
    for start, stop in zip(base.starts, base.stops, strict=True):
        bucket = values[start:stop][np.isfinite(values[start:stop])]
        size = 1 if stop - start == 1 else 2
        pair = drawn[position : position + size]
        position += size
        if bucket.size:
            assert np.nanmin(pair) == bucket.min() and np.nanmax(pair) == bucket.max()
        else:
            assert np.all(np.isnan(pair))
    assert position == drawn.size


def test_a_single_spike_survives_whatever_the_decimation():
    for place in (0, 1, 4999, 7777, 99_999):
        values = np.zeros(100_000)
        values[place] = 1.0
        base = choose_drawn_times(np.arange(values.size) / 500, 500.0, 300)
        drawn = base.reduce(values)
        assert drawn.size <= 400
        assert drawn.max() == 1.0
        assert abs(base.t[int(np.argmax(drawn))] - place / 500) <= base.width / 500


def test_a_rising_line_is_drawn_rising_and_a_falling_one_falling():
    line = np.linspace(0, 1, 10_000)
    base = choose_drawn_times(line, 1e4, 200)
    assert np.all(np.diff(base.reduce(line)) >= 0)
    assert np.all(np.diff(base.reduce(-line)) <= 0)


def test_no_more_points_than_asked_and_all_samples_near_the_chosen_time():
    t = np.arange(90_000) / 500
    base = choose_drawn_times(t, 500.0, 16_000, near=91.0, near_samples=6_000)
    assert base.t.size <= 16_000 + 6_000
    assert set(t[(t > 86) & (t < 96)]) <= set(base.t)


def test_a_gap_in_time_breaks_the_line_when_decimated_and_when_not():
    for n in (100, 50_000):
        t = np.arange(n) / 500
        t[n // 2 :] += 30
        base = choose_drawn_times(t, 500.0, 1000)
        drawn = base.reduce(np.ones(n))
        (hole,) = np.flatnonzero(np.isnan(drawn))
        assert base.t[hole] == t[n // 2 - 1]
        assert base.t[hole + 1] - base.t[hole] > 30


def test_thousands_of_gaps_do_not_swell_the_drawing():
    t = np.cumsum(np.tile([0.002, 0.1], 20_000))
    assert choose_drawn_times(t, 500.0, 1000).t.size < 1300


def test_time_out_of_order_falls_back_to_the_samples_number():
    t = np.array([0.0, 1.0, 0.5, 2.0])
    base = choose_drawn_times(t, 2.0, 100)
    assert base.by_sample
    assert base.t.tolist() == [0.0, 0.5, 1.0, 1.5]


@settings(deadline=None)
@given(values_with_holes)
def test_coded_values_are_decoded_to_half_a_step_and_holes_to_holes(values):
    decoded_values = decoded(encode_values(values))
    finite = np.isfinite(values)
    assert np.array_equal(np.isnan(decoded_values), ~finite)
    if finite.any():
        step = np.ptp(values[finite]) / 65534  # of 16 bits
        rounding = 1e-6 * np.abs(values[finite]) + np.finfo(float).tiny
        assert np.all(np.abs(decoded_values[finite] - values[finite]) <= 0.51 * step + rounding)


def test_times_are_coded_exactly():
    t = np.array([0.0, 0.1, 1 / 3, 1e6 + 1e-9])
    assert np.frombuffer(b64decode(encode_times(t)), dtype="<f8").tolist() == t.tolist()
