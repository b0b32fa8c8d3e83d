"""A fleet watched live: details, the thesis's windowed RMS and sequential tests over many actuators at once.

Each actuator is compared with itself: CUSUM and generalised likelihood ratio on the change of its details' log RMS
against a reference that it learns at the beginning (`fleet_tests`), with thresholds from a stated rate of false alarms
per actuator and operating hour. The duty must be the same throughout; a change of duty is a change.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sealscope.diagnosis.fleet.run_length import cusum_threshold, glr_threshold
from sealscope.errors import InputError
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.motion import ROUNDING
from sealscope.signals.filters import Array, IntArray
from sealscope.signals.fleet import FleetRms, saved_array
from sealscope.signals.windows import WindowedRms

#: What an actuator does: it learns its reference, is watched, or pauses: a sample is missing, a reading does not move.
LEARNING, WATCHED, MISSING, STILL = range(4)
STATUS = ("learning", "watched", "paused: missing samples", "paused: a reading does not move")
DETECTORS = ("CUSUM", "likelihood ratio")


class Alarms(NamedTuple):
    """Where a fleet stands; arrays (actuators,), valid until the next update and written to by it.

    `alarm`: raised and not taken back; `new`: how many by the last block; `t` [s]: when it was raised, `onset` [s]:
    the change was after this moment, both NaN without an alarm; `series`: index into `Fleet.series`, `direction`: +1
    rose, -1 fell, `detector`: index into `DETECTORS`, all of the test that raised it; `score`: the largest statistic
    over its threshold now; `status`: index into `STATUS`.
    """

    alarm: np.ndarray
    new: int
    t: Array
    onset: Array
    series: IntArray
    direction: IntArray
    detector: IntArray
    score: Array
    status: IntArray


class Fleet:
    """Live watch over many actuators: `update` takes the next block of all of them.

    `rate` [Hz]; `actuators`: how many, or their names; `alarms_per_hour`: false alarms per actuator and operating hour,
    at most, split evenly over the tests; `window_s`, `step_s` [s]: windows of the RMS that is told (`windows`);
    `decision_s` [s]: what one decision covers, a whole number of windows, best of the duty's cycles; `learn_s` [s]:
    how long an actuator learns; `watched`: the details that are tested, of each of `channels`; `change`: the CUSUM's
    change looked for in standard deviations of a decision, `memory_s`: how far back the likelihood ratio looks for the
    onset, `late_s`: by how much the reference's learning lags, in which time a change should be found.

    Raises InputError for what cannot be: a rate of alarms that no threshold can be set for, windows that do not fit
    into a decision, fewer than 20 decisions to learn from.
    """

    def __init__(
        self,
        rate: float,
        actuators: int | Sequence[str],
        *,
        alarms_per_hour: float = 1e-3,
        window_s: float = 2.0,
        step_s: float | None = None,
        decision_s: float = 10.0,
        learn_s: float = 1200.0,
        watched: Sequence[str] = ("d2", "d3", "d4"),
        channels: Sequence[str] = CHAMBERS,
        levels: int = 4,
        change: float = 1.0,
        memory_s: float = 600.0,
        late_s: float = 100.0,
        threads: int = 1,
    ) -> None:
        if not (isinstance(rate, (int, float)) and 0 < rate < math.inf):
            raise InputError(f"rate must be > 0 Hz, got {rate}")
        self.names = tuple(map(str, range(actuators))) if isinstance(actuators, int) else tuple(map(str, actuators))
        if len(set(self.names)) != len(self.names):
            raise InputError("actuators must have names of their own, got one name twice")
        self.rate, self.channels = float(rate), tuple(channels)
        size = _samples(window_s, rate, "window_s")
        step = size // 2 if step_s is None else _samples(step_s, rate, "step_s")
        if step < 1 or size % step:
            raise InputError(f"window_s must be a whole number of steps, got {size} samples and steps of {step}")
        self._tile = size // step
        self._tiles = round(decision_s * rate / size)
        if self._tiles < 1 or abs(self._tiles * size - decision_s * rate) > 0.5:
            raise InputError(f"decision_s must be a whole number of windows of {window_s} s, got {decision_s} s")
        self._learn = round(learn_s / decision_s)
        if self._learn < 20:
            raise InputError(f"learn_s must be 20 decisions or more, got {learn_s} s at {decision_s} s a decision")
        self._rms = FleetRms(len(self.names), len(self.channels), levels, size=size, step=step, threads=threads)
        self.quantities = self._rms.quantities
        unknown = [one for one in watched if one not in self.quantities[:-1]]
        if unknown or not watched:
            raise InputError(f"watched must be of {', '.join(self.quantities[:-1])}, got {', '.join(unknown) or '-'}")
        self._settings: dict[str, Any] = {
            "rate": self.rate, "alarms_per_hour": float(alarms_per_hour), "window_s": window_s, "step_s": step / rate,
            "decision_s": decision_s, "learn_s": learn_s, "watched": tuple(watched), "channels": self.channels,
            "levels": levels, "change": change, "memory_s": memory_s, "late_s": late_s,
        }  # fmt: skip
        self._rows = [self.quantities.index(one) for one in watched]
        self.series = tuple(f"{one} of {channel}" for channel in self.channels for one in watched)
        if not alarms_per_hour > 0:
            raise InputError(f"alarms_per_hour must be > 0, got {alarms_per_hour}")
        self.alarms_per_hour = float(alarms_per_hour)
        #: Mean number of decisions to a false alarm of one test of one series.
        self.run_length = 3600.0 / (alarms_per_hour * decision_s) * len(self.series) * len(DETECTORS)
        memory = max(1, round(memory_s / decision_s))
        h, b = cusum_threshold(self.run_length, change / 2), glr_threshold(self.run_length, memory)
        self.thresholds = {"CUSUM": h, "likelihood ratio": b}
        self._limits = (h, change / 2, b)
        self._allocate(memory, max(1, round(late_s / decision_s)))

    def _allocate(self, memory: int, late: int) -> None:
        from sealscope.diagnosis.fleet.sequential_tests import NUMBERS

        n, s, shape = len(self.names), len(self.series), (len(self.channels), len(self.quantities), len(self.names))
        self._found = np.empty((1, *shape))
        self.windows = WindowedRms(np.empty(0, dtype=np.int64), self._found[:0])
        self._window, self._decision, self._pooled = 0, 0, 0
        self._pool, self._squares, self._means, self._sums = (np.zeros(shape) for _ in range(4))
        self._means[:] = np.nan
        self._summed = np.zeros((len(self.channels), n), dtype=np.int64)
        self._y = np.empty((s, n))
        self._still = np.zeros((len(self.channels), n), dtype=bool)
        self._lost = np.zeros((len(self.channels), n), dtype=bool)
        self._tests = (
            np.zeros((NUMBERS, s, n)), np.zeros((2, s, n), dtype=np.int64), np.empty((late + 2, s, n)),
            np.zeros((memory + 1, s, n)), np.zeros((s, n), dtype=np.int64), np.zeros((2, s, n)),
            np.full((5, n), -1, dtype=np.int64),
        )  # fmt: skip
        self._scores, self._raised = self._tests[-2:]
        self._alarms = Alarms(
            np.zeros(n, dtype=bool), 0, np.full(n, np.nan), np.full(n, np.nan), self._raised[2], self._raised[3],
            self._raised[4], np.zeros(n), np.zeros(n, dtype=np.int64),
        )  # fmt: skip
        self.relearn()

    def update(self, block: ArrayLike) -> Alarms:
        """Take the next block [Pa], (channels, actuators, samples), NaN where a sample is missing.

        `windows` then holds the RMS that the block completes. Results depend on the samples alone, never on how they
        were cut into blocks. Raises InputError for a wrong shape.
        """
        x = self._rms._details.checked(block)
        count = self._rms.windows(x.shape[-1])
        if count > self._found.shape[0]:
            self._found = np.empty((count, *self._found.shape[1:]))
        self.windows = self._rms.update(x, self._found)
        new = 0
        for rms in self.windows.rms:
            if self._window % self._tile == 0:
                np.multiply(rms, rms, out=self._squares)
                self._pool += self._squares
                self._pooled += 1
                if self._pooled == self._tiles:
                    new += self._decide()
            self._window += 1
        if new or self._alarms.new:
            self._alarms = self._alarms._replace(new=new)
        return self._alarms

    @property
    def alarms(self) -> Alarms:
        """Where the fleet stands since the last block."""
        return self._alarms

    def _decide(self) -> int:
        """Judge the mean squares pooled since the last decision."""
        from sealscope.diagnosis.fleet.sequential_tests import judge

        means, levels = self._means, len(self.quantities) - 2
        np.divide(self._pool, self._tiles, out=means)
        self._pool[:], self._pooled = 0.0, 0
        self._decision += 1
        np.isfinite(means[:, levels], out=self._lost)
        np.logical_not(self._lost, out=self._lost)
        least = np.min(means[:, :levels], axis=1)
        np.less_equal(least, ROUNDING**2 * means[:, -1], out=self._still)
        sound = ~(self._still | self._lost)
        learning = sound & (self._summed <= self._learn)
        np.add(self._sums, means, out=self._sums, where=learning[:, None])
        self._summed += learning
        with np.errstate(divide="ignore", invalid="ignore"):  # a reading that does not move has no logarithm
            y = self._y.reshape(len(self.channels), len(self._rows), -1)
            for row, quantity in enumerate(self._rows):
                np.log(means[:, quantity], out=y[:, row])
        y *= 0.5
        np.copyto(y, np.nan, where=~sound[:, None])
        new = int(judge(self._y, self._decision, self._learn, self._limits, *self._tests))
        self._tell()
        return new

    def _tell(self) -> None:
        """Bring the arrays of `alarms` up to date."""
        from sealscope.diagnosis.fleet.sequential_tests import PAIRS

        told = self._alarms
        np.greater_equal(self._raised[0], 0, out=told.alarm)
        for row, out in ((self._raised[0], told.t), (self._raised[1], told.onset)):
            out[:] = (self._rms._details.first + row * self._tiles * self._rms.size) / self.rate
            out[~told.alarm] = np.nan
        np.max(self._scores, axis=(0, 1), out=told.score)
        learned = np.all(self._tests[0][PAIRS] >= self._learn, axis=0)
        told.status[:] = np.where(learned, WATCHED, LEARNING)
        told.status[np.any(self._still, axis=0)] = STILL
        told.status[np.any(self._lost, axis=0)] = MISSING

    @property
    def change_percent(self) -> Array:
        """RMS of the last decision against the reference learned, (channels, quantities, actuators) [%].

        ``100 (RMS - reference)/reference``, the thesis's diff% with the reference as "no leak"; NaN without one.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(100.0 * (np.sqrt(self._means / (self._sums / self._summed[:, None])) - 1.0))

    def relearn(self, actuators: Iterable[str] | None = None) -> None:
        """Take back alarms and begin to learn anew, for these actuators (all): repaired, or on another duty.

        Raises InputError for a name that the fleet does not have.
        """
        from sealscope.diagnosis.fleet.sequential_tests import forget

        known = {name: i for i, name in enumerate(self.names)}
        wanted = self.names if actuators is None else tuple(actuators)
        missing = [name for name in wanted if name not in known]
        if missing:
            raise InputError(f"actuators must be of this fleet, got {', '.join(map(str, missing))}")
        chosen = np.array([known[name] for name in wanted], dtype=np.int64)
        forget(chosen, *self._tests)
        self._sums[:, :, chosen], self._summed[:, chosen] = 0.0, 0
        self._tell()

    def state(self) -> dict[str, Any]:
        """All that the fleet knows, as plain numbers, words and arrays; `from_state` goes on from it."""
        kept = {name: getattr(self, f"_{name}").copy() for name in _ARRAYS}
        tests = {f"test_{i}": one.copy() for i, one in enumerate(self._tests)}
        counts = {name: getattr(self, f"_{name}") for name in _COUNTS}
        return {"names": self.names, **self._settings, "rms": self._rms.state_dict(), **kept, **tests, **counts}

    @classmethod
    def from_state(cls, state: dict[str, Any], *, threads: int = 1) -> Fleet:
        """The fleet that `state` described, bit for bit; raises InputError for a state that is not one."""
        names = ("names", *_SETTINGS, "rms", *_ARRAYS, *_COUNTS)
        missing = [name for name in names if not isinstance(state, dict) or name not in state]
        if missing:
            raise InputError(f"saved fleet must have {missing[0]!r}, got a state without it")
        settings = {name: state[name] for name in _SETTINGS if name != "rate"}
        fleet = cls(state["rate"], [str(one) for one in state["names"]], **settings, threads=threads)
        fleet._rms.load_state(state["rms"])
        for name in _ARRAYS:
            own = getattr(fleet, f"_{name}")
            own[...] = saved_array(state, name, own.shape, own.dtype)
        for i, own in enumerate(fleet._tests):
            own[...] = saved_array(state, f"test_{i}", own.shape, own.dtype)
        for name in _COUNTS:
            setattr(fleet, f"_{name}", int(state[name]))
        fleet._tell()
        return fleet


_SETTINGS = (
    "rate", "alarms_per_hour", "window_s", "step_s", "decision_s", "learn_s", "watched", "channels", "levels",
    "change", "memory_s", "late_s",
)  # fmt: skip
_ARRAYS = ("pool", "means", "sums", "summed", "still", "lost")
_COUNTS = ("window", "decision", "pooled")


def _samples(seconds: float, rate: float, name: str) -> int:
    samples = seconds * rate
    if not (samples >= 1 and abs(samples - round(samples)) < 1e-6 * samples):
        raise InputError(f"{name} must be a whole number of samples at {rate:g} Hz, got {seconds} s")
    return round(samples)
