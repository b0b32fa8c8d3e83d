"""The channels of a recording: their names, which are the thesis's symbols, their SI units and what they measure."""

from __future__ import annotations

from collections.abc import Container, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Channel names and the unit each has inside Sealscope; `docs/nomenclature.md` explains them.
CHANNEL_UNITS: Mapping[str, str] = MappingProxyType(
    {
        "u": "V",
        "omega": "rad/s",
        "theta": "rad",
        "x": "m",
        "p_1": "Pa",
        "p_2": "Pa",
        "p_A": "Pa",
        "p_B": "Pa",
        "q_leak": "m^3/s",
        "q_comp": "m^3/s",
        "q_pump": "m^3/s",
        "T_oil": "K",
    }
)
#: What tells the flow to the cylinder, best first: the pump's angle, its speed, a flow meter, the command.
FLOW_SOURCES = ("theta", "omega", "q_pump", "u")
#: Channels that change over minutes: that such a channel is constant, or missing in most rows, is no defect.
SLOW = frozenset({"T_oil"})
#: What each channel, and the time, measures.
LONG_NAMES: Mapping[str, str] = MappingProxyType(
    {
        "t": "time",
        "u": "command",
        "omega": "motor speed",
        "theta": "motor angle",
        "x": "piston position",
        "p_1": "pressure at pump port 1",
        "p_2": "pressure at pump port 2",
        "p_A": "pressure in chamber A",
        "p_B": "pressure in chamber B",
        "q_leak": "leakage flow",
        "q_comp": "leakage flow that the controller makes good",
        "q_pump": "flow to the cylinder by a meter",
        "T_oil": "oil temperature",
    }
)
#: Unit of a mapped channel that came without one: raw counts of a converter.
COUNTS = "count"

#: Beginning of the line of a history that names the columns of a file that are no channels.
UNUSED = "columns not used"


def flow_source(channels: Container[str]) -> str | None:
    """Return the channel that tells the flow to the cylinder, None where none does."""
    return next((name for name in FLOW_SOURCES if name in channels), None)
