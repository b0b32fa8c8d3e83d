"""Wrapped angles: a motor angle that begins anew after a turn is unwrapped, or left out where nothing tells its turns.

Called by the inspection before samples are interpolated.
"""

from __future__ import annotations

from dataclasses import replace

from sealscope.paragraphs import format_count
from sealscope.recordings.channels import COUNTS
from sealscope.recordings.formats.wrapped_angle import continue_resets, unwrap_angle
from sealscope.recordings.quality import Finding, locate_rows
from sealscope.recordings.recording import Recording

#: Channels that tell how far the shaft turns from sample to sample.
_SIGNALS = ("omega", "x", "u")


def unwrap_angles(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Unwrap the motor angle theta of a recording; leave it out if its turns are ambiguous. Also return a finding."""
    if "theta" not in recording:
        return recording, []
    signals = {
        name: recording[name]
        for name in _SIGNALS
        if name in recording and not (name == "omega" and recording.units[name] == COUNTS)
    }
    angle = unwrap_angle(recording["theta"], recording.units["theta"], recording.t, signals)
    if angle is None:
        return _continue_resets(recording)
    period = recording.format_value("theta", angle.period, is_span=True)
    leaps, places = format_count(angle.leaps.size, "time"), locate_rows(recording.t, angle.leaps)
    if angle.values is None:
        text = f"theta: begins anew after {period} and turns by half of this or more from sample to sample, "
        text += "as no other channel tells how far: left out; record the speed, or sample faster"
        finding = Finding("angle_ambiguous", "warning", "theta", angle.leaps.size, places[0], text, places)
        return recording.only(name for name in recording.channels if name != "theta"), [finding]
    text = f"theta: begins anew after {period}, {leaps}: unwrapped"
    finding = Finding("angle_unwrapped", "note", "theta", angle.leaps.size, places[0], text, places)
    return replace(recording, channels={**recording.channels, "theta": angle.values}), [finding]


def _continue_resets(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Let theta continue where the encoder begins again from its first value; also return a finding."""
    values, resets = continue_resets(recording["theta"], recording.channels.get("x"))
    if not resets.size:
        return recording, []
    text = f"theta: begins again from its first value, {format_count(resets.size, 'time')}: taken as continuing"
    places = locate_rows(recording.t, resets)
    finding = Finding("angle_reset", "note", "theta", int(resets.size), float(recording.t[resets[0]]), text, places)
    return replace(recording, channels={**recording.channels, "theta": values}), [finding]
