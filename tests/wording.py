"""Find a sentence by its key, in whatever words `texts.toml` and `messages.toml` have it."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from string import Formatter
from typing import Any


@cache
def _templates() -> Mapping[str, Mapping[str, str]]:
    """The tables of the reasons of verdicts and of the messages on page and terminal."""
    both: dict[str, Mapping[str, str]] = {}
    for package, file in (("sealscope.diagnosis.decision", "texts.toml"), ("sealscope.reporting", "messages.toml")):
        tables = tomllib.loads((files(package) / file).read_text("utf-8"))
        assert not both.keys() & tables.keys()
        both |= tables
    return both


def says(text: str, key: str, **values: Any) -> bool:
    """Test whether a text holds the sentence of `table.key` with these values; values that are not given may be any."""
    table, _, name = key.partition(".")
    pattern = ""
    for literal, field, form, _ in Formatter().parse(_templates()[table][name]):
        pattern += re.escape(literal)
        if field is not None:
            pattern += re.escape(format(values[field], form or "")) if field in values else ".*?"
    return re.search(pattern, " ".join(text.split()), re.DOTALL) is not None
