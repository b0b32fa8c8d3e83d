"""Samples in the order of their clock: gaps, repeated and late samples, clocks set back, other rates, all counted.

The result depends on the samples and their order alone, never on how they were cut into pieces.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.storage.plain_state import array_of, part_of, plain_array, restored

#: Channels by which an actuator is watched, and with those that are kept beside the estimates.
_WATCHED = ("x", "theta", "omega", "p_A", "p_B", "p_1", "p_2", "u")
CHANNELS = (*_WATCHED, "T_oil")
#: Rates that differ by less than this share are one rate.
_SAME_RATE = 0.01
#: Two samples follow each other where their times differ by so many steps.
_FOLLOWS = (0.5, 1.5)
#: Pieces of samples that are kept apart, at most: joined only when a block is whole, or they are many.
_PIECES = 16
#: Rates taken [Hz]: below, a reversal is not resolved; above, a block would hold more samples than it is worth.
_RATES = (10.0, 100_000.0)


def channels_to_watch(samples: Recording, valved: bool = False) -> tuple[str, ...]:
    """Return the channels by which an actuator is watched, of those of its samples; () where they do not suffice.

    The balance of volumes reads position, angle or speed, and the chambers' pressures, or, behind a servo valve
    (`valved`), the command and all pressures; without a position the chamber pressures and what moves the machine
    suffice.
    """
    return _channels_to_watch(tuple(name for name in _WATCHED if name in samples.channels), valved)


@cache
def _channels_to_watch(names: tuple[str, ...], valved: bool) -> tuple[str, ...]:
    there = {*names}
    if not {"p_A", "p_B"} <= there:
        return ()
    if valved and {"x", "u", "p_1", "p_2"} <= there:
        return tuple(name for name in _WATCHED if name in there - {"theta", "omega"})
    if not valved and "x" in there and {"theta", "omega"} & there:
        return tuple(name for name in _WATCHED if name in there - {"u", "p_1", "p_2"})
    if {"u", "theta", "omega"} & there:
        return tuple(name for name in _WATCHED if name in there - {"x", "p_1", "p_2"})
    return ()


@dataclass
class SampleJoiner:
    """The samples of one actuator since the last whole block, without holes.

    `late_s`: samples up to this much older than the newest are late or repeated, and dropped; older ones show that the
    clock was set back. `valved`: the machine moves by a servo valve. `settled`: a position that is recorded later is
    left out. `counters`: samples that were dropped and interruptions, by reason. `pieces`: the samples as they came, of
    each piece the times and the channels.
    """

    late_s: float = 60.0
    valved: bool = False
    settled: bool = False
    names: tuple[str, ...] = ()
    rate: float = 0.0
    newest: float = float("-inf")
    pieces: list[list[Any]] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return sum([piece[0].size for piece in self.pieces])

    def count(self, reason: str, number: int = 1) -> None:
        """Add to a counter."""
        self.counters[reason] = self.counters.get(reason, 0) + number

    def interrupt(self, reason: str) -> None:
        """Drop the samples since the last whole block, and count why."""
        self.count(reason)
        self.pieces = []

    def restart(self, reason: str) -> None:
        """Take the next sample whatever its time is: the recorder or its clock was set anew."""
        self.interrupt(reason)
        self.newest = float("-inf")

    def runs(self, samples: Recording) -> Iterator[None]:
        """Append the samples run by run, and yield after each run that follows without a hole."""
        if not self._fits(samples):
            return
        if abs(samples.rate / self.rate - 1.0) > _SAME_RATE:
            self.interrupt("rate changed")
            self.rate = samples.rate
        for first, last in self._in_order(samples.t):
            step = float(samples.t[first]) - self.newest
            if math.isfinite(self.newest) and not self._follows(step, step):
                self.interrupt("gap")
            self.pieces.append([samples.t[first:last], *(samples[name][first:last] for name in self.names)])
            if len(self.pieces) > _PIECES:
                self.pieces = [self._joined(len(self))]
            self.newest = float(samples.t[last - 1])
            yield

    def _follows(self, least: float, most: float) -> bool:
        """Return whether samples follow each other that are so far apart, at least and at most [s]."""
        low, high = _FOLLOWS
        return least * self.rate > low and most * self.rate < high

    def _fits(self, samples: Recording) -> bool:
        """Return whether the samples have the stream's channels and SI units; count them where they do not."""
        names, offered = self.names, channels_to_watch(samples, self.valved)
        if not names or ("x" in offered and "x" not in names and not self.settled):
            names = offered
        missing = [name for name in names if name not in samples]
        if not names:
            missing = ["p_A, p_B and x with theta or omega, or u, theta or omega"]
        if missing:
            self.count(f"samples without {missing[0]}", len(samples))
            return False
        for name in names:
            if samples.units[name] != CHANNEL_UNITS[name]:
                self.count(f"samples of {name} not in {CHANNEL_UNITS[name]}", len(samples))
                return False
        if not _RATES[0] <= samples.rate <= _RATES[1]:
            self.count(f"samples at a rate outside {_RATES[0]:g} to {_RATES[1]:g} Hz", len(samples))
            return False
        if names != self.names:
            if self.names:
                self.count("began anew: a position is recorded, too")
            self.names, self.rate, self.pieces = names, samples.rate, []
        return True

    def _in_order(self, t: Array) -> Iterator[tuple[int, int]]:
        """Yield first and one past the last index of runs of samples that follow each other."""
        with np.errstate(all="ignore"):  # NaN and infinity follow nothing
            steps = np.diff(t)
            whole = t.size > 1 and t[0] > self.newest and self._follows(float(steps.min()), float(steps.max()))
        if whole:  # as nearly always
            yield 0, t.size
            return
        finite = np.isfinite(t)
        if not finite.all():
            self.count("samples without a time", int(np.count_nonzero(~finite)))
        known: NDArray[np.intp] = np.flatnonzero(finite)
        at = 0
        while at < known.size:
            first = int(known[at])
            if t[first] <= self.newest:
                if self.newest - t[first] > self.late_s:
                    self.restart("clock set back")
                    continue
                late = (t[known[at:]] <= self.newest) & (t[known[at:]] >= self.newest - self.late_s)
                run = int(np.argmin(late)) if not late.all() else late.size
                self.count("late or repeated samples", run)
                at += run
                continue
            rest = known[at:]
            low, high = _FOLLOWS
            steps = np.diff(t[rest]) * self.rate
            breaks = ~((steps > low) & (steps < high)) | (np.diff(rest) != 1)
            run = int(np.argmax(breaks)) + 1 if breaks.any() else rest.size
            yield first, first + run
            at += run

    def taken(self, length: int) -> Recording:
        """Return the first `length` samples, and drop them here."""
        block = self.first(length)
        while self.pieces and length >= self.pieces[0][0].size:
            length -= self.pieces.pop(0)[0].size
        if length:
            self.pieces[0] = [_rest(values, length) for values in self.pieces[0]]
        return block

    def drained(self) -> tuple[Array, dict[str, Array]]:
        """Return times and channels of all samples, and drop them here."""
        t, *channels = self._joined(len(self))
        self.pieces = []
        return t, dict(zip(self.names, channels, strict=True))

    def first(self, length: int) -> Recording:
        """Return the first `length` samples, which stay."""
        t, *channels = self._joined(length)
        units = {name: CHANNEL_UNITS[name] for name in self.names}
        return Recording(t, dict(zip(self.names, channels, strict=True)), units, self.rate)

    def _joined(self, length: int) -> list[Array]:
        """Return the times and the channels of the first `length` samples, read-only and nobody else's."""
        parts = []
        for piece in self.pieces:
            parts.append(piece if piece[0].size <= length else [values[:length] for values in piece])
            length -= parts[-1][0].size
            if not length:
                break
        whole = [np.concatenate(column) for column in zip(*parts, strict=True)]
        whole = whole or [np.empty(0) for _ in ("t", *self.names)]
        for values in whole:
            values.setflags(write=False)
        return whole

    def state(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        t, *channels = map(plain_array, self._joined(len(self)))
        newest = None if self.newest == float("-inf") else self.newest
        own = {**vars(self), "newest": newest, "counters": dict(self.counters)}
        return {**own, "names": list(self.names), "pieces": [[t, *channels]] if len(self) else []}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> SampleJoiner:
        """Return the joiner that `state` was of; raises InputError where it does not fit."""
        pieces = [[array_of(values, "samples") for values in piece] for piece in part_of(state, "pieces", list)]
        known = {name: value for name, value in state.items() if name != "pieces" and value is not None}
        joiner = restored(cls, known, "samples")
        if not {*joiner.names} <= {*CHANNELS} or any(
            len(piece) != 1 + len(joiner.names) or len({values.size for values in piece}) != 1 for piece in pieces
        ):
            raise InputError("saved state's samples must be of channels that are known, of one length")
        joiner.pieces = pieces
        return joiner


def _rest(values: Array, first: int) -> Array:
    """Return values from the index `first` on; a copy where they are the lesser part of what they were cut from."""
    rest = values[first:]
    whole = values if values.base is None else values.base
    return rest.copy() if 2 * rest.size < getattr(whole, "size", 0) else rest
