"""Series of samples in a tree of structs, as in MATLAB and JSON files.

A row or column vector is a series, and so is each column of a matrix; a struct, a table or an object is a group. A
struct with the fields of a time series (``time`` and ``signals``, or ``Time`` and ``Data``) gives its series a clock.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.table import MAX_VALUES, Clock, Series, timedelta_seconds, uniform_clock

#: Deepest nesting that is read, and most columns of a matrix that are series.
_MAX_DEPTH, _MAX_COLUMNS = 8, 256
#: Names of the fields with a signal's name, samples, unit, and with the names of a matrix's columns.
_NAME_FIELDS = ("name", "signalname", "label", "title")
_SAMPLE_FIELDS = ("data", "value", "values", "samples", "y")
_UNIT_FIELDS = ("unit", "units", "einheit", "einheiten")
_COLUMN_NAME_FIELDS = ("colheaders", "header", "headers", "labels", "channels", "channelnames", "columns", "varnames")


def iter_series(fields: Mapping[str, Any]) -> Iterator[Series]:
    """Yield the series in the values of a MATLAB or JSON file: arrays (n,) or (n, m), structs, tables and objects."""
    # the file counts as no struct: its depth is -1, so that its values have the depth 0 (no struct around them)
    yield from _iter_struct(group="", name="", fields=fields, clock=None, depth=-1)


def _iter_value(group: str, name: str, value: Any, clock: Clock | None, depth: int = 0) -> Iterator[Series]:
    """Yield the series of samples in a value of any type; nothing for one that contains none, or is nested too deeply.

    `name`: name of the value; `group`: names of the structs around it, with slashes between; `clock`: times of series
    that state none, None if unknown; `depth`: number of structs and cell arrays around the value.
    """
    if depth > _MAX_DEPTH:
        return
    if (fields := _struct_fields(value)) is not None:
        yield from _iter_struct(group, name, fields, clock, depth)
    elif hasattr(value, "columns") and hasattr(value, "index"):  # a data frame
        yield from _iter_table(f"{group}/{name}" if group else name, value)
    elif isinstance(value, np.ndarray) and value.dtype == object:
        for number, member in enumerate(value.reshape(-1), start=1):
            yield from _iter_value(group, name if value.size == 1 else f"{name}({number})", member, clock, depth + 1)
    elif isinstance(value, np.ndarray):
        yield from _iter_columns(group, name, value, unit=None, clock=clock)


def _struct_fields(value: Any) -> Mapping[str, Any] | None:
    """Return the fields of a struct by name, or the structs in an array by `(1)`, `(2)`, ...; None for other values.

    An array of more than `_MAX_COLUMNS` structs also gives None.
    """
    properties = getattr(value, "properties", value)  # those of an object of mat-io
    if isinstance(properties, Mapping):
        return properties
    if isinstance(value, np.ndarray) and value.dtype.names and 1 <= value.size <= _MAX_COLUMNS:
        members = value.reshape(-1)
        if value.size == 1:
            return {name: members[0][name] for name in value.dtype.names}
        return {f"({number})": members[number - 1 : number] for number in range(1, value.size + 1)}
    return None


def _iter_struct(group: str, name: str, fields: Mapping[str, Any], clock: Clock | None, depth: int) -> Iterator[Series]:
    """Yield the series of samples in a struct: a time series, a signal, or a group of other values.

    A signal has samples and a unit or, in a Simulink log, a name and `values`. `group`, `name`: names of the structs
    around this one, and its name; `clock`: sampling times of series that state none; `depth`: number of structs around.
    """
    by_name = {key.rstrip("_").casefold(): value for key, value in fields.items()}
    unit = _first_text(by_name, _UNIT_FIELDS)
    samples = next((vector for key in _SAMPLE_FIELDS if _is_vector(vector := by_name.get(key))), None)
    # each struct's times have a key of their own, as names may repeat
    if (times := _read_struct_times(by_name)) is not None:
        yield from _iter_time_series(group, name, by_name, Clock.of_times(object(), times), depth)
    elif samples is not None and unit is not None:
        times = by_name.get("time", by_name.get("t"))
        if isinstance(times, np.ndarray) and times.dtype.kind in "fiu" and times.size == samples.size:
            clock = Clock.of_times(object(), times.reshape(-1).astype(np.float64))
        yield from _iter_columns(group, _first_text(by_name, _NAME_FIELDS) or name, samples, unit or None, clock)
    elif "values" in by_name and _single_text(by_name.get("name")):  # a signal of a Simulink log
        yield from _iter_value(group, _single_text(by_name["name"]), by_name["values"], clock, depth + 1)
    else:
        yield from _iter_group(f"{group}/{name}" if group else name, fields, clock, depth)


def _iter_time_series(group: str, name: str, by_name: Mapping[str, Any], clock: Clock, depth: int) -> Iterator[Series]:
    """Yield the series of samples in a struct that also contains their times; `clock` gives these times.

    The samples are in the structs of the field `signals`, as in Simulink's structure with time, in an array `data`, as
    in MATLAB's `timeseries`, or in another value `data`. `by_name`: name in lower case -> field of the struct; `group`,
    `name`: names of the structs around it, and its name; `depth`: number of structs around it.
    """
    data = by_name.get("data")
    if "signals" in by_name:
        for number, signal in enumerate(_list_structs(by_name["signals"]), start=1):
            label = _single_text(signal.get("label")) or f"{name}({number})"
            path = f"{group}/{name}" if group else name
            yield from _iter_columns(path, label, np.asarray(signal.get("values")), unit=None, clock=clock)
    elif isinstance(data, np.ndarray):
        info = _struct_fields(by_name.get("datainfo")) or {}
        unit = _single_text(info.get("Units")) or _first_text(by_name, _UNIT_FIELDS)
        yield from _iter_columns(group, _single_text(by_name.get("name")) or name, data, unit or None, clock)
    else:
        yield from _iter_value(group, "data", data, clock, depth + 1)


def _iter_group(group: str, fields: Mapping[str, Any], clock: Clock | None, depth: int) -> Iterator[Series]:
    """Yield the series of samples in each field of a struct, with names and units from fields such as `units`.

    `group`: names of the struct and of those around it, with slashes between; `depth`: number of the latter; `clock`:
    sampling times of series that state none, None if unknown.
    """
    units, column_names = _find_field_units(fields), _find_column_names(fields)
    for key, value in fields.items():
        # catman exports `Channel_3_Data` with `Channel_3_Header`
        channel, _, suffix = key.rpartition("_")
        header = _struct_fields(fields.get(f"{channel}_Header")) if suffix == "Data" else None
        if header is not None:
            step, values = single_number(header.get("dt")), np.asarray(value)
            channel_clock = uniform_clock("catman", values.size, step) if step and step > 0.0 else None
            label = _single_text(header.get("SignalName")) or key
            yield from _iter_columns(group, label, values, _single_text(header.get("Unit")) or None, channel_clock)
        elif column_names and isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] == len(column_names):
            for number, label in enumerate(column_names):
                yield from _iter_columns(group, label, value[:, number], unit=None, clock=clock)
        elif key in units and isinstance(value, np.ndarray):
            yield from _iter_columns(group, key, value, units[key], clock)
        else:
            yield from _iter_value(group, key, value, clock, depth + 1)


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
    """Read the times (n,) [s] of a struct with samples from its field `time` or `timeinfo`; None if it has neither.

    `timeinfo` states start, step and number of samples. A struct has samples if it has a field `signals` or `data`; for
    others, the result is None.
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


def _iter_columns(
    group: str, name: str, value: NDArray[Any], unit: str | None, clock: Clock | None
) -> Iterator[Series]:
    """Yield the series of a vector, or of each column of a matrix, called `name(:,1)` etc.; leave out other arrays."""
    if value.dtype.kind not in "fiubmMU":
        return
    flat = np.squeeze(value)
    if flat.ndim == 1 and flat.size > 1:
        yield Series(group, Label.parse(name, unit), flat.size, partial(np.asarray, flat), clock)
    elif flat.ndim == 2 and min(flat.shape) <= _MAX_COLUMNS:
        tall = flat if flat.shape[0] >= flat.shape[1] else flat.T  # the longer axis is that of the samples
        for number, column in enumerate(tall.T, start=1):
            label = Label(f"{name}(:,{number})", f"{name}(:,{number})", unit)
            yield Series(group, label, column.size, partial(np.asarray, column), clock)


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
