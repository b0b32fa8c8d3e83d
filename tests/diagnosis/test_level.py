"""The level of a recording against a baseline: the stated false-alarm probability with few recordings and many."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm, t

from sealscope.diagnosis.baseline.level import DayToDay, Level, against_baseline, rise_of, share_of_each
from sealscope.diagnosis.verdict.evidence import Evidence

PRIOR = DayToDay(1.0, 4.0)
COUNTS = (1, 3, 10)
PROBABILITIES = (0.01, 0.05)


def false_alarms(count: int, scatter: np.ndarray, error: float) -> dict[float, float]:
    """Share of leak-free machines that alarm, by nominal probability: levels of mean 7, one scatter a machine."""
    random = np.random.default_rng((count, round(1e3 * error)))
    scores = []
    for tau in scatter:
        days = 7.0 + np.hypot(tau, error) * random.standard_normal(count + 1)
        own, *baseline = [Level(float(day), error) for day in days]
        rise = rise_of(own, baseline, PRIOR, 0.01)
        assert rise.threshold == norm.isf(0.01)  # a score is compared with what does not depend on it
        scores.append(rise.score)
    return {own: float(np.mean(np.array(scores) > norm.isf(own))) for own in PROBABILITIES}


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("error", [0.02, 30.0], ids=["scatter dominates", "errors dominate"])
def test_the_stated_probability_holds(count: int, error: float) -> None:
    """Machines whose scatter the prior describes: of 2000 the stated share alarms, within 3.5 standard errors."""
    machines = 2000
    chi_square = np.random.default_rng(count).chisquare(PRIOR.freedom, machines)
    shares = false_alarms(count, PRIOR.scale * np.sqrt(PRIOR.freedom / chi_square), error)
    for nominal, share in shares.items():
        assert abs(share - nominal) < 3.5 * np.sqrt(nominal * (1.0 - nominal) / machines)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize(
    "scatter, most",
    [pytest.param(0.3, 0.01, marks=pytest.mark.slow), pytest.param(1.0, 0.01, marks=pytest.mark.slow), (2.0, 0.05)],
)
def test_of_machines_unlike_the_prior(count: int, scatter: float, most: float) -> None:
    """A scatter of up to the prior's alarms no more than stated; twice as much (one in eleven) somewhat more."""
    assert false_alarms(count, np.full(1500, scatter), 0.02)[0.01] < most + 0.006


def test_without_errors_it_is_student_s_distribution() -> None:
    values = np.array([3.0, 5.0, 4.5, 2.0])
    freedom = PRIOR.freedom + 3
    scale = np.sqrt((PRIOR.freedom + np.sum((values - values.mean()) ** 2)) / freedom * 1.25)
    for own in (0.0, 4.0, 9.0, 20.0):
        rise = rise_of(Level(own, 0.0), [Level(float(one), 0.0) for one in values], PRIOR, 0.01)
        size = own - values.mean()
        assert rise.size == pytest.approx(size, abs=1e-9)
        assert rise.score == pytest.approx(norm.isf(t.sf(size / scale, freedom)), abs=2e-3)
        assert rise.interval == pytest.approx(size + scale * t.ppf([0.025, 0.975], freedom), abs=2e-3)
        assert rise.threshold == pytest.approx(norm.isf(0.01))


def test_with_large_errors_it_is_the_normal_distribution() -> None:
    baseline = [Level(1.0, 200.0), Level(2.0, 400.0)]
    weight = np.array([1 / 200.0**2, 1 / 400.0**2])
    mean, deviation = weight @ [1.0, 2.0] / weight.sum(), np.sqrt(1.0 / weight.sum() + 100.0**2)
    rise = rise_of(Level(500.0, 100.0), baseline, PRIOR, 0.05)
    assert rise.score == pytest.approx((500.0 - mean) / deviation, rel=1e-3)


def test_equal_levels_and_far_ones_are_finite() -> None:
    same = [Level(2.0, 0.0)] * 3
    assert rise_of(Level(2.0, 0.0), same, PRIOR, 0.01).score == pytest.approx(0.0, abs=1e-9)
    far = rise_of(Level(1e6, 0.0), same, PRIOR, 0.01)
    assert np.isfinite(far.score) and far.score > 5.0
    assert far.interval[0] < far.size < far.interval[1]


def judged(within: Evidence, level: float) -> Evidence:
    baseline = [Level(1.0, 0.1), Level(1.2, 0.1)]
    return against_baseline(
        within, Level(level, 0.1), baseline, PRIOR, 0.005, part="level", flows=(2.0, 2.1), cause="piston or pump leak"
    )


def test_a_level_above_the_baseline_is_a_leak_from_the_start() -> None:
    quiet = Evidence("no leak", "nothing rises", 0.1, 2.0)
    evidence = judged(quiet, 40.0)
    assert (evidence.verdict, evidence.onset_s, evidence.cause) == ("leak", None, "piston or pump leak")
    assert evidence.leak_lpm == pytest.approx(2.0 * 38.9, rel=1e-3)
    low, high = evidence.leak_interval_lpm
    assert low < evidence.leak_lpm < 2.1 * 38.9 < high  # both laws
    assert [part.detector for part in evidence.parts] == ["level"]
    assert "2 baseline recordings" in evidence.reason
    assert judged(quiet, 1.3).verdict == "no leak"


@pytest.mark.parametrize(
    "within", [Evidence("leak", "it rises", 9.0, 2.0), Evidence("no leak", "the pump", 9.0, 2.0, cause="pump leak")]
)
def test_what_the_recording_shows_by_itself_decides(within: Evidence) -> None:
    evidence = judged(within, 40.0)
    assert (evidence.verdict, evidence.cause, evidence.score) == (within.verdict, within.cause, within.score)
    assert "higher than the baseline's" in evidence.reason


def test_no_comparable_baseline_is_no_clean_bill() -> None:
    quiet = Evidence("no leak", "nothing rises", 0.1, 2.0)
    evidence = against_baseline(quiet, Level(1.0, 0.1), [], PRIOR, 0.005, part="level", flows=(), cause=None)
    assert evidence.verdict == "cannot tell"
    assert "no baseline recording can be compared" in evidence.reason


def test_both_tests_of_a_recording_share_the_probability() -> None:
    assert share_of_each(0.01, []) == 0.01
    assert share_of_each(0.01, ["a recording"]) == 0.005
