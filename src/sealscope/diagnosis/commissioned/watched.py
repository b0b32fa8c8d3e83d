"""A machine's file as the monitor takes it: the rig that sizes flows, and how its logs are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sealscope.diagnosis.commissioned.machine import CommissionedMachine
from sealscope.diagnosis.commissioned.machine_file import read_machine
from sealscope.diagnosis.inference.blocks import Columns, solve
from sealscope.diagnosis.inference.terms import equations
from sealscope.diagnosis.learnt import Learnt
from sealscope.diagnosis.live.estimates import HealthyLevel
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.machine import unstated
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.formats.columns import ChannelMap
from sealscope.storage.toml_file import read_toml
from sealscope.units import LITRE_PER_MINUTE

#: Method whose lessons hold the size of the flows.
_BALANCE = "volume balance"
#: Fewest healthy recordings whose leakage is compared with.
_FEWEST = 2
_AREAS, _DISPLACEMENT = ("cylinder.A_A", "cylinder.A_B"), "pump.q_b"


@dataclass(frozen=True)
class WatchedMachine:
    """An actuator to be watched, from a rig's or a machine's file.

    Parameters
    ----------
    rig : Rig
        Sizes the flows. Where areas alone are stated, the displacement is the one that the healthy recordings measured.
    channel_map : mapping of str to str, or "auto"
        Channel to column of its logs.
    rate : float, optional
        Sampling rate [Hz] of logs without a time column.
    limit_lpm : float, optional
        Leak from which it is to be repaired [L/min], None where it needs an area that is not stated.
    machine : CommissionedMachine, optional
        The machine whose healthy recordings judge whole recordings; None where there are none.
    healthy : HealthyLevel, optional
        What pump and piston pass together in them; None where they do not tell.
    """

    rig: Rig
    channel_map: ChannelMap = field(default_factory=dict)
    rate: float | None = None
    limit_lpm: float | None = None
    machine: CommissionedMachine | None = None
    healthy: HealthyLevel | None = None


def load_watched(rig: str) -> WatchedMachine:
    """Load a packaged rig, a rig's file or a machine's file for the monitor; InputError as `load_rig`."""
    if not rig.endswith(".toml") or "machine" not in read_toml(Path(rig), "a rig file", rig):
        known = load_rig(rig)
        return WatchedMachine(known, known.channel_map)
    machine = read_machine(rig)
    known = _with_measured_displacement(machine.rig or unstated(), machine.healthy)
    limit_lpm, commissioned = _limit_lpm(machine.limit, known), machine if machine.healthy else None
    level = _healthy_level(machine.healthy, machine.rig or unstated())
    return WatchedMachine(known, machine.channel_map, machine.rate, limit_lpm, commissioned, level)


def is_remeasured(rig: Rig, before: Rig) -> bool:
    """Test whether two rigs differ only in the displacement, measured anew from more healthy recordings."""
    values, values_before = rig.model_dump(), before.model_dump()
    for tree in (values, values_before):
        tree.get("pump", {}).pop("q_b", None)
    return values == values_before and bool(np.isclose(rig.pump.q_b, before.pump.q_b, rtol=0.05))


def _with_measured_displacement(rig: Rig, healthy: tuple[Learnt, ...]) -> Rig:
    """Add the displacement measured by the healthy recordings to a rig of stated areas."""
    if rig.states(_DISPLACEMENT) or not rig.states(*_AREAS):
        return rig
    lessons = (recording.lessons.get(_BALANCE) for recording in healthy)
    scales = [float(lesson["scale"]) for lesson in lessons if isinstance(lesson, Mapping) and "scale" in lesson]
    measured = [scale for scale in scales if np.isfinite(scale) and scale > 0.0]
    if not measured:
        return rig
    source = f"measured by {len(measured)} healthy recordings beside the stated areas"
    return rig.with_overrides({_DISPLACEMENT: float(np.median(measured)) * rig.pump.q_b}, source=source)


def _healthy_level(healthy: tuple[Learnt, ...], rig: Rig) -> HealthyLevel | None:
    """Estimate the leakage conductance of pump and piston together in healthy recordings, by the sums of their balance.

    None where fewer than two of them have one: how it scatters is not known then; and behind a valve, each edge of
    which is a balance.
    """
    levels = []
    for recording in healthy:
        lesson, equation = recording.lessons.get(_BALANCE), equations(rig, frozenset(recording.units))
        if not isinstance(lesson, Mapping) or not lesson.keys() >= {"sums", "scale"} or len(equation) != 1:
            continue
        columns, sums = Columns(equation[0]), np.asarray(lesson["sums"], dtype=float)[0]
        if sums.shape != 2 * (columns.left + 1,):
            continue
        nuisances = [k for k in columns.nuisance if k != columns.leak and columns.names[k] != "pump leak"]
        chosen = [*nuisances, columns.leak]
        value = float(solve(sums[np.ix_(chosen, chosen)], sums[chosen, columns.left])[-1] * float(lesson["scale"]))
        if np.isfinite(value):
            levels.append(value)
    if len(levels) < _FEWEST:
        return None
    # what the warmest of them shows is healthy: the oil then may have been the warmest
    low = max(min(levels), max(levels) / priors("inference")["oil"]["warmest"])
    known_s = max((recording.start_s for recording in healthy if recording.start_s is not None), default=0.0)
    return HealthyLevel(float(np.mean(levels)), low, max(levels), float(np.std(levels, ddof=1)), known_s)


def _limit_lpm(text: str | None, rig: Rig) -> float | None:
    """Return the repair limit of a machine [L/min], the default one where none is stated; None without its area."""
    limit = RepairLimit.of(text)
    if limit.kind == "flow":
        return limit.value / LITRE_PER_MINUTE
    area = 0.5 * (rig.cylinder.A_A + rig.cylinder.A_B)
    return limit.value * area / LITRE_PER_MINUTE if rig.states(*_AREAS) else None
