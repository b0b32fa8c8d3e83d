"""Write tables as CSV files, atomically and safe for spreadsheets."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sealscope.storage.atomic import atomic_write

#: Beginnings of a cell that spreadsheets read as a formula, and numbers, which are none.
_FORMULA_BEGINNINGS, _NUMBER = ("=", "+", "-", "@", "\t", "\r"), re.compile(r"[+-]?[\d.]+(?:e[+-]?\d+)?|-")


def guard_cell(value: Any) -> Any:
    """Escape a text that a spreadsheet would read as a formula or a terminal would obey; numbers stay.

    Names and comments may come from outside. A text that begins like a formula gets an apostrophe; unprintable
    characters are escaped.
    """
    if not isinstance(value, str):
        return value
    text = "".join(
        character if character.isprintable() or character == "\n" else repr(character)[1:-1] for character in value
    )
    return f"'{text}" if value.startswith(_FORMULA_BEGINNINGS) and not _NUMBER.fullmatch(value) else text


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write `rows`, column -> value, as CSV, texts escaped (`guard_cell`); raise ValueError for an unknown column."""
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file,
    ):
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: guard_cell(value) for name, value in row.items()} for row in rows)
