"""The last seconds of samples of the actuators that somebody views on the page, and their curves."""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from sealscope.diagnosis.commissioned.watched import load_watched
from sealscope.diagnosis.live.joining import CHANNELS, are_successive, is_same_rate
from sealscope.errors import InputError
from sealscope.recordings.recording import Array, Recording
from sealscope.reporting.schematic import build_circuit
from sealscope.signals.details import Details, details, min_samples
from sealscope.signals.windows import WINDOW_SIZE, windowed_rms
from sealscope.units import LITRE_PER_MINUTE

#: Samples kept of a viewed actuator: those of the last `SPAN_S` seconds, but at least `MIN_SAMPLES`, which the wavelet
#: details need, and at most `MAX_SAMPLES`.
SPAN_S, MIN_SAMPLES, MAX_SAMPLES = 20.0, 2500, 20_000
#: Most actuators that are viewed at a time.
MAX_ACTUATORS = 20
#: Bins of a chart, each with its minimum and maximum; rate of the drawn motion [Hz], and its length [s].
_BINS, _MOTION_HZ, _MOTION_S = 400, 20.0, 8.0
#: Samples between two windows of the RMS.
_RMS_STEP = 100
_BAR, _MILLIMETRE, _KILOPASCAL = 1e5, 1e-3, 1e3
#: Forms in which the details of a pressure may be drawn.
DETAIL_FORMS = ("rms", "details")
PRESSURES = ("p_A", "p_B")


@dataclass
class _Window:
    """The last samples of an actuator without a gap; no array is changed after it is set, so readers need no copy."""

    rate: float = 0.0  # sampling rate [Hz]
    t: Array = field(default_factory=lambda: np.empty(0))  # times (n,) [s]
    channels: dict[str, Array] = field(default_factory=dict)  # samples (n,)
    version: int = 0  # number of blocks added

    def add(self, samples: Recording) -> None:
        """Append samples to the window; start anew after a gap, or if the sampling rate or the channels change.

        Samples are ignored if they are in the window already, have no channels, or have times that are not finite.
        """
        max_samples = min(MAX_SAMPLES, max(MIN_SAMPLES, round(SPAN_S * samples.rate)))
        t = samples.t[-max_samples:]
        names = [name for name in CHANNELS if name in samples]
        if not names or not t.size or not np.isfinite(t).all():
            return
        if self.t.size and self.t[0] <= t[0] and t[-1] <= self.t[-1]:
            return  # the block was sent again
        same_layout = self.t.size > 0 and [*self.channels] == names and is_same_rate(samples.rate, self.rate)
        if not (same_layout and are_successive(t[0] - self.t[-1], samples.rate)):
            self.t, self.channels = np.empty(0), {name: np.empty(0) for name in names}
        self.rate = samples.rate
        self.t = np.concatenate([self.t, t])[-max_samples:]
        self.channels = {
            name: np.concatenate([values, samples[name][-max_samples:]])[-max_samples:]
            for name, values in self.channels.items()
        }
        self.version += 1


class LiveSamples:
    """The last samples of the viewed actuators.

    `recall`: function that returns the stored samples of an actuator, which are shown until new ones arrive.
    """

    def __init__(self, recall: Callable[[str], Sequence[Recording]] = lambda name: ()) -> None:
        self._recall = recall
        self._windows: dict[str, _Window] = {}
        self._n_viewers = Counter[str]()
        self._lock = threading.Lock()

    @contextmanager
    def viewing(self, name: str) -> Iterator[bool]:
        """Keep the samples of the actuator `name` while the context lasts, and yield True.

        If too many other actuators are viewed, nothing is kept, and False is yielded.
        """
        with self._lock:
            is_first = name not in self._windows
            is_admitted = not is_first or len(self._windows) < MAX_ACTUATORS
            if is_admitted:
                self._n_viewers[name] += 1
                window = self._windows.setdefault(name, _Window())
        if not is_admitted:
            yield False
            return
        try:
            if is_first:
                with suppress(Exception):  # without stored samples the window fills with new ones
                    stored = self._recall(name)
                    with self._lock:
                        if not window.version:  # else newer samples have arrived meanwhile
                            for samples in stored:
                                window.add(samples)
            yield True
        finally:
            with self._lock:
                self._n_viewers[name] -= 1
                if not self._n_viewers[name]:
                    del self._n_viewers[name], self._windows[name]

    def push(self, name: str, samples: Recording | None) -> None:
        """Add new samples of an actuator to its window, if anybody views the actuator; do nothing for None."""
        if samples is None or name not in self._windows:
            return
        with self._lock:
            window = self._windows.get(name)
            if window is not None:
                window.add(samples)

    def version(self, name: str) -> int:
        """Return a number that increases when a viewed actuator gets samples, 0 for other actuators."""
        window = self._windows.get(name)
        return 0 if window is None else window.version

    def curves(self, name: str, pressure: str = "p_A", detail_form: str = "rms") -> dict[str, Any]:
        """Compute the curves that the page draws of a viewed actuator, as plain values for JSON.

        `pressure`: channel whose wavelet details are computed; `detail_form`: "details", or "rms" for their RMS in
        windows of `WINDOW_SIZE` samples. Numbers that are not finite become None, and curves that are not recorded are
        left out. The times of the curves are relative to `t`, that of the last sample [s] (None without samples).
        """
        with self._lock:
            window = self._windows.get(name) or _Window()
            t, channels, rate = window.t, window.channels, window.rate
        if not t.size:
            return {"name": name, "t": None}
        relative_t = t - t[-1]
        with np.errstate(all="ignore"):  # samples may have any value; overflows become gaps
            pressures_bar = {channel: channels[channel] / _BAR for channel in PRESSURES if channel in channels}
            return {
                "name": name,
                "t": float(t[-1]),
                "rate": rate,
                "channels": [*channels],
                "pressures": _envelope(relative_t, pressures_bar),
                "details": _detail_curves(relative_t, channels.get(pressure), pressure, detail_form),
                "motion": _motion_curves(relative_t, channels, rate),
            }


def _round_to_json(values: Array, digits: int = 3) -> list[float | None]:
    """Round an array (n,) to `digits` decimals, and list its numbers, with None for those that are not finite."""
    rounded_values = np.round(values, digits)
    return [value if math.isfinite(value) else None for value in rounded_values.tolist()]


def _envelope(t: Array, series: dict[str, Array]) -> dict[str, list[float | None]]:
    """Reduce series of samples (n,) at times `t` (n,) [s] to the minimum and maximum in each bin, for a chart.

    A bin is a group of successive samples; there are at most `_BINS`, of equal size. Series that would have at most two
    samples per bin are not reduced. Returns lists of rounded numbers: "t" with the times of each bin's first and middle
    sample, and by name each bin's minimum and maximum, in the order in which they occur.
    """
    bin_size = -(-t.size // _BINS)  # rounded up
    if bin_size <= 2:
        return {"t": _round_to_json(t, 4), **{name: _round_to_json(values) for name, values in series.items()}}
    n_bins = t.size // bin_size
    first = t.size - n_bins * bin_size  # the samples before do not fill a bin
    bin_times = t[first:].reshape(n_bins, bin_size)[:, [0, bin_size // 2]]  # of the first and middle samples
    curves = {"t": _round_to_json(bin_times.ravel(), 4)}
    for name, values in series.items():
        bins = values[first:].reshape(n_bins, bin_size)
        ends = np.stack([bins.min(axis=1), bins.max(axis=1)], axis=1)
        is_rising = (bins.argmin(axis=1) < bins.argmax(axis=1))[:, None]  # the minimum occurs first
        curves[name] = _round_to_json(np.where(is_rising, ends, ends[:, ::-1]).ravel())
    return curves


def _detail_curves(t: Array, signal: Array | None, pressure: str, detail_form: str) -> dict[str, Any]:
    """Compute the curves of the wavelet details [kPa] of a pressure, or of their RMS, as plain values.

    `signal` (n,) [Pa]: the pressure, None if it is not recorded; `pressure`: its name; `detail_form`: "details" or
    "rms". Only the samples after the last missing one are used. If there are fewer (`has` in the result) than needed
    (`needs`), or if numbers overflow, there are no curves, and "t" is empty.
    """
    samples = np.empty(0) if signal is None else signal / _KILOPASCAL
    missing_indices = np.flatnonzero(~np.isfinite(samples))
    first = missing_indices[-1] + 1 if missing_indices.size else 0
    samples = samples[first:]
    # `needs`: one window of samples whose details do not depend on padding at the ends of the signal
    header: dict[str, Any] = {"of": pressure, "drawn": detail_form, "needs": min_samples() + WINDOW_SIZE - 1}
    if samples.size < header["needs"]:
        return {**header, "t": [], "has": int(samples.size)}
    t = t[-samples.size :]
    try:
        transform: Details = details(samples)
        windows = windowed_rms(transform, step=_RMS_STEP)  # refuses details that overflow, in either form
    except InputError:
        return {**header, "t": [], "has": 0}  # overflowing samples count as none
    if detail_form == "details":
        inside = transform.inside()  # without the samples that depend on padding
        series = {f"d{level}": row[inside] for level, row in enumerate(transform.values, 1)}
        return {**header, **_envelope(t[inside], series)}
    rows = {f"d{level}": _round_to_json(row, 4) for level, row in enumerate(windows.rms, 1)}
    return {**header, "t": _round_to_json(t[windows.ends - 1], 4), **rows}  # at the last sample of each window


def _motion_curves(t: Array, channels: dict[str, Array], rate: float) -> dict[str, Any]:
    """Compute the curves of motion: pressures [bar], position [mm], speeds of piston [mm/s] and pump [rpm].

    The last `_MOTION_S` seconds of the channels (n,) in SI units are averaged over groups of successive samples, about
    1/`_MOTION_HZ` s or one sample long. Returns only an empty "t" if there are fewer than two groups.
    """
    bin_size = max(1, round(rate / _MOTION_HZ))
    n_bins = min(t.size // bin_size, round(_MOTION_S * rate / bin_size))
    if n_bins < 2:  # too few for a speed
        return {"t": []}

    def bin_means(values: Array) -> Array:
        return np.asarray(values[values.size - n_bins * bin_size :].reshape(n_bins, bin_size).mean(axis=1))

    times = bin_means(t)
    averages = {name: bin_means(values) for name, values in channels.items()}
    curves: dict[str, Any] = {"t": _round_to_json(times, 4)}
    for name in ("p_A", "p_B", "p_1", "p_2"):
        if name in averages:
            curves[name] = _round_to_json(averages[name] / _BAR)
    if "x" in averages:
        curves["x"] = _round_to_json(averages["x"] / _MILLIMETRE)
        curves["v"] = _round_to_json(np.gradient(averages["x"], times) / _MILLIMETRE)
    if "omega" in averages or "theta" in averages:
        speed = averages["omega"] if "omega" in averages else np.gradient(averages["theta"], times)
        curves["rpm"] = _round_to_json(speed * 30.0 / np.pi, 1)  # from [rad/s]
    return curves


@cache
def describe_rig(rig: str) -> dict[str, Any]:
    """Describe the parts of a rig that the page draws, as plain values by name.

    `rig`: name of a packaged rig, or path of a rig's or machine's file. `rods`: sides of the cylinder at which a rod
    leaves it; `valve`: True if a servo valve drives the cylinder; `stroke` [mm]; `area`: mean piston area, as flow per
    speed [L/min per mm/s]; `displacement` of the pump [L/rev].
    """
    loaded_rig = load_watched(rig).rig
    circuit = build_circuit(loaded_rig, ())
    return {
        "title": loaded_rig.title,
        "rods": circuit.rods,
        "valve": circuit.valve,
        "stroke": loaded_rig.cylinder.L / _MILLIMETRE,
        "area": 0.5 * (loaded_rig.cylinder.A_A + loaded_rig.cylinder.A_B) * _MILLIMETRE / LITRE_PER_MINUTE,
        "displacement": loaded_rig.pump.q_b * 1e3,  # from m^3 to L
    }
