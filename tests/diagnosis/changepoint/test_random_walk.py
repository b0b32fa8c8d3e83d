"""The observer's step test: false alarms as asked for, drifts left alone, steps found with size and onset."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.changepoint.random_walk import find_leak_step
from sealscope.errors import InputError

P = 0.01


def _null_rate(make, count: int, probability: float, **options) -> float:  # type: ignore[no-untyped-def]
    alarms = 0
    for seed in range(count):
        random = np.random.default_rng(seed)
        g = make(random)
        alarms += find_leak_step(g, np.ones(g.size), probability, **options).alarm
    return alarms / count


def _walk(share: float):  # type: ignore[no-untyped-def]
    return lambda random: random.standard_normal(50) + np.cumsum(share * random.standard_normal(50))


@pytest.mark.parametrize("expected, true", [(0.03, 0.03), (3.0, 3.0), pytest.param(3.0, 0.3, marks=pytest.mark.slow)])
def test_false_alarms_are_those_asked_for(expected: float, true: float) -> None:
    """Walks as strong as expected, or weaker: 5 % of 120 is 6, and 14 or more would come three times in 1000."""
    rate = _null_rate(_walk(true**0.5), 120, 0.05, expected_walk=expected, wary=expected > 1.0)
    assert rate < 14 / 120


@pytest.mark.parametrize(
    "name, drift",
    [
        ("warm-up", lambda t, r: 8.0 * np.exp(-t / 10.0)),
        pytest.param("cooling", lambda t, r: -8.0 * np.exp(-t / 10.0), marks=pytest.mark.slow),
        ("even", lambda t, r: 0.2 * t),
        pytest.param(
            "wander of 60 s", lambda t, r: 4.0 * np.sin(2 * np.pi * t / 20.0 + 6.3 * r.random()), marks=pytest.mark.slow
        ),
        ("wander of 150 s", lambda t, r: 4.0 * np.sin(2 * np.pi * t / 50.0 + 6.3 * r.random())),
    ],
)
def test_smooth_drifts_are_no_steps(name: str, drift) -> None:  # type: ignore[no-untyped-def]
    t = np.arange(50.0)
    rate = _null_rate(lambda r: r.standard_normal(50) + drift(t, r), 200, 0.01, expected_walk=3.0, wary=True)
    assert rate <= 0.05, name


def test_a_step_is_found_with_its_size_and_onset() -> None:
    hits, covered, dated = 0, 0, 0
    for seed in range(60):
        random = np.random.default_rng(seed)
        g = _walk(0.17)(random) + 4.0 * np.clip(np.arange(1, 51) - 24.6, 0.0, 1.0)
        found = find_leak_step(g, np.ones(50), 0.01, 0.03)
        hits += found.alarm
        covered += abs(found.size - 4.0) < 2.0 * found.size_sd
        dated += found.onset_interval[0] <= 24.6 <= found.onset_interval[1]
    assert hits >= 57
    assert covered >= 52
    assert dated >= 52


def test_a_fall_is_no_leak() -> None:
    g = np.random.default_rng(1).standard_normal(50) - 8.0 * (np.arange(50) > 25)
    assert not find_leak_step(g, np.ones(50), 0.01, 0.03).alarm


def test_step_needs_blocks_and_finite_values() -> None:
    with pytest.raises(InputError, match="16 blocks"):
        find_leak_step(np.zeros(15), np.ones(15), 0.01, 1.0)
    with pytest.raises(InputError, match="finite"):
        find_leak_step(np.full(20, np.nan), np.ones(20), 0.01, 1.0)
