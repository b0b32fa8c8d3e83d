"""The heading of a TwinCAT Scope export: a column of times before each channel, a row for each of its properties."""

from __future__ import annotations

import re
from collections.abc import Sequence

from sealscope.recordings.formats.headings.labels import Label

#: Rows by which the export is known: the first begins the heading.
_NAME, _UNIT, _MARKS = "Name", "Unit", ("SampleTime[ms]", "Starttime of export")
#: `V (Voltage)`, `(None)`: a unit and what it measures.
_MEASURED = re.compile(r"(?P<unit>[^()]{0,20})\([^()]{0,40}\)")


def scope_heading(lines: Sequence[str], delimiter: str) -> tuple[list[Label], int] | None:
    """Return (labels, number of lines from the heading's first on) of a TwinCAT Scope export; None for any other.

    `lines`: those above the first sample. Every property's row repeats its name over the columns of times, which are
    in milliseconds since the start of the export.
    """
    rows = [[cell.strip() for cell in line.split(delimiter)] for line in lines]
    if not any(row[0] in _MARKS for row in rows):
        return None
    begin = max((index for index, row in enumerate(rows) if row[0] == _NAME and len(row) > 2), default=None)
    if begin is None:
        return None
    properties = {row[0]: row for row in rows[begin:]}
    names, units = properties[_NAME], properties.get(_UNIT, [])
    labels = []
    for column, name in enumerate(names):
        if name == _NAME:
            labels.append(Label("t [ms]", "t", "ms"))
            continue
        given = units[column] if column < len(units) else ""
        measured = _MEASURED.fullmatch(given)
        unit = (measured["unit"] if measured else given).strip()
        labels.append(Label.parse(name, unit or None))
    return labels, sum(1 for line in lines[begin:] if line.strip())
