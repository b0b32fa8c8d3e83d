"""The pressures of the actuator, and the pair of its chambers."""

from __future__ import annotations

from sealscope.recordings.recording import Recording

CHAMBERS = ("p_A", "p_B")
#: The pump's ports and the chambers, in the order of the instruments.
PRESSURES = ("p_1", "p_2", *CHAMBERS)


def chambers_of(recording: Recording) -> tuple[str, ...]:
    """List the chamber pressures that the recording has."""
    return tuple(name for name in CHAMBERS if name in recording)
