"""The list of cases, figures, tables and claims under the thesis's own numbers, and how each is made."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any, Literal

from sealscope.calls import nearest
from sealscope.errors import InputError
from sealscope.thesis.engine.context import Context, Products

#: Modules that list `ITEMS`, in the order of the thesis.
MODULES = (
    "chapters.chapter3",
    "chapters.chapter4.figures",
    "chapters.chapter4.claims",
    "chapters.chapter5",
    "chapters.appendix_c_runs",
    "chapters.appendix_c",
    "identification",
    "chapters.success_rates",
    "claims.detection",
    "chapters.chapter6",
)


@dataclass(frozen=True)
class Item:
    """One thing that can be reproduced.

    `id`: the thesis's own number, such as "fig-4.22"; `make`: the function that makes its products; `inputs`: what the
    maker reads, by name; `uses_sheet`: it shows the thesis's data sheet where that is given, `needs_sheet`: it cannot
    be made without; `needs`: ids of the items whose products the maker asks for.
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


def collect() -> tuple[Item, ...]:
    """Collect the items of all modules, by chapter, in the modules' order within a chapter."""
    modules = [importlib.import_module(f"sealscope.thesis.{name}") for name in MODULES]
    return tuple(sorted((item for module in modules for item in module.ITEMS), key=lambda item: item.chapter))


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
    """Return the chosen items and all that they need, in the order of the list."""
    by_id, wanted = {item.id: item for item in items}, {item.id for item in chosen}
    while more := {needed for name in wanted for needed in by_id[name].needs} - wanted:
        wanted |= more
    return tuple(item for item in items if item.id in wanted)
