"""Signals in a tree of structs, as MATLAB and JSON files hold them: vectors, matrices, signals with unit and time.

A vector of either direction is a series, a matrix one a column of it; a struct, a table or an object is a group. What
has the fields of a time series (``time`` and ``signals``, or ``Time`` and ``Data``) gives its series a clock.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.table import MAX_VALUES, Clock, Series, uniform

#: Deepest nesting that is walked, and most columns of a matrix that are taken for series.
_DEEPEST, _MOST_COLUMNS = 8, 256
#: Fields of a struct that name a signal, its samples, its unit, and the columns of a matrix.
_NAME_FIELDS = ("name", "signalname", "label", "title")
_SAMPLE_FIELDS = ("data", "value", "values", "samples", "y")
_UNIT_FIELDS = ("unit", "units", "einheit", "einheiten")
_NAME_OF_COLUMNS = ("colheaders", "header", "headers", "labels", "channels", "channelnames", "columns", "varnames")


def series_in(fields: Mapping[str, Any]) -> Iterator[Series]:
    """Yield the series in a file's values by name: arrays (n,) or (n, m), structs as mappings, tables, objects."""
    yield from _group("", "", fields, None, -1)


def _walk(group: str, name: str, value: Any, clock: Clock | None, depth: int = 0) -> Iterator[Series]:
    """Yield the series in a value called `name`, of the group `group`."""
    if depth > _DEEPEST:
        return
    if (fields := _fields(value)) is not None:
        yield from _group(group, name, fields, clock, depth)
    elif hasattr(value, "columns") and hasattr(value, "index"):
        yield from _frame(f"{group}/{name}" if group else name, value)
    elif isinstance(value, np.ndarray) and value.dtype == object:
        for number, member in enumerate(value.reshape(-1), start=1):
            yield from _walk(group, name if value.size == 1 else f"{name}({number})", member, clock, depth + 1)
    elif isinstance(value, np.ndarray):
        yield from _columns(group, name, value, None, clock)


def _fields(value: Any) -> Mapping[str, Any] | None:
    """Return the fields of a struct or the properties of an object; None for anything else."""
    properties = getattr(value, "properties", value)
    if isinstance(properties, Mapping):
        return properties
    if isinstance(value, np.ndarray) and value.dtype.names and 1 <= value.size <= _MOST_COLUMNS:
        members = value.reshape(-1)
        if value.size == 1:
            return {name: members[0][name] for name in value.dtype.names}
        return {f"({number})": members[number - 1 : number] for number in range(1, value.size + 1)}
    return None


def _group(group: str, name: str, fields: Mapping[str, Any], clock: Clock | None, depth: int) -> Iterator[Series]:
    by_name = {key.rstrip("_").casefold(): value for key, value in fields.items()}
    data, unit = by_name.get("data"), _first_text(by_name, _UNIT_FIELDS)
    samples = next((vector for key in _SAMPLE_FIELDS if _is_vector(vector := by_name.get(key))), None)
    if (time := _times(by_name)) is not None:
        clock = _clock((group, name, depth), time)
        if "signals" in by_name:  # a structure with time, as Simulink's scopes write
            for number, signal in enumerate(_members(by_name["signals"]), start=1):
                label = _text(signal.get("label")) or f"{name}({number})"
                yield from _columns("", label, np.asarray(signal.get("values")), None, clock)
            return
        if isinstance(data, np.ndarray):
            unit = _text((_fields(by_name.get("datainfo")) or {}).get("Units")) or unit
            yield from _columns(group, _text(by_name.get("name")) or name, data, unit or None, clock)
            return
        yield from _walk(group, "data", data, clock, depth + 1)  # vectors that share the time beside them
        return
    if samples is not None and unit is not None:  # a signal with its name and unit beside its samples
        instants = by_name.get("time", by_name.get("t"))
        if isinstance(instants, np.ndarray) and instants.dtype.kind in "fiu" and instants.size == samples.size:
            clock = _clock((group, name, depth), instants.reshape(-1).astype(np.float64))
        yield from _columns(group, _first_text(by_name, _NAME_FIELDS) or name, samples, unit or None, clock)
        return
    if "values" in by_name and _text(by_name.get("name")):  # a signal of a Simulink log, named by the log
        yield from _walk(group, _text(by_name["name"]), by_name["values"], clock, depth + 1)
        return
    inner = f"{group}/{name}" if group else name
    units, names = _units_beside(fields), _column_names(fields)
    for key, value in fields.items():
        head, _, last = key.rpartition("_")
        header = _fields(fields.get(f"{head}_Header")) if last == "Data" else None
        if header is not None:  # `Channel_3_Data`, as catman exports it
            step, values = number_of(header.get("dt")), np.asarray(value)
            own_clock = uniform("catman", values.size, step) if step and step > 0.0 else None
            label = _text(header.get("SignalName")) or key
            yield from _columns(inner, label, values, _text(header.get("Unit")) or None, own_clock)
        elif names and isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] == len(names):
            for number, label in enumerate(names):
                yield from _columns(inner, label, value[:, number], None, clock)
        elif key in units and isinstance(value, np.ndarray):
            yield from _columns(inner, key, value, units[key], clock)
        else:
            yield from _walk(inner, key, value, clock, depth + 1)


def _is_vector(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.size > 1


def _first_text(by_name: Mapping[str, Any], names: tuple[str, ...]) -> str | None:
    """Return the text of the first of these fields, empty where it holds none; None where no field has the name."""
    return next((_text(by_name[name]) for name in names if name in by_name), None)


def _units_beside(fields: Mapping[str, Any]) -> dict[str, str]:
    """Return name -> unit of a struct called `units` beside the vectors."""
    for key, value in fields.items():
        if key.casefold() in _UNIT_FIELDS and (held := _fields(value)) is not None:
            return {name: text for name, member in held.items() if (text := _text(member))}
    return {}


def _column_names(fields: Mapping[str, Any]) -> list[str]:
    """Return the names of a matrix's columns, which a cell array of texts beside it holds."""
    for key, value in fields.items():
        if (
            key.casefold() in ("name", "names", *_NAME_OF_COLUMNS)
            and isinstance(value, np.ndarray)
            and value.dtype.kind in "OU"
            and value.size > 1
        ):
            texts = [_text(cell) or str(cell) for cell in value.reshape(-1)]
            if all(texts):
                return texts
    return []


def _times(by_name: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """Read the times (n,) [s] from fields: numbers, or a start, increment and length; None without."""
    if "signals" not in by_name and "data" not in by_name:
        return None
    time = by_name.get("time")
    if isinstance(time, np.ndarray) and time.dtype.kind in "fiu" and time.size > 1:
        return np.asarray(time, dtype=np.float64).reshape(-1)
    info = _fields(by_name.get("timeinfo")) or {}
    numbers = {key.rstrip("_"): number_of(value) for key, value in info.items()}
    step, length = numbers.get("Increment"), numbers.get("Length")
    if step is None or length is None or not 1 < length <= MAX_VALUES:
        return None
    return (numbers.get("Start") or 0.0) + step * np.arange(int(length), dtype=np.float64)


def _members(value: Any) -> list[Mapping[str, Any]]:
    """Return the structs of an array of them, or the only one."""
    fields = _fields(value) or {}
    whole = [member for field in fields.values() if (member := _fields(field)) is not None]
    return whole if whole and all(key.startswith("(") for key in fields) else [fields]


def _columns(group: str, name: str, value: NDArray[Any], unit: str | None, clock: Clock | None) -> Iterator[Series]:
    """Yield a series for a vector, and one a column for a matrix, called `name(:,1)` and so on."""
    if value.dtype.kind not in "fiubmMU":
        return
    flat = np.squeeze(value)
    if flat.ndim == 1 and flat.size > 1:
        yield Series(group, Label.parse(name, unit), flat.size, partial(np.asarray, flat), clock)
    elif flat.ndim == 2 and min(flat.shape) <= _MOST_COLUMNS:
        upright = flat if flat.shape[0] >= flat.shape[1] else flat.T
        for number, column in enumerate(upright.T, start=1):
            label = Label(f"{name}(:,{number})", f"{name}(:,{number})", unit)
            yield Series(group, label, column.size, partial(np.asarray, column), clock)


def _frame(group: str, frame: Any) -> Iterator[Series]:
    """Yield the columns of a table; the row times of a timetable are their clock."""
    units = [str(unit) for unit in frame.attrs.get("VariableUnits", frame.attrs.get("varUnits", ()))]
    clock, index = None, np.asarray(frame.index)
    if index.dtype.kind in "mM" and index.size:
        start = index[0].astype("datetime64[ns]") if index.dtype.kind == "M" else None
        elapsed = index if start is None else index - index[0]
        clock = _clock((group, "row times"), elapsed / np.timedelta64(1, "ns") / 1e9, start)
    for number, name in enumerate(frame.columns):
        label = Label.parse(str(name), (units[number] or None) if number < len(units) else None)
        values = np.asarray(frame[name])
        yield Series(group, label, len(values), partial(np.asarray, values), clock)


def _clock(key: tuple[Any, ...], t: NDArray[np.float64], start: np.datetime64 | None = None) -> Clock:
    return Clock(key, lambda: (t, start))


def _text(value: Any) -> str:
    """Return the only text that a value holds, empty where it is none."""
    flat = np.asarray(value).reshape(-1) if value is not None else np.empty(0)
    return str(flat[0]).strip() if flat.size == 1 and isinstance(flat[0], str) else ""


def number_of(value: Any) -> float | None:
    """Return the only number that a value holds; None where it holds none or several."""
    flat = np.asarray(value).reshape(-1) if value is not None else np.empty(0)
    return float(flat[0]) if flat.size == 1 and flat.dtype.kind in "fiu" and np.isfinite(flat[0]) else None


def entry_of(value: Any) -> str:
    """Format a value, a single text or number, for an entry about a recording; empty for any other value."""
    number = number_of(value)
    return _text(value) if number is None else f"{number:.12g}"
