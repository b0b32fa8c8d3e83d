"""Instruments that change within a run: offsets, gains and noise over time, readings that stand still."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sealscope.recordings.recording import Array


@dataclass(frozen=True)
class Adjustment:
    """One parameter of an instrument over time: `change(t)` is added to it, or multiplies it as 1 + change."""

    parameter: str
    change: Callable[[Array], Array]
    added: bool


@dataclass(frozen=True)
class Hold:
    """A channel that repeats its reading of `start` until `stop` [s]."""

    channel: str
    start: float
    stop: float


@dataclass(frozen=True)
class Readings:
    """All that changes at the instruments of a run; nothing by default."""

    adjustments: tuple[Adjustment, ...] = ()
    holds: tuple[Hold, ...] = ()

    def value(self, parameter: str, own: float, t: Array) -> Array | float:
        """The parameter at times t [s], its own value where nothing changes it."""
        found: Array | float = own
        for one in sorted(self.adjustments, key=lambda one: not one.added):
            if one.parameter == parameter:
                found = found + one.change(t) if one.added else found * (1.0 + one.change(t))
        return found

    def held(self, channel: str, read: Array, t: Array) -> Array:
        """The readings (n,) with every hold of this channel in them."""
        for one in self.holds:
            still = np.flatnonzero((t >= one.start) & (t < one.stop))
            if one.channel == channel and still.size:
                read = read.copy()
                read[still] = read[still[0]]
        return read
