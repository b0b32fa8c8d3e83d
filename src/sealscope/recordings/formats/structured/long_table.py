"""Long tables: a row holds one sample of one channel, as historians, panels and time series data bases export them.

WinCC's logs (`VarName;TimeString;VarValue;Validity;Time_ms`), InfluxDB's annotated CSV, and any table with columns of
names, moments and values. Each name is a series with a clock of its own.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import UnreadableFile
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.columns import counted
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.proposal import is_time
from sealscope.recordings.formats.headings.split_time import below_seconds
from sealscope.recordings.formats.series import Clock, Series, table_of
from sealscope.recordings.formats.table import MOST_WORDS, Choose, RawTable, check_size
from sealscope.recordings.formats.text_layout import COMMENTS, MISSING, Layout, cells_of, is_number, ungrouped
from sealscope.recordings.timebase import from_numbers, stamps

_NAMES = frozenset({
    "varname", "variable", "variable name", "variablenname", "variablename", "tagname", "tag name", "tag_name", "tag",
    "name", "signal", "signal name", "signalname", "channel", "channel name", "kanal", "kanalname", "messstelle",
    "point", "point name", "pointname", "item", "itemid", "item id", "sensor", "sensor name", "metric", "series",
    "_field", "field", "browsename", "nodeid", "topic", "bezeichnung",
})  # fmt: skip
_VALUES = frozenset({
    "varvalue", "value", "val", "_value", "wert", "messwert", "variablenwert", "tagvalue", "tag value", "vvalue",
    "point value", "reading", "valeur", "valor", "valore",
})  # fmt: skip
_TIMES = frozenset({"timestring", "_time", "datetime", "date_time", "date time", "date/time", "ts", "time_stamp"})
_UNITS = frozenset({"unit", "units", "einheit", "eu", "eng units", "engunits", "uom"})
#: Columns that annotate InfluxDB's tables; other columns without a number are tags, which tell series apart.
_ANNOTATIONS = frozenset({"", "result", "table", "_start", "_stop"})
#: WinCC's moments: a millionth of a day since 1899-12-30, and whether the value is valid.
_DAYS, _VALID = "time_ms", "validity"
_FROM_1899_TO_1970, _DAY = 25_569.0, 86_400.0
_LONGEST_LINE, _ROWS_AT_ONCE, _MOST_SERIES = 2**20, 2**15, 4096


@dataclass(frozen=True)
class LongColumns:
    """Columns of a long table: names, moments, values.

    And where there are such: units, days, validity, tags, the date beside a time of the day, milliseconds beside both.
    """

    name: int
    time: int
    value: int
    unit: int | None = None
    days: int | None = None
    valid: int | None = None
    tags: tuple[int, ...] = ()
    date: int | None = None
    ms: int | None = None


def long_columns(labels: Sequence[Label]) -> LongColumns | None:
    """Return the columns of a long table; None for a table whose headings name no channel, value and time."""
    names = [label.name.strip().casefold() for label in labels]

    def only(known: frozenset[str]) -> int | None:
        return next((column for column, name in enumerate(names) if name in known), None)

    name, value, unit = only(_NAMES), only(_VALUES), only(_UNITS)
    if "_field" in names:
        name = names.index("_field")
    if name is None or value is None:
        return None
    times = [column for column, own in enumerate(names) if own in _TIMES]
    times += [column for column, label in enumerate(labels) if is_time(label) and names[column] != _DAYS]
    times = [column for column in times if column not in (name, value)]
    if not times:
        return None
    influx = "_field" in names
    used = {name, value, times[0], unit}
    tags = tuple(
        column for column, own in enumerate(names) if influx and column not in used and own not in _ANNOTATIONS
    )
    days = names.index(_DAYS) if _DAYS in names and names[times[0]] == "timestring" else None
    date = only(frozenset({"date", "datum"}) - {names[times[0]]})
    ms = below_seconds(labels, [times[0]]).get("ms")
    return LongColumns(name, times[0], value, unit, days, only(frozenset({_VALID})), tags, date, ms)


@dataclass
class _Rows:
    """Samples as they stand in the file: `series`: number of each one's series, its moment and its value."""

    series: array[int] = field(default_factory=lambda: array("i"))
    values: array[float] = field(default_factory=lambda: array("d"))
    numbers: array[float] = field(default_factory=lambda: array("d"))
    moments: list[NDArray[np.datetime64]] = field(default_factory=list)
    names: dict[tuple[str, str, str], int] = field(default_factory=dict)
    words: dict[int, int] = field(default_factory=dict)
    invalid: int = 0


def read_long(path: Path, choose: Choose, layout: Layout, shape: LongColumns) -> RawTable:
    """Read the chosen channels of a long table.

    A name is a series, with its unit where a column gives it; series of one name and other tags are apart. A value
    that is no number is missing, and so is one that WinCC calls invalid.
    """
    place = str(path)
    rows = _Rows()
    texts: list[str] = []
    stamped: bool | None = None
    for number, cells in _cells(path, layout):
        if cells[shape.value : shape.value + 1] and cells[shape.value].strip().casefold() in _VALUES:
            shape = long_columns([Label.parse(cell) for cell in cells]) or shape  # the heading of another table
            continue
        if len(cells) <= max(shape.name, shape.time, shape.value) or not cells[shape.name].strip():
            continue
        moment = _moment(cells, shape)
        if shape.days is not None and shape.days < len(cells) and is_number(cells[shape.days], layout.decimal):
            moment = cells[shape.days].strip()
        if stamped is None:
            stamped = not is_number(moment, layout.decimal)
        key = _key(cells, shape)
        index = rows.names.setdefault(key, len(rows.names))
        if len(rows.names) > _MOST_SERIES:
            raise UnreadableFile(
                f"a long table must have at most {_MOST_SERIES} names, got more (line {number}, {place})"
            )
        rows.series.append(index)
        rows.values.append(_value(cells, shape, layout.decimal, index, rows))
        if stamped:
            texts.append("" if moment.casefold() in MISSING else moment)
            if len(texts) == _ROWS_AT_ONCE:
                rows.moments.append(_stamps(texts, number, place))
                texts = []
        else:
            rows.numbers.append(_number(moment, layout.decimal))
        if len(rows.series) % _ROWS_AT_ONCE == 0:
            check_size(len(rows.series), 3, place)
    if texts:
        rows.moments.append(_stamps(texts, number, place))
    if not rows.series:
        raise UnreadableFile(f"a recording must have samples, got a header and no rows ({place})")
    times, start, notes = _times(rows, shape, layout.labels[shape.time])
    series = list(_series(rows, times, start, place))
    table = table_of(series, choose, layout.kind, place, layout.about)
    if rows.invalid:
        notes.append(f"{counted(rows.invalid, 'value')} that the file calls invalid read as missing")
    notes.append(f"long table: {counted(len(rows.series), 'row')} of {counted(len(rows.names), 'name')}")
    return RawTable(table.kind, table.choice, table.columns, None, (*layout.notes, *notes, *table.notes), table.about)


def pivoted(
    names: Sequence[tuple[str, str]], moments: NDArray[Any], values: Array, label: Label, place: str
) -> tuple[list[Series], tuple[str, ...]]:
    """Return a series for each (name, unit) of the rows (n,), and lines for the history.

    `moments`: (n,) numbers in the unit of their `label`, or texts; `values`: (n,).
    """
    rows = _Rows()
    for key in names:
        rows.series.append(rows.names.setdefault(("", key[0][:200], key[1][:40]), len(rows.names)))
        if len(rows.names) > _MOST_SERIES:
            raise UnreadableFile(f"a long table must have at most {_MOST_SERIES} names, got more ({place})")
    rows.values.extend(values.tolist())
    if moments.dtype.kind == "f":
        rows.numbers.extend(moments.tolist())
    else:
        rows.moments.append(_stamps([str(cell) for cell in moments.tolist()], len(names), place))
    times, start, notes = _times(rows, LongColumns(0, 1, 2), label)
    said = f"long table: {counted(len(rows.series), 'row')} of {counted(len(rows.names), 'name')}"
    return list(_series(rows, times, start, place)), (*notes, said)


def _cells(path: Path, layout: Layout) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number, cells) of the lines from the first sample on, but comments and empty ones."""
    place = str(path)
    with path.open(encoding=layout.encoding, errors="replace") as file:
        number = 0
        while line := file.readline(_LONGEST_LINE):
            number += 1
            if len(line) == _LONGEST_LINE:
                raise UnreadableFile(
                    f"a text log must have lines, got {_LONGEST_LINE} signs without (line {number}, {place})"
                )
            if number > layout.first_row and line.strip() and not line.lstrip().startswith(COMMENTS):
                yield number, cells_of(line.rstrip("\n"), layout.delimiter)


def _moment(cells: Sequence[str], shape: LongColumns) -> str:
    """Return the moment of a row as text, with the date before it and the milliseconds behind, where they stand apart.

    `05/31/2024`, `11:59:59 PM`, `7`: `05/31/2024 11:59:59.007 PM`.
    """
    moment = cells[shape.time].strip()
    if ":" not in moment:
        return moment
    if shape.ms is not None and shape.ms < len(cells) and re.fullmatch(r"\d{1,3}", cells[shape.ms].strip()):
        clock, blank, half = moment.partition(" ") if moment[-1:].casefold() == "m" else (moment, "", "")
        moment = f"{clock}.{cells[shape.ms].strip():0>3}{blank}{half}"
    if shape.date is not None and shape.date < len(cells):
        return f"{cells[shape.date].strip()} {moment}"
    return moment


def _key(cells: Sequence[str], shape: LongColumns) -> tuple[str, str, str]:
    """Return (tags, name, unit) of a row, printable and cut to length."""
    tags = "/".join(cells[column].strip() for column in shape.tags if column < len(cells))
    unit = cells[shape.unit].strip() if shape.unit is not None and shape.unit < len(cells) else ""
    name = cells[shape.name].strip().strip('"')
    return tags[:200], name[:200], unit[:40]


def _number(cell: str, decimal: str) -> float:
    cell = ungrouped(cell.strip(), decimal)
    return float(cell.replace(",", ".")) if is_number(cell, decimal) and "d" not in cell.lower() else np.nan


def _value(cells: Sequence[str], shape: LongColumns, decimal: str, index: int, rows: _Rows) -> float:
    if shape.valid is not None and shape.valid < len(cells) and cells[shape.valid].strip() == "0":
        rows.invalid += 1
        return np.nan
    cell = cells[shape.value].strip()
    value = _number(cell, decimal)
    if not np.isfinite(value) and cell.casefold() not in MISSING:
        rows.words[index] = rows.words.get(index, 0) + 1
        return np.nan
    return value


def _stamps(texts: list[str], number: int, place: str) -> NDArray[np.datetime64]:
    try:
        return stamps(texts)
    except ValueError as error:
        bad = texts[int(error.args[0])][:40]
        raise UnreadableFile(
            f"time must be a stamp such as 2024-05-31T12:00:00.002, got {bad!r} (up to line {number}, {place})"
        ) from None


def _times(rows: _Rows, shape: LongColumns, label: Label) -> tuple[Array, np.datetime64 | None, list[str]]:
    """Return the seconds (n,) of all rows from the moment that is returned beside them, where it is known."""
    if rows.moments:
        moments = np.concatenate(rows.moments)
        rows.moments.clear()
        known = ~np.isnat(moments)
        if not known.any():
            raise UnreadableFile("time must have a stamp in some row, got none")
        start = moments[known].min()
        seconds = (moments - start).astype(np.int64) / 1e9
        seconds[~known] = np.nan
        return seconds, start, []
    values = np.frombuffer(rows.numbers, dtype=np.float64)
    if shape.days is not None:
        days = values / 1e6 - _FROM_1899_TO_1970
        first = float(np.nanmin(days))
        return (days - first) * _DAY, np.datetime64(round(first * _DAY * 1e6), "us").astype("datetime64[ns]"), []
    seconds, begin, notes = from_numbers(values, label.unit, label.whole)
    if "start_epoch_s" in begin:
        return seconds, np.datetime64(round(begin["start_epoch_s"] * 1e9), "ns"), notes
    return seconds, np.datetime64(begin["start"]).astype("datetime64[ns]") if "start" in begin else None, notes


def _series(rows: _Rows, times: Array, start: np.datetime64 | None, place: str) -> Iterator[Series]:
    """Yield a series for each name, in the order of its rows, or against it where they begin with the last."""
    numbers = np.frombuffer(rows.series, dtype=np.int32)
    values = np.frombuffer(rows.values, dtype=np.float64)
    order = np.argsort(numbers, kind="stable")
    ends = np.searchsorted(numbers[order], np.arange(len(rows.names)), side="right").tolist()
    for begin, end, ((tags, name, unit), index) in zip([0, *ends], ends, rows.names.items(), strict=False):
        own = order[begin:end]
        own = own[np.isfinite(times[own])]
        if own.size > 1 and np.all(np.diff(times[own]) < 0):
            own = own[::-1]
        words = rows.words.get(index, 0)
        read = partial(_samples, values, own, name, words, place)
        clock = Clock(index, partial(np.take, times, own), start)
        yield Series(tags, Label.parse(name, unit or None), own.size, read, clock)


def _samples(values: Array, own: NDArray[np.int64], name: str, words: int, place: str) -> NDArray[Any]:
    if words > MOST_WORDS * own.size:
        raise UnreadableFile(f"{name[:40]} must hold numbers, got text ({place})")
    return values[own]
