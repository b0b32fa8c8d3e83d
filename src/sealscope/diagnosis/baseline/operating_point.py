"""Operating points of recordings: what must be alike before any detector compares them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sealscope.diagnosis.baseline.duty import Motion, motion_difference, motion_of
from sealscope.recordings.chambers import CHAMBERS, chambers_of
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.motion import moves
from sealscope.recordings.recording import Recording

#: A stroke has one direction when its displacement exceeds this share of the whole path (or the mean pressure
#: difference this share of its rms).
ONE_WAY = 0.5
#: Pressure levels (rms of the pressure difference) are alike within this ratio when too few recordings tell how the
#: details follow the level.
LEVEL_RATIO = 1.15
#: Stroke, speed and time of a stroke are alike within this difference of their logarithms.
MOTION = 0.05
_SLOW_RATE = 20.0


@dataclass(frozen=True)
class OperatingPoint:
    """What must be alike before two recordings may be compared.

    `direction`: +1, -1 for a stroke in one direction, 0 for a back-and-forth duty; `level`: log of the rms of the
    pressure difference; `rate` [Hz]; `units` of the chambers; `chambers`; `command_rms` [V] and `cycle` [s] where there
    is a command; `motion`: stroke, speed and time from stroke to stroke, None where no reading shows them.
    """

    direction: Literal[-1, 0, 1]
    level: float
    rate: float
    units: tuple[str, ...]
    chambers: tuple[str, ...]
    command_rms: float | None
    cycle: float | None
    motion: Motion | None = None

    @classmethod
    def of_dict(cls, tree: Mapping[str, Any]) -> OperatingPoint:
        """Return the operating point of which `dataclasses.asdict` gave `tree`, also by way of JSON."""
        values = dict(tree) | {name: tuple(tree[name]) for name in ("units", "chambers")}
        if (motion := tree.get("motion")) is not None:
            fields: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in motion.items()}
            values["motion"] = Motion(**fields)
        return cls(**values)


def _direction(recording: Recording) -> Literal[-1, 0, 1]:
    share = 0.0
    if "x" in recording and moves(recording["x"]):
        stride = max(1, int(recording.rate / _SLOW_RATE))
        x = recording["x"][::stride]
        path = float(np.abs(np.diff(x)).sum())
        share = float(x[-1] - x[0]) / path if path > 0 else 0.0
    elif all(name in recording for name in CHAMBERS):
        dp = recording["p_A"] - recording["p_B"]
        rms = float(np.sqrt(np.mean(dp**2)))
        share = float(dp.mean()) / rms if rms > 0 else 0.0
    if abs(share) <= ONE_WAY:
        return 0
    return 1 if share > 0 else -1


def operating_point(recording: Recording) -> OperatingPoint:
    """Return the operating point of a recording without missing samples."""
    chambers = chambers_of(recording)
    pressure = recording["p_A"] - recording["p_B"] if len(chambers) == 2 else recording[chambers[0]]
    if len(chambers) < 2:
        pressure = pressure - pressure.mean()
    command = recording.channels.get("u")
    return OperatingPoint(
        direction=_direction(recording),
        level=0.5 * math.log(max(float(np.mean(pressure**2)), 1e-300)),
        rate=recording.rate,
        units=tuple(recording.units[name] for name in chambers),
        chambers=chambers,
        command_rms=None if command is None else float(np.sqrt(np.mean(command**2))),
        cycle=None if command is None else find_cycle(recording),
        motion=motion_of(recording),
    )


def difference(point: OperatingPoint, other: OperatingPoint, *, certain: bool = False) -> str | None:
    """Return why two recordings must not be compared, None where they may; the pressure level is judged elsewhere.

    `certain`: leave out what a leak could have made, too.
    """
    if point.chambers != other.chambers or point.units != other.units:
        return "other channels or units"
    if abs(point.rate / other.rate - 1.0) > 1e-3:
        return f"another sampling rate ({point.rate:g} Hz and {other.rate:g} Hz)"
    if point.direction != other.direction:
        return "another direction of the stroke"
    if (point.command_rms is None) != (other.command_rms is None):
        return "only one of them has a command"
    if point.command_rms is not None and other.command_rms is not None:
        if not math.isclose(point.command_rms, other.command_rms, rel_tol=0.05, abs_tol=0.01):
            return f"another command ({point.command_rms:.3g} V and {other.command_rms:.3g} V rms)"
        if (point.cycle is None) != (other.cycle is None) or (
            point.cycle is not None
            and other.cycle is not None
            and not math.isclose(point.cycle, other.cycle, rel_tol=0.05)
        ):
            return "another cycle of the command"
    moved = motion_difference(point.motion, other.motion, MOTION)
    if moved is not None and (moved.certain or not certain):
        return moved.text if moved.certain else f"{moved.text}, or a leak that takes as much"
    return None
