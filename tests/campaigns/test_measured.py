"""Campaigns over recordings and data sets that somebody else measured."""

from __future__ import annotations

from shutil import copy, copytree

import pytest

from sealscope.campaigns.cases.recordings import judge_recordings
from sealscope.campaigns.plans.reader import load_plan
from sealscope.campaigns.results import judge_recorded_campaign, prior_knowledge, write_result
from sealscope.diagnosis.diagnose import diagnose
from sealscope.recordings import read, write
from sealscope.reporting.campaign.page import campaign_text, render_campaign_page
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

from ..refusals import refusal
from ..representatives import SLOW, few

PLAN = """
[campaign]
name = "mine"
false_alarm = 0.1
detectors = ["d3 of p_A changed", "sign rule: d3 of p_A fell"]

[recordings]
rate = "500 Hz"

[[recordings.sets]]
files = "healthy-*.csv"
use = "calibrate"
end = 11

[[recordings.sets]]
files = "healthy-*.csv"
first = 11

[[recordings.sets]]
files = "leaky-*.csv"
size = 0.3
"""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Twelve healthy recordings and two leaky ones of one machine."""
    tmp_path = tmp_path_factory.mktemp("measured")
    for seed in range(1, 13):
        made = simulate_experiment(Experiment.of(command="3 sin(4t)", duration=8.0, seed=seed)).recording
        write(made, tmp_path / f"healthy-{seed}.csv")
    for seed in range(2):
        leak = simulate_experiment(
            Experiment.of(command="3 sin(4t)", duration=8.0, seed=50 + seed, leak="0.3 L/min from 4 s")
        )
        write(leak.recording, tmp_path / f"leaky-{seed}.csv")
    return tmp_path


@pytest.fixture
def folder(recordings, tmp_path):
    """A copy of them."""
    return copytree(recordings, tmp_path, dirs_exist_ok=True)


def plan_of(folder, text=PLAN):
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return load_plan(path)


def test_recordings_are_calibrated_and_judged(folder):
    result = judge_recorded_campaign(plan_of(folder), folder)
    assert (result.judgement.leak_free, result.judgement.judged, len(result.rows)) == (10, 4, 14)
    table = {row.detector: row for row in result.judgement.table}
    assert table["d3 of p_A changed"].alarms.count == 2
    assert table["d3 of p_A changed"].false_alarm.n == 2
    files = write_result(result, folder / "out")
    assert {path.name for path in files} >= {"table.csv", "records.csv", "thresholds.csv"}


@pytest.mark.slow
def test_the_same_recordings_give_the_same_files(folder):
    files = write_result(judge_recorded_campaign(plan_of(folder), folder), folder / "out")
    before = {path.name: path.read_bytes() for path in files}
    again = write_result(judge_recorded_campaign(plan_of(folder), folder), folder / "out")
    assert {path.name: path.read_bytes() for path in again} == before


@pytest.mark.slow
@pytest.mark.long
def test_numbers_in_names_count_as_numbers(folder):
    """`healthy-10` comes after `healthy-9`: the first ten are those numbered 1 to 10."""
    rows = judge_recordings(plan_of(folder), folder)
    judged = judge_recordings(plan_of(folder, PLAN.replace("first = 11", "first = 12")), folder)
    assert sum(row.use == "calibrate" for row in rows) == 10
    left_out = {row.id for row in rows} - {row.id for row in judged}
    assert len(left_out) == 1


@pytest.mark.slow
@pytest.mark.long
def test_a_file_that_cannot_be_judged_is_a_row_with_its_error(folder):
    (folder / "leaky-9.csv").write_text("t [s],p_A [Pa]\n0,1\n", encoding="utf-8")
    rows = judge_recordings(plan_of(folder), folder)
    errors = [row.error for row in rows if row.error]
    assert len(errors) == 1
    assert "leaky-9.csv" in errors[0]


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ('files = "leaky-*.csv"', 'files = "../*.csv"', "files"),
        ("size = 0.3", "size = -1.0", "recordings.sets[3].size, 0"),
        ("end = 11", "end = 11\nsize = 1.0", "calibrate, 0"),
        ('rate = "500 Hz"', "map = 3", "recordings.map"),
        ("size = 0.3", "colour = 1", "colour"),
        (PLAN[PLAN.index("[[recordings.sets]]") :], "", "recordings.sets"),
        ('files = "leaky-*.csv"', 'files = ""', "recordings.sets[3].files"),
        ('name = "mine"', 'name = "mine"\nplace = "here"', "campaign.place"),
        ('name = "mine"', 'name = "mine"\nrate = "1 kHz"', "campaign.rate"),
    ],
)
def test_a_wrong_plan_is_one_line(tmp_path, before, after, words):
    assert before in PLAN
    with refusal(*words.split(", ")):
        plan_of(tmp_path, PLAN.replace(before, after))


@pytest.mark.parametrize("stated", few([True, False], 1, SLOW))
def test_a_recording_is_judged_as_diagnose_judges_it(recordings, tmp_path, stated):
    """Where nobody states a rig neither of them states a flow, and the plan has given none."""
    text = PLAN[: PLAN.index("[[recordings.sets]]")] + '[[recordings.sets]]\nfiles = "leaky-0.csv"\n'
    text = text.replace('"d3 of p_A changed", "sign rule: d3 of p_A fell"]', '"diagnose", "volume balance"]')
    plan = plan_of(tmp_path, text.replace("[recordings]", 'assume = "thesis"\n[recordings]') if stated else text)
    lines = (recordings / "leaky-0.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    file = tmp_path / "leaky-0.csv"
    file.write_text("".join(line for line in lines if not line.startswith("#")), encoding="utf-8")  # of no known rig
    (row,) = judge_recordings(plan, tmp_path)
    diagnosis = diagnose(
        read(file, rate=500.0),
        rig="thesis" if stated else None,
        false_alarm_probability=plan.false_alarm,
    )
    said = row.statements["diagnose"]
    assert (said.verdict, said.onset_s, said.leak_lpm) == (diagnosis.verdict, diagnosis.onset_s, diagnosis.leak_lpm)
    assert (said.verdict, said.leak_lpm is not None) == ("leak", stated)
    assert {known.rig for known in prior_knowledge(plan).values()} == {"thesis" if stated else ""}


def test_names_of_files_may_hold_any_digit(recordings, tmp_path):
    for name in ("1²2.csv", "1.csv", "².csv"):
        copy(recordings / "healthy-1.csv", tmp_path / name)
    text = PLAN[: PLAN.index("[[recordings.sets]]")] + '[[recordings.sets]]\nfiles = "*.csv"\n'
    assert len(judge_recordings(plan_of(tmp_path, text.replace('"d3 of p_A changed", ', "")), tmp_path)) == 3


def test_one_recording_is_a_campaign(recordings, tmp_path):
    copy(recordings / "leaky-0.csv", tmp_path)
    text = PLAN[: PLAN.index("[[recordings.sets]]")] + '[[recordings.sets]]\nfiles = "*.csv"\nsize = 0.3\n'
    result = judge_recorded_campaign(plan_of(tmp_path, text.replace('"d3 of p_A changed", ', "")), tmp_path)
    assert [(row.alarms.count, row.alarms.n, row.false_alarm) for row in result.judgement.table[:1]] == [(1, 1, None)]
    assert "leaks of 0.3 L/min" in campaign_text(result) + render_campaign_page(result)
    assert write_result(result, tmp_path / "out")


def test_a_set_without_files_and_a_file_in_two_sets_are_refused(folder):
    with refusal("none"):
        judge_recordings(plan_of(folder, PLAN.replace("leaky-*", "nothing-*")), folder)
    with refusal("set"):
        judge_recordings(plan_of(folder, PLAN.replace("first = 11", "first = 10")), folder)


@pytest.mark.slow
def test_rotary_strokes(real_folder):
    """Levels of d3 lie high where the seal is defective; ten healthy strokes raise one alarm at 10 %."""
    result = judge_recorded_campaign(load_plan("rotary-seal"), real_folder / "vtnsi_actuator")
    assert (result.judgement.leak_free, result.judgement.judged, len(result.judgement.failed)) == (20, 40, 0)
    assert {duty for _, duty in result.judgement.thresholds} == {"in", "out"}  # the two directions
    table = {row.detector: row for row in result.judgement.table}
    assert table["d3 of p_B high"].alarms.value > 0.5
    assert table["d3 of p_B high"].false_alarm.count <= 4
    assert {"always fire", "never fire"} <= set(table)
