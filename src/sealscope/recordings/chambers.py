"""The pair of chamber pressures."""

from __future__ import annotations

from sealscope.recordings.recording import Recording

CHAMBERS = ("p_A", "p_B")


def chambers_of(recording: Recording) -> tuple[str, ...]:
    """The chamber pressures that the recording has."""
    return tuple(name for name in CHAMBERS if name in recording)
