"""The machine that a diagnosis assumes: what every L/min rests on, and whether it was stated or merely assumed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from sealscope.parameters.rig import ASSUMED
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Who stated the rig: the caller, the recording's own provenance, or nobody.
StatedBy = Literal["call", "recording", "nobody"]
#: What turns a motion into a flow.
GEOMETRY = ("cylinder.A_A", "cylinder.A_B", "pump.q_b")
#: The rig that is assumed where none is stated, and why.
DEFAULT = "thesis"
_REASON = "no rig was stated"


@dataclass(frozen=True)
class AssumedMachine:
    """What a diagnosis assumes of the machine.

    Parameters
    ----------
    rig : str
        Name of the rig.
    stated_by : {"call", "recording", "nobody"}
        Who stated it: `--rig` or a Rig, the provenance of a recording of our own, or nobody.
    area : float
        Area of the piston, the mean of both sides [m^2].
    displacement : float
        Displacement of the pump [m^3/rev].
    area_stated, displacement_stated : bool
        Whether they are stated, by the rig or on their own.
    """

    rig: str
    stated_by: StatedBy
    area: float
    displacement: float
    area_stated: bool
    displacement_stated: bool

    @property
    def stated(self) -> bool:
        """Whether area and displacement are both stated."""
        return self.area_stated and self.displacement_stated

    def as_dict(self) -> dict[str, Any]:
        """Return the machine as plain JSON values."""
        return {
            "name": self.rig,
            "stated_by": self.stated_by,
            "area_m2": self.area,
            "area_stated": self.area_stated,
            "displacement_m3_per_rev": self.displacement,
            "displacement_stated": self.displacement_stated,
        }


def assumed_rig(rig: Rig | str | os.PathLike[str] | None, recording: Recording) -> tuple[Rig, AssumedMachine]:
    """Return the rig that detectors assume, and what it states of the machine.

    Without a `rig` it is that of the thesis: stated where the recording's own provenance says that it was made with the
    same area and displacement, else each of its values is a mere assumption (`Rig.states`).
    """
    from sealscope.parameters import load_rig

    stated_by: StatedBy = "call"
    if rig is None:
        loaded = load_rig(DEFAULT)
        stated_by = "recording" if _made_with(recording.provenance, loaded) else "nobody"
        known = loaded if stated_by == "recording" else unstated()
    else:
        known = load_rig(rig)
        if known.entry("cylinder.M_eq").source == f"{ASSUMED} {_REASON}":  # area or displacement was stated, no rig
            stated_by = "nobody"
    return known, machine_of(known, stated_by)


def unstated() -> Rig:
    """Return the default rig, each value of which is a mere assumption."""
    from sealscope.parameters import load_rig

    return load_rig(DEFAULT).as_assumed(_REASON)


def machine_of(rig: Rig, stated_by: StatedBy) -> AssumedMachine:
    """Return what a rig says of the machine."""
    return AssumedMachine(
        rig.name,
        stated_by,
        0.5 * (rig.cylinder.A_A + rig.cylinder.A_B),
        rig.pump.q_b,
        rig.states("cylinder.A_A", "cylinder.A_B"),
        rig.states("pump.q_b"),
    )


def _made_with(provenance: Mapping[str, Any], rig: Rig) -> bool:
    """Return whether a simulated recording's own rig has the area and displacement of this one."""
    from sealscope.parameters import load_rig, rig_names

    experiment = provenance.get("experiment")
    if provenance.get("origin") != "simulation" or not isinstance(experiment, Mapping):
        return False
    name, overrides = experiment.get("rig"), experiment.get("overrides")
    if name not in rig_names() or not isinstance(overrides, Mapping) or set(GEOMETRY) & set(overrides):
        return False
    own = load_rig(name)
    return all(own[parameter] == rig[parameter] for parameter in GEOMETRY)
