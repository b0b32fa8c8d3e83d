"""Motor angles of streams that begin anew after whole turns."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.live.joining import AngleUnwrapper

TURN = 2.0 * np.pi
DRAWS = range(24)


def turning(random: np.random.Generator, rate: float) -> np.ndarray:
    """Return the angle [rad] of a shaft that turns both ways, rests, and starts anywhere."""
    t = np.arange(round(20.0 * rate)) / rate
    top = TURN * random.uniform(2.0, 40.0)  # [rad/s]
    speed = top * np.sin(TURN * random.uniform(0.05, 0.3) * t + random.uniform(0.0, TURN))
    speed[(t > 9.0) & (t < 11.0)] = 0.0
    return random.uniform(-100.0, 100.0) + np.cumsum(speed) / rate


def in_pieces(values: np.ndarray, random: np.random.Generator) -> list[np.ndarray]:
    return np.split(values, np.sort(random.integers(0, values.size, 12)))


@pytest.mark.parametrize("seed", DRAWS)
def test_steps_are_those_of_the_shaft_however_the_samples_come(seed: int) -> None:
    random = np.random.default_rng(seed)
    angle = turning(random, rate := float(random.choice([100.0, 250.0, 1000.0])))
    period, low = TURN * random.choice([1, 1, 4, 16]), random.choice([0.0, -0.5])
    wrapped = np.mod(angle - low * period, period) + low * period
    wrapped[random.integers(0, angle.size, 20)] = np.nan
    whole, n_wraps = AngleUnwrapper().unwrap(wrapped)
    unwrapper, parts, n_parts = AngleUnwrapper(), [], 0
    for piece in in_pieces(wrapped, random):
        values, n = unwrapper.unwrap(piece)
        parts.append(values)
        n_parts += n
        saved = json.loads(json.dumps(unwrapper.state()))
        unwrapper = AngleUnwrapper()
        unwrapper.load_state(saved)
    assert np.array_equal(np.concatenate(parts), whole, equal_nan=True) and n_parts == n_wraps
    known = np.isfinite(whole)
    errors = np.diff(whole[known] - angle[known])
    wrong = np.flatnonzero(np.abs(errors) > 1e-9)
    # one wrap may pass before the angle's range is known, and the first two steps before its speed is
    assert wrong[wrong > 1].size <= 1, (seed, rate, period)
    assert n_wraps >= np.count_nonzero(np.abs(np.diff(wrapped[known])) > 0.5 * period) - 1


@pytest.mark.parametrize("seed", DRAWS)
def test_angles_that_count_on_stay_as_they_are(seed: int) -> None:
    random = np.random.default_rng(seed)
    angle = turning(random, float(random.choice([10.0, 50.0, 100.0, 1000.0])))
    result, n_wraps = AngleUnwrapper().unwrap(angle)
    assert n_wraps <= 1  # of a logger so slow that the shaft turns several times from sample to sample
    assert np.count_nonzero(np.abs(np.diff(result - angle)) > 1e-9) <= 1


def test_a_watch_of_a_wrapped_angle_gives_the_same_estimates() -> None:
    recording = ss.simulate(command="3 sin(4t)", duration="60 s", leak="0.0042 L/min from 40 s", seed=3)
    wrapped = replace(recording, channels={**recording.channels, "theta": np.mod(recording["theta"], TURN)})
    plain_watch, wrapped_watch = (ss.watch("thesis", learn_hours=0.005) for _ in range(2))
    expected, estimates = plain_watch.update(recording), wrapped_watch.update(wrapped)
    assert len(estimates) == len(expected) and any(estimate.judged for estimate in estimates)
    for estimate, other in zip(estimates, expected, strict=True):
        assert (estimate.status, estimate.judged) == (other.status, other.judged)
        assert (estimate.leak_lpm is None) == (other.leak_lpm is None)
        if estimate.leak_lpm is not None:
            assert estimate.leak_lpm == pytest.approx(other.leak_lpm, rel=1e-3, abs=1e-5)
    assert wrapped_watch.counters["wraps of the motor angle, undone"] > 10
    assert "wraps of the motor angle, undone" not in plain_watch.counters


@pytest.mark.parametrize("size", [1e9, 1e50, 1e300])
def test_impossible_angles_are_no_wraps(size: float) -> None:
    angles = np.array([0.1, size, 0.2, -size, np.inf, 0.3, size, 0.4])
    result, n_wraps = AngleUnwrapper().unwrap(angles)
    assert n_wraps == 0 and np.array_equal(result, angles)
