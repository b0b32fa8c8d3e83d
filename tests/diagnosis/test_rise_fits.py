"""Size of a leak that the comparison with healthy recordings shows, if it began or grew within the recording."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sealscope.diagnosis.estimate.change import Information, step_test
from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.inference.equations.terms import LEAK, ORIFICE
from sealscope.diagnosis.inference.leak_flow import RiseFits, find_leak_step, fit_rise
from sealscope.recordings.recording import Array

K, BLOCK_S, PRESSURE = 60, 2.0, 5e6
TIME = BLOCK_S * (np.arange(K) + 0.5)
ONSET, END = 60.0, BLOCK_S * K
#: A press tells most in the first half of a recording, a plain machine as much in each block.
PRESS, PLAIN = np.where(TIME < ONSET, 25.0, 1.0), np.ones(K)
#: A leak that grows from nothing, and one that is older than the recording, with a mean flow of 1 since the onset.
GROWING, OLDER = 2.0 * np.clip((TIME - ONSET) / (END - ONSET), 0.0, None), np.ones(K)


class ConstantPressure(SimpleNamespace):
    """Blocks of a machine with a constant p_A - p_B, whose leak and orifice have the same conductance."""

    pressure_weights = np.ones(K)
    gram = np.tile([[1.0, PRESSURE**-0.5], [PRESSURE**-0.5, 1.0 / PRESSURE]], (K, 1, 1, 1))

    def __len__(self) -> int:
        return K

    def mean_pressure(self) -> Array:
        return np.where(self.pressed, PRESSURE, 0.0)

    def mean_root(self) -> Array:
        return np.where(self.pressed, PRESSURE**0.5, 0.0)


def fit(
    course: Array, weights: Array, seed: int, shift: float = 0.0, max_flow: float = 50.0, unpressed: int = 0
) -> RiseFits:
    """Fit a leak whose flow is `course`, over a healthy level of 3, with `weights` as the information of each block.

    `shift` is an error of the rise that the healthy recordings do not predict, `unpressed` the number of last blocks
    in which the pressures are equal.
    """
    blocks: Any = ConstantPressure(pressed=np.arange(K) < K - unpressed)
    columns: Any = [SimpleNamespace(leak=0, names=(LEAK, ORIFICE))]
    unit, deviation = 1.0 / PRESSURE, 0.05  # conductance of a flow of 1; error of the rise
    precision = weights / weights.mean() / (0.15 * unit) ** 2
    random = np.random.default_rng(seed)
    estimates = unit * (3.0 + course) + random.standard_normal(K) / np.sqrt(precision)
    scale = 0.3 * unit
    leak = Information(TIME, np.diag(precision), precision * estimates, slope=scale, walk=scale)
    rise = float(weights @ course / weights.sum()) + deviation * random.standard_normal() + shift
    laws = [(PRESSURE, float(np.log(prior))) for prior in (0.5, 0.25, 0.25)]
    test = find_leak_step(blocks, columns, leak)
    return fit_rise(
        blocks, columns, leak, weights / weights.sum(), test, Estimate(rise * unit, deviation * unit), laws, max_flow
    )


@pytest.mark.parametrize("weights", [PRESS, PLAIN])
@pytest.mark.parametrize("course", [GROWING, (TIME > ONSET).astype(float), OLDER])
def test_the_interval_contains_the_mean_flow_since_the_onset(course: Array, weights: Array) -> None:
    """A press whose leak grew to 2 L/min was stated with the mean of its informative half, in which nothing leaks."""
    flows = [fit(course, weights, seed).flow for seed in range(24)]
    assert sum(abs(flow.value - 1.0) < 1.96 * flow.deviation for flow in flows) >= 20
    assert np.median([flow.deviation for flow in flows]) < 0.3


@pytest.mark.parametrize("course", [GROWING, (TIME > ONSET).astype(float), OLDER])
def test_the_bound_is_above_the_mean_flow_over_the_recording(course: Array) -> None:
    bounds = [fit(course, PRESS, seed).bound for seed in range(24)]
    assert sum(bound > course.mean() for bound in bounds) >= 21


def test_without_a_leak_the_bound_is_none_of_a_leak_at_the_very_end() -> None:
    """The blocks hardly exclude a large leak in the last of them; no leak at all is more probable."""
    bounds = [fit(np.zeros(K), PLAIN, seed).bound for seed in range(24)]
    assert max(bounds) < 0.3


def test_the_course_tells_an_older_leak_from_one_that_began_within() -> None:
    def older(course: Array) -> float:
        """Compute the probability of a leak that is older than the recording."""
        fits = fit(course, PLAIN, seed=1)
        weights = np.exp(fits.log_weights - fits.log_weights.max())
        return float(weights[np.isneginf(fits.onsets)].sum() / weights.sum())

    assert older(OLDER) > 0.9
    assert older(GROWING) < 0.1


def test_a_step_is_measured_by_the_rise_as_well() -> None:
    """Given an onset within, the rise over healthy recordings makes the size more precise than the step alone."""
    step = (TIME > ONSET).astype(float)
    flows = [fit(step, PLAIN, seed).flow_within for seed in range(24)]
    assert all(flow is not None for flow in flows)
    errors = np.array([flow.value - 1.0 for flow in flows if flow is not None])
    assert np.sqrt((errors**2).mean()) < 0.15
    assert fit(OLDER, PRESS, seed=1)._replace(onsets=np.array([-np.inf])).flow_within is None


def test_a_clear_step_outweighs_a_rise_that_contradicts_it() -> None:
    """A day like none of the healthy ones: the rise is of the other sign, and the step alone tells the size."""
    flow = fit((TIME > ONSET).astype(float), PLAIN, seed=1, shift=-2.0).flow_within
    assert flow is not None
    assert flow.value == pytest.approx(1.0, abs=0.2)


def test_a_leak_larger_than_the_flow_of_the_pump_is_excluded() -> None:
    fits = fit(OLDER, PLAIN, seed=1, max_flow=0.9)
    is_possible = np.isfinite(fits.log_weights)
    assert is_possible[0] and not is_possible[1:].all()
    assert (np.abs(fits.flows[1:][is_possible[1:]]) <= 0.9).all()
    assert fits.flow.value == pytest.approx(1.0, rel=0.1)  # the rise is what it is


@pytest.mark.parametrize("size", [20.0, 40.0])
def test_an_older_leak_of_much_of_the_flow_is_no_small_one(size: float) -> None:
    """Such a rise is improbable by the prior on leaks, but it is what the healthy recordings show."""
    assert fit(size * OLDER, PLAIN, seed=1).flow.value == pytest.approx(size, rel=0.05)


def test_blocks_without_a_pressure_give_no_size_that_is_not_a_number() -> None:
    fits = fit(GROWING, PLAIN, seed=1, unpressed=5)
    assert np.isfinite([*fits.flow, fits.bound]).all()
    assert fits.flow_within is not None
    assert np.isfinite(fits.flow_within).all()


def healthy_draw(pressure: Array, seed: int, walk: float = 0.0) -> tuple[Any, Any, Information]:
    """Draw blocks of a healthy leak under these pressures (K,), whose conductance wanders by `walk` errors of its mean.

    Returns the blocks, the columns of leak and orifice, and the likelihood of the conductance.
    """
    random = np.random.default_rng(seed)
    unit_flows = np.stack([pressure, pressure**0.5], axis=1)
    blocks: Any = SimpleNamespace(gram=(unit_flows[:, :, None] * unit_flows[:, None])[:, None])
    columns: Any = [SimpleNamespace(leak=0, names=(LEAK, ORIFICE))]
    precision = pressure**2
    drift = walk * np.cumsum(random.standard_normal(pressure.size)) / np.sqrt(pressure.size * precision.mean())
    vector = precision * drift + np.sqrt(precision) * random.standard_normal(pressure.size)
    return blocks, columns, Information(BLOCK_S * (np.arange(pressure.size) + 0.5), np.diag(precision), vector)


def test_laws_that_a_constant_pressure_does_not_tell_apart_share_no_false_alarms() -> None:
    blocks, columns, leak = healthy_draw(np.ones(K), seed=1)
    leak = leak._replace(vector=leak.vector + leak.precision @ np.where(TIME > ONSET, 1.8, 0.0))  # as of a small leak
    laminar, joint = step_test(leak), find_leak_step(blocks, columns, leak)
    assert laminar is not None and joint is not None
    assert laminar.chance < 0.1
    assert joint.chance == pytest.approx(laminar.chance, rel=1e-6)


def test_a_leak_whose_chance_is_too_small_for_a_float_is_found_all_the_same() -> None:
    blocks, columns, leak = healthy_draw(np.ones(1200), seed=1)
    leak = leak._replace(vector=leak.vector + leak.precision @ np.where(leak.time > leak.time.mean(), 100.0, 0.0))
    joint = find_leak_step(blocks, columns, leak)
    assert joint is not None
    assert joint.chance == 0.0
    assert joint.threshold(0.01) < joint.score


@pytest.mark.slow
def test_the_joint_chance_of_all_laws_is_as_rare_as_it_says() -> None:
    """Under pressures that differ by a factor of two or more, beside none, some and much drift."""
    tests = []
    for seed in range(900):
        spread, walk = ((0.3, 0.0), (0.7, 3.0), (1.0, 3.0))[seed % 3]
        pressure = np.exp(spread * np.random.default_rng([seed, 1]).standard_normal(40))
        tests.append(find_leak_step(*healthy_draw(pressure, seed, walk)))
    chances = np.array([test.chance for test in tests if test is not None])
    assert np.mean(chances < 0.01) < 0.02
    assert np.mean(chances < 0.05) < 0.06
