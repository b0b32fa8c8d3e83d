"""Typed, immutable parameters of a rig, each value with unit and source."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sealscope.parameters.actuator import Cylinder, Friction
    from sealscope.parameters.drive import Fluid, Line, MakeUp, Motor, Pump
    from sealscope.parameters.instruments import Daq, PressureTransducer, Sensors
    from sealscope.parameters.load import load_rig, rig_names
    from sealscope.parameters.names import parse_override, parse_overrides
    from sealscope.parameters.rig import Entry, Rig, Row, declared_names

_HOMES = {
    "Cylinder": "actuator",
    "Daq": "instruments",
    "Entry": "rig",
    "Fluid": "drive",
    "Friction": "actuator",
    "Line": "drive",
    "MakeUp": "drive",
    "Motor": "drive",
    "PressureTransducer": "instruments",
    "Pump": "drive",
    "Rig": "rig",
    "Row": "rig",
    "Sensors": "instruments",
    "declared_names": "rig",
    "load_rig": "load",
    "parse_override": "names",
    "parse_overrides": "names",
    "rig_names": "load",
}

__all__ = [
    "Cylinder",
    "Daq",
    "Entry",
    "Fluid",
    "Friction",
    "Line",
    "MakeUp",
    "Motor",
    "PressureTransducer",
    "Pump",
    "Rig",
    "Row",
    "Sensors",
    "declared_names",
    "load_rig",
    "parse_override",
    "parse_overrides",
    "rig_names",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:  # pydantic loads with the first name used
        return getattr(importlib.import_module(f"sealscope.parameters.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
