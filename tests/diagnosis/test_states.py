"""States of NAMUR NE 107: which verdict is which, and the same words for a recording and for a watched actuator."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from importlib.resources import files
from typing import get_args

import pytest

from sealscope.diagnosis.decision.explanations import load_events
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.verdict.evidence import LEAKS, Cause
from sealscope.diagnosis.verdict.severity import RepairLimit, joint_causes, state_of

from ..refusals import refusal
from .balance_machine import machine, step

#: DeviceHealthEnumeration of OPC 10000-100.
HEALTH = {
    "good": 0,
    "failure": 1,
    "check function": 2,
    "out of specification": 3,
    "maintenance required": 4,
}


@pytest.mark.parametrize(
    ("condition", "cause", "name"),
    [
        ("no leak", None, "good"),
        ("watched", None, "good"),
        ("learning", None, "check function"),
        ("no data", None, "check function"),
        ("cannot tell", None, "out of specification"),
        ("not comparable", None, "out of specification"),
        ("leak", "piston leak", "maintenance required"),
        ("leak over the limit", "piston leak", "failure"),
        ("no leak", "external leak", "maintenance required"),
        ("cannot tell", "sensor fault", "failure"),
        ("cannot tell", "changed duty", "out of specification"),
    ],
)
def test_each_condition_has_its_state(condition, cause, name):
    state = state_of(condition, cause)
    assert (state.name, state.health, state.cause) == (name, HEALTH[name], cause)
    assert (state.severity == 0) == (name == "good")
    assert state.action


def test_a_worse_state_has_a_higher_severity_and_a_leak_beyond_the_limit_the_highest():
    severities = {state.name: state.severity for state in map(state_of, ("no leak", "learning", "cannot tell", "leak"))}
    ordered = ["good", "check function", "out of specification", "maintenance required"]
    assert sorted(severities, key=severities.__getitem__) == ordered
    assert state_of("leak over the limit").severity > max(severities.values())


def test_every_cause_says_what_to_do():
    causes = tomllib.loads((files("sealscope.diagnosis.verdict") / "states.toml").read_text("utf-8"))["causes"]
    single_causes = {*get_args(Cause), *(event.cause for event in load_events() if event.cause)}
    assert single_causes | joint_causes().keys() == causes.keys()
    assert all(set(joined) <= single_causes for joined in joint_causes().values())
    actions = {cause: state_of("cannot tell", cause).action for cause in causes}
    assert len({*actions.values()}) == len(actions)
    assert state_of("cannot tell").action not in actions.values()


@pytest.mark.slow
def test_a_recording_has_the_state_of_its_leak_against_the_limit():
    worn = machine(1, G=step(0.0, 3.0e-13, at=100.0), duration=200.0, rate=100.0)
    over = diagnose(worn, rig="thesis", limit="1e-6 L/min")
    under = replace(over, limit=RepairLimit.parse("10 L/min"))
    assert [each.verdict for each in (over, under)] == ["leak", "leak"]
    assert [each.state.name for each in (over, under)] == ["failure", "maintenance required"]
    for each in (over, under):
        assert each.state.cause in LEAKS
        assert each.state.since_s == each.onset_s
        assert each.state.action == each.next_check
    assert diagnose(machine(1)).state.name == "good"
    noisy = diagnose(machine(4, p_noise=2.0e6, x_step=2.0e-3))
    assert (noisy.verdict, noisy.state.name) == ("cannot tell", "out of specification")


@pytest.mark.parametrize("limit", ["5", "5e-6", "5,3", "inf"])
def test_a_repair_limit_has_a_unit(limit: str) -> None:
    with refusal("limit", limit):
        RepairLimit.parse(limit)
    assert RepairLimit.parse("5e-6 m^3/s").flow_lpm(None) == pytest.approx(0.3)
