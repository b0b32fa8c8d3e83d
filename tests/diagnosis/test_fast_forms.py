"""Compiled or shared computations against the plain forms whose results they must have."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.ndimage import median_filter

from sealscope.diagnosis.estimate.change import WALKS, Information, step_test
from sealscope.diagnosis.inference.changes.healthy_levels import _octave_powers
from sealscope.diagnosis.inference.machine_states import AVERAGING_TIME, MIN_REST, extend_flags, find_rests
from sealscope.recordings.recording import Array, Recording


def plain_rests(increments: Array, rate: float, limit: float) -> Array:
    """Flag the samples of each run of `MIN_REST` at least in which every mean speed is at most the limit."""
    window, shortest = max(1, round(AVERAGING_TIME * rate)), max(2, round(MIN_REST * rate))
    is_moving = np.ones(len(increments), dtype=bool)
    for first in range(len(increments) - window + 1):
        part = increments[first : first + window]
        if np.isfinite(part).all() and abs(part.sum()) <= limit * window / rate:
            is_moving[first : first + window] = False
    rests = np.zeros(len(increments), dtype=bool)
    for first in range(len(increments) - shortest + 1):
        if not is_moving[first : first + shortest].any():
            rests[first : first + shortest] = True
    return rests


@pytest.mark.parametrize("seed", range(6))
def test_rests_are_those_of_each_window_by_itself(seed: int) -> None:
    random = np.random.default_rng(seed)
    n, rate = int(random.integers(5, 400)), float(random.choice([10.0, 50.0]))
    increments = np.repeat(random.choice([0.0, 1.0, -1.0], n // 5 + 1), 5)[:n] + 0.1 * random.standard_normal(n)
    increments[random.random(n) < 0.02] = np.nan
    limit = 0.4 * rate
    assert (find_rests(increments, rate, limit) == plain_rests(increments, rate, limit)).all()


@pytest.mark.parametrize("seed", range(4))
def test_flags_are_extended_as_each_by_itself(seed: int) -> None:
    random = np.random.default_rng(seed)
    starts, length = random.random(60) < 0.1, int(random.integers(1, 12))
    expected = np.zeros(len(starts) + length - 1, dtype=bool)
    for first in np.flatnonzero(starts):
        expected[first : first + length] = True
    assert (extend_flags(starts, length) == expected).all()


def test_windows_that_are_transformed_together_have_the_powers_of_each_by_itself() -> None:
    random, rate, length = np.random.default_rng(1), 50.0, 100
    pressures = 1e6 + 1e5 * random.standard_normal((2, 5000))
    pressures[0, 700] = pressures[1, 3210:3216] = np.nan
    channels = {"p_A": pressures[0], "p_B": pressures[1]}
    recording = Recording(np.arange(5000) / rate, channels, {"p_A": "Pa", "p_B": "Pa"}, rate)
    edges = 0.5 * np.exp2(np.arange(5.0))
    pairs = [("p_B", "p_A"), ("p_A", "p_B")]
    found = _octave_powers(recording, pairs, length, edges)["p_A", "p_B"]
    lines = np.searchsorted(np.fft.rfftfreq(length, 1.0 / rate), edges)
    expected = []
    for start in range(0, 5000 - length + 1, length // 2):
        window = np.stack([median_filter(values, 3, mode="nearest")[start : start + length] for values in pressures])
        if np.isfinite(window).all():
            A, B = (np.fft.rfft((values - values.mean()) * np.hanning(length)) for values in window)
            products = (np.abs(A) ** 2, np.abs(B) ** 2, A * B.conj())
            expected.append([[part[low:high].sum() for low, high in itertools.pairwise(lines)] for part in products])
    for k, values in enumerate(found):
        assert values == pytest.approx(np.array(expected)[:, k], rel=1e-9)


def test_a_step_test_does_not_depend_on_the_tests_before_it() -> None:
    """The matrices of a coefficient are kept for its further tests: another coefficient has others."""
    random, n = np.random.default_rng(2), 30
    coefficients = []
    for _ in range(3):
        root = random.standard_normal((n, n))
        precision = root @ root.T / n + np.eye(n)
        vector = precision @ (np.arange(n) > 15) + random.standard_normal(n)
        coefficients.append(Information(np.arange(n) + 0.5, precision, vector, walk=2.0))
    shape = np.linspace(1.0, 2.0, n)
    first = [step_test(coefficient, shape=chosen) for coefficient in coefficients for chosen in (None, shape)]
    again = [step_test(coefficient, shape=chosen) for coefficient in coefficients[::-1] for chosen in (shape, None)]
    for test, repeated in zip(first, again[::-1], strict=True):
        assert test is not None and repeated is not None
        assert (test.score, test.law, test.best) == (repeated.score, repeated.law, repeated.best)
    assert len({test.score for test in first if test is not None}) == len(first)


def test_the_length_of_a_curve_is_the_largest_of_the_allowed_walks() -> None:
    """White noise allows all small walks, whose curve is shorter than that of the largest one."""
    noise = np.random.default_rng(3).standard_normal(40)
    test = step_test(Information(np.arange(40) + 0.5, np.eye(40), noise))
    assert test is not None
    assert 10.0 < test.law.length < 60.0
    walk = np.cumsum(3.0 * np.random.default_rng(4).standard_normal(40))
    walking = step_test(Information(np.arange(40) + 0.5, np.eye(40), walk))
    assert walking is not None and walking.walk[0] > test.walk[0] and len(WALKS) == 30
    assert walking.law.length > test.law.length
