"""Spreadsheets (Excel's .xlsx, .xlsb and .xls, OpenDocument's .ods), with python-calamine.

A sheet is written as tab-separated text and read as a text log, so that all rules for text logs apply.
"""

from __future__ import annotations

import datetime as dt
import re
import tempfile
import zipfile
from collections.abc import Iterable, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any

from sealscope.errors import InputError
from sealscope.paragraphs import join_names
from sealscope.recordings.formats.columns import Request
from sealscope.recordings.formats.libraries import import_library
from sealscope.recordings.formats.table import RecordingFields, check_size
from sealscope.recordings.formats.text import read_text
from sealscope.storage.opening import check_unpacked, max_unpacked_size

_CHUNK = 2**20
_N_ROWS = 500  # rows from which texts that are numbers with a decimal comma are detected
_MAX_HEADING = 30  # rows in which merged cells are headings
#: A number with a decimal comma, as text, and one that may also be a whole number with separated thousands.
_COMMA_NUMBER = re.compile(r"\s*[+-]?(?:\d{1,3}(?:\.\d{3})+|\d+),\d+(?:[eE][+-]?\d+)?\s*")
_THOUSANDS = re.compile(r"\s*[+-]?[1-9]\d{0,2},\d{3}\s*")


def read_spreadsheet(path: Path, request: Request) -> RecordingFields:
    """Read the requested columns of a spreadsheet, from the first sheet that has all of them.

    Visible sheets are tried before hidden ones, and longer before shorter ones. If all fail, the first error is raised.
    """
    _check_members(path)
    workbook = import_library("python_calamine", "a spreadsheet", "python-calamine").CalamineWorkbook.from_path(
        str(path)
    )
    sheets = [workbook.get_sheet_by_name(name) for name in workbook.sheet_names]
    hidden_names = {member.name for member in workbook.sheets_metadata if not str(member.visible).endswith(".Visible")}
    sheets = [sheet for sheet in sheets if sheet.total_height]
    sheets.sort(key=lambda sheet: (sheet.name in hidden_names, -sheet.total_height))
    first_error = InputError("a workbook must have a sheet with rows, got none")
    for number, sheet in enumerate(sheets):
        check_size(sheet.total_height, sheet.total_width)
        try:
            table = _read_sheet(sheet, request, str(path))
        except InputError as error:
            first_error = first_error if number else error  # that of the first sheet, number 0
            continue
        table = table._replace(kind="spreadsheet", provenance=table.provenance | {"format": "spreadsheet"})
        unread = [name for name in workbook.sheet_names if name != sheet.name]
        return table.with_note(f"sheet {sheet.name} read, not {join_names(unread, 4)}") if unread else table
    raise first_error


def _check_members(path: Path) -> None:
    """Raise UnreadableFile or BadZipFile if the members of a workbook, a ZIP archive, are damaged or too large."""
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        check_unpacked(sum(member.file_size for member in members), max_unpacked_size(path), path)
        for member in members:  # zipfile reads no more than the stated size, and then checks the CRC
            with archive.open(member) as file:
                while file.read(_CHUNK):
                    pass


def _read_sheet(sheet: Any, request: Request, place: str) -> RecordingFields:
    """Read a sheet as a text log; errors name the sheet and the workbook `place` instead of the temporary file."""
    with tempfile.TemporaryDirectory(prefix="sealscope-") as folder:
        text = Path(folder) / "sheet.tsv"
        with text.open("w", encoding="utf-8", newline="\n") as file:
            rows = iter(sheet.iter_rows())
            head = _fill_merged(list(islice(rows, _N_ROWS)), getattr(sheet, "merged_cell_ranges", None) or ())
            comma_columns = _find_comma_columns(head)
            for row in chain(head, rows):
                cells = [*map(_format_cell, row)]
                for column in comma_columns:
                    cells[column] = _use_point(cells[column])
                file.write("\t".join(cells) + "\n")
        try:
            return read_text(text, request)
        except InputError as error:
            message, sheet_place = str(error), f"sheet {sheet.name}, {place}"
            names_file = str(text) in message
            raise InputError(
                message.replace(str(text), sheet_place) if names_file else f"{message} ({sheet_place})"
            ) from None


def _fill_merged(rows: list[list[Any]], ranges: Iterable[Any]) -> list[list[Any]]:
    """Write the text of merged cells, in the heading, in all of them; `ranges`: ((row, column), (row, column)) each."""
    for (first_row, first_column), (last_row, last_column) in ranges:
        if last_row >= min(len(rows), _MAX_HEADING):
            continue
        value = rows[first_row][first_column]
        if isinstance(value, str):
            for row in rows[first_row : last_row + 1]:
                row[first_column : last_column + 1] = [value] * len(row[first_column : last_column + 1])
    return rows


def _find_comma_columns(rows: Sequence[Sequence[Any]]) -> set[int]:
    """Find the columns whose numbers are texts with a decimal comma.

    Raises InputError if the commas of all these texts may as well separate thousands.
    """
    texts: dict[int, list[str]] = {}
    for row in rows:
        for column, cell in enumerate(row):
            if isinstance(cell, str) and _COMMA_NUMBER.fullmatch(cell):
                texts.setdefault(column, []).append(cell)
    if texts and all(_THOUSANDS.fullmatch(cell) for cells in texts.values() for cell in cells):
        example = next(iter(texts.values()))[0].strip()
        raise InputError(f"a number must be no text whose comma may separate decimals or thousands, got {example!r}")
    return {*texts}


def _use_point(cell: str) -> str:
    """Replace the decimal comma of a number by a point; return other texts as they are."""
    return cell.replace(".", "").replace(",", ".") if _COMMA_NUMBER.fullmatch(cell) else cell


def _format_cell(value: Any) -> str:
    """Format a cell: numbers with all digits, times in ISO form, durations in seconds; truth values stay empty."""
    if isinstance(value, bool | None):  # `=IF(test, value)` is FALSE where there is no sample
        return ""
    if isinstance(value, float | int):
        return repr(value)
    if isinstance(value, dt.timedelta):
        return repr(value.total_seconds())
    if isinstance(value, dt.datetime | dt.date | dt.time):
        return value.isoformat()
    return str(value).translate(str.maketrans("\t\r\n", "   "))  # these separate cells and rows
