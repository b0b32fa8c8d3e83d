"""What is wrong with a recording: found and named, never repaired."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sealscope.recordings.motion import constant, stuck
from sealscope.recordings.recording import Array, Recording
from sealscope.recordings.symptoms import clipped, hum, infinite, missing

Severity = Literal["note", "warning", "fatal"]

#: The level 4 detail of db8 looks at this many samples at once; fewer tell nothing about it: (16 - 1)(2^4 - 1) + 1.
SHORTEST = 226
#: An interval over this many sampling steps is a gap, one under the inverse share of a step is crowded.
_GAP = 1.5
_CROWDED = 0.5
#: Scatter of the intervals, as a share of the step, from which sampling is called irregular, and unusable.
_JITTER = 0.05
_WORST_JITTER = 0.3
_RATE_ERROR = 0.01
#: Share of the power over 20 Hz, where leakage shows, from which hum disturbs, and from which there is little else.
_LOUD_HUM = 0.1
_UNCONNECTED = 0.5


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong: `code`, `severity`, the `channel` (None: time), how often, where first [s], in words.

    `fatal`: the recording as a whole cannot be analysed as uniformly sampled; `uniform_segments` gives the parts that
    can. `warning`: the channel needs a look before a verdict is believed. `note`: worth knowing.
    """

    code: str
    severity: Severity
    channel: str | None
    count: int
    first_t: float | None
    text: str


def inspect(recording: Recording) -> tuple[Finding, ...]:
    """Every finding on the time base and on each channel, time first, fatal ones foremost within time.

    Time: `too_short`, `missing_time`, `reversed_time`, `duplicated_time`, `gap`, `rate_mismatch`, `irregular_sampling`.
    Channels: `missing`, `mixed_rate`, `infinite`, `constant`, `clipped`, `stuck`, `mains_hum`.
    """
    found = _time_findings(recording)
    for name, values in recording.channels.items():
        found += _channel_findings(recording, name, values)
    return tuple(found)


def _moment(recording: Recording, index: int) -> float | None:
    t = float(recording.t[index])
    return t if np.isfinite(t) else None


def _time_findings(recording: Recording) -> list[Finding]:
    t, found = recording.t, list[Finding]()
    step = 1.0 / recording.rate

    def add(code: str, severity: Severity, where: Array | np.ndarray, text: str) -> None:
        found.append(Finding(code, severity, None, len(where), _moment(recording, int(where[0])), text))

    unknown = np.flatnonzero(~np.isfinite(t))
    if unknown.size:
        add("missing_time", "fatal", unknown, f"{unknown.size} samples have no time")
    known = np.flatnonzero(np.isfinite(t))
    steps = np.diff(t[known])
    back = np.flatnonzero(steps < 0)
    if back.size:
        worst = float(-steps[back].min())
        add("reversed_time", "fatal", known[back + 1], f"time goes back {_times(back.size)}, by up to {worst:g} s")
    same = np.flatnonzero(steps == 0)
    if same.size:
        add("duplicated_time", "fatal", known[same + 1], f"{same.size} time stamps repeat the one before")
    forward = steps[steps > 0]
    if forward.size:
        typical = float(np.median(forward))
        if abs(typical / step - 1.0) > _RATE_ERROR and not (same.size and typical < 2.5 * step):
            text = f"time stamps tell {1.0 / typical:.6g} Hz, the recording's rate is {recording.rate:g} Hz"
            add("rate_mismatch", "fatal", known[:1], text)
            step = typical
        gaps = np.flatnonzero(steps > _GAP * step)
        if gaps.size:
            lost = int(np.round(steps[gaps] / step - 1.0).sum())
            longest = float(steps[gaps].max())
            text = f"{gaps.size} gaps, about {lost} samples lost, the longest {longest:g} s"
            add("gap", "fatal", known[gaps], text)
        usual = forward[forward <= _GAP * step] / step
        scatter = float(usual.std()) if usual.size else 0.0
        if scatter > _JITTER:
            odd = np.flatnonzero((steps > 0) & (steps <= _GAP * step) & (np.abs(steps / step - 1.0) > _JITTER))
            severity: Severity = "fatal" if scatter > _WORST_JITTER else "warning"
            add(
                "irregular_sampling",
                severity,
                known[odd],
                f"intervals scatter by {100 * scatter:.0f} % of the sampling step",
            )
    if len(recording) < SHORTEST:
        text = f"{len(recording)} samples; the slowest detail needs {SHORTEST}"
        found.append(Finding("too_short", "warning", None, len(recording), None, text))
    return found


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _channel_findings(recording: Recording, name: str, values: Array) -> list[Finding]:
    found: list[Finding] = []
    rate = recording.rate

    def add(code: str, severity: Severity, count: int, first: int, text: str) -> None:
        found.append(Finding(code, severity, name, count, _moment(recording, first), f"{name}: {text}"))

    holes = missing(values)
    if holes is not None:
        if holes.every:
            rest = rate / holes.every
            text = f"has a value on every {_ordinal(holes.every)} row only ({rest:g} Hz among {rate:g} Hz)"
            add("mixed_rate", "warning", holes.samples, holes.first, text)
        elif holes.samples == values.size:
            add("missing", "warning", holes.samples, 0, "has no values at all")
        else:
            text = f"{holes.samples} samples missing in {_runs(holes.runs)}, the longest {holes.longest / rate:g} s"
            add("missing", "warning", holes.samples, holes.first, text)
    extreme = infinite(values)
    if extreme.size:
        add("infinite", "warning", extreme.size, int(extreme[0]), f"{extreme.size} samples are infinite")
    sound = np.flatnonzero(np.isfinite(values))
    kept = values[sound]
    if kept.size < 2:
        return found
    if constant(kept):
        # a command may rest, and a flow meter on a closed bypass reads one value; a pressure never does
        severity: Severity = "note" if name in ("u", "q_leak") else "warning"
        add("constant", severity, kept.size, int(sound[0]), f"is constant at {kept[0]:g} {recording.units[name]}")
        return found
    still = stuck(kept)
    if name.startswith("p_") or name == "q_leak":
        for rail in clipped(kept, still, low=name != "q_leak"):
            text = (
                f"{rail.samples} samples stand at the {rail.side} end, {rail.value:g} {recording.units[name]}: clipped"
            )
            add("clipped", "warning", rail.samples, int(sound[rail.first]), text)
    if name not in ("u", "q_leak"):
        if name.startswith("p_"):  # at an end of its values it is clipped
            still = still[(kept[still[:, 0]] > kept.min()) & (kept[still[:, 0]] < kept.max())]
        if still.size:
            first, length = (int(v) for v in still[0])
            text = f"stands still {_times(len(still))} while it should move, first for {length / rate:g} s"
            add("stuck", "warning", int(still[:, 1].sum()), int(sound[first]), text)
    if kept.size > 0.9 * values.size:
        for line in hum(kept, rate):
            text = f"mains hum of {line.frequency:g} Hz, amplitude {line.amplitude:.3g} {recording.units[name]}"
            text += f", {100 * line.share:.2g} % of the power over 20 Hz"
            if line.share > _UNCONNECTED:
                text += ": is the sensor connected?"
            add("mains_hum", "warning" if line.share > _LOUD_HUM else "note", kept.size, int(sound[0]), text)
    return found


def _runs(count: int) -> str:
    return "1 stretch" if count == 1 else f"{count} stretches"


def _ordinal(number: int) -> str:
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def uniform_segments(recording: Recording, channels: Sequence[str] | None = None, *, shortest: int = 1) -> list[slice]:
    """The maximal stretches, as slices, sampled uniformly with the named channels (default: all) finite.

    A stretch has at least `shortest` samples; each interval in it lies between half and one and a half steps of
    `recording.rate`. Raises InputError for a channel that the recording does not have.
    """
    count = len(recording)
    sound = np.isfinite(recording.t)
    for name in recording.channels if channels is None else channels:
        sound = sound & np.isfinite(recording[name])
    with np.errstate(invalid="ignore"):
        steps = np.diff(recording.t) * recording.rate
        joined = sound[1:] & sound[:-1] & (steps > _CROWDED) & (steps < _GAP)
    starts = np.flatnonzero(sound & np.r_[True, ~joined][:count])
    stops = np.flatnonzero(sound & np.r_[~joined, True][-count:]) + 1 if count else starts
    return [slice(int(a), int(b)) for a, b in zip(starts, stops, strict=True) if b - a >= shortest]
