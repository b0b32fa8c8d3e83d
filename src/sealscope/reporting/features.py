"""The details and their RMS as the page shows them: of every stretch of a recording that can be transformed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.errors import InputError
from sealscope.recordings.quality import uniform_segments
from sealscope.recordings.recording import Array, Recording
from sealscope.reporting.series import ordered_time
from sealscope.signals.details import QUANTITIES, details, shortest
from sealscope.signals.windows import WINDOW_SIZE, WINDOW_STEP, rms, windowed_rms

HALF_WINDOWS = 10


class ChamberDetails(NamedTuple):
    """d1..d4 and d3d4 of one chamber's pressure.

    `values`: name -> (n,) over the whole recording, NaN where the transform would touch an end or a fault of the data;
    `window_t`: (w,) centres of the RMS windows [s]; `window_rms`: name -> (w,), NaN between two stretches. Unit: the
    channel's, d3d4 its square.
    """

    channel: str
    unit: str
    values: dict[str, Array]
    window_t: Array
    window_rms: dict[str, Array]


class DetailChange(NamedTuple):
    """RMS of one detail before and after, in the channel's unit (d3d4: its square); `percent` as in the thesis."""

    channel: str
    name: str
    before: float | None
    after: float | None

    @property
    def percent(self) -> float | None:
        """``100 (after - before) / before`` [%], None where it cannot be formed."""
        if self.before is None or self.after is None or self.before <= 0:
            return None
        return 100 * (self.after - self.before) / self.before


def chamber_details(recording: Recording, channel: str) -> tuple[ChamberDetails | None, str]:
    """Return the details of one chamber over its usable stretches, and a sentence on what was left out.

    Bad data raise nothing: then the details are None, and the sentence is the reason.
    """
    if channel not in recording:
        return None, f"{channel} is not in this recording."
    n, series = len(recording), recording[channel]
    t = ordered_time(recording.t, recording.rate)[0]
    needed = shortest()
    parts = uniform_segments(recording, [channel])
    usable = [part for part in parts if part.stop - part.start >= needed]
    if not usable:
        longest = max((part.stop - part.start for part in parts), default=0)
        return (
            None,
            f"No details of {channel}: they need {needed} samples without a fault, the most there are is {longest}.",
        )
    values = {name: np.full(n, np.nan) for name in QUANTITIES}
    windows: list[tuple[Array, Array]] = []  # centres (w,), RMS (details, w) of each stretch
    for part in usable:
        try:
            transformed = details(series[part])
            rows, inside = transformed.quantities(), transformed.inside()
            ends, levels = windowed_rms(rows[:, inside], first=inside.start)
        except InputError as error:  # such as pressures of 1e300, whose squares overflow
            return None, f"No details of {channel}: {error}."
        for name, row, level in zip(QUANTITIES, rows, (1, 2, 3, 4, 4), strict=True):
            where = transformed.inside(level)
            values[name][part][where] = row[where]
        if ends.size:
            centres = t[part.start] + (ends - WINDOW_SIZE / 2) / recording.rate
            if windows:  # a point without a value parts two stretches
                windows.append((centres[:1], np.full((len(QUANTITIES), 1), np.nan)))
            windows.append((centres, levels))
    notes = []
    left_out = n - sum(part.stop - part.start for part in usable)
    if left_out:
        pieces = f"{len(usable)} stretch{'es' if len(usable) > 1 else ''}"
        notes.append(f"{channel}: the details are of {pieces} without a fault; {left_out} of {n} samples are left out.")
    if not windows:
        notes.append(f"{channel} has no stretch long enough for an RMS window of {WINDOW_SIZE} samples.")
        windows.append((np.empty(0), np.empty((len(QUANTITIES), 0))))
    window_t, levels = (np.concatenate(parts, axis=-1) for parts in zip(*windows, strict=True))
    window_rms = dict(zip(QUANTITIES, levels, strict=True))
    return ChamberDetails(channel, recording.units[channel], values, window_t, window_rms), " ".join(notes)


class Parts(NamedTuple):
    """The two parts of a recording whose RMS are compared, t < `end` and t >= `start` [s]; their names; why these."""

    end: float
    start: float
    heads: tuple[str, str]
    text: str


def parts_to_compare(diagnosis: Diagnosis, recording: Recording) -> Parts:
    """Before and after the onset's interval; without an onset the halves, or the whole of a short recording alone.

    A half of fewer than `HALF_WINDOWS` windows is not compared: it would show the stroke and not the seal.
    """
    t = ordered_time(recording.t, recording.rate)[0]
    if diagnosis.onset_s is not None:
        low, high = diagnosis.onset_interval_s or (diagnosis.onset_s, diagnosis.onset_s)
        text = f"Before and after the onset at {low:.1f} s."
        if low < high:
            text = f"Before {low:.1f} s and after {high:.1f} s; what lies in the onset's interval is left out."
        return Parts(low, high, ("Before", "After"), text)
    if len(recording) < 2 * (WINDOW_SIZE + (HALF_WINDOWS - 1) * WINDOW_STEP):
        text = "No onset was found, and the recording is too short to be parted."
        return Parts(np.inf, np.inf, ("Whole", "Later"), text)
    middle = float(t[0] + t[-1]) / 2
    text = f"No onset was found: the first half is set against the second, parted at {middle:.1f} s."
    return Parts(middle, middle, ("First half", "Second half"), text)


def changes(recording: Recording, chambers: list[ChamberDetails], parts: Parts) -> list[DetailChange]:
    """RMS in the first and the second part for each detail of each chamber; None where a part has no samples."""
    t = ordered_time(recording.t, recording.rate)[0]
    early, late = t < parts.end, t >= parts.start
    return [
        DetailChange(chamber.channel, name, _rms(values[early]), _rms(values[late]))
        for chamber in chambers
        for name, values in chamber.values.items()
    ]


def _rms(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(rms(finite)) if finite.size else None
