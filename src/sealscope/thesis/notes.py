"""The notes under figures and tables: `notes.toml` with the numbers put in."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.resources import files
from typing import Any


@cache
def _texts() -> dict[str, str]:
    return tomllib.loads(files(__package__).joinpath("notes.toml").read_text(encoding="utf-8"))


def note(name: str, **values: Any) -> str:
    """Return the note of that name with `values` put in."""
    return _texts()[name].format(**values)
