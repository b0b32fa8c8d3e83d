"""The details and their RMS as the page shows them: of the longest stretch of a recording that can be transformed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.recording import Recording
from sealscope.reporting.contract import DiagnosisLike

Array = NDArray[np.float64]

CHAMBERS = ("p_A", "p_B")
LEVELS = 4
PRODUCT = "d3d4"
NAMES = (*(f"d{level}" for level in range(1, LEVELS + 1)), PRODUCT)
WINDOW, STEP = 1000, 500


@dataclass(frozen=True)
class ChamberDetails:
    """d1..d4 and d3d4 of one chamber's pressure.

    `values`: name -> (n,) over the whole recording, NaN where the transform would touch an end or a fault of the data;
    `window_t`: (w,) centres of the RMS windows [s]; `window_rms`: name -> (w,). Unit: the channel's, d3d4 its square.
    """

    channel: str
    unit: str
    values: dict[str, Array]
    window_t: Array
    window_rms: dict[str, Array]


@dataclass(frozen=True)
class Change:
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


def usable(recording: Recording, channel: str) -> slice:
    """The longest stretch in which the channel has every sample and time runs on evenly; empty where there is none."""
    good = np.isfinite(recording[channel])
    apart = np.zeros(len(recording), dtype=bool)
    if len(recording) > 1:
        steps = np.diff(recording.t) * recording.rate
        apart[1:] = ~((steps > 0.5) & (steps < 1.5))
    starts = np.flatnonzero(good & (apart | ~np.append(False, good[:-1])))
    if not starts.size:
        return slice(0, 0)
    ends = np.flatnonzero(~np.append(good, False) | np.append(apart, True))
    stops = ends[np.searchsorted(ends, starts, side="right")]
    longest = int(np.argmax(stops - starts))
    return slice(int(starts[longest]), int(stops[longest]))


def chamber_details(recording: Recording, channel: str) -> tuple[ChamberDetails | None, str]:
    """The details of one chamber over its longest usable stretch, and a sentence that says what was left out or why not.

    Raises nothing for bad data: the reason is returned in words, with None.
    """
    from sealscope.signals.details import details
    from sealscope.signals.windows import windowed_rms

    if channel not in recording:
        return None, f"{channel} is not in this recording."
    part = usable(recording, channel)
    try:
        transformed = details(recording[channel][part], levels=LEVELS)
    except InputError as error:
        return None, f"No details of {channel}: {error}."
    n, values = len(recording), {}
    for level, name in enumerate(NAMES[:LEVELS], start=1):
        values[name] = _placed(transformed[level], transformed.inside(level), part, n)
    inside = transformed.inside()
    values[PRODUCT] = _placed(transformed.product(3, 4), transformed.inside(3, 4), part, n)
    levels = windowed_rms(transformed, WINDOW, STEP, first=part.start)
    product = windowed_rms(transformed.product(3, 4)[inside], WINDOW, STEP)
    rms = dict(zip(NAMES, [*levels.rms, product.rms], strict=True))
    # in the stretch time runs evenly, so a window's centre follows from its samples' numbers
    centres = recording.t[part.start] + (levels.ends - WINDOW / 2 - part.start) / recording.rate
    left_out = n - (part.stop - part.start)
    note = ""
    if left_out:
        first, last = recording.t[part.start], recording.t[part.stop - 1]
        note = (
            f"{channel}: the details are of the longest stretch with every sample, {first:.1f} s to {last:.1f} s; "
            f"{left_out} of {n} samples are left out."
        )
    if not centres.size:
        note = f"{note} {channel} is too short for a window of {WINDOW} samples.".strip()
    return ChamberDetails(channel, recording.units[channel], values, centres, rms), note


def _placed(series: Array, inside: slice, part: slice, n: int) -> Array:
    whole = np.full(n, np.nan)
    whole[part.start + inside.start : part.start + inside.stop] = series[inside]
    return whole


def before_and_after(diagnosis: DiagnosisLike, recording: Recording) -> tuple[float, float, str]:
    """The end of the part before and the start of the part after [s], and a sentence that says which they are."""
    first, last = float(recording.t[0]), float(recording.t[-1])
    if diagnosis.onset_s is None:
        middle = (first + last) / 2
        return middle, middle, f"No onset was found: the first half is set against the second (parted at {middle:.1f} s)."
    low, high = diagnosis.onset_interval_s or (diagnosis.onset_s, diagnosis.onset_s)
    if low == high:
        return low, high, f"Before and after the onset at {low:.1f} s."
    return low, high, f"Before {low:.1f} s and after {high:.1f} s; what lies in the onset's interval is left out."


def changes(recording: Recording, chambers: list[ChamberDetails], before_end: float, after_start: float) -> list[Change]:
    """RMS before and after for each detail of each chamber; None where a part has no samples."""
    early, late = recording.t < before_end, recording.t >= after_start
    return [
        Change(chamber.channel, name, _rms(values[early]), _rms(values[late]))
        for chamber in chambers
        for name, values in chamber.values.items()
    ]


def _rms(values: Array) -> float | None:
    from sealscope.signals.windows import rms

    finite = values[np.isfinite(values)]
    return float(rms(finite)) if finite.size else None
