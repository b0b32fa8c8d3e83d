"""What is believed of machines before a recording is seen: values with widths, units and sources, in data files."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from sealscope.errors import InputError
from sealscope.storage.toml_file import read_toml

if TYPE_CHECKING:
    from collections.abc import Mapping

_FIELDS = {"value", "width", "unit", "source"}


class Prior(NamedTuple):
    """A normal prior: its centre `value` and standard deviation `width`, both in `unit`, and the `source` of them."""

    value: float
    width: float
    unit: str
    source: str


@cache
def priors(file: str, table: str) -> Mapping[str, Prior]:
    """Return the priors of a table of a packaged file of this room, by name.

    Raises InputError where an entry is not value, width >= 0, unit and source.
    """
    place = f"diagnosis/{file}"
    entries = read_toml(Path(__file__).with_name(file), "a file of priors", place)[table]
    for name, entry in entries.items():
        if set(entry) != _FIELDS or entry["width"] < 0:
            raise InputError(f"a prior must have {', '.join(sorted(_FIELDS))} and width >= 0: {table}.{name} ({place})")
    return MappingProxyType({name: Prior(**entry) for name, entry in entries.items()})
