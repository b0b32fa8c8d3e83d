"""Reproduce chosen items of the thesis into a folder: only what changed, in parallel, and resumable."""

from __future__ import annotations

import hashlib
import json
import os
import traceback
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from sealscope.campaigns.execution.workers import Workers, process_count
from sealscope.errors import InputError, SealscopeError
from sealscope.thesis.engine.context import Context, RunSpec, SimulatedRun, simulated_run
from sealscope.thesis.engine.items import Item, collect, select_items, with_needed
from sealscope.thesis.engine.kept import ResultsFolder
from sealscope.thesis.engine.products import Claim, Figure, Product, ThesisTable, thinned
from sealscope.thesis.sheet import MISSING, DataSheet, find_sheet, read_sheet

#: Draws an item's products into a folder and returns its files, relative to the folder.
Publish = Callable[[Item, tuple[Product | Claim, ...], Path], tuple[str, ...]]
#: Called with how many items have ended, of how many, and which are in work.
Progress = Callable[[int, int, Sequence[str]], None]
State = Literal["made", "kept", "left out", "failed", "not made"]
#: Libraries that results and drawings rest on, beside the sources of this package.
_LIBRARIES = ("numpy", "scipy", "numba", "PyWavelets", "matplotlib")


@dataclass(frozen=True)
class ItemStatus:
    """The state of an item in a results folder.

    `state`: made now, kept from an earlier call, left out or failed (`reason` says why), or not made (not chosen, or
    made by other sources); `files`: what was drawn of it, relative to the folder.
    """

    item: Item
    state: State
    reason: str = ""
    files: tuple[str, ...] = ()

    @property
    def available(self) -> bool:
        """Whether its products can be shown."""
        return self.state in ("made", "kept")


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
        return (self._builder.products(status.item.id) or ()) if status.available else ()

    @cached_property
    def _builder(self) -> Builder:
        return Builder(self.job)


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
    chosen = with_needed(every, select_items(every, patterns))
    builder = Builder(Job(Path(folder), every, quick, find_sheet(sheet), publish))
    with builder.folder.locked():
        known = {item.id: builder.status(item) for item in every}
        waiting = [item for item in chosen if known[item.id].state == "not made"]
        total, ended = len(waiting), 0

        def report(in_work: Sequence[str]) -> None:
            if progress is not None:
                progress(ended, total, in_work)

        with closing(_built(builder, waiting, min(process_count(jobs), total), report)) as built:
            for status in built:
                known[status.item.id] = status
                ended += 1
        report(())
    return Reproduction(builder.job, tuple(known.values()))


def _built(
    builder: Builder, waiting: list[Item], jobs: int, report: Callable[[Sequence[str]], None]
) -> Generator[ItemStatus, None, None]:
    """Build the items in this process or in several, each as soon as its needs have ended."""
    if jobs <= 1:
        for item in waiting:
            report([item.id])
            yield builder(item.id)
        return
    with Workers(jobs, builder) as workers:
        while waiting or workers.items:
            unfinished = {item.id for item in waiting}.union(workers.items)
            for item in [item for item in waiting if unfinished.isdisjoint(item.needs)]:
                if workers.free:
                    waiting.remove(item)
                    workers.begin(item.id)
            report(workers.items)
            for name, status in workers.ended():
                yield status or ItemStatus(builder.items[name], "failed", "the process that made it died")


class Builder:
    """Makes and draws one item after the other, and decides which need it."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.folder = ResultsFolder(job.folder)
        self.items = {item.id: item for item in job.items}
        self.sheet: DataSheet | None = None
        self.sheet_key = ""
        if job.sheet is not None:
            self.sheet, self.sheet_key = read_sheet(job.sheet)
        self.run = lru_cache(maxsize=2)(self._run)

    def __reduce__(self) -> tuple[type[Builder], tuple[Job]]:
        return Builder, (self.job,)

    def __call__(self, name: str) -> ItemStatus:
        """Make and draw an item; the status holds the reason of a failure."""
        item, job = self.items[name], self.job
        try:
            products = self.products(name) or tuple(map(_thinned, item.make(self._context(item), item)))
            files = () if job.publish is None else job.publish(item, products, job.folder)
            self.folder.keep(name, self._key(item), products, files)
        except Exception as error:
            self.folder.keep_failure(name, traceback.format_exc())
            text = str(error) if isinstance(error, SealscopeError) else f"{type(error).__name__}: {error}"
            return ItemStatus(item, "failed", (text.strip() or type(error).__name__).splitlines()[0])
        return ItemStatus(item, "made", files=files)

    def status(self, item: Item) -> ItemStatus:
        """Return the status of an item in the folder: kept, left out or not made."""
        if item.needs_sheet and self.sheet is None:
            return ItemStatus(item, "left out", MISSING)
        files = self.folder.files(item.id, self._key(item))
        return ItemStatus(item, "not made") if files is None else ItemStatus(item, "kept", files=files)

    def products(self, name: str) -> tuple[Product | Claim, ...] | None:
        """Return the products of an item that the folder holds; None where it has none of these sources."""
        return self.folder.products(name, self._key(self.items[name]))

    def _key(self, item: Item) -> str:
        """Digest of what an item's products and drawings rest on."""
        sheet = self.sheet_key if item.needs_sheet or item.uses_sheet else ""
        needs = [self._key(self.items[needed]) for needed in item.needs]
        draw = self.job.publish is not None
        own = [item.id, item.title, item.make.__module__, item.make.__qualname__, item.inputs]
        return _digest([own, needs, sheet, draw, self.job.quick, sources_key()])

    def _context(self, item: Item) -> Context:
        def product(name: str) -> tuple[Product | Claim, ...]:
            if name not in item.needs:
                raise InputError(f"{item.id} must name {name} among its needs to ask for its products")
            if self.status(self.items[name]).state == "left out":
                return ()
            products = self.products(name)
            if products is None:
                raise InputError(f"needs {name}, which failed")
            return products

        sheet = self.sheet if item.needs_sheet or item.uses_sheet else None
        return Context(self.job.quick, sheet, self.run, product)

    def _run(self, spec: RunSpec) -> SimulatedRun:
        experiment = spec.experiment()
        key = _digest([experiment.key(), spec.prove, sources_key()])
        return self.folder.run(key, lambda: simulated_run(experiment, spec.prove))


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


@cache
def sources_key() -> str:
    """Digest of the sources of this package and the versions of the libraries under it: what every result rests on."""
    package = Path(__file__).parents[2]
    kinds = (".py", ".toml", ".csv", ".j2", ".css", ".js")
    files = {str(path.relative_to(package)): path for path in package.rglob("*") if path.suffix in kinds}
    sources = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in sorted(files.items())}
    versions = {of.name.lower(): of.version for of in metadata.distributions()}
    return _digest([sources, [versions.get(name.lower()) for name in _LIBRARIES]])


def _digest(value: Any) -> str:
    """SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()[:32]
