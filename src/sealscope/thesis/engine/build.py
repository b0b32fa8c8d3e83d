"""Reproduce chosen items of the thesis into a folder: only changed ones, in parallel, and resumable."""

from __future__ import annotations

import os
import shutil
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from graphlib import TopologicalSorter
from importlib import metadata
from json import dumps, loads
from pathlib import Path
from typing import Any, Literal

from sealscope.campaigns.cases.case import digest, files_digest
from sealscope.campaigns.cases.row import error_text
from sealscope.campaigns.execution.workers import carried_out, process_count
from sealscope.errors import InputError
from sealscope.storage.folders import inner_folder
from sealscope.storage.opening import names_a_file
from sealscope.storage.plain_values import as_type
from sealscope.storage.rows import locked, read_rows, stored
from sealscope.thesis.engine.context import Context, Products
from sealscope.thesis.engine.items import Item, collect, select_items, with_needed
from sealscope.thesis.engine.products import Claim, Figure, Product, thinned
from sealscope.thesis.sheet import MISSING, DataSheet, find_sheet, read_sheet

#: Draws an item's products into a folder and returns its files, relative to the folder.
Publish = Callable[[Item, Products, Path], tuple[str, ...]]
#: Called with how many items have ended, of how many, and which are in work.
Progress = Callable[[int, int, Sequence[str]], None]
State = Literal["made", "kept", "left out", "failed", "not made"]
#: Libraries that results and drawings rest on, beside the sources of this package.
_LIBRARIES = ("numpy", "scipy", "numba", "PyWavelets", "matplotlib")
_WHAT = "a reproduction"


@dataclass(frozen=True)
class ItemStatus:
    """The state of an item in a results folder.

    `state`: made now, kept from an earlier call, left out or failed (`reason` says why), or not made (not chosen, or
    made by other sources); `products` without the curves of figures; `files`: what was drawn of it, relative to the
    folder.
    """

    item: Item
    state: State
    reason: str = ""
    products: Products = ()
    files: tuple[str, ...] = ()


@dataclass(frozen=True)
class ItemRow:
    """The stored result of an item, under the `key` of its inputs; or its `error` with the trace."""

    id: str
    key: str
    products: Products = ()
    files: tuple[str, ...] = ()
    error: str = ""
    trace: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Convert the row to plain JSON values."""
        return asdict(self)


#: An item to make, its key, and the products of what it needs.
_Job = tuple[Item, str, Mapping[str, Products]]


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
) -> dict[str, ItemStatus]:
    """Make and draw the chosen items (`items.select_items`) and their needs; return the status of all items.

    `jobs` processes (default: one a core, at most two; 1: in this process); `sheet`: folder of the data sheet (see
    `sheet.find_sheet`); `publish` draws. What was made by an earlier call from the same sources stays. A failed item
    does not stop the others. KeyboardInterrupt leaves all finished items valid.

    Raises InputError for an unknown item, a bad sheet, or a folder that cannot be written, is in use or is damaged.
    """
    if jobs is not None and jobs < 1:
        raise InputError(f"jobs must be >= 1, got {jobs}")
    every = collect() if items is None else items
    chosen, where, place = with_needed(every, select_items(every, patterns)), find_sheet(sheet), Path(folder)
    data, sheet_key = (None, "") if where is None else read_sheet(where)
    keys = _keys(every, sheet_key, quick, publish is not None)
    kept = inner_folder(place, "kept")
    with locked(kept, _WHAT):
        made_rows = read_rows(kept, partial(_row, keys), _WHAT, loads)
        statuses = {item.id: _status(item, data, made_rows.get(item.id), place) for item in every}
        waiting = {item.id: item for item in chosen if statuses[item.id].state == "not made"}
        runs = inner_folder(kept, "runs")
        try:
            shutil.rmtree(runs)  # pickles of a call that was broken off, or from outside
            runs.mkdir()
        except OSError as error:
            raise InputError(f"a folder of runs must be emptied, got: {error.strerror or error} ({runs})") from None
        task = partial(_make_item, quick, data, publish, place, runs)
        in_work: list[str] = []
        ended = 0

        def start_jobs(ready: Sequence[str]) -> Iterator[_Job]:
            for name in ready:
                in_work.append(name)
                progress(ended, len(waiting), in_work)
                done = {need: statuses[need] for need in waiting[name].needs}
                yield (
                    waiting[name],
                    keys[name],
                    {n: status.products for n, status in done.items() if status.state != "failed"},
                )

        order = TopologicalSorter({name: waiting.keys() & item.needs for name, item in waiting.items()})
        order.prepare()
        while order.is_active():
            ready = sorted(order.get_ready(), key=list(waiting).index)
            ended_rows = _rows(carried_out(task, start_jobs(ready), min(process_count(jobs), len(ready))))
            for row in stored(kept, ended_rows, _WHAT, allow_nan=True):
                state: State = "failed" if row.error else "made"
                statuses[row.id] = ItemStatus(waiting[row.id], state, row.error, row.products, row.files)
                in_work.remove(row.id)
                ended += 1
            order.done(*ready)
        progress(ended, len(waiting), in_work)
        shutil.rmtree(runs, ignore_errors=True)
    return statuses


def _keys(items: Sequence[Item], sheet: str, quick: bool, drawn: bool) -> dict[str, str]:
    """Compute the digest of the inputs of each item's products and drawings."""
    by_id, sources = {item.id: item for item in items}, sources_key()

    @cache
    def key(name: str) -> str:
        item = by_id[name]
        identity = [item.id, item.title, item.make.__module__, item.make.__qualname__, item.inputs]
        return digest([identity, [*map(key, item.needs)], sheet if item.of_sheet else "", drawn, quick, sources])

    return {name: key(name) for name in by_id}


def _row(keys: Mapping[str, str], tree: Any) -> ItemRow | None:
    """Read the stored row of an item, None for one of other sources."""
    if not isinstance(tree, dict):
        raise ValueError("no row")
    return as_type(ItemRow, tree) if keys.get(str(tree.get("id"))) == tree.get("key") else None


def _status(item: Item, sheet: DataSheet | None, row: ItemRow | None, folder: Path) -> ItemStatus:
    """Determine the status of an item in the folder: kept, left out or not made."""
    if item.needs_sheet and sheet is None:
        return ItemStatus(item, "left out", MISSING)
    if row is None or row.error or not all(names_a_file(folder / name) for name in row.files):
        return ItemStatus(item, "not made")
    return ItemStatus(item, "kept", "", row.products, row.files)


def _rows(results: Generator[tuple[_Job, ItemRow | None], None, None]) -> Generator[ItemRow, None, None]:
    """Yield the rows of the items as they end."""
    with closing(results):
        for (item, key, _), row in results:
            yield row or ItemRow(item.id, key, error="the process that made it died")


def _make_item(
    quick: bool, sheet: DataSheet | None, publish: Publish | None, folder: Path, runs: Path, job: _Job
) -> ItemRow:
    """Make and draw an item; the row holds the reason of a failure."""
    item, key, needed = job
    context = Context(item.id, item.needs, quick, sheet if item.of_sheet else None, needed, runs)
    try:
        products = tuple(map(_thinned, item.make(context, item)))
        files = () if publish is None else publish(item, products, folder)
        row = ItemRow(item.id, key, tuple(map(undrawn, products)), files)
        dumps(row.as_dict())  # what cannot be stored fails here, and not all the others with it
    except Exception as error:
        return ItemRow(item.id, key, error=error_text(error) or type(error).__name__, trace=traceback.format_exc())
    return row


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


def undrawn(product: Product | Claim) -> Product | Claim:
    """Remove the arrays, which are drawn, from a product."""
    return replace(product, panels=()) if isinstance(product, Figure) else product


@cache
def sources_key() -> str:
    """Compute a digest of this package's sources and its libraries' versions, on which all results depend."""
    package = Path(__file__).parents[2]
    kinds = (".py", ".toml", ".csv", ".j2", ".css", ".js")
    sources = files_digest(path for path in sorted(package.rglob("*")) if path.suffix in kinds)
    versions = {distribution.name.lower(): distribution.version for distribution in metadata.distributions()}
    return digest([sources, [versions.get(name.lower()) for name in _LIBRARIES]])
