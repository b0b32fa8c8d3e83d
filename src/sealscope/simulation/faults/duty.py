"""A changed duty: the machine is asked for other strokes than before. No fault of its own, but it looks like one."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import Command, number_text
from sealscope.simulation.faults.faults import Fault, From, Growing


@dataclass(frozen=True)
class DutyChange(Fault):
    """The command becomes `amplitude` times as large and runs `speed` times as fast, without a jump in its phase."""

    amplitude: float = 1.0
    speed: float = 1.0
    opening: From | Growing = field(default_factory=From)
    kind: ClassVar[str] = "duty"

    def __post_init__(self) -> None:
        for name, value in (("amplitude", self.amplitude), ("frequency", self.speed)):
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"a duty's {name} must change by a factor >= 0, got {value:g}")
        if not isinstance(self.opening, From | Growing):
            raise InputError("a duty must change at one time or grow from one to another, got a table")

    def clock(self, t: Array) -> Array:
        """Time on the command's own clock: t + (speed - 1) x integral of the opening."""
        at, stop = (
            (self.opening.start, self.opening.stop)
            if isinstance(self.opening, Growing)
            else (
                self.opening.at,
                self.opening.at,
            )
        )
        since = np.maximum(t - at, 0.0)
        if stop > at:
            grown = np.minimum(since, stop - at)
            since = grown**2 / (2.0 * (stop - at)) + np.maximum(t - stop, 0.0)
        return np.asarray(t + (self.speed - 1.0) * since)

    def commanded(self, command: Command) -> Command:
        return ChangedDuty(command, self)

    def __str__(self) -> str:
        words = []
        if self.amplitude != 1.0 or self.speed == 1.0:
            words.append(f"amplitude x{number_text(self.amplitude)}")
        if self.speed != 1.0:
            words.append(f"frequency x{number_text(self.speed)}")
        return f"duty {' '.join(words)} {self.opening}"


@dataclass(frozen=True)
class ChangedDuty:
    """The command `before`, changed as `change` says."""

    before: Command
    change: DutyChange

    def volts(self, t: Array) -> Array:
        """u [V] at times t [s]."""
        size = 1.0 + (self.change.amplitude - 1.0) * self.change.opening.share(t)
        return np.asarray(size * self.before.volts(self.change.clock(t)))

    def __str__(self) -> str:
        return f"{self.before}, {self.change}"
