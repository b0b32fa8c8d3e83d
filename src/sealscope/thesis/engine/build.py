"""Reproduce chosen items of the thesis into a folder: only what changed, in parallel, and resumable."""

from __future__ import annotations

import hashlib
import json
import os
import traceback
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, replace
from functools import lru_cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any, Literal

from sealscope.campaigns.execution.workers import Workers, process_count
from sealscope.errors import InputError, SealscopeError
from sealscope.thesis.engine.context import RunSpec, SimulatedRun
from sealscope.thesis.engine.folder import ResultsFolder
from sealscope.thesis.engine.items import Item, check, collect, select_items, with_needed
from sealscope.thesis.engine.products import Claim, Figure, Product, ThesisTable, thinned
from sealscope.thesis.engine.sources import sources_key
from sealscope.thesis.sheet import MISSING, DataSheet, find_sheet, read_sheet

#: Draws an item's products into a folder and returns its files, relative to the folder.
Publish = Callable[[Item, tuple[Product | Claim, ...], Path], tuple[str, ...]]
#: Called with how many items have ended, of how many, and which are in work.
Progress = Callable[[int, int, Sequence[str]], None]
LEFT_OUT = "left out"
State = Literal["made", "drawn", "kept", "left out", "failed", "not made"]
_DRAWING = ("matplotlib", "pillow", "jinja2")
_RUNS = "sealscope.thesis.engine.runs"


@dataclass(frozen=True)
class ItemStatus:
    """The state of an item in a results folder.

    `state`: made now, only drawn anew, kept from an earlier call, left out or failed (`reason` says why), or not made
    (not chosen, or made by other sources); `files`: what was drawn of it, relative to the folder.
    """

    item: Item
    state: State
    reason: str = ""
    files: tuple[str, ...] = ()

    @property
    def available(self) -> bool:
        """Whether its products can be shown."""
        return self.state in ("made", "drawn", "kept")


@dataclass(frozen=True)
class Job:
    """One reproduction, as a worker process gets it."""

    folder: Path
    items: tuple[Item, ...]
    quick: bool = False
    sheet: Path | None = None
    publish: Publish | None = None


@dataclass(frozen=True)
class Reproduction:
    """The content of a results folder after a call: the status of every item of the list, in its order."""

    job: Job
    statuses: tuple[ItemStatus, ...]

    def among(self, *states: State) -> list[ItemStatus]:
        """Return the items in one of the states."""
        return [status for status in self.statuses if status.state in states]

    def products(self, status: ItemStatus) -> tuple[Product | Claim, ...]:
        """Read the products of an item from the folder; () where there are none."""
        folder = ResultsFolder(self.job.folder)
        return (folder.products(status.item.id, self.job.quick) or ()) if status.available else ()


def reproduce(
    patterns: Sequence[str] = ("all",),
    folder: str | os.PathLike[str] = "sealscope-thesis",
    *,
    quick: bool = False,
    jobs: int | None = None,
    sheet: str | os.PathLike[str] | None = None,
    items: Sequence[Item] | None = None,
    publish: Publish | None = None,
    progress: Progress | None = None,
) -> Reproduction:
    """Make the chosen items (see `items.select_items`) and what they need, and draw them with `publish`.

    `jobs` processes (default: one a core, at most two; 1: in this process); `sheet`: folder of the data sheet (see
    `sheet.find_sheet`). What was made by an earlier call from the same sources stays. A failed item does not stop the
    others. KeyboardInterrupt leaves all finished items valid.

    Raises InputError for an unknown item, a bad sheet, or a folder that cannot be written or is in use.
    """
    if jobs is not None and jobs < 1:
        raise InputError(f"jobs must be >= 1, got {jobs}")
    every = tuple(items) if items is not None else collect()
    check(every)
    chosen = with_needed(every, select_items(every, patterns))
    job = Job(Path(folder), every, quick, find_sheet(sheet), publish)
    builder = Builder(job)
    with builder.folder.locked():
        known = {item.id: builder.status(item) for item in chosen}
        stale: dict[str, list[str]] = {}
        for item in chosen:  # needs come before what needs them
            needs = [needed for needed in item.needs if needed in stale]
            if known[item.id].state == "not made" or (known[item.id].state == "kept" and needs):
                stale[item.id] = needs
        ended = 0

        def report(in_work: Sequence[str]) -> None:
            if progress is not None:
                progress(ended, len(stale), in_work)

        count = min(process_count(jobs), len(stale))
        built = _in_turn(builder, stale, report) if count <= 1 else _side_by_side(job, stale, count, report)
        with closing(built):
            for status in built:
                known[status.item.id] = status
                ended += 1
        report(())
        return Reproduction(job, tuple(known.get(item.id) or builder.status(item) for item in every))


Report = Callable[[Sequence[str]], None]


def _in_turn(builder: Builder, needs: Mapping[str, Sequence[str]], report: Report) -> Generator[ItemStatus, None, None]:
    for name in needs:
        report([name])
        yield builder(name)


def _side_by_side(
    job: Job, needs: Mapping[str, Sequence[str]], jobs: int, report: Report
) -> Generator[ItemStatus, None, None]:
    """Build the items in processes, each as soon as its needs have ended."""
    items = {item.id: item for item in job.items}
    sorter = TopologicalSorter(needs)
    sorter.prepare()
    ready: list[str] = []
    with Workers(jobs, Builder(job)) as workers:
        while sorter.is_active():
            ready += sorter.get_ready()
            while ready and workers.free:
                workers.begin(ready.pop(0))
            report(workers.items)
            for name, status in workers.ended():
                yield status or ItemStatus(items[name], "failed", "the process that made it died")
                sorter.done(name)


class Builder:
    """Makes and draws one item after the other, and decides which need it."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.folder = ResultsFolder(job.folder)
        self.items = {item.id: item for item in job.items}
        self.sheet: DataSheet | None = None
        self.sheet_key = "none"
        if job.sheet is not None:
            self.sheet, self.sheet_key = read_sheet(job.sheet)
        self.run = lru_cache(maxsize=2)(self._run)

    def __reduce__(self) -> tuple[type[Builder], tuple[Job]]:
        return Builder, (self.job,)

    def __call__(self, name: str) -> ItemStatus:
        """Make an item, or only draw it where its kept product is valid; the status holds the reason of a failure."""
        item, job = self.items[name], self.job
        try:
            status = self.status(item)
            if status.state == "kept":
                return status
            products = self.folder.products(name, job.quick) if self._stamp(name) else None
            state: State = "made" if products is None else "drawn"
            if products is None:
                products = self._make(item)
            files = () if job.publish is None else job.publish(item, products, job.folder)
            self.folder.keep_drawn(name, self._drawing(self._stamp(name)), files)
        except Exception as error:
            self.folder.keep_failure(name, traceback.format_exc())
            text = str(error) if isinstance(error, SealscopeError) else f"{type(error).__name__}: {error}"
            return ItemStatus(item, "failed", (text.strip() or type(error).__name__).splitlines()[0])
        return ItemStatus(item, state, files=files)

    def status(self, item: Item) -> ItemStatus:
        """Return the status of an item in the folder: kept, left out or not made."""
        if item.needs_sheet and self.sheet is None:
            return ItemStatus(item, "left out", MISSING)
        stamp = self._stamp(item.id)
        drawn, files = self.folder.drawn(item.id)
        if stamp and drawn == self._drawing(stamp):
            return ItemStatus(item, "kept", files=files)
        return ItemStatus(item, "not made")

    def _stamp(self, name: str) -> str:
        """Digest of what the kept product of an item rests on, where that is as it was; else an empty text.

        A record holds the `key` of the item; the hash of the `sheet` and the key of the `runs`, None where the maker
        did not look at them; and the stamps of other items' products that it `asked` for.
        """
        item = self.items.get(name)
        if item is None:
            return ""
        if item.needs_sheet and self.sheet is None:
            return LEFT_OUT
        record = self.folder.record(name, self.job.quick)
        valid = (
            record is not None
            and record.get("key") == self._key(item)
            and record["sheet"] in (None, self.sheet_key)
            and record["runs"] in (None, sources_key(_RUNS))
            and all(self._stamp(other) == stamp for other, stamp in record["asked"].items())
        )
        return _digest(record)[:24] if valid else ""

    def _key(self, item: Item) -> str:
        """Digest of what an item's products rest on beside the sheet, the runs and other items."""
        return _digest([astuple(item), self.job.quick, sources_key(item.make.__module__)])

    def _drawing(self, stamp: str) -> str:
        """Key of the drawing of a product: the product and all that draws it."""
        publish = self.job.publish
        return stamp if publish is None else f"{stamp} {sources_key(publish.__module__, _DRAWING)}"

    def _make(self, item: Item) -> tuple[Product | Claim, ...]:
        for needed in item.needs:
            if not self._stamp(needed):
                raise InputError(f"needs {needed}, which failed")
        context = BuildContext(self, item)
        products = tuple(map(_thinned, item.make(context, item)))
        record = {
            "key": self._key(item),
            "sheet": self.sheet_key if context.saw_sheet else None,
            "runs": sources_key(_RUNS) if context.ran else None,
            "asked": context.product_stamps,
        }
        self.folder.keep(item.id, self.job.quick, record, products)
        return products

    def _run(self, spec: RunSpec) -> SimulatedRun:
        from sealscope.thesis.engine import runs

        experiment = runs.experiment_of(spec)
        key = _digest([experiment.key(), spec.prove, sources_key(_RUNS)])
        return self.folder.run(key[:32], lambda: runs.simulated_run(spec, experiment))


class BuildContext:
    """The Context of one item's maker; notes what it used, for the item's record."""

    def __init__(self, builder: Builder, item: Item) -> None:
        self._builder, self._item = builder, item
        self.quick = builder.job.quick
        self.saw_sheet = item.needs_sheet
        self.ran = False
        self.product_stamps: dict[str, str] = {}

    @property
    def sheet(self) -> DataSheet | None:
        """The measured sheet, None where it was not given."""
        self.saw_sheet = True
        return self._builder.sheet

    def run(self, spec: RunSpec) -> SimulatedRun:
        """Return the run of `spec`: from memory, from the folder, or simulated now."""
        self.ran = True
        return self._builder.run(spec)

    def product(self, item: str) -> tuple[Product | Claim, ...]:
        """Return the products of an item among the maker's `needs`; () where it is left out for want of the sheet."""
        if item not in self._item.needs:
            raise InputError(f"{self._item.id} must name {item} among its needs to ask for its products")
        builder = self._builder
        self.product_stamps[item] = stamp = builder._stamp(item)
        if stamp == LEFT_OUT:
            return ()
        products = builder.folder.products(item, builder.job.quick) if stamp else None
        if products is None:
            raise InputError(f"needs {item}, which failed")
        return products


def _thinned(product: Product | Claim) -> Product | Claim:
    """Thin the long lines of a figure to what an eye can see."""
    if not isinstance(product, (Figure, ThesisTable, Claim)):
        raise TypeError(f"a maker must give Figure, ThesisTable or Claim, got {type(product).__name__}")
    if not isinstance(product, Figure):
        return product
    panels = []
    for panel in product.panels:
        pairs = [thinned(curve.x, curve.y) if curve.kind == "line" else (curve.x, curve.y) for curve in panel.curves]
        curves = tuple(replace(curve, x=x, y=y) for curve, (x, y) in zip(panel.curves, pairs, strict=True))
        panels.append(replace(panel, curves=curves))
    return replace(product, panels=tuple(panels))


def _digest(value: Any) -> str:
    """SHA-256 of plain values; a function stands for its name."""
    text = json.dumps(value, default=lambda of: f"{of.__module__}:{of.__qualname__}")
    return hashlib.sha256(text.encode()).hexdigest()
