"""The formula of a planned hold against what hold tests then show."""

from __future__ import annotations

import numpy as np
import pytest

import sealscope as ss
from sealscope.campaigns.smallest import DetectableLeak, PlannedDuty, RecordingPlan, has_shut_off
from sealscope.diagnosis.hold.plan import HOLD_MINUTES, plan_hold
from sealscope.errors import InputError
from sealscope.parameters import load_rig

AREA, NOISE = 3e-3, 1e-4


def test_a_leak_as_planned_is_shown_as_often_as_planned():
    planned = plan_hold(2e4, AREA, 0.65, 1e-6, noise=NOISE, detection=0.8)
    shown = 0
    for seed in range(30):
        random = np.random.default_rng(seed)
        t = np.arange(0.0, 60.0 * planned.minutes, 1.0)
        values = {"x": 0.4 - planned.creep * t + NOISE * random.standard_normal(t.size), "T_oil": 320.0 + 0.0 * t}
        values["p_A"] = 8e6 + 1e4 * random.standard_normal(t.size)
        recording = ss.Recording(t, values, {"x": "m", "p_A": "Pa", "T_oil": "K"}, rate=1.0)
        (result,) = ss.hold_test(recording, area=AREA)
        shown += result.leak_interval_lpm[0] > 0.0
    assert 15 <= shown <= 30


@pytest.mark.parametrize("is_logged", [True, False])
def test_oil_that_changes_hides_as_much_as_planned(is_logged):
    planned = plan_hold(2e4, AREA, 0.65, 1e-4, warming=0.0 if is_logged else 3.0, detection=0.8)
    shown, seeds = 0, range(20)
    for seed in seeds:
        random = np.random.default_rng(seed)
        t = np.arange(0.0, 60.0 * planned.minutes, 1.0)
        change = random.uniform(-1.0, 1.0) if is_logged else 3.0 * random.standard_normal()
        T = change * np.expm1(-t / random.uniform(600.0, 3000.0)) / np.expm1(-1.0)
        leak = planned.leak + (planned.per_kelvin * abs(T[-1]) if is_logged else 0.0)
        x = 0.4 - leak / AREA * t + 7e-4 * 0.65 * T
        values = {"x": np.round(x / 1e-4 + random.uniform()) * 1e-4, "p_A": 8e6 + 1e4 * random.standard_normal(t.size)}
        if is_logged:
            values["T_oil"] = np.round(3200.0 + 10.0 * T) / 10.0
        recording = ss.Recording(t, values, {"x": "m", "p_A": "Pa", "T_oil": "K"}, rate=1.0)
        (result,) = ss.hold_test(recording, area=AREA)
        shown += result.leak_interval_lpm[0] > 0.0
    assert 0.5 * len(seeds) <= shown, shown


def test_a_longer_hold_shows_less_and_drift_more():
    planned = plan_hold(2e4, AREA, 0.65, 1e-4)
    longer = plan_hold(2e4, AREA, 0.65, 1e-4, find=0.3 * planned.leak)
    assert longer.minutes > planned.minutes and longer.leak <= 0.3 * planned.leak
    unseen = plan_hold(2e4, AREA, 0.65, 1e-4, find=1e-3 * planned.leak)
    assert unseen.minutes == HOLD_MINUTES[-1] and "no hold" in unseen.text() and "no hold" not in longer.text()
    drifting = [plan_hold(2e4, AREA, 0.65, 1e-4, warming=warming).leak for warming in (0.0, 1.0, 30.0)]
    assert drifting == sorted(drifting) and drifting[-1] > 2.0 * drifting[0]
    assert plan_hold(4e4, AREA, 0.65, 1e-4).pressure == pytest.approx(2.0 * planned.pressure)


@pytest.mark.parametrize("sizes", [(0.0, AREA, 0.6), (2e4, 0.0, 0.6), (2e4, AREA, 0.0)])
def test_a_hold_needs_load_area_and_oil(sizes):
    with pytest.raises(InputError, match="above 0"):
        plan_hold(*sizes, 1e-4)


def test_a_plan_names_the_hold():
    found = DetectableLeak(PlannedDuty("3 sin(4t)"), 60.0, 1e-14, 1e-13, 1e5)
    hold = plan_hold(2e4, AREA, 0.65, 1e-4)
    plan = RecordingPlan("bench", None, found, found, (found,), 1e5, 0.01, 0.9, hold)
    assert "hold 20 kN for 10 min" in plan.text()
    assert plan.as_dict()["hold"]["minutes"] == 10.0
    assert "hold" not in plan._replace(hold=None).text()
    assert not has_shut_off(load_rig("thesis"))
