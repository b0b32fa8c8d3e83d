"""Series of samples in a tree of structs, as in MATLAB and JSON files.

A row or column vector is a series, and so is each column of a matrix; a struct, a table or an object is a group. A
struct with the fields of a time series (``time`` and ``signals``, or ``Time`` and ``Data``) gives its series a clock.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.table import MAX_VALUES, Clock, Series, uniform_clock
from sealscope.recordings.formats.times.timebase import timedelta_seconds

#: Deepest nesting that is read, and most columns of a matrix that are series.
_MAX_DEPTH, _MAX_COLUMNS = 8, 256
#: Names of the fields with a signal's name, samples, unit, and with the names of a matrix's columns.
_NAME_FIELDS = ("name", "signalname", "label", "title")
_SAMPLE_FIELDS = ("data", "value", "values", "samples", "y")
_UNIT_FIELDS = ("unit", "units", "einheit", "einheiten")
_COLUMN_NAME_FIELDS = ("colheaders", "header", "headers", "labels", "channels", "channelnames", "columns", "varnames")


class _Place(NamedTuple):
    """Place of a value in the tree."""

    group: str  # names of the structs around the value, with slashes between
    name: str  # name of the value
    clock: Clock | None = None  # sampling times of series that state none, None if unknown
    depth: int = 0  # number of structs and cell arrays around the value

    @property
    def path(self) -> str:
        """Group of the values in this one, if it is a struct or a table."""
        return f"{self.group}/{self.name}" if self.group else self.name

    def inner(self, name: str) -> _Place:
        """Return the place of a value `name` inside this one."""
        return self._replace(name=name, depth=self.depth + 1)


def iter_series(fields: Mapping[str, Any]) -> Iterator[Series]:
    """Yield the series in the values of a MATLAB or JSON file: arrays (n,) or (n, m), structs, tables and objects."""
    yield from _iter_struct(_Place(group="", name="", depth=-1), fields)  # no struct is around its values: depth 0


def _iter_value(place: _Place, value: Any) -> Iterator[Series]:
    """Yield the series of samples in a value of any type; nothing for one without samples, or nested too deeply."""
    if place.depth > _MAX_DEPTH:
        return
    if (fields := _struct_fields(value)) is not None:
        yield from _iter_struct(place, fields)
    elif hasattr(value, "columns") and hasattr(value, "index"):  # a data frame
        yield from _iter_table(place.path, value)
    elif isinstance(value, np.ndarray) and value.dtype == object:
        for number, member in enumerate(value.reshape(-1), start=1):
            yield from _iter_value(place.inner(place.name if value.size == 1 else f"{place.name}({number})"), member)
    elif isinstance(value, np.ndarray):
        yield from _iter_columns(place, place.name, value)


def _struct_fields(value: Any) -> Mapping[str, Any] | None:
    """Return the fields of a struct by name, or the structs in a short array by `(1)`, `(2)`, ...; None for others."""
    properties = getattr(value, "properties", value)  # those of an object of mat-io
    if isinstance(properties, Mapping):
        return properties
    if isinstance(value, np.ndarray) and value.dtype.names and 1 <= value.size <= _MAX_COLUMNS:
        members = value.reshape(-1)
        if value.size == 1:
            return {name: members[0][name] for name in value.dtype.names}
        return {f"({number})": members[number - 1 : number] for number in range(1, value.size + 1)}
    return None


def _iter_struct(place: _Place, fields: Mapping[str, Any]) -> Iterator[Series]:
    """Yield the series of samples in a struct: a time series, a signal, or a group of other values.

    A signal has samples and a unit or, in a Simulink log, a name and `values`.
    """
    # MATLAB's objects call some of their fields `Data_`
    by_name = {key.rstrip("_").casefold(): value for key, value in fields.items()}
    unit = _first_text(by_name, _UNIT_FIELDS)
    samples = next((vector for key in _SAMPLE_FIELDS if _is_vector(vector := by_name.get(key))), None)
    # each struct's times have a key of their own, as names may repeat
    if (times := _read_struct_times(by_name)) is not None:
        yield from _iter_time_series(place._replace(clock=Clock.of_times(object(), times)), by_name)
    elif samples is not None and unit is not None:
        times = by_name.get("time", by_name.get("t"))
        if isinstance(times, np.ndarray) and times.dtype.kind in "fiu" and times.size == samples.size:
            place = place._replace(clock=Clock.of_times(object(), times.reshape(-1).astype(np.float64)))
        yield from _iter_columns(place, _first_text(by_name, _NAME_FIELDS) or place.name, samples, unit)
    elif "values" in by_name and (signal_name := _single_text(by_name.get("name"))):  # a signal of a Simulink log
        yield from _iter_value(place.inner(signal_name), by_name["values"])
    else:
        yield from _iter_group(place._replace(group=place.path), fields)


def _iter_time_series(place: _Place, by_name: Mapping[str, Any]) -> Iterator[Series]:
    """Yield the series of samples in a struct that also contains their times, the clock of its `place`.

    The samples are in the structs of the field `signals`, as in Simulink's structure with time, in an array `data`, as
    in MATLAB's `timeseries`, or in another value `data`. `by_name`: name in lower case -> field of the struct.
    """
    data = by_name.get("data")
    if "signals" in by_name:
        for number, signal in enumerate(_list_structs(by_name["signals"]), start=1):
            label = _single_text(signal.get("label")) or f"{place.name}({number})"
            yield from _iter_columns(place._replace(group=place.path), label, np.asarray(signal.get("values")))
    elif isinstance(data, np.ndarray):
        info = _struct_fields(by_name.get("datainfo")) or {}
        unit = _single_text(info.get("Units")) or _first_text(by_name, _UNIT_FIELDS)
        yield from _iter_columns(place, _single_text(by_name.get("name")) or place.name, data, unit)
    else:
        yield from _iter_value(place.inner("data"), data)


def _iter_group(place: _Place, fields: Mapping[str, Any]) -> Iterator[Series]:
    """Yield the series of samples in each field of a struct, whose name is part of the group of `place`."""
    units, column_names = _find_field_units(fields), _find_column_names(fields)
    for key, value in fields.items():
        # catman exports `Channel_3_Data` with `Channel_3_Header`
        channel, _, suffix = key.rpartition("_")
        header = _struct_fields(fields.get(f"{channel}_Header")) if suffix == "Data" else None
        if header is not None:
            step, values = single_number(header.get("dt")), np.asarray(value)
            clock = uniform_clock("catman", values.size, step) if step and step > 0.0 else None
            label, unit = _single_text(header.get("SignalName")) or key, _single_text(header.get("Unit"))
            yield from _iter_columns(place._replace(clock=clock), label, values, unit)
        elif column_names and isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] == len(column_names):
            for number, label in enumerate(column_names):
                yield from _iter_columns(place, label, value[:, number])
        elif key in units and isinstance(value, np.ndarray):
            yield from _iter_columns(place, key, value, units[key])
        else:
            yield from _iter_value(place.inner(key), value)


def _is_vector(value: Any) -> bool:
    """Test whether a value is an array of two or more numbers."""
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.size > 1


def _first_text(by_name: Mapping[str, Any], names: tuple[str, ...]) -> str | None:
    """Return the text of the first existing field of several `names`; "" if it is not a text, None if none exists."""
    return next((_single_text(by_name[name]) for name in names if name in by_name), None)


def _find_field_units(fields: Mapping[str, Any]) -> dict[str, str]:
    """Find the units of a struct's fields, name -> unit, in its field `units`; empty if there is none."""
    for key, value in fields.items():
        if key.casefold() in _UNIT_FIELDS and (units_by_name := _struct_fields(value)) is not None:
            return {name: text for name, member in units_by_name.items() if (text := _single_text(member))}
    return {}


def _find_column_names(fields: Mapping[str, Any]) -> list[str]:
    """Find the names of a matrix's columns in a list of texts in the same struct; empty if there is none."""
    for key, value in fields.items():
        if (
            key.casefold() in ("name", "names", *_COLUMN_NAME_FIELDS)
            and isinstance(value, np.ndarray)
            and value.dtype.kind in "OU"
            and value.size > 1
        ):
            texts = [_single_text(cell) or str(cell) for cell in value.reshape(-1)]
            if all(texts):
                return texts
    return []


def _read_struct_times(by_name: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """Read the times (n,) [s] of a struct with a field `signals` or `data` from its field `time` or `timeinfo`.

    `timeinfo` states start, step and number of samples. None for a struct without such fields.
    """
    if "signals" not in by_name and "data" not in by_name:
        return None
    time = by_name.get("time")
    if isinstance(time, np.ndarray) and time.dtype.kind in "fiu" and time.size > 1:
        return np.asarray(time, dtype=np.float64).reshape(-1)
    info = _struct_fields(by_name.get("timeinfo")) or {}
    numbers = {key.rstrip("_"): single_number(value) for key, value in info.items()}
    step, length = numbers.get("Increment"), numbers.get("Length")
    if step is None or length is None or not 1 < length <= MAX_VALUES:
        return None
    return (numbers.get("Start") or 0.0) + step * np.arange(int(length), dtype=np.float64)


def _list_structs(value: Any) -> list[Mapping[str, Any]]:
    """List the structs in an array of structs, or a single struct, as mappings; one empty mapping for other values."""
    fields = _struct_fields(value) or {}  # of an array: `(1)`, `(2)`, ...
    members = [member for field in fields.values() if (member := _struct_fields(field)) is not None]
    return members if members and all(key.startswith("(") for key in fields) else [fields]


def _iter_columns(place: _Place, name: str, value: NDArray[Any], unit: str | None = None) -> Iterator[Series]:
    """Yield the series of a vector, or of each column of a matrix, called `name(:,1)` etc.; leave out other arrays."""
    if value.dtype.kind not in "fiubmMU":
        return
    flat, unit = np.squeeze(value), unit or None
    if flat.ndim == 1 and flat.size > 1:
        yield Series(place.group, Label.parse(name, unit), flat.size, partial(np.asarray, flat), place.clock)
    elif flat.ndim == 2 and min(flat.shape) <= _MAX_COLUMNS:
        tall = flat if flat.shape[0] >= flat.shape[1] else flat.T  # the longer axis is that of the samples
        for number, column in enumerate(tall.T, start=1):
            label = Label(f"{name}(:,{number})", f"{name}(:,{number})", unit)
            yield Series(place.group, label, column.size, partial(np.asarray, column), place.clock)


def _iter_table(group: str, frame: Any) -> Iterator[Series]:
    """Yield the columns of a data frame as series of the `group`; times in its index are the sampling times."""
    units = [str(unit) for unit in frame.attrs.get("VariableUnits", frame.attrs.get("varUnits", ()))]
    clock, index = None, np.asarray(frame.index)
    if index.dtype.kind in "mM" and index.size:
        start = index[0].astype("datetime64[ns]") if index.dtype.kind == "M" else None
        elapsed = index if start is None else index - index[0]
        clock = Clock.of_times((group, "row times"), timedelta_seconds(elapsed), start)
    for number, name in enumerate(frame.columns):
        label = Label.parse(str(name), (units[number] or None) if number < len(units) else None)
        values = np.asarray(frame[name])
        yield Series(group, label, len(values), partial(np.asarray, values), clock)


def _single_text(value: Any) -> str:
    """Return the only text in a value; empty if there is none or several."""
    flat = np.asarray(value).reshape(-1)
    return str(flat[0]).strip() if flat.size == 1 and isinstance(flat[0], str) else ""


def single_number(value: Any) -> float | None:
    """Return the only finite number in a value; None if there is none or several."""
    flat = np.asarray(value).reshape(-1)
    return float(flat[0]) if flat.size == 1 and flat.dtype.kind in "fiu" and np.isfinite(flat[0]) else None


def format_remark(value: Any) -> str:
    """Format a single text or number as the text of a remark; empty for any other value."""
    number = single_number(value)
    return _single_text(value) if number is None else f"{number:.12g}"
