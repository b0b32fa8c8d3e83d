"""Every detector by name: the built-in ones and those that installed distributions bring."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sealscope.diagnosis.detector import Detector, Factory

if TYPE_CHECKING:
    from sealscope.parameters import Rig


def _rms_change(rig: Rig) -> Detector:
    from sealscope.diagnosis.rms_change.detector import RmsChange

    return RmsChange()


def _volume_balance(rig: Rig) -> Detector:
    from sealscope.diagnosis.volume_balance.detector import VolumeBalance

    return VolumeBalance(rig)


def _pressure_model(rig: Rig) -> Detector:
    from sealscope.diagnosis.pressure_model.detector import PressureModel

    return PressureModel(rig)


def _observer(rig: Rig) -> Detector:
    from sealscope.diagnosis.observer.detector import Observer

    return Observer(rig)


#: The built-in detectors by name; `diagnose` runs those that the channels allow, and one contract test runs them all.
DETECTORS: dict[str, Factory] = {
    "volume balance": _volume_balance,
    "pressure model": _pressure_model,
    "observer": _observer,
    "rms change": _rms_change,
}


def detectors() -> Mapping[str, Factory]:
    """Every detector by name: the built-in ones, then those that installed distributions bring (`plugins`)."""
    from sealscope.diagnosis.plugins import plug_ins

    return {**DETECTORS, **{one.name: one for one in plug_ins(frozenset(DETECTORS))}}
