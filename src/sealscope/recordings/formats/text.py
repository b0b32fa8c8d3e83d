"""Text logs: Sealscope's own CSV, and those that other people's loggers write.

A log is read in blocks of whole lines. A block that is a plain rectangle of numbers is read by pyarrow, where it is
installed, any other one row by row.
"""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from itertools import accumulate, chain
from math import inf, isnan
from os import SEEK_CUR
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
    with_exponents,
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
from sealscope.recordings.formats.timebase import (
    LogTime,
    day_before_month,
    either_dates,
    falling,
    is_stamp,
    stamps,
    stated_order,
)

#: Bytes that are read at a time, so many times more by pyarrow, and bytes of the longest line.
_CHUNK, _FAST, _LONGEST_LINE = 2**19, 4, 2**23
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


def read_text(path: Path, request: Wanted) -> RecordingFields:
    """Read the wanted columns of a text log."""
    return next(read_text_parts(path, request, inf))


def read_text_parts(path: Path, request: Wanted, every: float) -> Iterator[RecordingFields]:
    """Yield the wanted columns of a text log in parts of `every` seconds at its first rate, in bounded memory.

    A log with a time for each channel, one that begins with its last sample and a long table are one part.
    """
    layout = look_at(path)
    description = None if layout.own is None else parse_description(layout.own)
    times = _times_of_channels(layout.labels)
    choice = None
    with suppress(InputError):
        choice = choose_columns(layout.labels, request, layout.rate)
    if choice is None or times:
        try:
            table = _several_clocks(path, layout, times, request)
        except InputError:
            if choice is None:
                raise
        else:
            yield table
            return
    log = _Log(path, layout, choice.columns, choice.date)

    def part(blocks: list[_Block], time: LogTime, more: Sequence[str] = ()) -> RecordingFields:
        columns, notes = log.join_blocks(blocks)
        notes = [*layout.notes, *notes, *more]
        return converted(choice, columns, layout.kind, request, notes, layout.about, description, time)

    blocks, size, time = log.blocks(), inf, LogTime()
    first = next(blocks, None)
    backwards = first is not None and choice.time is not None and falling(first.columns[choice.time])
    if first is not None and every < inf and not backwards:
        size = max(1, round(every * part([first[:]], time).rate))
        time = LogTime(time.head, time.rate, time.resolution)
    before: list[_Block] = []
    for blocks_of_part in _split_blocks([] if first is None else chain([first], blocks), size):
        if before:
            yield part(before, time)
        before = blocks_of_part
    yield part(before, time, log.remarks_and_headings())


def _several_clocks(path: Path, layout: Layout, times: Sequence[int], request: Wanted) -> RecordingFields:
    """Read a log in which each channel follows its own one of the columns `times`, or a long table."""
    held: dict[int, NDArray[Any]] = {}
    columns = [column for column in range(len(layout.labels)) if column not in times]
    owner = {column: max(time for time in times if time < column) for column in columns} if times else {}

    def prepare(kinds: Mapping[int, str], date: int | None) -> Sequence[str]:
        used = {columns[number]: kind for number, kind in kinds.items()}
        read = {owner[column]: "time" for column in used if times}
        log = _Log(path, layout, used | read, None if times else date)
        cells, notes = log.join_blocks([*log.blocks()])
        held.update(cells)
        note = [f"{len(read)} columns of times, one for each channel"] if times else []
        return [*layout.notes, *notes, *log.remarks_and_headings(), *note]

    def series(column: int, clock: Clock | None = None) -> Series:
        return Series("", layout.labels[column], 0, partial(held.__getitem__, column), clock)

    start = exported_from(layout.about)
    clocks = {time: Clock(time, partial(seconds_of_series, series(time), start)) for time in times}
    members = [series(column, clocks[owner[column]] if times else None) for column in columns]
    return table_of(members, request, layout.kind, layout.about, layout.rate, prepare=prepare)


def _times_of_channels(labels: Sequence[Label]) -> list[int]:
    """Return the columns of times, of one name but for a number, which each channel or group of channels follows."""
    names = [_NUMBER.sub("", label.name.casefold()) for label in labels]
    if names.count(names[0]) < 2 or not is_time(labels[0]):
        return []
    times = [column for column, label in enumerate(labels) if is_time(label)]
    separate = all(after - before > 1 for before, after in zip(times, [*times[1:], len(labels)], strict=True))
    return times if len({names[column] for column in times}) == 1 and len(times) > 1 and separate else []


def _split_blocks(blocks: Iterable[_Block], size: float) -> Iterator[list[_Block]]:
    """Yield blocks that together have `size` rows, the last ones fewer."""
    held: list[_Block] = []
    room = size
    for block in blocks:
        rest = block
        while len(rest) >= room:
            yield [*held, rest[: int(room)]]
            held, room, rest = [], size, rest[int(room) :]
        if len(rest):
            held.append(rest)
            room -= len(rest)
    if held:
        yield held


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
class _Block:
    """Rows of a log: its columns (n,); of the cells that hold a word in place of a number, the rows and the first."""

    columns: dict[int, NDArray[Any]] = field(default_factory=dict)
    words: dict[int, NDArray[np.intp]] = field(default_factory=dict)
    first: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __getitem__(self, rows: slice) -> _Block:
        first, stop, _ = rows.indices(len(self))
        words = {
            column: indices[(indices >= first) & (indices < stop)] - first for column, indices in self.words.items()
        }
        return _Block({column: cells[rows] for column, cells in self.columns.items()}, words, self.first)


class _Log:
    """The rows of a text log in blocks; `kinds` and `date` are those of `Prepare`."""

    def __init__(self, path: Path, layout: Layout, kinds: Mapping[int, str], date: int | None) -> None:
        self.path, self.layout, self.kinds, self.date, self.place = path, layout, kinds, date, str(path)
        self.least = max(kinds) + 1
        self.total = self.repeated = self.remarks = 0
        self.remark = ""
        plain = layout.encoding in ("utf-8", "utf-8-sig", "cp1252") and layout.delimiter != " "
        numeric = not layout.cell_units and not layout.prefixed and "texts" not in kinds.values()
        self.fast = plain and numeric and path.stat().st_size >= _LARGE and find_spec("pyarrow") is not None
        self.stamped: bool | None = None
        self.day_first: bool | None = None
        self.order = ""
        self.dated = False
        self.worded = Counter[int]()
        self.nulls, self.width, self.usual = ["", "NaN"], 0, 0

    def blocks(self) -> Iterator[_Block]:
        """Yield the rows in blocks that are read one after the other."""
        layout, first = self.layout, True
        with self.path.open("rb") as file:
            for number, block, end, cut in _blocks(
                file, layout.encoding, self.place, lambda: _CHUNK * (_FAST if self.fast and self.width else 1)
            ):
                if self.fast and not cut:
                    plain = self._plain(number, block, end)
                    self.fast, first = plain is not None or not first, False
                    if plain is not None:
                        self.stamped, self.usual = False, self.width
                        self._count(len(plain))
                        yield plain
                        continue
                rows, lines = self._rows(number, block[:end], cut)
                if rows:
                    self._count(len(rows))
                    yield self._read(rows, lines, cut)

    def _rows(self, number: int, block: bytes, cut: bool) -> tuple[list[list[str]], Sequence[int]]:
        """Return the cells of the samples in a block from line `number` on, and the numbers of their lines."""
        lines = _lines(block, self.layout)
        kept = self._samples(lines, max(0, self.layout.first_row + 1 - number))
        if self.layout.prefixed:
            lines = [with_exponents(line) for line in lines]
        if not kept:
            return [], []
        where = [number + i for i in kept]
        rows = self._cells([lines[i] for i in kept], where, cut)
        if cut and len(rows[-1]) < self.usual and _HALF_A_NUMBER.fullmatch(rows[-1][-1]):
            # a last line without an end was not written whole: half a number and what follows it are missing
            rows[-1] = [*rows[-1][:-1], *[""] * (self.least - len(rows[-1]) + 1)]
        self.usual = len(rows[-1])
        return self._checked(rows, where)

    def _count(self, rows: int) -> None:
        self.total += rows
        check_size(self.total, len(self.kinds))

    def _plain(self, number: int, block: bytes, end: int) -> _Block | None:
        """Read a block from line `number` on, up to `end`; None where a row is no row of plain numbers."""
        from pyarrow import ArrowInvalid, csv, float64, py_buffer

        layout, start = self.layout, 0
        for _ in range(max(0, layout.first_row + 1 - number)):
            start = block.find(b"\n", start) + 1
        self.width = width = block.count(layout.delimiter.encode(), start, block.find(b"\n", start)) + 1
        if not self.least <= width <= len(layout.labels):
            return None
        if len(self.kinds) < width and any(block.find(mark, start, end) >= 0 for mark in _MARKS):
            return None  # where all columns are read, none of these signs is part of a number
        if block.find(b"\r", 0, end) >= 0 and block.count(b"\r", 0, end) != block.count(b"\r\n", 0, end):
            return None
        names = [str(column) for column in self.kinds]
        for nulls in (self.nulls, ["NaN", *MISSING]):
            try:
                table = csv.read_csv(
                    py_buffer(block).slice(start, end - start),
                    csv.ReadOptions(column_names=[*map(str, range(width))], block_size=end, use_threads=False),
                    csv.ParseOptions(delimiter=layout.delimiter, quote_char=False),
                    csv.ConvertOptions(
                        include_columns=names,
                        column_types=dict.fromkeys(names, float64()),
                        null_values=nulls,
                        decimal_point=layout.decimal,
                    ),
                )
            except ArrowInvalid:
                table = None
            else:
                self.nulls = nulls
                break
        if table is None:
            return None
        columns = {column: _values_of(cells) for column, cells in zip(self.kinds, table.columns, strict=True)}
        return None if any(np.isinf(cells).any() for cells in columns.values()) else _Block(columns)

    def _samples(self, lines: Sequence[str], first: int) -> list[int]:
        """Return the indices of the lines from `first` on that are no comments, blank or repeated headings."""
        blank = " " if self.layout.delimiter == "\t" else None  # tabs alone are a row of missing samples
        kept = [
            i for i in range(first, len(lines)) if lines[i].strip(blank) and not lines[i].lstrip().startswith(COMMENTS)
        ]
        rows = [i for i in kept if lines[i].strip() not in self.layout.above] if self.layout.above else kept
        self.repeated += len(kept) - len(rows)
        return rows

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
                where = f"(line {numbers[i]}, {self.place})"
                self.remark = self.remark or f"{layout.delimiter.join(row).strip()[:40]!r} {where}"
                self.remarks += 1
            elif short or any(cell.strip() for cell in row[most:]):
                raise InputError(
                    f"a row must have {counted(most, 'cell')}, got {len(row)} (line {numbers[i]}, {self.place})"
                )
            else:
                kept.append(i)
        return [rows[i] for i in kept], [numbers[i] for i in kept]

    def _read(self, rows: Sequence[Sequence[str]], lines: Sequence[int], cut: bool) -> _Block:
        """Read rows of cells; `cut`: whether the last one was not written whole."""
        block = _Block()
        for column, kind in self.kinds.items():
            cells = [row[column] for row in rows]
            where, words = partial(self._place_of, lines=lines, column=column), list[int]()
            if unit := self.layout.cell_units.get(column):
                cells = plain_cells(cells, unit, cut, where)
            if kind == "texts":
                check_texts(self.total, max(map(len, cells)), self.layout.labels[column].whole)
                block.columns[column] = np.array(cells, dtype=object)
            elif kind == "time" and self._is_stamped(cells, rows):
                cells = self._moments(rows, column)
                block.columns[column], words = self._dates(cells, where)
            else:
                block.columns[column], words = numbers(cells, self.layout.decimal, where)
                if kind == "any":
                    block.columns[column][words] = np.inf  # no number is, that may stand in a log
                    continue
            if words:
                block.words[column] = np.array(words)
                self.worded[column] += len(words)
                block.first[column] = f"{cells[words[0]].strip()[:40]!r} {where(words[0])}"
        return block

    def _is_stamped(self, cells: Sequence[str], rows: Sequence[Sequence[str]]) -> bool:
        """Test whether the time holds stamps, by its first cell; it may be a time of the day beside a date."""
        index = next((i for i, cell in enumerate(cells) if not is_missing(cell)), None)
        if self.stamped is None and index is not None:
            self.stamped = not is_number(cells[index], self.layout.decimal) and is_stamp(cells[index])
            day = rows[index][self.date] if self.date is not None and self.date < len(rows[index]) else ""
            self.dated = self.stamped and ":" in cells[index][:3] and is_stamp(day) and ":" not in day
        return bool(self.stamped)

    def _moments(self, rows: Sequence[Sequence[str]], column: int) -> list[str]:
        """Return the cells of a column of stamps, with the date of its own column before a time of the day."""
        if not self.dated or self.date is None:
            return [row[column] for row in rows]
        days = [row[self.date].strip() if self.date < len(row) else "" for row in rows]
        times = [row[column].strip() for row in rows]
        return [f"{day} {time}" if day and time else "" for day, time in zip(days, times, strict=True)]

    def _place_of(self, index: int, lines: Sequence[int], column: int) -> str:
        return f"(line {lines[index]}, column {self.layout.labels[column].whole}, {self.place})"

    def _dates(self, cells: list[str], where: Callable[[int], str]) -> tuple[NDArray[np.datetime64], list[int]]:
        """Return cells as moments (n,), missing ones and words as NaT, and the indices of the words."""
        texts = ["" if cell.strip().lower() in MISSING else cell for cell in cells]
        if self.day_first is None and either_dates(texts):
            self.day_first = self._day_before_month()
        with suppress(ValueError):
            return stamps(texts, bool(self.day_first)), []
        words = [
            index
            for index, text in enumerate(texts)
            if text.strip() and not is_stamp(text) and not any(sign.isdigit() for sign in text)
        ]
        for index in words:
            texts[index] = ""
        try:
            return stamps(texts, bool(self.day_first)), words
        except ValueError as error:
            bad = int(error.args[0])
            raise InputError(f"{_STAMP_RULE}, got {cells[bad]!r} {where(bad)}") from None

    def _day_before_month(self) -> bool:
        """Test whether the day is before the month in the dates of the log, read up to the first unambiguous one."""
        log = _Log(self.path, self.layout, self.kinds, self.date)
        columns = [column for column, kind in self.kinds.items() if kind == "time"]
        dates: list[dict[str, None]] = [{} for _ in columns]
        with suppress(InputError), self.path.open("rb") as file:  # what is wrong with a row is said where it is read
            for number, block, end, cut in _blocks(file, self.layout.encoding, self.place, lambda: _CHUNK):
                rows, _ = log._rows(number, block[:end], cut)
                for column, column_dates in zip(columns, dates, strict=True):
                    column_dates.update(either_dates(self._moments(rows, column)))
                if any(stated_order(date) is not None for date in dates):
                    break
        order = day_before_month(dates)
        if all(stated_order(date) is None for date in dates):
            self.order = f"dates read as {'day, month' if order else 'month, day'}: none has a number over 12"
        return order

    def join_blocks(self, blocks: list[_Block]) -> tuple[dict[int, NDArray[Any]], list[str]]:
        """Return the columns of blocks, which let go of them, and lines for the history; refuse many words."""
        labels, notes, columns = self.layout.labels, list[str](), dict[int, NDArray[Any]]()
        starts, last = [0, *accumulate(map(len, blocks))], [*self.kinds][-1]
        words = {
            column: [
                start + index
                for start, block in zip(starts, blocks, strict=False)
                for index in block.words.get(column, ())
            ]
            for column in self.kinds
        }
        for column, indices in words.items():  # each column's blocks are let go before the next is joined
            first = next((block.first[column] for block in blocks if len(block.words.get(column, ()))), "")
            if indices and self.worded[column] > MOST_WORDS * self.total:
                stamped = self.stamped and self.kinds[column] == "time"
                raise InputError(f"{_STAMP_RULE if stamped else 'a sample must be a number'}, got {first}")
            if indices:
                many = f"{counted(len(indices), 'cell')} without a number read as missing"
                notes.append(f"column {labels[column].whole}: {many}, first {first}")
            parts = [block.columns.pop(column) for block in blocks] or [np.empty(0)]
            if self.stamped and self.kinds[column] == "time":  # blocks before the first stamp have no moments
                parts = [np.full(part.shape, "NaT", "M8[ns]") if part.dtype.kind == "f" else part for part in parts]
            cells = np.concatenate(parts)
            # the rows of a summary, where a word stands in place of the time
            cells = np.delete(cells, words[last]) if words[last] and self.kinds[last] == "time" else cells
            cells.setflags(write=False)  # made here: a recording takes it as it is
            columns[column] = cells
        notes += [self.order] if self.order else []
        if self.dated and self.date is not None:
            notes.append(f"date and time joined from columns {labels[self.date].whole} and {labels[last].whole}")
        return columns, notes

    def remarks_and_headings(self) -> list[str]:
        """Return lines for the history on what stands among the rows; raise InputError for many remarks."""
        if self.remarks > max(MOST_WORDS * self.total, _MOST_REMARKS):
            raise InputError(f"a sample must be a number, got {self.remark}")
        remarks = f"{counted(self.remarks, 'line')} of text among the samples left out, first {self.remark}"
        repeated = f"{counted(self.repeated, 'line')} of the heading repeated among the samples left out"
        return [*([remarks] if self.remarks else []), *([repeated] if self.repeated else [])]


def _blocks(
    file: BinaryIO, encoding: str, place: str, chunk: Callable[[], int]
) -> Iterator[tuple[int, bytes, int, bool]]:
    """Yield (number of the first line, bytes, where their whole lines end, whether the last one has no end)."""
    width = 2 if encoding.startswith("utf-16") else 1
    newline = "\n".encode(encoding if width == 2 else "ascii")
    number = 1
    while block := file.read(chunk()):
        while (end := _end(block, newline)) < 0 and len(block) < _LONGEST_LINE and (more := file.read(chunk())):
            block += more
        if width == 1 and b"\0" in block:
            line = number + block[: block.index(b"\0")].count(b"\n")
            raise InputError(f"a text log must be text throughout, got binary data (line {line}, {place})")
        if end < 0 and len(block) >= _LONGEST_LINE:
            if b"\r" not in block or width == 2:
                raise InputError(f"a text log must have lines, got {len(block)} bytes without")
            end = block.rfind(b"\r")
        if end < 0:
            yield number, block, len(block), not block.endswith(b"\r")
            return
        end += width
        file.seek(end - len(block), SEEK_CUR)  # what is read again costs less than a copy of the block
        yield number, block, end, False
        signs = np.frombuffer(block, f"<u{width}", end // width)  # numpy counts them faster than bytes do
        lines = int(np.count_nonzero(signs == int.from_bytes(newline, "little")))
        number += lines or block.count(b"\r", 0, end)


def _end(block: bytes, newline: bytes) -> int:
    """Return where the last newline begins, not across two characters of UTF-16; -1 where there is none."""
    end = block.rfind(newline)
    while end >= 0 and end % len(newline):
        end = block.rfind(newline, 0, end + 1)
    return end


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


def _values_of(cells: Any) -> Array:
    """Return the values (n,) of a pyarrow ChunkedArray of doubles, NaN for null; its own `to_numpy` loads pandas."""
    parts = []
    for chunk in cells.chunks:
        known, values = chunk.buffers()
        first, stop = chunk.offset, chunk.offset + len(chunk)
        part = np.frombuffer(values, np.float64, count=stop)[first:]
        if chunk.null_count:
            bits = np.unpackbits(np.frombuffer(known, np.uint8), count=stop, bitorder="little")[first:]
            part = np.where(bits, part, np.nan)
        parts.append(part)
    return parts[0] if len(parts) == 1 else np.concatenate([*parts, np.empty(0)])
