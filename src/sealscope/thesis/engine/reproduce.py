"""Reproduce chosen items of the thesis into a folder: only what changed, in parallel, and resumable."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from sealscope.errors import InputError
from sealscope.thesis.engine import crew
from sealscope.thesis.engine.bench import Bench, Job, Publish
from sealscope.thesis.engine.items import Entry, Item
from sealscope.thesis.engine.products import Claim, Product
from sealscope.thesis.engine.registry import check, collect, select, with_needed
from sealscope.thesis.engine.store import held
from sealscope.thesis.sheet import find_sheet

#: Told how many items have ended, of how many, and which are in work.
Progress = Callable[[int, int, Sequence[str]], None]


@dataclass(frozen=True)
class Outcome:
    """What stands in a results folder after a call: an entry for every item of the registry, in its order."""

    job: Job
    entries: tuple[Entry, ...]

    def among(self, *states: str) -> list[Entry]:
        """The entries in one of the states."""
        return [entry for entry in self.entries if entry.state in states]

    def products(self, entry: Entry) -> tuple[Product | Claim, ...]:
        """The products of an entry, read from the folder; () where there are none."""
        return (Bench(self.job).store.products(entry.item.id, self.job.quick) or ()) if entry.there else ()

    def shown(self) -> Iterator[tuple[Entry, tuple[Product | Claim, ...]]]:
        """Every entry with its products, one after the other."""
        store = Bench(self.job).store
        for entry in self.entries:
            found = store.products(entry.item.id, self.job.quick) if entry.there else None
            yield entry, found or ()


def reproduce(
    wanted: Sequence[str] = ("all",),
    folder: str | os.PathLike[str] = "sealscope-thesis",
    *,
    quick: bool = False,
    jobs: int | None = None,
    sheet: str | os.PathLike[str] | None = None,
    registry: Sequence[Item] | None = None,
    publish: Publish | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Make the wanted items (see `registry.select`) and what they need, draw them with `publish`, and say what became
    of each.

    `jobs` processes (default: one a core; 1: in this process); `sheet`: folder of the data sheet (see
    `sheet.find_sheet`). What was made by an earlier call from the same sources stays. A failed item does not stop the
    others. KeyboardInterrupt leaves all finished items valid.

    Raises InputError for an unknown item, a bad sheet, or a folder that cannot be written or is in use.
    """
    if jobs is not None and jobs < 1:
        raise InputError(f"jobs must be >= 1, got {jobs}")
    items = tuple(registry) if registry is not None else collect()
    check(items)
    chosen = with_needed(items, select(items, wanted))
    job = Job(Path(folder), items, quick, find_sheet(sheet), publish)
    bench = Bench(job)
    with held(bench.store.kept / "lock", wait=False) as ours:
        if not ours:
            raise InputError(f"a results folder must be used by one call at a time, got {folder}")
        bench.store.clean()
        return Outcome(job, _carry_out(job, bench, chosen, jobs or os.cpu_count() or 1, progress))


def _carry_out(
    job: Job, bench: Bench, chosen: Sequence[Item], jobs: int, progress: Progress | None
) -> tuple[Entry, ...]:
    known = {item.id: bench.entry(item) for item in chosen}
    stale: list[str] = []
    for item in chosen:  # needs come before what needs them
        state = known[item.id].state
        if state == "not made" or (state == "kept" and any(needed in stale for needed in item.needs)):
            stale.append(item.id)
    needs = {item.id: [needed for needed in item.needs if needed in stale] for item in chosen if item.id in stale}
    ended = 0

    def told(entry: Entry | None, in_work: Sequence[str]) -> None:
        nonlocal ended
        ended += entry is not None
        if progress is not None:
            progress(ended, len(stale), in_work)

    if stale:
        count = min(jobs, len(stale))
        ends = crew.alone(job, stale, needs, told) if count == 1 else crew.together(job, stale, needs, told, count)
        with closing(ends):
            known |= {entry.item.id: entry for entry in ends}
    return tuple(known.get(item.id) or bench.entry(item) for item in job.registry)
