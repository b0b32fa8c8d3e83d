"""What is believed of machines before a recording is seen: `priors.toml` of a package, as `inference/priors.toml`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sealscope.storage.toml_file import priors_of


def priors(package: str) -> Mapping[str, Mapping[str, Any]]:
    """Return the values of `priors_of` a package below `sealscope.diagnosis`."""
    return priors_of(f"sealscope.diagnosis.{package}")
