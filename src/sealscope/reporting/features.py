"""Compute wavelet details of the chamber pressures and their RMS for the page, from all usable samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.errors import InputError
from sealscope.recordings.quality import uniform_segments
from sealscope.recordings.recording import Array, Recording
from sealscope.reporting.series import ordered_time
from sealscope.signals.details import QUANTITIES, details, min_samples
from sealscope.signals.windows import WINDOW_SIZE, WINDOW_STEP, rms, windowed_rms

#: Number of RMS windows that each half of a recording needs for a comparison.
HALF_WINDOWS = 10


class ChamberDetails(NamedTuple):
    """Wavelet details d1..d4 of one chamber's pressure in the channel's `unit`, and their product d3d4 in its square.

    `values`: by name, each detail (n,) over the whole recording, NaN where it depends on samples beyond an end or on a
    defect of the data; `window_t` (w,) [s]: centres of the windows of the RMS; `window_rms`: by name, the RMS (w,) in
    each window, NaN between two usable parts of the recording.
    """

    channel: str
    unit: str
    values: dict[str, Array]
    window_t: Array
    window_rms: dict[str, Array]


def chamber_details(recording: Recording, channel: str) -> tuple[ChamberDetails | None, str]:
    """Compute the wavelet details of `channel`, a chamber's pressure; return them with a note on what is missing.

    Only parts of the recording that are long enough and without a defect are transformed. Without such a part, without
    the channel, or if the transform fails, the details are None and the note is the reason.
    """
    if channel not in recording:
        return None, f"{channel} is not in this recording."
    n, signal = len(recording), recording[channel]
    t, _ = ordered_time(recording.t, recording.rate)
    n_needed = min_samples()
    parts = uniform_segments(recording, [channel])
    usable_parts = [part for part in parts if part.stop - part.start >= n_needed]
    if not usable_parts:
        n_longest = max((part.stop - part.start for part in parts), default=0)
        need = f"they need {n_needed} samples without a fault, the longest stretch has {n_longest}"
        return None, f"No details of {channel}: {need}."
    values = {name: np.full(n, np.nan) for name in QUANTITIES}
    windows: list[tuple[Array, Array]] = []  # centres (w,), RMS (details, w) of each part
    for part in usable_parts:
        try:
            transform = details(signal[part])
            rows, inside = transform.quantities(), transform.inside()  # `inside`: without the effect of padding
            ends, window_rows = windowed_rms(rows[:, inside], first=inside.start)
        except InputError as error:  # such as pressures of 1e300, whose squares overflow
            return None, f"No details of {channel}: {error}."
        # padding at the ends affects d3d4 as far as d4
        for name, row, level in zip(QUANTITIES, rows, (1, 2, 3, 4, 4), strict=True):
            unaffected_samples = transform.inside(level)
            values[name][part][unaffected_samples] = row[unaffected_samples]
        if ends.size:
            # `ends`: number of the sample just after each window, in the part
            centres = t[part.start] + (ends - WINDOW_SIZE / 2) / recording.rate
            if windows:  # NaN breaks the drawn line between two parts
                windows.append((centres[:1], np.full((len(QUANTITIES), 1), np.nan)))
            windows.append((centres, window_rows))
    notes = []
    n_left_out = n - sum(part.stop - part.start for part in usable_parts)
    if n_left_out:
        parts_text = f"{len(usable_parts)} stretch{'es' if len(usable_parts) > 1 else ''} without a fault"
        notes.append(f"{channel}: the details cover {parts_text}; {n_left_out} of {n} samples are left out.")
    if not windows:
        notes.append(f"{channel} has no stretch long enough for an RMS window of {WINDOW_SIZE} samples.")
        windows.append((np.empty(0), np.empty((len(QUANTITIES), 0))))
    window_t, window_rows = (np.concatenate(arrays, axis=-1) for arrays in zip(*windows, strict=True))
    window_rms = dict(zip(QUANTITIES, window_rows, strict=True))
    return ChamberDetails(channel, recording.units[channel], values, window_t, window_rms), " ".join(notes)


class Parts(NamedTuple):
    """Two parts of a recording that are compared on the page: before the time `end` [s], and from `start` [s] on.

    `heads`: their headings in the table; `text`: sentence that explains the choice.
    """

    end: float
    start: float
    heads: tuple[str, str]
    text: str


def parts_to_compare(diagnosis: Diagnosis, recording: Recording) -> Parts:
    """Choose two parts of a recording to compare: before and after the onset's interval, or halves without an onset.

    If the halves are too short for `HALF_WINDOWS` RMS windows each, their difference would reflect the piston's motion;
    the first part is then the whole recording.
    """
    t, _ = ordered_time(recording.t, recording.rate)
    if diagnosis.onset_s is not None:
        low, high = diagnosis.onset_interval_s or (diagnosis.onset_s, diagnosis.onset_s)
        text = f"Before and after the onset at {low:.1f} s."
        if low < high:
            text = f"Before {low:.1f} s and after {high:.1f} s; the onset's interval is left out."
        return Parts(low, high, ("Before", "After"), text)
    if len(recording) < 2 * (WINDOW_SIZE + (HALF_WINDOWS - 1) * WINDOW_STEP):
        text = "No onset was found, and the recording is too short to be divided."
        # the first part ends at infinity, so that it has all samples
        return Parts(end=np.inf, start=np.inf, heads=("Whole", "Later"), text=text)
    middle = float(t[0] + t[-1]) / 2
    text = f"No onset was found: the first half, until {middle:.1f} s, is compared with the second."
    return Parts(middle, middle, ("First half", "Second half"), text)


def changes(
    recording: Recording, chambers: list[ChamberDetails], parts: Parts
) -> list[tuple[str, str, float | None, float | None]]:
    """List (channel, detail, RMS in the first part, in the second), with None for an RMS without finite values."""
    t, _ = ordered_time(recording.t, recording.rate)
    first, second = t < parts.end, t >= parts.start
    series = ((chamber.channel, name, values) for chamber in chambers for name, values in chamber.values.items())
    return [(channel, name, _rms(values[first]), _rms(values[second])) for channel, name, values in series]


def _rms(values: Array) -> float | None:
    """Compute the RMS of the finite values; return None if there are none."""
    finite = values[np.isfinite(values)]
    return float(rms(finite)) if finite.size else None
