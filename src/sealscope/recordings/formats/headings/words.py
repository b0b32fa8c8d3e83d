"""The words of headings and their meanings, from `words.toml`."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from typing import Any


def _split_lists(tree: Any) -> Any:
    """Convert the comma-separated texts in nested tables, at any depth, to tuples of words."""
    if isinstance(tree, str):
        return tuple(tree.replace("\n", "").split(", "))
    return {key: _split_lists(value) for key, value in tree.items()}


_tree = tomllib.loads(files(__package__).joinpath("words.toml").read_text(encoding="utf-8"))
#: Meaning, or table of meanings -> words; the entries of `time`, `channel` and `stated` stay texts.
WORDS: dict[str, Any] = {**_split_lists(_tree), **{name: _tree[name] for name in ("time", "channel", "stated")}}
