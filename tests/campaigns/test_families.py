"""What a campaign over families shows, from rows whose truth is known."""

from __future__ import annotations

import pytest

from sealscope.campaigns.cases.case import list_cases
from sealscope.campaigns.cases.machines import case_leaks
from sealscope.campaigns.cases.row import CaseRow, Statement
from sealscope.campaigns.judging.alarms import ANY_LAW
from sealscope.campaigns.judging.judge import judge
from sealscope.campaigns.judging.tables import build_tables
from sealscope.campaigns.plans.duty import ALL_FAMILIES
from sealscope.campaigns.plans.reader import load_plan
from sealscope.reporting.campaign.page_tables import page_tables

from ..refusals import refusal

NAME = "diagnose"


def row(number, family, verdict, leak=0.0, law="laminar", interval=None, error=None):
    statement = Statement(verdict, 1.0, 2.0, leak_lpm=leak, leak_interval_lpm=interval)
    return CaseRow(
        id=f"{number:016x}", use="judge", leak_lpm=leak, fault="", levels={"family": family}, replicate=number,
        flow_lpm=leak, statements={} if error else {NAME: statement}, scores={} if error else {NAME: (1.0, None)},
        law=law, error=error,
    )  # fmt: skip


ROWS = [
    row(0, "hoses", "no leak"),
    row(1, "hoses", "leak"),
    row(2, "hoses", "cannot tell", error="it broke"),
    row(3, "hoses", "leak", 0.004, "laminar", (0.003, 0.005)),
    row(4, "hoses", "no leak", 0.004, "orifice", (0.005, 0.006)),
    row(5, "mass", "no leak", 0.004, "orifice"),
    row(6, "mass", "no leak"),
]


def findings():
    return {(one.family, one.leak_lpm, one.law): one for one in judge(ROWS, [NAME], false_alarm=0.01).families}


def test_each_family_is_counted_by_hand():
    result = findings()
    hoses = result["hoses", 0.0, ANY_LAW]
    assert (hoses.alarms.count, hoses.alarms.n, hoses.cannot_tell.count, hoses.failed) == (1, 3, 1, 1)
    assert result[ALL_FAMILIES, 0.0, ANY_LAW].alarms.n == 4
    both = result["hoses", 0.004, ANY_LAW]
    assert (both.alarms.count, both.alarms.n) == (1, 2)
    assert (both.coverage.count, both.coverage.n) == (1, 2)
    assert result["hoses", 0.004, "laminar"].coverage.count == 1
    assert result["mass", 0.004, "orifice"].coverage.n == 0
    assert ("mass", 0.004, ANY_LAW) not in result  # it has one law


def test_the_table_says_which_half_it_is():
    families = build_tables(judge(ROWS, [NAME]), "L/min", {}, part="held out")["families"]
    assert {line["part"] for line in families} == {"held out"}
    assert {line["family"] for line in families} == {ALL_FAMILIES, "hoses", "mass"}


def test_the_page_shows_each_family():
    lines = page_tables(judge(ROWS, [NAME]), "L/min")["families"]["rows"]
    assert lines[0][:3] == (NAME, ALL_FAMILIES, "no leak")
    both = next(line for line in lines if line[1:3] == ("hoses", "0.004 any"))
    assert both[3].startswith("50 %")


def test_rows_survive_being_stored():
    assert [CaseRow.from_dict(one.as_dict()).law for one in ROWS] == [one.law for one in ROWS]


@pytest.mark.slow
def test_a_mixture_is_half_of_each_law():
    plan = load_plan("bench-unmodelled")
    case = next(case for case in list_cases(plan) if case.law == "mixture")
    leaks = case_leaks(plan, case)
    assert [leak.law for leak in leaks] == ["laminar", "orifice"]
    assert sum(leak.mean for leak in leaks) * 60_000 == pytest.approx(case.leak_lpm)


def test_no_family_of_a_plan_is_called_as_all_of_them(tmp_path, text):
    (tmp_path / "mine.toml").write_text(
        '[profile]\nname = "mine"\ntitle = "families"\nextends = "bench"\n[[family]]\nname = "all"\nwhy = "ours"\n',
        encoding="utf-8",
    )
    text = text.replace("[factors]", '[factors]\nfamily = ["all"]')
    (tmp_path / "plan.toml").write_text(text.replace("seed = 3", 'seed = 3\nprofile = "mine.toml"'), encoding="utf-8")
    with refusal("factors.family", "'all'", "plan.toml"):
        load_plan(tmp_path / "plan.toml")


def test_a_factor_of_families_needs_a_profile_with_them(tmp_path, text):
    path = tmp_path / "plan.toml"
    path.write_text(text.replace("[factors]", '[factors]\nfamily = ["hoses"]'), encoding="utf-8")
    with refusal("family", "'hoses'"):
        load_plan(path)
    path.write_text(
        text.replace("[factors]", '[factors]\nfamily = ["pipes"]').replace(
            "seed = 3", 'seed = 3\nprofile = "unmodelled"'
        ),
        encoding="utf-8",
    )
    with refusal("'pipes'"):
        load_plan(path)
