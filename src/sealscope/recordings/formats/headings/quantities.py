"""Cells that hold a number with its unit, `20 bar` or `12,5 mm`: the unit is the column's, the same in every cell."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.formats.headings.labels import Label
from sealscope.units import parse_unit

_CELL = re.compile(
    r"(?P<number>[+\-\u2212]?\d(?:[\d.,'\u00a0\u202f]{0,40}\d)?(?:[eE][+-]?\d{1,3})?)[ \u00a0\u202f]{0,2}"
    r"(?P<unit>[^\W\d_][^\s;,|\d\"]{0,15}[23\u00b2\u00b3]?|%|\u00b0C?)"
)
_LONGEST_CELL = 80
#: Most spellings of units that the beginning of a file is tried for.
_MOST_UNITS = 64


def unit_in(cell: str) -> str | None:
    """Return the unit of a cell `20 bar`; None for any other cell, whatever its unit means."""
    cell = cell.strip()
    match = _CELL.fullmatch(cell) if len(cell) <= _LONGEST_CELL else None
    return None if match is None else match["unit"]


def units_in(rows: Sequence[Sequence[str]], is_value: Callable[[str], bool]) -> dict[int, str]:
    """Return column -> unit of the columns in which more than half of the cells are a number with a known unit.

    `rows`: cells of a part of the samples; `is_value`: whether a cell is a number or a stamp as it is.
    """
    known: dict[str, bool] = {}
    counts: dict[int, Counter[str]] = {}
    for row in rows:
        for column, cell in enumerate(row):
            unit = None if is_value(cell) else unit_in(cell)
            if unit is None:
                continue
            if unit not in known:
                known[unit] = len(known) < _MOST_UNITS and is_unit(unit)
            if known[unit]:
                counts.setdefault(column, Counter())[unit] += 1
    return {column: units.most_common(1)[0][0] for column, units in counts.items() if 2 * units.total() > len(rows)}


def is_unit(text: str) -> bool:
    """Return whether a text is a known unit."""
    try:
        parse_unit(text)
    except InputError:
        return False
    return True


def without_units(line: str, units: Sequence[str]) -> str:
    """Return a line of a log without these units behind its numbers, where at least one cell of it ends in one."""
    spelt = "|".join(re.escape(unit) for unit in sorted(set(units), key=len, reverse=True))
    return re.sub(rf"(?<=[\d.])[ \u00a0\u202f]{{0,2}}(?:{spelt})(?=[ ]{{0,8}}\"?[ ]{{0,8}}(?:[;,|\t]|$))", "", line)


def with_units(labels: Sequence[Label], units: Mapping[int, str], place: str) -> list[Label]:
    """Return the labels with the units of their cells; raise UnreadableFile where a heading gives another."""
    result = []
    for column, label in enumerate(labels):
        unit = units.get(column)
        if unit is not None and label.unit is not None and not _same(label.unit, unit):
            raise UnreadableFile(
                f"a column must have one unit, got {label.unit[:40]} in its heading and {unit} in its cells "
                f"(column {label.whole}, {place})"
            )
        result.append(label if unit is None or label.unit is not None else replace(label, unit=unit))
    return result


def _same(unit: str, other: str) -> bool:
    try:
        return parse_unit(unit) == parse_unit(other)
    except InputError:
        return False


def plain_cells(cells: Sequence[str], unit: str, cut: bool, where: Callable[[int], str]) -> list[str]:
    """Return the cells of a column without their `unit`; other cells, such as words, stay as they are.

    Raises UnreadableFile for a number with another unit, or with none but for 0. A last cell that is `cut` short is
    missing. `where`: place of a cell by its index.
    """
    result = []
    for index, cell in enumerate(cells):
        text = cell.strip()
        if text.endswith(unit):
            result.append(text[: -len(unit)].rstrip())
            continue
        if cut and index == len(cells) - 1:
            result.append("")
            continue
        other = unit_in(text)
        if other is not None or (text[:1] in "+-\u2212.,0123456789" and text.strip("+-\u22120.,")):
            raise UnreadableFile(f"a cell must be in {unit}, as others of its column, got {text[:40]!r} {where(index)}")
        result.append(text)
    return result
