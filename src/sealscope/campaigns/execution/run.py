"""Run a campaign: carry out its missing cases; every row is stored, an interrupted run continues."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import closing
from functools import partial
from pathlib import Path

from sealscope.campaigns.cases.case import CampaignCase, cases_of, interleave_cases
from sealscope.campaigns.cases.recordings import ProgressCallback
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.cases.work import work
from sealscope.campaigns.execution import batches, store
from sealscope.campaigns.execution.workers import carried_out, process_count
from sealscope.campaigns.plans.duty import check_controllers
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.errors import InputError
from sealscope.storage.folders import inner_folder, make_folder
from sealscope.storage.rows import locked, stored

#: Carries out one case of a plan; `folder` to write its recording into, None for none.
Task = Callable[..., CaseRow]
RECORDINGS = "recordings"


def run(
    plan: SimulatedPlan,
    folder: str | os.PathLike[str],
    *,
    jobs: int | None = None,
    cluster: str | None = None,
    retry: bool = False,
    progress: ProgressCallback | None = None,
    task: Task = work,
    batch: bool = False,
    trust: bool = False,
) -> store.CampaignProgress:
    """Carry out the missing cases of the plan in `folder`, and return its progress.

    `jobs`: processes of this machine, one a core by default and two a core at most, 1 for this process alone;
    `cluster`: address of a Dask scheduler instead; `retry`: carry failed cases out again; `batch`: simulate cases side
    by side (`batches`) with `jobs` threads; `trust`: whether the plan's own controllers (`FILE.py:NAME`), which may be
    hostile, are run. The rows do not depend on process, order or batch; kinds of records take turns
    (`interleave_cases`). Raises InputError for a controller that is not trusted, a folder with another campaign or
    another run at work, and a plan that no batch can carry out.
    """
    if jobs is not None and jobs < 1:
        raise InputError(f"--jobs must be >= 1, got {jobs}")
    check_controllers(plan, trust)
    cases = cases_of(plan)
    mode = store.RUN_BY_RUN
    if batch:
        if cluster is not None:
            raise InputError("--cluster must stand without --batch: a batch is made by one machine")
        batches.check_plan(plan, cases)
        mode = batches.IN_BATCHES
    place = Path(folder)
    make_folder(place)
    with locked(place, store.WHAT):
        store.begin(place, store.made_from(plan, mode))
        rows = store.rows_of(plan, place)
        if retry:
            rows = {name: row for name, row in rows.items() if row.error is None}
        waiting = [case for case in interleave_cases(cases) if case.id not in rows]
        report = progress or (lambda done, size, failures: None)
        done, failures = len(rows), sum(row.error is not None for row in rows.values())
        report(done, plan.size, failures)
        recordings = inner_folder(place, RECORDINGS) if plan.keep_recordings else None
        jobs = process_count(jobs)
        if batch:
            new_rows = batches.in_batches(plan, waiting, jobs)
        else:
            new_rows = _rows(carried_out(partial(task, plan, folder=recordings), waiting, jobs, cluster))
        for row in stored(place, new_rows, store.WHAT):
            done += 1
            failures += row.error is not None
            report(done, plan.size, failures)
    return store.progress_of(plan, place)


def _rows(results: Generator[tuple[CampaignCase, CaseRow | None], None, None]) -> Generator[CaseRow, None, None]:
    """Yield the rows of the cases as they end."""
    with closing(results):
        for case, row in results:
            yield row or CaseRow.from_case(case, error="the process that carried it out died")
