"""The Recording: time series with names, units, a sampling rate and a history, on which the whole project is built.

A Recording is what a rig's data logger would have written. Only its provenance states where it comes from (a simulator,
a file, a stream); the truth of a simulation is never part of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import wraps
from html import escape
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sealscope.calls import checked_call
from sealscope.errors import InputError, MissingExtra, UnreadableFile
from sealscope.paragraphs import format_count
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS, DISPLAY_UNITS, LONG_NAMES, Array
from sealscope.recordings.formats.columns import ChannelMap, Request
from sealscope.recordings.formats.headings.preamble import collect_remarks
from sealscope.storage.opening import raising_unreadable
from sealscope.units import from_si

if TYPE_CHECKING:
    import pandas
    import xarray

    from sealscope.recordings.formats.table import RecordingFields

__all__ = ["CHANNEL_UNITS", "COUNTS", "Array", "Recording", "compute_once", "keep_with_recording", "make_recording"]

_T = TypeVar("_T")
#: Unit of a channel -> unit in which it is drawn if its log states none.
_PLOT_UNITS = {"m": "mm", "rad/s": "rpm", "m^3/s": "L/min", "K": "degC"}


def _freeze(values: Any) -> Array:
    """Convert values to a read-only array of doubles; copy them unless they are such an array that owns its memory."""
    if type(values) is np.ndarray and values.dtype == np.float64 and values.base is None and not values.flags.writeable:
        return values
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Channels sampled on one time base.

    A recording is immutable: arrays are copied and read-only, and methods that cut or select return a new recording.
    ``recording["p_A"]`` is a channel, ``"p_A" in recording`` tests for it, ``len(recording)`` is the number of samples.

    Parameters
    ----------
    t : array_like of float, shape (n,)
        Time [s].
    channels : mapping of str to array_like of float, shape (n,)
        Values of each channel, NaN where a sample is missing. The names are those of `CHANNEL_UNITS`, such as ``x``,
        ``p_A`` and ``p_B``.
    units : mapping of str to str
        Unit of each channel: the SI unit of `CHANNEL_UNITS`, or ``count`` for raw counts of a converter.
    rate : float
        Nominal sampling rate [Hz].
    provenance : mapping of str to JSON value, optional
        Where the data come from.
    history : tuple of str, optional
        One line for each processing step.
    bridged : array_like of bool, shape (n,), optional
        Rows whose missing values were filled in (`recordings.corrections.gaps`); None if there are none.

    Raises
    ------
    InputError
        If lengths differ, a unit is missing, a value is not a number or the rate is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> import sealscope as ss
    >>> t = np.arange(1000) / 500
    >>> pressures = {"p_A": 3e5 + 1e4 * np.sin(4 * t), "p_B": 3e5 - 1e4 * np.sin(4 * t)}
    >>> recording = ss.Recording(t, pressures, {"p_A": "Pa", "p_B": "Pa"}, rate=500.0)
    >>> recording
    Recording(p_A [Pa], p_B [Pa]; 1000 samples, 500 Hz, 2 s)
    >>> recording.between(0.5, 1.0).duration
    0.5
    >>> frame = recording.to_pandas()
    >>> ss.Recording.from_pandas(frame[["p_A [Pa]"]])
    Recording(p_A [Pa]; 1000 samples, 500 Hz, 2 s)
    """

    t: Array
    channels: Mapping[str, Array]
    units: Mapping[str, str]
    rate: float
    provenance: Mapping[str, Any] = field(default_factory=dict)
    history: tuple[str, ...] = ()
    bridged: NDArray[np.bool_] | None = None
    _results: dict[Hashable, Any] = field(default_factory=dict, init=False)  # cache of `compute_once`

    def __post_init__(self) -> None:
        """Check the arguments and replace them by read-only copies."""
        try:
            t = _freeze(self.t)
            channels = {name: _freeze(values) for name, values in self.channels.items()}
            rate = float(self.rate)
        except (TypeError, ValueError) as error:
            raise InputError(f"the values of a recording must be numbers: {error}") from None
        bridged = None if self.bridged is None else np.array(self.bridged, dtype=bool)
        if t.ndim != 1:
            raise InputError(f"t must be one-dimensional, got shape {t.shape}")
        for name, values in channels.items():
            if values.shape != t.shape:
                raise InputError(f"channel {name} must have as many samples as t ({t.size}), got shape {values.shape}")
            if name not in self.units:
                raise InputError(f"channel {name} must have a unit, got none")
        if not (np.isfinite(rate) and rate > 0):
            raise InputError(f"rate must be > 0 Hz, got {self.rate}")
        if bridged is not None:
            if bridged.shape != t.shape:
                raise InputError(f"bridged must have as many samples as t ({t.size}), got shape {bridged.shape}")
            bridged.setflags(write=False)
            bridged = bridged if bridged.any() else None
        units = MappingProxyType({name: self.units[name] for name in channels})
        frozen = {"t": t, "channels": MappingProxyType(channels), "units": units, "rate": rate, "bridged": bridged}
        frozen |= {"provenance": MappingProxyType(dict(self.provenance)), "history": tuple(self.history)}
        for name, value in frozen.items():  # a frozen dataclass cannot set its fields in the usual way
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the class and its arguments for pickling, as plain dicts: mapping proxies cannot be pickled."""
        channels, units, provenance = map(dict, (self.channels, self.units, self.provenance))
        return type(self), (self.t, channels, units, self.rate, provenance, self.history, self.bridged)

    def __getitem__(self, name: str) -> Array:
        """Return the samples (n,) of a channel; raise InputError if it is absent."""
        try:
            return self.channels[name]
        except KeyError:
            have = ", ".join(self.channels) or "none"
            raise InputError(f"channel {name} is not in this recording; it has {have}") from None

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def __len__(self) -> int:
        return int(self.t.size)

    def _format_extent(self) -> str:
        """Format the number of samples, the rate and the duration."""
        return f"{format_count(len(self), 'sample')}, {self.rate:g} Hz, {self.duration:g} s"

    def __repr__(self) -> str:
        channels = ", ".join(f"{name} [{unit}]" for name, unit in self.units.items()) or "no channels"
        return f"Recording({channels}; {self._format_extent()})"

    def _repr_html_(self) -> str:
        """Render a table for notebooks: minimum, mean, maximum of each channel's finite samples, number of others."""
        rows = []
        for name, values in self.channels.items():
            finite = values[np.isfinite(values)]
            statistics = [f"{statistic(finite):.6g}" if finite.size else "" for statistic in (np.min, np.mean, np.max)]
            rows.append((name, LONG_NAMES.get(name, ""), self.units[name], *statistics, values.size - finite.size))
        headings = ("channel", "", "unit", "least", "mean", "most", "missing")
        lines = ["".join(f"<th>{head}</th>" for head in headings)]
        lines += ["".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows]
        table = "".join(f"<tr>{line}</tr>" for line in lines)
        return f"<table><caption>Recording: {escape(self._format_extent())}</caption>{table}</table>"

    @property
    def duration(self) -> float:
        """Duration [s] from the first sample to one interval after the last, or by the rate if the time steps back."""
        span = float(self.t[-1] - self.t[0]) + 1.0 / self.rate if self.t.size else 0.0
        # `span` is that of the number of samples up to rounding, and is not finite if a time is missing
        differs = math.isfinite(span) and abs(span * self.rate - self.t.size) > 0.5 and np.all(np.diff(self.t) >= 0.0)
        return span if differs else self.t.size / self.rate

    @property
    def unused(self) -> tuple[str, ...]:
        """Names of the file's columns of measured pressures, positions, speeds or flows that no channel uses."""
        return self._names_in_provenance("unused")

    @property
    def unused_temperatures(self) -> tuple[str, ...]:
        """Names of the file's columns of temperatures, if none of them is read as the oil temperature."""
        return self._names_in_provenance("unused_temperatures")

    def _names_in_provenance(self, key: str) -> tuple[str, ...]:
        """Return the names in the list `key` of the provenance; empty without such a list."""
        names = self.provenance.get(key, ())
        return tuple(map(str, names)) if isinstance(names, list | tuple) else ()

    @property
    def remarks(self) -> dict[str, str]:
        """Remarks in the header of the recording's file, such as the operator or the machine, by their names."""
        remarks = self.provenance.get("about")
        return collect_remarks(remarks.items()) if isinstance(remarks, Mapping) else {}

    def unit_in_log(self, name: str) -> str | None:
        """Return the unit in which a channel was logged; None if it was in SI units or counts, or came from no log."""
        units = self.provenance.get("log_units")
        return str(units[name]) if isinstance(units, Mapping) and name in units else None

    def format_value(self, name: str, value: float, digits: int = 6, *, is_span: bool = False) -> str:
        """Format a value of the channel `name`, stated in its unit (`units`), in the unit of its log if this has one.

        `digits`: number of significant digits; `is_span`: the value is a difference, to which the offset of a unit does
        not apply.
        """
        unit = self.units[name]
        display_unit = self.unit_in_log(name) or unit
        if display_unit != unit:
            offset = from_si(0.0, display_unit, unit) if is_span else 0.0  # such as that of degC
            value = from_si(value, display_unit, unit) - offset
        return f"{value:.{digits}g} {display_unit}"

    @property
    def pressure_unit(self) -> str:
        """Unit in which pressures are displayed, the first unit of a logged pressure in `DISPLAY_UNITS`, else bar."""
        units = (self.unit_in_log(name) for name in self.channels if name.startswith("p_"))
        return next((unit for unit in units if unit in DISPLAY_UNITS), "bar")

    def between(self, start: float, stop: float) -> Recording:
        """Return a recording of the samples with start <= t < stop [s]."""
        return self._select((self.t >= start) & (self.t < stop), f"cut to {start:g} s <= t < {stop:g} s")

    def samples(self, rows: slice) -> Recording:
        """Return a recording of the samples in a slice; their times stay as they are."""
        return self._select(rows, f"cut to samples {rows.start} to {rows.stop}")

    def _select(self, rows: Any, note: str) -> Recording:
        """Return a recording of the selected rows, a slice or a mask (n,); `note` is added to its history."""
        channels = {name: values[rows] for name, values in self.channels.items()}
        bridged = None if self.bridged is None else self.bridged[rows]
        return replace(self, t=self.t[rows], channels=channels, history=(*self.history, note), bridged=bridged)

    def only(self, names: Iterable[str]) -> Recording:
        """Return a recording with the named channels only; both share the results that `compute_once` caches."""
        part = replace(self, channels={name: self[name] for name in names})
        object.__setattr__(part, "_results", self._results)
        return part

    def series(self) -> tuple[dict[str, Array], dict[str, str], dict[str, Any]]:
        """Return the content for writers of files: (name -> samples, name -> unit, description).

        The time is called `t`. The description has rate, provenance and history as JSON values; raises InputError if
        the provenance has others.
        """
        from sealscope.recordings.formats.table import make_description

        description = make_description(self.rate, self.provenance, self.history)
        return {"t": self.t, **self.channels}, {"t": "s", **self.units}, description

    def to_pandas(self) -> pandas.DataFrame:
        """Copy the recording to a data frame with the index ``t [s]`` and columns such as ``p_A [Pa]``.

        Its ``attrs``, which `from_pandas` reads, have units by column, rate, provenance and history. Raises
        MissingExtra without pandas, and InputError if the provenance has values that JSON does not have.
        """
        from sealscope.recordings.frames import to_pandas

        return to_pandas(*self.series())

    def to_xarray(self) -> xarray.Dataset:
        """Copy the recording to a data set over the coordinate ``t``, with variables and attributes as in NetCDF files.

        Raises MissingExtra without xarray, and InputError if the provenance has values that JSON does not have.
        """
        from sealscope.recordings.frames import to_xarray

        return to_xarray(*self.series())

    def plot(self, channels: Iterable[str] | None = None) -> NDArray[Any]:
        """Plot channels over time, one panel for each unit, in the units of the log or else practical ones.

        Parameters
        ----------
        channels : iterable of str, optional
            Names of the channels; by default all.

        Returns
        -------
        axes : ndarray
            `matplotlib.axes.Axes` (k,), one for each unit, above one another.

        Raises
        ------
        InputError
            The recording lacks one of the channels, or has no channels.
        MissingExtra
            matplotlib is not installed.
        """
        channels_by_unit: dict[str, list[tuple[str, Array]]] = {}
        for name in self.channels if channels is None else channels:
            values, unit = self[name], self.units[name]
            plot_unit = self.unit_in_log(name) or (self.pressure_unit if unit == "Pa" else _PLOT_UNITS.get(unit, unit))
            values = values if plot_unit == unit else from_si(values, plot_unit, CHANNEL_UNITS.get(name, unit))
            channels_by_unit.setdefault(plot_unit, []).append((name, values))
        if not channels_by_unit:
            raise InputError("a recording must have channels to be drawn, got none")
        try:
            from matplotlib.figure import Figure
        except ImportError:
            raise MissingExtra("a drawing needs matplotlib: pip install 'sealscope[report]'") from None
        axes = Figure(layout="constrained").subplots(len(channels_by_unit), sharex=True, squeeze=False)[:, 0]
        for panel, (unit, lines) in zip(axes, channels_by_unit.items(), strict=True):
            for name, values in lines:
                panel.plot(self.t, values, label=name)
            panel.set(ylabel=f"{', '.join(name for name, _ in lines)} [{unit}]")
            panel.legend()
        axes[-1].set(xlabel="t [s]")
        return np.asarray(axes)

    @classmethod
    @checked_call
    def from_pandas(
        cls, frame: pandas.DataFrame, *, map: ChannelMap | None = None, rate: float | None = None
    ) -> Recording:
        """Make a recording from a data frame, by the same rules as for files.

        Parameters
        ----------
        frame : pandas.DataFrame
            Columns such as ``p_A [bar]``; a unit may also be in ``frame.attrs["units"][column]`` or in the column's
            own ``attrs["units"]``. The time is a column such as ``t [s]``, or else the index, if this has a name or
            contains floating-point numbers, dates or time differences.
        map : mapping of str to str or "auto", optional
            Channel (or ``t``) -> column, as for `read`.
        rate : float, optional
            Sampling rate [Hz], in place of a time; by default inferred from the time.

        Returns
        -------
        Recording
            In SI units.

        Raises
        ------
        MissingExtra
            If pandas is not installed.
        InputError
            If no column is a channel, a unit has the wrong dimension, a value is not a number, or there is neither
            time nor rate.
        """
        from sealscope.recordings.frames import read_pandas

        request = Request(map or {}, rate)
        try:
            with raising_unreadable("a data frame", "data frame"):
                return make_recording(read_pandas(frame, request))
        except UnreadableFile as error:
            raise InputError(str(error)) from None


def make_recording(fields: RecordingFields) -> Recording:
    """Make a recording from the fields that a reader of a file format returns."""
    return Recording(*fields[:-1])  # without the `kind` of the file


def compute_once(
    recording: Recording, key: Hashable, compute: Callable[[Recording], _T], channels: Iterable[str] | None = None
) -> _T:
    """Return `compute(recording)`, which is computed once for each `key` and then cached with the recording.

    `channels`: the channels on which the result depends, by default all. Copies of the recording with fewer channels
    (`Recording.only`) share the result if they have these channels.
    """
    names = frozenset(recording.channels)
    if channels is not None:
        names = names.intersection(channels)
    if (key, names) not in recording._results:
        recording._results[key, names] = compute(recording)
    return recording._results[key, names]  # type: ignore[no-any-return]


def keep_with_recording(compute: Callable[[Recording], _T]) -> Callable[[Recording], _T]:
    """Let a function of a recording compute its result once, and cache it with the recording (`compute_once`)."""

    @wraps(compute)
    def restore(recording: Recording) -> _T:
        """Restore the result, or compute it."""
        return compute_once(recording, (compute.__module__, compute.__qualname__), compute)

    return restore
