"""Text logs: Sealscope's own CSV, and those that other people's loggers write."""

from __future__ import annotations

import csv
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.columns import ColumnMap, counted
from sealscope.recordings.formats.headings.quantities import plain_cells
from sealscope.recordings.formats.table import MOST_WORDS, Choose, RawTable, check_size, parse_description
from sealscope.recordings.formats.text_layout import (
    COMMENTS,
    MISSING,
    OWN_MARK,
    SNIFF,
    Layout,
    blank_cells,
    encoding_of,
    is_number,
    layout_of,
    ungrouped,
)
from sealscope.recordings.timebase import is_stamp, stamps

_CHUNK = 8 * 1024 * 1024
#: Logs of so many bytes are worth the import of pyarrow.
_LARGE = 2**20
#: Signs that begin quoted cells and comments.
_MARKS = (b'"', b"#", b"%", b"/", b"!")
_LONGEST_OWN_LINE = 64 * 1024 * 1024
_ROWS_WRITTEN_AT_ONCE = 8192
#: Most lines of text among the samples, however few these are: marks of events, a summary at the end.
_MOST_REMARKS = 8
_STAMP_RULE = "time must be a stamp such as 2024-05-31T12:00:00.002"
_LONGEST_REMARK = 400
_HALF_A_NUMBER = re.compile(r"[\s+\-\d.,:TeE]{0,40}")


def read_table(path: Path, choose: Choose, layout: Layout) -> RawTable:
    """Read the chosen columns of a text log of one table."""
    place = str(path)
    choice = choose(layout.labels, layout.rate)
    taken, loose = _Columns(layout, choice, place), _Loose()
    with path.open("rb") as file:
        for rows, numbers, cut in _row_blocks(file, layout, choice, place, loose):
            taken.take(rows, numbers, cut)
    return _table(layout, taken, loose.notes(taken.total))


def read_text_parts(path: Path, choose: Choose, rows_of: Callable[[RawTable], int]) -> Iterator[RawTable]:
    """Yield the chosen columns of a text log part by part, in bounded memory.

    `rows_of`: returns how many rows a part shall have, from the beginning of the log.
    """
    place = str(path)
    layout = look_at(path)
    choice = choose(layout.labels, layout.rate)
    taken, loose, size, total = _Columns(layout, choice, place), _Loose(), 0, 0
    with path.open("rb") as file:
        for block, numbers, cut in _row_blocks(file, layout, choice, place, loose):
            if not size:
                beginning = _Columns(layout, choice, place)
                beginning.take(block, numbers, cut)
                size = rows_of(_table(layout, beginning, []))
            first = 0
            while first < len(block):
                last = min(len(block), first + size - taken.total)
                taken.take(block[first:last], numbers[first:last], cut and last == len(block))
                total, first = total + last - first, last
                if taken.total == size:
                    yield _table(layout, taken, [])
                    taken = _Columns(layout, choice, place)
    notes = loose.notes(total)
    if taken.total or not total:
        yield _table(layout, taken, notes)


def _table(layout: Layout, taken: _Columns, notes: Sequence[str]) -> RawTable:
    """Return the table of the columns taken; `notes`: more lines for the history."""
    columns, own = taken.finish()
    description = None if layout.own is None else parse_description(layout.own, taken.place)
    return RawTable(layout.kind, taken.choice, columns, description, (*layout.notes, *own, *notes), layout.about)


def look_at(path: Path) -> Layout:
    """Return the layout of a text log, by its beginning; raise UnreadableFile where it is none."""
    place = str(path)
    with path.open("rb") as file:
        head = file.read(SNIFF)
        if not head:
            raise UnreadableFile(f"a recording must have samples, got an empty file ({place})")
        encoding = encoding_of(head)
        if encoding is None:
            raise UnreadableFile(f"a recording must be text, NetCDF, HDF5 or Parquet, got other binary data ({place})")
        if head.startswith(OWN_MARK.encode()):
            head += _own_line(file, head)
        return layout_of(head, encoding, len(file.read(1)) == 0, place)


def _own_line(file: BinaryIO, head: bytes) -> bytes:
    """Read the rest of a long first line of our own, and as much after it as is needed to see the layout."""
    more = b""
    while b"\n" not in head and b"\n" not in more and len(more) < _LONGEST_OWN_LINE:
        data = file.read(SNIFF)
        if not data:
            return more
        more += data
    return more + file.read(SNIFF) if more else b""


def _blocks(file: BinaryIO, encoding: str, place: str) -> Iterator[tuple[int, bytes, bool]]:
    """Yield (number of the first line, whole lines, False) in bounded blocks; True for a last line without an end."""
    width = 2 if encoding.startswith("utf-16") else 1
    newline = "\n".encode(encoding if width == 2 else "ascii")
    rest, number = b"", 1
    while data := file.read(_CHUNK):
        block = rest + data
        if width == 1 and b"\0" in data:
            line = number + block[: block.index(b"\0")].count(b"\n")
            raise UnreadableFile(f"a text log must be text throughout, got binary data (line {line}, {place})")
        end = block.rfind(newline)
        while width == 2 and end >= 0 and end % 2:  # a newline's bytes across two characters
            end = block.rfind(newline, 0, end + 1)
        if end < 0 and len(data) == _CHUNK:
            if b"\r" not in block or width == 2:
                raise UnreadableFile(f"a text log must have lines, got {len(block)} bytes without ({place})")
            end = block.rfind(b"\r")
        if end >= 0:
            block, rest = block[: end + width], block[end + width :]
            yield number, block, False
            number += block.count(newline) or block.count(b"\r")
        else:
            rest = block
    if rest:
        yield number, rest, not rest.endswith(b"\r")


def _lines(block: bytes, layout: Layout) -> list[str]:
    """Return the lines of a block without their ends."""
    text = block.decode(layout.encoding, errors="replace").lstrip("\ufeff")
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    return text.removesuffix("\n").split("\n")


@dataclass
class _FormulaParser:
    """Reads blocks in which each row has plain numbers in the chosen columns by pyarrow, where it is installed.

    `first`: whether no block was read; `usable`: whether the log can have such blocks: its first block is one; `width`:
    cells in a row of the last block.
    """

    layout: Layout
    choice: ColumnMap
    usable: bool
    first: bool = True
    width: int = 0

    @classmethod
    def of(cls, file: BinaryIO, layout: Layout, choice: ColumnMap) -> _FormulaParser:
        """Return the parser of a log; small ones, whose time is that of the import, are not for it."""
        plain = layout.encoding in ("utf-8", "utf-8-sig", "cp1252") and layout.delimiter != " "
        large = os.fstat(file.fileno()).st_size >= _LARGE
        return cls(layout, choice, plain and large and not layout.cell_units and find_spec("pyarrow") is not None)

    def values(self, number: int, block: bytes) -> NDArray[np.float64] | None:
        """Return the chosen columns (n, k) of a block from line `number` on, None where a row is another."""
        if not self.usable:
            return None
        values = self._values(block.split(b"\n", max(0, self.layout.first_row + 1 - number))[-1])
        self.usable, self.first = values is not None or not self.first, False
        return values

    def _values(self, block: bytes) -> NDArray[np.float64] | None:
        from pyarrow import ArrowInvalid, csv, float64, py_buffer

        layout, columns = self.layout, [column for column, _ in self.choice.columns]
        self.width = width = block.partition(b"\n")[0].count(layout.delimiter.encode()) + 1
        if any(mark in block for mark in _MARKS) or not max(columns) < width <= len(layout.labels):
            return None
        if b"\r" in block and block.count(b"\r") != block.count(b"\r\n"):
            return None
        names = [str(column) for column in range(width)]
        try:
            table = csv.read_csv(
                py_buffer(block),
                csv.ReadOptions(column_names=names, block_size=len(block)),
                csv.ParseOptions(delimiter=layout.delimiter, quote_char=False),
                csv.ConvertOptions(
                    include_columns=[names[column] for column in columns],
                    column_types={names[column]: float64() for column in columns},
                    null_values=["", "NaN", *MISSING],
                    decimal_point=layout.decimal,
                ),
            )
        except ArrowInvalid:
            return None
        values = np.empty((table.num_rows, len(columns)), order="F")
        for index, column in enumerate(table.columns):
            values[:, index] = column.to_numpy()
        return None if np.isinf(values).any() else values


def _rows(lines: list[str], numbers: Sequence[int], layout: Layout, cut: bool, place: str) -> list[list[str]]:
    """Split lines into cells; a quotation mark must be closed on its line, but on one that was `cut` short."""
    if layout.delimiter == " ":
        return [blank_cells(line) for line in lines]
    if not any('"' in line for line in lines):
        return [line.split(layout.delimiter) for line in lines]
    reader = csv.reader([*lines, ""], delimiter=layout.delimiter, skipinitialspace=True)
    rows: list[list[str]] = []
    for line, row in enumerate(reader):
        if reader.line_num > line + 1:  # the line goes on in the next
            if cut and line == len(lines) - 1:
                return [*rows, [*row[:-1], ""]]
            raise UnreadableFile(
                f"a quotation mark must be closed on its line, got an open one (line {numbers[line]}, {place})"
            )
        rows.append(row)
    return rows[:-1]


@dataclass
class _Loose:
    """What stands among the rows of a log and is none: remarks, repeated headings."""

    remarks: _Words = field(default_factory=lambda: _Words(""))
    repeated: int = 0

    def notes(self, rows: int) -> list[str]:
        """Return lines for the history; raise UnreadableFile where remarks are more than a few among `rows`."""
        notes = self.remarks.notes(rows)
        if self.repeated:
            notes.append(f"{counted(self.repeated, 'line')} of the heading repeated among the samples left out")
        return notes


def _row_blocks(
    file: BinaryIO, layout: Layout, choice: ColumnMap, place: str, loose: _Loose
) -> Iterator[tuple[list[list[str]] | NDArray[np.float64], Sequence[int], bool]]:
    """Yield blocks of rows with a cell in each chosen column, their lines' numbers, whether the last is cut short.

    A block in which each row has plain numbers there is yielded as these, (n, k).
    """
    least, usual = max(column for column, _ in choice.columns) + 1, 0
    parser = _FormulaParser.of(file, layout, choice)
    for number, block, cut in _blocks(file, layout.encoding, place):
        if not cut and (values := parser.values(number, block)) is not None:
            usual = parser.width
            yield values, range(number, number + len(values)), False
            continue
        lines = _lines(block, layout)
        skip = max(0, layout.first_row + 1 - number)
        blank = " " if layout.delimiter == "\t" else None  # tabs alone are a row of missing samples
        kept = [
            i for i in range(skip, len(lines)) if lines[i].strip(blank) and not lines[i].lstrip().startswith(COMMENTS)
        ]
        if layout.above:
            count = len(kept)
            kept = [i for i in kept if lines[i].strip() not in layout.above]
            loose.repeated += count - len(kept)
        if not kept:
            continue
        numbers: Sequence[int] = [number + i for i in kept]
        rows = _rows([lines[i] for i in kept], numbers, layout, cut, place)
        if cut and len(rows[-1]) < usual and _HALF_A_NUMBER.fullmatch(rows[-1][-1]):
            # a last line without an end was not written whole: half a number and what follows it are missing
            rows[-1] = [*rows[-1][:-1], *[""] * (least - len(rows[-1]) + 1)]
        usual = len(rows[-1])
        rows, numbers = _without_remarks(rows, numbers, least, layout, place, loose.remarks)
        if rows:
            _check_widths(rows, numbers, least, layout, place)
            yield rows, numbers, cut


class _Columns:
    """The chosen columns of the rows taken so far; the time may hold stamps, with the date in another column."""

    def __init__(self, layout: Layout, choice: ColumnMap, place: str) -> None:
        self._layout, self.choice, self.place = layout, choice, place
        self._parts: list[list[NDArray[Any]]] = [[] for _ in choice.columns]
        self._words = [_Words(layout.labels[column].whole) for column, _ in choice.columns]
        self._stamped: bool | None = None
        self._dated = False
        self.total = 0

    def take(self, rows: list[list[str]] | NDArray[np.float64], numbers: Sequence[int], cut: bool) -> None:
        """Read more rows; `cut`: whether the last one was not written whole."""
        layout, choice, place = self._layout, self.choice, self.place
        self.total += len(rows)
        check_size(self.total, len(choice.columns), place)
        if isinstance(rows, np.ndarray):
            self._stamped = False
            for part, odd, values in zip(self._parts, self._words, rows.T, strict=True):
                part.append(odd.passed(values))
            return
        for part, odd, (column, time) in zip(self._parts, self._words, choice.columns, strict=True):
            cells = [row[column] for row in rows]
            if unit := layout.cell_units.get(column):
                where = partial(_place_of, numbers=numbers, column=column, layout=layout, place=place)
                cells = plain_cells(cells, unit, cut, where)
            if time and self._stamped is None:
                index = next((i for i, cell in enumerate(cells) if cell.strip().lower() not in MISSING), 0)
                self._stamped = not is_number(cells[index], layout.decimal) and is_stamp(cells[index])
                # a time of the day beside a date
                day = rows[index][choice.date] if choice.date is not None and choice.date < len(rows[index]) else ""
                self._dated = self._stamped and ":" in cells[index][:3] and is_stamp(day) and ":" not in day
            if not (time and self._stamped):
                part.append(_numbers(cells, numbers, column, layout, place, odd))
                continue
            if self._dated and choice.date is not None:
                cells = [
                    f"{row[choice.date].strip()} {cell.strip()}" if cell.strip() else ""
                    for row, cell in zip(rows, cells, strict=True)
                ]
            part.append(_dates(cells, numbers, column, layout, place, odd))

    def finish(self) -> tuple[list[NDArray[Any]], list[str]]:
        """Return the columns, and lines for the history."""
        choice, labels = self.choice, self._layout.labels
        no_time = self._words[-1].at if choice.time is not None else []
        joined: list[NDArray[Any]] = []
        for part in self._parts:  # each column's blocks are let go before the next is joined
            joined.append(np.concatenate(part) if part else np.empty(0))
            part.clear()
            if no_time:  # the rows of a summary, where a word stands in place of the time
                joined[-1] = np.delete(joined[-1], no_time)
        notes = [note for odd in self._words for note in odd.notes(self.total)]
        if self._dated and choice.date is not None:
            before, after = labels[choice.date], labels[choice.columns[-1][0]]
            notes.append(f"date and time joined from columns {before.whole} and {after.whole}")
        return joined, notes


def _without_remarks(
    rows: list[list[str]], numbers: Sequence[int], least: int, layout: Layout, place: str, remarks: _Words
) -> tuple[list[list[str]], Sequence[int]]:
    """Return rows and their numbers without the short ones that hold no number, which are counted in `remarks`."""
    if min(map(len, rows)) >= least:
        return rows, numbers
    kept = [
        i
        for i, row in enumerate(rows)
        if len(row) >= least
        or sum(map(len, row)) > _LONGEST_REMARK
        or any(is_number(cell, layout.decimal) or is_stamp(cell) for cell in row)
    ]
    for i in sorted(set(range(len(rows))) - set(kept)):
        remarks.add(f"{layout.delimiter.join(rows[i])}", f"(line {numbers[i]}, {place})")
    return [rows[i] for i in kept], [numbers[i] for i in kept]


def _check_widths(rows: list[list[str]], numbers: Sequence[int], least: int, layout: Layout, place: str) -> None:
    """Refuse rows that have too few cells, or more than the header and not empty."""
    most = len(layout.labels)
    widths = [len(row) for row in rows]
    if min(widths) >= least and max(widths) <= most:
        return
    for row, number in zip(rows, numbers, strict=True):
        if len(row) < least or any(cell.strip() for cell in row[most:]):
            raise UnreadableFile(f"a row must have {counted(most, 'cell')}, got {len(row)} (line {number}, {place})")


def _place_of(index: int, numbers: Sequence[int], column: int, layout: Layout, place: str) -> str:
    return f"(line {numbers[index]}, column {layout.labels[column].whole}, {place})"


def _dates(
    cells: list[str], numbers: Sequence[int], column: int, layout: Layout, place: str, words: _Words
) -> NDArray[np.datetime64]:
    texts = ["" if cell.strip().lower() in MISSING else cell for cell in cells]
    try:
        return words.passed(stamps(texts))
    except ValueError:
        for index, text in enumerate(texts):
            if text.strip() and not is_stamp(text) and not any(sign.isdigit() for sign in text):
                words.rule = _STAMP_RULE
                words.add(text.strip(), _place_of(index, numbers, column, layout, place), index)
                texts[index] = ""
    try:
        return words.passed(stamps(texts))
    except ValueError as error:
        bad = int(error.args[0])
        where = _place_of(bad, numbers, column, layout, place)
        raise UnreadableFile(f"{_STAMP_RULE}, got {cells[bad]!r} {where}") from None


@dataclass
class _Words:
    """Cells of a column that hold a word in place of a number (`OVERLOAD`), or lines of words where `name` is empty.

    `rule`: what they break; `count`, `first`, `where`: how many, the first and its place; `at`: their rows; `rows`:
    those read so far.
    """

    name: str
    rule: str = "a sample must be a number"
    count: int = 0
    first: str = ""
    where: str = ""
    at: list[int] = field(default_factory=list)
    rows: int = 0

    def add(self, text: str, where: str, index: int = 0) -> None:
        """Count a word, at `index` after the rows read so far."""
        if not self.count:
            self.first, self.where = text[:40], where
        self.count += 1
        self.at.append(self.rows + index)

    def passed(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the values of a block, whose rows are read now."""
        self.rows += len(values)
        return values

    def notes(self, rows: int) -> list[str]:
        """Return a line for the history; raise UnreadableFile where they are more than a few among `rows`."""
        if self.count > max(MOST_WORDS * rows, 0 if self.name else _MOST_REMARKS):
            raise UnreadableFile(f"{self.rule}, got {self.first!r} {self.where}")
        if not self.count:
            return []
        if not self.name:
            return [
                f"{counted(self.count, 'line')} of text among the samples left out, first {self.first!r} {self.where}"
            ]
        cells = counted(self.count, "cell")
        return [f"column {self.name}: {cells} without a number read as missing, first {self.first!r} {self.where}"]


def _numbers(cells: list[str], numbers: Sequence[int], column: int, layout: Layout, place: str, words: _Words) -> Array:
    """Read cells as doubles, missing ones as NaN; an infinite one is refused, words are counted and missing."""
    comma = layout.decimal == ","
    texts = [cell.replace(".", "?").replace(",", ".") for cell in cells] if comma else cells
    plain = not any("_" in text for text in texts)  # Python takes 1_000 for a number
    try:
        if not plain:
            raise ValueError
        values = np.fromiter(map(float, texts), np.float64, len(texts))
    except ValueError:
        values = np.fromiter((_number(cell, layout.decimal) for cell in cells), np.float64, len(cells))
    for index in np.flatnonzero(~np.isfinite(values)).tolist():
        shown = cells[index].strip()
        if shown.lower() not in MISSING:
            where = _place_of(index, numbers, column, layout, place)
            if is_number(shown, layout.decimal):
                raise UnreadableFile(f"a sample must be a finite number, got {shown[:40]!r} {where}")
            words.add(shown, where, index)
    return words.passed(values)


def _number(cell: str, decimal: str) -> float:
    text = ungrouped(cell.strip().replace("\u2212", "-"), decimal)
    if not is_number(text, decimal):
        return np.nan
    # a Fortran exponent, 1.5D+03
    return float(text.replace(",", ".").lower().replace("d", "e"))


def write_text(
    path: Path,
    values: Mapping[str, Array],
    units: Mapping[str, str],
    description: Mapping[str, Any],
    delimiter: str,
) -> None:
    """Write `# sealscope: {...}`, the header `t [s],p_A [Pa],...` and one row a sample.

    Numbers read back to the same bits; a missing sample is an empty cell. Raises InputError where a value is infinite.
    """
    for name, series in values.items():
        if np.isinf(series).any():
            what = name if name == "t" else f"channel {name}"
            raise InputError(f"{what} must be finite or missing to be written as text, got inf")
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(OWN_MARK + json.dumps(description) + "\n")
        file.write(delimiter.join(f"{name} [{units[name]}]" for name in values) + "\n")
        for start in range(0, len(values["t"]), _ROWS_WRITTEN_AT_ONCE):
            rows = []
            for series in values.values():
                part = series[start : start + _ROWS_WRITTEN_AT_ONCE]
                cells = list(map(repr, part.tolist()))
                for missing in np.flatnonzero(np.isnan(part)).tolist():
                    cells[missing] = ""
                rows.append(cells)
            file.write("\n".join(map(delimiter.join, zip(*rows, strict=True))))
            file.write("\n")
