"""JSON: a record a line or a member of an array, rows with or without a heading, blocks of columns, or one document.

Records, rows and blocks are read one after the other in bounded memory. A document of columns, of signals with their
units, or of a table as pandas writes it (`orient`: split, table, columns, index) is read as a whole, as a tree.
"""

from __future__ import annotations

import json
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import entries, stated_rate
from sealscope.recordings.formats.headings.proposal import is_time
from sealscope.recordings.formats.series import Series, table_of
from sealscope.recordings.formats.structured.long_table import long_columns, pivoted
from sealscope.recordings.formats.structured.tree import series_in
from sealscope.recordings.formats.table import Choose, RawTable, check_size, check_texts, from_text
from sealscope.recordings.formats.text_layout import MISSING, SNIFF, encoding_of, is_number, ungrouped

#: Largest document, or member of a stream, that is read as a whole [characters], and most arrays and objects in it.
LARGEST_DOCUMENT, _MOST_PARTS = 2**26, 2**22
_CHUNK = 2**20
#: Most names that records may have, deepest nesting of a record, and longest vector in one.
_MOST_NAMES, _DEEPEST, _LONGEST_VECTOR = 1024, 4, 256
_BEGINS = re.compile(r'\{\s{0,1000}["}]|\[\s{0,1000}[\[{\]"\d\-nN]')
#: What stands between the members of a stream: white space, commas, and RFC 7464's mark of a record.
_BETWEEN, _SPACE = re.compile(r"[\s,\x1e]*"), re.compile(r"\s*")
_VALUE_KEYS, _UNIT_KEYS = ("value", "val", "v"), ("unit", "units", "uom", "einheit")
_NAME_KEYS = ("columns", "names", "header", "headers", "fields", "channels", "labels")
_ROW_KEYS = ("data", "rows", "values", "records")
_decoder = json.JSONDecoder()


def is_json(head: bytes) -> bool:
    """Return whether a file that begins with `head` is JSON: an object, or an array, but no heading in brackets."""
    encoding = encoding_of(head)
    text = "" if encoding is None else head.decode(encoding, errors="replace").lstrip("\ufeff \t\r\n\x1e")
    if not _BEGINS.match(text):
        return False
    first, newline, _ = text.partition("\n")
    if text.startswith("{") or not first.strip("[ \t\r") or (not newline and len(head) >= SNIFF):
        return True
    try:
        json.loads(first.strip().rstrip(","))
    except json.JSONDecodeError as error:
        return error.pos >= len(first.strip().rstrip(",")) - 1  # `[2024-05-31 12:00] started` is a remark
    except (ValueError, RecursionError):
        return False
    return True


def read_json(path: Path, choose: Choose) -> RawTable:
    """Read the chosen columns of a JSON file."""
    place = str(path)
    stream = _Stream(path, place)
    members = iter(stream)
    begin = list(islice(members, 2))
    if not begin:
        raise UnreadableFile(f"a recording must have samples, got empty JSON ({place})")
    if len(begin) == 1 and isinstance(begin[0], Mapping) and not _is_flat(begin[0]):
        values = _plain(begin[0], place)
        about = entries((name, value) for name, value in begin[0].items() if isinstance(value, str | int | float))
        series, rows, long = list(series_in(values)), 0, None
    else:
        records = _Records(place)
        for member in chain(begin, members):
            records.add(member)
        series, about, rows = records.series(), {}, records.rows
        long = _long(records, series, choose, place)
    if not series:
        raise UnreadableFile(f"JSON must hold records or columns of samples, got none ({place})")
    table = table_of(series if long is None else long[0], choose, "JSON", place, about, stated_rate(about))
    notes = (f"the last value is cut short and left out, after {rows} rows",) if stream.cut else ()
    return replace(table, notes=(*notes, *(() if long is None else long[1]), *table.notes))


def _long(
    records: _Records, series: Sequence[Series], choose: Choose, place: str
) -> tuple[list[Series], tuple[str, ...]] | None:
    """Return a series for each name, and lines for the history, of records of one sample each; None for others."""
    labels = [member.label for member in series]
    shape = long_columns(labels)
    if shape is None:
        return None
    try:
        choose(labels, None)
    except InputError:
        columns = [column.values(records.rows) for column in records.columns.values()]
        names = [str(cell) for cell in columns[shape.name].tolist()]
        units = [""] * len(names) if shape.unit is None else [str(cell) for cell in columns[shape.unit].tolist()]
        values = columns[shape.value]
        if values.dtype.kind != "f":
            values = from_text(["" if cell is None else str(cell) for cell in values.tolist()], False, "value", place)
        return pivoted(list(zip(names, units, strict=True)), columns[shape.time], values, labels[shape.time], place)
    return None


def _is_flat(member: Mapping[str, Any]) -> bool:
    return all(isinstance(value, str | int | float | None) for value in member.values())


@dataclass
class _Stream:
    """The values of a file, one after the other, where an array of arrays or objects stands for its members.

    `cut`: whether the last value has no end, which is left out.
    """

    path: Path
    place: str
    cut: bool = False

    def __iter__(self) -> Iterator[Any]:
        with self.path.open("rb") as head:
            encoding = encoding_of(head.read(SNIFF))
        if encoding is None:
            raise UnreadableFile(f"JSON must be text, got binary data ({self.place})")
        with self.path.open(encoding=encoding, errors="replace") as file:
            text, at, line, inside, count, ended = file.read(_CHUNK).lstrip("\ufeff"), 0, 1, False, 0, False
            while True:
                at = self._end(_BETWEEN, text, at)
                inner = self._end(_SPACE, text, at + 1)
                error: json.JSONDecodeError | None = None
                if inside and text[at : at + 1] == "]":
                    inside, at = False, at + 1
                    continue
                if not inside and text[at : at + 1] == "[" and text[inner : inner + 1] in ("[", "{", "]"):
                    inside, at = True, inner
                    continue
                if inner < len(text) or (ended and at < len(text)):
                    try:
                        member, end = _decoder.raw_decode(text, at)
                    except json.JSONDecodeError as wrong:
                        error = wrong
                    except (ValueError, RecursionError) as wrong:
                        raise UnreadableFile(f"JSON must be plain, got: {str(wrong)[:80]} ({self.place})") from None
                    else:
                        count += 1
                        yield member
                        at = end
                        continue
                if not ended and len(text) - at <= LARGEST_DOCUMENT:  # a value is parsed anew with twice as much of it
                    line += text.count("\n", 0, at)
                    more = file.read(max(_CHUNK, len(text) - at))
                    text, at, ended = text[at:] + more, 0, not more
                    if len(text) > _MOST_PARTS and text.count("{") + text.count("[") > _MOST_PARTS:
                        raise UnreadableFile(f"JSON must have at most {_MOST_PARTS} parts in one value ({self.place})")
                    continue
                if error is None:
                    return
                if ended and count and (error.msg.startswith("Unterminated") or error.pos >= len(text) - 16):
                    self.cut = True
                    return
                what = error.msg if ended else f"over {LARGEST_DOCUMENT} signs in one, write a record a line"
                line += text.count("\n", 0, error.pos)
                raise UnreadableFile(f"JSON must be whole, got: {what} (line {line}, {self.place})")

    @staticmethod
    def _end(pattern: re.Pattern[str], text: str, at: int) -> int:
        match = pattern.match(text, at)
        return at if match is None else match.end()


class _Column:
    """Samples of a name: numbers at their rows, and texts at theirs."""

    def __init__(self) -> None:
        self.unit: str | None = None
        self.at, self.numbers = array("q"), array("d")
        self.texts: dict[int, str] = {}

    def add(self, row: int, value: object, name: str, place: str) -> None:
        if isinstance(value, str) and is_number(value, "."):
            value = float(ungrouped(value.strip(), ".").lower().replace("d", "e"))
        if isinstance(value, str):
            if value.strip().casefold() not in MISSING:
                check_texts(len(self.texts) + 1, len(value), name, place)
                self.texts[row] = value
        elif value is not None:
            try:
                number = float(value)  # type: ignore[arg-type]
            except OverflowError:
                number = np.inf
            if np.isinf(number):
                raise UnreadableFile(f"a sample must be a finite number, got {name} = {str(value)[:40]} ({place})")
            self.at.append(row)
            self.numbers.append(number)

    def values(self, rows: int) -> NDArray[Any]:
        """Return the samples (rows,), missing ones as NaN; texts where the numbers are in texts, too."""
        numbers = np.full(rows, np.nan)
        numbers[np.frombuffer(self.at, dtype=np.int64)] = np.frombuffer(self.numbers)
        if not self.texts:
            return numbers
        texts = np.where(np.isnan(numbers), "", numbers.astype(str)).astype(object)
        texts[list(self.texts)] = list(self.texts.values())
        return texts


@dataclass
class _Records:
    """Members of a stream, collected by name: records, rows under a first row of names, blocks of columns."""

    place: str
    rows: int = 0
    columns: dict[tuple[str, str], _Column] = field(default_factory=dict)
    heads: list[str] | None = None

    def add(self, member: Any) -> None:
        """Add a member: one row of samples, or as many as the arrays of a block have."""
        if isinstance(member, Mapping):
            if (length := _block_length(member)) is not None:
                for name, cells in member.items():
                    for row, cell in enumerate(cells if isinstance(cells, list) else (), start=self.rows):
                        self._add(row, "", name, cell, _DEEPEST)
                self.rows += length
                return
            self._add(self.rows, "", "", member, 0)
        elif isinstance(member, list):
            if self.heads is None:
                texts = bool(member) and all(isinstance(cell, str) for cell in member)
                self.heads = member if texts else [str(number + 1) for number in range(len(member))]
                if texts:
                    return
            if len(member) > len(self.heads):
                raise UnreadableFile(
                    f"a row must have {len(self.heads)} values, got {len(member)} (row {self.rows + 1}, {self.place})"
                )
            for name, value in zip(self.heads, member, strict=False):
                self._add(self.rows, "", name, value, 1)
        else:
            raise UnreadableFile(
                f"JSON must hold objects or arrays, got {str(member)[:40]!r} (row {self.rows + 1}, {self.place})"
            )
        self.rows += 1

    def _add(self, row: int, group: str, name: str, value: Any, depth: int) -> None:
        """Add a value of a record, or what is in it, called by the names on the way to it."""
        if isinstance(value, Mapping) and depth < _DEEPEST:
            held, unit = _key_of(value, _VALUE_KEYS), _key_of(value, _UNIT_KEYS)
            if name and held is not None and unit is not None and not isinstance(value[held], Mapping | list):
                column, given = self._column(group, name), value[unit]
                if isinstance(given, str) and column.unit not in (None, given):
                    raise UnreadableFile(
                        f"{name} must have one unit, got {str(column.unit)[:40]} and {given[:40]} "
                        f"(row {row + 1}, {self.place})"
                    )
                column.unit = given if isinstance(given, str) else column.unit
                column.add(row, value[held], name, self.place)
                return
            inner = f"{group}/{name}" if group and name else group or name
            for key, cell in value.items():
                self._add(row, inner, key, cell, depth + 1)
        elif isinstance(value, list) and depth < _DEEPEST and len(value) <= _LONGEST_VECTOR:
            for number, cell in enumerate(value, start=1):
                self._add(row, group, f"{name}({number})", cell, depth + 1)
        elif isinstance(value, Mapping | list):
            raise UnreadableFile(f"{name} must be a number or a text, got {type(value).__name__} ({self.place})")
        else:
            self._column(group, name).add(row, value, name, self.place)

    def _column(self, group: str, name: str) -> _Column:
        if (group, name) not in self.columns and len(self.columns) == _MOST_NAMES:
            raise UnreadableFile(f"records must have at most {_MOST_NAMES} names, got more ({self.place})")
        return self.columns.setdefault((group, name), _Column())

    def series(self) -> list[Series]:
        """Return a series a name, each with a sample in every row."""
        return [
            Series(group, Label.parse(name, column.unit), self.rows, partial(column.values, self.rows))
            for (group, name), column in self.columns.items()
        ]

    def texts_or_numbers(self) -> dict[str, NDArray[Any]]:
        """Return name -> samples (n,) as the tree of signals has them."""
        check_size(self.rows, len(self.columns), self.place)
        return {name: _as_held(column, self.rows) for (_, name), column in self.columns.items()}


def _as_held(column: _Column, rows: int) -> NDArray[Any]:
    values = column.values(rows)
    return values.astype(str) if values.dtype == object else values


def _key_of(value: Mapping[str, Any], names: Sequence[str]) -> str | None:
    """Return the key of an object that is the first of these names, whatever its case; None where it has none."""
    keys = {key.casefold(): key for key in value}
    return next((keys[name] for name in names if name in keys), None)


def _block_length(member: Mapping[str, Any]) -> int | None:
    """Return how many samples a block of columns holds: arrays of one length, one of which is the time."""
    lists = {name: len(value) for name, value in member.items() if isinstance(value, list)}
    timed = len(set(lists.values())) == 1 and any(is_time(Label.parse(name)) for name in lists)
    return next(iter(lists.values())) if timed else None


def _plain(value: Any, place: str, depth: int = 0) -> Any:
    """Return a document's value as the tree of signals has them: arrays for lists, tables as columns by name."""
    if isinstance(value, Mapping):
        if (table := _table(value, place)) is not None or depth == 8:
            return table
        return {key: _plain(member, place, depth + 1) for key, member in value.items()}
    if not isinstance(value, list):
        return value
    rows = value and all(isinstance(member, list) for member in value)
    if rows or (value and all(isinstance(member, Mapping) and _is_flat(member) for member in value)):
        return _by_column(value, None, place)
    if value and all(isinstance(member, Mapping) for member in value):
        return {f"({number})": _plain(member, place, depth + 1) for number, member in enumerate(value, start=1)}
    return _vector(value, place)


def _vector(cells: Sequence[Any], place: str) -> NDArray[Any] | None:
    """Return an array (n,) of numbers or texts; None for cells of another kind."""
    if not all(isinstance(cell, str | int | float | None) for cell in cells):
        return None
    column = _Column()
    for row, cell in enumerate(cells):
        column.add(row, cell, "an array", place)
    return _as_held(column, len(cells))


def _by_column(rows: Sequence[Any], heads: Sequence[Any] | None, place: str) -> dict[str, NDArray[Any]]:
    """Return name -> samples (n,) of rows that are records or arrays under their `heads`."""
    records = _Records(place, heads=None if heads is None else [str(head) for head in heads])
    for row in rows:
        records.add(row)
    return records.texts_or_numbers()


def _list_of(value: Mapping[str, Any], names: Sequence[str]) -> list[Any]:
    """Return the list under the first of these names, empty where there is none."""
    held = value.get(_key_of(value, names) or "")
    return held if isinstance(held, list) else []


def _table(value: Mapping[str, Any], place: str) -> dict[str, Any] | None:
    """Return name -> samples of a table that names and rows, or objects by row or column, make; None for any other."""
    heads, rows, index = (_list_of(value, names) for names in (_NAME_KEYS, _ROW_KEYS, ("index",)))
    if heads and rows and isinstance(rows[0], list) and len(rows[0]) == len(heads):
        names = [head.get("name", "") if isinstance(head, Mapping) else head for head in heads]
        timed = len(index) == len(rows) and index != list(range(len(rows)))
        return {**({"t": _vector(index, place)} if timed else {}), **_by_column(rows, names, place)}
    members = list(value.values())
    if not members or not all(isinstance(member, Mapping) and member and _is_flat(member) for member in members):
        return None
    if all(key.isdigit() for key in value):  # a record by the number of its row
        return dict(_by_column(members, None, place))
    inner = list(members[0])
    if len(inner) < 2 or not all(list(member) == inner for member in members):
        return None
    if not (inner[0][:1].isdigit() and inner[-1][:1].isdigit()):
        return None
    columns: dict[str, Any] = {name: _vector(list(member.values()), place) for name, member in value.items()}
    return columns if inner == [str(row) for row in range(len(inner))] else {"t": _vector(inner, place), **columns}
