"""JSON: a record a line or a member of an array, rows with or without a heading, blocks of columns, or one document.

Records, rows and blocks are read one after the other in bounded memory. A document of columns, of signals with their
units, or of a table as pandas writes it (`orient`: split, table, columns, index) is read as a whole, as a tree.
"""

from __future__ import annotations

import codecs
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
LARGEST_DOCUMENT = 2**26
_MOST_PARTS = 2**22
_CHUNK = 2**20
#: Most names that records may have, deepest nesting of a record, and longest vector in one.
_MOST_NAMES, _DEEPEST, _LONGEST_VECTOR = 1024, 4, 256
_BEGINS = re.compile(r'\{\s{0,1000}["}]|\[\s{0,1000}[\[{\]"\d\-nN]')
#: What stands between the members of a stream: white space, commas, and RFC 7464's mark of a record.
_BETWEEN = re.compile(r"[\s,\x1e]*")
_SPACE = re.compile(r"\s*")
#: Errors of a text that ends too early are this near to its end, or say so.
_NEAR_END = 16
_VALUE_KEYS = ("value", "val", "v")
_UNIT_KEYS = ("unit", "units", "uom", "einheit")
_NAME_KEYS = ("columns", "names", "header", "headers", "fields", "channels", "labels")
_ROW_KEYS = ("data", "rows", "values", "records")
_decoder = json.JSONDecoder()


def is_json(head: bytes) -> bool:
    """Return whether a file that begins with `head` is JSON: an object, or an array, but no heading in brackets."""
    encoding = encoding_of(head)
    if encoding is None:
        return False
    text = head.decode(encoding, errors="replace").lstrip("\ufeff \t\r\n\x1e")
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
        series = list(series_in(values if isinstance(values, Mapping) else {"data": values}))
        rows, long = 0, None
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
        return None
    except InputError:
        pass
    columns = [column.values(records.rows) for column in records.columns.values()]
    names = [str(cell) for cell in columns[shape.name].tolist()]
    units = [""] * len(names) if shape.unit is None else [str(cell) for cell in columns[shape.unit].tolist()]
    values = columns[shape.value]
    if values.dtype.kind != "f":
        values = from_text(["" if cell is None else str(cell) for cell in values.tolist()], False, "value", place)
    return pivoted(list(zip(names, units, strict=True)), columns[shape.time], values, labels[shape.time], place)


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
        inside, line, count, least = False, 1, 0, 0
        rest, pieces = "", [""]
        for text, ended in self._texts():
            pieces.append(text)
            if not ended and sum(map(len, pieces)) < least:
                continue
            rest, at, least = "".join(pieces), 0, 0
            if len(rest) > _MOST_PARTS and rest.count("{") + rest.count("[") > _MOST_PARTS:
                raise UnreadableFile(f"JSON must have at most {_MOST_PARTS} parts in one value ({self.place})")
            while True:
                at = _end(_BETWEEN, rest, at)
                inner = _end(_SPACE, rest, at + 1)
                if at == len(rest):
                    break
                if inner >= len(rest) and not ended and len(rest) - at <= LARGEST_DOCUMENT:
                    least = min(2 * (len(rest) - at), LARGEST_DOCUMENT + 1)  # it is parsed anew then
                    break
                if inside and rest[at] == "]":
                    inside, at = False, at + 1
                    continue
                if not inside and rest[at] == "[" and rest[inner : inner + 1] in ("[", "{", "]"):
                    inside, at = True, inner
                    continue
                try:
                    member, end = _decoder.raw_decode(rest, at)
                except json.JSONDecodeError as error:
                    unfinished = error.msg.startswith("Unterminated") or error.pos >= len(rest) - _NEAR_END
                    if unfinished and not ended and len(rest) - at <= LARGEST_DOCUMENT:
                        least = min(
                            2 * (len(rest) - at), LARGEST_DOCUMENT + 1
                        )  # a value is parsed anew when twice as much of it is read
                        break
                    if unfinished and ended and count:
                        self.cut = True
                        return
                    what = (
                        error.msg
                        if len(rest) - at <= LARGEST_DOCUMENT
                        else f"over {LARGEST_DOCUMENT} signs in one, write a record a line"
                    )
                    where = line + rest.count("\n", 0, error.pos)
                    raise UnreadableFile(f"JSON must be whole, got: {what} (line {where}, {self.place})") from None
                except (ValueError, RecursionError) as error:
                    raise UnreadableFile(f"JSON must be plain, got: {str(error)[:80]} ({self.place})") from None
                count += 1
                yield member
                at = end
            line += rest.count("\n", 0, at)
            pieces = [rest[at:]]

    def _texts(self) -> Iterator[tuple[str, bool]]:
        """Yield (text, whether it is the last) in blocks."""
        with self.path.open("rb") as file:
            encoding = encoding_of(file.read(SNIFF))
            if encoding is None:
                raise UnreadableFile(f"JSON must be text, got binary data ({self.place})")
            file.seek(0)
            decoder = codecs.getincrementaldecoder(encoding)(errors="replace")
            begun = False
            while data := file.read(_CHUNK):
                text = decoder.decode(data)
                yield (text if begun else text.lstrip("\ufeff")), False
                begun = True
            yield decoder.decode(b"", True), True


def _end(pattern: re.Pattern[str], text: str, at: int) -> int:
    match = pattern.match(text, at)
    return at if match is None else match.end()


class _Column:
    """Samples of a name: numbers at their rows, and texts at theirs."""

    def __init__(self) -> None:
        self.unit: str | None = None
        self.at, self.numbers = array("q"), array("d")
        self.text_at: list[int] = []
        self.texts: list[str] = []

    def add(self, row: int, value: object, name: str, place: str) -> None:
        if value is None:
            return
        if isinstance(value, str) and is_number(value, "."):
            value = float(ungrouped(value.strip(), ".").lower().replace("d", "e"))
        if isinstance(value, str):
            if value.strip().casefold() not in MISSING:
                check_texts(len(self.texts) + 1, len(value), name, place)
                self.text_at.append(row)
                self.texts.append(value)
            return
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
        texts = np.full(rows, "", dtype=object)
        known = np.isfinite(numbers)
        texts[known] = [repr(value) for value in numbers[known].tolist()]
        texts[self.text_at] = self.texts
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
                self._add_block(member, length)
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

    def _add_block(self, member: Mapping[str, Any], length: int) -> None:
        for name, cells in member.items():
            if isinstance(cells, list):
                for row, cell in enumerate(cells, start=self.rows):
                    self._add(row, "", name, cell, _DEEPEST)
        self.rows += length

    def _add(self, row: int, group: str, name: str, value: Any, depth: int) -> None:
        """Add a value of a record, or what is in it, called by the names on the way to it."""
        if isinstance(value, Mapping) and depth < _DEEPEST:
            keys = {key.casefold(): key for key in value}
            held, unit = (
                next((keys[key] for key in names if key in keys), None) for names in (_VALUE_KEYS, _UNIT_KEYS)
            )
            if name and held is not None and unit is not None and not isinstance(value[held], Mapping | list):
                column = self._column(group, name)
                given = value[unit]
                if isinstance(given, str) and column.unit not in (None, given):
                    raise UnreadableFile(
                        f"{name} must have one unit, got {column.unit[:40]} and {given[:40]} "  # type: ignore[index]
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
        column = self.columns.get((group, name))
        if column is None:
            if len(self.columns) == _MOST_NAMES:
                raise UnreadableFile(f"records must have at most {_MOST_NAMES} names, got more ({self.place})")
            column = self.columns[group, name] = _Column()
        return column

    def series(self) -> list[Series]:
        """Return a series a name, each with a sample in every row."""
        return [
            Series(group, Label.parse(name, column.unit), self.rows, partial(column.values, self.rows))
            for (group, name), column in self.columns.items()
        ]


def _key_of(value: Mapping[str, Any], names: Sequence[str]) -> str | None:
    """Return the key of an object that is the first of these names, whatever its case; None where it has none."""
    keys = {key.casefold(): key for key in value}
    return next((keys[name] for name in names if name in keys), None)


def _block_length(member: Mapping[str, Any]) -> int | None:
    """Return how many samples a block of columns holds: arrays of one length, one of which is the time."""
    lengths = {len(value) for value in member.values() if isinstance(value, list)}
    timed = any(isinstance(value, list) and is_time(Label.parse(name)) for name, value in member.items())
    return lengths.pop() if len(lengths) == 1 and timed else None


def _plain(value: Any, place: str, depth: int = 0) -> Any:
    """Return a document's value as the tree of signals has them: arrays for lists, tables as columns by name."""
    if isinstance(value, Mapping):
        table = _table(value, place)
        if table is not None:
            return table
        return {key: _plain(member, place, depth + 1) for key, member in value.items()} if depth < 8 else None
    if not isinstance(value, list):
        return value
    if value and all(isinstance(member, Mapping) for member in value):
        if all(_is_flat(member) for member in value):
            return _by_column(value, None, place)
        return {f"({number})": _plain(member, place, depth + 1) for number, member in enumerate(value, start=1)}
    if value and all(isinstance(member, list) for member in value):
        return _by_column(value, None, place)
    return _vector(value, place)


def _list_of(value: Mapping[str, Any], names: Sequence[str]) -> list[Any]:
    """Return the list under the first of these names, empty where there is none."""
    held = value.get(_key_of(value, names) or "")
    return held if isinstance(held, list) else []


def _vector(cells: Sequence[Any], place: str) -> NDArray[Any] | None:
    """Return an array (n,) of numbers or texts; None for cells of another kind."""
    if not all(isinstance(cell, str | int | float | None) for cell in cells):
        return None
    if not any(isinstance(cell, str) for cell in cells):
        try:
            numbers = np.array(cells, dtype=np.float64)  # None is NaN
        except OverflowError:
            numbers = np.full(len(cells), np.inf)
        if np.isinf(numbers).any():
            raise UnreadableFile(f"a sample must be a finite number, got an infinite one in an array ({place})")
        return numbers
    column = _Column()
    for row, cell in enumerate(cells):
        column.add(row, cell, "an array", place)
    values = column.values(len(cells))
    return values.astype(str) if values.dtype == object else values


def _by_column(rows: Sequence[Any], heads: Sequence[Any] | None, place: str) -> dict[str, NDArray[Any]]:
    """Return name -> samples (n,) of rows that are records or arrays under their `heads`."""
    records = _Records(place, heads=None if heads is None else [str(head) for head in heads])
    for row in rows:
        records.add(row)
    check_size(records.rows, len(records.columns), place)
    columns = {name: column.values(records.rows) for (_, name), column in records.columns.items()}
    return {name: values.astype(str) if values.dtype == object else values for name, values in columns.items()}


def _table(value: Mapping[str, Any], place: str) -> dict[str, Any] | None:
    """Return name -> samples of a table that names and rows, or objects by row or column, make; None for any other."""
    heads, rows = _list_of(value, _NAME_KEYS), _list_of(value, _ROW_KEYS)
    if heads and rows and isinstance(rows[0], list) and len(rows[0]) == len(heads):
        names = [head.get("name", "") if isinstance(head, Mapping) else head for head in heads]
        table = _by_column(rows, names, place)
        index = value.get("index")
        if isinstance(index, list) and len(index) == len(rows) and index != list(range(len(rows))):
            return {"t": _vector(index, place), **table}
        return dict(table)
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
    if inner == [str(row) for row in range(len(inner))]:
        return columns
    numbers = all(re.fullmatch(r"-?\d{1,20}(\.\d{1,20})?", key) for key in inner)
    return {"t": _vector([float(key) for key in inner] if numbers else inner, place), **columns}
