"""Run the missing cases of a campaign; each result is stored at once, and an interrupted run can be continued."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

from sealscope.campaigns.cases.case import interleave_cases, list_cases
from sealscope.campaigns.cases.recordings import ProgressCallback
from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.cases.scoring import run_case
from sealscope.campaigns.execution import store
from sealscope.campaigns.execution.workers import iter_results, iter_rows, process_count
from sealscope.campaigns.plans.duty import check_controllers
from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.errors import InputError
from sealscope.storage.folders import make_folder, make_inner_folder
from sealscope.storage.rows import lock_rows, store_rows

RECORDINGS = "recordings"


def run(
    plan: SimulatedPlan,
    folder: str | os.PathLike[str],
    *,
    jobs: int | None = None,
    cluster: str | None = None,
    retry: bool = False,
    progress: ProgressCallback | None = None,
    trust: bool = False,
) -> store.CampaignProgress:
    """Run the cases of a plan that have no result in `folder` yet, and return the campaign's progress.

    - `jobs`: number of processes (`process_count`), 1 for this process only
    - `cluster`: address of a Dask scheduler to use instead
    - `retry`: True to run failed cases again
    - `progress`: called with the numbers of cases done, of all cases, and of failed ones
    - `trust`: True to run controllers that the plan names by file or module, whose code may be hostile

    Raises InputError for an untrusted controller, and for a folder that has another campaign or is in use by another
    run.
    """
    if jobs is not None and jobs < 1:
        raise InputError(f"--jobs must be >= 1, got {jobs}")
    check_controllers(plan, trust)
    cases = list_cases(plan)
    place = Path(folder)
    make_folder(place)
    with lock_rows(place, store.WHAT):
        store.begin_campaign(place, store.collect_row_inputs(plan))
        rows = store.read_plan_rows(plan, place)
        if retry:
            rows = {name: row for name, row in rows.items() if row.error is None}
        waiting = [case for case in interleave_cases(cases) if case.id not in rows]
        report = progress or (lambda n_done, n_records, n_failed: None)
        n_done, n_failed = len(rows), sum(row.error is not None for row in rows.values())
        report(n_done, plan.size, n_failed)
        recordings = make_inner_folder(place, RECORDINGS) if plan.keep_recordings else None
        jobs = process_count(jobs)
        results = iter_results(partial(run_case, plan, folder=recordings), waiting, jobs, cluster)
        error = "the process that ran the record died"
        new_rows = iter_rows(results, lambda case: CaseRow.from_case(case, error=error))
        for row in store_rows(place, new_rows, store.WHAT):
            n_done += 1
            n_failed += row.error is not None
            report(n_done, plan.size, n_failed)
    return store.read_progress(plan, place)
