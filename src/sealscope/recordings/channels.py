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
#: Channels from which the flow to the cylinder is computed, best first: pump angle, speed, flow meter, command.
FLOW_SOURCES = ("theta", "omega", "q_pump", "u")
#: Channels that change slowly, over minutes, in which constant or mostly missing values are not defects.
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
#: Unit of a channel whose column states none: raw counts of a converter.
COUNTS = "count"

#: Beginning of the history line that lists the unused columns of a file.
UNUSED = "columns not used"


def flow_source(channels: Container[str]) -> str | None:
    """Choose the best available channel for computing the flow to the cylinder; None if there is none.

    The order of preference is that of `FLOW_SOURCES`.
    """
    return next((name for name in FLOW_SOURCES if name in channels), None)
