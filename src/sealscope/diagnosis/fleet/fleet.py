"""Live monitoring of a fleet: details, the thesis's windowed RMS and sequential tests over many actuators at once.

Each actuator is compared with itself: CUSUM and generalised likelihood ratio on the change of its details' log RMS
against a reference that it learns at the beginning (`sequential_tests`), with thresholds from a stated rate of false
alarms per actuator and operating hour. The duty must be the same throughout; a change of duty is a change.
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
from sealscope.signals.filters import Array, IntArray, saved_array, saved_count, saved_part
from sealscope.signals.streams import FleetRms
from sealscope.signals.windows import WindowedRms

#: What an actuator does: it learns its reference, is watched, or pauses: a sample is missing, a reading does not move.
LEARNING, WATCHED, MISSING, STILL = range(4)
STATUS = ("learning", "watched", "paused: missing samples", "paused: a reading does not move")
DETECTORS = ("CUSUM", "likelihood ratio")


class Alarms(NamedTuple):
    """Alarms of a fleet; arrays (actuators,), valid until the next update and written to by it.

    Attributes
    ----------
    alarm : ndarray of bool
        Raised and not taken back.
    new : int
        How many alarms the last block raised.
    t, onset : ndarray of float
        When the alarm was raised, and the moment after which the change began [s]; NaN without an alarm.
    series, direction, detector : ndarray of int
        Of the test that raised the alarm: index into `Fleet.series`, +1 for a rise and -1 for a fall, and index into
        `DETECTORS`.
    score : ndarray of float
        The largest statistic over its threshold now.
    status : ndarray of int
        Index into `STATUS`.
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
    """Live monitoring of many actuators by the RMS of their pressures' wavelet details.

    Parameters
    ----------
    rate : float
        Sampling rate [Hz].
    actuators : int or sequence of str
        How many actuators, or their names.
    alarms_per_hour : float, default 1e-3
        False alarms per actuator and operating hour, at most, split evenly over the tests.
    window_s, step_s : float
        Windows of the RMS in `windows` [s]; `step_s` is half of `window_s` by default.
    decision_s : float, default 10
        What one decision covers [s]: a whole number of windows, best of the duty's cycles.
    learn_s : float, default 1200
        How long an actuator learns its reference [s].
    watched : sequence of str
        The details that are tested, of each channel.
    channels : sequence of str
        Names of the signals of an actuator.
    levels : int, default 4
        Levels of the wavelet transform.
    change : float, default 1
        The change that the CUSUM looks for, in standard deviations of a decision.
    memory_s : float, default 600
        How far back the likelihood ratio looks for the onset [s].
    late_s : float, default 100
        By how much the reference's learning lags [s], in which time a change should be found.
    threads : int, default 1
        Threads that share the actuators; no bit depends on it.

    Attributes
    ----------
    names, series : tuple of str
        The actuators, and the series of each that are tested, such as "d3 of p_A".
    windows : WindowedRms
        RMS (w, channels, quantities, actuators) of the windows that the last block completed; `quantities` names its
        third axis.
    thresholds : dict
        Threshold of each of `DETECTORS`.

    Raises
    ------
    InputError
        For settings that contradict each other: a rate of alarms for which no threshold can be set, windows that do not
        fit into a decision, fewer than 20 decisions to learn from.

    Examples
    --------
    >>> import numpy as np
    >>> import sealscope as ss
    >>> fleet = ss.Fleet(500.0, ["press 1", "press 2"])
    >>> pressures = np.random.default_rng(0).normal(3e5, 1e4, size=(2, 2, 5000))  # p_A and p_B, 10 s
    >>> alarms = fleet.update(pressures)
    >>> alarms.alarm.tolist(), ss.Fleet.status_text(alarms)
    ([False, False], ['learning', 'learning'])
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
        self.rate = _positive(rate, "rate", " Hz")
        self.alarms_per_hour = _positive(alarms_per_hour, "alarms_per_hour")
        if isinstance(actuators, int | np.integer) and not isinstance(actuators, bool):
            actuators = [str(number) for number in range(actuators)]
        self.names = _names(actuators, "actuators")
        self.channels, watched = _names(channels, "channels"), _names(watched, "watched")
        size = _samples(window_s, self.rate, "window_s")
        step = size // 2 if step_s is None else _samples(step_s, self.rate, "step_s")
        if step < 1 or size % step:
            raise InputError(f"window_s must be a whole number of steps, got {size} samples and steps of {step}")
        self._tile = size // step
        decision = _positive(decision_s, "decision_s", " s") * self.rate
        self._tiles = round(decision / size)
        if self._tiles < 1 or abs(self._tiles * size - decision) > 0.5:
            raise InputError(f"decision_s must be a whole number of windows of {window_s} s, got {decision_s} s")
        self._learn = round(_positive(learn_s, "learn_s", " s") / decision_s)
        if self._learn < 20:
            raise InputError(f"learn_s must be 20 decisions or more, got {learn_s} s at {decision_s} s a decision")
        self._rms = FleetRms(len(self.names), len(self.channels), levels, size=size, step=step, threads=threads)
        self.quantities = self._rms.quantities
        unknown = [name for name in watched if name not in self.quantities[:-1]]
        if unknown or not watched:
            raise InputError(f"watched must be of {', '.join(self.quantities[:-1])}, got {', '.join(unknown) or '-'}")
        self._settings: dict[str, Any] = {
            "rate": self.rate, "alarms_per_hour": self.alarms_per_hour, "window_s": window_s, "step_s": step / rate,
            "decision_s": decision_s, "learn_s": learn_s, "watched": watched, "channels": self.channels,
            "levels": levels, "change": _positive(change, "change"), "memory_s": _positive(memory_s, "memory_s", " s"),
            "late_s": _positive(late_s, "late_s", " s"),
        }  # fmt: skip
        self._rows = [self.quantities.index(name) for name in watched]
        self.series = tuple(f"{name} of {channel}" for channel in self.channels for name in watched)
        #: Mean number of decisions to a false alarm of one test of one series.
        self.run_length = 3600.0 / (self.alarms_per_hour * decision_s) * len(self.series) * len(DETECTORS)
        memory = max(1, round(memory_s / decision_s))
        h, b = cusum_threshold(self.run_length, change / 2), glr_threshold(self.run_length, memory)
        self.thresholds = {"CUSUM": h, "likelihood ratio": b}
        self._limits = (h, change / 2, b)
        self._allocate(memory, max(1, round(late_s / decision_s)))

    def _allocate(self, memory: int, late: int) -> None:
        from sealscope.diagnosis.fleet.sequential_tests import NUMBERS

        n, s, shape = len(self.names), len(self.series), (len(self.channels), len(self.quantities), len(self.names))
        self._block_rms = np.empty((1, *shape))
        self.windows = WindowedRms(np.empty(0, dtype=np.int64), self._block_rms[:0])
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
        """Take the next block of all actuators.

        Results depend on the samples alone, never on how they were cut into blocks.

        Parameters
        ----------
        block : array_like
            Pressures (channels, actuators, n) [Pa], NaN where a sample is missing.

        Returns
        -------
        Alarms
            The alarms since then; `windows` holds the RMS that the block completes.

        Raises
        ------
        InputError
            For a block of another shape.
        """
        x = self._rms.details.checked(block)
        count = self._rms.windows(x.shape[-1])
        if count > self._block_rms.shape[0]:
            self._block_rms = np.empty((count, *self._block_rms.shape[1:]))
        self.windows = self._rms.update(x, self._block_rms)
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
        """Alarms since the last block."""
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
        healthy = ~(self._still | self._lost)
        learning = healthy & (self._summed <= self._learn)
        np.add(self._sums, means, out=self._sums, where=learning[:, None])
        self._summed += learning
        with np.errstate(divide="ignore", invalid="ignore"):  # a reading that does not move has no logarithm
            y = self._y.reshape(len(self.channels), len(self._rows), -1)
            for row, quantity in enumerate(self._rows):
                np.log(means[:, quantity], out=y[:, row])
        y *= 0.5
        np.copyto(y, np.nan, where=~healthy[:, None])
        new = int(judge(self._y, self._decision, self._learn, self._limits, *self._tests))
        self._refresh()
        return new

    def _refresh(self) -> None:
        """Bring the arrays of `alarms` up to date."""
        from sealscope.diagnosis.fleet.sequential_tests import PAIRS

        alarms = self._alarms
        np.greater_equal(self._raised[0], 0, out=alarms.alarm)
        for row, out in ((self._raised[0], alarms.t), (self._raised[1], alarms.onset)):
            out[:] = (self._rms.details.first + row * self._tiles * self._rms.size) / self.rate
            out[~alarms.alarm] = np.nan
        np.max(self._scores, axis=(0, 1), out=alarms.score)
        learned = np.all(self._tests[0][PAIRS] >= self._learn, axis=0)
        alarms.status[:] = np.where(learned, WATCHED, LEARNING)
        alarms.status[np.any(self._still, axis=0)] = STILL
        alarms.status[np.any(self._lost, axis=0)] = MISSING

    @staticmethod
    def status_text(alarms: Alarms) -> list[str]:
        """Return the status of each actuator in words."""
        return [STATUS[number] for number in alarms.status]

    @property
    def change_percent(self) -> Array:
        """RMS of the last decision against the reference learned, (channels, quantities, actuators) [%].

        ``100 (RMS - reference)/reference``, the thesis's diff% with the reference as "no leak"; NaN without one.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(100.0 * (np.sqrt(self._means / (self._sums / self._summed[:, None])) - 1.0))

    def relearn(self, actuators: Iterable[str] | None = None) -> None:
        """Take back alarms and begin to learn anew: an actuator was repaired, or has another duty.

        Parameters
        ----------
        actuators : iterable of str, optional
            Names of actuators, all by default.

        Raises
        ------
        InputError
            For anything that is not a list of names of this fleet.
        """
        from sealscope.diagnosis.fleet.sequential_tests import forget

        known = {name: i for i, name in enumerate(self.names)}
        wanted = self.names if actuators is None else _names(actuators, "actuators")
        missing = [name for name in wanted if name not in known]
        if missing:
            raise InputError(f"actuators must be of this fleet, got {', '.join(missing)}")
        chosen = np.array([known[name] for name in wanted], dtype=np.int64)
        forget(chosen, *self._tests)
        self._sums[:, :, chosen], self._summed[:, chosen] = 0.0, 0
        self._refresh()

    def state_dict(self) -> dict[str, Any]:
        """Return all that the fleet knows, as plain numbers, texts and arrays; `from_state` continues from it."""
        arrays = {name: getattr(self, f"_{name}").copy() for name in _ARRAYS}
        tests = {f"test_{i}": values.copy() for i, values in enumerate(self._tests)}
        counts = {name: getattr(self, f"_{name}") for name in _COUNTS}
        return {"names": self.names, **self._settings, "rms": self._rms.state_dict(), **arrays, **tests, **counts}

    @classmethod
    def from_state(cls, state: dict[str, Any], *, threads: int = 1) -> Fleet:
        """Return the fleet that `state_dict` described, bit for bit.

        Parameters
        ----------
        state : dict
            What `state_dict` returned.
        threads : int, default 1
            Threads that share the actuators.

        Raises
        ------
        InputError
            For a state that is not one: a part that is missing or of another type, shape or range.
        """
        settings = {name: saved_part(state, name, _WHAT) for name in ("names", *_SETTINGS)}
        rate, names = settings.pop("rate"), _names(settings.pop("names"), f"saved {_WHAT}'s names")
        fleet = cls(rate, names, **settings, threads=threads)
        fleet._rms.load_state(saved_part(state, "rms", _WHAT))
        own = {f"test_{i}": values for i, values in enumerate(fleet._tests)}
        for name, values in (own | {name: getattr(fleet, f"_{name}") for name in _ARRAYS}).items():
            values[...] = saved_array(state, name, values.shape, _WHAT, values.dtype)
        for name in _COUNTS:
            setattr(fleet, f"_{name}", saved_count(state, name, _WHAT))
        if fleet._pooled >= fleet._tiles:
            raise InputError(f"saved fleet's pooled must be less than {fleet._tiles} windows, got {fleet._pooled}")
        fleet._refresh()
        return fleet


_WHAT = "fleet"
_SETTINGS = (
    "rate", "alarms_per_hour", "window_s", "step_s", "decision_s", "learn_s", "watched", "channels", "levels",
    "change", "memory_s", "late_s",
)  # fmt: skip
_ARRAYS = ("pool", "means", "sums", "summed", "still", "lost")
_COUNTS = ("window", "decision", "pooled")


def _positive(value: object, name: str, unit: str = "") -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 0 < value < math.inf:
        raise InputError(f"{name} must be > 0{unit}, got {value!r}")
    return float(value)


def _names(values: object, name: str) -> tuple[str, ...]:
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise InputError(f"{name} must be a list of names, got {values!r}")
    names = tuple(values)
    if strange := [value for value in names if not isinstance(value, str)]:
        raise InputError(f"{name} must be names, got {strange[0]!r}")
    if len(set(names)) != len(names):
        raise InputError(f"{name} must have names of their own, got one name twice")
    return names


def _samples(seconds: float, rate: float, name: str) -> int:
    samples = _positive(seconds, name, " s") * rate
    if not (samples >= 1 and abs(samples - round(samples)) < 1e-6 * samples):
        raise InputError(f"{name} must be a whole number of samples at {rate:g} Hz, got {seconds} s")
    return round(samples)
