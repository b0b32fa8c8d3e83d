"""Controllers of a rig's piston position; their parameters are assumptions and may differ from the rig's values."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sealscope.control.controller import CompiledLaw as CompiledLaw
    from sealscope.control.controller import Controller as Controller
    from sealscope.control.controller import Measured as Measured
    from sealscope.control.controller import Started as Started
    from sealscope.control.drive import Drive as Drive
    from sealscope.control.drive import ValveDrive as ValveDrive
    from sealscope.control.drive import drive_of as drive_of
    from sealscope.control.fault_tolerant import FaultTolerant as FaultTolerant
    from sealscope.control.flatness import Flatness as Flatness
    from sealscope.control.leak_observer import Balance as Balance
    from sealscope.control.loop_margins import Margins as Margins
    from sealscope.control.loop_margins import margins as margins
    from sealscope.control.position import PositionPI as PositionPI
    from sealscope.control.registry import CONTROLLERS as CONTROLLERS
    from sealscope.control.registry import controller_named as controller_named

_NAMES = {
    "controller": ("CompiledLaw", "Controller", "Measured", "Started"),
    "drive": ("Drive", "ValveDrive", "drive_of"),
    "fault_tolerant": ("FaultTolerant",),
    "flatness": ("Flatness",),
    "leak_observer": ("Balance",),
    "loop_margins": ("Margins", "margins"),
    "position": ("PositionPI",),
    "registry": ("CONTROLLERS", "controller_named"),
}


def __getattr__(name: str) -> Any:
    """Import an exported name when it is first used: a diagnosis needs the model of the drive alone."""
    for module, names in _NAMES.items():
        if name in names:
            return getattr(importlib.import_module(f"sealscope.control.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
