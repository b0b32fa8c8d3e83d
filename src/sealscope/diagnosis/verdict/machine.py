"""The machine assumed by a diagnosis: the sizes behind every L/min, stated or merely assumed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from sealscope.parameters import Rig, load_rig, rig_names
from sealscope.parameters.rig import ASSUMED
from sealscope.recordings.channels import flow_source
from sealscope.recordings.recording import Recording

#: Who stated the rig: the caller, the recording's own provenance, or nobody.
StatedBy = Literal["call", "recording", "nobody"]
#: What turns a motion into a flow; the rig that is assumed where none is stated, and why.
_GEOMETRY = ("cylinder.A_A", "cylinder.A_B", "pump.q_b")
_DEFAULT, _REASON = "thesis", "no rig was stated"


@dataclass(frozen=True)
class AssumedMachine:
    """Assumptions of a diagnosis about the machine.

    `rig`: its name; `stated_by` the call (`--rig` or a Rig), the provenance of a recording of our own, or nobody;
    `area` of the piston, the mean of both sides [m^2], and `displacement` of the pump [m^3/rev]; `area_stated`,
    `displacement_stated`: whether they are stated, by the rig or on their own; `flow_meter`: whether flows are a
    meter's, `q_pump`, and rest on neither; `areas` of sides A and B [m^2]; `bypass`: whether a flow meter in a bypass
    of the cylinder was recorded.
    """

    rig: str
    stated_by: StatedBy
    area: float
    displacement: float
    area_stated: bool
    displacement_stated: bool
    flow_meter: bool = False
    areas: tuple[float, float] | None = None
    bypass: bool = False

    @property
    def stated(self) -> bool:
        """True if area and displacement are both stated."""
        return self.area_stated and self.displacement_stated

    def as_dict(self) -> dict[str, Any]:
        """Return the machine as plain JSON values."""
        return {
            "name": self.rig,
            "stated_by": self.stated_by,
            "area_m2": self.area,
            "areas_m2": self.areas,
            "area_stated": self.area_stated,
            "displacement_m3_per_rev": self.displacement,
            "displacement_stated": self.displacement_stated,
            "flow_meter": self.flow_meter,
        }


def assumed_rig(rig: Rig | str | os.PathLike[str] | None, recording: Recording) -> tuple[Rig, AssumedMachine]:
    """Return the rig assumed by detectors, and its statements about the machine.

    Without a `rig` it is that of the thesis: stated where the recording's own provenance says that it was made with the
    same area and displacement, else each of its values is a mere assumption (`Rig.states`).
    """
    used_rig = load_rig(_DEFAULT if rig is None else rig)
    stated_by: StatedBy = "call"
    if rig is None:
        stated_by = "recording" if _is_simulated_with(recording.provenance, used_rig) else "nobody"
        used_rig = used_rig if stated_by == "recording" else unstated()
    elif not states_rig(used_rig):
        stated_by = "nobody"
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


def states_rig(rig: Rig) -> bool:
    """Test whether a rig is somebody's, not the default one with only area or displacement stated."""
    return rig.entry("cylinder.M_eq").source != f"{ASSUMED} {_REASON}"


def measures_flow(units: Mapping[str, str]) -> bool:
    """Test whether a meter reads the flow to the cylinder in its unit, and no angle or speed of a pump is read."""
    return flow_source(units) == "q_pump" and units["q_pump"] == "m^3/s"


def healthy_leakage(rig: Rig) -> float:
    """Return the largest leakage of a healthy pump, `pump.G_healthy` [m^3/(s Pa)]; 0 if stated for another pump.

    What a file assumes of its own pump counts; not what is left of another rig's where only the displacement is stated.
    """
    healthy, pump = rig.entry("pump.G_healthy"), rig.entry("pump.q_b")
    assumed_of_it = states_rig(rig) and rig.states("pump.q_b") and healthy.place == pump.place
    is_known = rig.states("pump.G_healthy") or assumed_of_it
    return rig.pump.G_healthy if is_known else 0.0


def unstated() -> Rig:
    """Return the default rig, with each value marked as an assumption."""
    return load_rig(_DEFAULT).as_assumed(_REASON)


def _is_simulated_with(provenance: Mapping[str, Any], rig: Rig) -> bool:
    """Test whether the rig of a simulated recording has the area and displacement of this one."""
    experiment = provenance.get("experiment")
    if provenance.get("origin") != "simulation" or not isinstance(experiment, Mapping):
        return False
    name, overrides = experiment.get("rig"), experiment.get("overrides")
    if name not in rig_names() or not isinstance(overrides, Mapping) or set(_GEOMETRY) & set(overrides):
        return False
    stated_rig = load_rig(name)
    return all(stated_rig[parameter] == rig[parameter] for parameter in _GEOMETRY)
