"""The output contract: keys, types, plain JSON, whatever the input."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.severity import Severity
from sealscope.recordings.recording import Recording

from ..refusals import refusal
from ..wording import says

jsonschema = pytest.importorskip("jsonschema")
DOCS = Path(__file__).parents[2] / "docs"
SCHEMA = jsonschema.Draft202012Validator(json.loads((DOCS / "reference" / "verdict.schema.json").read_text()))


def check(result: Diagnosis) -> None:
    """Everything that another program may rely on, after a way through text."""
    line = json.dumps(result.as_dict(), allow_nan=False)
    tree = json.loads(line)
    SCHEMA.validate(tree)
    assert "\n" not in line + tree["reason"] + tree["next_check"]
    assert tree["reason"] and tree["next_check"] and tree["methods"][0]["verdict"] == tree["verdict"]
    assert tree["verdict"] != "leak" or tree["bound_lpm"] is None
    if tree["onset_s"] is not None:
        first, last = tree["onset_interval_s"]
        assert tree["verdict"] == "leak" and first <= tree["onset_s"] <= last


@pytest.mark.usefixtures("rms_change_alone")
def test_contract_of_ringing_that_fell(leaky: Recording) -> None:
    """Friction, duty and filters make it fall as well: alone it is an alarm that is not explained."""
    result = diagnose(leaky, file="rig.csv")
    assert (result.verdict, result.file) == ("cannot tell", "rig.csv")
    check(result)
    tree = result.as_dict()
    assert tree["leak_lpm"] is None
    assert tree["leak_interval_lpm"] is None
    assert tree["false_alarm_probability"] == 0.01
    assert tree["score"] > tree["threshold"]
    assert tree["methods"] == [
        {
            "name": "rms change",
            "score": tree["score"],
            "threshold": tree["threshold"],
            "verdict": "cannot tell",
            "reason": tree["reason"],
            "chance": tree["chance"],
            "odds": tree["odds"],
        }
    ]


def test_contract_of_all_methods_beside_the_verdict(leaky: Recording) -> None:
    result = diagnose(leaky)
    assert result.verdict == "leak"
    check(result)
    tree = result.as_dict()
    assert (tree["score"], tree["threshold"]) == (tree["methods"][0]["score"], tree["methods"][0]["threshold"])
    assert tree["reason"].startswith(tree["methods"][0]["reason"])
    assert {"volume balance", "rms change"} <= {one["name"] for one in tree["methods"]}


def test_contract_of_the_other_verdicts(healthy: Recording) -> None:
    for result, verdict in ((diagnose(healthy), "no leak"), (diagnose(healthy.between(0, 2)), "cannot tell")):
        assert result.verdict == verdict
        check(result)


def test_numbers_that_json_does_not_know_become_null() -> None:
    result = Diagnosis(
        "leak", "r", math.nan, math.inf, math.inf, (-math.inf, 3.0), file="f", false_alarm_probability=0.01
    )
    tree = json.loads(json.dumps(result.as_dict(), allow_nan=False))
    assert tree["onset_s"] is tree["score"] is tree["threshold"] is None
    assert tree["onset_interval_s"] == [None, 3.0]


@pytest.mark.slow
def test_a_part_analysed_is_told(leaky: Recording) -> None:
    p_A = np.array(leaky["p_A"])
    p_A[:1001] = np.nan
    p_A[1100] = np.nan
    result = diagnose(Recording(leaky.t, {**leaky.channels, "p_A": p_A}, leaky.units, leaky.rate))
    codes = {finding.code: finding for finding in result.quality}
    assert codes["part_analysed"].count == 1001
    assert codes["gaps_bridged"].count == 1
    assert codes["missing"].channel == "p_A"
    assert result.share < 0.984
    assert says(result.reason, "doubt.share", percent=100 * result.share)
    check(result)


@pytest.mark.parametrize("probability", [0.0, -0.1, 1e-5, 0.21, 1.0, math.nan, math.inf])
def test_a_probability_no_threshold_can_be_set_for(probability: float, healthy: Recording) -> None:
    with refusal("0.0001", "0.2"):
        diagnose(healthy, false_alarm_probability=probability)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_any_recording_gets_a_verdict(data: st.DataObject) -> None:
    """Channels of every kind of trouble, in any mixture and length, with or without a baseline of the same kind."""
    random = np.random.default_rng(data.draw(st.integers(0, 1000)))
    rate = data.draw(st.sampled_from([0.5, 10.0, 100.0, 1000.0]))
    names = data.draw(st.sets(st.sampled_from(["p_A", "p_B", "u", "x", "q_leak"]), min_size=1))

    def channel(n: int) -> np.ndarray:
        kind = data.draw(
            st.sampled_from(["noise", "sine", "constant", "integers", "holes", "half still", "huge", "none"])
        )
        noise = random.standard_normal(n)
        k = np.arange(n)
        return {
            "noise": noise,
            "sine": np.sin(k / 20.0) + 1e-3 * noise,
            "constant": np.full(n, 5.0),
            "integers": np.rint(2 * noise),
            "holes": np.where(random.random(n) < 0.01, np.nan, noise),
            "half still": np.where(k < n // 2, 0.0, noise),
            "huge": noise * 1e160,
            "none": np.full(n, np.nan),
        }[kind]

    def one() -> Recording:
        n = data.draw(st.sampled_from([0, 1, 2, 30, 226, 1000, 4000]))
        return Recording(np.arange(n) / rate, {name: channel(n) for name in names}, dict.fromkeys(names, "count"), rate)

    check(diagnose(one(), [one() for _ in range(data.draw(st.integers(0, 4)))], false_alarm_probability=0.05))


def test_every_field_is_documented(healthy: Recording) -> None:
    """Each key, and each key within it, stands in docs/verdict.md."""
    page = (DOCS / "verdict.md").read_text(encoding="utf-8")
    tree = diagnose(healthy).as_dict()
    for key, value in tree.items():
        assert f"`{key}`" in page, key
        inner = value[0] if isinstance(value, list) and value and isinstance(value[0], dict) else value
        for name in inner if isinstance(inner, dict) and key != "about" else ():
            assert f"`{name}`" in page, (key, name)
    for name in Severity((1.0, 0.0, 2.0), None, None, None).as_dict():
        assert f"`{name.removesuffix('_interval')}`" in page, name
