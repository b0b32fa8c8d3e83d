"""Readings: what a single recording states of the leakage."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from sealscope.diagnosis.beliefs import beliefs
from sealscope.diagnosis.detector import unusable
from sealscope.diagnosis.inference.detector import VolumeBalance
from sealscope.diagnosis.inference.pressures.detector import PressureResponse
from sealscope.diagnosis.inspection import inspected
from sealscope.diagnosis.rms_change.blocks import JUDGED, QUANTITIES, whole
from sealscope.diagnosis.trend.wear import DayToDay
from sealscope.diagnosis.verdict.machine import AssumedMachine, assumed_rig
from sealscope.parameters import Rig
from sealscope.recordings.chambers import CHAMBERS, chambers_of
from sealscope.recordings.joining import start_seconds
from sealscope.recordings.oil import oil_temperature
from sealscope.recordings.recording import Recording

#: What a level rests on, the most specific first: a conductance, but for `ringing`, the damping of the pressures'
#: details.
Basis = Literal["volume balance", "pressure response", "ringing"]
BASES: tuple[Basis, ...] = ("volume balance", "pressure response", "ringing")


@dataclass(frozen=True, eq=False, kw_only=True)
class LeakReading:
    """What a recording states of the leakage.

    `start`: of its first sample [s since 1970], None where not known, and `duration` [s]; `basis`, None where nothing
    can be stated, and `problem`: why; `level`: conductance of pump and piston together [m^3/(s Pa)], or a relative
    index, with its standard `error`; `states_flow`: whether L/min can be stated of it, and `area` [m^2] of the piston
    by which a speed of creep is a flow in the level's unit, None where it is in none; `pressure`: mean |p_A - p_B|;
    `temperature` of the oil [deg C], None where the file does not say; `scale`: displacement over area, over the
    assumed one; `machine`: what was assumed; `digest`: equal for copies.
    """

    file: str
    start: float | None
    duration: float
    basis: Basis | None = None
    level: float = np.nan
    error: float = np.nan
    states_flow: bool = False
    area: float | None = None
    pressure: float
    temperature: float | None
    scale: float | None = None
    machine: AssumedMachine | None
    digest: str
    problem: str = ""


def reading_of(recording: Recording, rig: Rig | str | os.PathLike[str] | None = None, file: str = "") -> LeakReading:
    """Return what a recording states of the leakage.

    `rig`: what may be assumed of the machine; None: as for `diagnose`, L/min only where the machine is known.
    """
    known, machine = assumed_rig(rig, recording)
    inspection = inspected(recording)
    part = inspection.part
    both = len(chambers_of(part)) == len(CHAMBERS) and len(part) > 0
    reading = LeakReading(
        file=file or str(recording.provenance.get("file", "recording")),
        start=start_seconds(recording, file),
        duration=recording.duration,
        pressure=float(np.mean(np.abs(part["p_A"] - part["p_B"]))) if both else float("nan"),
        temperature=oil_temperature(recording),
        machine=machine,
        digest=inspection.digest,
        problem=inspection.defect or "",
    )
    if reading.problem:
        return reading
    with np.errstate(all="ignore"):
        return replace(reading, **_stated(part, known, machine))


def _stated(part: Recording, rig: Rig, machine: AssumedMachine) -> dict[str, Any]:
    """Return the most specific level that a recording without a defect allows, or the problem."""
    balance, response = VolumeBalance(rig), PressureResponse(rig)
    lack, lacks = unusable(balance, part), unusable(response, part)
    own = balance.balance(part) if lack is None else None
    if own is not None and len(own.columns) == 1:
        size, total = own.size, own.level
        area = machine.area if size.stated or ("x", "m") in own.units else None
        return {
            "basis": BASES[0],
            "level": total.value * size.scale,
            "error": (total.high - total.low) * size.scale / 3.92,
            "states_flow": size.stated,
            "area": area,
            "scale": None if size.ratio is None else size.ratio.value,
        }
    if lacks is None and (reading := response.reading(part)) is not None:
        area = machine.area if reading.stated else None
        level, error = reading.level
        return {"basis": BASES[1], "level": level, "error": error, "states_flow": reading.stated, "area": area}
    log_rms = whole(part)[0].reshape(-1, len(QUANTITIES))
    ringing = float(-np.mean(log_rms[:, [QUANTITIES.index(name) for name in JUDGED]]))
    if np.isfinite(ringing):
        return {"basis": BASES[2], "level": ringing, "error": beliefs("trend")["own"]["ringing"]}
    why = dict.fromkeys(reason for reason in (lack, lacks) if reason) or ["the pressures do not ring"]
    return {"problem": "no detector states a level: " + "; ".join(why)}


def scatter_of(basis: Basis, usual: float) -> DayToDay:
    """Return the prior on the scatter of a level between recordings, for a machine of that usual level."""
    believed = beliefs("trend")["between"]
    if basis == "volume balance":
        scale = max(believed[basis] * abs(usual), float(np.finfo(float).tiny))
    else:
        own = {"pressure response": beliefs("inference.pressures")["conductance"]["level"]}
        scale = own.get(basis, believed["ringing"])
    return DayToDay(scale, believed["freedom"])
