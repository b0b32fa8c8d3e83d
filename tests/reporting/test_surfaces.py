"""Terminal, JSON, page, card, index, the monitor's page and its metrics show one state of a machine."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest

from sealscope.diagnosis.verdict.evidence import AGAINST, WITHIN, Evidence, LeakCourse, RelativeLeak, TotalLeakage
from sealscope.diagnosis.verdict.machine_sizes import AssumedMachine
from sealscope.diagnosis.verdict.severity import state_of
from sealscope.monitor.alarms import Alarm
from sealscope.monitor.outputs.prometheus import format_metrics
from sealscope.reporting import messages
from sealscope.reporting.index import write_index
from sealscope.reporting.page import render_card, render_page
from sealscope.reporting.schematic import build_circuit

from .pages import Reader

NOTHING = {"onset_s": None, "onset_interval_s": None, "leak_lpm": None, "leak_interval_lpm": None, "quality": ()}
EVENT = "the zero of p_A changed near 12 s (99.9 % sure; 1 in 9 000 healthy recordings shows as much)"
OVER = RelativeLeak(creep=1e-3, creep_interval=(0.9e-3, 1.1e-3))
MACHINE = AssumedMachine("thesis", "nobody", 5.93e-3, 4.9e-6, True, False, areas=(7.854e-3, 4.006e-3))
#: What is diagnosed -> the state that every surface shows.
DIAGNOSES = {
    "leak": ({}, "maintenance required"),
    "leak over the limit": ({"relative": OVER}, "failure"),
    "nothing": ({"verdict": "no leak", "cause": None, **NOTHING}, "good"),
    "sensor": ({"verdict": "no leak", "cause": "sensor fault", "reason": EVENT, **NOTHING}, "failure"),
    "outside": ({"verdict": "no leak", "cause": "external leak", **NOTHING}, "maintenance required"),
    "mute": ({"verdict": "cannot tell", "cause": None, **NOTHING}, "out of specification"),
}


@pytest.mark.parametrize("name", DIAGNOSES)
def test_all_surfaces_show_one_state(name, recording, make_diagnosis, tmp_path):
    changed, expected = DIAGNOSES[name]
    diagnosis = make_diagnosis(**changed)
    state = diagnosis.as_dict()["state"]
    text = f"{expected} ({state['symbol']} of NE 107"
    assert state["name"] == expected
    for terminal in (messages.short_text(diagnosis), messages.diagnosis_text(diagnosis)):
        assert text in " ".join(terminal.split())
    page, tone = render_page(recording, diagnosis), f"state-{state['symbol']}"
    assert f'class="verdict {tone}"' in page and text in Reader(page).text
    assert f'<body class="{tone}">' in render_card(recording, diagnosis)
    index = write_index(tmp_path / "index.html", [(tmp_path / "page.html", diagnosis)])
    assert f'<td class="{tone}">' in index.read_text(encoding="utf-8")
    metrics = format_metrics({"press": {"state": state}}, {})
    assert f'sealscope_health{{actuator="press"}} {float(state["health"])}' in metrics
    assert f'sealscope_severity{{actuator="press"}} {float(state["severity"])}' in metrics


@pytest.mark.parametrize(("level", "name"), [("warning", "leak"), ("error", "leak over the limit")])
def test_an_alarm_of_the_monitor_is_in_the_state_of_a_diagnosis(level, name, make_diagnosis):
    alarm = Alarm(
        "press-1", "press", level, "new", 90.0, 95.0, 80.0, (79.0, 81.0), 0.01, None, "piston leak", "", "", 1
    )
    state = make_diagnosis(cause="piston leak", **DIAGNOSES[name][0]).state
    shown = alarm.as_dict()["machine_state"]
    assert {key: shown[key] for key in ("name", "symbol", "health", "severity", "condition")} == {
        key: getattr(state, key) for key in ("name", "symbol", "health", "severity", "condition")
    }


def test_both_pages_have_a_colour_for_every_state():
    styles = {
        "state-": resources.files("sealscope.reporting").joinpath("templates/page.css").read_text("utf-8"),
        "badge.": resources.files("sealscope.web").joinpath("base.css").read_text("utf-8"),
    }
    conditions = ("watched", "learning", "cannot tell", "leak", "leak over the limit")
    symbols = {state_of(condition).symbol for condition in conditions}
    assert len(symbols) == len(conditions)
    for before, style in styles.items():
        coloured = {*re.findall(rf"\.{re.escape(before)}([A-Z])\b", style)}
        assert coloured | ({"N"} if before == "badge." else set()) == symbols


def test_an_event_that_is_no_leak_stands_with_its_evidence(recording, make_diagnosis):
    diagnosis = make_diagnosis(**DIAGNOSES["sensor"][0])
    for text in (messages.short_text(diagnosis), Reader(render_page(recording, diagnosis)).text):
        assert EVENT in " ".join(text.split())


def judged_by(within, against, **changed):
    """Return the parts of a diagnosis whose two questions have these chances."""
    questions = (Evidence("no leak", "", 1.0, 9.0, detector="within the recording", chance=within),)
    questions += (Evidence("leak", "", 10.0, 9.0, detector="against the baseline", chance=against),)
    judge = Evidence("leak", "more than before", 10.0, 9.0, detector="volume balance", parts=questions)
    return {"parts": (judge,), **changed}


def test_since_is_as_a_whole_only_where_nothing_rises_within(make_diagnosis):
    whole = make_diagnosis(onset_s=None, onset_interval_s=None, **judged_by(0.6, 0.001))
    rises = make_diagnosis(onset_s=None, onset_interval_s=None, **judged_by(0.004, 0.001))
    assert messages.since(whole) == messages.say("since.whole")
    assert messages.since(rises) == messages.say("since.unsettled")


@pytest.mark.parametrize(
    ("against", "total", "bound", "kept"),
    [
        (0.4, (0.06, 0.05, 0.07), 0.01, True),
        (0.02, (0.06, 0.05, 0.07), 0.01, False),  # few healthy recordings have as much
        (0.4, (3.6, 3.5, 3.7), 3.7, False),  # all of it may be a leak
        (None, (0.06, 0.05, 0.07), 0.01, False),  # there is no healthy recording
    ],
)
def test_a_baseline_is_proposed_where_the_total_is_like_the_healthy_ones(make_diagnosis, against, total, bound, kept):
    parts = judged_by(0.5, against)["parts"] if against is not None else ()
    diagnosis = make_diagnosis(
        verdict="no leak", cause=None, baselines=3 if parts else 0, parts=parts, bound_lpm=bound,
        total_leakage=TotalLeakage(total[0], total[1:], 1e6), **NOTHING,
    )  # fmt: skip
    assert ("keep this recording as a baseline" in diagnosis.next_check) is kept
    assert diagnosis.state.name == "good"


def test_what_is_stated_is_printed_and_drawn(recording, make_diagnosis):
    diagnosis = make_diagnosis(machine=MACHINE)
    assert "7854 mm² at A and 4006 mm² at B as stated" in str(messages.machine_text(diagnosis.machine))
    circuit = build_circuit(None, recording, MACHINE)
    assert (circuit.cylinder, circuit.rods) == ("single-rod cylinder", "B")
    text = Reader(render_page(recording, diagnosis)).text
    assert "single-rod cylinder, area 7854 mm² at A and 4006 mm² at B, as stated" in text


def test_a_bypass_is_named_where_the_machine_has_one(make_diagnosis):
    for cause in (None, "piston leak", "piston or pump leak"):
        without = make_diagnosis(cause=cause, machine=MACHINE, quality=())
        assert "bypass" not in " ".join(messages.next_steps(without))
        values = {**vars(MACHINE), "bypass": True}
        assert (
            "bypass"
            in messages.next_steps(make_diagnosis(cause=cause, machine=AssumedMachine(**values), quality=()))[0]
        )


def test_the_repair_limit_counts_from_the_healthy_level(make_diagnosis):
    t = np.arange(4.0)
    course = LeakCourse(t, np.full(4, 1.15), np.full(4, 1.1), np.full(4, 1.2), whole=True)
    leaking = make_diagnosis(
        machine=MACHINE, course=course, onset_s=None, onset_interval_s=None, leak_lpm=1.1, leak_interval_lpm=(1.0, 1.2)
    )
    limit = leaking.limit_lpm
    assert leaking.repair_lpm == pytest.approx(limit + 0.05)
    assert replace(leaking, onset_s=math.nan).repair_lpm == leaking.repair_lpm  # an unknown onset is none
    healthy = make_diagnosis(machine=MACHINE, course=course, verdict="no leak", **NOTHING)
    assert healthy.repair_lpm == pytest.approx(limit + 1.15)


def test_where_the_sum_alone_is_known_the_outside_is_looked_at_first(make_diagnosis):
    action = make_diagnosis(cause="piston, pump or external leak", machine=MACHINE, quality=()).next_check
    assert action.index("outside") < action.index("piston seal") < action.index("pump's case drain")


@pytest.mark.parametrize("seed", range(4))
def test_advice_names_each_respect_in_which_a_recording_is_not_like_the_healthy_ones(make_diagnosis, seed):
    """It read "not in all respects shown to be like the healthy ones", and did not say in which."""
    rng = np.random.default_rng(seed)
    is_rare = rng.random(3) < 0.5
    is_rare[rng.integers(3)] = True
    against, within, rarest = np.where(is_rare, rng.uniform(0.0, 0.04, 3), rng.uniform(0.06, 1.0, 3)).tolist()
    tests = (
        Evidence("no leak", "", detector=AGAINST, chance=against),
        Evidence("no leak", "", detector=WITHIN, chance=within),
    )
    diagnosis = make_diagnosis(
        verdict="no leak", leak_lpm=None, leak_interval_lpm=None, onset_s=None, onset_interval_s=None, cause=None,
        bound_lpm=0.01, total_leakage=None, parts=(Evidence("no leak", "", parts=tests),), baselines=5,
        rarest_chance=rarest, rarest_change="the free air in the oil",
    )  # fmt: skip
    words = ("the leakage above theirs", "the leakage rises within", "the free air in the oil")
    for is_named, text in zip(is_rare, words, strict=True):
        assert (text in diagnosis.next_check) == is_named
    assert len(diagnosis.unlike_healthy) == is_rare.sum()
    assert not diagnosis.is_baseline
