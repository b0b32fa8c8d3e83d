"""Headings whose names stand apart or belong together: tables of channels, rows of labels, TwinCAT Scope, X and Y."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.units import same_dimension

_ROW = WORDS["row"]
#: Names of columns of pairs: `X`, `p_A X` or `p_A.x`, with `Y` for x beside it.
_PAIRED = {sign: re.compile(rf"(?P<name>.*?)[\s_.:-]{{0,3}}\b{sign}\d{{0,3}}", re.IGNORECASE) for sign in "xy"}
_LONGEST = 80
#: Rows by which a TwinCAT Scope export is known; `V (Voltage)`, `(None)`: a unit and what it measures.
_SCOPE, _MEASURED = ("SampleTime[ms]", "Starttime of export"), re.compile(r"([^()]{0,20})\([^()]{0,40}\)")


def described(labels: Sequence[Label], rows: Sequence[Sequence[str]]) -> list[Label]:
    """Return the labels, those with the names that the rows above them give; the columns' own names stay known, too.

    A channel's name may say its unit where the column's heading does not. `rows`: cells of the lines above the heading,
    and of rows of labels in it.
    """
    names: dict[str, str] = {}
    typed: int | None = None
    for row in rows:
        cells = [cell.strip().strip('"').strip() for cell in row]
        keys = [cell.casefold() for cell in cells]
        if not cells:
            continue
        if keys[0] in _ROW["channel"]:
            typed = next((keys.index(name) for name in _ROW["typed"] if name in keys[1:]), None)
        elif keys[0] in _ROW["label"]:
            for label, cell in zip(labels[1:], cells[1:], strict=False):
                names.setdefault(_key(label), cell)
        elif typed is not None and typed < len(cells):
            names.setdefault(_plain(cells[0]), cells[typed])
    return [_rename_label(label, names.get(_key(label), "")) for label in labels]


def _plain(text: str) -> str:
    return text.replace(" ", "").casefold()


def _key(label: Label) -> str:
    """Return a column's own name, which stands last where a row of labels was joined to it."""
    return _plain(label.name.rpartition(" ")[2] or label.name)


def _rename_label(label: Label, name: str) -> Label:
    if not name or len(name) > _LONGEST or _plain(name) == _key(label):
        return label
    typed = Label.parse(name)
    last_word = label.name.rpartition(" ")[2]
    return replace(label, name=typed.name, unit=label.unit or typed.unit, called=last_word)


def scope_heading(lines: Sequence[str], delimiter: str) -> tuple[list[Label], int] | None:
    """Return (labels, number of lines from the heading's first on) of a TwinCAT Scope export; None for any other.

    `lines`: those above the first sample. Every property's row repeats its name over the columns of times, which are
    in milliseconds since the start of the export.
    """
    rows = [[cell.strip() for cell in line.split(delimiter)] for line in lines]
    begin = max((index for index, row in enumerate(rows) if row[0] == "Name" and len(row) > 2), default=None)
    if begin is None or not any(row[0] in _SCOPE for row in rows):
        return None
    properties = {row[0]: row for row in rows[begin:]}
    names, units, labels = properties["Name"], properties.get("Unit", []), []
    for column, name in enumerate(names):
        text = units[column] if column < len(units) else ""
        measured = _MEASURED.fullmatch(text)
        unit = (measured[1] if measured else text).strip()
        labels.append(Label("t [ms]", "t", "ms") if name == "Name" else Label.parse(name, unit or None))
    return labels, sum(1 for line in lines[begin:] if line.strip())


def x_y_pairs(labels: Sequence[Label]) -> list[Label]:
    """Return the labels of columns in pairs of times X and values Y as times and channels; all others as they are.

    `X [s], p_A [bar], X [s], p_B [bar]` and `p_A X, p_A Y [bar], p_B X, p_B Y [bar]`; an X without a unit is in
    seconds.
    """
    times, values = labels[::2], labels[1::2]
    timed = all(label.unit is None or same_dimension(label.unit, "s") for label in times)
    if len(labels) < 4 or len(labels) % 2 or not timed:
        return list(labels)
    heads = [_PAIRED["x"].fullmatch(label.name.replace("_", " ")) for label in times]
    tails = [_PAIRED["y"].fullmatch(label.name.replace("_", " ")) for label in values]
    bare = all(head is not None and not head["name"] for head in heads)
    same_names = all(
        head is not None and tail is not None and head["name"].casefold() == tail["name"].casefold()
        for head, tail in zip(heads, tails, strict=True)
    )
    if not (bare or same_names):
        return list(labels)
    result = []
    for time, value, tail in zip(times, values, tails, strict=True):
        name = value.name if bare or tail is None else value.name[: len(tail["name"])]
        result += [replace(time, name="t", unit=time.unit or "s"), replace(value, name=name)]
    return result
