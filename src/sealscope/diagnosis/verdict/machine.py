"""The machine that a diagnosis assumes: the sizes behind every flow in L/min, and whether somebody stated them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sealscope.diagnosis.priors.verdict import VERDICT
from sealscope.parameters import Rig, load_rig, rig_names
from sealscope.parameters.rig import ASSUMED
from sealscope.recordings.channels import METERS, flow_source
from sealscope.recordings.recording import Recording

#: Who stated the rig: the caller, the recording's provenance, or nobody.
StatedBy = Literal["call", "recording", "nobody"]
#: Parameters that convert a motion to a flow.
_GEOMETRY = ("cylinder.A_A", "cylinder.A_B", "pump.q_b")
#: Name of the rig that is assumed if no rig is stated, and the reason that is noted with its values.
_DEFAULT, _REASON = "thesis", "no rig was stated"
#: The same of a machine whose recording shows the supply of a servo valve.
_BEHIND_VALVE = "servo-valve"


@dataclass(frozen=True)
class AssumedMachine:
    """Sizes of the machine that a diagnosis assumes.

    - `rig`: name of the rig; `stated_by`: who stated it, the caller (`--rig` or a Rig), the recording's provenance, or
      nobody.
    - `area`: mean of the piston areas [m^2] of sides A and B, `areas`; `displacement`: that of the pump [m^3/rev].
    - `area_stated`, `displacement_stated`: true if the size is known from the rig, or was stated separately.
    - `flow_meter`: true if a flow meter, channel `q_pump` or `q_supply`, measures the flow, so that neither size is
      needed.
    - `bypass`: true if a flow meter in a bypass of the cylinder was recorded.
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
        """True if area and displacement are both stated, and not merely assumed."""
        return self.area_stated and self.displacement_stated

    def as_dict(self) -> dict[str, Any]:
        """Return the assumed areas and displacement of the machine, and who stated them, as plain values for JSON."""
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
    """Choose the rig that detectors assume for a recording, and tell who stated its areas and displacement.

    A given `rig` counts as stated by the caller if it defines a whole machine, else by nobody. Without a rig, the
    thesis's rig is used, or the one of `infer_rig`. It counts as stated by the recording if that was simulated with a
    packaged rig of the same areas and displacement; otherwise all its values are marked as assumptions. Raises
    InputError if `rig` cannot be read.
    """
    rig = infer_rig(None if rig is None else load_rig(rig), recording)
    used_rig = load_rig(_DEFAULT) if rig is None else rig
    stated_by: StatedBy = "call" if rig is not None and states_rig(rig) else "nobody"
    if rig is None and _names_rig_of_same_geometry(recording.provenance, used_rig):
        stated_by = "recording"
    elif rig is None:
        used_rig = used_rig.as_assumed(_REASON)
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


def infer_rig(rig: Rig | None, recording: Recording) -> Rig | None:
    """Replace a rig that nobody stated by one behind a servo valve, if the recording shows the valve's supply.

    That is so if no flow and no pump is recorded, only the command, and if p_1 exceeds both chamber pressures by
    `supply.margin` (`priors.toml`) in the fraction `supply.above` of the samples: at the port of a pump, p_1 is about
    the pressure of one chamber. Pressures in raw counts cannot be compared, and a stated displacement is that of a pump
    that feeds the chambers. Stated areas are kept.
    """
    is_stated = rig is not None and (states_rig(rig) or rig.states("pump.q_b"))
    if is_stated or flow_source(recording.channels) != "u":
        return rig
    if any(recording.units.get(name) != "Pa" for name in ("p_1", "p_A", "p_B")):
        return rig
    excess = recording["p_1"] - np.maximum(recording["p_A"], recording["p_B"])
    excess = excess[np.isfinite(excess)]
    if not excess.size or not np.mean(excess > VERDICT.supply.margin) > VERDICT.supply.above:
        return rig
    valve_rig = load_rig(_BEHIND_VALVE).as_assumed(_REASON)
    if rig is None or not rig.states("cylinder.A_A", "cylinder.A_B"):
        return valve_rig
    return valve_rig.with_areas(rig.cylinder.A_A, rig.cylinder.A_B, source=rig.entry("cylinder.A_A").source)


def states_rig(rig: Rig) -> bool:
    """Return True if a whole rig was stated; False if one is assumed, even with stated areas or displacement."""
    # a user may state areas or displacement alone, but never the mass: if it is not assumed, a whole rig was stated
    return rig.entry("cylinder.M_eq").source != f"{ASSUMED} {_REASON}"


def measures_flow(units: Mapping[str, str]) -> bool:
    """Return True if the best source for the flow to the cylinder is a flow meter (`METERS`) in m^3/s.

    The result is False if the pump's angle or speed is recorded, too. `units` has the unit of each recorded channel.
    """
    source = flow_source(units)
    return source in METERS and units[source] == "m^3/s"


def healthy_leakage(rig: Rig) -> float:
    """Return the largest leakage conductance of a healthy pump [m^3/(s Pa)] that the rig gives (`pump.G_healthy`).

    A value marked as an assumption is used only if a whole rig was stated, and if the same file states the
    displacement. Otherwise the value may belong to another pump, such as that of the default rig, and the result is 0.
    """
    is_from_same_file = rig.entry("pump.G_healthy").place == rig.entry("pump.q_b").place
    is_of_this_pump = states_rig(rig) and rig.states("pump.q_b") and is_from_same_file
    return rig.pump.G_healthy if rig.states("pump.G_healthy") or is_of_this_pump else 0.0


def unstated_rig() -> Rig:
    """Return the default rig, with every value marked as an assumption."""
    return load_rig(_DEFAULT).as_assumed(_REASON)


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
