"""Faults of the sensors: an offset, a changed gain, a reading that stands still."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

from sealscope.errors import InputError
from sealscope.recordings.chambers import PRESSURES
from sealscope.recordings.recording import CHANNEL_UNITS, Array
from sealscope.simulation.changes.readings import Adjustment, Hold
from sealscope.simulation.commands import number_text
from sealscope.simulation.faults.faults import Fault, From, Opening

#: Channels whose sensors can be faulty, and the parameter of each sensor that holds its relative error of gain.
GAINS = {
    **dict.fromkeys(PRESSURES, "gain_error"),
    "x": "scale_error",
    "q_leak": "gain_error",
}


def _check(channel: str, value: float, what: str) -> None:
    if channel not in GAINS:
        raise InputError(f"a faulty sensor must be one of {', '.join(GAINS)}, got {channel!r}")
    if not math.isfinite(value):
        raise InputError(f"{what} of a faulty sensor must be finite, got {value} ({channel})")


@dataclass(frozen=True)
class SensorOffset(Fault):
    """The sensor of a channel reads `offset` too much, in the channel's SI unit."""

    channel: str
    offset: float
    opening: Opening = field(default_factory=From)
    kind: ClassVar[str] = "sensor offset"

    def __post_init__(self) -> None:
        _check(self.channel, self.offset, "offset")

    def adjustments(self) -> tuple[Adjustment, ...]:
        def change(t: Array) -> Array:
            return self.offset * self.opening.share(t)

        return (Adjustment(f"sensors.{self.channel}.offset", change, added=True),)

    def __str__(self) -> str:
        offset = f"{number_text(self.offset)} {CHANNEL_UNITS[self.channel]}"
        return f"sensor {self.channel} offset {offset} {self.opening}"


@dataclass(frozen=True)
class SensorGain(Fault):
    """The sensor of a channel reads `error` too much, relative: 0.01 is one per cent."""

    channel: str
    error: float
    opening: Opening = field(default_factory=From)
    kind: ClassVar[str] = "sensor gain"

    def __post_init__(self) -> None:
        _check(self.channel, self.error, "gain error")
        if not self.error > -1:
            raise InputError(f"the gain error of a sensor must be > -100 %, got {100 * self.error:g} %")

    def adjustments(self) -> tuple[Adjustment, ...]:
        def change(t: Array) -> Array:
            return self.error * self.opening.share(t)

        return (Adjustment(f"sensors.{self.channel}.{GAINS[self.channel]}", change, added=True),)

    def __str__(self) -> str:
        return f"sensor {self.channel} gain {number_text(self.error)} {self.opening}"


@dataclass(frozen=True)
class SensorStuck(Fault):
    """The sensor of a channel repeats its reading of `at` until `until` [s]."""

    channel: str
    at: float = 0.0
    until: float = math.inf
    kind: ClassVar[str] = "sensor stuck"

    def __post_init__(self) -> None:
        _check(self.channel, self.at, "time")
        if not self.until > self.at:
            raise InputError(f"a sensor must be stuck until later than {self.at:g} s, got {self.until:g} s")

    @property
    def opening(self) -> Opening:  # type: ignore[override]
        """From when on it stands still."""
        return From(self.at)

    def holds(self) -> tuple[Hold, ...]:
        return (Hold(self.channel, self.at, self.until),)

    def __str__(self) -> str:
        until = f" to {number_text(self.until)} s" if math.isfinite(self.until) else ""
        return f"sensor {self.channel} stuck from {number_text(self.at)} s{until}"
