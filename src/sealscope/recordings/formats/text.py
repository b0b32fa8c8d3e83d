"""Text logs: CSV files written by Sealscope, and logs of other programs.

A log is read in blocks of complete lines: by pyarrow, if installed, where they contain only numbers, else row by row.
"""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from itertools import chain, pairwise
from math import inf, isnan
from os import SEEK_CUR
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.paragraphs import format_count
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.cells import (
    MAX_WORD_FRACTION,
    MISSING,
    expand_prefixes,
    is_missing,
    is_number,
    is_value,
    parse_numbers,
    strip_unit,
)
from sealscope.recordings.formats.columns import Request, choose_columns
from sealscope.recordings.formats.headings.labels import Label, is_time
from sealscope.recordings.formats.headings.preamble import scope_start
from sealscope.recordings.formats.table import (
    MAX_VALUES,
    Clock,
    RecordingFields,
    Series,
    build_fields,
    check_size,
    check_texts,
    convert_columns,
    parse_description,
    read_times,
)
from sealscope.recordings.formats.text_layout import (
    COMMENTS,
    DESCRIPTION_MARK,
    SNIFF,
    Layout,
    detect_encoding,
    detect_layout,
    split_at_blanks,
)
from sealscope.recordings.formats.times.timebase import (
    TimeState,
    ambiguous_dates,
    explicit_order,
    is_day_first,
    is_day_first_beside,
    is_falling,
    is_stamp,
    parse_stamps,
)

#: Bytes read at a time; for pyarrow `_ARROW_FACTOR` times as many.
_CHUNK, _ARROW_FACTOR = 2**19, 4
_MAX_LINE = 2**23  # longest line [bytes]
_MIN_ARROW_SIZE = 2**20  # smallest log [bytes] for which pyarrow is imported
#: Characters that begin quoted cells and comments.
_MARKS = (b'"', b"#", b"%", b"/", b"!")
_MAX_DESCRIPTION = 64 * 1024 * 1024  # longest description in the first line [bytes]
_ROWS_PER_WRITE = 8192
#: Most lines of text among few samples (marks of events, a summary), and the longest such line.
_MAX_TEXT_LINES, _MAX_TEXT_LINE = 8, 400
_STAMP_RULE = "time must be a stamp such as 2024-05-31T12:00:00.002"
_PARTIAL_NUMBER = re.compile(r"[\s+\-\d.,:TeE]{0,40}")
#: The number at the end of a time column's name: `t.1` of pandas, `Time 2 - slow` of catman.
_NUMBER_SUFFIX = re.compile(r"[\s._(-]{0,4}\d{1,4}\b.{0,60}")


def read_text(path: Path, request: Request) -> RecordingFields:
    """Read the requested columns of a text log to the fields of a recording."""
    return next(read_text_parts(path, request, inf))


def read_text_parts(path: Path, request: Request, every: float, rows: float | None = None) -> Iterator[RecordingFields]:
    """Yield a text log in parts of `every` [s], each as the fields of a recording, in bounded memory.

    All parts but the last have the same number of rows: `rows` or, without it, `every` times the sampling rate of the
    first rows. The log is a single part if these are infinite, if it begins with the last sample, if each channel has a
    time column, or if it is a long table, in which each row is one sample of a named channel.
    """
    layout = read_layout(path)
    description = None if layout.description is None else parse_description(layout.description)
    time_columns = _find_channel_times(layout.labels)
    choice = None
    with suppress(InputError):  # the log may be a long table
        choice = choose_columns(layout.labels, request, layout.rate)
    if choice is None or time_columns:
        try:
            table = _read_several_clocks(path, layout, time_columns, request)
        except InputError:
            if choice is None:
                raise
            # else the columns called times are not one for each channel: the log is read with a single time
        else:
            yield table
            return
    log = _Log(path, layout, kinds=choice.columns, date=choice.date, wordy=choice.wordy)

    def make_part(rows: _Rows, state: TimeState, more_notes: Sequence[str] = ()) -> RecordingFields:
        """Convert a part of the log to fields; update `state`, that of the time column after the previous part."""
        columns, notes = log.take_columns(rows)
        notes = [*layout.notes, *notes, *more_notes]
        return convert_columns(
            choice, columns, layout.kind, request, notes, remarks=layout.remarks, description=description, state=state
        )

    blocks = log.iter_blocks()
    rows_per_part, state = inf, TimeState()
    first = next(blocks, None)
    is_reversed = first is not None and choice.time is not None and is_falling(first.columns[choice.time])
    if first is not None and min(every, inf if rows is None else rows) < inf and not is_reversed:
        # convert the first block to know its rate; then forget its last time
        rows_per_part = max(1, round(every * make_part(_Rows.from_block(first), state).rate)) if rows is None else rows
        state = TimeState(state.head, state.rate, state.resolution)
    pending = _Rows()
    for part in log.collect_rows([] if first is None else chain([first], blocks), rows_per_part):
        if len(pending):
            yield make_part(pending, state)
        pending = part
    # the last part notes the lines that were left out of the whole log
    yield make_part(pending, state, log.describe_text_lines())


def _read_several_clocks(path: Path, layout: Layout, time_columns: Sequence[int], request: Request) -> RecordingFields:
    """Read a log in which each channel has its own sampling times, in the last of the `time_columns` before its column.

    If there are no `time_columns`, the log is a long table: each row is one sample of a named channel.
    """
    cells_by_column: dict[int, NDArray[Any]] = {}
    columns = [column for column in range(len(layout.labels)) if column not in time_columns]
    time_of_column: dict[int, int] = {}
    if time_columns:
        time_of_column = {column: max(time for time in time_columns if time < column) for column in columns}

    def prepare(kinds: Mapping[int, str], date: int | None) -> Sequence[str]:
        """Read the columns with the indices `kinds` in `columns`, and their times; return lines for the history.

        `date`: column of the date in a long table, whose indices in `columns` are the columns' numbers.
        """
        kinds_by_column = {columns[index]: kind for index, kind in kinds.items()}
        time_kinds = {time_of_column[column]: "time" for column in kinds_by_column if time_columns}
        log = _Log(path, layout, kinds_by_column | time_kinds, None if time_columns else date)
        cells, notes = log.take_columns(next(log.collect_rows(log.iter_blocks(), inf), _Rows()))
        cells_by_column.update(cells)
        notes_on_times = [f"{len(time_kinds)} columns of times, one for each channel"] if time_columns else []
        return [*layout.notes, *notes, *log.describe_text_lines(), *notes_on_times]

    def make_series(column: int, clock: Clock | None = None) -> Series:
        """Make the series of a column that `prepare` reads later; its count is 0, as the length is not known yet."""
        return Series("", layout.labels[column], 0, partial(cells_by_column.__getitem__, column), clock)

    start = scope_start(layout.remarks)
    clocks = {time: Clock(time, partial(read_times, make_series(time), start)) for time in time_columns}
    # in the order of `columns`, as `prepare` expects
    members = [make_series(column, clocks[time_of_column[column]] if time_columns else None) for column in columns]
    return build_fields(members, request, layout.kind, layout.remarks, layout.rate, prepare=prepare)


def _find_channel_times(labels: Sequence[Label]) -> list[int]:
    """Find the time columns of a log in which each channel, or group of channels, follows a time column of its own.

    The names of the time columns may differ only in a number at the end. Empty for other logs.
    """
    names = [_NUMBER_SUFFIX.sub("", label.name.casefold()) for label in labels]  # without the numbers
    if names.count(names[0]) < 2 or not is_time(labels[0]):
        return []
    times = [column for column, label in enumerate(labels) if is_time(label)]
    have_one_name = len({names[column] for column in times}) == 1
    have_channels = all(next_time - time > 1 for time, next_time in pairwise([*times, len(labels)]))
    return times if len(times) > 1 and have_one_name and have_channels else []


def read_layout(path: Path) -> Layout:
    """Detect the layout of a text log from its beginning; raise InputError if the file is not a text log."""
    with path.open("rb") as file:
        head = file.read(SNIFF)
        encoding = detect_encoding(head)
        if encoding is None:
            raise InputError("a recording must be text, NetCDF, HDF5 or Parquet, got other binary data")
        if head.startswith(DESCRIPTION_MARK.encode()):  # read a long first line and SNIFF bytes after it
            while b"\n" not in head[:-SNIFF] and len(head) < _MAX_DESCRIPTION and (data := file.read(SNIFF)):
                head += data
        is_complete = not file.read(1)
        return detect_layout(head, encoding, str(path), is_complete=is_complete)


@dataclass
class _Block:
    """Consecutive rows of a text log."""

    columns: dict[int, NDArray[Any]] = field(default_factory=dict)  # column -> values (n,)
    word_rows: dict[int, NDArray[np.intp]] = field(default_factory=dict)  # column -> rows with a word for a number
    #: Column -> the first of these words with its place; without it if the block is a slice that begins after it.
    first_words: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __getitem__(self, rows: slice) -> _Block:
        """Return the block of the rows in a slice."""
        first, stop, _ = rows.indices(len(self))
        first_words = {
            column: word for column, word in self.first_words.items() if first <= self.word_rows[column][0] < stop
        }
        word_rows = {
            column: indices[(indices >= first) & (indices < stop)] - first for column, indices in self.word_rows.items()
        }
        return _Block({column: cells[rows] for column, cells in self.columns.items()}, word_rows, first_words)


@dataclass
class _Rows:
    """Rows of a text log, collected from its blocks in arrays with room for more, so that no value is held twice."""

    columns: dict[int, NDArray[Any]] = field(default_factory=dict)  # column -> values (m,), the first `count` in use
    word_rows: dict[int, list[int]] = field(default_factory=dict)  # column -> rows with a word for a number
    first_words: dict[int, str] = field(default_factory=dict)  # column -> the first of them with its place, or ""
    count: int = 0

    @classmethod
    def from_block(cls, block: _Block) -> _Rows:
        """Collect the rows of a single block."""
        rows = cls()
        rows.append(block, len(block))
        return rows

    def __len__(self) -> int:
        return self.count

    def append(self, block: _Block, room: int) -> None:
        """Add the rows of a block; arrays that are full are copied into arrays with room for `room` rows."""
        stop = self.count + len(block)
        for column, cells in block.columns.items():
            values = self.columns.get(column)
            if values is None or values.size < stop or values.dtype != cells.dtype:
                longer = np.empty(max(room, stop), cells.dtype)
                if values is not None and values.dtype == cells.dtype:
                    longer[: self.count] = values[: self.count]
                elif values is not None:  # rows before the first stamp were read as numbers
                    longer[: self.count] = np.datetime64("NaT")
                self.columns[column] = values = longer
            values[self.count : stop] = cells
        for column, indices in block.word_rows.items():
            if indices.size:
                if column not in self.word_rows:
                    self.first_words[column] = block.first_words.get(column, "")
                self.word_rows.setdefault(column, []).extend((indices + self.count).tolist())
        self.count = stop


class _Log:
    """Reader of the rows of a text log, block by block; a word is a text in place of a number or a time stamp."""

    def __init__(
        self, path: Path, layout: Layout, kinds: Mapping[int, str], date: int | None, wordy: Container[int] = ()
    ) -> None:
        """Prepare to read the log at `path`, and decide if pyarrow can read its layout.

        `kinds`: column to read -> kind of its values: "numbers"; "any", i.e. numbers with inf in place of words;
        "time"; or "texts". `date`: column of the date that belongs to the time, or None; `wordy`: columns of which any
        number of cells may be words.
        """
        self.path, self.layout, self.kinds, self.date, self.wordy = path, layout, kinds, date, wordy
        self.min_cells = max(kinds) + 1  # fewest cells that a row must have
        self.n_rows = self.n_repeated = self.n_text_lines = 0  # rows, repeated heading lines, lines of text until now
        self.n_bytes, self.file_size = 0, path.stat().st_size  # bytes of these rows; of the file
        self.first_text_line = ""  # the first line of text with its place, for messages
        is_delimited = layout.encoding in ("utf-8", "utf-8-sig", "cp1252") and layout.delimiter != " "
        is_numeric = not layout.cell_units and not layout.prefixed and "texts" not in kinds.values()
        self.uses_arrow = (
            is_delimited and is_numeric and self.file_size >= _MIN_ARROW_SIZE and find_spec("pyarrow") is not None
        )
        self.null_values = ["", "NaN"]  # texts that pyarrow reads as missing
        self.has_stamps: bool | None = None  # True if the time column contains date stamps; None before its first cell
        self.has_date = False  # True if a date column completes these stamps
        self.day_first: bool | None = None  # None until the first date such as 05/06/2024
        self.order_note = ""  # line for the history if the dates leave the order of day and month open
        self.n_words = Counter[int]()  # column -> number of words
        self.first_words: dict[int, str] = {}  # column -> the log's first word with its place, for messages
        self.last_width = 0  # number of cells in the last row

    def iter_blocks(self) -> Iterator[_Block]:
        """Yield the rows of the log in blocks, read by pyarrow as far as possible, else row by row."""
        for first_line, content, end, is_cut in self._iter_line_blocks():
            block = self._read_by_arrow(first_line, content, end) if self.uses_arrow and not is_cut else None
            if block is None:
                if first_line == 1:  # pyarrow cannot read this layout; a later block may just contain a word or comment
                    self.uses_arrow = False
                rows, line_numbers = self._split_rows(first_line, content[:end], is_cut)
                self._count_rows(len(rows))
                block = self._parse_rows(rows, line_numbers, is_cut) if rows else None
            self.n_bytes += end
            if block is not None:
                yield block

    def collect_rows(self, blocks: Iterable[_Block], size: float) -> Iterator[_Rows]:
        """Collect the rows of blocks, divided where necessary, in parts of `size` rows; the last may have fewer.

        If `size` is inf, all rows are in a single part.
        """
        part = _Rows()
        for block in blocks:
            # rows of the whole log, if those that follow are as long
            n_expected = min(round(1.02 * self.n_rows * self.file_size / self.n_bytes), MAX_VALUES // len(self.kinds))
            room, remaining_block = int(min(size, n_expected)), block
            while len(part) + len(remaining_block) >= size:
                n_missing = int(size) - len(part)
                part.append(remaining_block[:n_missing], room)
                yield part
                part, remaining_block = _Rows(), remaining_block[n_missing:]
            if len(remaining_block):
                part.append(remaining_block, room)
        if len(part):
            yield part

    def _iter_line_blocks(self) -> Iterator[tuple[int, bytes, int, bool]]:
        """Yield the log in blocks of lines: (number of the first line, from 1; bytes; end; is_cut).

        The bytes before index `end` are complete lines; the others come again in the next block. Lines end at a
        newline; in a one-byte encoding, those of a block without any newline end at a carriage return. Only the last
        block may have an incomplete last line, without a line end: then `is_cut` is True, and `end` is the block's
        length. In a one-byte encoding, it is the block's only line. Raises InputError for binary data, and for a line
        that is too long.
        """
        encoding = self.layout.encoding
        character_bytes = 2 if encoding.startswith("utf-16") else 1
        newline = "\n".encode(encoding if character_bytes == 2 else "ascii")
        first_line, n_bytes = 1, _CHUNK
        with self.path.open("rb") as file:
            while block := file.read(n_bytes):
                while (end := _last_newline(block, newline)) < 0 and len(block) < _MAX_LINE:
                    if not (more := file.read(n_bytes)):
                        break
                    block += more
                if character_bytes == 1 and b"\0" in block:
                    line = first_line + block[: block.index(b"\0")].count(b"\n")
                    raise InputError(f"a text log must be text throughout, got binary data (line {line}, {self.path})")
                if end < 0 and character_bytes == 1:
                    end = block.rfind(b"\r")
                if end < 0:
                    if len(block) >= _MAX_LINE:
                        raise InputError(f"a text log must have lines, got {len(block)} bytes without")
                    yield first_line, block, len(block), True
                    return
                end += character_bytes
                file.seek(end - len(block), SEEK_CUR)  # reading again costs less than copying the block
                yield first_line, block, end, False
                # numpy counts newlines faster than bytes does
                characters = np.frombuffer(block, f"<u{character_bytes}", end // character_bytes)
                n_lines = int(np.count_nonzero(characters == int.from_bytes(newline, "little")))
                first_line += n_lines or block.count(b"\r", 0, end)
                n_bytes = _CHUNK * (_ARROW_FACTOR if self.uses_arrow else 1)

    def _split_rows(self, first_line: int, block: bytes, is_cut: bool) -> tuple[list[list[str]], Sequence[int]]:
        """Split a block of bytes of the log into rows of cells; also return the line number of each row.

        Lines that are not samples are left out. `first_line`, `is_cut`: as in `_iter_line_blocks`. If a cut last line
        has fewer cells than the row before, its last number is left out.
        """
        lines = _decode_lines(block, self.layout)
        samples = self._select_samples(lines, max(0, self.layout.first_row + 1 - first_line))
        if self.layout.prefixed:
            lines = [expand_prefixes(line) for line in lines]
        if not samples:
            return [], []
        line_numbers = [first_line + i for i in samples]
        rows = self._split_lines([lines[i] for i in samples], line_numbers, is_cut)
        if is_cut and len(rows[-1]) < self.last_width and _PARTIAL_NUMBER.fullmatch(rows[-1][-1]):
            # the last cell is a partial number: it and the cells that the file lacks are missing
            rows[-1] = [*rows[-1][:-1], *[""] * (self.min_cells - len(rows[-1]) + 1)]
        self.last_width = len(rows[-1])
        return self._remove_text_rows(rows, line_numbers)

    def _count_rows(self, n_rows: int) -> None:
        """Count rows that were read; raise InputError if the columns then have too many values."""
        self.n_rows += n_rows
        check_size(self.n_rows, len(self.kinds))

    def _read_by_arrow(self, first_line: int, block: bytes, end: int) -> _Block | None:
        """Read the rows of a block of bytes by pyarrow; `first_line`, `end`: as in `_iter_line_blocks`.

        Returns None unless all cells to read are plain finite numbers or missing.
        """
        from pyarrow import ArrowInvalid, csv, float64, py_buffer

        layout, start = self.layout, 0
        for _ in range(max(0, layout.first_row + 1 - first_line)):  # skip the lines above the first row
            start = block.find(b"\n", start) + 1
        width = block.count(layout.delimiter.encode(), start, block.find(b"\n", start)) + 1
        if not self.min_cells <= width <= len(layout.labels):
            return None
        if len(self.kinds) < width and any(block.find(mark, start, end) >= 0 for mark in _MARKS):
            return None  # unread columns could contain quoted cells
        if block.find(b"\r", 0, end) >= 0 and block.count(b"\r", 0, end) != block.count(b"\r\n", 0, end):
            return None  # carriage returns inside a line
        names = [str(column) for column in self.kinds]
        table = None
        # a short list of the marks of missing samples is faster; once it fails, the long one is used for all blocks
        for nulls in (self.null_values, ["NaN", *MISSING]):
            with suppress(ArrowInvalid):
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
                self.null_values = nulls
                break
        if table is None:
            return None
        result = _Block({column: _arrow_values(cells) for column, cells in zip(self.kinds, table.columns, strict=True)})
        if any(np.isinf(cells).any() for cells in result.columns.values()):
            return None
        self.has_stamps, self.last_width = False, width  # the times are numbers, too
        self._count_rows(len(result))
        return result

    def _select_samples(self, lines: Sequence[str], first: int) -> list[int]:
        """List the indices of lines with samples, from `first` on: no comments, blank lines or repeated headings."""
        blank = " " if self.layout.delimiter == "\t" else None  # a line of tabs is a row of missing samples
        content = [
            i for i in range(first, len(lines)) if lines[i].strip(blank) and not lines[i].lstrip().startswith(COMMENTS)
        ]
        headings = self.layout.lines_above
        rows = [i for i in content if lines[i].strip() not in headings] if headings else content
        self.n_repeated += len(content) - len(rows)
        return rows

    def _split_lines(self, lines: list[str], line_numbers: Sequence[int], is_cut: bool) -> list[list[str]]:
        """Split lines of the log into cells; raise InputError for a quotation mark that is not closed on its line.

        In a last line within which the file ends (`is_cut`), such a cell becomes empty instead.
        """
        delimiter = self.layout.delimiter
        if delimiter == " ":
            return [split_at_blanks(line) for line in lines]
        if not any('"' in line for line in lines):
            return [line.split(delimiter) for line in lines]
        # a cell with an open quotation mark in the last line continues in the empty line, which shows it
        reader = csv.reader([*lines, ""], delimiter=delimiter, skipinitialspace=True)
        rows: list[list[str]] = []
        for line, row in enumerate(reader):
            if reader.line_num > line + 1:  # a quoted cell continues on the next line
                if is_cut and line == len(lines) - 1:
                    return [*rows, [*row[:-1], ""]]
                place = f"(line {line_numbers[line]}, {self.path})"
                raise InputError(f"a quotation mark must be closed on its line, got an open one {place}")
            rows.append(row)
        return rows[:-1]  # without the empty line

    def _remove_text_rows(
        self, rows: list[list[str]], line_numbers: Sequence[int]
    ) -> tuple[list[list[str]], Sequence[int]]:
        """Remove short rows of text, such as a note by the logger; return the other rows and their line numbers.

        A row of text has fewer cells than a sample needs, no value and at most `_MAX_TEXT_LINE` characters; these rows
        are counted. Raises InputError for any other row with too few cells, or with too many that are not blank.
        """
        layout, max_cells = self.layout, len(self.layout.labels)
        if min(map(len, rows)) >= self.min_cells and max(map(len, rows)) <= max_cells:
            return rows, line_numbers
        complete_rows: list[int] = []
        for i, row in enumerate(rows):
            is_short = len(row) < self.min_cells
            has_value = any(is_value(cell, layout.decimal) for cell in row)
            place = f"(line {line_numbers[i]}, {self.path})"
            if is_short and not has_value and sum(map(len, row)) <= _MAX_TEXT_LINE:
                self.first_text_line = self.first_text_line or f"{layout.delimiter.join(row).strip()[:40]!r} {place}"
                self.n_text_lines += 1
            elif is_short or any(cell.strip() for cell in row[max_cells:]):
                raise InputError(f"a row must have {format_count(max_cells, 'cell')}, got {len(row)} {place}")
            else:
                complete_rows.append(i)
        return [rows[i] for i in complete_rows], [line_numbers[i] for i in complete_rows]

    def _parse_rows(self, rows: Sequence[Sequence[str]], line_numbers: Sequence[int], is_cut: bool) -> _Block:
        """Parse rows of cells to a block of values; `line_numbers`: line of each row; `is_cut`: the last is incomplete.

        Words become NaN or NaT and are counted in `n_words`; in a column of the kind "any" they become inf, uncounted.
        """
        block = _Block()
        for column, kind in self.kinds.items():
            cells = [row[column] for row in rows]
            format_place = partial(self._format_place, line_numbers=line_numbers, column=column)
            values: NDArray[Any]
            word_rows: list[int] = []
            if unit := self.layout.cell_units.get(column):
                cells = strip_unit(cells, unit, is_cut, format_place)
            if kind == "texts":
                check_texts(self.n_rows, max(map(len, cells)), self.layout.labels[column].whole)
                values = np.array(cells, dtype=object)
            elif kind == "time" and self._is_stamped(cells, rows):
                cells = self._join_dates(rows, column)
                values, word_rows = self._parse_dates(cells, format_place)
            else:
                values, word_rows = parse_numbers(cells, self.layout.decimal, format_place)
                if kind == "any":
                    values[word_rows] = np.inf  # tells words from numbers, which are finite in a log
                    word_rows = []
            block.columns[column] = values
            if word_rows:
                block.word_rows[column] = np.array(word_rows)
                self.n_words[column] += len(word_rows)
                first_word = cells[word_rows[0]].strip()[:40]
                block.first_words[column] = f"{first_word!r} {format_place(word_rows[0])}"
                self.first_words.setdefault(column, block.first_words[column])
        return block

    def _is_stamped(self, cells: Sequence[str], rows: Sequence[Sequence[str]]) -> bool:
        """Test whether the time column, with `cells` in `rows`, contains dates or times of day as text, not numbers.

        The first cell that is not missing decides for the whole log, and sets `has_stamps`, and `has_date`: True if the
        stamps are times of day, and the cell in the date column is a date.
        """
        index = next((i for i, cell in enumerate(cells) if not is_missing(cell)), None)
        if self.has_stamps is None and index is not None:
            self.has_stamps = not is_number(cells[index], self.layout.decimal) and is_stamp(cells[index])
            row = rows[index]
            date_cell = row[self.date] if self.date is not None and self.date < len(row) else ""
            is_time_of_day = ":" in cells[index][:3]  # as in `12:00:00`
            self.has_date = self.has_stamps and is_time_of_day and is_stamp(date_cell) and ":" not in date_cell
        return bool(self.has_stamps)

    def _join_dates(self, rows: Sequence[Sequence[str]], column: int) -> list[str]:
        """Prefix the times in `column` with the dates of their rows, if the log has dates; "" if either is missing."""
        if not self.has_date or self.date is None:
            return [row[column] for row in rows]
        days = [row[self.date].strip() if self.date < len(row) else "" for row in rows]
        times = [row[column].strip() for row in rows]
        return [f"{day} {time}" if day and time else "" for day, time in zip(days, times, strict=True)]

    def _format_place(self, index: int, line_numbers: Sequence[int], column: int) -> str:
        """Format the line, column and file of the cell in row `index` of a block, whose `line_numbers` are given."""
        return f"(line {line_numbers[index]}, column {self.layout.labels[column].whole}, {self.path})"

    def _parse_dates(
        self, cells: list[str], format_place: Callable[[int], str]
    ) -> tuple[NDArray[np.datetime64], list[int]]:
        """Parse cells of the time column to time stamps (n,), NaT for empty cells and words (texts without digits).

        Also returns the indices of the words. At the first ambiguous date, such as 05/06/2024, the log's dates decide
        `day_first`. Raises InputError for texts with digits that are not stamps.
        """
        texts = ["" if cell.strip().lower() in MISSING else cell for cell in cells]
        if self.day_first is None and ambiguous_dates(texts):
            self.day_first = self._detect_day_first()
        with suppress(ValueError):
            return parse_stamps(texts, bool(self.day_first)), []
        word_rows = [
            index
            for index, text in enumerate(texts)
            if text.strip() and not is_stamp(text) and not any(character.isdigit() for character in text)
        ]
        for index in word_rows:
            texts[index] = ""
        try:
            return parse_stamps(texts, bool(self.day_first)), word_rows
        except ValueError as error:
            bad_row = int(error.args[0])  # as `parse_stamps` states
            raise InputError(f"{_STAMP_RULE}, got {cells[bad_row]!r} {format_place(bad_row)}") from None

    def _detect_day_first(self) -> bool:
        """Detect if the day precedes the month, from the log's beginning to the first date with a number over 12.

        Without such a date, the file's name or the logs beside it decide (`is_day_first_beside`), or else the order is
        guessed (`is_day_first`), and `order_note` says so.
        """
        log = _Log(self.path, self.layout, self.kinds, self.date)  # reads ahead without changing this reader
        columns = [column for column, kind in self.kinds.items() if kind == "time"]
        dates: list[dict[str, None]] = [{} for _ in columns]
        with suppress(InputError):  # errors are raised when the row is read again
            for first_line, content, end, is_cut in log._iter_line_blocks():
                rows, _line_numbers = log._split_rows(first_line, content[:end], is_cut)
                for column, column_dates in zip(columns, dates, strict=True):
                    column_dates.update(ambiguous_dates(self._join_dates(rows, column)))
                if any(explicit_order(date) is not None for date in dates):
                    break
        first_date = next((date for column_dates in dates for date in column_dates), "")
        if all(explicit_order(date) is None for date in dates):
            if (order_beside := is_day_first_beside(self.path, first_date)) is not None:
                return order_beside
            order = is_day_first(dates)
            self.order_note = f"dates read as {'day, month' if order else 'month, day'}: none has a number over 12"
            return order
        return is_day_first(dates)

    def take_columns(self, rows: _Rows) -> tuple[dict[int, NDArray[Any]], list[str]]:
        """Take the columns of `rows`, column -> values (n,), which empties it; also return lines for the history.

        Rows with a word as the time are left out. Raises InputError if the log has had too many words until now.
        """
        labels = self.layout.labels
        notes: list[str] = []
        columns: dict[int, NDArray[Any]] = {}
        last_column = [*self.kinds][-1]  # the time, if there is one
        for column, kind in self.kinds.items():
            n_words = len(rows.word_rows.get(column, ()))
            if n_words and column not in self.wordy and self.n_words[column] > MAX_WORD_FRACTION * self.n_rows:
                is_stamp_column, first_word = self.has_stamps and kind == "time", self.first_words[column]
                raise InputError(f"{_STAMP_RULE if is_stamp_column else 'a sample must be a number'}, got {first_word}")
            if n_words:
                first = rows.first_words[column]
                cells_text = f"{format_count(n_words, 'cell')} without a number read as missing"
                notes.append(f"column {labels[column].whole}: {cells_text}" + (f", first {first}" if first else ""))
            cells = rows.columns.pop(column, np.empty(0))
            if self.has_stamps and kind == "time" and cells.dtype.kind == "f":  # all rows are before the first stamp
                cells = np.full(cells.size, "NaT", "M8[ns]")
            cells.resize(len(rows), refcheck=False)  # gives the rest back, and copies nothing
            # rows with a word in place of the time belong to a summary
            if self.kinds[last_column] == "time" and (summary_rows := rows.word_rows.get(last_column)):
                cells = np.delete(cells, summary_rows)
            cells.setflags(write=False)  # so that the recording does not copy it
            columns[column] = cells
        notes += [self.order_note] if self.order_note else []
        if self.has_date and self.date is not None:
            notes.append(f"date and time joined from columns {labels[self.date].whole} and {labels[last_column].whole}")
        return columns, notes

    def describe_text_lines(self) -> list[str]:
        """Describe the text and repeated headings that were left out; raise InputError for too many lines of text."""
        if self.n_text_lines > max(MAX_WORD_FRACTION * self.n_rows, _MAX_TEXT_LINES):
            raise InputError(f"a sample must be a number, got {self.first_text_line}")
        notes = []
        if self.n_text_lines:
            lines = format_count(self.n_text_lines, "line")
            notes.append(f"{lines} of text among the samples left out, first {self.first_text_line}")
        if self.n_repeated:
            notes.append(f"{format_count(self.n_repeated, 'line')} of the heading repeated among the samples left out")
        return notes


def _last_newline(block: bytes, newline: bytes) -> int:
    """Find the index of the last `newline` in a block of bytes, even if it has two bytes as in UTF-16; -1 if none."""
    end = block.rfind(newline)
    while end >= 0 and end % len(newline):
        end = block.rfind(newline, 0, end + 1)
    return end


def _decode_lines(block: bytes, layout: Layout) -> list[str]:
    """Decode a block of bytes and split it into lines, without their ends."""
    text = block.decode(layout.encoding, errors="replace").lstrip("\ufeff")
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    return text.removesuffix("\n").split("\n")


def write_text(
    path: Path, values: Mapping[str, Array], units: Mapping[str, str], description: Mapping[str, Any], delimiter: str
) -> None:
    """Write the content of `Recording.series` as a text log, without loss.

    It consists of the line `# sealscope: {...}` with the description, the header `t [s],p_A [Pa],...` and one row per
    sample. Missing samples become empty cells. Raises InputError for an infinite sample.
    """
    for name, series in values.items():
        if np.isinf(series).any():
            channel = name if name == "t" else f"channel {name}"
            raise InputError(f"{channel} must be finite or missing to be written as text, got inf")
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(DESCRIPTION_MARK + json.dumps(description) + "\n")
        file.write(delimiter.join(f"{name} [{units[name]}]" for name in values) + "\n")
        for start in range(0, len(values["t"]), _ROWS_PER_WRITE):
            columns = [series[start : start + _ROWS_PER_WRITE].tolist() for series in values.values()]
            cells = [["" if isnan(value) else repr(value) for value in column] for column in columns]
            file.write("".join(delimiter.join(row) + "\n" for row in zip(*cells, strict=True)))


def _arrow_values(cells: Any) -> Array:
    """Convert a pyarrow ChunkedArray of doubles to an array (n,), with NaN for null.

    Pyarrow's `to_numpy` would load pandas. Each chunk has a buffer of bits, 1 for known values, and one of values.
    """
    parts = []
    for chunk in cells.chunks:
        validity, values = chunk.buffers()
        first, stop = chunk.offset, chunk.offset + len(chunk)
        part = np.frombuffer(values, np.float64, count=stop)[first:]
        if chunk.null_count:
            bits = np.unpackbits(np.frombuffer(validity, np.uint8), count=stop, bitorder="little")[first:]
            part = np.where(bits, part, np.nan)
        parts.append(part)
    return parts[0] if len(parts) == 1 else np.concatenate([*parts, np.empty(0)])  # empty: there may be no chunk
