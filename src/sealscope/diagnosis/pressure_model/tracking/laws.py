"""The laws of a leak past the piston: a gap, an orifice, or both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sealscope.diagnosis.pressure_model.model import ORIFICE, G
from sealscope.recordings.recording import Array


@dataclass(frozen=True)
class Law:
    """What a leak of unit size adds: `laminar` to G [m^3/(s Pa)], `orifice` to its coefficient [m^3/(s Pa^0.5)]."""

    laminar: float
    orifice: float

    @property
    def parts(self) -> tuple[tuple[int, float], ...]:
        """The parameters that rise, and by how much with the size."""
        return tuple((k, each) for k, each in ((G, self.laminar), (ORIFICE, self.orifice)) if each != 0.0)

    @property
    def name(self) -> str:
        """The law in words."""
        return {(True, False): "a worn seal", (False, True): "an orifice"}.get(
            (self.laminar != 0.0, self.orifice != 0.0), "a worn seal and an orifice"
        )

    def flow(self, drop: Array) -> float:
        """Return the mean flow [m^3/s] of a leak of unit size at the pressure differences `drop` (n,) [Pa]."""
        size = np.abs(drop)
        return float(self.laminar * np.mean(size) + self.orifice * np.mean(np.sqrt(size)))


#: A leak is a gap, or an orifice.
WORN_SEAL, HOLE = Law(1.0, 0.0), Law(0.0, 1.0)
LAWS = (WORN_SEAL, HOLE)
