"""A claim of `claims.toml` with its numbers put in and its verdict."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from typing import Any

from sealscope.thesis.engine.products import Claim, verdict_of


@cache
def _texts() -> dict[str, dict[str, str]]:
    return tomllib.loads(files(__package__).joinpath("claims.toml").read_text(encoding="utf-8"))


def judged(id: str, tests: Iterable[bool | None], kind: str = "", /, **values: Any) -> Claim:
    """Judge the claim `claim-id` by the tests of its parts; its texts, with `values` put in, are those of `kind` or id.

    `sheet` and `simulation` among the values take the place of the texts of that name.
    """
    texts = _texts()
    text = dict(texts[kind or id])
    text.setdefault("sheet", next(of for prefix, of in texts["sheet"].items() if id.startswith(prefix)))
    filled = {name: of.format(**values) for name, of in text.items()}
    filled |= {name: values[name] for name in ("sheet", "simulation") if name in values}
    filled["verdict"] = verdict_of(tests)
    return Claim(id=f"claim-{id}", **filled)  # type: ignore[arg-type]  # the verdict is one of the texts that it may be
