"""Text logs: Sealscope's own CSV, and those that other people's loggers write."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.formats.table import Table, check_size, own_words, read_own_words
from sealscope.recordings.formats.text_layout import (
    COMMENTS,
    MISSING,
    OWN_MARK,
    SNIFF,
    Layout,
    encoding_of,
    is_number,
    layout_of,
)
from sealscope.recordings.recording import Array, Recording
from sealscope.recordings.timebase import is_stamp, stamps

_CHUNK = 8 * 1024 * 1024
_LONGEST_OWN_LINE = 64 * 1024 * 1024
_ROWS_WRITTEN_AT_ONCE = 8192
_HALF_A_NUMBER = re.compile(r"[\s+\-\d.,:TeE]{0,40}")


@contextmanager
def open_text(path: Path) -> Iterator[Table]:
    """The columns of a text log; raises UnreadableFile."""
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
        layout = layout_of(head, encoding, len(file.read(1)) == 0, place)

        def fetch(columns: Sequence[int], time: int | None) -> tuple[list[Array], NDArray[Any] | None]:
            file.seek(0)
            return _columns(file, layout, columns, time, place)

        own = read_own_words(layout.own, place) if layout.own is not None else None
        yield Table(place, layout.kind, layout.labels, fetch, own, layout.notes)


def _own_line(file: BinaryIO, head: bytes) -> bytes:
    """The rest of a long first line of our own, and as much after it as is needed to see the layout."""
    more = b""
    while b"\n" not in head and b"\n" not in more and len(more) < _LONGEST_OWN_LINE:
        data = file.read(SNIFF)
        if not data:
            return more
        more += data
    return more + file.read(SNIFF) if more else b""


def _blocks(file: BinaryIO, encoding: str, place: str) -> Iterator[tuple[int, list[str], bool]]:
    """(number of the first line, whole lines, whether the last line is cut short), in bounded blocks."""
    width = 2 if encoding.startswith("utf-16") else 1
    newline = "\n".encode(encoding if width == 2 else "ascii")
    rest, number = b"", 1
    while True:
        data = file.read(_CHUNK)
        block = rest + data
        if not block:
            return
        if width == 1 and b"\0" in data:
            line = number + block[: block.index(b"\0")].count(b"\n")
            raise UnreadableFile(f"a text log must be text throughout, got binary data (line {line}, {place})")
        if data:
            end = block.rfind(newline)
            while width == 2 and end >= 0 and end % 2:  # a newline's bytes across two characters
                end = block.rfind(newline, 0, end + 1)
            if end < 0:
                if b"\r" not in block or width == 2:
                    raise UnreadableFile(f"a text log must have lines, got {len(block)} bytes without ({place})")
                end = block.rfind(b"\r")
            block, rest = block[: end + width], block[end + width :]
        else:
            rest = b""
        text = block.decode(encoding, errors="replace")
        if "\r" in text:
            text = text.replace("\r\n", "\n").replace("\r", "\n")
        open_end = not text.endswith("\n")
        lines = text.split("\n")
        if not open_end:
            lines.pop()
        if number == 1 and lines:
            lines[0] = lines[0].lstrip("\ufeff")
        yield number, lines, open_end
        number += len(lines)


def _rows(lines: list[str], layout: Layout) -> list[list[str]]:
    if layout.delimiter == " ":
        return [line.split() for line in lines]
    if any('"' in line for line in lines):
        return list(csv.reader(lines, delimiter=layout.delimiter, skipinitialspace=True))
    delimiter = layout.delimiter
    return [line.split(delimiter) for line in lines]


def _columns(
    file: BinaryIO, layout: Layout, columns: Sequence[int], time: int | None, place: str
) -> tuple[list[Array], NDArray[Any] | None]:
    wanted = [*columns, time] if time is not None else list(columns)
    parts: list[list[NDArray[Any]]] = [[] for _ in wanted]
    total = 0
    stamped: bool | None = None
    least = max(wanted) + 1
    usual = 0
    for number, lines, open_end in _blocks(file, layout.encoding, place):
        skip = max(0, layout.first_row + 1 - number)
        blank = " " if layout.delimiter == "\t" else None  # tabs alone are a row of missing samples
        kept = [
            i for i in range(skip, len(lines)) if lines[i].strip(blank) and not lines[i].lstrip().startswith(COMMENTS)
        ]
        if not kept:
            continue
        numbers = [number + i for i in kept]
        rows = _rows([lines[i] for i in kept], layout)
        usual = len(rows[-2]) if len(rows) > 1 else usual
        if open_end and len(rows[-1]) < usual and _HALF_A_NUMBER.fullmatch(rows[-1][-1]):
            # a last line without an end was not written whole: half a number and what follows it are missing
            rows[-1] = [*rows[-1][:-1], *[""] * (least - len(rows[-1]) + 1)]
        if min(map(len, rows)) < least:
            short = next(i for i, row in enumerate(rows) if len(row) < least)
            raise UnreadableFile(
                f"a row must have {len(layout.labels)} cells, got {len(rows[short])} (line {numbers[short]}, {place})"
            )
        if max(map(len, rows)) > len(layout.labels):
            _refuse_extra_cells(rows, numbers, layout, place)
        usual = len(rows[-1])
        odd = any("_" in lines[i] for i in kept)  # Python takes 1_000 for a number
        total += len(rows)
        check_size(total, len(wanted), place)
        if time is not None and stamped is None:
            first = next((row[time] for row in rows if row[time].strip().lower() not in MISSING), "")
            stamped = not is_number(first, layout.decimal) and is_stamp(first)
        for part, column in zip(parts, wanted, strict=True):
            cells = [row[column] for row in rows]
            if stamped and column == time:
                part.append(_dates(cells, numbers, column, layout, place))
            else:
                part.append(_numbers(cells, numbers, column, layout, place, odd))
    arrays = [np.concatenate(part) if part else np.empty(0) for part in parts]
    return (arrays[:-1], arrays[-1]) if time is not None else (arrays, None)


def _refuse_extra_cells(rows: list[list[str]], numbers: Sequence[int], layout: Layout, place: str) -> None:
    most = len(layout.labels)
    for row, number in zip(rows, numbers, strict=True):
        if len(row) > most and any(cell.strip() for cell in row[most:]):
            raise UnreadableFile(f"a row must have {most} cells, got {len(row)} (line {number}, {place})")


def _place_of(index: int, numbers: Sequence[int], column: int, layout: Layout, place: str) -> str:
    return f"(line {numbers[index]}, column {layout.labels[column].whole}, {place})"


def _dates(cells: list[str], numbers: Sequence[int], column: int, layout: Layout, place: str) -> NDArray[np.datetime64]:
    try:
        return stamps(["" if cell.strip().lower() in MISSING else cell for cell in cells])
    except ValueError as error:
        bad = int(error.args[0])
        where = _place_of(bad, numbers, column, layout, place)
        raise UnreadableFile(
            f"time must be a stamp such as 2024-05-31T12:00:00.002, got {cells[bad]!r} {where}"
        ) from None


def _numbers(cells: list[str], numbers: Sequence[int], column: int, layout: Layout, place: str, odd: bool) -> Array:
    """Cells as doubles, missing ones as NaN; the first that is no number is named."""
    if layout.decimal == ",":
        cells = [cell.replace(".", "?").replace(",", ".") for cell in cells]
    try:
        values = np.fromiter(map(_number if odd else float, cells), np.float64, len(cells))
    except ValueError:
        values = np.fromiter(map(_number, cells), np.float64, len(cells))
    suspicious = np.flatnonzero(~np.isfinite(values))
    for index in suspicious.tolist():
        cell = cells[index].strip()
        shown = cell.replace(".", ",").replace("?", ".") if layout.decimal == "," else cell
        if shown.lower() in MISSING:
            continue
        rule = "a finite number" if is_number(cell, ".") else "a number"
        where = _place_of(index, numbers, column, layout, place)
        raise UnreadableFile(f"a sample must be {rule}, got {shown[:40]!r} {where}")
    return values


def _number(cell: str) -> float:
    text = cell.strip()
    try:
        return float(text) if "_" not in text else np.nan
    except ValueError:
        if is_number(text, "."):  # a Fortran exponent, 1.5D+03
            return float(text.lower().replace("d", "e"))
        return np.nan


def write_text(recording: Recording, path: Path, delimiter: str) -> None:
    """Write `# sealscope: {...}`, the header `t [s],p_A [Pa],...` and one row a sample.

    Numbers read back to the same bits; a missing sample is an empty cell. Raises InputError where a value is infinite.
    """
    import json

    names = list(recording.channels)
    for name in names:
        if np.isinf(recording[name]).any():
            raise InputError(f"channel {name} must be finite or missing to be written as text, got inf")
    if np.isinf(recording.t).any():
        raise InputError("t must be finite or missing to be written as text, got inf")
    header = ["t [s]", *(f"{name} [{recording.units[name]}]" for name in names)]
    columns = [recording.t, *recording.channels.values()]
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(OWN_MARK + json.dumps(own_words(recording)) + "\n")
        file.write(delimiter.join(header) + "\n")
        for start in range(0, len(recording), _ROWS_WRITTEN_AT_ONCE):
            part = slice(start, start + _ROWS_WRITTEN_AT_ONCE)
            texts = [list(map(repr, column[part].tolist())) for column in columns]
            for column, cells in zip(columns, texts, strict=True):
                for missing in np.flatnonzero(np.isnan(column[part])).tolist():
                    cells[missing] = ""
            file.write("\n".join(map(delimiter.join, zip(*texts, strict=True))))
            file.write("\n")
