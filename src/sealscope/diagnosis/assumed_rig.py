"""The rig that detectors assume for a recording: the stated one, or one that the recording shows."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sealscope.diagnosis.inference.circuit.recognition import recognise_circuit
from sealscope.diagnosis.priors.verdict import VERDICT
from sealscope.diagnosis.verdict.machine_sizes import (
    DEFAULT,
    UNSTATED,
    AssumedMachine,
    StatedBy,
    measures_flow,
    states_rig,
)
from sealscope.parameters import Rig, load_rig, rig_names
from sealscope.parameters.circuit import OPEN_CIRCUIT
from sealscope.parameters.rig import ASSUMED
from sealscope.recordings.channels import flow_source
from sealscope.recordings.recording import Recording

#: Parameters that convert a motion to a flow.
_GEOMETRY = ("cylinder.A_A", "cylinder.A_B", "pump.q_b")
#: Rig that is assumed of a machine whose recording shows the supply of a servo valve.
_BEHIND_VALVE = "servo-valve"
#: Source of a circuit that a recording shows.
_SHOWN = f"{ASSUMED} a recording shows it"


def assumed_rig(rig: Rig | str | os.PathLike[str] | None, recording: Recording) -> tuple[Rig, AssumedMachine]:
    """Choose the rig that detectors assume for a recording, and tell who stated its areas and displacement.

    A given `rig` counts as stated by the caller if it defines a whole machine, else by nobody. Without a rig, the
    thesis's rig is used, or the one of `infer_rig`. It counts as stated by the recording if that was simulated with a
    packaged rig of the same areas and displacement; otherwise all its values are marked as assumptions. Raises
    InputError if `rig` cannot be read.
    """
    rig = infer_rig(None if rig is None else load_rig(rig), [recording])
    used_rig = load_rig(DEFAULT) if rig is None else rig
    stated_by: StatedBy = "call" if rig is not None and states_rig(rig) else "nobody"
    if rig is None and _names_rig_of_same_geometry(recording.provenance, used_rig):
        stated_by = "recording"
    elif rig is None:
        used_rig = used_rig.as_assumed(UNSTATED)
    return used_rig, AssumedMachine(
        used_rig.name,
        stated_by,
        area=0.5 * (used_rig.cylinder.A_A + used_rig.cylinder.A_B),
        displacement=used_rig.pump.q_b,
        area_stated=used_rig.states("cylinder.A_A", "cylinder.A_B"),
        displacement_stated=used_rig.states("pump.q_b"),
        flow_meter=measures_flow(recording.units),
        areas=(used_rig.cylinder.A_A, used_rig.cylinder.A_B),
        bypass="q_leak" in recording.units,
    )


def infer_rig(rig: Rig | None, recordings: Sequence[Recording]) -> Rig | None:
    """Replace a rig that nobody stated as a whole, if recordings of the machine show its circuit.

    With stated areas, the circuit of a pump is that of `recognise_circuit`; the rig notes it, so that these recordings
    decide for all later ones of a machine. The first recording with the supply's pressure may also show a servo valve
    (`_shows_valve_supply`). Stated sizes are kept.
    """
    circuit = OPEN_CIRCUIT.parameter
    if rig is not None and (states_rig(rig) or rig.entry(circuit).source == _SHOWN):
        return rig
    if rig is not None and (value := recognise_circuit(rig, recordings)) is not None:
        return rig.with_overrides({circuit: value}, source=_SHOWN)
    is_valve = (shown for recording in recordings if (shown := _shows_valve_supply(rig, recording)) is not None)
    if not next(is_valve, False):
        return rig
    valve_rig = load_rig(_BEHIND_VALVE).as_assumed(UNSTATED)
    if rig is None or not rig.states("cylinder.A_A", "cylinder.A_B"):
        return valve_rig
    return valve_rig.with_areas(rig.cylinder.A_A, rig.cylinder.A_B, source=rig.entry("cylinder.A_A").source)


def _shows_valve_supply(rig: Rig | None, recording: Recording) -> bool | None:
    """Return True if a recording shows the supply of a servo valve; None if it cannot tell.

    That is so if no flow and no pump is recorded, only the command, and if p_1 exceeds both chamber pressures by
    `supply.margin` (`priors.toml`) in more than the fraction `supply.above` of the samples that have all three: at the
    port of a pump, p_1 is about the pressure of one chamber. A recording cannot tell without these pressures in Pa: raw
    counts cannot be compared. A displacement that `rig` states is that of a pump that feeds the chambers: the result is
    then False.
    """
    states_pump = rig is not None and rig.states("pump.q_b")
    if states_pump or flow_source(recording.channels) != "u":
        return False
    if any(recording.units.get(name) != "Pa" for name in ("p_1", "p_A", "p_B")):
        return None
    excess = recording["p_1"] - np.maximum(recording["p_A"], recording["p_B"])
    excess = excess[np.isfinite(excess)]
    return bool(np.mean(excess > VERDICT.supply.margin) > VERDICT.supply.above) if excess.size else None


def _names_rig_of_same_geometry(provenance: Mapping[str, Any], rig: Rig) -> bool:
    """Return True if a recording was simulated with a packaged rig of the areas and displacement of `rig`.

    `provenance` is that of the recording. The result is False if the simulation replaced an area or the displacement.
    """
    experiment = provenance.get("experiment")
    if not isinstance(experiment, Mapping):
        return False
    name, overrides = experiment.get("rig"), experiment.get("overrides")
    if name not in rig_names() or not isinstance(overrides, Mapping) or set(_GEOMETRY) & set(overrides):
        return False
    stated_rig = load_rig(name)
    return all(stated_rig[parameter] == rig[parameter] for parameter in _GEOMETRY)
