"""A plan says what it wants or is refused in one line; a case's name and seeds are what it is."""

from __future__ import annotations

import hashlib
import subprocess
import sys

import pytest

from sealscope.campaigns.cases.case import interleave_cases, list_cases
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.campaigns.plans.reader import load_plan, plan_names

from ..refusals import refusal

#: Digests of the ids and noise seeds of every packaged plan's cases. A change draws new machines: the published figures
#: of the plan no longer belong to its records.
DRAWN = {
    "a90-bench": "5c64ff06f5c84936",
    "a90-still": "0e044672371d0c85",
    "bench-closed-loop": "c4c952f2f6132e55",
    "bench-closed-loop-development": "f7ad3aaaab8b6493",
    "bench-detectors": "c14436aede0a4bfe",
    "bench-faults": "fe66e262367aaedd",
    "bench-load": "8f873b29dd0e4b27",
    "bench-load-development": "e4d8a6226d020574",
    "bench-load-resting-development": "2c046579e9b41c1e",
    "bench-pressures": "a725a60b2a529fb9",
    "bench-quick": "5e2c6ad77f0da6f0",
    "bench-single-rod": "7ed0e63b533648d9",
    "bench-single-rod-development": "fad6b4d692c86f36",
    "bench-thesis": "e034193cb0b6574f",
    "bench-unmodelled": "f4613fe47fdbe6c2",
    "bench-unmodelled-development": "778e5fc7b49f54f0",
    "bench-valve": "c2065dbf8536fac1",
    "bench-volume": "afca12e9d27e4824",
    "duty-pump": "b9abb89ca1d56dd8",
    "duty-valve": "08b1c921bbe09801",
}


def plan_of(tmp_path, text):
    path = tmp_path / "plan.toml"
    path.write_text(text, encoding="utf-8")
    return load_plan(path)


def test_a_plan_is_read_with_its_units(tiny):
    plan = load_plan(tiny)
    assert (plan.duration_s, plan.onset_s, plan.size) == (6.0, 3.0, 26)
    assert [one.leak_lpm for one in plan.records] == pytest.approx([0.0, 0.0, 0.015, 0.03])
    assert plan.factors["closed"] == ("0 %", "50 %")


def test_kinds_of_records_take_turns(tiny):
    """However early a campaign ends, each kind has its share, within one record."""
    cases = list_cases(load_plan(tiny))
    order = interleave_cases(cases)
    assert sorted(order, key=cases.index) == cases
    kinds = [(case.use, case.leak_lpm) for case in order]
    for done in range(len(cases)):
        for kind in set(kinds):
            assert abs(kinds[:done].count(kind) - done * kinds.count(kind) / len(kinds)) <= 1.0


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ('name = "tiny"', 'name = "../tiny"', "name, 80"),
        ('duration = "6 s"', 'duration = "6 V"', "duration"),
        ('onset = "3 s"', 'onset = "7 s"', "onset, duration, 7"),
        ("false_alarm = 0.2", "false_alarm = 1.5", "campaign.false_alarm"),
        (
            "false_alarm = 0.2",
            "false_alarm = 0.01",
            "198, 99, 2",
        ),
        ("detectors = [", 'detectors = "all" # [', "campaign.detectors"),
        ('"d3 of p_A fell", ', '"d3 of p_A fel", ', "'d3 of p_A fell'"),
        ('command = ["3 sin(4t)"', 'command = ["3 sinus(4t)"', "factors.command"),
        ('closed = ["0 %"', 'closed = ["100 %"', "closed, 0, 100"),
        ('closed = ["0 %", "50 %"]', 'opened = ["0 %"]', "factors.opened"),
        ('use = "calibrate"', 'use = "guess"', "records[1].use, 'calibrate', 'judge'"),
        ("count = 6", "count = 0", "records[2].count, 1"),
        ('leak = "0.015 L/min"', 'leak = "0.015 L"', "leak"),
        ('leak = "30 cm^3/min"', 'leak = "0.015 L/min"', "records"),
        ('use = "calibrate"', 'use = "calibrate"\nleak = "1 L/min"', "leak-free"),
        ("seed = 3", "seed = 3\ncolour = 2", "campaign.colour"),
        ("seed = 3", 'seed = 3\nunit = "mL/min"', "campaign.unit"),
        ("[factors]", "[factor]", "[factor]"),
        ("seed = 3", "seed = 3\nrate = true", "campaign.rate"),
        ("seed = 3", "seed = 3\nfactors = {}", "campaign.factors"),
        ("seed = 3", "seed = 3\nplace = 'here'", "campaign.place"),
        ("seed = 3", "seed = ", "TOML"),
        ("seed = 3", 'seed = 3\nrig = "nowhere"', "campaign.rig"),
        ("seed = 3", 'seed = 3\nset = { "V_9" = 1.0 }', "campaign.set"),
        ("seed = 3", 'seed = 3\nkeep_recordings = "yes"', "campaign.keep_recordings"),
    ],
)
def test_what_breaks_a_rule_is_one_line_with_the_place(tmp_path, text, before, after, words):
    assert before in text
    with refusal(*words.split(", "), "plan.toml"):
        plan_of(tmp_path, text.replace(before, after, 1))


def test_the_packaged_plans_are_sound():
    pytest.importorskip("sealscope.simulation.bench.machines")
    for name in plan_names():
        plan = load_plan(name)
        assert plan.name == name
    bench = load_plan("bench-thesis")
    sizes = {one.leak_lpm: one.count for one in bench.records if one.use == "judge"}
    assert {0.0005: 500, 0.001: 500, 0.0042: 500, 0.0075: 500, 0.015: 500}.items() <= sizes.items()
    assert bench.duration_s == 180.0
    assert bench.rig.daq.sample_rate == 500.0
    assert len(bench.factors["command"]) == len(bench.factors["closed"]) == 4


@pytest.mark.parametrize("name", DRAWN)
@pytest.mark.slow
def test_the_packaged_plans_draw_the_machines_of_their_published_figures(name):
    text = "".join(f"{case.id}{case.noise_seed}" for case in list_cases(load_plan(name)))
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == DRAWN[name]


def test_records_go_round_the_cells(tiny):
    cases = list_cases(load_plan(tiny))
    assert len({case.id for case in cases}) == len(cases) == 26
    assert len({case.machine_seed for case in cases} | {case.noise_seed for case in cases}) == 52
    per_cell = {}
    for case in cases:
        if case.use == "calibrate":
            key = tuple(case.levels.items())
            per_cell[key] = per_cell.get(key, 0) + 1
    assert sorted(per_cell.values()) == [2, 2, 3, 3]


def test_more_records_leave_the_others_what_they_were(tmp_path, text):
    few = {case.id for case in list_cases(plan_of(tmp_path, text))}
    more = {case.id for case in list_cases(plan_of(tmp_path, text.replace("count = 6", "count = 16")))}
    assert few < more
    assert len(more - few) == 10


@pytest.mark.parametrize(
    "change",
    [
        ("seed = 3", "seed = 4"),
        ('duration = "6 s"', 'duration = "7 s"'),
        ("seed = 3", 'seed = 3\nset = { "V_1" = "51 cm^3" }'),
    ],
)
def test_another_world_gives_other_cases(tmp_path, text, change):
    few = {case.id for case in list_cases(plan_of(tmp_path, text))}
    other = {case.id for case in list_cases(plan_of(tmp_path, text.replace(*change)))}
    assert not few & other


def test_detectors_do_not_change_the_records(tmp_path, text):
    plain = list_cases(plan_of(tmp_path, text))
    other = list_cases(plan_of(tmp_path, text.replace('"d3 of p_A changed", ', "")))
    assert [case.id for case in plain] == [case.id for case in other]


@pytest.mark.slow
def test_names_and_seeds_are_the_same_in_another_process(tiny):
    code = (
        "import sys\nfrom sealscope.campaigns.plans.reader import load_plan\n"
        "from sealscope.campaigns.cases.case import list_cases\n"
        "print([(c.id, c.machine_seed, c.noise_seed) for c in list_cases(load_plan(sys.argv[1]))])"
    )
    result = subprocess.run([sys.executable, "-c", code, str(tiny)], capture_output=True, text=True, check=True)
    plan = load_plan(tiny)
    assert isinstance(plan, SimulatedPlan)
    assert result.stdout.strip() == str([(c.id, c.machine_seed, c.noise_seed) for c in list_cases(plan)])
