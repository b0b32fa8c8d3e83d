"""Reading: what a single recording states of the leakage, by the best detector that its channels allow."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from sealscope.diagnosis.detector import unusable
from sealscope.diagnosis.inference.detector import VolumeBalance
from sealscope.diagnosis.inference.pressures.detector import PressureResponse
from sealscope.diagnosis.inference.pressures.evidence import priors
from sealscope.diagnosis.inspection import inspected
from sealscope.diagnosis.rms_change.blocks import JUDGED, QUANTITIES, whole_log_rms
from sealscope.diagnosis.trend.wear import DayToDay, Level
from sealscope.diagnosis.verdict.machine import AssumedMachine, assumed_rig
from sealscope.parameters import Rig
from sealscope.recordings.chambers import CHAMBERS, chambers_of
from sealscope.recordings.formats.headings.preamble import stated_oil_temperature
from sealscope.recordings.joining import start_seconds
from sealscope.recordings.recording import Recording

#: What a level rests on, the most specific first: a conductance, but for `ringing`, the damping of the pressures'
#: details.
Basis = Literal["volume balance", "pressure response", "ringing"]
BASES: tuple[Basis, ...] = ("volume balance", "pressure response", "ringing")
#: Between recordings a level moves by this share of itself, or by this much; both known as from five recordings. Those
#: of the conductances are what `diagnose` assumes; that of the ringing is `rms change`'s between sessions.
_SHARE, _RINGING, _FREEDOM = 0.1, 0.11, 4.0
#: Error of a ringing's logarithm that a recording states of itself.
_RINGING_ERROR = 0.01


@dataclass(frozen=True, eq=False)
class LeakReading:
    """What a recording states of the leakage.

    `start`: of its first sample [s since 1970], None where not known, and `duration` [s]; `basis`, None where nothing
    can be stated, and `problem`: why; `level`: conductance of pump and piston together [m^3/(s Pa)], or a relative
    index; `states_flow`: whether L/min can be stated of it, and `area` [m^2] of the piston by which a speed of creep is
    a flow in the level's unit, None where it is in none; `pressure`: mean |p_A - p_B|; `temperature` of the oil
    [deg C], None where the file does not say; `scale`: displacement over area, over the assumed one; `machine`: what
    was assumed; `digest`: equal for copies.
    """

    file: str
    start: float | None
    duration: float
    basis: Basis | None
    level: Level
    states_flow: bool
    area: float | None
    pressure: float
    temperature: float | None
    scale: float | None
    machine: AssumedMachine | None
    digest: str
    problem: str = ""


class _Stated(NamedTuple):
    """What a detector states: a level on a basis, and which of its figures have a unit."""

    basis: Basis | None = None
    level: Level = Level(np.nan, np.nan)
    states_flow: bool = False
    in_metres: bool = False
    scale: float | None = None


def reading_of(recording: Recording, rig: Rig | str | os.PathLike[str] | None = None, file: str = "") -> LeakReading:
    """Return what a recording states of the leakage.

    `rig`: what may be assumed of the machine; None: as for `diagnose`, L/min only where the machine is known.
    """
    known, machine = assumed_rig(rig, recording)
    inspection = inspected(recording)
    part, problem, stated = inspection.part, inspection.defect or "", _Stated()
    if not problem:
        with np.errstate(all="ignore"):
            stated = _stated(part, known)
        if stated.basis is None:
            reasons = (unusable(detector(known), part) for detector in (VolumeBalance, PressureResponse))
            why = dict.fromkeys(reason for reason in reasons if reason) or ["the pressures do not ring"]
            problem = "no detector states a level: " + "; ".join(why)
    both = len(chambers_of(part)) == len(CHAMBERS) and len(part) > 0
    return LeakReading(
        file=file or str(recording.provenance.get("file", "recording")),
        start=start_seconds(recording, file),
        duration=recording.duration,
        basis=stated.basis,
        level=stated.level,
        states_flow=stated.states_flow,
        area=machine.area if stated.states_flow or stated.in_metres else None,
        pressure=float(np.mean(np.abs(part["p_A"] - part["p_B"]))) if both else float("nan"),
        temperature=oil_temperature(recording),
        scale=stated.scale,
        machine=machine,
        digest=inspection.digest,
        problem=problem,
    )


def _stated(part: Recording, rig: Rig) -> _Stated:
    """Return the most specific level that a recording without a defect allows."""
    balance, response = VolumeBalance(rig), PressureResponse(rig)
    if unusable(balance, part) is None:
        own = balance.balance(part)
        if own is not None and len(own.columns) == 1:
            size, total = own.size, own.level
            level = Level(total.value * size.scale, (total.high - total.low) * size.scale / 3.92)
            ratio = None if size.ratio is None else size.ratio.value
            return _Stated("volume balance", level, size.stated, ("x", "m") in own.units, ratio)
    if unusable(response, part) is None and (reading := response.reading(part)) is not None:
        return _Stated("pressure response", Level(*reading.level), reading.stated)
    log_rms = whole_log_rms(part).reshape(-1, len(QUANTITIES))
    ringing = float(-np.mean(log_rms[:, [QUANTITIES.index(name) for name in JUDGED]]))
    return _Stated("ringing", Level(ringing, _RINGING_ERROR)) if np.isfinite(ringing) else _Stated()


def oil_temperature(recording: Recording) -> float | None:
    """Return the oil's mean temperature [deg C], else what the file says beside its samples; None where neither is."""
    if "T_oil" in recording and np.any(known := np.isfinite(recording["T_oil"])):
        return float(recording["T_oil"][known].mean()) - 273.15
    return stated_oil_temperature(recording.provenance)


def scatter_of(basis: Basis, usual: float) -> DayToDay:
    """Return the prior on the scatter of a level between recordings, for a machine of that usual level."""
    if basis == "volume balance":
        return DayToDay(max(_SHARE * abs(usual), float(np.finfo(float).tiny)), _FREEDOM)
    return DayToDay(priors("response")["G_level"].width if basis == "pressure response" else _RINGING, _FREEDOM)
