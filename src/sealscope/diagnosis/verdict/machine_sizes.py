"""The machine that a diagnosis assumes: the sizes behind every flow in L/min, and whether somebody stated them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sealscope.errors import InputError
from sealscope.parameters import Rig, load_rig
from sealscope.parameters.rig import ASSUMED
from sealscope.recordings.channels import METERS, flow_source
from sealscope.units import parse_quantity

#: Who stated the rig: the caller, the recording's provenance, or nobody.
StatedBy = Literal["call", "recording", "nobody"]
#: Name of the rig that is assumed if no rig is stated, and the reason that is noted with its values.
DEFAULT, UNSTATED = "thesis", "no rig was stated"


@dataclass(frozen=True)
class AssumedMachine:
    """Sizes of the machine that a diagnosis assumes.

    Attributes
    ----------
    rig : str
        Name of the rig.
    stated_by : {"call", "recording", "nobody"}
        Source of the rig: the caller (`--rig` or a Rig), the recording's provenance, or a mere assumption.
    area, displacement : float
        Mean piston area of both sides [m^2], and displacement of the pump [m^3/rev].
    area_stated, displacement_stated : bool
        Whether the size is known from the rig, or was stated separately.
    flow_meter : bool
        Whether a flow meter, channel `q_pump` or `q_supply`, measures the flow, so that neither size is needed.
    areas : tuple of float, optional
        Piston areas of sides A and B [m^2].
    bypass : bool
        Whether a flow meter in a bypass of the cylinder was recorded.
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
    def has_stated_sizes(self) -> bool:
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


def states_rig(rig: Rig) -> bool:
    """Return True if a whole rig was stated; False if one is assumed, even with stated areas or displacement."""
    # a user may state areas or displacement alone, but never the mass: if it is not assumed, a whole rig was stated
    return rig.entry("cylinder.M_eq").source != f"{ASSUMED} {UNSTATED}"


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
    return load_rig(DEFAULT).as_assumed(UNSTATED)


def build_stated_rig(
    rig: str | os.PathLike[str] | None = None, areas: Sequence[str] | None = None, displacement: str | None = None
) -> Rig | None:
    """Build the rig that a person states: a rig's name or file, sizes as texts, or both; None if nothing is stated.

    `areas`: area of the piston such as "633 mm^2", or those of sides A and B; `displacement`: that of the pump, such as
    "4.9 cm^3/rev". Raises InputError for an invalid text, which it calls by the option of the command line.
    """
    stated_rig = None if rig is None else load_rig(rig)
    source = "set by the call (--area, --displacement)"
    if areas:
        if len(areas) > 2:
            raise InputError(f"--area must be given once, or twice for sides A and B, got {len(areas)} times")
        values = [parse_quantity(text, "m^2", name="--area") for text in areas]  # one, or those of the sides A and B
        stated_rig = (stated_rig or unstated_rig()).with_areas(values[0], values[-1], source=source)
    if displacement is not None:
        overrides = {"pump.q_b": parse_quantity(displacement, "m^3/rev", name="--displacement")}
        stated_rig = (stated_rig or unstated_rig()).with_overrides(overrides, source=source)
    return stated_rig
