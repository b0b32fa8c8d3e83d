"""Registry of detectors by name: the built-in ones and those of installed distributions."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING

from sealscope.diagnosis.detector import Detector, Factory
from sealscope.diagnosis.plugins import plug_ins

if TYPE_CHECKING:
    from sealscope.parameters import Rig


def _built_in(module: str, name: str) -> Factory:
    def make(rig: Rig) -> Detector:
        detector: Detector = getattr(import_module(f"sealscope.diagnosis.{module}"), name)(rig)
        return detector

    return make


#: The built-in detectors by name, loaded when first made; one contract test runs them all.
DETECTORS: dict[str, Factory] = {
    "volume balance": _built_in("inference.detector", "VolumeBalance"),
    "pressure response": _built_in("inference.pressures.detector", "PressureResponse"),
    "rms change": _built_in("rms_change.detector", "RmsChange"),
}


def detectors() -> Mapping[str, Factory]:
    """Return every detector by name: the built-in ones, then those of installed distributions (`plugins`)."""
    return {**DETECTORS, **{plug_in.name: plug_in for plug_in in plug_ins(frozenset(DETECTORS))}}
