"""Fill numbers into the reproduction's texts: notes (`notes.toml`) and claims with their findings (`claims.toml`)."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from typing import Any

from sealscope.thesis.engine.products import Claim, claim_verdict


@cache
def load_texts(name: str) -> dict[str, Any]:
    """Load a TOML file of the package `sealscope.thesis`, such as "notes.toml"."""
    return tomllib.loads(files("sealscope.thesis").joinpath(name).read_text(encoding="utf-8"))


def format_note(name: str, **values: Any) -> str:
    """Format the text `name` of `notes.toml`, with `values` in place of its placeholders."""
    return str(load_texts("notes.toml")[name]).format(**values)


def format_range(values: Iterable[float], unit: str, factor: float = 1.0) -> str:
    """Format the smallest and the largest of some values, such as "-1.25 to +3.00 kPa"; `factor` converts to `unit`."""
    scaled = [value * factor for value in values]
    return f"{min(scaled):+.2f} to {max(scaled):+.2f} {unit}"


def judge_claim(id: str, tests: Iterable[bool], kind: str = "", /, **values: Any) -> Claim:
    """Judge the claim `id` by the tests of its parts (`claim_verdict`), and fill `values` into its texts.

    Without tests the claim cannot be tested. The texts are in `claims.toml` under `id`, or under `kind` for claims that
    share texts. The values `sheet`, `simulation` and `why` replace a whole text; the others fill the placeholders of
    the same names. These may be named as the first three arguments, which are therefore positional only.
    """
    claims = load_texts("claims.toml")
    templates = dict(claims[kind or id])
    # a claim without a text `sheet` of its own gets that of its chapter, found by the prefix of its id
    templates.setdefault("sheet", next(text for prefix, text in claims["sheet"].items() if id.startswith(prefix)))
    replaced = {name: values[name] for name in ("sheet", "simulation", "why") if name in values}
    texts = {name: template.format(**values) for name, template in templates.items() if name not in replaced}
    return Claim(id=f"claim-{id}", verdict=claim_verdict(tests), **texts, **replaced)
