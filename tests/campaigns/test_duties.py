"""Targets, controllers and loads of a plan: the words of the command line, and what becomes of them on a machine."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import pytest

from sealscope.campaigns.cases.case import list_cases
from sealscope.campaigns.cases.machines import case_experiment
from sealscope.campaigns.cases.scoring import run_case
from sealscope.campaigns.execution.run import run
from sealscope.campaigns.execution.store import read_progress
from sealscope.campaigns.plans.duty import check_controllers
from sealscope.campaigns.plans.reader import load_plan, plan_names
from sealscope.control import Flatness, registry
from sealscope.errors import InputError
from sealscope.simulation.bench.machines import draw
from sealscope.simulation.bench.profile import load_profile

from ..refusals import refusal

PLAN = """
[campaign]
name = "loops"
rig = "thesis-closed-loop"
profile = "closed-loop"
duration = "6 s"
onset = "3 s"
seed = 3
detectors = ["volume balance"]

[factors]
command = ["position 20 mm sin(2t)"]
controller = ["pi", "flatness"]
load = ["300 N sin(0.5t)"]

[[records]]
count = 2
"""
PROFILES = ("closed-loop", "load", "single-rod")


def plan_of(folder, text):
    path = folder / "plan.toml"
    path.write_text(text, encoding="utf-8")
    return load_plan(path)


@pytest.mark.slow
def test_a_machine_follows_its_target_under_its_load(tmp_path):
    plan = plan_of(tmp_path, PLAN)
    pi, flat = (case_experiment(plan, case) for case in list_cases(plan))
    assert str(pi.target) == "position 20 mm sin(2t)"
    assert [type(one.active_controller).__name__ for one in (pi, flat)] == ["PositionPI", "Flatness"]
    assert str(pi.load) == "load 300 N sin(0.5t)"
    assert pi.x_0 == 0.0
    row = run_case(plan, list_cases(plan)[0])
    assert row.error is None
    assert row.statements["volume balance"].verdict in ("no leak", "cannot tell")  # 6 s are short


def test_the_controller_assumes_the_rig_as_designed_and_not_the_machine(tmp_path):
    plan = plan_of(tmp_path, PLAN)
    experiment = case_experiment(plan, list_cases(plan)[1])
    assert experiment.active_controller == Flatness.from_rig(plan.rig) != Flatness.from_rig(experiment.rig)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ('"position 20 mm sin(2t)"', '"position 900 mm sin(2t)"', "factors.command"),
        ('"position 20 mm sin(2t)"', '"position 20 sin(2t)"', "factors.command"),
        ('"position 20 mm sin(2t)"', "5", "command, 5"),
        ('"position 20 mm sin(2t)"', '"3 sin(4t)"', "factors.controller"),
        ('"pi", "flatness"', '"pid"', "factors.controller"),
        ('"pi", "flatness"', "2", "controller, 2"),
        ("300 N", "300", "factors.load"),
    ],
)  # fmt: skip
def test_a_duty_that_no_run_can_have_is_refused_in_one_line(tmp_path, before, after, words):
    with refusal(*words.split(", "), "plan.toml"):
        plan_of(tmp_path, PLAN.replace(before, after))


def test_a_controller_that_reads_the_pump_s_angle_is_refused_on_a_rig_without_a_pump(tmp_path):
    on_valve = PLAN.replace('rig = "thesis-closed-loop"', 'rig = "servo-valve"')
    with refusal("factors.controller", "plan.toml"):
        plan_of(tmp_path, on_valve.replace('"flatness"', '"fault-tolerant"'))


def test_a_controller_of_ones_own_is_part_of_the_case(tmp_path):
    law = "class Law:\n    rate = 500.0\n    delay = 1\n    def __init__(self, rig): pass\n"
    law += "    def start(self):\n        return lambda measured: {gain} * (measured.target - measured.x)\n"
    own, cases = tmp_path / "own.py", []
    for gain in (50.0, 60.0):
        own.write_text(law.format(gain=gain), encoding="utf-8")
        plan = plan_of(tmp_path, PLAN.replace('"pi", "flatness"', f'"{own}:Law"'))
        cases.append({case.id for case in list_cases(plan)})
        assert case_experiment(plan, list_cases(plan)[0]).active_controller.rate == 500.0
    assert not cases[0] & cases[1]


EVIL = "from pathlib import Path\nPath({mark!r}).touch()\n"


@pytest.mark.parametrize("of", ["factor", "profile", "module"])
def test_a_plan_runs_no_program_that_the_caller_does_not_trust(tmp_path, monkeypatch, of):
    """Neither a file beside the plan nor a module that is installed for something else, whatever they do when made."""
    mark = tmp_path / "ran"
    (tmp_path / "evil.py").write_text(EVIL.format(mark=str(mark)))
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "__init__.py").write_text(EVIL.format(mark=str(mark)))
    (tmp_path / "package" / "inner.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    name = "package.inner:x" if of == "module" else f"{tmp_path / 'evil.py'}:x"
    text = PLAN.replace('"pi", "flatness"', f'"{name}"')
    if of == "profile":
        text = PLAN.replace('controller = ["pi", "flatness"]\n', "").replace('"closed-loop"', '"own.toml"')
        duty = f'[duty]\ncommands = ["position 20 mm sin(2t)"]\ncontrollers = ["{name}"]\nclosed = [50]\nwhy = "x"\n'
        (tmp_path / "own.toml").write_text(f'[profile]\nname = "own"\ntitle = "own"\n{duty}')
        text = text.replace('rig = "own.toml"', 'rig = "thesis-closed-loop"')
    plan = plan_of(tmp_path, text)
    assert read_progress(plan, tmp_path / "rows").done == 0
    with refusal(":x", "plan.toml"):
        run(plan, tmp_path / "rows")
    assert not mark.exists()
    with pytest.raises(InputError, match="could not be made"):
        run(plan, tmp_path / "rows", trust=True)
    assert mark.exists()
    assert not (tmp_path / "rows").exists()


def test_an_installed_controller_is_run(tmp_path, monkeypatch):
    point = EntryPoint("own law", "sealscope.control.flatness:Flatness", registry.GROUP)
    monkeypatch.setattr(registry, "_installed", lambda: {point.name: point})
    plan = plan_of(tmp_path, PLAN.replace('"pi", "flatness"', '"own law"').replace("count = 2", "count = 1"))
    check_controllers(plan, trust=False)
    assert isinstance(case_experiment(plan, list_cases(plan)[0]).active_controller, Flatness)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [PROFILES[0], *(pytest.param(name, marks=[pytest.mark.slow, pytest.mark.long]) for name in PROFILES[1:])]
)
def test_each_family_is_either_for_development_or_held_out(name):
    plans = [load_plan(each) for each in plan_names() if each.startswith(f"bench-{name}")]
    assert {plan.name for plan in plans if plan.part != "development"} == {f"bench-{name}"}
    families = [family for plan in plans for family in plan.factors["family"]]
    assert sorted(families) == sorted(family.name for family in load_profile(name).families)
    seeds = [{case.machine_seed for case in list_cases(plan)} for plan in plans]
    assert len(set().union(*seeds)) == sum(map(len, seeds))
    for plan in plans:
        assert sum(group.count for group in plan.records if not (group.leak_lpm or group.fault)) >= 400
        for case in list_cases(plan)[:6]:
            case_experiment(plan, case)


def test_a_profile_says_what_differs_from_the_one_that_it_extends():
    bench, rod = draw("bench", 5).overrides, draw("single-rod", 5, rig="single-rod-eha")
    assert rod.controller == "pi"
    changed = {name for name, value in rod.overrides.items() if bench.get(name) != value}
    own = {"fluid.K_oil", "pump.G_pump", "fluid.p_charge", "makeup.p_crack"}
    scaled = {"friction.F_pr", "friction.F_cfr", "friction.F_v"}  # factors on another rig's values
    assert own <= changed <= own | scaled | {"line.closed_A", "line.closed_B", "line.orifices"}
    assert 0.8e9 <= rod.overrides["fluid.K_oil"] <= 1.15e9


def test_a_family_draws_its_loads_and_controllers():
    machines = [draw("load", seed, rig="thesis-closed-loop", family="steady, loop closed") for seed in range(20)]
    assert {machine.controller for machine in machines} == {"pi", "fault-tolerant"}
    assert {str(machine.load) for machine in machines} == {"load 2 kN", "load -1 kN"}
    with refusal("controller", "target"):
        draw("load", 1, rig="thesis-closed-loop").experiment(controller="pi")


@pytest.mark.parametrize(
    ("duty", "words"),
    [
        ('commands = ["3 sin(t)"]\ncontrollers = ["pi"]\nwhy = "x"\n', "controller, target"),
        ('commands = ["3 sin(t)"]\nloads = ["2"]\nwhy = "x"\n', "load"),
        ('commands = ["3 sin(t)"]\nloads = "2 kN"\nwhy = "x"\n', "duty.loads, '2 kN'"),
        ('commands = ["position 5 mm sin(t)"]\namplitude = [0.9, 1.1]\nwhy = "x"\n', "amplitude"),
    ],
)
def test_a_profiles_duty_is_refused_in_one_line(tmp_path, duty, words):
    path = tmp_path / "own.toml"
    path.write_text(f'[profile]\nname = "own"\ntitle = "own"\nextends = "bench"\n[duty]\n{duty}', encoding="utf-8")
    with refusal(*words.split(", "), "own.toml"):
        load_profile(path)
