"""A step in a drifting series: against a slow oracle, under drifts that the model does not know, and its intervals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.special import bdtr, bdtrc

from sealscope.diagnosis.changepoint.shapes import rises
from sealscope.diagnosis.changepoint.smooth_drift import QUIET_STRENGTHS, DriftFamily, find_step
from sealscope.errors import InputError

N = 57
T = 3.0 * (np.arange(N) + 0.5)
ONES = np.ones(N)
Drift = Callable[[np.random.Generator, np.ndarray], np.ndarray]


def ranged(y: np.ndarray) -> np.ndarray:
    return y / np.ptp(y)


def wander(random: np.random.Generator, t: np.ndarray) -> np.ndarray:
    k = np.arange(6) + 0.5
    return ranged(np.sin(np.pi * np.outer(t / t[-1], k)) @ (random.standard_normal(6) / k))


#: Smooth drifts of height one; only the second is of the family that the search assumes.
DRIFTS: dict[str, Drift] = {
    "none": lambda random, t: np.zeros_like(t),
    "random walk": lambda random, t: ranged(np.cumsum(random.standard_normal(t.size))),
    "wander": wander,
    "warm-up": lambda random, t: random.choice([-1, 1]) * np.exp(-t / random.uniform(5.0, 90.0)),
    "swing": lambda random, t: 0.5 * np.sin(2 * np.pi * t / random.uniform(30.0, 180.0) + random.uniform(0, 6.3)),
    "even": lambda random, t: random.choice([-1, 1]) * t / t[-1],
}


def twice_integrated(t: np.ndarray, span: float) -> np.ndarray:
    """Covariance of a walk integrated twice, by summing its steps; its curvature has walked for `span` before."""
    dt = 0.002
    when = np.arange(0.5 * dt, t[-1], dt)
    reached = 0.5 * np.maximum(t[:, None] - when, 0.0) ** 2
    return np.asarray(dt * reached @ reached.T + span * np.outer(t**2, t**2) / 4.0)


@pytest.mark.parametrize("length", [1.0, 2.0])
@pytest.mark.parametrize("number", [0, 3, 12, 20, 31, 35])
def test_scores_are_likelihood_ratios(number: int, length: float) -> None:
    """One strength of drift against generalised least squares written out, determinant and all."""
    n = 20
    t = np.arange(n) + np.where(np.arange(n) > 11, 2.0, 0.0)
    random = np.random.default_rng(number)
    sd = random.uniform(0.5, 2.0, n)
    sd /= np.median(sd)
    walk, slope, bend = QUIET_STRENGTHS[number]
    low, high = np.minimum.outer(t, t), np.maximum.outer(t, t)
    covariance = np.diag(sd**2) + walk * low + slope * low**2 * (3 * high - low) / 6
    covariance += bend * twice_integrated(t, t[-1])
    inverse = np.linalg.inv(covariance)
    fixed = np.stack([np.ones(n), t], axis=1)
    if length > 1.0:  # blocks that overlap: every other one has an offset and a slope of its own
        fixed = np.concatenate([fixed, fixed * ((-1.0) ** t)[:, None]], axis=1)
    y = random.standard_normal(n) + 3.0 * (t > 9)

    def squares(columns: np.ndarray) -> float:
        found = np.linalg.solve(columns.T @ inverse @ columns, columns.T @ inverse @ y)
        rest = y - columns @ found
        return float(rest @ inverse @ rest)

    family = DriftFamily(t, sd, np.zeros((n, 1)), quiet=True, length=length)
    one = family.drifts[number]
    plain = squares(fixed)
    assert np.sum((one.whiten @ y) ** 2) == pytest.approx(plain, rel=1e-5 if bend else 1e-9)
    for k in (0, family.onsets.size // 2):
        with_step = squares(np.column_stack([fixed, family.shapes[k]]))
        assert plain - (one.steps[k] @ y) ** 2 == pytest.approx(with_step, rel=1e-5 if bend else 1e-9)
    pulse = squares(np.column_stack([fixed, np.eye(n)[7]]))
    assert plain - (one.pulses[7] @ y) ** 2 == pytest.approx(pulse, rel=1e-5 if bend else 1e-9)

    def log_weight(covariance: np.ndarray) -> float:
        scaled = fixed / np.tile([1.0, t[-1]], fixed.shape[1] // 2)
        inner = scaled.T @ np.linalg.inv(covariance) @ scaled
        return float(np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(inner)[1])

    rest = np.log(one.weight / family.drifts[0].weight) * family.freedom
    weight = log_weight(covariance) - log_weight(np.diag(sd**2))
    assert rest == pytest.approx(weight, rel=1e-5 if bend else 1e-9, abs=1e-9)


def test_interventions_share_the_block_they_begin_in() -> None:
    t = np.arange(5.0)
    assert rises(t, np.array([1.75]), 0.0)[0] == pytest.approx([0, 0, 0.75, 1, 1])
    assert rises(t, np.array([1.0]), 2.0)[0] == pytest.approx([0, 0, 0.5, 1, 1])


def test_finds_a_step_in_a_wander() -> None:
    random = np.random.default_rng(1)
    g = 12.0 * wander(random, T) + 10.0 * (T > 90) + random.standard_normal(N)
    found = find_step(T, g, ONES, 0.01, sign=1)
    assert found.alarm
    assert found.onset == pytest.approx(90.0, abs=1.6)
    assert found.onset_interval[0] <= 90.0 <= found.onset_interval[1]
    assert found.onset_interval[1] - found.onset_interval[0] < 20.0
    assert abs(found.size - 10.0) < 3.0 * found.size_sd
    assert found.rise == 0.0
    assert found.level.shape == (N,)


def test_finds_a_growth_and_says_how_long_it_took() -> None:
    random = np.random.default_rng(2)
    t = 3.0 * (np.arange(90) + 0.5)
    g = 20.0 * np.clip((t - 100.0) / 27.0, 0.0, 1.0) + random.standard_normal(t.size)
    found = find_step(t, g, np.ones(t.size), 0.01, sign=1)
    assert found.alarm
    assert found.rise == pytest.approx(27.0, rel=0.2)
    assert found.onset == pytest.approx(100.0, abs=8.0)
    assert found.size == pytest.approx(20.0, abs=4.0)


@pytest.mark.parametrize("name", DRIFTS)
@pytest.mark.parametrize("height", [pytest.param(4.0, marks=pytest.mark.slow), 12.0])
def test_false_alarms_do_not_depend_on_the_drift(name: str, height: float) -> None:
    """At 5 %, of 150 series without a step: no more than chance allows once in 10 000 such tests."""
    random = np.random.default_rng(3)
    alarms = sum(
        find_step(T, height * DRIFTS[name](random, T) + random.standard_normal(N), ONES, 0.05, sign=1).alarm
        for _ in range(150)
    )
    assert bdtrc(alarms - 1, 150, 0.05) > 1e-4 if alarms else True


def test_threshold_is_not_needlessly_high() -> None:
    random = np.random.default_rng(4)
    alarms = sum(find_step(T, random.standard_normal(N), ONES, 0.2, sign=1).alarm for _ in range(200))
    assert bdtr(alarms, 200, 0.2) > 1e-4
    assert bdtrc(alarms - 1, 200, 0.2) > 1e-4


def test_power_and_interval_of_the_height() -> None:
    """Steps of eight noise deviations in a wander as high: most are found (131 of these), 95 % intervals cover."""
    random = np.random.default_rng(5)
    hits = covered = near = 0
    for _ in range(150):
        g = 8.0 * wander(random, T) + 8.0 * np.clip((T + 1.5 - 88.0) / 3.0, 0, 1) + random.standard_normal(N)
        found = find_step(T, g, ONES, 0.01, sign=1)
        hits += found.alarm
        covered += abs(found.size - 8.0) < 2.0 * found.size_sd
        near += found.onset_interval[0] <= 88.0 <= found.onset_interval[1]
    assert hits >= 118
    assert bdtr(covered, 150, 0.95) > 1e-3
    assert bdtr(near, 150, 0.95) > 1e-3


def test_a_fall_is_no_rise() -> None:
    g = np.random.default_rng(6).standard_normal(N) - 15.0 * (T > 60)
    assert not find_step(T, g, ONES, 0.05, sign=1).alarm
    fall = find_step(T, g, ONES, 0.01, sign=-1)
    assert fall.alarm
    assert fall.size < 0


def test_one_wild_block_is_no_step() -> None:
    g = np.random.default_rng(7).standard_normal(N)
    g[30] += 40.0
    found = find_step(T, g, ONES, 0.01, sign=1)
    assert not found.alarm


def test_units_and_clock_do_not_matter() -> None:
    g = np.random.default_rng(8).standard_normal(N) + 6.0 * (T > 80)
    one = find_step(T, g, ONES, 0.01)
    other = find_step(T + 1e4, 1e-13 * g + 5e-13, 1e-13 * ONES, 0.01)
    assert other.score == pytest.approx(one.score, rel=1e-6)
    assert other.threshold == pytest.approx(one.threshold, rel=1e-6)
    assert other.onset == pytest.approx(one.onset + 1e4, abs=1e-6)
    assert other.size == pytest.approx(1e-13 * one.size, rel=1e-6)


def test_the_scale_of_the_deviations_is_found_anew() -> None:
    g = np.random.default_rng(9).standard_normal(N)
    one, other = find_step(T, g, ONES, 0.01), find_step(T, g, 10.0 * ONES, 0.01)
    assert other.score == pytest.approx(one.score, rel=1e-9)
    assert other.noise == pytest.approx(0.1 * one.noise, rel=1e-9)


def test_an_error_that_blocks_share_is_not_taken_for_a_step() -> None:
    """The duty changes at 90 s, and with it what an error of the geometry adds to each block."""
    random = np.random.default_rng(10)
    pattern = np.where(T > 90, 8.0, 0.0)[:, None]
    g = random.standard_normal(N) + pattern[:, 0] * 1.2
    assert find_step(T, g, ONES, 0.01).alarm
    assert not find_step(T, g, ONES, 0.01, shared=pattern).alarm


def test_gaps_between_blocks_are_allowed() -> None:
    random = np.random.default_rng(12)
    keep = np.r_[0:20, 26:57]
    g = random.standard_normal(N) + 9.0 * (T > 120)
    found = find_step(T[keep], g[keep], ONES[keep], 0.01, sign=1)
    assert found.alarm
    assert found.onset == pytest.approx(120.0, abs=3.0)


def test_a_smaller_probability_asks_for_more() -> None:
    g = np.random.default_rng(13).standard_normal(N)
    thresholds = [find_step(T, g, ONES, p).threshold for p in (0.2, 0.05, 0.01, 1e-4)]
    assert thresholds == sorted(thresholds)
    assert len(set(thresholds)) == 4


@pytest.mark.parametrize(
    "t, g, sd, told",
    [
        (T[:10], ONES[:10], ONES[:10], "16 blocks or more"),
        (T, ONES[:50], ONES, "one shape"),
        (T, np.where(T > 50, np.nan, 1.0), ONES, "finite"),
        (T[::-1], ONES, ONES, "rise"),
        (T, ONES, 0.0 * ONES, "> 0"),
    ],
)
def test_what_makes_no_sense_is_told(t: np.ndarray, g: np.ndarray, sd: np.ndarray, told: str) -> None:
    with pytest.raises(InputError, match=told):
        find_step(t, g, sd, 0.01)


def overlapping(random: np.random.Generator, height: float, step: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Means over 39 blocks of 6 s, each half a block after the other, of a drift 300 times their noise, and a step."""
    t = 3.0 * (np.arange(39) + 1.0)
    fine = np.arange(0.0, 120.0, 0.05)
    course = height * wander(random, fine) + step * (fine > 60.0)
    sums = np.concatenate([[0.0], np.cumsum(course)])
    first, last = (np.searchsorted(fine, t + side * 3.0 - 1e-9) for side in (-1, 1))
    g = (sums[last] - sums[first]) / (last - first) + random.standard_normal(t.size)
    return t, g + 40.0 * (-1.0) ** np.arange(39)


def test_a_step_far_below_a_smooth_drift_is_found_in_blocks_that_overlap() -> None:
    random = np.random.default_rng(8)
    series = [overlapping(random, 300.0, 30.0) for _ in range(40)]
    found = [find_step(t, g, np.ones(39), 0.01, quiet=True, halves=True) for t, g in series]
    assert sum(step.alarm for step in found) >= 28
    seen = [step for step in found if step.alarm]
    assert np.median([abs(step.onset - 60.0) for step in seen]) < 2.0
    assert np.median([step.size for step in seen]) == pytest.approx(30.0, abs=5.0)
    assert sum(abs(step.size - 30.0) < step.quantile * step.size_sd for step in seen) >= 0.8 * len(seen)


def test_a_smooth_drift_alone_is_none() -> None:
    random = np.random.default_rng(9)
    alarms = sum(
        find_step(*overlapping(random, 300.0), np.ones(39), 0.05, quiet=True, halves=True).alarm for _ in range(100)
    )
    assert bdtrc(alarms - 1, 100, 0.05) > 1e-4 if alarms else True
