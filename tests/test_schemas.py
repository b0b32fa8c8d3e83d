"""The published JSON Schemas hold for what the program writes, and refuse what it never writes."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import pytest

import sealscope as ss
from sealscope.monitor.alarms import Alarm

from .representatives import other

jsonschema = pytest.importorskip("jsonschema")
REFERENCE = Path(__file__).parents[1] / "docs" / "reference"


def validator(name):
    schema = json.loads((REFERENCE / f"{name}.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize(
    ("options", "channels"),
    [
        ({"leak": "0.02 L/min from 15 s"}, ("p_A", "p_B", "x", "theta", "u")),
        other(({}, ("p_A", "p_B", "x", "theta", "u"))),
        ({}, ("p_A", "p_B")),
    ],
)
def test_verdicts_follow_the_schema(options, channels):
    recording = ss.simulate(command="5 sin(2t)", duration="30 s", seed=1, **options)
    written = json.loads(json.dumps(ss.diagnose(recording.only(channels)).as_dict(), allow_nan=False))
    schema = validator("verdict")
    schema.validate(written)
    for broken in ({"verdict": "maybe"}, {"leak_lpm": "0.02"}, {"more": 1}):
        assert not schema.is_valid(written | broken)
    for name in ("onset_s", "evidence"):
        assert not schema.is_valid({key: value for key, value in written.items() if key != name})


def test_alarms_follow_the_schema():
    alarm = Alarm(
        id="press 1", actuator="press", level="error", state="new", raised_s=90.0, updated_s=95.0,
        onset_s=80.0, onset_interval_s=(79.0, 81.0), leak_lpm=0.01, leak_interval_lpm=(0.009, 0.011),
        cause="piston leak", evidence="a step", next_check="hold a load", baseline=1,
    )  # fmt: skip
    schema = validator("alarm")
    written = json.loads(json.dumps(alarm.as_dict()))
    schema.validate(written)
    assert {field.name for field in fields(Alarm)} <= set(written)
    assert not schema.is_valid(written | {"state": "gone"})
