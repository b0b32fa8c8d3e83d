"""Campaigns judge detectors by what they state - verdict, onset, flow, cause - each through its channels, run once."""

from __future__ import annotations

import csv
import json
import math
import runpy
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import get_args

import pytest

from sealscope.campaigns.cases.row import CaseRow, Statement, expected_cause
from sealscope.campaigns.execution import run as campaign
from sealscope.campaigns.execution.store import read_rows
from sealscope.campaigns.judging.judge import judge
from sealscope.campaigns.plans.detectors import ALL_CHANNELS, check_detector, parse_detector_name
from sealscope.campaigns.plans.reader import load_plan
from sealscope.campaigns.results import judge_simulated_campaign, write_result
from sealscope.diagnosis.decision.decide import decide
from sealscope.diagnosis.decision.explanations import load_events
from sealscope.diagnosis.detectors import registry
from sealscope.diagnosis.detectors.registry import make_observable
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.verdict.evidence import Cause, Evidence
from sealscope.recordings import read
from sealscope.reporting.campaign.page import campaign_text, render_campaign_page
from sealscope.simulation.faults import FAULTS

from ..refusals import refusal

PLAN = """
[campaign]
name = "watched"
duration = "24 s"
onset = "12 s"
rate = "250 Hz"
false_alarm = 0.2
seed = 3
keep_recordings = true
detectors = ["watcher", "watcher @ pressures", "diagnose", "diagnose @ pressures",
             "rms change", "d3 of p_A changed"]

[views]
pressures = ["u", "p_A", "p_B"]

[[records]]
use = "calibrate"
count = 5

[[records]]
count = 1

[[records]]
leak = "0.02 L/min"
count = 2

[[records]]
fault = "friction +20 %"
count = 1
"""
examined: list[tuple[str, ...]] = []


class Watcher:
    """Reports which channels a record has, how its pressure changes, and the rig that it was made for."""

    name = "watcher"

    def __init__(self, rig) -> None:
        self.rig = rig

    def usable(self, recording):
        return None

    def observe(self, recording, baseline=()):
        examined.append(tuple(recording.channels))
        moved = float(recording["p_A"][len(recording) // 2 :].std() / recording["p_A"][: len(recording) // 2].std())
        name = "all channels" if "x" in recording else "few channels"
        return make_observable(name, math.exp(-1.0 - abs(math.log(moved))), size=self.rig.pump.q_b)


def decide_for_watcher(report, reports, null, probability, weigh_rivals):
    """Decide as always, but state figures for the watcher that campaigns have to keep."""
    if report.provider != "watcher":
        return decide(report, reports, null, probability, weigh_rivals)
    (change,) = report.observables
    is_whole = change.name == "all channels"
    return Evidence(
        "leak" if is_whole else "no leak", f"at {probability}", change.score, 2.0, 13.0,
        (11.0, 15.0), change.size, (0.0, 1.0), cause=None if is_whole else "friction change", detector="watcher",
    )  # fmt: skip


@pytest.fixture
def plan(tmp_path, monkeypatch):
    quick = {name: registry.DETECTORS[name] for name in ("volume balance", "rms change")}
    monkeypatch.setattr(registry, "DETECTORS", {**quick, "watcher": Watcher})
    monkeypatch.setattr(registry, "entry_points", lambda group: ())
    monkeypatch.setattr("sealscope.diagnosis.diagnose.decide", decide_for_watcher)
    registry.plug_ins.cache_clear()
    parse_detector_name.cache_clear()
    examined.clear()
    path = tmp_path / "watched.toml"
    path.write_text(PLAN, encoding="utf-8")
    return load_plan(path)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder for the finished campaign of this file's plan, and what its watcher saw: run by the first that asks."""
    return {"folder": tmp_path_factory.mktemp("finished") / "watched", "examined": None}


@pytest.fixture
def done(plan, tmp_path, finished):
    if finished["examined"] is None:
        assert campaign.run(plan, finished["folder"], jobs=1).failed == 0
        finished["examined"] = tuple(examined)
    examined[:] = finished["examined"]
    return copytree(finished["folder"], tmp_path / "watched")


def test_every_detector_sees_its_channels_and_is_run_once(plan, done):
    assert len(examined) == 2 * plan.size  # once for each set of channels, although several entries ask for one of them
    assert examined.count(("u", "p_A", "p_B")) == plan.size
    whole = next(one for one in examined if "x" in one)
    assert {"theta", "omega", "p_1", "p_2"} <= set(whole)
    assert not any("q_leak" in one for one in examined)


def test_rows_keep_what_was_stated_and_come_back_from_disk(plan, done):
    rows = read_rows(done)
    row = next(iter(rows.values()))
    assert set(row.scores) == set(plan.detectors)
    assert set(row.statements) == {
        "watcher", "watcher @ pressures", "diagnose", "diagnose @ pressures", "rms change",
    }  # fmt: skip
    said = row.statements["watcher"]
    assert (said.verdict, said.threshold, said.onset_s, said.onset_interval_s) == ("leak", 2.0, 13.0, (11.0, 15.0))
    assert (said.leak_lpm, said.leak_interval_lpm) == (plan.rig.pump.q_b, (0.0, 1.0))
    assert row.statements["watcher @ pressures"].cause == "friction change"
    assert row.scores["watcher @ pressures"] == (None, 13.0)  # another cause: the lowest of scores
    assert CaseRow.from_dict(json.loads(json.dumps(row.as_dict(), allow_nan=False))) == row
    line = json.loads((done / "rows.jsonl").read_text().splitlines()[0])
    del line["statements"]
    assert CaseRow.from_dict(line).statements == {}


@pytest.mark.slow
def test_the_fused_verdict_is_that_of_diagnose(plan, done):
    for row in read_rows(done).values():
        recording = read(done / "recordings" / f"{row.id}.nc")
        observed = recording.only(name for name in recording.channels if name != "q_leak")
        for key, one in (("diagnose", observed), ("diagnose @ pressures", observed.only(["u", "p_A", "p_B"]))):
            outcome = diagnose(one, false_alarm_probability=plan.false_alarm, rig=plan.rig)
            said = row.statements[key]
            assert (said.verdict, said.cause, said.onset_s) == (outcome.verdict, outcome.cause, outcome.onset_s)
            assert said.score == pytest.approx(outcome.score)
            if said.ranking_score is not None:
                beyond = (
                    outcome.score / outcome.threshold if outcome.threshold > 0 else outcome.score - outcome.threshold
                )
                assert row.scores[key][0] == pytest.approx(beyond)


def recall(confusion, fault):
    """The share of the records with a fault that are called so."""
    return confusion.shares[confusion.rows.index(fault)][confusion.columns.index(fault)].value


def test_what_it_adds_up_to(plan, done):
    result = judge_simulated_campaign(plan, done)
    table = {(one.detector, one.leak_lpm): one for one in result.judgement.table}
    assert table["watcher", 0.02].alarms.value == table["watcher", 0.02].false_alarm.value == 1.0
    assert table["watcher @ pressures", 0.02].alarms.count == 0
    flows = {(one.detector, one.leak_lpm): one for one in result.judgement.flows}
    assert flows["watcher", 0.0].errors.bias.value == pytest.approx(plan.rig.pump.q_b)
    assert flows["watcher", 0.02].errors.bias.value == pytest.approx(-0.02, rel=0.1)
    assert flows["watcher", 0.02].errors.coverage.value == 1.0
    onsets = {(one.detector, one.leak_lpm): one.errors for one in result.judgement.onsets}
    assert onsets["watcher", 0.02].median_size.value == 1.0
    assert onsets["watcher", 0.02].coverage.count == 2
    named = {one.detector: one.confusion for one in result.judgement.causes}
    assert recall(named["watcher @ pressures"], "friction change") == 1.0
    assert recall(named["watcher"], "piston leak") == 1.0
    assert recall(named["watcher"], "friction change") == 0.0
    files = {path.name: path for path in write_result(result, done)}
    assert {"estimates.csv", "causes.csv", "onsets.csv", "records.csv"} <= set(files)
    with files["records.csv"].open(encoding="utf-8") as file:
        (first, *_) = csv.DictReader(file)
    assert first["watcher @ pressures: cause"] == "friction change"
    page = render_campaign_page(result, list(files))
    for heading in ("How much", "Since when", "Which cause is named"):
        assert heading in page
    assert "watcher @ pressures" in campaign_text(result)
    with files["table.csv"].open(encoding="utf-8") as file:
        given = {line["detector"]: line for line in csv.DictReader(file)}
    columns = ("true onset given", "channels given", "rig assumed")
    assert [given["watcher @ pressures"][name] for name in columns] == ["no", "u p_A p_B", "thesis"]
    assert [given["d3 of p_A changed"][name] for name in columns] == ["yes", " ".join(ALL_CHANNELS), ""]
    assert [given["rms change"][name] for name in columns[::2]] == ["no", "thesis"]
    assert [given["always fire"][name] for name in columns] == ["", "", ""]
    for words in ("splits the record where the leak opens: d3 of p_A changed.", "u, p_A, p_B to watcher @ pressures"):
        assert words in " ".join(campaign_text(result).split())
        assert words in page


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('assume_set = { "pump.q_b" = 1e-7 }', ""), "rig"),
        (("", ('pressures = ["u", "p_A", "p_B"]', 'pressures = ["p_A", "p_B"]')), "channels"),
        (("", ("false_alarm = 0.2", "false_alarm = 0.19")), "false-alarm"),
    ],
)
def test_rows_of_other_assumptions_are_not_mixed_in(plan, done, tmp_path, change, words):
    text = PLAN.replace("seed = 3", f"seed = 3\n{change[0]}")
    if change[1]:
        assert change[1][0] in text
        text = text.replace(*change[1])
    (tmp_path / "watched.toml").write_text(text, encoding="utf-8")
    with refusal(*words.split(", ")):
        judge_simulated_campaign(load_plan(tmp_path / "watched.toml"), done)
    with refusal(*words.split(", ")):
        campaign.run(load_plan(tmp_path / "watched.toml"), done, jobs=1)


def test_rows_of_an_older_form_are_refused(plan, done):
    head = json.loads((done / "campaign.json").read_text())
    del head["format"]
    (done / "campaign.json").write_text(json.dumps(head))
    with refusal("rows"):
        campaign.run(plan, done, jobs=1)


@pytest.mark.slow
def test_detectors_may_assume_another_rig(plan, done, tmp_path):
    text = PLAN.replace("seed = 3", 'seed = 3\nassume_set = { "pump.q_b" = 1e-7 }').replace("count = 5", "count = 4")
    (tmp_path / "watched.toml").write_text(text, encoding="utf-8")
    other = load_plan(tmp_path / "watched.toml")
    assert other.rig == plan.rig
    assert other.assumed.pump.q_b == 1e-7
    campaign.run(other, tmp_path / "other", jobs=1)
    rows, before = read_rows(tmp_path / "other"), read_rows(done)
    assert set(rows) < set(before)  # the records are the same
    assert {row.statements["watcher"].leak_lpm for row in rows.values()} == {1e-7}
    assert "differs from the rig" in render_campaign_page(judge_simulated_campaign(other, tmp_path / "other"))


def test_what_names_stand_for(plan):
    observed = parse_detector_name("watcher @ pressures")
    assert (observed.base, observed.view, observed.scorer) == ("watcher", "pressures", None)
    assert parse_detector_name("rms change").scorer is None
    assert parse_detector_name("d3 of p_A fell @ pressures").needs_threshold
    assert not parse_detector_name("sign rule: d3 of p_A fell").needs_threshold
    for wrong, named in (
        ("watchr", "'watcher'"),
        ("watcher, calibrated", "'watcher, calibrated'"),
        ("watcher, quick", "'watcher, quick'"),
        ("watcher @ nowhere", "nowhere"),
    ):
        with refusal(named):
            check_detector(wrong, plan.views)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ('pressures = ["u"', 'pressures = ["q_leak"', "views.pressures, q_leak"),
        ('pressures = ["u"', 'pressures = ["v"', "views.pressures"),
        ('pressures = ["u", "p_A", "p_B"]', "pressures = []", "views.pressures, 1"),
        ("[views]", '[views]\n"a @ b" = ["u"]', "a @ b"),
        ("seed = 3", 'seed = 3\nassume = "nowhere"', "campaign.assume"),
        ("seed = 3", "seed = 3\nassume_set = 3", "campaign.assume_set"),
        ("seed = 3", 'seed = 3\nassume_set = { "V_9" = 1.0 }', "campaign.assume"),
        ("false_alarm = 0.2", "false_alarm = 0.3", "0.3, campaign.false_alarm"),
        ('"watcher",', '"watcher", 3,', "campaign.detectors[2]"),
    ],
)
def test_what_breaks_a_rule_is_one_line(plan, tmp_path, before, after, words):
    assert before in PLAN
    (tmp_path / "watched.toml").write_text(PLAN.replace(before, after, 1), encoding="utf-8")
    with refusal(*words.split(", "), "watched.toml"):
        load_plan(tmp_path / "watched.toml")


@pytest.mark.slow
def test_channels_restrict_those_that_name_no_view(plan, tmp_path):
    text = PLAN.replace("seed = 3", 'seed = 3\nchannels = ["p_A", "p_B"]').replace("count = 5", "count = 4")
    (tmp_path / "watched.toml").write_text(text, encoding="utf-8")
    campaign.run(load_plan(tmp_path / "watched.toml"), tmp_path / "few", jobs=1)
    assert set(examined) == {("p_A", "p_B"), ("u", "p_A", "p_B")}


def row(number, verdict, leak=0.0, fault="", cause=None, use="judge", **stated):
    said = Statement(verdict, 4.0 if verdict == "leak" else 1.0, 3.0, cause=cause, **stated)
    scores = {"watcher": (said.ranking_score, said.onset_s)}
    inputs = {"id": f"{number:04x}", "use": use, "leak_lpm": leak, "fault": fault, "levels": {}, "replicate": number}
    return CaseRow(**inputs, flow_lpm=leak, scores=scores, statements={"watcher": said})


def test_flows_onsets_and_causes_by_hand():
    rows = [
        row(1, "leak", 1.0, onset_s=92.0, onset_interval_s=(91.0, 95.0), leak_lpm=1.5, leak_interval_lpm=(1.2, 2.0)),
        row(2, "leak", 1.0, onset_s=84.0, onset_interval_s=(80.0, 91.0), leak_lpm=0.9, leak_interval_lpm=(0.8, 1.1)),
        row(3, "no leak", 1.0, leak_lpm=0.3),
        row(4, "cannot tell", 1.0),
        row(5, "no leak", 0.0, leak_lpm=0.1, leak_interval_lpm=(-0.1, 0.3)),
        row(6, "no leak", 0.0, cause="friction change"),
        row(7, "no leak", fault="friction +20 %", cause="friction change"),
        row(8, "leak", fault="friction +20 %"),
        row(9, "cannot tell", fault="air 1 %"),
        replace(row(10, "leak", fault="air 1 %"), error="it failed"),
    ]
    outcome = judge(rows, ["watcher"], onset_s=90.0)
    (onset,) = outcome.onsets
    assert (onset.errors.n, onset.errors.median.value, onset.errors.median_size.value) == (2, -6.0, 2.0)
    assert (onset.errors.coverage.count, onset.errors.coverage.n) == (1, 2)
    free, leaky = outcome.flows
    assert (free.leak_lpm, free.errors.bias.value, free.errors.without, free.errors.coverage.value) == (0.0, 0.1, 1, 1)
    assert leaky.errors.bias.value == pytest.approx((0.5 - 0.1 - 0.7) / 3)
    assert (leaky.errors.without, leaky.errors.coverage.count, leaky.errors.coverage.n) == (1, 1, 2)
    assert (leaky.errors.median.value, leaky.errors.median_size.value) == pytest.approx((-0.1, 0.5))
    (named,) = outcome.causes
    said = {
        (true, name): int(named.confusion.counts[i][j])
        for i, true in enumerate(named.confusion.rows)
        for j, name in enumerate(named.confusion.columns)
        if named.confusion.counts[i][j]
    }
    assert said == {
        ("none", "none"): 1, ("none", "friction change"): 1,
        ("piston leak", "piston leak"): 2, ("piston leak", "none"): 1, ("piston leak", "cannot tell"): 1,
        ("friction change", "friction change"): 1, ("friction change", "piston leak"): 1,
        ("air in the oil", "cannot tell"): 2,
    }  # fmt: skip
    assert not outcome.thresholds


def test_a_fault_has_the_cause_that_a_detector_should_name():
    for words, cause in (
        ("pump leak x3", "pump leak"),
        ("rod seal B 0.01 L/min", "external leak"),
        ("friction +20 %", "friction change"),
        ("air 1 %", "air in the oil"),
        ("sensor p_A gain 2 %", "sensor fault"),
        ("duty amplitude x1.1", "changed duty"),
        ("circulation from 60 s", "pump leak"),
        ("filter A x10", "filter A x10"),
        ("what nobody simulates", "what nobody simulates"),
    ):
        assert expected_cause(words) == cause
    assert {row.cause for row in FAULTS.values()} - {""} <= {
        *get_args(Cause),
        *(event.cause for event in load_events()),
    }


def test_the_documented_plan_is_sound_where_the_example_is_installed(monkeypatch):
    example = Path(__file__).resolve().parents[2] / "docs" / "examples" / "ringing-energy"
    made = runpy.run_path(str(example / "ringing_energy.py"))["RingingEnergy"]
    with refusal("ringing energy"):
        load_plan(example / "judge.toml")
    monkeypatch.setattr(registry, "DETECTORS", {**registry.DETECTORS, "ringing energy": made})
    plan = load_plan(example / "judge.toml")
    assert not any(parse_detector_name(name).needs_threshold for name in plan.detectors)
    assert plan.views == {"pressures": ("u", "p_A", "p_B")}
