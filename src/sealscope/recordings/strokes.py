"""The strokes of a machine: how far, how fast and how often the piston and the pump move from one turn to the next.

Strokes are cut at the turning points of the piston's position x, where it is recorded, else of the pump's angle (theta,
or omega summed up), else of the pressure difference, which friction reverses at every turn and which tells their time
alone. A turning point counts where the reading returns by a share of its range (hysteresis), so that noise and a
controller's small corrections are none. Without theta and omega the command stands for the speed of the pump where the
piston's speed follows it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.channels import Array
from sealscope.recordings.motion import moves
from sealscope.recordings.recording import Recording, remembered

#: Rate [Hz] to which readings are averaged before their turning points are looked for.
_ANALYSIS_RATE = 50.0
#: A reading turns where it returns by this share of its range; the pressure difference by the second one.
_RETURN, _RETURN_OF_PRESSURE = 0.05, 0.5
#: The share of a stroke, from its start and to its end, that is left out where its speed is measured: there it
#: accelerates, overshoots or rests.
_ENDS = 0.1
#: Correlation of the command and the piston's speed from which on the command sets the pump's speed.
_SETS_SPEED = 0.9
#: Fewest strokes by the pressure difference, which may also swing within a stroke.
_FEWEST_BY_PRESSURE = 6
#: Fewest readings in which strokes are looked for.
_SHORTEST = 8


@dataclass(frozen=True, eq=False)
class Strokes:
    """n strokes from one turning point to the next, in the order of time.

    `start` (n,) [s] on the recording's time axis; `direction` (n,) +1 or -1; `travel` (n,) of the piston in the unit of
    x, None where x is not recorded; `pump` (n,) its angle over the same strokes in `pump_unit` (rad, or V s by the
    command), None where it is not known; `moving` (n,) [s] the time in motion, at the mean speed of the stroke's inner
    80 %, None of pressures; `time` (n,) [s] from this start to the next one.
    """

    start: Array
    direction: Array
    travel: Array | None
    pump: Array | None
    pump_unit: str
    moving: Array | None
    time: Array

    def __len__(self) -> int:
        return len(self.start)


def strokes_of(recording: Recording) -> Strokes | None:
    """Return the whole strokes of a uniformly sampled recording, None where no reading shows any.

    The first and the last stroke, which the recording may have cut off, are left out; a recording that is one stroke in
    one direction is that stroke, and its time its length. Computed once for a recording and what `Recording.only`
    makes of it.
    """
    names = ("u", "x", "theta", "omega", *CHAMBERS)
    return remembered(recording, "strokes", _strokes, [name for name in names if name in recording])


def _slow(values: Array, stride: int) -> Array:
    return np.asarray(values[: values.size // stride * stride].reshape(-1, stride).mean(axis=1))


def _pump(recording: Recording, stride: int, travel: Array | None) -> tuple[Array | None, str]:
    """Return the pump's angle, and its unit."""
    if "theta" in recording and moves(recording["theta"]):
        return _slow(recording["theta"], stride), "rad"
    for name, unit in (("omega", "rad"), ("u", "V s")):
        if name in recording and moves(recording[name]):
            angle = _slow(np.cumsum(recording[name]) / recording.rate, stride)
            if name == "omega" or (travel is not None and _follows(travel, angle)):
                return angle, unit
    return None, ""


def _follows(travel: Array, angle: Array) -> bool:
    if travel.size < _SHORTEST:
        return False
    return abs(float(np.corrcoef(np.diff(travel), np.diff(angle))[0, 1])) > _SETS_SPEED


def _strokes(recording: Recording) -> Strokes | None:
    stride = max(1, int(recording.rate / _ANALYSIS_RATE))
    travel = _slow(recording["x"], stride) if "x" in recording and moves(recording["x"]) else None
    pump, pump_unit = _pump(recording, stride, travel)
    path, share = travel if travel is not None else pump, _RETURN
    if path is None and all(name in recording and moves(recording[name]) for name in CHAMBERS):
        path, share = _slow(recording["p_A"] - recording["p_B"], stride), _RETURN_OF_PRESSURE
    if path is None or path.size < _SHORTEST:
        return None
    low, high = np.quantile(path, [0.01, 0.99])
    turns = _turning_points(path, share * float(high - low))
    whole = turns[1:-1] if turns.size >= 5 else turns
    if whole.size < (2 if travel is not None or pump is not None else _FEWEST_BY_PRESSURE + 2):
        return None
    seconds = stride / recording.rate
    begin, end = whole[:-1], whole[1:]
    crossings = np.array([_inner(path[a : b + 1]) for a, b in zip(begin, end, strict=True)]) + begin[:, None]
    start = float(recording.t[0]) + crossings[:, 0] * seconds
    time = np.diff(start) if start.size > 1 else np.array([recording.duration])
    kept = slice(0, time.size)
    of = (begin[kept], end[kept])
    moving = np.diff(crossings, axis=1)[kept, 0] * seconds / (1.0 - 2.0 * _ENDS)
    return Strokes(
        start[kept],
        np.sign(path[of[1]] - path[of[0]]),
        None if travel is None else np.abs(travel[of[1]] - travel[of[0]]),
        None if pump is None else np.abs(pump[of[1]] - pump[of[0]]),
        pump_unit,
        None if travel is None and pump is None else moving,
        time,
    )


def _inner(path: Array) -> tuple[float, float]:
    """Return when a stroke leaves its first and when it reaches its last tenth, in samples from its first one."""
    share = (path - path[0]) / (path[-1] - path[0])
    last = int(np.argmax(share >= 1.0 - _ENDS))
    first = int(np.flatnonzero(share[: last + 1] <= _ENDS)[-1])
    return (_between(share, first, _ENDS), max(_between(share, last - 1, 1.0 - _ENDS), first + 1e-3))


def _between(share: Array, k: int, level: float) -> float:
    """Return where the line from sample k to the next one passes a level."""
    step = float(share[k + 1] - share[k])
    return k + (float(level - share[k]) / step if step > 0 else 0.0)


def _turning_points(path: Array, least: float) -> np.ndarray:
    """Return the indices of the turning points of a path (n,), its ends included, that return by `least` or more."""
    points = [0]
    low = high = 0
    rising: bool | None = None
    values = path.tolist()
    for k, value in enumerate(values):
        if value > values[high]:
            high = k
        if value < values[low]:
            low = k
        if rising is not False and values[high] - value > least:  # fell from the highest point
            if rising or high > 0:
                points.append(high)
            rising, low, high = False, k, k
        elif rising is not True and value - values[low] > least:
            if rising is False or low > 0:
                points.append(low)
            rising, low, high = True, k, k
    last = high if rising else low
    if last > points[-1]:
        points.append(last)
    return np.array(points)
