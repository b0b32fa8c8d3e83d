"""The volume balance where make-up valves fill the circuit."""

from __future__ import annotations

import itertools

import pytest

from sealscope.campaigns.cases.case import list_cases
from sealscope.campaigns.cases.machines import case_experiment
from sealscope.campaigns.plans.reader import load_plan
from sealscope.diagnosis.diagnose import Examination
from sealscope.simulation.simulate import simulate_experiment


@pytest.mark.slow
def test_a_circuit_that_fills_at_the_start_hides_no_small_leak() -> None:
    """The first block, into which a valve lets oil by one side, stood out beyond a step of 0.0002 L/min."""
    plan = load_plan("bench-detectors")
    leaking = (case for case in list_cases(plan) if case.leak_lpm == 0.0002)
    (case,) = itertools.islice(leaking, 1, 2)
    recording = simulate_experiment(case_experiment(plan, case)).recording
    evidence = Examination(recording, false_alarm_probability=0.01, rig="thesis").evidence("volume balance")
    assert evidence.verdict == "leak"
    assert evidence.onset_interval_s is not None
    assert evidence.onset_interval_s[0] - 1.0 <= 90.0 <= evidence.onset_interval_s[1] + 1.0
