"""Cases many at a time: the scores that each case has by itself, whatever stands beside it, or one clear refusal."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from sealscope.campaigns.cases.case import list_cases
from sealscope.campaigns.cases.machines import experiment_with_flow_leak, size_leaks_on_short_run
from sealscope.campaigns.cases.scoring import judge_record, run_case
from sealscope.campaigns.execution import batches, store
from sealscope.campaigns.execution import run as campaign
from sealscope.campaigns.execution.batches import make_step_chooser
from sealscope.campaigns.plans.reader import read_plan
from sealscope.campaigns.results import judge_simulated_campaign, write_result
from sealscope.simulation.simulate import simulate_experiment

from ..refusals import refusal

QUIET = {f"sensors.{name}.{what}": 0.0 for name in ("p_A", "p_B") for what in ("noise", "drift", "hum")}
QUIET |= {"sensors.common_noise": 0.0, "daq.bits": 24}
SCORED = [
    "d3 of p_A fell", "d1 of p_B changed", "d2 of p_A low", "d4 of p_B rose", "sign rule: d3d4 of p_A fell",
    "d3d4 of both chambers as the thesis says", "d3 of p_A fell @ side", "d4 of p_B high @ side",
]  # fmt: skip


@pytest.fixture
def plan_with(text):
    """The tiny plan with other entries of [campaign], other tables, or other records."""

    def made(records=None, views=None, factors=None, **head):
        tree = tomllib.loads(text)
        tree["campaign"] |= head
        if views:
            tree["views"] = views
        if factors:
            tree["factors"] = factors
        if records is not None:
            tree["records"] = [one for one in tree["records"] if one.get("use") == "calibrate"] + records
        return read_plan(tree, "tiny.toml")

    return made


@pytest.fixture(scope="module")
def finished_in_batches(text, tmp_path_factory):
    """A folder with all rows of the tiny plan, made in batches."""
    folder = tmp_path_factory.mktemp("in batches")
    assert campaign.run(read_plan(tomllib.loads(text), "tiny.toml"), folder, batch=True).done == 26
    return folder


def rows_of(plan, cases):
    """The rows by case id, without their processor time."""
    return {row.id: replace(row, seconds=0.0) for row in batches.iter_batch_rows(plan, cases, 2)}


def alone(plan, case):
    """Scores of a case's whole recording, at the step that it has in a batch."""
    experiment = experiment_with_flow_leak(plan, case)
    experiment = replace(experiment, step=make_step_chooser(plan)(case, experiment))
    made = simulate_experiment(replace(experiment, leaks=size_leaks_on_short_run(experiment)))
    return judge_record(made.recording, plan.onset_s, plan, plan.rig)[0], made.truth


@pytest.mark.slow
def test_without_noise_the_scores_are_those_of_the_recordings(plan_with):
    records = [
        {"count": 4},
        {"leak": "0.015 L/min", "count": 4},
        {"leak": "0.05 L/min", "law": "orifice", "count": 2},
        {"fault": "friction x1.3", "count": 2},
    ]
    plan = plan_with(records, {"side": ["p_B"]}, set=QUIET, detectors=SCORED, onset="2.6 s")
    cases = [case for case in list_cases(plan) if case.use == "judge"]
    rows = rows_of(plan, cases)
    for case in cases:
        row = rows[case.id]
        scores, truth = alone(plan, case)
        assert row.error is None
        assert row.scores["d3 of p_A fell @ side"] == scores["d3 of p_A fell @ side"] == (None, None)
        known = [name for name in SCORED if name != "d3 of p_A fell @ side"]
        result = np.array([row.scores[name][0] for name in known])
        # a fault's jump falls on the boundary of another block
        within = 1e-6 if case.fault else 1e-9
        np.testing.assert_allclose(result, [scores[name][0] for name in known], rtol=0, atol=within)
        assert row.flow_lpm == pytest.approx(truth.mean_leak_lpm, rel=1e-6)
        if not case.fault and case.levels["closed"] == "0 %":  # where both choose the same step, down to it
            by_itself = run_case(plan, case)
            np.testing.assert_allclose(result, [by_itself.scores[name][0] for name in known], rtol=0, atol=1e-9)
    assert np.ptp([row.scores["d3 of p_A fell"][0] for row in rows.values()]) > 0.01


@pytest.mark.slow  # that a run in lanes is the run by itself: tests/simulation/test_batch.py
def test_with_noise_the_scores_are_of_the_same_law(plan_with):
    plan = plan_with([{"count": 30}], detectors=["d3 of p_A changed", "d1 of p_A fell", "d4 of p_B rose"])
    cases = [case for case in list_cases(plan) if case.use == "judge" and case.levels["closed"] == "0 %"]
    rows, others = rows_of(plan, cases), {case.id: run_case(plan, case) for case in cases}
    assert len(cases) == 15
    for name in plan.detectors:
        one, other = (np.array([made[case.id].scores[name][0] for case in cases]) for made in (rows, others))
        assert stats.ks_2samp(one, other).pvalue > 0.01
        assert not np.any(one == other)  # other noise of the same law


@pytest.mark.slow
@pytest.mark.parametrize("machines", [{}, {"profile": "bench"}])
def test_a_row_is_the_same_in_any_batch(plan_with, monkeypatch, machines):
    plan = plan_with(duration="4 s", onset="2 s", **machines)
    cases = list_cases(plan)[::6]
    whole = rows_of(plan, cases)
    assert not any(row.error for row in whole.values())
    monkeypatch.setattr(batches, "BATCH_SIZE", 7)
    assert rows_of(plan, cases[::-1]) == whole
    assert rows_of(plan, cases[3:4]) == {cases[3].id: whole[cases[3].id]}


@pytest.mark.slow
def test_interrupted_it_goes_on_to_the_same_bytes(plan_with, finished_in_batches, monkeypatch, tmp_path):
    plan = plan_with()
    expected = {
        path.name: path.read_bytes()
        for path in write_result(judge_simulated_campaign(plan, finished_in_batches), tmp_path)
    }
    monkeypatch.setattr(batches, "BATCH_SIZE", 8)
    reported = []

    def stop(done, total, failures):
        reported.append(done)
        if done == 11:  # in the middle of the second batch's rows
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        campaign.run(plan, tmp_path / "twice", batch=True, progress=stop)
    assert store.read_progress(plan, tmp_path / "twice").done == 11
    assert (
        campaign.run(plan, tmp_path / "twice", batch=True, progress=lambda done, *_: reported.append(done)).done == 26
    )
    assert reported[12:] == list(range(11, 27))
    again = {
        path.name: path.read_bytes()
        for path in write_result(judge_simulated_campaign(plan, tmp_path / "twice"), tmp_path)
    }
    assert again == expected
    ids = [json.loads(line)["id"] for line in (tmp_path / "twice" / "rows.jsonl").read_bytes().splitlines()]
    assert len(ids) == len(set(ids)) == plan.size


@pytest.mark.slow
def test_rows_of_both_ways_are_not_mixed(plan_with, finished_tiny, finished_in_batches):
    plan = plan_with()
    for folder, batch in ((finished_in_batches, False), (finished_tiny, True)):
        with refusal("mode"):
            campaign.run(plan, folder, jobs=1, batch=batch)
    ways = [judge_simulated_campaign(plan, folder).mode for folder in (finished_in_batches, finished_tiny)]
    assert ways == ["in batches", "run by run"]


@pytest.mark.slow
def test_a_case_that_fails_costs_no_other(plan_with):
    plan = plan_with([{"count": 5}, {"leak": "0.015 L/min", "count": 5}, {"leak": "30 L/min", "count": 2}])
    cases = [case for case in list_cases(plan) if case.use == "judge"]
    rows = rows_of(plan, cases)
    healthy = [case for case in cases if case.leak_lpm < 1]
    assert rows_of(plan, healthy) == {case.id: rows[case.id] for case in healthy}
    for case in cases:
        assert (rows[case.id].error is None) == (case.leak_lpm < 1)
        if case.leak_lpm > 1:
            assert rows[case.id].error == run_case(plan, case).error
            assert "smaller than the pump's mean flow" in rows[case.id].error


@pytest.mark.long
@pytest.mark.slow
def test_a_cell_that_cannot_be_run_costs_no_other(text):
    """A command that drives the piston into the cap and a pressure below vacuum."""
    tree = tomllib.loads(text)
    tree["factors"]["command"].append("9 sin(0.3t)")
    tree["campaign"] |= {"false_alarm": 0.25, "set": {"omega_per_volt": 26.7}}
    plan = read_plan(tree, "tiny.toml")
    cases = [case for case in list_cases(plan) if case.use == "judge"]
    rows = rows_of(plan, cases)
    for case in cases:
        hopeless = case.levels["command"] == "9 sin(0.3t)"
        assert (rows[case.id].error is not None) == hopeless == (run_case(plan, case).error is not None)
        if hopeless:
            assert "vacuum" in rows[case.id].error


@pytest.mark.slow
def test_a_leak_that_asks_for_a_shorter_step_gets_it(plan_with):
    plan = plan_with([{"leak": "0.55 L/min", "count": 1}], detectors=["sign rule: d3 of p_A fell"])
    case = list_cases(plan)[-1]
    by_itself, row = run_case(plan, case), rows_of(plan, [case])[case.id]
    assert (row.error, by_itself.error) == (None, None)
    assert row.flow_lpm == pytest.approx(by_itself.flow_lpm, rel=1e-2)
    assert row.scores["sign rule: d3 of p_A fell"][0] == pytest.approx(
        by_itself.scores["sign rule: d3 of p_A fell"][0], abs=0.1
    )


@pytest.mark.parametrize(
    ("changed", "names"),
    [
        ({"detectors": ["d3 of p_A fell", "rms change"]}, "'rms change'"),
        ({"detectors": ["volume balance"]}, "'volume balance'"),
        ({"detectors": ["rms change"]}, "'rms change'"),
        ({"detectors": ["diagnose"]}, "'diagnose'"),
        ({"keep_recordings": True}, "keep_recordings, true"),
        ({"records": [{"fault": "sensor p_A offset 2 psi", "count": 1}]}, "fault, sensor p_A offset"),
        ({"records": [{"leak": "0.01 L/min", "fault": "oil +20 K", "count": 1}]}, "leak, oil"),
        ({"set": {"sensors.p_A.drop_rate": 0.1}}, "sensors.p_A.drop_rate, 0.1"),
        ({"set": {"motor.integrator": "euler"}}, "motor.integrator, euler"),
        ({"factors": {"daq.sample_rate": ["500 Hz", "250 Hz"]}}, "sampling rate, 500 Hz, 250 Hz"),
        ({"factors": {"command": ["position 20 mm sin(2t)"]}}, "command, target"),
        ({"onset": "5.9 s"}, "onset, 6 s, 5.9 s"),
    ],
)
def test_what_a_batch_cannot_do_is_refused_by_name(plan_with, tmp_path, changed, names):
    plan = plan_with(**changed)
    with refusal("--batch", "tiny.toml", *names.split(", ")):
        campaign.run(plan, tmp_path / "none", batch=True)
    assert not (tmp_path / "none").exists()


def test_bad_calls_are_refused_before_the_work(plan_with, tmp_path):
    plan = plan_with()
    with refusal("--cluster", "--batch"):
        campaign.run(plan, tmp_path / "none", batch=True, cluster="tcp://127.0.0.1:1")
    assert not (tmp_path / "none").exists()
