"""Cells of a text log: numbers, time stamps, missing samples, words in place of numbers, numbers with units.

`decimal` is the decimal separator of the log, "." or ",".
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import repeat

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.headings.labels import WORDS, Label, is_unit
from sealscope.recordings.formats.times.timebase import is_stamp
from sealscope.units import parse_unit

#: Texts that loggers write for a missing sample, in lower case.
MISSING = frozenset({"", *WORDS["missing"]})
MAX_WORD_FRACTION = 0.01  # largest fraction of a column's cells that may be words, as loggers write on overflow
#: Longest number, and longest number with its unit [characters].
_MAX_NUMBER, _MAX_QUANTITY = 400, 80
#: Decimal separator -> pattern of a number.
_NUMBER = {
    ".": re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eEdD][+-]?\d+)?|[+-]?inf(?:inity)?", re.IGNORECASE),
    ",": re.compile(r"[+-]?(?:\d+(?:,\d+)?|,\d+)(?:[eEdD][+-]?\d+)?|[+-]?inf(?:inity)?", re.IGNORECASE),
}
#: Numbers with thousands separators, all of them the same.
_GROUPED = {
    ".": re.compile(r"[+-]?[1-9]\d{0,2}(?P<separator>[,'\u2019 \u00a0\u202f])\d{3}(?:(?P=separator)\d{3})*(?:\.\d*)?"),
    ",": re.compile(r"[+-]?[1-9]\d{0,2}(?P<separator>[.'\u2019 \u00a0\u202f])\d{3}(?:(?P=separator)\d{3})*(?:,\d*)?"),
}
#: A number with its unit, `20 bar` or `12,5 mm`.
_QUANTITY = re.compile(
    r"(?P<number>[+\-\u2212]?\d(?:[\d.,'\u00a0\u202f]{0,40}\d)?(?:[eE][+-]?\d{1,3})?)[ \u00a0\u202f]{0,2}"
    r"(?P<unit>[^\W\d_][^\s;,|\d\"]{0,15}[23\u00b2\u00b3]?|%|\u00b0C?)"
)
#: A number with the prefix of a power of ten behind it, `170.3m` or `-3k`, at the end of a cell.
_PREFIXED = re.compile(r"(?<=\d)(?P<prefix>[pnu\u00b5\u03bcmkKMG])(?=[ ]{0,8}\"?[ ]{0,8}(?:[;,|\t]|$))")
_POWERS = {"p": -12, "n": -9, "u": -6, "\u00b5": -6, "\u03bc": -6, "m": -3, "k": 3, "K": 3, "M": 6, "G": 9}
_MAX_UNITS = 64  # most different units that are looked up for a file


def is_missing(cell: str) -> bool:
    """Test whether a cell of a log stands for a missing sample: it is empty, or a mark such as `NaN` or `--`."""
    return cell.strip().lower() in MISSING


def is_number(cell: str, decimal: str) -> bool:
    """Test whether a cell is a number, or `inf`, with the decimal separator `decimal`; thousands may be separated."""
    cell = cell.strip()
    return len(cell) <= _MAX_NUMBER and bool(_NUMBER[decimal].fullmatch(cell) or is_grouped(cell, decimal))


def is_grouped(cell: str, decimal: str) -> bool:
    """Test whether a cell is a number with thousands separators, such as `1,234.5` for the decimal separator "."."""
    return _GROUPED[decimal].fullmatch(cell.strip()) is not None


def is_value(cell: str, decimal: str) -> bool:
    """Test whether a cell is a number with the decimal separator `decimal`, or a time stamp."""
    return is_number(cell, decimal) or is_stamp(cell)


def parse_numbers(cells: Sequence[str], decimal: str, format_place: Callable[[int], str]) -> tuple[Array, list[int]]:
    """Parse a column's cells to doubles (n,), NaN for words and missing samples; also return the indices of words.

    `format_place`: index of a cell -> its place, for messages. Raises InputError for an infinite number.
    """
    # with a decimal comma a point is not a decimal separator: `?` makes `float` refuse the cell
    texts = [cell.replace(".", "?").replace(",", ".") for cell in cells] if decimal == "," else cells
    try:
        if any("_" in text for text in texts):  # Python takes 1_000 for a number
            raise ValueError
        values = np.fromiter(map(float, texts), np.float64, len(texts))
    except ValueError:
        values = np.fromiter(map(_parse_number, cells, texts, repeat(decimal)), np.float64, len(cells))
    word_indices = [index for index in np.flatnonzero(~np.isfinite(values)).tolist() if not is_missing(cells[index])]
    for index in word_indices:
        if is_number(cells[index], decimal):
            text = cells[index].strip()[:40]
            raise InputError(f"a sample must be a finite number, got {text!r} {format_place(index)}")
    return values, word_indices


def _parse_number(cell: str, cell_with_point: str, decimal: str) -> float:
    """Parse a cell to a double, NaN if it is not a number; thousands separators and Fortran exponents are allowed.

    `decimal`: decimal separator of the cell; `cell_with_point`: the same cell with "." as the decimal separator.
    """
    with suppress(ValueError):
        return np.nan if "_" in cell_with_point else float(cell_with_point)  # Python takes 1_000 for a number
    text = cell.strip().replace("\u2212", "-")
    if match := _GROUPED[decimal].fullmatch(text):
        text = text.replace(match["separator"], "")
    if not is_number(text, decimal):
        return np.nan
    return float(text.replace(",", ".").lower().replace("d", "e"))  # Fortran exponents: 1.5D+03


def has_prefixes(rows: Sequence[Sequence[str]]) -> bool:
    """Test whether the numbers in `rows` of cells end in SI prefixes, such as `170.3m`, and not in units.

    An ending is a prefix if it is never a unit, such as `k`, or if numbers of its column have another ending or none.
    """
    prefixes_by_column: dict[int, set[str]] = {}
    for row in rows:
        for column, cell in enumerate(row):
            match = _PREFIXED.search(cell)
            digits = cell if match is None else cell[: match.start()]
            if not (is_number(digits, ".") or is_number(digits, ",")):
                continue
            if match is not None:
                prefixes_by_column.setdefault(column, set()).add(match["prefix"])
            elif re.search("[1-9]", digits):  # zero needs no prefix
                prefixes_by_column.setdefault(column, set()).add("")
    never_units = {"k", "u", "\u00b5", "\u03bc"}
    return any(len(prefixes) > 1 or prefixes & never_units for prefixes in prefixes_by_column.values())


def expand_prefixes(line: str) -> str:
    """Replace the SI prefixes at the ends of the numbers in a line by exponents: `170.3m` becomes `170.3e-3`."""
    return _PREFIXED.sub(lambda match: f"e{_POWERS[match['prefix']]}", line)


def _trailing_unit(cell: str) -> str | None:
    """Find the text, not always a known unit, after the number in a cell such as `20 bar`; None for other cells."""
    cell = cell.strip()
    match = _QUANTITY.fullmatch(cell) if len(cell) <= _MAX_QUANTITY else None
    return None if match is None else match["unit"]


def find_cell_units(rows: Sequence[Sequence[str]]) -> dict[int, str]:
    """Find the most frequent unit in the cells of each column; return column -> unit.

    A column is left out unless over half of the `rows` have a known unit in it.
    """
    is_known: dict[str, bool] = {}
    counts: dict[int, Counter[str]] = {}
    for row in rows:
        for column, cell in enumerate(row):
            unit = None if is_value(cell, ".") or is_value(cell, ",") else _trailing_unit(cell)
            if unit is None:
                continue
            if unit not in is_known:
                is_known[unit] = len(is_known) < _MAX_UNITS and is_unit(unit)
            if is_known[unit]:
                counts.setdefault(column, Counter())[unit] += 1
    return {column: units.most_common(1)[0][0] for column, units in counts.items() if 2 * units.total() > len(rows)}


def remove_units(line: str, units: Iterable[str]) -> str:
    """Remove `units` from a line of a log, where they follow a number at the end of a cell."""
    pattern = "|".join(re.escape(unit) for unit in sorted(set(units), key=len, reverse=True))
    return re.sub(rf"(?<=[\d.])[ \u00a0\u202f]{{0,2}}(?:{pattern})(?=[ ]{{0,8}}\"?[ ]{{0,8}}(?:[;,|\t]|$))", "", line)


def add_units(labels: Sequence[Label], units: Mapping[int, str], place: str) -> list[Label]:
    """Add the units in cells, column -> unit, to headings that state none; raise InputError if one states another."""
    result = []
    for column, label in enumerate(labels):
        unit = units.get(column)
        if unit and label.unit and not (is_unit(label.unit) and parse_unit(label.unit) == parse_unit(unit)):
            raise InputError(
                f"a column must have one unit, got {label.unit[:40]} in its heading and {unit} in its cells "
                f"(column {label.whole}, {place})"
            )
        result.append(label if label.unit is not None else replace(label, unit=unit))
    return result


def strip_unit(cells: Sequence[str], unit: str, is_cut: bool, format_place: Callable[[int], str]) -> list[str]:
    """Remove the unit after the number from each cell of a column; words, and zeros without a unit, stay as they are.

    `is_cut`: the last cell may be incomplete, and becomes empty if it does not end in `unit`. Raises InputError for a
    number with another unit, and for a number other than zero without a unit.
    """
    result = [cell.strip() for cell in cells]
    for index, text in enumerate(result):
        if text.endswith(unit):
            result[index] = text[: -len(unit)].rstrip()
        elif is_cut and index == len(cells) - 1:
            result[index] = ""
        # another unit, or a number without a unit that has a digit other than 0
        elif _trailing_unit(text) is not None or (text[:1] in "+-\u2212.,0123456789" and text.strip("+-\u22120.,")):
            place = format_place(index)
            raise InputError(f"a cell must be in {unit}, like others in its column, got {text[:40]!r} {place}")
    return result
