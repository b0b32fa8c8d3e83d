"""What is believed of machines before a recording is seen: `priors.toml` of a package, as `inference/priors.toml`."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any


@cache
def beliefs(package: str) -> Mapping[str, Mapping[str, Any]]:
    """Return the values by table and name; each states its unit and source beside it.

    `package`: below `sealscope.diagnosis`. Raises KeyError where a row lacks unit or source.
    """
    text = (files(f"sealscope.diagnosis.{package}") / "priors.toml").read_text("utf-8")
    checked = {}
    for table, rows in tomllib.loads(text).items():
        checked[table] = {name: (row["value"], row["unit"], row["source"])[0] for name, row in rows.items()}
    return checked
