"""The list of cases, figures, tables and claims under the thesis's own numbers, and how each is made."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from graphlib import CycleError, TopologicalSorter
from typing import TYPE_CHECKING, Literal

from sealscope.calls import nearest
from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.thesis.engine.context import Context
    from sealscope.thesis.engine.products import Claim, Product

    Maker = Callable[[Context, "Item"], tuple[Product | Claim, ...]]

Kind = Literal["case", "figure", "table", "claims"]
Input = str | float | tuple[str | float, ...]

#: Modules that list `ITEMS`, in the order of the thesis.
MODULES = (
    "chapters.chapter3",
    "claims.chapter3",
    "chapters.chapter4.figures",
    "claims.chapter4",
    "chapters.chapter5",
    "chapters.appendix_c.tables",
    "identification",
    "chapters.appendix_c.success_rates",
    "claims.detection",
    "chapters.chapter6",
    "claims.chapter6",
)
_ID = re.compile(r"[a-z0-9]+([-.][a-z0-9]+)*")


@dataclass(frozen=True)
class Item:
    """One thing that can be reproduced.

    `id`: the thesis's own number, such as "fig-4.22"; `make`: the function that makes its products; `inputs`: what the
    maker reads, by name; `needs_sheet`: it cannot be made without the thesis's data sheet; `needs`: ids of the items
    whose products the maker asks for.
    """

    id: str
    chapter: int
    kind: Kind
    title: str
    make: Maker
    inputs: tuple[tuple[str, Input], ...] = ()
    needs_sheet: bool = False
    needs: tuple[str, ...] = ()

    def input(self, name: str) -> Input:
        """Return the input called `name`; KeyError where the item has none."""
        return dict(self.inputs)[name]


def collect() -> tuple[Item, ...]:
    """Collect the items of all modules, by chapter, in the modules' order within a chapter."""
    modules = [importlib.import_module(f"sealscope.thesis.{name}") for name in MODULES]
    items = tuple(sorted((item for module in modules for item in module.ITEMS), key=lambda item: item.chapter))
    check(items)
    return items


def check(items: Iterable[Item]) -> None:
    """Raise ValueError for an id given twice or no file name, a needed item that does not exist, a circle of needs."""
    by_id: dict[str, Item] = {}
    for item in items:
        if not _ID.fullmatch(item.id):
            raise ValueError(f"an id must be of a-z, 0-9, '.' and '-', got {item.id!r}")
        if item.id in by_id:
            raise ValueError(f"an id must be given once, got {item.id} twice")
        by_id[item.id] = item
    for item in by_id.values():
        for needed in item.needs:
            if needed not in by_id:
                raise ValueError(f"a needed item must exist, got {needed} ({item.id})")
    try:
        TopologicalSorter({item.id: item.needs for item in by_id.values()}).prepare()
    except CycleError as error:
        raise ValueError(f"items must not need each other in a circle, got {' -> '.join(error.args[1])}") from None


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
            matches = [name for name in ids if name == folded or fnmatchcase(name, folded)]
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
    """Return the chosen items and all that they need, each after what it needs, otherwise in the list's order."""
    by_id: Mapping[str, Item] = {item.id: item for item in items}
    ordered: dict[str, Item] = {}

    def add(item: Item) -> None:
        for needed in item.needs:
            add(by_id[needed])
        ordered[item.id] = item

    for item in chosen:
        add(item)
    return tuple(ordered.values())
