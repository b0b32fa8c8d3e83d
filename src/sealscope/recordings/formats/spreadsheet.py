"""Spreadsheets (Excel's .xlsx, .xlsb and .xls, OpenDocument's .ods), with python-calamine: the sheet with a log.

A sheet is written as text with tabs between its cells and read as any text log, so that headings, unit rows, lines
above the header, stamps and missing cells follow the same rules.
"""

from __future__ import annotations

import datetime as dt
import tempfile
import zipfile
from pathlib import Path
from typing import Any

from sealscope.errors import InputError
from sealscope.recordings.formats.columns import Wanted, listed
from sealscope.recordings.formats.libraries import library
from sealscope.recordings.formats.table import RecordingFields, check_size
from sealscope.recordings.formats.text import read_text
from sealscope.storage.unpacking import check_unpacked, most_unpacked

_CHUNK = 2**20


def read_spreadsheet(path: Path, request: Wanted) -> RecordingFields:
    """Read the wanted columns of the first sheet that holds them: hidden sheets last, those with most rows first."""
    _check_members(path)
    workbook = library("python_calamine", "a spreadsheet", "python-calamine").CalamineWorkbook.from_path(str(path))
    sheets = [workbook.get_sheet_by_name(name) for name in workbook.sheet_names]
    hidden = {member.name for member in workbook.sheets_metadata if not str(member.visible).endswith(".Visible")}
    sheets = [sheet for sheet in sheets if sheet.total_height]
    sheets.sort(key=lambda sheet: (sheet.name in hidden, -sheet.total_height))
    reason = InputError("a workbook must have a sheet with rows, got none")
    for number, sheet in enumerate(sheets):
        check_size(sheet.total_height, sheet.total_width)
        try:
            table = _read_sheet(sheet, request, str(path))
        except InputError as error:
            reason = reason if number else error
            continue
        table = table._replace(kind="spreadsheet", provenance=table.provenance | {"format": "spreadsheet"})
        unread = [name for name in workbook.sheet_names if name != sheet.name]
        return table.with_note(f"sheet {sheet.name} read, not {listed(unread, 4)}") if unread else table
    raise reason


def _check_members(path: Path) -> None:
    """Unpack a workbook's members, and refuse more than it may hold: the sizes that they state may be a lie."""
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        check_unpacked(sum(member.file_size for member in members), most_unpacked(path), path)
        for member in members:
            with archive.open(member) as file:
                while file.read(_CHUNK):
                    pass


def _read_sheet(sheet: Any, request: Wanted, place: str) -> RecordingFields:
    with tempfile.TemporaryDirectory(prefix="sealscope-") as folder:
        text = Path(folder) / "sheet.tsv"
        with text.open("w", encoding="utf-8", newline="\n") as file:
            for row in sheet.iter_rows():
                file.write("\t".join(map(_cell, row)) + "\n")
        try:
            return read_text(text, request)
        except InputError as error:
            line, sheet_place = str(error), f"sheet {sheet.name}, {place}"
            shown = line.replace(str(text), sheet_place) if str(text) in line else f"{line} ({sheet_place})"
            raise InputError(shown) from None


def _cell(value: Any) -> str:
    """Return a cell as text: numbers with all their digits, moments as ISO stamps, lengths of time in seconds."""
    if isinstance(value, bool | None):
        return ""
    if isinstance(value, float | int):
        return repr(value)
    if isinstance(value, dt.timedelta):
        return repr(value.total_seconds())
    if isinstance(value, dt.datetime | dt.date | dt.time):
        return value.isoformat()
    return str(value).translate(str.maketrans("\t\r\n", "   "))
