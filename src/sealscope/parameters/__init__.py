"""Typed, immutable parameters of a rig, each value with unit and source."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sealscope.parameters.parts import Daq as Daq
    from sealscope.parameters.parts import PressureTransducer as PressureTransducer
    from sealscope.parameters.rig import Rig as Rig
    from sealscope.parameters.rig import declared_names as declared_names
    from sealscope.parameters.rig import load_rig as load_rig
    from sealscope.parameters.rig import parse_overrides as parse_overrides
    from sealscope.parameters.rig import rig_names as rig_names

_NAMES = {
    "parts": ("Daq", "PressureTransducer"),
    "rig": ("Rig", "declared_names", "load_rig", "parse_overrides", "rig_names"),
}


def __getattr__(name: str) -> Any:
    """Import an exported name when it is first used, because pydantic is slow to load."""
    for module, names in _NAMES.items():
        if name in names:
            return getattr(importlib.import_module(f"sealscope.parameters.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
