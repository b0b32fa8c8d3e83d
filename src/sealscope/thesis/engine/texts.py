"""The thesis's texts with numbers put in: notes (`notes.toml`), claims and verdicts (`claims.toml`)."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from typing import Any

from sealscope.thesis.engine.products import Claim, verdict_of


@cache
def texts_of(name: str) -> dict[str, Any]:
    """Read a TOML file of this package."""
    return tomllib.loads(files("sealscope.thesis").joinpath(name).read_text(encoding="utf-8"))


def note(name: str, **values: Any) -> str:
    """Fill `values` into the note of a name."""
    return str(texts_of("notes.toml")[name]).format(**values)


def judge_claim(id: str, tests: Iterable[bool | None], kind: str = "", /, **values: Any) -> Claim:
    """Judge the claim `claim-id` by the tests of its parts; its texts, filled with `values`, are those of `kind` or id.

    `sheet`, `simulation` and `why` among the values take the place of the texts of that name.
    """
    texts = texts_of("claims.toml")
    text = dict(texts[kind or id])
    text.setdefault("sheet", next(words for prefix, words in texts["sheet"].items() if id.startswith(prefix)))
    replaced = {name: values[name] for name in ("sheet", "simulation", "why") if name in values}
    filled = {name: words.format(**values) for name, words in text.items() if name not in replaced}
    return Claim(id=f"claim-{id}", verdict=verdict_of(tests), **filled, **replaced)
