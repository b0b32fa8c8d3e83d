"""The list of cases, figures, tables and claims that can be reproduced (`items.toml`), and the selection from it."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from fnmatch import fnmatchcase
from functools import cache
from typing import Any, Literal

from sealscope.calls import nearest
from sealscope.errors import InputError
from sealscope.thesis.engine.context import Context, Products
from sealscope.thesis.engine.products import Cell, Figure, Number, Panel, ThesisTable
from sealscope.thesis.engine.texts import load_texts


@dataclass(frozen=True)
class Item:
    """One case, figure, table or group of claims of the thesis that can be reproduced.

    `id`: kind and the thesis's number, such as "fig-4.22"; `make`: function that makes its products; `inputs`: inputs
    of that function by name; `uses_sheet`: True if it shows the measured data sheet when that is given; `needs_sheet`:
    True if it cannot be made without the sheet; `needs`: ids of items whose products `make` uses; `claims`: ids of
    claims that it supports or refutes; `columns`: heads of its table.
    """

    id: str
    chapter: int
    kind: Literal["case", "figure", "table", "claims"]
    title: str
    make: Callable[[Context, Item], Products]
    inputs: Mapping[str, Any] = field(default_factory=dict)
    needs_sheet: bool = False
    uses_sheet: bool = False
    needs: tuple[str, ...] = ()
    claims: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()

    @property
    def reads_sheet(self) -> bool:
        """True if the item uses the measured data sheet, or cannot be made without it."""
        return self.uses_sheet or self.needs_sheet

    def figure(
        self, panels: Iterable[Panel], numbers: Iterable[Number] = (), resolved: bool | None = None, notes: str = ""
    ) -> Figure:
        """Build the figure of this item, with its id, title and claims; the arguments are those of `Figure`."""
        return Figure(self.id, self.title, tuple(panels), tuple(numbers), self.claims, resolved, notes)

    def table(
        self,
        rows: Iterable[tuple[Cell, ...]],
        notes: str = "",
        columns: Iterable[str] = (),
        *,
        tail: str = "",
        title: str = "",
        resolved: bool | None = None,
    ) -> ThesisTable:
        """Build a table of this item, with its claims.

        `columns` (heads) and `title` replace those of the item if stated; `tail` is appended to the item's id, for a
        second table of one item; the other arguments are those of `ThesisTable`.
        """
        heads = tuple(columns) or self.columns
        return ThesisTable(self.id + tail, title or self.title, heads, tuple(rows), self.claims, resolved, notes)


_FIELDS = {declared.name for declared in fields(Item)}


@cache
def load_items() -> tuple[Item, ...]:
    """Read the list of all items from `items.toml`, in the order of the file."""
    return tuple(
        item for chapter, rows in load_texts("items.toml").items() for name, row in rows.items()
        for item in _iter_row_items(name, int(chapter), row)
    )  # fmt: skip


def _iter_row_items(name: str, chapter: int, row: Mapping[str, Any]) -> Iterator[Item]:
    """Yield the item `name`, or the items that a function `each` lists, which a row of `items.toml` describes.

    Entries of the row that are not fields of `Item` become its `inputs`; with `each`, the function states id, title and
    inputs of each item instead.
    """
    row_inputs: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in row.items()}
    row_fields: dict[str, Any] = {key: row_inputs.pop(key) for key in row if key in _FIELDS}
    row_fields["make"] = _import_function(row_fields["make"])
    row_fields["claims"] = tuple(f"claim-{claim}" for claim in row_fields.get("claims", ()))
    if "each" in row_inputs:
        variants = _import_function(row_inputs["each"])()
    else:
        variants = [(name, row_fields.pop("title"), row_inputs)]
    for id, title, inputs in variants:
        yield Item(**{"kind": "figure", "chapter": chapter, **row_fields, "id": id, "title": title, "inputs": inputs})


def _import_function(name: str) -> Any:
    """Import a function by its dotted name below `sealscope.thesis`, such as "chapters.chapter3.wavelet_figure"."""
    module, _, function = name.rpartition(".")
    return getattr(importlib.import_module(f"sealscope.thesis.{module}"), function)


def select_items(items: Sequence[Item], patterns: Sequence[str]) -> tuple[Item, ...]:
    """Select items by id (`fig-5.58`), `all`, chapter (`chapter-4`) or wildcards (`fig-5.*`), in the order of `items`.

    No patterns select all. Raises InputError, with the closest ids, if a pattern matches nothing.
    """
    ids = [item.id for item in items]
    selected: set[str] = set()
    for pattern in patterns or ("all",):
        folded = pattern.strip().casefold()
        if folded == "all":
            matches = ids
        elif re.fullmatch(r"chapter-\d+", folded):
            matches = [item.id for item in items if folded == f"chapter-{item.chapter}"]
        else:
            matches = [name for name in ids if fnmatchcase(name, folded)]
        if not matches:
            near = nearest(folded, [*ids, "all"], count=3)
            hint = f"; closest: {', '.join(near)}" if near else ""
            raise InputError(
                "an item must be an id of the list (sealscope reproduce --list), all, chapter-N or a wildcard such as "
                f"fig-5.*, got {pattern!r}{hint}"
            )
        selected.update(matches)
    return tuple(item for item in items if item.id in selected)


def add_needed_items(items: Sequence[Item], selected: Iterable[Item]) -> tuple[Item, ...]:
    """Add to the selected items all items whose products they need, directly or indirectly, in the order of `items`."""
    by_id, ids = {item.id: item for item in items}, {item.id for item in selected}
    while missing := {needed for name in ids for needed in by_id[name].needs} - ids:
        ids |= missing
    return tuple(item for item in items if item.id in ids)
