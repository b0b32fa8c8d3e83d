"""Text logs: Sealscope's own CSV, and those that other people's loggers write.

A log is read in blocks of whole lines. A block that is a plain rectangle of numbers is read by pyarrow, where it is
installed, any other one row by row.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from math import isnan
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.cells import (
    MISSING,
    MOST_WORDS,
    is_missing,
    is_number,
    is_value,
    numbers,
    plain_cells,
)
from sealscope.recordings.formats.columns import Wanted, choose_columns, counted
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import exported_from
from sealscope.recordings.formats.headings.proposal import is_time
from sealscope.recordings.formats.table import (
    Clock,
    RecordingFields,
    Series,
    check_size,
    check_texts,
    converted,
    parse_description,
    seconds_of_series,
    table_of,
)
from sealscope.recordings.formats.text_layout import (
    COMMENTS,
    OWN_MARK,
    SNIFF,
    Layout,
    blank_cells,
    encoding_of,
    layout_of,
)
from sealscope.recordings.formats.timebase import is_stamp, stamps

#: Bytes that are read at a time, which fit a processor's cache, and of the longest line.
_CHUNK, _LONGEST_LINE = 2**19, 2**23
#: Logs of so many bytes are worth the import of pyarrow.
_LARGE = 2**20
#: Signs that begin quoted cells and comments.
_MARKS = (b'"', b"#", b"%", b"/", b"!")
_LONGEST_OWN_LINE = 64 * 1024 * 1024
_ROWS_WRITTEN_AT_ONCE = 8192
#: Most lines of text among the samples, however few these are: marks of events, a summary at the end.
_MOST_REMARKS, _LONGEST_REMARK = 8, 400
_STAMP_RULE = "time must be a stamp such as 2024-05-31T12:00:00.002"
_HALF_A_NUMBER = re.compile(r"[\s+\-\d.,:TeE]{0,40}")
#: The number of a column of times: `t.1` of pandas, `Time 2 - slow` of catman.
_NUMBER = re.compile(r"[\s._(-]{0,4}\d{1,4}\b.{0,60}")
#: Rows as cells, or as numbers (n, k) of the columns asked for.
_Rows = list[list[str]] | NDArray[np.float64]


def read_text(path: Path, wanted: Wanted) -> RecordingFields:
    """Read the wanted columns of a text log: a table with one time, or a time for each channel, or a long table."""
    layout = look_at(path)
    own = None if layout.own is None else parse_description(layout.own)
    held: dict[int, NDArray[Any]] = {}
    times = _times_of_channels(layout.labels)
    table = partial(table_of, wanted=wanted, kind=layout.kind, about=layout.about, rate=layout.rate)

    def prepare(kinds: Mapping[int, str], date: int | None) -> Sequence[str]:
        log = _Log(path, layout, kinds, date)
        for block in log.blocks():
            log.take(*block)
        rows = log.total
        columns, notes = log.finish()
        held.update(columns)
        return [*layout.notes, *notes, *log.remarks_and_headings(rows)]

    def series(column: int, clock: Clock | None = None) -> Series:
        return Series("", layout.labels[column], 0, partial(held.__getitem__, column), clock)

    if times:
        values = [column for column in range(len(layout.labels)) if column not in times]
        owner = {column: max(time for time in times if time < column) for column in values}
        start = exported_from(layout.about)

        def prepare_each(kinds: Mapping[int, str], date: int | None) -> Sequence[str]:
            columns = {values[column]: kind for column, kind in kinds.items()}
            read = {owner[column]: "time" for column in columns}
            return [*prepare(columns | read, None), f"{len(read)} columns of times, one for each channel"]

        clocks = {time: Clock(time, partial(seconds_of_series, series(time), start)) for time in times}
        try:
            return table([series(column, clocks[owner[column]]) for column in values], prepare=prepare_each)
        except InputError:
            with suppress(InputError):
                choose_columns(layout.labels, wanted, layout.rate)
                times = []
            if times:
                raise
    return table([series(column) for column in range(len(layout.labels))], own=own, prepare=prepare)


def _times_of_channels(labels: Sequence[Label]) -> list[int]:
    """Return the columns of times, of one name but for a number, which each channel or group of channels follows."""
    names = [_NUMBER.sub("", label.name.casefold()) for label in labels]
    if names.count(names[0]) < 2 or not is_time(labels[0]):
        return []
    times = [column for column, label in enumerate(labels) if is_time(label)]
    apart = all(after - before > 1 for before, after in zip(times, [*times[1:], len(labels)], strict=True))
    return times if len({names[column] for column in times}) == 1 and len(times) > 1 and apart else []


def read_text_parts(path: Path, wanted: Wanted, rows_of: Callable[[RecordingFields], int]) -> Iterator[RecordingFields]:
    """Yield the wanted columns of a text log part by part, in bounded memory.

    `rows_of`: returns how many rows a part shall have, from the beginning of the log. Where the log has several clocks
    or is a long table, the whole of it is the only part.
    """
    layout = look_at(path)
    try:
        choice = choose_columns(layout.labels, wanted, layout.rate)
    except InputError:
        choice = None
    if choice is None or _times_of_channels(layout.labels):
        yield read_text(path, wanted)
        return
    own = None if layout.own is None else parse_description(layout.own)
    log, size, total = _Log(path, layout, choice.columns, choice.date), 0, 0

    def part(source: _Log, more: Sequence[str] = ()) -> RecordingFields:
        columns, notes = source.finish()
        return converted(choice, columns, layout.kind, wanted, [*layout.notes, *notes, *more], layout.about, own)

    for block, lines, cut in log.blocks():
        if not size:
            beginning = _Log(path, layout, choice.columns, choice.date)
            beginning.take(block, lines, cut)
            size = rows_of(part(beginning))
        first = 0
        while first < len(block):
            last = min(len(block), first + size - log.total)
            log.take(block[first:last], lines[first:last], cut and last == len(block))
            total, first = total + last - first, last
            if log.total == size:
                yield part(log)
    notes = log.remarks_and_headings(total)
    if log.total or not total:
        yield part(log, notes)


def look_at(path: Path) -> Layout:
    """Return the layout of a text log, by its beginning; raise InputError where it is none."""
    with path.open("rb") as file:
        head = file.read(SNIFF)
        encoding = encoding_of(head)
        if encoding is None:
            raise InputError("a recording must be text, NetCDF, HDF5 or Parquet, got other binary data")
        while head.startswith(OWN_MARK.encode()) and b"\n" not in head[:-SNIFF] and len(head) < _LONGEST_OWN_LINE:
            if not (data := file.read(SNIFF)):  # our first line may be long
                break
            head += data
        return layout_of(head, encoding, len(file.read(1)) == 0, str(path))


@dataclass
class _Words:
    """Cells that hold a word in place of a number (`OVERLOAD`), or lines of words; `at`: their rows."""

    rule: str = "a sample must be a number"
    count: int = 0
    first: str = ""
    where: str = ""
    at: list[int] = field(default_factory=list)

    def add(self, text: str, where: str, row: int = 0) -> None:
        if not self.count:
            self.first, self.where = text.strip()[:40], where
        self.count += 1
        self.at.append(row)

    def note(self, what: str, most: float) -> list[str]:
        """Return a line for the history, where there are any; raise InputError where there are more than `most`."""
        if self.count > most:
            raise InputError(f"{self.rule}, got {self.first!r} {self.where}")
        return [f"{what}, first {self.first!r} {self.where}"] if self.count else []


class _Log:
    """The rows of a text log, and the columns of those taken so far; `kinds` and `date` are those of `Prepare`."""

    def __init__(self, path: Path, layout: Layout, kinds: Mapping[int, str], date: int | None) -> None:
        self.path, self.layout, self.kinds, self.date, self.place = path, layout, kinds, date, str(path)
        self.least = max(kinds) + 1
        self.remarks, self.repeated = _Words(), 0
        plain = layout.encoding in ("utf-8", "utf-8-sig", "cp1252") and layout.delimiter != " "
        numeric = not layout.cell_units and "texts" not in kinds.values()
        self.fast = plain and numeric and path.stat().st_size >= _LARGE and find_spec("pyarrow") is not None
        self.stamped: bool | None = None
        self.dated = False
        self._begin()

    def _begin(self) -> None:
        self.total = 0
        self.parts: dict[int, list[NDArray[Any]]] = {column: [] for column in self.kinds}
        self.words = {column: _Words() for column in self.kinds}

    def blocks(self) -> Iterator[tuple[_Rows, Sequence[int], bool]]:
        """Yield blocks of rows, their lines' numbers, and whether the last one was not written whole."""
        layout, usual, first = self.layout, 0, True
        with self.path.open("rb") as file:
            for number, block, cut in _blocks(file, layout.encoding, self.place):
                if self.fast and not cut:
                    values = self._plain(number, block)
                    self.fast, first = values is not None or not first, False
                    if values is not None:
                        usual = self.width
                        yield values, range(number, number + len(values)), False
                        continue
                lines = _lines(block, layout)
                kept = self._samples(lines, max(0, layout.first_row + 1 - number))
                if not kept:
                    continue
                where: Sequence[int] = [number + i for i in kept]
                rows = self._cells([lines[i] for i in kept], where, cut)
                if cut and len(rows[-1]) < usual and _HALF_A_NUMBER.fullmatch(rows[-1][-1]):
                    # a last line without an end was not written whole: half a number and what follows it are missing
                    rows[-1] = [*rows[-1][:-1], *[""] * (self.least - len(rows[-1]) + 1)]
                usual = len(rows[-1])
                rows, where = self._checked(rows, where)
                if rows:
                    yield rows, where, cut

    def _plain(self, number: int, block: bytes) -> NDArray[np.float64] | None:
        """Return the columns (n, k) of a block from line `number` on; None where a row is no row of plain numbers."""
        from pyarrow import ArrowInvalid, csv, float64, py_buffer

        layout, start = self.layout, 0
        for _ in range(max(0, layout.first_row + 1 - number)):
            start = block.find(b"\n", start) + 1
        self.width = width = block.count(layout.delimiter.encode(), start, block.find(b"\n", start)) + 1
        if any(block.find(mark, start) >= 0 for mark in _MARKS) or not self.least <= width <= len(layout.labels):
            return None
        if b"\r" in block and block.count(b"\r") != block.count(b"\r\n"):
            return None
        wanted = [str(column) for column in self.kinds]
        try:
            table = csv.read_csv(
                py_buffer(block).slice(start),
                csv.ReadOptions(column_names=[*map(str, range(width))], block_size=len(block)),
                csv.ParseOptions(delimiter=layout.delimiter, quote_char=False),
                csv.ConvertOptions(
                    include_columns=wanted,
                    column_types=dict.fromkeys(wanted, float64()),
                    null_values=["NaN", *MISSING],
                    decimal_point=layout.decimal,
                ),
            )
        except ArrowInvalid:
            return None
        values = np.empty((table.num_rows, len(wanted)), order="F")
        for index, column in enumerate(table.columns):
            values[:, index] = column.to_numpy()
        return None if np.isinf(values).any() else values

    def _samples(self, lines: Sequence[str], first: int) -> list[int]:
        """Return the indices of the lines from `first` on that are no comments, blank or repeated headings."""
        blank = " " if self.layout.delimiter == "\t" else None  # tabs alone are a row of missing samples
        kept = [
            i for i in range(first, len(lines)) if lines[i].strip(blank) and not lines[i].lstrip().startswith(COMMENTS)
        ]
        own = [i for i in kept if lines[i].strip() not in self.layout.above] if self.layout.above else kept
        self.repeated += len(kept) - len(own)
        return own

    def _cells(self, lines: list[str], numbers: Sequence[int], cut: bool) -> list[list[str]]:
        """Split lines into cells; a quotation mark must be closed on its line, but on one that was `cut` short."""
        delimiter = self.layout.delimiter
        if delimiter == " ":
            return [blank_cells(line) for line in lines]
        if not any('"' in line for line in lines):
            return [line.split(delimiter) for line in lines]
        reader = csv.reader([*lines, ""], delimiter=delimiter, skipinitialspace=True)
        rows: list[list[str]] = []
        for line, row in enumerate(reader):
            if reader.line_num > line + 1:  # the line goes on in the next
                if cut and line == len(lines) - 1:
                    return [*rows, [*row[:-1], ""]]
                raise InputError(
                    f"a quotation mark must be closed on its line, got an open one (line {numbers[line]}, {self.place})"
                )
            rows.append(row)
        return rows[:-1]

    def _checked(self, rows: list[list[str]], numbers: Sequence[int]) -> tuple[list[list[str]], Sequence[int]]:
        """Return rows and their numbers without short ones of words, which are counted; refuse any other width."""
        layout, most, kept = self.layout, len(self.layout.labels), []
        if min(map(len, rows)) >= self.least and max(map(len, rows)) <= most:
            return rows, numbers
        for i, row in enumerate(rows):
            short = len(row) < self.least
            valued = sum(map(len, row)) > _LONGEST_REMARK or (
                short and any(is_value(cell, layout.decimal) for cell in row)
            )
            if short and not valued:
                self.remarks.add(layout.delimiter.join(row), f"(line {numbers[i]}, {self.place})")
            elif short or any(cell.strip() for cell in row[most:]):
                raise InputError(
                    f"a row must have {counted(most, 'cell')}, got {len(row)} (line {numbers[i]}, {self.place})"
                )
            else:
                kept.append(i)
        return [rows[i] for i in kept], [numbers[i] for i in kept]

    def take(self, rows: _Rows, lines: Sequence[int], cut: bool) -> None:
        """Read more rows; `cut`: whether the last one was not written whole."""
        before, self.total = self.total, self.total + len(rows)
        check_size(self.total, len(self.kinds))
        if isinstance(rows, np.ndarray):
            self.stamped = False
            for part, numeric in zip(self.parts.values(), rows.T, strict=True):
                part.append(numeric)
            return
        for column, kind in self.kinds.items():
            cells = [row[column] for row in rows]
            where = partial(self._place_of, lines=lines, column=column)
            if unit := self.layout.cell_units.get(column):
                cells = plain_cells(cells, unit, cut, where)
            if kind == "texts":
                check_texts(self.total, max(map(len, cells)), self.layout.labels[column].whole)
                values: NDArray[Any] = np.array(cells, dtype=object)
            elif kind == "time" and self._is_stamped(cells, rows):
                if self.dated and self.date is not None:
                    days = [row[self.date].strip() for row in rows]
                    cells = [f"{day} {cell.strip()}" if cell.strip() else "" for day, cell in zip(days, cells)]  # noqa: B905
                values = self._dates(cells, where, self.words[column], before)
            else:
                values, words = numbers(cells, self.layout.decimal, where)
                if kind == "any":
                    values[words] = np.inf  # no number is, that may stand in a log
                else:
                    for index in words:
                        self.words[column].add(cells[index], where(index), before + index)
            self.parts[column].append(values)

    def _is_stamped(self, cells: Sequence[str], rows: Sequence[Sequence[str]]) -> bool:
        """Return whether the time holds stamps, by its first cell; it may be a time of the day beside a date."""
        if self.stamped is None:
            index = next((i for i, cell in enumerate(cells) if not is_missing(cell)), 0)
            self.stamped = not is_number(cells[index], self.layout.decimal) and is_stamp(cells[index])
            day = rows[index][self.date] if self.date is not None and self.date < len(rows[index]) else ""
            self.dated = self.stamped and ":" in cells[index][:3] and is_stamp(day) and ":" not in day
        return self.stamped

    def _place_of(self, index: int, lines: Sequence[int], column: int) -> str:
        return f"(line {lines[index]}, column {self.layout.labels[column].whole}, {self.place})"

    def _dates(
        self, cells: list[str], where: Callable[[int], str], words: _Words, before: int
    ) -> NDArray[np.datetime64]:
        texts = ["" if is_missing(cell) else cell for cell in cells]
        with suppress(ValueError):
            return stamps(texts)
        for index, text in enumerate(texts):
            if text.strip() and not is_stamp(text) and not any(sign.isdigit() for sign in text):
                words.rule = _STAMP_RULE
                words.add(text, where(index), before + index)
                texts[index] = ""
        try:
            return stamps(texts)
        except ValueError as error:
            bad = int(error.args[0])
            raise InputError(f"{_STAMP_RULE}, got {cells[bad]!r} {where(bad)}") from None

    def finish(self) -> tuple[dict[int, NDArray[Any]], list[str]]:
        """Return the columns taken, and lines for the history; what is taken from now on begins anew."""
        labels, notes, joined = self.layout.labels, list[str](), dict[int, NDArray[Any]]()
        last = [*self.kinds][-1]
        no_time = self.words[last].at if self.kinds[last] == "time" else []
        for column, part in self.parts.items():  # each column's blocks are let go before the next is joined
            joined[column] = np.concatenate(part) if part else np.empty(0)
            part.clear()
            if no_time:  # the rows of a summary, where a word stands in place of the time
                joined[column] = np.delete(joined[column], no_time)
            joined[column].setflags(write=False)  # made here: a recording takes it as it is
        for column, words in self.words.items():
            what = f"column {labels[column].whole}: {counted(words.count, 'cell')} without a number read as missing"
            notes += words.note(what, MOST_WORDS * self.total)
        if self.dated and self.date is not None:
            notes.append(f"date and time joined from columns {labels[self.date].whole} and {labels[last].whole}")
        self._begin()
        return joined, notes

    def remarks_and_headings(self, rows: int) -> list[str]:
        """Return lines for the history on what stands among the `rows`; raise InputError for many remarks."""
        most = max(MOST_WORDS * rows, _MOST_REMARKS)
        lines = f"{counted(self.remarks.count, 'line')} of text among the samples left out"
        repeated = f"{counted(self.repeated, 'line')} of the heading repeated among the samples left out"
        return [*self.remarks.note(lines, most), *([repeated] if self.repeated else [])]


def _blocks(file: BinaryIO, encoding: str, place: str) -> Iterator[tuple[int, bytes, bool]]:
    """Yield (number of the first line, whole lines, False) in bounded blocks; True for a last line without an end."""
    width = 2 if encoding.startswith("utf-16") else 1
    newline = "\n".encode(encoding if width == 2 else "ascii")
    rest, number = b"", 1
    while data := file.read(_CHUNK):
        block = rest + data
        if width == 1 and b"\0" in data:
            line = number + block[: block.index(b"\0")].count(b"\n")
            raise InputError(f"a text log must be text throughout, got binary data (line {line}, {place})")
        end = block.rfind(newline)
        while width == 2 and end >= 0 and end % 2:  # a newline's bytes across two characters
            end = block.rfind(newline, 0, end + 1)
        if end < 0 and len(block) >= _LONGEST_LINE:
            if b"\r" not in block or width == 2:
                raise InputError(f"a text log must have lines, got {len(block)} bytes without ({place})")
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


def write_text(
    path: Path,
    values: Mapping[str, Array],
    units: Mapping[str, str],
    description: Mapping[str, Any],
    delimiter: str,
) -> None:
    """Write `# sealscope: {...}`, the header `t [s],p_A [Pa],...` and one row a sample, to the bit."""
    for name, series in values.items():
        if np.isinf(series).any():
            what = name if name == "t" else f"channel {name}"
            raise InputError(f"{what} must be finite or missing to be written as text, got inf")
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(OWN_MARK + json.dumps(description) + "\n")
        file.write(delimiter.join(f"{name} [{units[name]}]" for name in values) + "\n")
        for start in range(0, len(values["t"]), _ROWS_WRITTEN_AT_ONCE):
            columns = [series[start : start + _ROWS_WRITTEN_AT_ONCE].tolist() for series in values.values()]
            cells = [["" if isnan(value) else repr(value) for value in column] for column in columns]
            file.write("".join(delimiter.join(row) + "\n" for row in zip(*cells, strict=True)))
