"""The lessons of a machine's healthy recordings, in a file beside its text (`machine_file`).

The file is lines: the first names the format, each other one is the lesson of a recording, as its SHA-256, a blank and
JSON. The text names the lessons it uses by their SHA-256. So a lesson that was altered or lost is found and named, a
lesson that no text names does no harm, and a new file that holds the old lessons as well belongs to both texts, the old
and the new, at whichever instant a writer is killed.

JSON holds `digest`, `units`, `rate`, `seconds`, `start_s`, `about`, `lessons` by the names of detectors, and
`statistics` by their names. Numbers in arrays are bytes (`storage.plain_state.plain_array`). Unknown names are kept.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, FailFast, Field, create_model

from sealscope.diagnosis.inference.circuit.locked_holds import HeldLeaks
from sealscope.diagnosis.inference.terms import LEAK
from sealscope.diagnosis.learnt import Learnt
from sealscope.diagnosis.rms_change.blocks import DUTY
from sealscope.errors import InputError
from sealscope.signals.details import QUANTITIES
from sealscope.storage.atomic import atomic_write
from sealscope.storage.opening import open_regular
from sealscope.storage.plain_state import array_of, plain_array
from sealscope.storage.plain_values import as_type, parse_json

#: What the file's name ends with, and its first line.
SUFFIX, _HEAD = ".lessons", b"sealscope lessons 1\n"
#: Largest file and longest line [bytes]; most lessons in a file.
LARGEST, _LONGEST, _MOST = 50_000_000, 5_000_000, 5000
#: Most commas, brackets and braces in a line: a number, and a share of its bytes. Each becomes an object in memory.
_MARKS, _SHARE = 40, 0.1
#: Largest size of a number: products of two do not overflow. Times are within the years that calendars have [s].
_SIZE, _FIRST, _LAST = 1e100, -6.2e10, 2.5e11
#: Largest size of the logarithm of a number that is neither zero nor infinite.
_LOGARITHM = 750.0
#: Length of a checksum in hexadecimal digits.
_DIGITS = 64


class Line(NamedTuple):
    """A line of the file: the `checksum` that it states, and the JSON of a lesson, unread."""

    checksum: str
    data: bytes


def make_table(extra: Literal["allow", "ignore"] = "ignore", **kinds: Any) -> Any:
    """Return the type of a table by the types of its values, in a tuple with None where a value may be absent."""
    config = ConfigDict(strict=True, allow_inf_nan=False, extra=extra)
    fields = {name: kind if isinstance(kind, tuple) else (kind, ...) for name, kind in kinds.items()}
    return create_model("Table", __config__=config, **fields)  # type: ignore[call-overload]


def table_of(kind: Any) -> Any:
    """Return the type of a table with values of one kind; the first other value is the error."""

    def check(table: Any) -> Any:
        if not isinstance(table, dict):
            raise ValueError(f"must be a table, got {table!r:.60}")
        for name, value in table.items():
            try:
                as_type(kind, value)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return table

    return Annotated[Any, AfterValidator(check)]


def list_of(kind: Any, fewest: int = 0) -> Any:
    """Return the type of a list of one kind; the first value that is not is the error."""
    return Annotated[list[kind], FailFast(), Field(min_length=fewest)]


def _check_array(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        raise ValueError("must be an array of numbers")
    if not (np.abs(value) < _SIZE).all():
        raise ValueError(f"must hold finite numbers of a size below {_SIZE:g}")
    return value


def _check_statistic(value: Any) -> Any:
    _check_array(np.array(value) if isinstance(value, float) else value)
    return value


def _check_sums(lesson: Any) -> Any:
    """Check sums of products: their shape, and that flow and leak can be of one duty. All estimates rest on these."""
    size = len(lesson.terms) + 1
    if lesson.sums.ndim != 3 or not len(lesson.sums) or lesson.sums.shape[1:] != (size, size):
        raise ValueError(f"sums must be of the shape (E, {size}, {size}), got {lesson.sums.shape}")
    shut = lesson.shut_sums
    if shut is not None and shut.shape != (1, size + 1, size + 1):
        raise ValueError(f"shut_sums must be of the shape (1, {size + 1}, {size + 1}), got {shut.shape}")
    if lesson.held is not None and lesson.held.shape != (len(HeldLeaks._fields),):
        raise ValueError(f"held must hold {len(HeldLeaks._fields)} numbers, got the shape {lesson.held.shape}")
    if LEAK not in lesson.terms:
        raise ValueError(f"terms must have {LEAK!r}, got {', '.join(lesson.terms)}")
    leak = lesson.terms.index(LEAK)
    squares, product = lesson.sums[:, [leak, -1], [leak, -1]], lesson.sums[:, leak, -1]
    if not (squares > 0.0).all() or not (product**2 <= _ROUNDED * squares.prod(axis=1)).all():
        raise ValueError("sums must be those of squares and products of a leak and a flow, got none such")
    return lesson


def _check_levels(lesson: Any) -> Any:
    chambers, expected = len(lesson.chambers), (len(QUANTITIES) * len(lesson.chambers),)
    if not chambers or lesson.levels.shape != expected or lesson.duty.shape != (len(DUTY),):
        shapes = f"{lesson.levels.shape} and {lesson.duty.shape}"
        raise ValueError(f"levels and duty must be of the shapes {expected} and ({len(DUTY)},), got {shapes}")
    if not max(np.abs(lesson.levels).max(), np.abs(lesson.duty).max()) < _LOGARITHM:
        raise ValueError(f"levels and duty must be logarithms, of a size below {_LOGARITHM:g}")
    return lesson


#: By how much rounding lets a product exceed its squares.
_ROUNDED = 1.0 + 1e-6
_Array = Annotated[Any, AfterValidator(_check_array)]
_Statistic = Annotated[Any, AfterValidator(_check_statistic)]
_Number = Annotated[float, Field(gt=-_SIZE, lt=_SIZE)]
_Size = Annotated[float, Field(ge=0.0, lt=_SIZE)]
_Positive = Annotated[float, Field(gt=0.0, lt=_LAST)]
_Time = Annotated[float, Field(gt=_FIRST, lt=_LAST)]
_BALANCE = make_table(
    "allow",
    terms=list_of(str),
    scale=_Size,
    sums=_Array,
    shut_sums=(_Array, None),
    held=(_Array, None),
    shut_odds=(_Number, None),
    flow=_Size,
    pressure=_Size,
    start_s=(_Time, None),
    oil_degC=(_Number, None),
)
_RMS = make_table(
    "allow",
    chambers=list_of(str),
    recorded=(list_of(str), None),
    rate=_Positive,
    start_s=(_Time, None),
    levels=_Array,
    duty=_Array,
)
#: What Sealscope's own methods learn; the lessons of others are plain tables.
_LESSONS = {
    "volume balance": (Annotated[_BALANCE, AfterValidator(_check_sums)], None),
    "pressure response": (make_table("allow", level=_Number), None),
    "rms change": (Annotated[_RMS, AfterValidator(_check_levels)], None),
}
_ABOUT = {
    "sha256": str,
    "pressure_bar": _Number,
    "oil_degC": _Number,
    "noise": table_of(_Size),
    "wrong": list_of(str),
}


def _unpack(value: Any, name: str) -> Any:
    """Return a parsed JSON value with its arrays as arrays; its `name` stands in the error."""
    if isinstance(value, dict):
        if value.keys() == {"shape", "f8"}:
            try:
                return array_of(value, name)
            except InputError:
                raise ValueError(f"{name} must be the bytes of an array, with its shape") from None
        return {key: _unpack(inner, key) for key, inner in value.items()}
    return value


_BY_METHOD: Any = Annotated[make_table("allow", **_LESSONS), BeforeValidator(lambda value: _unpack(value, ""))]
_LESSON = make_table(
    digest=Annotated[str, Field(min_length=1, max_length=200)],
    units=table_of(str),
    rate=_Positive,
    seconds=_Positive,
    start_s=(_Time, None),
    about=(make_table("allow", **{name: (kind, None) for name, kind in _ABOUT.items()}), None),
    lessons=_BY_METHOD,
    statistics=(Annotated[table_of(_Statistic), BeforeValidator(lambda value: _unpack(value, ""))], None),
)


def _pack(value: Any) -> Any:
    """Return a value for JSON, without members that are None; a list of fractional numbers is an array."""
    if isinstance(value, Mapping):
        return {str(name): _pack(inner) for name, inner in value.items() if inner is not None}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple) and value and isinstance(value[0], float | list | tuple):
        try:
            value = np.asarray(value)
        except ValueError:  # rows of unequal lengths
            return [_pack(inner) for inner in value]
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
        return plain_array(value)
    if isinstance(value, list | tuple | np.ndarray):
        return [_pack(inner) for inner in (value.tolist() if isinstance(value, np.ndarray) else value)]
    return value


def check_lesson(method: str, lesson: Mapping[str, Any]) -> None:
    """Raise ArithmeticError if a method's lesson could not be read again, for example with infinite numbers."""
    try:
        packed = _pack(lesson)
        json.dumps(packed, allow_nan=False)
        as_type(_BY_METHOD, {method: packed})
    except ValueError as error:
        raise ArithmeticError(f"no lesson: {error}") from None


def format_lesson(learnt: Learnt) -> Line:
    """Format the lessons of a recording as a line of the file.

    Raises InputError where it would not be read again, as with numbers that are not finite.
    """
    tree = {
        "digest": learnt.digest,
        "units": dict(learnt.units),
        "rate": float(learnt.rate),
        "seconds": float(learnt.seconds),
        "start_s": learnt.start_s,
        "about": learnt.about,
        "lessons": learnt.lessons,
    }
    packed = _pack(tree)
    packed["statistics"] = {
        name: float(value) if np.ndim(value) == 0 else plain_array(np.asarray(value, dtype=float))
        for name, value in learnt.statistics.items()
    }
    try:
        data = json.dumps(packed, allow_nan=False, sort_keys=True, separators=(",", ":")).encode("ascii")
    except (TypeError, ValueError) as error:
        raise InputError(f"the lesson of {learnt.file} must hold plain finite values, got: {error}") from None
    line = Line(sha256(data).hexdigest(), data)
    parse_lesson(line, learnt.file, learnt.file)
    return line


def parse_lesson(line: Line, file: str, place: str) -> Learnt:
    """Parse a line as the lesson of a recording's `file`; `place` stands in the errors.

    Raises InputError where the checksum is another, or a value breaks a rule.
    """
    if sha256(line.data).hexdigest() != line.checksum:
        rule = f"must have the SHA-256 {line.checksum[:12]}..., got another"
        raise InputError(f"the lesson of {file} {rule}: {_AGAIN} ({place})")
    marks, most = sum(line.data.count(mark) for mark in b",[{"), _MARKS + int(_SHARE * len(line.data))
    try:
        if marks > most:
            raise ValueError(f"it must hold its numbers in arrays, got {marks} values")
        stated = as_type(_LESSON, parse_json(line.data)).model_dump(exclude_unset=True)
    except ValueError as error:
        raise InputError(f"the lesson of {file} is wrong: {error} ({place})") from None
    return Learnt(file, **{"start_s": None, **stated})


#: What a person does about a lesson that is lost or damaged.
_AGAIN = "take its [[healthy]] out of the machine's file, or commission it anew"


def read_lessons(path: Path, files: Mapping[str, str]) -> list[Learnt]:
    """Read the lessons of some checksums.

    Parameters
    ----------
    path : Path
        The file of lessons.
    files : mapping of str to str
        Recording's file by the checksum of its lesson.

    Returns
    -------
    list of Learnt
        The lessons, in the order of `files`.

    Raises
    ------
    InputError
        The file is missing, is none or too large, or a lesson is missing, damaged or breaks a rule.
    """
    found: dict[str, Learnt] = {}
    for line in _iter_lines(path):
        if line.checksum in files and line.checksum not in found:
            found[line.checksum] = parse_lesson(line, files[line.checksum], str(path))
    for checksum, file in files.items():
        if checksum not in found:
            rule = "must be in the file of lessons, got none such"
            raise InputError(f"the lesson {checksum[:12]}... of {file} {rule}: {_AGAIN} ({path})")
    return [found[checksum] for checksum in files]


def read_lines(path: Path) -> list[Line]:
    """Read all lines, unparsed and unchecked; none where the file cannot be read."""
    try:
        return list(_iter_lines(path))
    except InputError:
        return []


def write_lines(lines: Collection[Line], path: Path) -> None:
    """Write the file of lessons whole, or not at all.

    Raises InputError where it would be too large to be read again, or cannot be written.
    """
    size = len(_HEAD) + sum(len(line.data) + _DIGITS + 2 for line in lines)
    if size > LARGEST or len(lines) > _MOST or any(len(line.data) > _LONGEST - 2 * _DIGITS for line in lines):
        limits = f"{_MOST} lessons of {_LONGEST} bytes and {LARGEST} bytes in all"
        raise InputError(f"a file of lessons must have at most {limits}, got {len(lines)} and {size} bytes ({path})")
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(_HEAD)
        for line in lines:
            file.write(b"%b %b\n" % (line.checksum.encode(), line.data))


def _iter_lines(path: Path) -> Iterator[Line]:
    what = "a file of lessons"
    try:
        with open_regular(path, what) as file:
            size = file.seek(0, 2)
            file.seek(0)
            if size > LARGEST:
                raise InputError(f"{what} must be at most {LARGEST} bytes, got {size} ({path})")
            if file.readline(len(_HEAD)) != _HEAD:
                raise InputError(f"{what} must begin with {_HEAD.decode().strip()!r}, got something else ({path})")
            for _ in range(_MOST + 1):
                row = file.readline(_LONGEST)
                if not row:
                    return
                checksum, blank, data = row.rstrip(b"\n").partition(b" ")
                if len(checksum) == _DIGITS and blank:  # else a torn line, whose lesson is missing
                    yield Line(checksum.decode("ascii", "replace"), data)
            raise InputError(f"{what} must have at most {_MOST} lessons, got more ({path})")
    except InputError:
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{what} must be readable, got: {reason} ({path})") from None
