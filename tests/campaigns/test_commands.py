"""Campaigns from the command line, and their page."""

from __future__ import annotations

import re
import sys

import pytest

from sealscope import cli
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.plans.reader import load_plan

from ..refusals import mentions


@pytest.fixture
def call(monkeypatch, capfd):
    """Status, output and complaint of one call within this process."""

    def called(*words):
        monkeypatch.setattr(sys, "argv", ["sealscope", *map(str, words)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capfd.readouterr()
        assert "Traceback" not in err
        return ended.value.code, out, err

    return called


def test_run_status_and_report(call, tiny, tmp_path):
    folder = tmp_path / "mine"
    status, out, _ = call("campaign", "status", tiny, "-o", folder)
    assert (status, out) == (0, "records: 0 of 26 done\n")
    status, out, err = call("campaign", "run", tiny, "-o", folder, "-j", "1")
    assert status == 0, err
    assert re.search(r"^records: 26 of 26 done; [\d.]+ s of one core each$", out, re.MULTILINE)
    for name in ("d3 of p_A changed", "sign rule: d3 of p_A fell", "always fire", "never fire"):
        assert re.search(rf"^{name} .*%", out, re.MULTILINE)
    page = (folder / "report.html").read_text(encoding="utf-8")
    for text in (out, page):  # these scorers compare the sides of the true onset, and the table says so
        assert "Given the true onset, which no machine in service gives" in text
    assert re.search(r"^d3 of p_A fell +true onset ", out, re.MULTILINE)
    assert page.count("<td>true onset</td>") == 3
    check_page(folder, load_plan(tiny))
    again = call("campaign", "report", tiny, "-o", folder)
    assert again[0] == 0
    assert (folder / "report.html").read_text(encoding="utf-8") == page


def test_no_more_processes_than_two_a_core(call, tiny, tmp_path, monkeypatch):
    from sealscope.campaigns.execution import run, workers

    monkeypatch.setattr(workers, "cores", lambda: 2)
    assert [workers.process_count(asked) for asked in (None, 1, 4, 30)] == [2, 1, 4, 4]
    started = []

    def ended(task, cases, jobs, cluster):
        started.append(jobs)
        yield from ((case, CaseRow.from_case(case, error="not carried out")) for case in cases)

    monkeypatch.setattr(run, "iter_results", ended)
    _, _, err = call("campaign", "run", tiny, "-o", tmp_path / "out", "-j", "30")
    assert started == [4]
    assert err.startswith("sealscope: --jobs 30: 4 processes are started, two a core\n")


def check_page(folder, plan):
    """The page is whole, and asks nothing of a network."""
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "http" not in page.replace("http-equiv", "")
    for href in re.findall(r'href="([^"]+)"', page):
        assert (folder / href).is_file()
    for name in plan.detectors:
        assert page.count(f"<summary>{name}</summary>") == 1
    assert page.count('<svg class="curve"') == 2 * len(plan.detectors)
    numbers = re.findall(r' d="([^"]+)"', page)
    assert numbers
    assert not any("nan" in one or "inf" in one for one in numbers)
    assert not re.search(r">(nan|inf|None)<", page)


@pytest.mark.slow
def test_an_incomplete_campaign_says_so(call, tiny, finished_tiny):
    rows = (finished_tiny / "rows.jsonl").read_bytes().splitlines(keepends=True)
    (finished_tiny / "rows.jsonl").write_bytes(b"".join(rows[:-3]))
    status, out, _ = call("campaign", "report", tiny, "-o", finished_tiny)
    assert status == 0
    assert "Not complete: 3 records of the plan have no row yet." in out


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("campaign", "run", "no-such-plan"), "plan"),
        (("campaign", "report", "TINY", "-o", "nowhere"), "rows"),
        (("campaign", "run", "TINY", "-o", "nowhere", "-j", "0"), "--jobs, 1"),
        (("campaign", "run", "rotary-seal"), "--data"),
        (("campaign", "run", "rotary-seal", "--data", "nowhere"), "--data"),
        (("campaign", "run", "rotary-seal", "--data", ".", "-o", "."), "--output, --data"),
    ],
)
def test_wrong_calls_are_one_line(call, tiny, tmp_path, monkeypatch, words, names):
    monkeypatch.chdir(tmp_path)
    status, _, err = call(*(tiny if word == "TINY" else word for word in words))
    assert status in (1, 2)
    assert mentions(err, *names.split(", "))
    assert len(err.splitlines()) == 1
