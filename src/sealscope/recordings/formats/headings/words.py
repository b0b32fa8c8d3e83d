"""The words of headings, from `words.toml`."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from typing import Any


def _lists(tree: Any) -> Any:
    """Return a tree with a tuple of words in place of each text."""
    if isinstance(tree, str):
        return tuple(tree.replace("\n", "").split(", "))
    return {key: _lists(value) for key, value in tree.items()}


_tree = tomllib.loads(files(__package__).joinpath("words.toml").read_text(encoding="utf-8"))
#: Name of a meaning, or of a table of these -> words; `time` and `stated` hold texts.
WORDS: dict[str, Any] = {**_lists(_tree), "time": _tree["time"], "stated": _tree["stated"]}
