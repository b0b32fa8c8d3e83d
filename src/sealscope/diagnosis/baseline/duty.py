"""The duty of a machine, and where it changes: stroke, speed and dwell, each by the signals that a leak leaves alone.

A leak across the piston takes a share of the pump's flow: where the command sets the speed, the piston's stroke and
speed fall and the pump's do not; where a loop holds the position, the pump's stroke and speed rise and the piston's do
not. A changed duty moves both alike. So with both x and the pump's angle a stroke or a speed has changed by what they
have in common. With one of them alone, a change that a leak could make, too (x shorter or slower, the pump's angle
longer or faster), is no certain change of the duty, and neither is it comparable. The time from stroke to stroke, and
with it the dwell, is another duty's where the ratio of both strokes stays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sealscope.recordings.recording import Array, Recording, remembered
from sealscope.recordings.strokes import Strokes, strokes_of

#: A change of stroke, speed or time by less than this, as a logarithm, is none: healthy machines show it.
LEAST_CHANGE = 0.03
#: Strokes on either side of an instant that are compared, all of them in turn.
_WINDOWS = (3, 6, 12, 24, 48)
#: Probability that the means of a window of equal strokes differ as much.
_CHANCE = 1e-6
#: Scatter of a stroke below which it is rounding.
_LEAST_SCATTER = 1e-4
#: The beginning is left out, as the machine settles: this long, or so many strokes, but at most this share.
_SETTLING_SECONDS, _SETTLING_STROKES, _SETTLING_SHARE = 10.0, 6, 1.0 / 8.0

Quantity = Literal["stroke", "speed", "time"]
#: Of several quantities that change at once the first is named.
_ORDER: tuple[Quantity, ...] = ("stroke", "speed", "time")
_MEASURED = ("stroke", "speed", "pump_stroke", "pump_speed", "time")


@dataclass(frozen=True)
class Motion:
    """Mean logarithms of the strokes of a recording, each with its standard error; None where it is not measured.

    `stroke`, `speed` of the piston in the unit `unit` of x, and that a second; `pump_stroke`, `pump_speed` in
    `pump_unit`; `time` from stroke to stroke [s].
    """

    unit: str
    pump_unit: str
    stroke: tuple[float, float] | None
    speed: tuple[float, float] | None
    pump_stroke: tuple[float, float] | None
    pump_speed: tuple[float, float] | None
    time: tuple[float, float] | None


@dataclass(frozen=True)
class MotionDifference:
    """What differs between two duties: `text`, and whether a leak cannot be the cause (`certain`)."""

    text: str
    certain: bool


@dataclass(frozen=True)
class StrokeChange(MotionDifference):
    """Where a duty changes within a recording: also at `t` [s].

    `recurs`: the machine did so before as it does after, and will again as it did before.
    """

    t: float
    recurs: bool = False


def motion_of(recording: Recording) -> Motion | None:
    """Return the mean motion of a recording, None where no reading shows a stroke."""
    strokes = strokes_of(recording)
    if strokes is None:
        return None
    logs = _logarithms(strokes)

    def mean(name: str) -> tuple[float, float] | None:
        if name not in logs:
            return None
        values = logs[name]
        error = float(values.std(ddof=1)) / math.sqrt(values.size) if values.size > 1 else 0.0
        return float(values.mean()), error

    return Motion(
        *_units(recording, strokes), *(mean(name) for name in ("stroke", "speed", "pump_stroke", "pump_speed", "time"))
    )


def _units(recording: Recording, strokes: Strokes) -> tuple[str, str]:
    return recording.units["x"] if strokes.travel is not None else "", strokes.pump_unit


def _logarithms(strokes: Strokes) -> dict[str, Array]:
    """Return the logarithms of what the strokes were measured by."""
    measured = {"stroke": strokes.travel, "pump_stroke": strokes.pump, "time": strokes.time}
    if strokes.moving is not None:
        for name, of in (("speed", strokes.travel), ("pump_speed", strokes.pump)):
            measured[name] = None if of is None else of / strokes.moving
    tiny = np.finfo(float).tiny
    return {name: np.log(np.maximum(values, tiny)) for name, values in measured.items() if values is not None}


def motion_difference(own: Motion | None, other: Motion | None, least: float) -> MotionDifference | None:
    """Return how the motion of a recording differs from another one's, None where it does not, or nothing is known.

    `least`: the smallest difference of a logarithm that counts; it must also be three standard errors.
    """
    if own is None or other is None:
        return None
    changes: dict[str, float] = {}
    alike = (own.unit == other.unit, own.pump_unit == other.pump_unit)
    for name in _MEASURED:
        here, there = getattr(own, name), getattr(other, name)
        if here is None or there is None or (name != "time" and not alike[name.startswith("pump")]):
            continue
        change = here[0] - there[0]
        changes[name] = change if abs(change) > 3.0 * math.hypot(here[1], there[1]) else 0.0
    quantity, certain = _changed(changes, least)
    if quantity is None:
        return None
    here, there = ({name: getattr(side, name)[0] for name in changes} for side in (own, other))
    text = _text(quantity, here, there, (own.unit, own.pump_unit))
    return MotionDifference(f"another {text[0]} ({text[2]} and {text[1]})", certain)


def _changed(changes: Mapping[str, float], least: float) -> tuple[Quantity | None, bool]:
    """Return which quantity of the duty changed, and whether a leak cannot be the cause."""
    for quantity in _ORDER[:2]:
        piston, pump = changes.get(quantity), changes.get(f"pump_{quantity}")
        if piston is not None and pump is not None:
            if min(abs(piston), abs(pump)) > least and piston * pump > 0.0:
                return quantity, True
            continue
        change = piston if piston is not None else pump
        if change is not None and abs(change) > least:
            return quantity, (change > 0.0) == (piston is not None)
    loss = changes.get("pump_stroke", 0.0) - changes.get("stroke", 0.0)
    together = "pump_stroke" in changes and "stroke" in changes
    if abs(changes.get("time", 0.0)) > least and not (together and loss > least):
        return "time", True
    return None, False


def _text(
    quantity: Quantity, own: Mapping[str, float], other: Mapping[str, float], units: tuple[str, str]
) -> tuple[str, str, str]:
    """Return the quantity's name, its value in `other` without and in `own` with its unit."""
    pump = quantity not in own and quantity != "time"
    if quantity != "time":
        name = f"pump_{quantity}" if pump else quantity
        values = [math.exp(side[name]) for side in (other, own)]
        what, unit = (f"{quantity} of the pump", units[1]) if pump else (quantity, units[0])
        if unit == "m":
            values, unit = [1e3 * value for value in values], "mm"
        unit = "V" if unit == "V s" and quantity == "speed" else f"{unit}/s" if quantity == "speed" else unit
    else:
        what, unit, values = "time from stroke to stroke", "s", [math.exp(side["time"]) for side in (other, own)]
        prefix = "" if "speed" in own else "pump_"
        if f"{prefix}speed" in own and f"{prefix}speed" in other:
            moving = [math.exp(side[f"{prefix}stroke"] - side[f"{prefix}speed"]) for side in (other, own)]
            if abs(math.log(moving[1] / moving[0])) < LEAST_CHANGE:
                what, values = "dwell", [max(0.0, value - part) for value, part in zip(values, moving, strict=True)]
    return what, f"{values[0]:.3g}", f"{values[1]:.3g} {unit}"


def duty_changes(recording: Recording) -> tuple[StrokeChange, ...]:
    """Return where the motion changes within a recording, in the order of time.

    The means of strokes before and after each turn are compared by Student's t, for windows of 3 to 48 strokes; strokes
    in either direction are taken about their own mean. Duties in which every stroke differs from the next one scatter,
    and do not change. Computed once for a recording.
    """
    return remembered(recording, "duty changes", _duty_changes)


def _duty_changes(recording: Recording) -> tuple[StrokeChange, ...]:
    from scipy.special import stdtrit

    strokes = strokes_of(recording)
    if strokes is None or len(strokes) < 2 * _WINDOWS[0]:
        return ()
    settled = float(recording.t[0]) + min(
        max(_SETTLING_SECONDS, _SETTLING_STROKES * float(np.median(strokes.time))), _SETTLING_SHARE * recording.duration
    )
    kept = strokes.start >= settled
    logs = {name: values[kept] for name, values in _logarithms(strokes).items()}
    start, direction = strokes.start[kept], strokes.direction[kept]
    levels = {}
    for name, values in logs.items():
        levels[name] = values.copy()
        for side in (-1.0, 1.0):
            of_side = direction == side
            if np.any(of_side):
                levels[name][of_side] += values.mean() - values[of_side].mean()
    candidates: list[tuple[float, int, int, Quantity, bool]] = []
    for window in _WINDOWS:
        if start.size < 2 * window:
            break
        sure = -float(stdtrit(2 * window - 2, 0.5 * _CHANCE))
        means, t = {}, {}
        for name, values in levels.items():
            rows = np.lib.stride_tricks.sliding_window_view(values, window)
            mean, variance = rows.mean(axis=1), rows.var(axis=1, ddof=1)
            means[name] = mean[window:] - mean[:-window]
            pooled = np.sqrt(0.5 * (variance[window:] + variance[:-window]) + _LEAST_SCATTER**2)
            t[name] = np.abs(means[name]) / (pooled * math.sqrt(2.0 / window))
        for k in range(start.size - 2 * window + 1):
            quantity, certain = _changed(
                {name: float(means[name][k]) if t[name][k] > sure else 0.0 for name in levels}, LEAST_CHANGE
            )
            if quantity is not None:
                largest = max(float(t[name][k] / sure) for name in levels if name.endswith(quantity))
                candidates.append((largest, k + window, window, quantity, certain))
    changes: list[StrokeChange] = []
    taken = np.zeros(start.size + 1, dtype=np.bool_)
    units = _units(recording, strokes)
    for _, edge, window, quantity, certain in sorted(candidates, key=lambda own: (_ORDER.index(own[3]), -own[0])):
        reach = slice(max(0, edge - window), edge + window)
        if np.any(taken[reach]):
            continue
        taken[reach] = True
        sides = [
            {name: float(values[side].mean()) for name, values in levels.items()}
            for side in (slice(edge - window, edge), slice(edge, edge + window))
        ]
        what, before, after = _text(quantity, sides[1], sides[0], units)
        at = float(start[edge])
        recurs = all(_recurs(values, edge, window) for name, values in levels.items() if name.endswith(quantity))
        changes.append(StrokeChange(f"{what} changed from {before} to {after} at {at:.0f} s", certain, at, recurs))
    return tuple(sorted(changes, key=lambda change: change.t))


def _recurs(values: Array, edge: int, window: int) -> bool:
    """Return whether `values` (n,) were before an edge as in the window after it, and are after it as in that before.

    Each for a window of strokes in sequence, whose own deviations from that mean count.
    """
    rows = np.lib.stride_tricks.sliding_window_view(values, window)
    early, late = rows[: max(0, edge - 2 * window + 1)], rows[edge + window :]
    before, after = values[edge - window : edge], values[edge : edge + window]
    return all(
        len(there) > 0 and float(np.abs(there - own.mean()).mean(axis=1).min()) < LEAST_CHANGE + float(own.std())
        for there, own in ((early, after), (late, before))
    )
