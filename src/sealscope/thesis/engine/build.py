"""Reproduce items of the thesis into a folder, in parallel; results stored earlier are reused if up to date."""

from __future__ import annotations

import os
import shutil
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from graphlib import TopologicalSorter
from importlib import metadata
from json import dumps, loads
from pathlib import Path
from typing import Any, Literal

from sealscope.campaigns.cases.case import digest, files_digest
from sealscope.campaigns.cases.row import error_text
from sealscope.campaigns.execution.workers import iter_results, iter_rows, process_count
from sealscope.errors import InputError
from sealscope.storage.folders import make_inner_folder
from sealscope.storage.opening import is_file_path
from sealscope.storage.plain_values import convert_type
from sealscope.storage.rows import lock_rows, read_rows, store_rows
from sealscope.thesis.engine.context import Context, Products
from sealscope.thesis.engine.items import Item, add_needed_items, load_items, select_items
from sealscope.thesis.engine.products import Claim, Figure, Product, thin_curve
from sealscope.thesis.sheet import MISSING, DataSheet, find_sheet, read_sheet

#: Writes an item's products into a folder and returns the files, relative to the folder.
Publish = Callable[[Item, Products, Path], tuple[str, ...]]
#: Called with the number of finished items, the number of all items to make, and the ids of the items in work.
Progress = Callable[[int, int, Sequence[str]], None]
State = Literal["made", "kept", "left out", "failed", "not made"]
#: Libraries whose versions results and drawings depend on.
_LIBRARIES = ("numpy", "scipy", "numba", "PyWavelets", "matplotlib")
#: Name of the stored results in error messages.
_WHAT = "a reproduction"


@dataclass(frozen=True)
class ItemStatus:
    """The state of an item, that is of a figure, table or claim, in the folder of a reproduction.

    - `state`: "made" by this call, "kept" from an earlier call, "left out" or "failed" (for the stated `reason`), or
      "not made" (not selected, and no complete result of the same inputs is stored)
    - `products`: tables, claims, and figures without their panels
    - `files`: paths relative to the folder
    """

    item: Item
    state: State
    reason: str = ""
    products: Products = ()
    files: tuple[str, ...] = ()


@dataclass(frozen=True)
class ItemRow:
    """The stored result of an item, or the `error` that it raised, with its traceback `trace`.

    `key`: digest of the item's inputs, by which an outdated result is recognised.
    """

    id: str
    key: str
    products: Products = ()
    files: tuple[str, ...] = ()
    error: str = ""
    trace: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Convert the stored result of an item to a dict of plain values, which JSON can store."""
        return asdict(self)


#: An item to make, its key, and the products of the items it needs.
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
    """Make the selected items of the thesis and the items they need; return the status of all items by id.

    `patterns`: selection (`items.select_items`); `quick`: True to simulate less; `jobs`: number of processes, by
    default one per core, 1 for this process only; `sheet`: folder of the measured data sheet; `items`: the list to
    select from, by default that of `items.toml`; `publish`: writes the products as files, by default none; `progress`:
    called with the number of finished items, the number of all items that this call makes, and the ids of the items
    that are being made.

    Results that an earlier call stored in `folder` from the same inputs are reused. A failed item does not stop the
    others, and KeyboardInterrupt leaves all finished items stored.

    Raises InputError for `jobs` below 1, an unknown item, an invalid data sheet, or a folder that is damaged, in use or
    cannot be written.
    """
    if jobs is not None and jobs < 1:
        raise InputError(f"jobs must be >= 1, got {jobs}")
    all_items = load_items() if items is None else items
    selected = add_needed_items(all_items, select_items(all_items, patterns))
    root = Path(folder)
    sheet_folder = find_sheet(sheet)
    data_sheet, sheet_key = (None, "") if sheet_folder is None else read_sheet(sheet_folder)
    keys = _item_keys(all_items, sheet_key, quick)
    store = make_inner_folder(root, "kept")
    with lock_rows(store, _WHAT):
        stored_rows = read_rows(store, partial(_parse_row, keys), _WHAT, loads)
        statuses = {item.id: _item_status(item, data_sheet, stored_rows.get(item.id), root) for item in all_items}
        waiting = {item.id: item for item in selected if statuses[item.id].state == "not made"}
        runs = _empty_runs_folder(store)
        task = partial(_make_item, quick, data_sheet, publish, root, runs)
        in_work: list[str] = []
        n_done = 0

        def start_jobs(ready: Sequence[str]) -> Iterator[_Job]:
            """Yield the job of each item whose id is in `ready`, and report the item as in work."""
            for name in ready:
                in_work.append(name)
                progress(n_done, len(waiting), in_work)
                item = waiting[name]
                # an item that was left out counts as made, without products
                made_needs = [need for need in item.needs if statuses[need].state != "failed"]
                yield item, keys[name], {need: statuses[need].products for need in made_needs}

        # an item is ready when all items it needs are finished
        order = TopologicalSorter({name: waiting.keys() & item.needs for name, item in waiting.items()})
        order.prepare()
        while order.is_active():
            ready = sorted(order.get_ready(), key=list(waiting).index)
            results = iter_results(task, start_jobs(ready), min(process_count(jobs), len(ready)))
            new_rows = iter_rows(results, lambda job: ItemRow(job[0].id, job[1], error="the process that made it died"))
            for row in store_rows(store, new_rows, _WHAT, allow_nan=True):
                state: State = "failed" if row.error else "made"
                statuses[row.id] = ItemStatus(waiting[row.id], state, row.error, row.products, row.files)
                in_work.remove(row.id)
                n_done += 1
            order.done(*ready)
        progress(n_done, len(waiting), in_work)
        shutil.rmtree(runs, ignore_errors=True)
    return statuses


def _empty_runs_folder(store: Path) -> Path:
    """Empty the folder for the simulated runs of this call, below the results folder `store`; return its path.

    Unpickling files that this call did not write would be unsafe. Raises InputError if the folder cannot be emptied.
    """
    runs = make_inner_folder(store, "runs")
    try:
        shutil.rmtree(runs)
        runs.mkdir()
    except OSError as error:
        raise InputError(f"a folder of runs must be emptied, got: {error.strerror or error} ({runs})") from None
    return runs


def _item_keys(items: Sequence[Item], sheet_key: str, quick: bool) -> dict[str, str]:
    """Compute a digest for each item, by id, that changes with any input of the item's products and files.

    `sheet_key`: digest of the data sheet, "" if not given; `quick`: True if less is simulated.
    """
    by_id = {item.id: item for item in items}
    sources = sources_key()

    @cache
    def item_key(name: str) -> str:
        """Compute the digest of one item, which includes the digests of the items it needs."""
        item = by_id[name]
        identity = [item.id, item.title, item.make.__module__, item.make.__qualname__, item.inputs]
        sheet = sheet_key if item.reads_sheet else ""
        return digest([identity, [*map(item_key, item.needs)], sheet, quick, sources])

    return {name: item_key(name) for name in by_id}


def _parse_row(keys: Mapping[str, str], tree: Any) -> ItemRow | None:
    """Convert plain values to the stored result of an item, or None if the item's key is no longer that in `keys`.

    Raises ValueError if `tree` has another form.
    """
    if not isinstance(tree, dict):
        raise ValueError("no row")
    return convert_type(ItemRow, tree) if keys.get(str(tree.get("id"))) == tree.get("key") else None


def _item_status(item: Item, sheet: DataSheet | None, row: ItemRow | None, folder: Path) -> ItemStatus:
    """Determine an item's status before anything is made, from its stored result and the files in `folder`.

    `row`: the stored result of the same inputs, None if there is none.
    """
    if item.needs_sheet and sheet is None:
        return ItemStatus(item, "left out", MISSING)
    if row is None or row.error or not all(is_file_path(folder / name) for name in row.files):
        return ItemStatus(item, "not made")
    return ItemStatus(item, "kept", "", row.products, row.files)


def _make_item(
    quick: bool, sheet: DataSheet | None, publish: Publish | None, folder: Path, runs: Path, job: _Job
) -> ItemRow:
    """Make one item and write its files; return the row to store, with result or error.

    `folder`: folder of the results; `runs`: folder of the simulated runs that all items share; the other arguments are
    those of `reproduce`.
    """
    item, key, needed = job
    context = Context(item.id, item.needs, quick, sheet if item.reads_sheet else None, needed, runs)
    try:
        products = tuple(map(_thin_product, item.make(context, item)))  # figures with fewer points
        files = () if publish is None else publish(item, products, folder)
        row = ItemRow(item.id, key, tuple(map(drop_curves, products)), files)  # figures are stored without curves
        dumps(row.as_dict())  # if a row cannot be stored, only its own item fails
    except Exception as error:
        return ItemRow(item.id, key, error=error_text(error) or type(error).__name__, trace=traceback.format_exc())
    return row


def _thin_product(product: Product | Claim) -> Product | Claim:
    """Thin the long lines of a figure to fewer points (`thin_curve`); return any other product unchanged."""
    if not isinstance(product, Figure):
        return product
    panels = []
    for panel in product.panels:
        curves = []
        for curve in panel.curves:
            x, y = thin_curve(curve.x, curve.y) if curve.kind == "line" else (curve.x, curve.y)
            curves.append(replace(curve, x=x, y=y))
        panels.append(replace(panel, curves=tuple(curves)))
    return replace(product, panels=tuple(panels))


def drop_curves(product: Product | Claim) -> Product | Claim:
    """Remove the panels of a figure, which are not stored; return any other product unchanged."""
    return replace(product, panels=()) if isinstance(product, Figure) else product


@cache
def sources_key() -> str:
    """Compute a digest of this package's sources and of the versions of the libraries on which results depend."""
    package = Path(__file__).parents[2]  # folder of `sealscope`
    suffixes = (".py", ".toml", ".csv", ".j2", ".css", ".js")
    sources = files_digest(path for path in sorted(package.rglob("*")) if path.suffix in suffixes)
    versions = {distribution.name.lower(): distribution.version for distribution in metadata.distributions()}
    return digest([sources, [versions.get(name.lower()) for name in _LIBRARIES]])
