"""Names of the pressure channels: both chambers of the cylinder and both ports of the pump."""

from __future__ import annotations

from collections.abc import Container

CHAMBERS = ("p_A", "p_B")
#: The pump's ports and the chambers, in the order of the instruments.
PRESSURES = ("p_1", "p_2", *CHAMBERS)

#: Units in which pressures are displayed.
DISPLAY_UNITS = ("bar", "MPa", "kPa", "psi")


def chambers_of(recording: Container[str]) -> tuple[str, ...]:
    """List the names of the chamber pressures that a recording contains, p_A before p_B."""
    return tuple(name for name in CHAMBERS if name in recording)
