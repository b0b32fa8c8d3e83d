"""From a case to its machine: the bench's draw by the case's seed, the case's levels on top, the leak sized on it."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.campaigns.cases.case import list_cases, profile_key
from sealscope.campaigns.cases.machines import SIZING_SECONDS, case_experiment
from sealscope.campaigns.cases.scoring import run_case
from sealscope.campaigns.plans.duty import parse_plan_fault, parse_throttle_values
from sealscope.campaigns.plans.reader import load_plan
from sealscope.simulation.bench import profile
from sealscope.simulation.bench.profile import load_profile
from sealscope.simulation.simulate import simulate_experiment

from ..refusals import refusal


@pytest.fixture
def bench(text, tmp_path):
    """The tiny plan on the bench, with another fault beside the leaks."""
    path = tmp_path / "bench.toml"
    with_fault = '\n[[records]]\nfault = "pump leak x3"\ncount = 2\n'
    path.write_text(text.replace("seed = 3", 'seed = 3\nprofile = "bench"') + with_fault, encoding="utf-8")
    return load_plan(path)


def test_every_case_has_a_machine_of_its_own(bench):
    experiments = [case_experiment(bench, case) for case in list_cases(bench)[:12]]
    assert len({one.rig["fluid.K_oil"] for one in experiments}) == 12
    assert len({one.seed for one in experiments}) == 12
    assert all(one.drifts for one in experiments)
    for one in experiments:
        assert 550e6 <= one.rig["fluid.K_oil"] <= 800e6


def test_the_cells_are_what_the_plan_says_and_not_what_was_drawn(bench):
    for case in list_cases(bench)[:8]:
        experiment = case_experiment(bench, case)
        assert str(experiment.command) == case.levels["command"]
        closed = 0.5 if case.levels["closed"] == "50 %" else 0.0
        assert experiment.rig["line.closed_A"] == experiment.rig["line.closed_B"] == closed
        assert experiment.rig["line.orifices"] == ("present" if closed else bench.rig["line.orifices"])


def test_the_same_case_gives_the_same_bytes(bench):
    case = list_cases(bench)[0]
    one, other = (simulate_experiment(case_experiment(bench, case)).recording for _ in range(2))
    assert all(np.array_equal(one[name], other[name]) for name in one.channels)
    rows = [run_case(bench, case).as_dict() | {"seconds": 0.0} for _ in range(2)]
    assert rows[0] == rows[1]
    assert rows[0]["error"] is None


@pytest.mark.slow
def test_a_leak_has_its_mean_on_its_own_machine(bench):
    """Sized over a short run; the row tells what the record had."""
    assert bench.duration_s < SIZING_SECONDS
    for case in [case for case in list_cases(bench) if case.leak_lpm][:6]:
        row = run_case(bench, case)
        assert row.error is None
        assert row.flow_lpm == pytest.approx(case.leak_lpm, rel=0.15)
        assert case_experiment(bench, case).onset() == bench.onset_s


def test_a_fault_sets_in_at_the_onset_unless_it_says_when(bench):
    case = next(case for case in list_cases(bench) if case.fault)
    (fault,) = case_experiment(bench, case).faults
    assert fault.opening.onset() == bench.onset_s
    assert parse_plan_fault("pump leak x3 from 1 s", 3.0).opening.onset() == 1.0
    with refusal("fault"):
        parse_plan_fault("a bad day", 3.0)


def test_a_profile_is_known_by_what_it_says(tmp_path):
    text = (profile._PACKAGED / "bench.toml").read_text(encoding="utf-8")
    copy, other = tmp_path / "copy.toml", tmp_path / "other.toml"
    copy.write_text(text, encoding="utf-8")
    other.write_text(text.replace("[550, 800]", "[551, 800]"), encoding="utf-8")
    assert profile_key(load_profile(copy)) == profile_key(load_profile("bench"))
    assert profile_key(load_profile(other)) != profile_key(load_profile("bench"))


def test_a_profile_beside_the_plan_is_found(text, tmp_path):
    (tmp_path / "own.toml").write_text((profile._PACKAGED / "bench.toml").read_text(encoding="utf-8"), encoding="utf-8")
    path = tmp_path / "plan.toml"
    path.write_text(text.replace("seed = 3", 'seed = 3\nprofile = "own.toml"'), encoding="utf-8")
    assert case_experiment(load_plan(path), list_cases(load_plan(path))[0]).drifts


def test_closing_is_a_share():
    assert parse_throttle_values("25 %")["line.closed_A"] == parse_throttle_values(0.25)["line.closed_A"] == 0.25
    for wrong in ("100 %", -0.1, 1.0):
        with refusal("closed"):
            parse_throttle_values(wrong)
