"""Reproduce chosen items of the thesis into a folder: only what changed, in parallel, and resumable."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Literal

from sealscope.campaigns.cases.case import digest, files_digest
from sealscope.campaigns.execution.workers import carried_out, process_count
from sealscope.errors import InputError, SealscopeError
from sealscope.thesis.engine.context import Context, Products, RunSpec, SimulatedRun, simulated_run
from sealscope.thesis.engine.items import Item, collect, select_items, with_needed
from sealscope.thesis.engine.kept import ResultsFolder
from sealscope.thesis.engine.products import Claim, Figure, Product, thinned
from sealscope.thesis.sheet import MISSING, DataSheet, find_sheet, read_sheet

#: Draws an item's products into a folder and returns its files, relative to the folder.
Publish = Callable[[Item, Products, Path], tuple[str, ...]]
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


class Reproduction:
    """The items of a results folder: the status of each by its id, in the order of the list, and its products."""

    def __init__(
        self, folder: Path, items: Sequence[Item], quick: bool, sheet: Path | None, publish: Publish | None
    ) -> None:
        self.folder, self.items = ResultsFolder(folder), {item.id: item for item in items}
        self.quick, self.publish = quick, publish
        self.sheet: DataSheet | None = None
        self._sheet_key = ""
        if sheet is not None:
            self.sheet, self._sheet_key = read_sheet(sheet)
        self.statuses: dict[str, ItemStatus] = {}

    def products(self, name: str) -> Products | None:
        """Return the products of an item that the folder holds; None where it has none of these sources."""
        return self.folder.products(name, self._key(self.items[name]))

    def status(self, item: Item) -> ItemStatus:
        """Return the status of an item as the folder has it: kept, left out or not made."""
        if self._left_out(item):
            return ItemStatus(item, "left out", MISSING)
        files = self.folder.files(item.id, self._key(item))
        return ItemStatus(item, "not made" if files is None else "kept", files=files or ())

    def make(self, name: str) -> ItemStatus:
        """Make and draw an item; the status holds the reason of a failure."""
        item = self.items[name]
        try:
            products = self.products(name) or tuple(map(_thinned, item.make(self._context(item), item)))
            files = () if self.publish is None else self.publish(item, products, self.folder.path)
            self.folder.save(name, self._key(item), products, files)
        except Exception as error:
            self.folder.save_failure(name, traceback.format_exc())
            text = str(error) if isinstance(error, SealscopeError) else f"{type(error).__name__}: {error}"
            return ItemStatus(item, "failed", (text.strip() or type(error).__name__).splitlines()[0])
        return ItemStatus(item, "made", files=files)

    def _left_out(self, item: Item) -> bool:
        return item.needs_sheet and self.sheet is None

    def _key(self, item: Item) -> str:
        """Digest of what an item's products and drawings rest on."""
        sheet = self._sheet_key if item.needs_sheet or item.uses_sheet else ""
        needs = [self._key(self.items[needed]) for needed in item.needs]
        own = [item.id, item.title, item.make.__module__, item.make.__qualname__, item.inputs]
        return digest([own, needs, sheet, self.publish is not None, self.quick, sources_key()])

    def _context(self, item: Item) -> Context:
        def product(name: str) -> Products:
            if name not in item.needs:
                raise InputError(f"{item.id} must name {name} among its needs to ask for its products")
            products = () if self._left_out(self.items[name]) else self.products(name)
            if products is None:
                raise InputError(f"needs {name}, which failed")
            return products

        def run(spec: RunSpec) -> SimulatedRun:
            return self.folder.run(digest([astuple(spec), sources_key()]), lambda: simulated_run(spec))

        return Context(self.quick, self.sheet if item.needs_sheet or item.uses_sheet else None, run, product)


def reproduce(
    patterns: Sequence[str] = ("all",),
    folder: str | os.PathLike[str] = "sealscope-thesis",
    *,
    quick: bool = False,
    jobs: int | None = None,
    sheet: str | os.PathLike[str] | None = None,
    items: Sequence[Item] | None = None,
    publish: Publish | None = None,
    progress: Progress = lambda ended, total, in_work: None,
) -> Reproduction:
    """Make the chosen items (see `items.select_items`) and what they need, and draw them with `publish`.

    `jobs` processes (default: one a core, at most two; 1: in this process); `sheet`: folder of the data sheet (see
    `sheet.find_sheet`). What was made by an earlier call from the same sources stays. A failed item does not stop the
    others. KeyboardInterrupt leaves all finished items valid.

    Raises InputError for an unknown item, a bad sheet, or a folder that cannot be written or is in use.
    """
    if jobs is not None and jobs < 1:
        raise InputError(f"jobs must be >= 1, got {jobs}")
    every = collect() if items is None else items
    chosen = with_needed(every, select_items(every, patterns))
    result = Reproduction(Path(folder), every, quick, find_sheet(sheet), publish)
    with result.folder.locked():
        result.statuses = {item.id: result.status(item) for item in every}
        waiting = [item for item in chosen if result.statuses[item.id].state == "not made"]
        total, ended, in_work = len(waiting), 0, list[str]()

        def begun(ready: Sequence[Item]) -> Iterator[str]:
            for item in ready:
                in_work.append(item.id)
                progress(ended, total, in_work)
                yield item.id

        while waiting:
            unmade = {item.id for item in waiting}
            ready = [item for item in waiting if unmade.isdisjoint(item.needs)]
            waiting = [item for item in waiting if item not in ready]
            with closing(carried_out(result.make, begun(ready), min(process_count(jobs), len(ready)))) as made:
                for name, status in made:
                    died = ItemStatus(result.items[name], "failed", "the process that made it died")
                    result.statuses[name] = status or died
                    in_work.remove(name)
                    ended += 1
        progress(ended, total, in_work)
    return result


def _thinned(product: Product | Claim) -> Product | Claim:
    """Thin the long lines of a figure to what an eye can see."""
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
    sources = files_digest(path for path in sorted(package.rglob("*")) if path.suffix in kinds)
    versions = {of.name.lower(): of.version for of in metadata.distributions()}
    return digest([sources, [versions.get(name.lower()) for name in _LIBRARIES]])
