"""What is believed of machines before a recording is seen: `priors.toml` of a package, as `inference/priors.toml`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sealscope.storage.toml_file import beliefs_of


def beliefs(package: str) -> Mapping[str, Mapping[str, Any]]:
    """Return the values of `beliefs_of` a package below `sealscope.diagnosis`."""
    return beliefs_of(f"sealscope.diagnosis.{package}")
