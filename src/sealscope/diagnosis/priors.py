"""What is believed of machines before a recording is seen: values with widths, units and sources, in a data file."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import NamedTuple


class Prior(NamedTuple):
    """A normal prior: its centre `value` and standard deviation `width`, both in `unit`, and the `source` of them."""

    value: float
    width: float
    unit: str
    source: str


@cache
def priors(table: str) -> Mapping[str, Prior]:
    """Return the priors of a table of `pressures.toml`, by name."""
    tree = tomllib.loads((files("sealscope.diagnosis") / "pressures.toml").read_text("utf-8"))
    return {name: Prior(**row) for name, row in tree[table].items()}
