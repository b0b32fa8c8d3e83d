"""Tables as files of CSV, written whole or not at all."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sealscope.storage.atomic import atomic_write

#: What a cell begins with that a spreadsheet takes for a formula.
_SIGNS, _NUMBER = ("=", "+", "-", "@", "\t", "\r"), re.compile(r"[+-]?[\d.]+(?:e[+-]?\d+)?|-")


def guard_cell(value: Any) -> Any:
    """Return a cell that a spreadsheet takes for no formula and a terminal obeys nothing of; numbers stay.

    Names and comments come from outside. A text that begins like a formula gets an apostrophe; what cannot be printed
    becomes its escape.
    """
    if not isinstance(value, str):
        return value
    text = "".join(sign if sign.isprintable() or sign == "\n" else repr(sign)[1:-1] for sign in value)
    return f"'{text}" if value.startswith(_SIGNS) and not _NUMBER.fullmatch(value) else text


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows, numbers in full, texts guarded (`guard_cell`); ValueError for a row with a value of no column."""
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file,
    ):
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: guard_cell(value) for name, value in row.items()} for row in rows)
