"""The plan of a recording against recordings made afresh, its properties, its words and the command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from sealscope.campaigns import smallest
from sealscope.campaigns.smallest import (
    DetectableLeak,
    PlannedDuty,
    RecordingPlan,
    detectable_leak,
    duty_experiment,
    plan_recording,
)
from sealscope.diagnosis.diagnose import Examination
from sealscope.parameters import Rig, load_rig
from sealscope.simulation.leaks import Leak, opening_from
from sealscope.simulation.simulate import simulate_experiment
from sealscope.units import LITRE_PER_MINUTE

from ..refusals import refusal

DUTY = PlannedDuty("3 sin(4t)")


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("thesis")


@pytest.fixture(scope="module")
def minute(rig: Rig) -> DetectableLeak:
    return detectable_leak(rig, DUTY, 60.0)


@pytest.mark.slow
def test_what_is_planned_is_found(rig: Rig, minute: DetectableLeak) -> None:
    """1.3 times the size is found in most recordings made afresh, and a third of it in none."""
    result = []
    for factor in (1.3, 1.0 / 3.0):
        leak = Leak("laminar", coefficient=factor * minute.conductance, opening=opening_from(30.0))
        runs = [replace(duty_experiment(rig, DUTY, 60.0, seed), leaks=(leak,)) for seed in range(10, 14)]
        records = [simulate_experiment(run).recording for run in runs]
        cases = [Examination(recording, false_alarm_probability=0.01, rig=rig) for recording in records]
        result.append(sum(case.evidence("volume balance").verdict == "leak" for case in cases))
    assert result[0] >= 3 and result[1] == 0


@pytest.mark.slow
def test_what_is_separable_from_the_pump_is_no_smaller_than_what_is_found(rig: Rig, minute: DetectableLeak) -> None:
    assert minute.conductance <= minute.separable
    rarer, surer = (detectable_leak(rig, DUTY, 20.0, **of) for of in ({"false_alarm": 1e-3}, {"detection": 0.99}))
    usual = detectable_leak(rig, DUTY, 20.0)
    assert minute.conductance < usual.conductance < min(rarer.conductance, surer.conductance)


@pytest.mark.long
@pytest.mark.slow
def test_the_shortest_recording_that_finds_it_is_planned(
    monkeypatch: pytest.MonkeyPatch, rig: Rig, minute: DetectableLeak
) -> None:
    monkeypatch.setattr(smallest, "DURATIONS", (30.0, 45.0, 60.0))
    monkeypatch.setattr(smallest, "COMMANDS", ())
    wanted = 1.1 * minute.conductance * minute.pressure
    plan = plan_recording(rig, wanted, usual=DUTY)
    assert plan.finds and 30.0 <= plan.for_detection.duration <= 60.0
    lines = plan.text().splitlines()
    assert lines[0].startswith(f"{wanted / LITRE_PER_MINUTE:.2g} L/min") and "3 sin(4t) for" in lines[0]
    assert max(map(len, lines)) <= 120
    tree = plan.as_dict()
    assert json.loads(json.dumps(tree, allow_nan=False)) == tree and tree["finds"] is True


@pytest.mark.slow
def test_a_leak_that_no_recording_finds_is_said_so(monkeypatch: pytest.MonkeyPatch, rig: Rig) -> None:
    monkeypatch.setattr(smallest, "DURATIONS", (20.0,))
    monkeypatch.setattr(smallest, "COMMANDS", ("11 sin(4t)",))
    monkeypatch.setattr(smallest, "LOADS", ("",))
    plan = plan_recording(rig, 1e-12, usual=DUTY)
    assert not plan.finds and "not found; the best is 3 sin(4t) for 20 s" in plan.text()
    assert "must stay within +-10 V" in plan.compared[1].note and plan.as_dict()["compared"][1]["pressure_Pa"] is None
    assert f"left out: 11 sin(4t): {plan.compared[1].note}" in " ".join(plan.text().split())  # nothing is cut


def test_without_a_term_of_the_pump_nothing_tells_it_apart() -> None:
    own = DetectableLeak(DUTY, 60.0, 1e-14, np.inf, 1e5)
    text = RecordingPlan("bench", None, own, own, (own,), 1e5, 0.01, 0.9).text()
    assert "separated from a leak of the pump: no" in text and "6e-05 L/min" in text.splitlines()[0]


def test_what_is_no_command_is_refused(rig: Rig) -> None:
    with refusal("command", "voltage"):
        duty_experiment(rig, PlannedDuty("position 20 mm sin(2t)"), 20.0)
    with refusal("duty", "balance"):
        plan_recording(rig, usual=PlannedDuty("11 sin(4t)"))
