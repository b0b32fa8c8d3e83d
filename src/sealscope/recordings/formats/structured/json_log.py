"""JSON: a record a line or a member of an array, rows under names, blocks of columns, or a document of signals."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.formats.cells import is_missing
from sealscope.recordings.formats.columns import Wanted
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import entries, stated_rate
from sealscope.recordings.formats.headings.proposal import is_time
from sealscope.recordings.formats.structured.tree import series_in
from sealscope.recordings.formats.table import RecordingFields, Series, check_size, check_texts, table_of
from sealscope.recordings.formats.text_layout import SNIFF, encoding_of

#: Most names that records may have, deepest nesting of a record, and longest vector in one.
_MOST_NAMES, _DEEPEST, _LONGEST_VECTOR = 1024, 4, 256
_BEGINS = re.compile(r'\{\s{0,1000}["}]|\[\s{0,1000}[\[{\]"\d\-nN]')
#: What stands between the members of a stream: white space, commas, and RFC 7464's mark of a record.
_BETWEEN = re.compile(r"[\s,\x1e]*")
_OPENS = re.compile(r"\[\s*(?=[\[{\]])")
_decoder = json.JSONDecoder()


def is_json(head: bytes) -> bool:
    """Test whether a file that begins with `head` is JSON: an object, or an array, but no heading in brackets."""
    encoding = encoding_of(head)
    text = "" if encoding is None else head.decode(encoding, errors="replace").lstrip("\ufeff \t\r\n\x1e")
    if not _BEGINS.match(text):
        return False
    first, newline, _ = text.partition("\n")
    if text.startswith("{") or not first.strip("[ \t\r") or (not newline and len(head) >= SNIFF):
        return True
    first = first.strip().rstrip(",")
    try:
        json.loads(first)
    except json.JSONDecodeError as error:
        return error.pos >= len(first) - 1  # `[2024-05-31 12:00] started` is a remark
    except (ValueError, RecursionError):
        return False
    return True


def read_json(path: Path, request: Wanted) -> RecordingFields:
    """Read the wanted columns of a JSON file."""
    place = str(path)
    with path.open("rb") as head:
        encoding = encoding_of(head.read(SNIFF))
    if encoding is None:
        raise InputError("JSON must be text, got binary data")
    text = path.read_text(encoding, errors="replace").lstrip("\ufeff")
    members, cut = list[Any](), False
    try:
        for member in _members(text):
            members.append(member)
    except json.JSONDecodeError as error:
        cut = bool(members) and (error.msg.startswith("Unterminated") or error.pos >= len(text.rstrip()) - 16)
        if not cut:
            line = 1 + text.count("\n", 0, error.pos)
            raise InputError(f"JSON must be whole, got: {error.msg} (line {line}, {place})") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"JSON must be plain, got: {str(error)[:80]}") from None
    if not members:
        raise InputError("a recording must have samples, got empty JSON")
    first, remarks = members[0], dict[str, str]()
    if len(members) == 1 and isinstance(first, Mapping) and not all(map(_is_cell, first.values())):
        remarks = entries((name, value) for name, value in first.items() if isinstance(value, str | int | float))
        series = list(series_in(_arrays(first, place)))
    else:
        series = _records(members, place)
    if not series:
        raise InputError("JSON must hold records or columns of samples, got none")
    table = table_of(series, request, "JSON", remarks, stated_rate(remarks))
    note = f"the last value is cut short and left out, after {len(members)} rows"
    return table.with_note(note) if cut else table


def _members(text: str) -> Iterator[Any]:
    """Yield the values of a text, one after the other; an array of arrays or objects stands for its members."""
    position, inside = 0, False
    while (position := _BETWEEN.match(text, position).end()) < len(text):  # type: ignore[union-attr]
        if inside and text[position] == "]":
            inside, position = False, position + 1
        elif not inside and (opened := _OPENS.match(text, position)):
            inside, position = True, opened.end()
        else:
            member, position = _decoder.raw_decode(text, position)
            yield member


def _is_cell(value: object) -> bool:
    return isinstance(value, str | int | float | None)


def _cells(group: str, name: str, value: Any, depth: int) -> Iterator[tuple[str, str, Any, str | None]]:
    """Yield (group, name, cell, unit) of a value of a record, or of what is in it, called by the names on the way."""
    if isinstance(value, Mapping) and depth < _DEEPEST:
        unit = value.get("unit")
        if name and set(value) == {"value", "unit"} and _is_cell(value["value"]) and isinstance(unit, str):
            yield group, name, value["value"], unit
            return
        for inner, cell in value.items():
            yield from _cells(f"{group}/{name}" if group and name else group or name, inner, cell, depth + 1)
    elif isinstance(value, list) and depth < _DEEPEST and len(value) <= _LONGEST_VECTOR:
        for number, cell in enumerate(value, start=1):
            yield from _cells(group, f"{name}({number})", cell, depth + 1)
    elif _is_cell(value):
        yield group, name, value, None
    else:
        raise InputError(f"{name} must be a number or a text, got {type(value).__name__}")


def _records(members: Sequence[Any], place: str) -> list[Series]:
    """Return a series a name of records, of rows under a first row of names, or of blocks of columns."""
    columns: dict[tuple[str, str], dict[int, Any]] = {}
    units: dict[tuple[str, str], str] = {}
    heads: list[str] | None = None
    rows = 0
    for member in members:
        if isinstance(member, Mapping) and (length := _block_length(member)) is not None:
            for name, cells in member.items():
                columns.setdefault(("", name), {}).update(enumerate(cells, start=rows))
            rows += length
            continue
        where = f"(row {rows + 1}, {place})"
        if isinstance(member, list):
            if heads is None:
                texts = bool(member) and all(isinstance(cell, str) for cell in member)
                heads = member if texts else [str(number + 1) for number in range(len(member))]
                if texts:
                    continue
            if len(member) > len(heads):
                raise InputError(f"a row must have {len(heads)} values, got {len(member)} {where}")
            parts = [_cells("", name, value, 1) for name, value in zip(heads, member, strict=False)]
        elif isinstance(member, Mapping):
            parts = [_cells("", "", member, 0)]
        else:
            raise InputError(f"JSON must hold objects or arrays, got {str(member)[:40]!r} {where}")
        for group, name, cell, unit in chain.from_iterable(parts):
            key = (group, name)
            columns.setdefault(key, {})[rows] = cell
            if unit is not None and units.setdefault(key, unit) != unit:
                raise InputError(f"{name} must have one unit, got {units[key][:40]} and {unit[:40]} {where}")
            if len(columns) > _MOST_NAMES:
                raise InputError(f"records must have at most {_MOST_NAMES} names, got more")
        rows += 1
    check_size(rows, len(columns))

    def values(key: tuple[str, str]) -> NDArray[Any]:
        return _array([columns[key].get(row) for row in range(rows)], key[1])

    return [Series(key[0], Label.parse(key[1], units.get(key)), rows, partial(values, key)) for key in columns]


def _block_length(member: Mapping[str, Any]) -> int | None:
    """Return the number of samples of a block of columns: arrays of one length, among them the time; else None."""
    if not all(isinstance(value, list) for value in member.values()):
        return None
    lengths = set(map(len, member.values()))
    return lengths.pop() if len(lengths) == 1 and any(is_time(Label.parse(name)) for name in member) else None


def _array(cells: Sequence[Any], name: str) -> NDArray[Any]:
    """Convert cells to doubles (n,), with NaN for missing ones, or to texts if any is a text."""
    if any(isinstance(cell, str) for cell in cells):
        texts = ["" if cell is None or is_missing(str(cell)) else str(cell) for cell in cells]
        check_texts(len(texts), max(map(len, texts)), name)
        return np.array(texts)
    try:
        values = np.array([np.nan if cell is None else cell for cell in cells], dtype=np.float64)
    except OverflowError:
        values = np.full(1, np.inf)
    if np.isinf(values).any():
        raise InputError(f"a sample must be a finite number, got an infinite one for {name}")
    return values


def _arrays(value: Any, place: str, depth: int = 0) -> Any:
    """Return a document's value with arrays in place of lists, and columns by name in place of records."""
    if isinstance(value, Mapping) and depth < 8:
        return {key: _arrays(member, place, depth + 1) for key, member in value.items()}
    if not isinstance(value, list) or not value:
        return value
    if all(map(_is_cell, value)):
        return _array(value, "an array")
    if all(isinstance(member, Mapping) and all(map(_is_cell, member.values())) for member in value):
        return {series.label.whole: series.values() for series in _records(value, place)}
    if all(isinstance(member, list) and len(member) == len(value[0]) for member in value):
        return np.column_stack([_array(column, "an array") for column in zip(*value, strict=True)])
    if all(isinstance(member, Mapping) for member in value):
        return {f"({number})": _arrays(member, place, depth + 1) for number, member in enumerate(value, start=1)}
    return None
