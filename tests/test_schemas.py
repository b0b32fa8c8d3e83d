"""The published JSON Schemas hold for what the program writes, and refuse what it never writes."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
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


@pytest.mark.parametrize("limit", [None, "0.5 mm/min", "boom: 1 mL/min at 100 bar"])
def test_hold_tests_follow_the_schema(limit):
    t = np.arange(0.0, 120.0, 0.5)
    x = 0.4 - 0.5e-3 * t / 60.0 + 1e-5 * np.random.default_rng(1).standard_normal(t.size)
    channels = {"x": x, "p_A": 8e6 + 1e3 * np.sin(t), "T_oil": 320.0 - 1e-3 * t}
    units = {"x": "m", "p_A": "Pa", "T_oil": "K"}
    schema = validator("hold")
    for names, areas in ((("x", "p_A"), ("3117 mm^2", "2155 mm^2")), (("x", "T_oil"), None), (("p_A",), "3117 mm^2")):
        chosen = {name: channels[name] for name in names}
        recording = ss.Recording(t, chosen, {name: units[name] for name in names}, rate=2.0)
        for result in ss.hold_test(recording, area=areas, limit=limit):
            written = json.loads(json.dumps(result.as_dict(), allow_nan=False))
            schema.validate(written)
            for broken in ({"result": "maybe"}, {"creep_mm_per_min": "0.5"}, {"causes": ["wear"]}, {"more": 1}):
                assert not schema.is_valid(written | broken)
            for name in ("file", "leak_interval_lpm", "reason"):
                assert not schema.is_valid({key: value for key, value in written.items() if key != name})
    (collected,) = ss.hold_test(collected="12 mL in 10 min", limit=limit and "0.3 mL/min")
    schema.validate(json.loads(json.dumps(collected.as_dict(), allow_nan=False)))
