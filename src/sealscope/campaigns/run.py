"""Run a campaign: what is missing in its folder is carried out, every row is kept, an interrupted run goes on."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sealscope.campaigns import crew, store
from sealscope.campaigns.cases import Case, cases_of, code_key, digest, world
from sealscope.campaigns.entries import entry, plug_ins_of
from sealscope.campaigns.plan import Plan
from sealscope.campaigns.work import Row, work
from sealscope.diagnosis.calibration.scorers import scorer
from sealscope.errors import InputError

#: Told how many records have their row, how many there are, and how many of those failed.
Progress = Callable[[int, int, int], None]
RECORDINGS = "recordings"
#: How rows are made unless in batches.
RUN_BY_RUN = "run by run"


@dataclass(frozen=True)
class Standing:
    """How far a campaign is: `records` in the plan, how many are `done`, and `failed` of these; `seconds`: processor
    time of a record on average, None where none is done."""

    records: int
    done: int
    failed: int
    seconds: float | None

    @property
    def complete(self) -> bool:
        """Whether every record has its row."""
        return self.done == self.records


def made_from(plan: Plan, way: str = RUN_BY_RUN) -> dict[str, Any]:
    """What a campaign's rows depend on, as plain values; `way`: how they are made, `RUN_BY_RUN` or `batches.way`."""
    # a detector that searches within the record sets its own threshold for the rate, and its score may follow
    entries = [entry(name) for name in plan.detectors]
    searching = any(one.detector or scorer(one.of).timing == "search" for one in entries)
    assumed = plan.assumed or plan.rig
    return {
        "format": store.FORMAT,
        "name": plan.name,
        "title": plan.title,
        "world": world(plan),
        "way": way,
        "code": code_key(),
        "rate_within": plan.false_alarm if searching else None,
        "assumed": digest({row.name: repr(row.value) for row in assumed.table()}) if searching else None,
        "plug_ins": plug_ins_of(entries),
        "views": {view: list(plan.views.get(view, ())) for view in sorted({one.view for one in entries})},
        "version": _version(),
    }


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("sealscope")
    except PackageNotFoundError:  # a source tree that is not installed
        return "unknown"


def kept_rows(plan: Plan, folder: Path) -> dict[str, Row]:
    """The folder's rows that belong to the plan, by case id in rising order; a row without one of the plan's
    detectors is not among them."""
    rows = store.read_rows(folder)
    found = (rows.get(case.id) for case in sorted(cases_of(plan), key=lambda case: case.id))
    return {row.id: row for row in found if row is not None and (row.error or set(plan.detectors) <= set(row.scores))}


def standing(plan: Plan, folder: Path) -> Standing:
    """How far the campaign in the folder is."""
    rows = kept_rows(plan, folder)
    seconds = [row.seconds for row in rows.values() if row.error is None]
    mean = sum(seconds) / len(seconds) if seconds else None
    return Standing(plan.size, len(rows), sum(row.error is not None for row in rows.values()), mean)


def run(
    plan: Plan,
    folder: str | os.PathLike[str],
    *,
    jobs: int | None = None,
    cluster: str | None = None,
    retry: bool = False,
    progress: Progress | None = None,
    task: crew.Task = work,
    batch: bool = False,
    device: str = "cpu",
) -> Standing:
    """Carry out what is missing of the plan in `folder`, and say how far it is then.

    `jobs`: processes of this machine, one a core by default, 1 for this process alone; `cluster`: address of a Dask
    scheduler instead; `retry`: carry failed cases out again; `batch`: simulate cases side by side (`batches`) on the
    `device`, cpu (with `jobs` threads) or gpu, which stands for a batch by itself. The rows are the same whoever makes
    them and in whatever order, those of batches in any batch. Raises InputError where the folder holds another
    campaign, another run is at work in it, or a batch cannot do what the plan asks for.
    """
    if jobs is not None and jobs < 1:
        raise InputError(f"--jobs must be >= 1, got {jobs}")
    batch = batch or device != "cpu"
    cases = cases_of(plan)
    way = RUN_BY_RUN
    if batch:
        from sealscope.campaigns import batches

        if cluster is not None:
            raise InputError("--cluster must stand without --batch: a batch is made by one machine")
        batches.check_device(plan, device)
        batches.check_plan(plan, cases)
        way = batches.way(device)
    place = Path(folder)
    store.begin(place, made_from(plan, way))
    with store.alone_in(place):
        rows = kept_rows(plan, place)
        if retry:
            rows = {name: row for name, row in rows.items() if row.error is None}
        waiting = [case for case in cases if case.id not in rows]
        failures = sum(row.error is not None for row in rows.values())
        done = len(rows)
        if progress is not None:
            progress(done, plan.size, failures)
        keep = None
        if plan.keep_recordings:
            keep = place / RECORDINGS
            keep.mkdir(exist_ok=True)
        made = (
            batches.in_batches(plan, waiting, jobs or _cores(), device)
            if batch
            else _rows(plan, waiting, jobs or _cores(), cluster, keep, task)
        )
        with store.Appender(place) as appender, closing(made):
            for row in made:
                appender.append(row)
                done += 1
                failures += row.error is not None
                if progress is not None:
                    progress(done, plan.size, failures)
    return standing(plan, place)


def _rows(
    plan: Plan, waiting: Sequence[Case], jobs: int, cluster: str | None, keep: Path | None, task: crew.Task
) -> Generator[Row, None, None]:
    if not waiting:
        return
    if cluster is not None:
        yield from crew.on_cluster(plan, waiting, cluster, keep, task)
    elif jobs == 1:
        yield from crew.alone(plan, waiting, keep, task)
    else:
        yield from crew.together(plan, waiting, min(jobs, len(waiting)), keep, task)


def _cores() -> int:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1
