"""The texts of a verdict's reason, by key (`texts.toml`)."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any


@cache
def _texts() -> Mapping[str, Mapping[str, str]]:
    """Read `texts.toml` once: its tables by name, each a mapping from key to text."""
    return tomllib.loads((files("sealscope.diagnosis.decision") / "texts.toml").read_text("utf-8"))


def text_of(table: str, key: str, **values: Any) -> str:
    """Return the text with a given `key` in a `table` of `texts.toml`, with `values` filled in for its fields."""
    return _texts()[table][key].format(**values)
