"""The pump's shaft, as its angle, speed or command shows it, and what the pump delivers by it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from sealscope.control.drive import Drive
from sealscope.recordings.motion import moves
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: A recording starts from rest where its first command, or speed, is under this share of the largest.
_AT_REST = 0.02


@dataclass(frozen=True, eq=False)
class Shaft:
    """The shaft of a recording of n samples.

    `shown`: the channel that shows it, theta, omega or u; `drive`: the law by which u does; `speed` (n,) [rad/s], that
    commanded where u shows it; `sense`: 1, or -1 where p_A - p_B (`dp` (n,) [Pa]) falls with it.
    """

    shown: str
    drive: Drive
    speed: Array
    dp: Array
    sense: float

    @classmethod
    def of(cls, recording: Recording, rig: Rig) -> Self | None:
        """Return the shaft of a recording with both chamber pressures, None where no channel shows it."""
        shown, drive = shaft_shown(recording), Drive.of(rig)
        if shown is None:
            return None
        if shown == "u":
            speed = drive.omega_per_volt * recording["u"]
        else:
            speed = np.gradient(recording["theta"]) * recording.rate if shown == "theta" else recording["omega"]
        dp = recording["p_A"] - recording["p_B"]
        return cls(shown, drive, speed, dp, _sense(speed, dp - dp.mean()))

    @property
    def settled(self) -> bool:
        """Whether the drive's state at the start is known: its speed is recorded, or it starts from rest."""
        return self.shown != "u" or bool(abs(self.speed[0]) <= _AT_REST * np.max(np.abs(self.speed)))

    def flow(self, recording: Recording, settled: int = 0) -> Array:
        """Return what the pump delivers (n,) [m^3/s]; `settled` as `Drive.flow` takes it."""
        if self.shown == "u":
            return self.drive.flow(recording["u"], self.sense * self.dp, recording.rate, settled)
        return self.drive.displacement * self.speed

    def along(self, x: Array) -> float:
        """Return 1 where a position (n,) grows with the shaft's angle, else -1."""
        return _sense(self.speed, np.gradient(x))


def shaft_shown(recording: Recording) -> str | None:
    """Return the channel that shows the shaft: theta, omega or u, whichever is recorded and moves; None without one."""
    units = {"theta": "rad", "omega": "rad/s", "u": "V"}
    return next((name for name, unit in units.items() if shows(recording, name, unit)), None)


def shows(recording: Recording, name: str, unit: str) -> bool:
    """Return whether a channel is recorded in this unit, and moves."""
    return name in recording and recording.units[name] == unit and moves(recording[name])


def _sense(speed: Array, values: Array) -> float:
    return 1.0 if float(np.dot(speed - speed.mean(), values)) >= 0.0 else -1.0
