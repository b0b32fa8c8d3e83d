"""The list of everything that can be reproduced, and how a caller names a part of it."""

from __future__ import annotations

import difflib
import importlib
import re
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

from sealscope.errors import InputError
from sealscope.thesis.engine.items import Item

_ROOM = "sealscope.thesis"
#: Modules of the thesis's room that offer `ITEMS`, in the order of the thesis.
MODULES = (
    "chapters.chapter3.figures",
    "chapters.chapter4.figures",
    "claims.chapter4.summary",
    "chapters.chapter5.tests",
    "chapters.appendix_c.tables",
    "identification.fit",
    "chapters.appendix_c.success_rates",
    "claims.detection",
)
_ID = re.compile(r"[a-z0-9]+([-.][a-z0-9]+)*")


def collect(modules: Sequence[str] = MODULES) -> tuple[Item, ...]:
    """Every item of the modules, by chapter, in the modules' order within one.

    Raises ValueError where the list contradicts itself (see `check`).
    """
    found: list[Item] = []
    for name in modules:
        found += importlib.import_module(f"{_ROOM}.{name}").ITEMS
    registry = tuple(sorted(found, key=lambda item: item.chapter))
    check(registry)
    return registry


def check(registry: Iterable[Item]) -> None:
    """Refuse two items of one id, an id that is no file name, a needed item that is not there, or a circle of needs."""
    by_id: dict[str, Item] = {}
    for item in registry:
        if not _ID.fullmatch(item.id):
            raise ValueError(f"an id must be of a-z, 0-9, '.' and '-', got {item.id!r}")
        if item.id in by_id:
            raise ValueError(f"an id must be given once, got {item.id} twice")
        if item.make.count(":") != 1:
            raise ValueError(f"make must be 'module:function', got {item.make!r} ({item.id})")
        by_id[item.id] = item
    done: set[str] = set()

    def walk(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            raise ValueError(f"items must not need each other in a circle, got {' -> '.join((*above, name))}")
        if name in done:
            return
        for needed in by_id[name].needs:
            if needed not in by_id:
                raise ValueError(f"a needed item must exist, got {needed} ({name})")
            walk(needed, (*above, name))
        done.add(name)

    for name in by_id:
        walk(name, ())


def select(registry: Sequence[Item], wanted: Sequence[str]) -> tuple[Item, ...]:
    """The items a caller means: ids (`fig-5.58`), `all`, a chapter (`chapter-4`), or wildcards (`fig-5.*`).

    Raises InputError, with the closest id, where a word fits nothing.
    """
    by_id = {item.id: item for item in registry}
    chosen: set[str] = set()
    for word in wanted or ("all",):
        folded = word.strip().casefold()
        chapter = re.fullmatch(r"chapter-(\d+)", folded)
        if folded == "all":
            fits = list(by_id)
        elif folded in by_id:
            fits = [folded]
        elif chapter:
            fits = [item.id for item in registry if item.chapter == int(chapter[1])]
        elif any(sign in folded for sign in "*?["):
            fits = [name for name in by_id if fnmatchcase(name, folded)]
        else:
            fits = []
        if not fits:
            near = difflib.get_close_matches(folded, [*by_id, "all"], n=3, cutoff=0.5)
            hint = f"; closest: {', '.join(near)}" if near else ""
            raise InputError(
                f"an item must be an id of the list (sealscope reproduce --list), all, chapter-N or a wildcard such as "
                f"fig-5.*, got {word!r}{hint}"
            )
        chosen.update(fits)
    return tuple(item for item in registry if item.id in chosen)


def with_needed(registry: Sequence[Item], chosen: Sequence[Item]) -> tuple[Item, ...]:
    """The chosen items and all that they need, each after what it needs, otherwise in the registry's order."""
    by_id = {item.id: item for item in registry}
    ordered: dict[str, Item] = {}

    def walk(item: Item) -> None:
        for needed in item.needs:
            walk(by_id[needed])
        ordered.setdefault(item.id, item)

    for item in chosen:
        walk(item)
    return tuple(ordered.values())
