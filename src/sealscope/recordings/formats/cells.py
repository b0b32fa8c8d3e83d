"""Cells of a text: numbers, moments, what is missing, words in place of numbers, and numbers with their units."""

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
from sealscope.recordings.formats.headings.labels import Label, is_unit
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.recordings.formats.timebase import is_stamp
from sealscope.units import parse_unit

#: What loggers write where a sample is missing, in lower case.
MISSING = frozenset({"", *WORDS["missing"]})
#: Share of a column's cells that may hold a word, as loggers write where the input overflows.
MOST_WORDS = 0.01
_LONGEST_NUMBER, _LONGEST_QUANTITY = 400, 80
_NUMBER = {
    ".": re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eEdD][+-]?\d+)?|[+-]?inf(?:inity)?", re.IGNORECASE),
    ",": re.compile(r"[+-]?(?:\d+(?:,\d+)?|,\d+)(?:[eEdD][+-]?\d+)?|[+-]?inf(?:inity)?", re.IGNORECASE),
}
#: Numbers with a sign between their thousands, the same all through.
_GROUPED = {
    ".": re.compile(r"[+-]?[1-9]\d{0,2}(?P<sign>[,'\u2019 \u00a0\u202f])\d{3}(?:(?P=sign)\d{3})*(?:\.\d*)?"),
    ",": re.compile(r"[+-]?[1-9]\d{0,2}(?P<sign>[.'\u2019 \u00a0\u202f])\d{3}(?:(?P=sign)\d{3})*(?:,\d*)?"),
}
#: A number with its unit, `20 bar` or `12,5 mm`.
_QUANTITY = re.compile(
    r"(?P<number>[+\-\u2212]?\d(?:[\d.,'\u00a0\u202f]{0,40}\d)?(?:[eE][+-]?\d{1,3})?)[ \u00a0\u202f]{0,2}"
    r"(?P<unit>[^\W\d_][^\s;,|\d\"]{0,15}[23\u00b2\u00b3]?|%|\u00b0C?)"
)
#: A number with the prefix of a power of ten behind it, `170.3m` or `-3k`, at the end of a cell.
_PREFIXED = re.compile(r"(?<=\d)(?P<prefix>[pnu\u00b5\u03bcmkKMG])(?=[ ]{0,8}\"?[ ]{0,8}(?:[;,|\t]|$))")
_POWERS = {"p": -12, "n": -9, "u": -6, "\u00b5": -6, "\u03bc": -6, "m": -3, "k": 3, "K": 3, "M": 6, "G": 9}
#: Most spellings of units that the beginning of a file is tried for.
_MOST_UNITS = 64


def is_missing(cell: str) -> bool:
    """Test whether a cell stands for a missing sample."""
    return cell.strip().lower() in MISSING


def is_number(cell: str, decimal: str) -> bool:
    """Test whether the cell is a number with this decimal sign."""
    cell = cell.strip()
    return len(cell) <= _LONGEST_NUMBER and bool(_NUMBER[decimal].fullmatch(cell) or is_grouped(cell, decimal))


def is_grouped(cell: str, decimal: str) -> bool:
    """Test whether the cell is a number with signs between its thousands."""
    return _GROUPED[decimal].fullmatch(cell.strip()) is not None


def is_value(cell: str, decimal: str) -> bool:
    """Test whether the cell is a number or a moment."""
    return is_number(cell, decimal) or is_stamp(cell)


def numbers(cells: Sequence[str], decimal: str, where: Callable[[int], str]) -> tuple[Array, list[int]]:
    """Return cells as doubles (n,), missing ones and words as NaN, and the indices of words; none may be infinite."""
    texts = [cell.replace(".", "?").replace(",", ".") for cell in cells] if decimal == "," else cells
    try:
        if any("_" in text for text in texts):  # Python takes 1_000 for a number
            raise ValueError
        values = np.fromiter(map(float, texts), np.float64, len(texts))
    except ValueError:
        values = np.fromiter(map(_number, cells, texts, repeat(decimal)), np.float64, len(cells))
    words = [index for index in np.flatnonzero(~np.isfinite(values)).tolist() if not is_missing(cells[index])]
    for index in words:
        if is_number(cells[index], decimal):
            raise InputError(f"a sample must be a finite number, got {cells[index].strip()[:40]!r} {where(index)}")
    return values, words


def _number(cell: str, pointed: str, decimal: str) -> float:
    """Return a cell as a double, NaN for a word; `pointed`: with a point for its decimal sign."""
    with suppress(ValueError):
        return np.nan if "_" in pointed else float(pointed)
    text = cell.strip().replace("\u2212", "-")
    if match := _GROUPED[decimal].fullmatch(text):
        text = text.replace(match["sign"], "")
    if not is_number(text, decimal):
        return np.nan
    return float(text.replace(",", ".").lower().replace("d", "e"))  # a Fortran exponent, 1.5D+03


def has_prefixes(rows: Sequence[Sequence[str]]) -> bool:
    """Test whether numbers end in prefixes of powers of ten, and not in a unit: a column has several, or a `k`."""
    found: dict[int, set[str]] = {}
    for row in rows:
        for column, cell in enumerate(row):
            match = _PREFIXED.search(cell)
            bare = match is None and is_number(cell, ".") and float(cell.replace(",", "")) != 0.0
            if match is not None and is_number(cell[: match.start()], "."):
                found.setdefault(column, set()).add(match["prefix"])
            elif bare:
                found.setdefault(column, set()).add("")
    return any(len(prefixes) > 1 or prefixes & {"k", "u", "\u00b5", "\u03bc"} for prefixes in found.values())


def with_exponents(line: str) -> str:
    """Return a line of a log with exponents for the prefixes behind its numbers: `170.3e-3` for `170.3m`."""
    return _PREFIXED.sub(lambda match: f"e{_POWERS[match['prefix']]}", line)


def _unit_behind(cell: str) -> str | None:
    """Return the unit of a cell `20 bar`; None for any other cell, whatever its unit means."""
    cell = cell.strip()
    match = _QUANTITY.fullmatch(cell) if len(cell) <= _LONGEST_QUANTITY else None
    return None if match is None else match["unit"]


def units_behind(rows: Sequence[Sequence[str]]) -> dict[int, str]:
    """Return column -> unit of the columns in which more than half of the cells are a number with a known unit."""
    known: dict[str, bool] = {}
    counts: dict[int, Counter[str]] = {}
    for row in rows:
        for column, cell in enumerate(row):
            unit = None if is_value(cell, ".") or is_value(cell, ",") else _unit_behind(cell)
            if unit is None:
                continue
            if unit not in known:
                known[unit] = len(known) < _MOST_UNITS and is_unit(unit)
            if known[unit]:
                counts.setdefault(column, Counter())[unit] += 1
    return {column: units.most_common(1)[0][0] for column, units in counts.items() if 2 * units.total() > len(rows)}


def without_units(line: str, units: Iterable[str]) -> str:
    """Return a line of a log without these units behind its numbers, where at least one cell of it ends in one."""
    spelt = "|".join(re.escape(unit) for unit in sorted(set(units), key=len, reverse=True))
    return re.sub(rf"(?<=[\d.])[ \u00a0\u202f]{{0,2}}(?:{spelt})(?=[ ]{{0,8}}\"?[ ]{{0,8}}(?:[;,|\t]|$))", "", line)


def with_units(labels: Sequence[Label], units: Mapping[int, str], place: str) -> list[Label]:
    """Return the labels with the units of their cells; raise InputError where a heading gives another."""
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


def plain_cells(cells: Sequence[str], unit: str, cut: bool, where: Callable[[int], str]) -> list[str]:
    """Return the cells of a column without their `unit`, words as they are; a last one that is `cut` is missing."""
    result = [cell.strip() for cell in cells]
    for index, text in enumerate(result):
        if text.endswith(unit):
            result[index] = text[: -len(unit)].rstrip()
        elif cut and index == len(cells) - 1:
            result[index] = ""
        elif _unit_behind(text) is not None or (text[:1] in "+-\u2212.,0123456789" and text.strip("+-\u22120.,")):
            raise InputError(f"a cell must be in {unit}, as others of its column, got {text[:40]!r} {where(index)}")
    return result
