"""However a campaign was carried out - in one go, in pieces, by one process, by many, on a cluster - its result is
the same bytes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from sealscope.campaigns.cases.case import list_cases
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.cases.scoring import run_case
from sealscope.campaigns.execution import run as campaign
from sealscope.campaigns.execution import store
from sealscope.campaigns.plans.reader import load_plan
from sealscope.campaigns.results import judge_simulated_campaign, write_result
from sealscope.errors import MissingExtra, SimulationFailed, UnreadableFile
from sealscope.storage.rows import ROWS, lock_rows

from ..refusals import refusal
from ..waiting import until

SOURCES = Path(campaign.__file__).resolve().parents[3]


def files_of(plan, folder):
    """Name -> bytes of every result file."""
    return {path.name: path.read_bytes() for path in write_result(judge_simulated_campaign(plan, folder), folder)}


@pytest.fixture
def once(tiny, finished_tiny):
    """The plan, and the files of a campaign that ran through in this process."""
    plan = load_plan(tiny)
    return plan, files_of(plan, finished_tiny)


@pytest.mark.long
@pytest.mark.slow
def test_processes_make_the_same_bytes(once, tmp_path):
    plan, expected = once
    assert {"records.csv", "table.csv", "pod.csv", "cells.csv", "thresholds.csv"} <= set(expected)
    assert campaign.run(plan, tmp_path / "two", jobs=2).done == 26
    assert files_of(plan, tmp_path / "two") == expected


def start(plan, folder):
    environment = {**os.environ, "PYTHONPATH": str(SOURCES)}
    words = [sys.executable, "-m", "sealscope", "campaign", "run", str(plan), "-o", str(folder), "-j", "2"]
    return subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def wait_for_rows(folder, count, process):
    """Until so many rows are there."""
    path = folder / ROWS

    def has_rows():
        assert process.poll() is None, "it ended before it could be killed"
        return path.is_file() and path.read_bytes().count(b"\n") >= count

    until(has_rows)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="kills as POSIX does")
def test_killed_twice_it_goes_on_to_the_same_bytes(once, tiny, tmp_path):
    plan, expected = once
    folder = tmp_path / "killed"
    for count in (4, 12):
        process = start(tiny, folder)
        wait_for_rows(folder, count, process)
        process.kill()
        process.wait()
        with (folder / ROWS).open("ab") as file:  # the line that was being written when it died
            file.write(b'{"id": "0123", "sco')
    before = store.read_progress(plan, folder)
    assert 12 <= before.done < 26
    reported = []
    assert campaign.run(plan, folder, jobs=2, progress=lambda *words: reported.append(words)).done == 26
    assert reported[0] == (before.done, 26, 0)
    assert files_of(plan, folder) == expected
    ids = [json.loads(line)["id"] for line in (folder / ROWS).read_bytes().splitlines()]
    assert len(ids) == len(set(ids)) == 26


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="looks at processes in /proc")
def test_no_process_outlives_a_killed_campaign(tiny, tmp_path):
    process = start(tiny, tmp_path / "killed")
    wait_for_rows(tmp_path / "killed", 3, process)

    def children():
        outcome = []
        for stat in Path("/proc").glob("[0-9]*/stat"):
            try:
                words = stat.read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if words[1] == str(process.pid) and words[0] != "Z":
                outcome.append(int(stat.parent.name))
        return outcome

    workers = children()
    assert len(workers) >= 2
    process.kill()
    process.wait()

    def alive(pid):
        stat = Path(f"/proc/{pid}/stat")
        try:
            return stat.read_text().rpartition(")")[2].split()[0] != "Z"
        except OSError:
            return False

    until(lambda: not any(alive(pid) for pid in workers))


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGINT") or os.name == "nt", reason="interrupts as POSIX does")
def test_an_interrupt_ends_it_and_keeps_the_rows(tiny, tmp_path):
    process = start(tiny, tmp_path / "stopped")
    wait_for_rows(tmp_path / "stopped", 3, process)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    assert store.read_progress(load_plan(tiny), tmp_path / "stopped").done >= 3


@pytest.mark.slow
def test_on_a_cluster_the_same_bytes(once, tmp_path):
    distributed = pytest.importorskip("distributed")
    plan, expected = once
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        assert campaign.run(plan, tmp_path / "cluster", cluster=cluster.scheduler_address).done == 26
    assert files_of(plan, tmp_path / "cluster") == expected


def test_a_cluster_that_is_not_there_is_one_line(tiny, tmp_path):
    pytest.importorskip("distributed")
    with refusal("--cluster", "nowhere"):
        campaign.run(load_plan(tiny), tmp_path / "none", cluster="nowhere")


def test_without_dask_it_says_what_to_install(tiny, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with refusal("sealscope[cluster]", error=MissingExtra):
        campaign.run(load_plan(tiny), tmp_path / "none", cluster="tcp://127.0.0.1:1")


def doomed(case):
    return case.use == "judge" and int(case.id, 16) % 3 == 0


def break_some(plan, case, folder=None):
    """A task that fails on a third of the records to judge."""
    if doomed(case):
        return CaseRow.from_case(case, error=str(SimulationFailed("the run diverged")))
    return run_case(plan, case, folder)


@pytest.mark.slow
@pytest.mark.long
def test_a_failed_case_is_a_row_with_its_error(tiny, tmp_path, monkeypatch):
    plan = load_plan(tiny)
    bad = sum(doomed(case) for case in list_cases(plan))
    assert 0 < bad < 16
    monkeypatch.setattr(campaign, "run_case", break_some)
    state = campaign.run(plan, tmp_path / "bad", jobs=1)
    assert (state.done, state.failed) == (26, bad)
    again = campaign.run(plan, tmp_path / "bad", jobs=1)
    assert again.failed == bad
    monkeypatch.undo()
    result = judge_simulated_campaign(plan, tmp_path / "bad")
    assert {row.error for row in result.judgement.failed} == {"the run diverged"}
    outcome = [row for row in result.judgement.table if row.detector == "d3 of p_A changed"]
    assert [row.alarms.n for row in outcome] == [5, 5]  # a failed record stays in the count, as one that cannot be told
    leaky_bad = sum(row.leak_lpm > 0 for row in result.judgement.failed)
    assert sum(row.cannot_tell.count for row in outcome) == leaky_bad
    assert campaign.run(plan, tmp_path / "bad", jobs=1, retry=True).failed == 0


@pytest.mark.long
@pytest.mark.slow
def test_a_case_that_kills_its_process_costs_no_other(once, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)
    die_on_one = import_module("dying_task").die_on_one
    plan, _ = once
    monkeypatch.setattr(campaign, "run_case", die_on_one)
    state = campaign.run(plan, tmp_path / "dead", jobs=2)
    assert (state.done, state.failed) == (26, 1)
    rows = store.read_plan_rows(plan, tmp_path / "dead")
    assert [row.error for row in rows.values() if row.error] == ["the process that ran the record died"]


def test_a_fault_of_the_program_is_told_in_the_row(tiny, monkeypatch):
    plan = load_plan(tiny)
    case = list_cases(plan)[0]

    def broken(*_):
        raise ZeroDivisionError("by nought")

    monkeypatch.setattr("sealscope.campaigns.cases.scoring.case_experiment", broken)
    assert run_case(plan, case).error == "ZeroDivisionError: by nought"


@pytest.mark.slow
def test_the_code_key_covers_every_source_that_a_case_runs(tiny):
    """Whatever a worker has loaded after carrying out a case is in the key."""
    code = (
        "import sys; from sealscope.campaigns.plans.reader import load_plan\n"
        "from sealscope.campaigns.cases.case import list_cases, iter_sources\n"
        "from sealscope.campaigns.cases.scoring import run_case\n"
        "plan = load_plan(sys.argv[1]); cases = list_cases(plan)[-1:]\n"
        "assert run_case(plan, cases[0]).error is None\n"
        "covered = {str(path) for path in iter_sources()}\n"
        "loaded = {m.__file__ for n, m in sys.modules.items() if n.startswith('sealscope.') and m.__file__}\n"
        "print(sorted(loaded - covered)); print(len(loaded) > 60)"
    )
    environment = {**os.environ, "PYTHONPATH": str(SOURCES)}
    outcome = subprocess.run(
        [sys.executable, "-c", code, str(tiny)], env=environment, capture_output=True, text=True, check=True
    )
    assert outcome.stdout.splitlines() == ["[]", "True"]


def test_rows_of_another_campaign_are_not_mixed_in(finished_tiny, text, tmp_path):
    other = tmp_path / "other.toml"
    other.write_text(text.replace("seed = 3", "seed = 4"), encoding="utf-8")
    with refusal("rig", "bench", "onset", "seed"):
        campaign.run(load_plan(other), finished_tiny, jobs=1)


def test_more_records_are_added_to_what_is_there(finished_tiny, text, tmp_path):
    folder = finished_tiny
    more = tmp_path / "more.toml"
    more.write_text(text.replace("count = 6", "count = 8"), encoding="utf-8")
    reported = []
    campaign.run(load_plan(more), folder, jobs=1, progress=lambda *words: reported.append(words))
    assert reported[0] == (26, 28, 0)


@pytest.mark.slow
def test_another_detector_is_added_to_what_is_there(finished_tiny, text, tmp_path):
    folder, more = finished_tiny, tmp_path / "more.toml"
    more.write_text(text.replace('"d3 of p_A changed"', '"d4 of p_A changed"'), encoding="utf-8")
    assert store.read_progress(load_plan(more), folder).done == 0
    campaign.run(load_plan(more), folder, jobs=1)
    assert store.read_progress(load_plan(more), folder).done == 26


def test_two_at_once_are_refused(tiny, tmp_path):
    plan = load_plan(tiny)
    store.begin_campaign(tmp_path / "mine", store.collect_row_inputs(plan))
    with lock_rows(tmp_path / "mine", "a campaign"), refusal("one process"):
        campaign.run(plan, tmp_path / "mine", jobs=1)


def test_a_run_that_is_refused_changes_nothing_of_the_one_at_work(tiny, text, tmp_path):
    other = tmp_path / "other.toml"
    other.write_text(text.replace("seed = 3", "seed = 4"), encoding="utf-8")
    folder = tmp_path / "mine"
    store.begin_campaign(folder, store.collect_row_inputs(load_plan(tiny)))  # it has no row yet
    with lock_rows(folder, "a campaign"), refusal("one process"):
        campaign.run(load_plan(other), folder, jobs=1)
    assert store.read_head(folder) == store.collect_row_inputs(load_plan(tiny))


def test_rows_whose_origin_is_lost_are_not_continued(tiny, finished_tiny):
    (finished_tiny / store.HEAD).unlink()
    with refusal("same"):
        campaign.run(load_plan(tiny), finished_tiny, jobs=1)


def test_a_spoilt_line_is_refused_with_its_place(tiny, tmp_path):
    plan = load_plan(tiny)
    store.begin_campaign(tmp_path, store.collect_row_inputs(plan))
    (tmp_path / ROWS).write_bytes(b'{"id": 3}\n')
    with refusal("rows.jsonl, line 1", error=UnreadableFile):
        store.read_progress(plan, tmp_path)


@pytest.mark.long
@pytest.mark.slow
def test_recordings_are_kept_only_where_asked(tiny, text, tmp_path):
    few = text.replace("count = 6", "count = 1").replace("count = 5", "count = 1").replace("count = 10", "count = 8")
    path = tmp_path / "keep.toml"
    path.write_text(few.replace("seed = 3", "seed = 3\nkeep_recordings = true"), encoding="utf-8")
    plan = load_plan(path)
    assert campaign.run(plan, tmp_path / "kept", jobs=1).failed == 0
    names = {path.stem for path in (tmp_path / "kept" / "recordings").glob("*.nc")}
    assert names == {case.id for case in list_cases(plan)}
    path.write_text(few, encoding="utf-8")
    campaign.run(load_plan(path), tmp_path / "bare", jobs=1)
    assert not (tmp_path / "bare" / "recordings").exists()
