"""Write tables as CSV files, atomically and safe to open in a spreadsheet."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sealscope.errors import escape_text
from sealscope.storage.atomic import atomic_write

#: Beginnings of a cell that spreadsheets read as a formula.
_FORMULA_BEGINNINGS = ("=", "+", "-", "@", "\t", "\r")
#: Cells that may begin so although they are not formulas: numbers, and a single dash.
_NUMBER = re.compile(r"[+-]?[\d.]+(?:e[+-]?\d+)?|-")


def guard_cell(value: Any) -> Any:
    """Escape a text that a spreadsheet would execute like a formula, or a terminal like a command.

    A text that begins like a formula and is not a number gets an apostrophe in front, by which a spreadsheet takes it
    as text. Unprintable characters except line feeds are escaped. Other values are returned unchanged.
    """
    if not isinstance(value, str):
        return value
    text = escape_text(value, kept="\n")
    return f"'{text}" if value.startswith(_FORMULA_BEGINNINGS) and not _NUMBER.fullmatch(value) else text


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> int:
    """Write rows, mappings from column to value, as a CSV file with these `columns`; return the number of rows.

    `guard_cell` escapes the texts. A missing value gives an empty cell. Raises ValueError if a row has another column,
    and InputError if the file cannot be written.
    """
    n_rows = 0
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file,
    ):
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({name: guard_cell(value) for name, value in row.items()})
            n_rows += 1
    return n_rows
