"""JSON logs: records by line or in an array, rows after a row of names, blocks of columns, or a tree of signals."""

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
from sealscope.recordings.formats.columns import Request
from sealscope.recordings.formats.headings.labels import Label, is_time
from sealscope.recordings.formats.headings.preamble import collect_attributes, stated_rate
from sealscope.recordings.formats.structured.tree import iter_series
from sealscope.recordings.formats.table import RecordingFields, Series, build_fields, check_size, check_texts
from sealscope.recordings.formats.text_layout import SNIFF, detect_encoding

#: Most names in records, deepest nesting of a record and of a tree, and longest vector in a record.
_MAX_NAMES, _MAX_DEPTH, _MAX_TREE_DEPTH, _MAX_VECTOR = 1024, 4, 8, 256
_MAX_TRUNCATED = 16  # an error this near the end of a text [characters] is a truncated last value
_BEGINS = re.compile(r'\{\s{0,1000}["}]|\[\s{0,1000}[\[{\]"\d\-nN]')
#: Separators of values: white space, commas, and the record separator of RFC 7464.
_SEPARATORS = re.compile(r"[\s,\x1e]*")
#: Beginning of an array of arrays or objects.
_OPENS = re.compile(r"\[\s*(?=[\[{\]])")
_decoder = json.JSONDecoder()


def is_json(head: bytes) -> bool:
    """Test whether `head`, the first bytes of a file, begins a JSON object or array; a heading in brackets does not."""
    encoding = detect_encoding(head)
    text = "" if encoding is None else head.decode(encoding, errors="replace").lstrip("\ufeff \t\r\n\x1e")
    if not _BEGINS.match(text):
        return False
    first, newline, _ = text.partition("\n")
    if (
        text.startswith("{")  # an object
        or not first.strip("[ \t\r")  # a line of opening brackets
        or (not newline and len(head) >= SNIFF)  # a first line longer than `head`
    ):
        return True
    first = first.strip().rstrip(",")
    try:
        json.loads(first)
    except json.JSONDecodeError as error:
        # an array that goes on in the next line fails at the end of this one, and one that breaks off in a number such
        # as `2.` at its last character; a remark such as `[2024-05-31 12:00] started` fails earlier
        return error.pos >= len(first) - 1
    except (ValueError, RecursionError):
        return False
    return True


def read_json(path: Path, request: Request) -> RecordingFields:
    """Read the requested columns of a JSON file to the fields of a recording; a truncated last value is left out."""
    place = str(path)
    with path.open("rb") as head:
        encoding = detect_encoding(head.read(SNIFF))  # `is_json` has read it as text
    text = path.read_text(encoding, errors="replace").lstrip("\ufeff")
    members, is_cut = _read_members(text, place)
    if not members:
        raise InputError("a recording must have samples, got empty JSON")
    first, remarks = members[0], dict[str, str]()
    # a single object is a tree of signals, unless it is a flat record
    if len(members) == 1 and isinstance(first, Mapping) and not all(map(_is_cell, first.values())):
        remarks = collect_attributes(first)
        series = list(iter_series(_convert_lists(first, place)))
    else:
        series = _parse_records(members, place)
    if not series:
        raise InputError("JSON must hold records or columns of samples, got none")
    table = build_fields(series, request, "JSON", remarks, stated_rate(remarks))
    note = f"the last value is cut short and left out, after {len(members)} rows"
    return table.with_note(note) if is_cut else table


def _read_members(text: str, place: str) -> tuple[list[Any], bool]:
    """Read the complete values of a JSON text; also return whether the text breaks off within the next value.

    After a first complete value, an unterminated text and any damage in the last `_MAX_TRUNCATED` characters count as
    breaking off. Raises InputError for other damage. `place`: the file, for messages.
    """
    members, is_cut = list[Any](), False
    try:
        for member in _iter_members(text):
            members.append(member)
    except json.JSONDecodeError as error:
        is_cut = bool(members) and (
            error.msg.startswith("Unterminated") or error.pos >= len(text.rstrip()) - _MAX_TRUNCATED
        )
        if not is_cut:
            line = 1 + text.count("\n", 0, error.pos)
            raise InputError(f"JSON must be whole, got: {error.msg} (line {line}, {place})") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"JSON must be plain, got: {str(error)[:80]}") from None
    return members, is_cut


def _iter_members(text: str) -> Iterator[Any]:
    """Yield the values that stand one after the other in a JSON text, such as one record on each line.

    Between them may be white space, commas and record separators. The members of an outer array of arrays or objects
    are yielded one by one, so that those before a truncated member are still read. Raises json.JSONDecodeError.
    """
    position, in_array = 0, False
    while (position := _SEPARATORS.match(text, position).end()) < len(text):  # type: ignore[union-attr]
        if in_array and text[position] == "]":
            in_array, position = False, position + 1
        elif not in_array and (opened := _OPENS.match(text, position)):
            in_array, position = True, opened.end()
        else:
            member, position = _decoder.raw_decode(text, position)
            yield member


def _is_cell(value: object) -> bool:
    """Test whether a value is a text, a number or null."""
    return isinstance(value, str | int | float | None)


def _iter_cells(group: str, name: str, value: Any, depth: int) -> Iterator[tuple[str, str, Any, str | None]]:
    """Yield the single values in an entry of a JSON record, as (group, name, cell, unit).

    `group`, `name`: names of the records around the entry, and of the entry; `depth`: number of records and vectors
    around it. The `value` is a text, number or null; or `{"value": ..., "unit": ...}`; or a vector, with members called
    `name(1)`, `name(2)`, ...; or a record, whose name then belongs to the group. Raises InputError for others.
    """
    if isinstance(value, Mapping) and depth < _MAX_DEPTH:
        unit = value.get("unit")
        if name and set(value) == {"value", "unit"} and _is_cell(value["value"]) and isinstance(unit, str):
            yield group, name, value["value"], unit
            return
        inner_group = f"{group}/{name}" if group and name else group or name
        for inner_name, inner_value in value.items():
            yield from _iter_cells(inner_group, inner_name, inner_value, depth + 1)
    elif isinstance(value, list) and depth < _MAX_DEPTH and len(value) <= _MAX_VECTOR:
        for number, cell in enumerate(value, start=1):
            yield from _iter_cells(group, f"{name}({number})", cell, depth + 1)
    elif _is_cell(value):
        yield group, name, value, None
    else:
        raise InputError(f"{name} must be a number or a text, got {type(value).__name__}")


def _parse_records(members: Sequence[Any], place: str) -> list[Series]:
    """Make a series of samples for each name in a sequence of JSON values.

    Each value is a record (an object with the samples of one time), a row (an array of these; the first may contain the
    names), or a block of columns (an object of arrays). Raises InputError for others, and for names with several units.
    """
    columns: dict[tuple[str, str], dict[int, Any]] = {}
    units: dict[tuple[str, str], str] = {}
    row_names: list[str] | None = None
    rows = 0
    for member in members:
        if isinstance(member, Mapping) and (length := _block_length(member)) is not None:
            for name, cells in member.items():
                columns.setdefault(("", name), {}).update(enumerate(cells, start=rows))
            rows += length
            continue
        where = f"(row {rows + 1}, {place})"
        if isinstance(member, list):
            if row_names is None:
                is_heading = bool(member) and all(isinstance(cell, str) for cell in member)
                row_names = member if is_heading else [str(number + 1) for number in range(len(member))]
                if is_heading:
                    continue
            if len(member) > len(row_names):
                raise InputError(f"a row must have {len(row_names)} values, got {len(member)} {where}")
            named_values = zip(row_names, member, strict=False)
            cell_iterators = [_iter_cells(group="", name=name, value=value, depth=1) for name, value in named_values]
        elif isinstance(member, Mapping):
            cell_iterators = [_iter_cells(group="", name="", value=member, depth=0)]
        else:
            raise InputError(f"JSON must hold objects or arrays, got {str(member)[:40]!r} {where}")
        for group, name, cell, unit in chain.from_iterable(cell_iterators):
            key = (group, name)
            columns.setdefault(key, {})[rows] = cell
            if unit is not None and units.setdefault(key, unit) != unit:
                raise InputError(f"{name} must have one unit, got {units[key][:40]} and {unit[:40]} {where}")
            if len(columns) > _MAX_NAMES:
                raise InputError(f"records must have at most {_MAX_NAMES} names, got more")
        rows += 1
    check_size(rows, len(columns))

    def read_values(key: tuple[str, str]) -> NDArray[Any]:
        """Convert the cells of a column, given by its group and name, to an array (n,), one value per row."""
        return _parse_array([columns[key].get(row) for row in range(rows)], key[1])

    return [Series(key[0], Label.parse(key[1], units.get(key)), rows, partial(read_values, key)) for key in columns]


def _block_length(member: Mapping[str, Any]) -> int | None:
    """Find the number of rows in a block of columns, i.e. equally long arrays, one of them a time; None for others."""
    if not all(isinstance(value, list) for value in member.values()):
        return None
    lengths = set(map(len, member.values()))
    return lengths.pop() if len(lengths) == 1 and any(is_time(Label.parse(name)) for name in member) else None


def _parse_array(cells: Sequence[Any], name: str) -> NDArray[Any]:
    """Convert JSON values to doubles (n,), NaN if missing, or to texts; raise InputError for an infinite number."""
    if any(isinstance(cell, str) for cell in cells):
        texts = ["" if cell is None or is_missing(str(cell)) else str(cell) for cell in cells]
        check_texts(len(texts), max(map(len, texts)), name)
        return np.array(texts)
    try:
        values = np.array([np.nan if cell is None else cell for cell in cells], dtype=np.float64)
    except OverflowError:  # a whole number that no double can hold
        values = np.full(1, np.inf)
    if np.isinf(values).any():
        raise InputError(f"a sample must be a finite number, got an infinite one for {name}")
    return values


def _convert_lists(value: Any, place: str, depth: int = 0) -> Any:
    """Convert the lists in a JSON value to arrays, or to mappings from names to columns.

    Lists of samples and of equally long rows become arrays. A list of records (mappings from names to single values)
    becomes a mapping from name to column, and a list of other mappings a mapping with the names `(1)`, `(2)`, ...;
    other lists become None. `depth`: number of mappings around the value; `place`: the file, for messages.
    """
    if isinstance(value, Mapping) and depth < _MAX_TREE_DEPTH:
        return {key: _convert_lists(member, place, depth + 1) for key, member in value.items()}
    if not isinstance(value, list) or not value:
        return value
    if all(map(_is_cell, value)):  # samples
        return _parse_array(value, "an array")
    if all(isinstance(member, Mapping) and all(map(_is_cell, member.values())) for member in value):  # records
        return {series.label.whole: series.values() for series in _parse_records(value, place)}
    if all(isinstance(member, list) and len(member) == len(value[0]) for member in value):  # rows
        return np.column_stack([_parse_array(column, "an array") for column in zip(*value, strict=True)])
    if all(isinstance(member, Mapping) for member in value):  # an array of structs
        return {f"({number})": _convert_lists(member, place, depth + 1) for number, member in enumerate(value, start=1)}
    return None
