"""Rewrite a text log whose layout is not recognised as a plain table: one heading, commas, points, ISO 8601 stamps.

A person states what was read wrongly: the first row of samples, the delimiter, the decimal separator or the form of the
time stamps. Everything else is detected as when the log is read. Called by `sealscope mend` and by the workbench.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from sealscope.calls import checked_call
from sealscope.errors import InputError
from sealscope.recordings.files import unpacked_text
from sealscope.recordings.formats.cells import is_missing, is_number, is_value
from sealscope.recordings.formats.text import read_layout
from sealscope.recordings.formats.text_layout import SNIFF, detect_encoding, split_cells
from sealscope.storage.atomic import atomic_write
from sealscope.storage.opening import raising_unreadable

#: Words for delimiters that are hard to type.
DELIMITERS = {"tab": "\t", "blank": " ", "semicolon": ";", "comma": ",", "bar": "|"}
#: Longest line that is read [characters], and columns of a row.
_MAX_LINE, _MAX_CELLS = 2**20, 4096


@dataclass(frozen=True)
class StatedLayout:
    """Layout of a text log as stated by a person; None for values that are detected.

    - `first_row`: number of the line of the first sample, from 1; `heading_row`: that of the headings, by default the
      last line before the first row that has as many cells; 0 if there are no headings;
    - `delimiter`: a character, or one of `DELIMITERS`; `decimal`: "." or ",";
    - `time_format`: form of the time stamps as for `datetime.strptime`, such as "%d.%m.%Y %H:%M:%S.%f"; `time_column`:
      number of their column, from 1.
    """

    first_row: int | None = None
    heading_row: int | None = None
    delimiter: str | None = None
    decimal: str | None = None
    time_format: str | None = None
    time_column: int = 1

    def __post_init__(self) -> None:
        """Check the values; raise InputError for an invalid one."""
        for name in ("first_row", "heading_row", "time_column"):
            value, least = getattr(self, name), 0 if name == "heading_row" else 1
            if value is not None and not least <= value <= 1_000_000:
                raise InputError(f"{name} must be the number of a line or column, {least} to 1000000, got {value}")
        if self.delimiter is not None and self.delimiter not in DELIMITERS and len(self.delimiter) != 1:
            raise InputError(f"delimiter must be a character, or {', '.join(DELIMITERS)}, got {self.delimiter[:40]!r}")
        if self.decimal not in (None, ".", ","):
            raise InputError(f"decimal must be a point or a comma, got {self.decimal!r:.40}")
        if self.time_format is not None and "%" not in self.time_format:
            raise InputError(f"time_format must read like '%d.%m.%Y %H:%M:%S', got {self.time_format[:60]!r}")


class TextPreview(NamedTuple):
    """The first lines of a text log, and how they are read with a stated layout.

    `lines`: the lines as written; `layout`: the layout with the detected values filled in; `heading`: the headings;
    `rows`: the cells of the first rows, as they would be rewritten; `problem`: why they cannot be, "" if they can.
    """

    lines: list[str]
    layout: StatedLayout
    heading: list[str]
    rows: list[list[str]]
    problem: str


def _complete_layout(file: Path, lines: list[str], layout: StatedLayout) -> tuple[StatedLayout, list[str]]:
    """Fill in what is not stated of a layout, from the detected one; also return the headings of the columns."""
    detected = None
    with suppress(InputError, ValueError):
        detected = read_layout(file)
    delimiter = layout.delimiter or (detected.delimiter if detected else ",")
    delimiter = DELIMITERS.get(delimiter, delimiter)
    decimal = layout.decimal or (detected.decimal if detected else ".")
    first = layout.first_row or (detected.first_row + 1 if detected else 1)
    layout = replace(layout, first_row=first, delimiter=delimiter, decimal=decimal)
    width = len(split_cells(lines[first - 1], delimiter)) if first <= len(lines) else 0
    heading_row = layout.heading_row
    if heading_row is None:
        above = [number for number in range(1, first) if number <= len(lines)]
        cells = {number: split_cells(lines[number - 1].strip(), delimiter) for number in above}
        named = [
            number for number in above if abs(len(cells[number]) - width) <= 1 and any(map(str.strip, cells[number]))
        ]
        heading_row = named[-1] if named else 0
        # units below the names: the names are in the row above
        if len(named) > 1 and named[-2] == named[-1] - 1 and all(cell.strip()[:1] in "[(" for cell in cells[named[-1]]):
            heading_row = named[-2]
    heading = (
        [] if not heading_row or heading_row > len(lines) else split_cells(lines[heading_row - 1].strip(), delimiter)
    )
    if 0 < heading_row < first - 1:  # a row of units between headings and samples
        units = split_cells(lines[heading_row].strip(), delimiter)
        if len(units) == len(heading):
            heading = [
                f"{name} {unit.strip()}" if unit.strip()[:1] in tuple("[(") else name
                for name, unit in zip(heading, units, strict=True)
            ]
    heading = [name.strip().strip('"') for name in heading]
    heading += [f"column {number + 1}" for number in range(len(heading), width)]
    if width == 0:
        raise InputError(
            f"the first row must be a line of the log, got line {first} of {len(lines)} that were looked at"
        )
    return replace(layout, heading_row=heading_row), heading[:_MAX_CELLS]


def _rewrite_row(line: str, number: int, layout: StatedLayout, width: int) -> list[str] | None:
    """Rewrite a line's cells with points and ISO stamps; None for a line without a value, such as a remark.

    Raises InputError for a time stamp of another form, and for a row that has too many cells.
    """
    assert layout.delimiter is not None and layout.decimal is not None
    cells = [cell.strip() for cell in split_cells(line, layout.delimiter)]
    if not any(is_value(cell, layout.decimal) for cell in cells) and layout.time_format is None:
        return None
    while len(cells) > width and not cells[-1]:
        cells.pop()
    if len(cells) > width:
        raise InputError(f"a row must have {width} cells, got {len(cells)} (line {number})")
    if layout.decimal == ",":
        cells = [cell.replace(".", "").replace(",", ".") if is_number(cell, ",") else cell for cell in cells]
    index = layout.time_column - 1
    if layout.time_format is not None and index < len(cells) and not is_missing(cells[index]):
        # the separator of the stamp's decimals is part of its format
        stamp = split_cells(line, layout.delimiter)[index].strip()
        try:
            moment = datetime.strptime(stamp, layout.time_format)
        except ValueError:
            if not any(is_number(cell, ".") for cell in cells):
                return None
            raise InputError(f"a time must read {layout.time_format}, got {stamp[:60]!r} (line {number})") from None
        cells[index] = moment.isoformat()
    return cells + [""] * (width - len(cells))


def _iter_lines(file: Path) -> Iterator[str]:
    """Yield the lines of a text file in the detected encoding; raise InputError for one that is too long."""
    with file.open("rb") as content:
        encoding = detect_encoding(content.read(SNIFF))
    if encoding is None:
        raise InputError("a log to mend must be text, got binary data")
    with file.open(encoding=encoding, errors="replace", newline=None) as text:
        while line := text.readline(_MAX_LINE):
            if len(line) == _MAX_LINE:
                raise InputError(f"a line must have at most {_MAX_LINE} characters, got more")
            yield line.rstrip("\n").removeprefix("\ufeff")


def preview_text(path: str | os.PathLike[str], layout: StatedLayout | None = None, count: int = 40) -> TextPreview:
    """Read the first `count` lines of a text log, and show how its first rows are read with a stated layout.

    Raises UnreadableFile if the file is no text. What is wrong with a row is the `problem` of the preview.
    """
    stated = layout or StatedLayout()
    with unpacked_text(Path(path)) as file:
        lines = list(islice(_iter_lines(file), max(count, (stated.first_row or 0) + 10)))
        try:
            full, heading = _complete_layout(file, lines, stated)
        except InputError as error:
            return TextPreview(lines[:count], stated, [], [], str(error))
    rows, problem = list[list[str]](), ""
    assert full.first_row is not None
    for number, line in enumerate(lines[full.first_row - 1 :][:10], full.first_row):
        try:
            row = _rewrite_row(line, number, full, len(heading))
        except InputError as error:
            problem = problem or str(error)
            row = split_cells(line, full.delimiter or ",")
        rows += [] if row is None else [row]
    return TextPreview(lines[:count], full, heading, rows, problem or ("" if rows else "no row has a value"))


@checked_call
def mend(
    path: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    first_row: int | None = None,
    heading_row: int | None = None,
    delimiter: str | None = None,
    decimal: str | None = None,
    time_format: str | None = None,
    time_column: int = 1,
) -> int:
    r"""Rewrite a text log as a plain CSV file, with a stated layout where the detected one is wrong.

    Parameters
    ----------
    path : str or path-like
        The log, which is not changed; it may be in an archive.
    target : str or path-like
        The file to write (.csv), atomically: headings, commas, decimal points, and stamps of ISO 8601.
    first_row, heading_row : int, optional
        Numbers of the lines, from 1, of the first sample and of the headings; 0 for no headings.
    delimiter : str, optional
        A character, or "tab", "blank", "semicolon", "comma", "bar".
    decimal : {".", ","}, optional
        The decimal separator.
    time_format : str, optional
        Form of the time stamps as for `datetime.datetime.strptime`, such as ``"%d.%m.%Y %H:%M:%S,%f"``.
    time_column : int, optional
        Number of the column of the time stamps, from 1.

    Returns
    -------
    int
        The number of rows that were written. Lines without a value are left out.

    Raises
    ------
    UnreadableFile
        The log is missing or no text.
    InputError
        An argument is not valid, a row does not fit it, or the target cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> from sealscope.recordings import mend
    >>> text = "rig 7;;\nrun 3;;\nt;p_A [bar];p_B [bar]\n0,00;3,5;2\n0,01;3,6;2\n"
    >>> _ = Path("odd.txt").write_text(text)
    >>> mend("odd.txt", "plain.csv", first_row=4)
    2
    >>> Path("plain.csv").read_text().splitlines()[:2]
    ['t,p_A [bar],p_B [bar]', '0.00,3.5,2']
    """
    stated = StatedLayout(first_row, heading_row, delimiter, decimal, time_format, time_column)
    if Path(target).suffix.lower() != ".csv":
        raise InputError(f"a mended log's name must end in .csv, got {os.fspath(target)}")
    n_rows = 0
    with ExitStack() as stack:
        file = stack.enter_context(unpacked_text(Path(path)))
        stack.enter_context(raising_unreadable("a log to mend", Path(path)))
        lines = list(islice(_iter_lines(file), max(200, (first_row or 0) + 10)))
        layout, heading = _complete_layout(file, lines, stated)
        assert layout.first_row is not None
        temporary = stack.enter_context(atomic_write(target))
        with temporary.open("w", encoding="utf-8", newline="") as output:
            writer = csv.writer(output, lineterminator="\n")
            writer.writerow(heading)
            for number, line in enumerate(_iter_lines(file), 1):
                if number < layout.first_row or not line.strip():
                    continue
                if (row := _rewrite_row(line, number, layout, len(heading))) is not None:
                    writer.writerow(row)
                    n_rows += 1
        if not n_rows:
            raise InputError("a log to mend must have rows with values, got none")
    return n_rows
