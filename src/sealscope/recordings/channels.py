"""The channels of a recording: their names, which are the thesis's symbols, their SI units and what they measure."""

from __future__ import annotations

from collections.abc import Container, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Channel -> its unit inside Sealscope, and what it measures; `docs/nomenclature.md` explains the names.
_CHANNELS = {
    "u": ("V", "command"),
    "omega": ("rad/s", "motor speed"),
    "theta": ("rad", "motor angle"),
    "x": ("m", "piston position"),
    "p_1": ("Pa", "pressure at pump port 1"),
    "p_2": ("Pa", "pressure at pump port 2"),
    "p_A": ("Pa", "pressure in chamber A"),
    "p_B": ("Pa", "pressure in chamber B"),
    "q_leak": ("m^3/s", "leakage flow"),
    "q_comp": ("m^3/s", "leakage flow that the controller makes good"),
    "q_pump": ("m^3/s", "flow to the cylinder by a meter"),
    "q_supply": ("m^3/s", "flow to the valve by a meter in its supply line"),
    "T_oil": ("K", "oil temperature"),
}
CHANNEL_UNITS: Mapping[str, str] = MappingProxyType({name: unit for name, (unit, _) in _CHANNELS.items()})
#: What each channel, and the time, measures.
LONG_NAMES: Mapping[str, str] = MappingProxyType({"t": "time"} | {name: text for name, (_, text) in _CHANNELS.items()})
#: Channels of flow meters.
METERS = ("q_pump", "q_supply")
#: Channels from which the flow to the cylinder is computed, best first: pump angle, speed, flow meters, command.
FLOW_SOURCES = ("theta", "omega", *METERS, "u")
#: Channels that change slowly, over minutes, in which constant or mostly missing values are not defects.
SLOW = frozenset({"T_oil"})
#: Unit of a channel whose column states none: raw counts of a converter.
COUNTS = "count"

#: Beginning of the history line that lists the unused columns of a file.
UNUSED = "columns not used"


def flow_source(channels: Container[str]) -> str | None:
    """Choose the best of `FLOW_SOURCES` for computing the flow to the cylinder; None if all are absent."""
    return next((name for name in FLOW_SOURCES if name in channels), None)
