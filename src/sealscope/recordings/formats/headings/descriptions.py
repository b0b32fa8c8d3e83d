"""Headings with names outside the heading row: tables of channels, rows of labels, TwinCAT Scope, X-Y pairs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from sealscope.recordings.formats.headings.labels import WORDS, Label
from sealscope.units import same_dimension

_ROW = WORDS["row"]
#: Names of columns in pairs: `X`, `p_A X` or `p_A.x`, and the same with `Y`.
_PAIR_NAMES = {axis: re.compile(rf"(?P<name>.*?)[\s_.:-]{{0,3}}\b{axis}\d{{0,3}}", re.IGNORECASE) for axis in "xy"}
_MAX_NAME = 80
#: First cells of rows that only a TwinCAT Scope export has.
_SCOPE_ROWS = ("SampleTime[ms]", "Starttime of export")
#: A unit with its quantity: `V (Voltage)`, `(None)`.
_UNIT_WITH_QUANTITY = re.compile(r"([^()]{0,20})\([^()]{0,40}\)")


def apply_descriptions(labels: Sequence[Label], rows: Sequence[Sequence[str]]) -> list[Label]:
    """Replace the names of columns by the descriptions that a user has entered for them in the logger.

    They are in a table of channels above the heading, whose rows begin with the last word of a column's name, or in a
    row of labels, in the order of the columns, with `label` or `labels` in place of the first. The first description of
    a column counts; it may state the unit. `rows`: cells of all these lines.
    """
    names: dict[str, str] = {}
    name_column: int | None = None
    for row in rows:
        cells = [cell.strip().strip('"').strip() for cell in row]
        keys = [cell.casefold() for cell in cells]
        if not cells:
            continue
        if keys[0] in _ROW["channel"]:  # the heading of a table of channels
            name_column = next((keys.index(name) for name in _ROW["description"] if name in keys[1:]), None)
        elif keys[0] in _ROW["label"]:  # a row of labels
            for label, cell in zip(labels[1:], cells[1:], strict=False):
                names.setdefault(_column_key(label), cell)
        elif name_column is not None and name_column < len(cells):  # a row of the table
            names.setdefault(_fold(cells[0]), cells[name_column])
    return [_rename_label(label, names.get(_column_key(label), "")) for label in labels]


def _fold(text: str) -> str:
    """Remove blanks from a text and convert it to lower case, for comparison."""
    return text.replace(" ", "").casefold()


def _column_key(label: Label) -> str:
    """Return the last word of a column's name in lower case; the words before it may name a group of columns."""
    return _fold(label.name.rpartition(" ")[2] or label.name)


def _rename_label(label: Label, description: str) -> Label:
    """Replace a column's name by a description, unless this is empty, too long or the last word of the name."""
    if not description or len(description) > _MAX_NAME or _fold(description) == _column_key(label):
        return label
    renamed = Label.parse(description)  # it may end in a unit
    last_word = label.name.rpartition(" ")[2]
    return replace(label, name=renamed.name, unit=label.unit or renamed.unit, called=last_word)


def parse_scope_heading(lines: Sequence[str], delimiter: str) -> tuple[list[Label], int] | None:
    """Parse the heading of a TwinCAT Scope export to (labels of the columns, number of heading lines); None for others.

    `lines`: those above the first sample. Each states a property of all channels, such as the unit: the cells above
    time columns [ms] contain the name of the property, and those above channels its value.
    """
    rows = [[cell.strip() for cell in line.split(delimiter)] for line in lines]
    # the last row of names; a row of two cells is a remark on the file
    begin = max((index for index, row in enumerate(rows) if row[0] == "Name" and len(row) > 2), default=None)
    if begin is None or not any(row[0] in _SCOPE_ROWS for row in rows):
        return None
    properties = {row[0]: row for row in rows[begin:]}
    names, units, labels = properties["Name"], properties.get("Unit", []), []
    for column, name in enumerate(names):
        text = units[column] if column < len(units) else ""
        match = _UNIT_WITH_QUANTITY.fullmatch(text)
        unit = (match[1] if match else text).strip()
        labels.append(Label("t [ms]", "t", "ms") if name == "Name" else Label.parse(name, unit or None))
    return labels, sum(1 for line in lines[begin:] if line.strip())


def split_pairs(labels: Sequence[Label]) -> list[Label]:
    """Rename the columns of a table in which a time column X precedes each channel Y; other tables stay as they are.

    Names are like `X [s], p_A [bar], X [s], p_B [bar]`, or like `p_A X, p_A Y [bar], p_B X, p_B Y [bar]`. The times
    become `t`, in seconds if they have no unit; the values get the channels' names.
    """
    times, values = labels[::2], labels[1::2]
    are_times = all(label.unit is None or same_dimension(label.unit, "s") for label in times)
    if len(labels) < 4 or len(labels) % 2 or not are_times:
        return list(labels)
    # with blanks in place of `_`, as the X of `p_A_X` would be no word of its own
    x_matches = [_PAIR_NAMES["x"].fullmatch(label.name.replace("_", " ")) for label in times]
    y_matches = [_PAIR_NAMES["y"].fullmatch(label.name.replace("_", " ")) for label in values]
    is_unnamed = all(x_match is not None and not x_match["name"] for x_match in x_matches)
    same_names = all(
        x_match is not None and y_match is not None and x_match["name"].casefold() == y_match["name"].casefold()
        for x_match, y_match in zip(x_matches, y_matches, strict=True)
    )
    if not (is_unnamed or same_names):
        return list(labels)
    result = []
    for time, value, y_match in zip(times, values, y_matches, strict=True):
        # the part of the name before the Y, as it is spelled in the heading
        name = value.name if is_unnamed or y_match is None else value.name[: len(y_match["name"])]
        result += [replace(time, name="t", unit=time.unit or "s"), replace(value, name=name)]
    return result
