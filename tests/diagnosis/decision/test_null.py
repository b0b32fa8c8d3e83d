"""Healthy recordings as the null: ordinary ones change nothing, strange ones everything."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.decision.case import HealthyNull
from sealscope.diagnosis.inference.observable import Observable

from .cases import observable

CHANGE = observable("volumes: leak", 1e-6)
KEY = CHANGE.key


def chance(*surprisals: float, of: Observable = CHANGE) -> float:
    return HealthyNull({KEY: surprisals}).chance(of)


def test_without_healthy_recordings_the_law_stands() -> None:
    for law in (1e-200, 1e-6, 0.3, 1.0):
        assert HealthyNull().chance(observable("volumes: leak", law)) == pytest.approx(law)
        assert HealthyNull().calibrate("any", law) == pytest.approx(law)
        assert HealthyNull().uncalibrated_chance("any", law) == pytest.approx(law)


@pytest.mark.parametrize("surprisals", [(1.0, 1.0), (0.2, 1.6)])
def test_two_ordinary_healthy_recordings_change_next_to_nothing(surprisals: tuple[float, float]) -> None:
    """Healthy recordings have -log P = 1 on average: an alarm needs a score larger by 40 % at most."""
    null = HealthyNull({KEY: surprisals})
    for wanted in (0.05, 0.01):
        assert np.log(null.uncalibrated_chance(KEY, wanted)) > 1.4 * np.log(wanted)
    assert null.calibrate(KEY, 1e-20) < 1e-5


def test_five_strange_ones_change_everything() -> None:
    """What every healthy recording shows is no alarm."""
    assert chance(14.0, 14.0, 14.0, 14.0, 14.0) > 0.2
    assert chance(60.0, 45.0, 80.0, 70.0, 50.0) > 0.5


def test_the_stranger_the_healthy_ones_the_less_strange_the_judged() -> None:
    chances = [chance(*([surprisal] * 5)) for surprisal in (0.5, 1.0, 2.0, 5.0, 20.0, 100.0)]
    assert chances == sorted(chances)


def test_the_rarer_by_the_law_the_rarer() -> None:
    null = HealthyNull({KEY: [3.0, 8.0, 1.0]})
    laws = np.geomspace(1e-250, 1.0, 60)
    chances = [null.calibrate(KEY, law) for law in laws]
    assert np.all(np.diff(chances) > 0.0)
    assert all(found >= law * (1.0 - 1e-9) for found, law in zip(chances, laws, strict=True))


def test_more_ordinary_recordings_return_to_the_law() -> None:
    chances = [chance(*([1.0] * count)) for count in (1, 4, 20, 100)]
    assert chances == sorted(chances, reverse=True)
    assert chances[-1] < 3e-6


def test_the_law_s_chance_is_the_inverse() -> None:
    null = HealthyNull({KEY: [2.0, 7.0, 4.0]})
    for wanted in (0.2, 0.01, 1e-4):
        assert null.calibrate(KEY, null.uncalibrated_chance(KEY, wanted)) == pytest.approx(wanted, rel=1e-6)


def test_one_observable_s_healthy_values_are_not_another_s() -> None:
    null = HealthyNull({KEY: [30.0] * 5})
    other = observable("volumes: pump leak", 1e-6)
    assert null.chance(other) == pytest.approx(1e-6)


def test_healthy_values_from_the_law_keep_the_rate() -> None:
    """Of healthy recordings of a machine that follows the law, at most 1 % have a chance below 1 %; power remains."""
    random = np.random.default_rng(1)
    for count in (2, 5, 20):
        judged = [
            chance(
                *random.exponential(size=count), of=observable("volumes: leak", float(np.exp(-random.exponential())))
            )
            for _ in range(400)
        ]
        assert np.mean(np.array(judged) < 0.01) < 0.025


@pytest.mark.parametrize(("count", "most"), [(10, 0.05), (40, 0.025)])
@pytest.mark.parametrize("inflation", [3.0, 10.0])
def test_healthy_recordings_make_good_a_law_that_fails(inflation: float, count: int, most: float) -> None:
    """Of 1 % that are stated; the law alone gives 21 % and 63 %."""
    random = np.random.default_rng(2)
    alarms = []
    for _ in range(400):
        *healthy, judged = inflation * random.exponential(size=count + 1)
        alarms.append(chance(*healthy, of=observable("volumes: leak", max(float(np.exp(-judged)), 1e-300))) < 0.01)
    assert np.mean(alarms) < most
