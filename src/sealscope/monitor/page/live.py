"""The last seconds of the actuators that somebody looks at, as the page draws them; of the others nothing is kept."""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.diagnosis.live.joining import CHANNELS, follow, same_rate
from sealscope.errors import InputError
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import Details, details, shortest
from sealscope.signals.windows import WINDOW_SIZE, windowed_rms
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: What is kept of an actuator: the last seconds, and at slow rates enough for the details; at most so many samples, and
#: of so many actuators at a time.
SPAN_S, FEWEST_SAMPLES, MOST_SAMPLES, MOST_ACTUATORS = 20.0, 2500, 20_000, 20
#: What of it is drawn: bins of a chart, each with its least and its largest value; samples a second of the motion, and
#: how many of its last seconds.
_BINS, _MOTION_HZ, _MOTION_S = 400, 20.0, 8.0
#: Windows of the RMS are so many samples apart.
_RMS_STEP = 100
_BAR, _MILLIMETRE, _KILOPASCAL = 1e5, 1e-3, 1e3
#: What may be drawn of the details of a pressure.
DRAWN = ("rms", "details")
PRESSURES = ("p_A", "p_B")


@dataclass
class _Window:
    """The last samples without a hole; the arrays are replaced, never written to."""

    rate: float = 0.0
    t: Array = field(default_factory=lambda: np.empty(0))
    channels: dict[str, Array] = field(default_factory=dict)
    version: int = 0

    def add(self, samples: Recording) -> None:
        """Take the next samples; after a hole, at another rate or with other channels they begin anew."""
        most = min(MOST_SAMPLES, max(FEWEST_SAMPLES, round(SPAN_S * samples.rate)))
        t = samples.t[-most:]
        names = [name for name in CHANNELS if name in samples]
        if not names or not t.size or not np.isfinite(t).all():
            return
        if self.t.size and self.t[0] <= t[0] and t[-1] <= self.t[-1]:
            return  # repeated
        same_layout = self.t.size > 0 and [*self.channels] == names and same_rate(samples.rate, self.rate)
        if not (same_layout and follow(t[0] - self.t[-1], samples.rate)):
            self.t, self.channels = np.empty(0), {name: np.empty(0) for name in names}
        self.rate = samples.rate
        self.t = np.concatenate([self.t, t])[-most:]
        self.channels = {
            name: np.concatenate([values, samples[name][-most:]])[-most:] for name, values in self.channels.items()
        }
        self.version += 1


class LiveSamples:
    """The last seconds of the actuators that are looked at.

    `recall`: returns the last samples of an actuator that are stored, for who begins to look.
    """

    def __init__(self, recall: Callable[[str], Sequence[Recording]] = lambda name: ()) -> None:
        self._recall = recall
        self._windows: dict[str, _Window] = {}
        self._lookers = Counter[str]()
        self._lock = threading.Lock()

    @contextmanager
    def looked_at(self, name: str) -> Iterator[bool]:
        """Keep the samples of an actuator meanwhile; False where too many others are looked at."""
        with self._lock:
            first = name not in self._windows
            admitted = not first or len(self._windows) < MOST_ACTUATORS
            if admitted:
                self._lookers[name] += 1
                window = self._windows.setdefault(name, _Window())
        if not admitted:
            yield False
            return
        try:
            if first:
                with suppress(Exception):  # what comes from now on is shown without what is stored
                    stored = self._recall(name)
                    with self._lock:
                        if not window.version:  # else newer samples have come meanwhile
                            for samples in stored:
                                window.add(samples)
            yield True
        finally:
            with self._lock:
                self._lookers[name] -= 1
                if not self._lookers[name]:
                    del self._lookers[name], self._windows[name]

    def take(self, name: str, samples: Recording | None) -> None:
        """Add new samples of an actuator to its window, if anybody views it."""
        if samples is None or name not in self._windows:
            return
        with self._lock:
            window = self._windows.get(name)
            if window is not None:
                window.add(samples)

    @property
    def watched(self) -> frozenset[str]:
        """The actuators that somebody looks at."""
        return frozenset(self._windows)

    def version(self, name: str) -> int:
        """Return a number that changes with the samples of a viewed actuator, 0 if there are none."""
        window = self._windows.get(name)
        return 0 if window is None else window.version

    def picture(self, name: str, pressure: str = "p_A", drawn: str = "rms") -> dict[str, Any]:
        """Return the curves of a viewed actuator as plain values; times end at 0 [s].

        `pressures` [bar]; `details`, d1 to d4 of one `pressure` [kPa]: their RMS over `WINDOW_SIZE` samples, or they
        themselves; `motion`: position [mm], pressures [bar], piston's speed [mm/s] and the pump's [rpm]. A value that
        is missing is None.
        """
        with self._lock:
            window = self._windows.get(name) or _Window()
            t, channels, rate = window.t, window.channels, window.rate
        if not t.size:
            return {"name": name, "t": None}
        past = t - t[-1]
        with np.errstate(all="ignore"):  # whatever comes from the wire, what overflows is not drawn
            shown = {channel: channels[channel] / _BAR for channel in PRESSURES if channel in channels}
            return {
                "name": name,
                "t": float(t[-1]),
                "rate": rate,
                "channels": [*channels],
                "pressures": _envelope(past, shown),
                "details": _details_of(past, channels.get(pressure), pressure, drawn),
                "motion": _motion_of(past, channels, rate),
            }


def _plain(values: Array, digits: int = 3) -> list[float | None]:
    """Round numbers to so many decimals, with None for those not finite."""
    rounded = np.round(values, digits)
    return [value if math.isfinite(value) else None for value in rounded.tolist()]


def _envelope(t: Array, series: dict[str, Array]) -> dict[str, list[float | None]]:
    """Return series over t, each bin's least and largest value in their order where there are more than two a bin."""
    size = -(-t.size // _BINS)
    if size <= 2:
        return {"t": _plain(t, 4), **{name: _plain(values) for name, values in series.items()}}
    count = t.size // size
    bins = {name: values[t.size - count * size :].reshape(count, size) for name, values in {**series, "t": t}.items()}
    drawn = {"t": _plain(bins.pop("t")[:, [0, size // 2]].ravel(), 4)}
    for name, values in bins.items():
        ends = np.stack([values.min(axis=1), values.max(axis=1)], axis=1)
        rising = (values.argmin(axis=1) < values.argmax(axis=1))[:, None]
        drawn[name] = _plain(np.where(rising, ends, ends[:, ::-1]).ravel())
    return drawn


def _details_of(t: Array, signal: Array | None, pressure: str, drawn: str) -> dict[str, Any]:
    """Return details of a pressure or their RMS over windows, of the samples since the last missing one."""
    known = np.empty(0) if signal is None else signal / _KILOPASCAL
    missing = np.flatnonzero(~np.isfinite(known))
    known = known[missing[-1] + 1 if missing.size else 0 :]
    shown: dict[str, Any] = {"of": pressure, "drawn": drawn, "needs": shortest() + WINDOW_SIZE - 1}
    if known.size < shown["needs"]:
        return {**shown, "t": [], "has": int(known.size)}
    t = t[-known.size :]
    try:
        measurement: Details = details(known)
        windows = windowed_rms(measurement, step=_RMS_STEP)
    except InputError:  # beyond floating point
        return {**shown, "t": [], "has": 0}
    if drawn == "details":
        inside = measurement.inside()
        return {**shown, **_envelope(t[inside], {f"d{j + 1}": row[inside] for j, row in enumerate(measurement.values)})}
    rows = {f"d{j + 1}": _plain(row, 4) for j, row in enumerate(windows.rms)}
    return {**shown, "t": _plain(t[windows.ends - 1], 4), **rows}


def _motion_of(t: Array, channels: dict[str, Array], rate: float) -> dict[str, Any]:
    """Compute short-time means of the position, pressures and pump, and the speeds between them."""
    size = max(1, round(rate / _MOTION_HZ))
    count = min(t.size // size, round(_MOTION_S * rate / size))
    if count < 2:
        return {"t": []}

    def means(values: Array) -> Array:
        return np.asarray(values[values.size - count * size :].reshape(count, size).mean(axis=1))

    times = means(t)
    moved = {name: means(channels[name]) for name in channels}
    shown: dict[str, Any] = {"t": _plain(times, 4)}
    for name in ("p_A", "p_B", "p_1", "p_2"):
        if name in moved:
            shown[name] = _plain(moved[name] / _BAR)
    if "x" in moved:
        shown["x"] = _plain(moved["x"] / _MILLIMETRE)
        shown["v"] = _plain(np.gradient(moved["x"], times) / _MILLIMETRE)
    if "omega" in moved or "theta" in moved:
        speed = moved["omega"] if "omega" in moved else np.gradient(moved["theta"], times)
        shown["rpm"] = _plain(speed * 30.0 / np.pi, 1)
    return shown


@cache
def machine_of(rig: str) -> dict[str, Any]:
    """Return the drawn parts of a rig as plain values.

    `rods`: the sides that the rod leaves; `stroke` [mm]; `area` [L/min per mm/s] and `displacement` [L/rev] give flows;
    `valve`: whether a servo valve drives it.
    """
    from sealscope.diagnosis.commissioned.watched import load_watched
    from sealscope.reporting.schematic import circuit_of

    known: Rig = load_watched(rig).rig
    circuit = circuit_of(known, ())
    return {
        "title": known.title,
        "rods": circuit.rods,
        "valve": circuit.valve,
        "stroke": known.cylinder.L / _MILLIMETRE,
        "area": 0.5 * (known.cylinder.A_A + known.cylinder.A_B) * _MILLIMETRE / LITRE_PER_MINUTE,
        "displacement": known.pump.q_b * 1e3,
    }
