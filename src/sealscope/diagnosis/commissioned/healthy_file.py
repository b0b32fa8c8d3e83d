"""Read and write the file of healthy summaries, which lies next to a machine's text file (`machine_file`).

The first line names the format. Each other line is the summary of a recording: the SHA-256 of a JSON text, a blank and
the JSON text. The machine's file refers to summaries by their SHA-256. A summary that was altered or lost is therefore
found and named, and one that is not referred to does no harm. A new file also contains the old summaries. It therefore
fits both the old and the new machine's file, whenever a writer is killed.

The JSON text holds the fields of a `SummarisedRecording` except `file`. Arrays are stored as bytes
(`storage.plain_state.plain_array`). Unknown names in `about` and in the summaries are kept.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator, Mapping
from dataclasses import MISSING, fields
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_type_hints

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, FailFast, Field, create_model

from sealscope.diagnosis.healthy import Magnitude, Number, Positive, SummarisedRecording, Summary, Time
from sealscope.diagnosis.hold.recorded_holds import HoldSummary
from sealscope.diagnosis.inference.changes.healthy_levels import LevelSummary
from sealscope.diagnosis.inference.comparison import BalanceSummary
from sealscope.diagnosis.inference.pressures.samples import ResponseSummary
from sealscope.diagnosis.rms_change.rms_detector import DetailSummary
from sealscope.errors import InputError
from sealscope.storage.atomic import atomic_write
from sealscope.storage.opening import open_regular
from sealscope.storage.plain_state import plain_array, restore_array
from sealscope.storage.plain_values import convert_type, parse_json

#: Ending of the file's name, and its first line.
SUFFIX, _HEAD = ".healthy", b"sealscope healthy summaries 1\n"
#: Largest file and longest line [bytes]; most summaries in a file.
MAX_SIZE, _MAX_LINE, _MAX_SUMMARIES = 50_000_000, 5_000_000, 5000
#: Most commas, brackets and braces in a line: the first number plus the second times the number of bytes. The limit
#: saves memory, as each of these marks becomes an object.
_MAX_MARKS, _MAX_FRACTION = 40, 0.1
#: Length of a checksum in hexadecimal digits.
_DIGITS = 64


class Line(NamedTuple):
    """One line of a file of summaries: the SHA-256 that it states, and the JSON of a summary, not yet parsed."""

    checksum: str
    data: bytes


def table_type(extra: Literal["allow", "ignore"] = "ignore", **value_types: Any) -> Any:
    """Make a pydantic type for a table with known keys; `extra`: keep ("allow") or drop ("ignore") other keys.

    `value_types` has the type of each key's value, or (type, None) for a key that may be absent.
    """
    config = ConfigDict(strict=True, allow_inf_nan=False, extra=extra)
    # pydantic's `...` marks a value that must be present
    fields = {name: kind if isinstance(kind, tuple) else (kind, ...) for name, kind in value_types.items()}
    return create_model("Table", __config__=config, **fields)  # type: ignore[call-overload]


def uniform_table_type(value_type: Any) -> Any:
    """Make a pydantic type for a table of any keys with values of one type; its error names the first wrong value."""

    def check_values(table: Any) -> Any:
        """Return the table unchanged; raise ValueError if it is no table, or if one of its values is not valid."""
        if not isinstance(table, dict):
            raise ValueError(f"must be a table, got {table!r:.60}")
        for name, value in table.items():
            try:
                convert_type(value_type, value)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return table

    return Annotated[Any, AfterValidator(check_values)]


def list_type(value_type: Any, min_length: int = 0) -> Any:
    """Make a pydantic type for a list of values of one type; validation stops at the first wrong one and names it."""
    return Annotated[list[value_type], FailFast(), Field(min_length=min_length)]


def _summary_type(kind: type[Summary]) -> Any:
    """Make a pydantic type for the table of a `kind` of summary: its fields, checked as they and `check` say.

    Other entries, of a later version, are kept.
    """
    hints = get_type_hints(kind, include_extras=True)
    types = {entry.name: (hints[entry.name], ... if entry.default is MISSING else None) for entry in fields(kind)}

    def check_entries(table: Any) -> Any:
        """Return the table unchanged; raise ValueError if its entries do not fit each other."""
        kind.restore(vars(table)).check()
        return table

    return Annotated[table_type("allow", **types), AfterValidator(check_entries)]


#: Summaries by Sealscope's own methods; those of others are plain tables.
SUMMARY_TYPES: tuple[type[Summary], ...] = (BalanceSummary, ResponseSummary, DetailSummary, LevelSummary, HoldSummary)
_ABOUT = {
    "pressure_bar": Number,
    "oil_degC": Number,
    "noise": uniform_table_type(Magnitude),
    "log_units": uniform_table_type(str),
    "wrong": list_type(str),
    "defects": uniform_table_type(Number),
}


def _restore_arrays(value: Any, name: str) -> Any:
    """Convert packed arrays (tables of "shape" and "f8") in a JSON value, at any depth of nested tables, to arrays.

    Raises ValueError with the key of an array that is not valid; `name` is the key of the value.
    """
    if isinstance(value, dict):
        if value.keys() == {"shape", "f8"}:
            try:
                return restore_array(value, name)
            except InputError:
                raise ValueError(f"{name} must be the bytes of an array, with its shape") from None
        return {key: _restore_arrays(inner, key) for key, inner in value.items()}
    return value


_RESTORED = BeforeValidator(lambda value: _restore_arrays(value, ""))
_BY_METHOD: Any = Annotated[
    table_type("allow", **{kind.method: (_summary_type(kind), None) for kind in SUMMARY_TYPES}), _RESTORED
]
_RECORDING = table_type(
    digest=Annotated[str, Field(min_length=1, max_length=200)],
    units=uniform_table_type(str),
    rate=Positive,
    seconds=Positive,
    start_s=(Time, None),
    about=(table_type("allow", **{name: (kind, None) for name, kind in _ABOUT.items()}), None),
    summaries=_BY_METHOD,
    statistics=(uniform_table_type(Number), None),
)


def _pack_arrays(value: Any) -> Any:
    """Convert a value for JSON: drop entries of mappings that are None, and pack arrays (`plain_array`), at any depth.

    Lists that begin with a float or a list are packed, too, as a line may have few single values (`_MAX_MARKS`); if
    their rows have unequal lengths, row by row.
    """
    if isinstance(value, Mapping):
        return {str(name): _pack_arrays(member) for name, member in value.items() if member is not None}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple) and value and isinstance(value[0], float | list | tuple):
        try:
            value = np.asarray(value)
        except ValueError:  # rows of unequal lengths
            return [_pack_arrays(row) for row in value]
    if isinstance(value, np.ndarray):
        is_numeric = value.dtype.kind in "fiu"  # float, signed or unsigned integer
        return plain_array(value) if is_numeric else _pack_arrays(value.tolist())
    return [_pack_arrays(item) for item in value] if isinstance(value, list | tuple) else value


def _format_json(value: Any) -> bytes:
    """Convert a value to JSON with packed arrays; raise ValueError for infinity or nan, TypeError for other types."""
    return json.dumps(_pack_arrays(value), allow_nan=False, sort_keys=True, separators=(",", ":")).encode("ascii")


def check_summary(method: str, table: Mapping[str, Any]) -> None:
    """Check that the table of the summary by the detector `method` can be stored and read back.

    Raises TypeError for a value that is not plain, else ArithmeticError, which `log_failure` attributes to the
    recording if the detector is built in.
    """
    try:
        convert_type(_BY_METHOD, parse_json(_format_json({method: table})))
    except ValueError as error:
        raise ArithmeticError(f"no summary: {error}") from None


def format_summary(recording: SummarisedRecording) -> Line:
    """Convert a healthy recording's summaries to a line of their file; raise InputError if it cannot be read back."""
    fields = {name: value for name, value in vars(recording).items() if name != "file"}
    try:
        data = _format_json(fields)
    except (TypeError, ValueError) as error:
        raise InputError(f"the summary of {recording.file} must hold plain finite values, got: {error}") from None
    line = Line(sha256(data).hexdigest(), data)
    parse_summary(line, recording.file, recording.file)  # raises InputError if it is not valid
    return line


def parse_summary(line: Line, file: str, place: str) -> SummarisedRecording:
    """Parse a line of a file of summaries to the summary of a healthy recording; raise InputError if it is not valid.

    `file` is the recording's name, and `place` the path of the file of summaries, for messages.
    """
    if sha256(line.data).hexdigest() != line.checksum:
        rule = f"must have the SHA-256 {line.checksum[:12]}..., got another"
        raise InputError(f"the summary of {file} {rule}: {_REMEDY} ({place})")
    n_marks = sum(line.data.count(mark) for mark in b",[{")  # each becomes an object in memory
    max_marks = _MAX_MARKS + int(_MAX_FRACTION * len(line.data))
    try:
        if n_marks > max_marks:
            raise ValueError(f"it must hold its numbers in arrays, got {n_marks} values")
        fields = convert_type(_RECORDING, parse_json(line.data)).model_dump(exclude_unset=True)
    except ValueError as error:
        raise InputError(f"the summary of {file} is wrong: {error} ({place})") from None
    return SummarisedRecording(file, **{"start_s": None, **fields})  # an unknown start is not stored


#: Advice for a summary that is lost or damaged.
_REMEDY = "take its [[healthy]] out of the machine's file, or commission it anew"


def read_summaries(path: Path, files: Mapping[str, str]) -> list[SummarisedRecording]:
    """Read the summaries of the recordings in `files`, which maps the checksum of a line to the recording's name.

    The result has the order of `files`. Raises InputError if the file or one of the lines is missing or not valid.
    """
    recordings: dict[str, SummarisedRecording] = {}
    for line in _iter_lines(path):
        if line.checksum in files and line.checksum not in recordings:
            recordings[line.checksum] = parse_summary(line, files[line.checksum], str(path))
    for checksum, file in files.items():
        if checksum not in recordings:
            rule = "must be in the file of healthy summaries, but is missing"
            raise InputError(f"the summary {checksum[:12]}... of {file} {rule}: {_REMEDY} ({path})")
    return [recordings[checksum] for checksum in files]


def read_lines(path: Path) -> list[Line]:
    """Read the lines of a file of summaries, without parsing or checking them, to keep them in a new file.

    The first line, and lines without a checksum and a blank, are skipped (`_iter_lines`). If the file is missing, of
    another kind, too large or cannot be read to its end, the list is empty: there is then nothing to keep, and the new
    file must be written nevertheless. It does not need the old one, as the summaries of the machine are in memory
    (`machine_file`).
    """
    try:
        return list(_iter_lines(path))
    except InputError:
        return []


def write_lines(lines: Collection[Line], path: Path, like: Path | None = None) -> None:
    """Write a file of summaries as a whole; raise InputError if it would be too large or cannot be written.

    `like`: file whose owner and permissions it gets (`atomic_write`).
    """
    size = len(_HEAD) + sum(len(line.data) + _DIGITS + 2 for line in lines)  # 2: a blank and a line feed
    max_line = max((len(line.data) + 2 * _DIGITS for line in lines), default=0)  # longest line, with a margin
    if size > MAX_SIZE or len(lines) > _MAX_SUMMARIES or max_line > _MAX_LINE:
        limits = f"{_MAX_SUMMARIES} summaries of {_MAX_LINE} bytes and {MAX_SIZE} bytes in all"
        raise InputError(
            f"a file of healthy summaries must have at most {limits}, got {len(lines)} and {size} bytes ({path})"
        )
    with atomic_write(path, like) as temporary, temporary.open("wb") as file:
        file.write(_HEAD)
        for line in lines:
            file.write(b"%b %b\n" % (line.checksum.encode(), line.data))


def _iter_lines(path: Path) -> Iterator[Line]:
    """Yield the lines of a file of summaries after the first; raise InputError for a file of another kind.

    A line without a checksum and a blank is skipped. One whose JSON is cut off is yielded: `parse_summary` finds that.
    """
    noun = "a file of healthy summaries"
    try:
        with open_regular(path, noun) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            if size > MAX_SIZE:
                raise InputError(f"{noun} must be at most {MAX_SIZE} bytes, got {size} ({path})")
            if file.readline(len(_HEAD)) != _HEAD:
                raise InputError(f"{noun} must begin with {_HEAD.decode().strip()!r}, got something else ({path})")
            for _ in range(_MAX_SUMMARIES + 1):  # the last pass finds the end, unless there are too many lines
                row = file.readline(_MAX_LINE)
                if not row:
                    return
                checksum, blank, data = row.rstrip(b"\n").partition(b" ")
                if len(checksum) == _DIGITS and blank:
                    yield Line(checksum.decode("ascii", "replace"), data)
            raise InputError(f"{noun} must have at most {_MAX_SUMMARIES} summaries, got more ({path})")
    except InputError:
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{noun} must be readable, got: {reason} ({path})") from None
