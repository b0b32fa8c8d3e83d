"""The list of cases, figures, tables and claims under the thesis's own numbers (`items.toml`), with their makers."""

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
from sealscope.thesis.engine.texts import texts_of


@dataclass(frozen=True)
class Item:
    """One case, figure, table or claim that can be reproduced.

    `id`: the thesis's own number, such as "fig-4.22"; `make`: the function that makes its products; `inputs`: what the
    maker reads, by name; `uses_sheet`: it shows the thesis's data sheet where that is given, `needs_sheet`: it cannot
    be made without; `needs`: ids of the items whose products the maker asks for; `claims` that it bears on; `columns`
    of its table.
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
    def of_sheet(self) -> bool:
        """True for an item that uses the data sheet where it is given."""
        return self.uses_sheet or self.needs_sheet

    def figure(
        self, panels: Iterable[Panel], numbers: Iterable[Number] = (), resolved: bool | None = None, notes: str = ""
    ) -> Figure:
        """Make the item's figure of these panels."""
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
        """Make the item's table of these rows; `tail`, `title`, `columns` of a further one."""
        heads = tuple(columns) or self.columns
        return ThesisTable(
            self.id + tail, title or self.title, heads, tuple(rows), self.claims, resolved=resolved, notes=notes
        )


_FIELDS = {declared.name for declared in fields(Item)}


@cache
def collect() -> tuple[Item, ...]:
    """Read the items of `items.toml`, in its order."""
    return tuple(
        item for chapter, rows in texts_of("items.toml").items() for name, row in rows.items()
        for item in _items(name, int(chapter), row)
    )  # fmt: skip


def _items(name: str, chapter: int, row: Mapping[str, Any]) -> Iterator[Item]:
    """Yield the item of a row, or the items of the function named by `each` (id, title and inputs)."""
    inputs_read: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in row.items()
    }
    fields_read: dict[str, Any] = {key: inputs_read.pop(key) for key in row if key in _FIELDS}
    fields_read["make"] = _function(fields_read["make"])
    fields_read["claims"] = tuple(f"claim-{claim}" for claim in fields_read.get("claims", ()))
    variants = (
        _function(inputs_read["each"])() if "each" in inputs_read else [(name, fields_read.pop("title"), inputs_read)]
    )
    for id, title, inputs in variants:
        yield Item(**{"kind": "figure", "chapter": chapter, **fields_read, "id": id, "title": title, "inputs": inputs})


def _function(name: str) -> Any:
    module, _, function = name.rpartition(".")
    return getattr(importlib.import_module(f"sealscope.thesis.{module}"), function)


def select_items(items: Sequence[Item], patterns: Sequence[str]) -> tuple[Item, ...]:
    """Select items by id (`fig-5.58`), `all`, chapter (`chapter-4`) or wildcards (`fig-5.*`), in the order of the list.

    Raises InputError, with the closest ids, where a pattern matches nothing.
    """
    ids = [item.id for item in items]
    chosen: set[str] = set()
    for pattern in patterns or ("all",):
        folded = pattern.strip().casefold()
        if folded == "all":
            matches = ids
        elif re.fullmatch(r"chapter-\d+", folded):
            matches = [item.id for item in items if folded == f"chapter-{item.chapter}"]
        else:
            matches = [name for name in ids if fnmatchcase(name, folded)]
        if not matches:
            near = nearest(folded, [*ids, "all"], 3)
            hint = f"; closest: {', '.join(near)}" if near else ""
            raise InputError(
                "an item must be an id of the list (sealscope reproduce --list), all, chapter-N or a wildcard such as "
                f"fig-5.*, got {pattern!r}{hint}"
            )
        chosen.update(matches)
    return tuple(item for item in items if item.id in chosen)


def with_needed(items: Sequence[Item], chosen: Iterable[Item]) -> tuple[Item, ...]:
    """Add the items that the chosen ones need, in the order of the list."""
    by_id, names = {item.id: item for item in items}, {item.id for item in chosen}
    while more := {needed for name in names for needed in by_id[name].needs} - names:
        names |= more
    return tuple(item for item in items if item.id in names)
