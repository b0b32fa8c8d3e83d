"""The file of a commissioned machine: TOML that people read, with all that a diagnosis compares with.

It is a rig's file, too: `[rig]`, `[motor]` and so on state what is known of it, `[map]` its channels. Beside them
`[machine]` names it, `[learnt]` is what its healthy recordings say, for people to read, and each `[[healthy]]` is a
recording: the checksum of its file, and what it has taught each method. `[[alarms]]` is what persons said of alarms.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.commissioned.machine import CommissionedMachine, JudgedAlarm
from sealscope.diagnosis.learnt import Learnt
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.parameters.load import OF_MACHINES
from sealscope.recordings.formats.columns import REST, check_call
from sealscope.storage.atomic import atomic_write
from sealscope.storage.toml_file import read_toml

#: Version of the file's format, and the largest file read [bytes]: some 10 kB a recording.
FORMAT, LARGEST = 1, 50_000_000
#: What persons say of alarms.
MARKS = ("valid", "invalid", "repaired")
_HEAD = """\
# A machine commissioned by Sealscope: what its healthy recordings have taught. [machine], [map] and [rig] may be
# edited; [learnt] is written anew with each change; [[healthy]] is what diagnoses compare with.
"""
_HEALTHY = {"file": str, "digest": str, "rate": float, "seconds": float, "units": dict, "lessons": dict}
_ABOUT = {"sha256": str, "pressure_bar": float, "oil_degC": float, "noise": dict, "wrong": list}
#: What a lesson of each built-in method holds: its entries, numbers of which by their count of dimensions.
_LESSONS: Mapping[str, Mapping[str, Any]] = {
    "volume balance": {"terms": list, "scale": 0, "sums": 3, "flow": 0, "pressure": 0},
    "pressure response": {"by": str, "level": 0},
    "rms change": {"chambers": list, "rate": 0, "levels": 1, "duty": 1},
}


@checked_call
def write_machine(machine: CommissionedMachine, path: str | os.PathLike[str]) -> Path:
    """Write a machine's file: whole under its name, or not at all; one that is there is kept, as `.toml.bak`.

    Parameters
    ----------
    machine : CommissionedMachine
        What `sealscope.commission` returns.
    path : str or path-like
        The file, ending in .toml.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    InputError
        The path does not end in .toml, or cannot be written.

    Examples
    --------
    >>> import sealscope as ss
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     ss.write(ss.simulate(duration="20 s"), Path(folder, "healthy.nc"))
    ...     path = ss.write_machine(ss.commission(folder), Path(folder, "machine.toml"))
    ...     ss.load_machine(path)
    <CommissionedMachine machine: 1 healthy recording>
    """
    target = Path(path)
    if target.suffix.lower() != ".toml":
        raise InputError(f"a machine's file must end in .toml, got {target}")
    text = _HEAD + "\n".join(_tables(_tree(machine))) + "\n"
    if target.is_file():
        with atomic_write(target.with_suffix(".toml.bak")) as temporary:
            temporary.write_bytes(target.read_bytes())
    with atomic_write(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return target


def _tree(machine: CommissionedMachine) -> dict[str, Any]:
    """Return the tables of a machine's file."""
    from importlib.metadata import version

    summary = machine.summary
    head: dict[str, Any] = {"format": FORMAT, "name": machine.name, "sealscope": version("sealscope")}
    head["written"] = datetime.now(UTC).isoformat(timespec="seconds")
    head |= {name: value for name in ("rate", "limit") if (value := getattr(machine, name)) is not None}
    tree: dict[str, Any] = {"machine": head}
    if columns := machine.channel_map:
        tree["map"] = {REST: columns} if isinstance(columns, str) else dict(columns)
    if machine.rig is not None:
        tree |= machine.rig.as_dict()
    learnt = tree["learnt"] = {"problems": summary.problems, "noise": dict(summary.noise)}
    if summary.smallest is not None:
        learnt["smallest_leak"] = _known(summary.smallest)
    learnt["terms"] = {name: _known(term) for name, term in summary.terms.items()}
    tree["healthy"] = [_row(own, machine.about.get(own.digest, {})) for own in machine.healthy]
    if machine.alarms:
        tree["alarms"] = [
            {"alarm": own.alarm, "mark": own.mark, "date": _stamp(own.date_s), "onset": _stamp(own.onset_s)}
            | {name: value for name in ("leak_lpm", "reason") if (value := getattr(own, name))}
            for own in machine.alarms
        ]
    return tree


def _known(values: Any) -> dict[str, Any]:
    return {name: value for name, value in values._asdict().items() if value is not None}


def _stamp(moment: float) -> str:
    return datetime.fromtimestamp(moment, UTC).isoformat()


def _row(own: Learnt, about: Mapping[str, Any]) -> dict[str, Any]:
    start = {} if own.start_s is None else {"start": _stamp(own.start_s)}
    plain = {"file": own.file, "digest": own.digest, "rate": own.rate, "seconds": own.seconds}
    lessons = {
        name: {key: value for key, value in lesson.items() if value is not None} for name, lesson in own.lessons.items()
    }
    return {**plain, **start, "units": dict(own.units), "about": dict(about), "lessons": lessons}


def _tables(tree: Mapping[str, Any], prefix: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield the lines of nested tables: plain values first, then the tables within, then lists of tables."""
    name = ".".join(map(_key, prefix))
    plain = {key: value for key, value in tree.items() if not _stands_apart(value, bool(prefix))}
    if plain and prefix:
        yield from ("", f"[{name}]")
    for key, value in plain.items():
        yield f"{_key(key)} = {_value(value)}"
    for key, value in tree.items():
        if isinstance(value, Mapping) and key not in plain:
            yield from _tables(value, (*prefix, key))
        elif key not in plain:
            for row in value:
                own = _tables(row, (*prefix, key))
                yield from (next(own), f"[{next(own)}]", *own)


def _stands_apart(value: Any, within: bool) -> bool:
    """Whether a value is a table of its own, or the list of them that all others are in; figures alone are a line."""
    if isinstance(value, Mapping):
        return not within or not all(isinstance(own, str | float | int) for own in value.values()) or not value
    return isinstance(value, list) and not within


def _key(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else _value(key)


def _value(value: Any) -> str:
    """Return a plain value as TOML; numbers to the last digit."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(key)} = {_value(own)}" for key, own in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")


@checked_call
def load_machine(path: str | os.PathLike[str]) -> CommissionedMachine:
    """Load a machine's file.

    Parameters
    ----------
    path : str or path-like
        A file that `write_machine` or `sealscope commission` wrote.

    Returns
    -------
    CommissionedMachine
        The machine.

    Raises
    ------
    InputError
        The file cannot be read, is of another format, or one of its values breaks a rule.

    Examples
    --------
    >>> import sealscope as ss
    >>> ss.load_machine("absent.toml")
    Traceback (most recent call last):
    sealscope.errors.InputError: a machine's file must be readable, got: No such file or directory (absent.toml)
    """
    place = os.fspath(path)
    tree = read_toml(Path(path), "a machine's file", place, LARGEST)
    head = _part(tree, "machine", dict, place)
    if head.get("format") != FORMAT:
        raise InputError(f"machine.format must be {FORMAT}, got {head.get('format')!r} ({place})")
    name = _part(head, "name", str, place)
    channel_map = _part(tree, "map", dict, place) if "map" in tree else {}
    if not all(isinstance(column, str) for column in channel_map.values()):
        raise InputError(f"map must be a table of channels and their columns, got {channel_map!r:.80} ({place})")
    rate = _part(head, "rate", float, place) if "rate" in head else None
    limit = _part(head, "limit", str, place) if "limit" in head else None
    try:
        check_call(channel_map, rate)
        RepairLimit.of(limit)
    except InputError as error:
        raise InputError(f"{error} ({place})") from None
    rows = _part(tree, "healthy", list, place)
    if not rows:
        raise InputError(f"healthy must hold a recording, got none ({place})")
    healthy = tuple(_healthy(row, f"healthy[{k}] of {place}") for k, row in enumerate(rows))
    about = {
        own.digest: _about(row, f"healthy[{k}] of {place}")
        for k, (own, row) in enumerate(zip(healthy, rows, strict=True))
    }
    rig = {name: table for name, table in tree.items() if name not in OF_MACHINES and name != "map"}
    known = Rig.from_dict(rig, place=place) if rig else None
    alarms = tuple(
        _alarm(row, f"alarms[{k}] of {place}")
        for k, row in enumerate(_part(tree, "alarms", list, place) if "alarms" in tree else ())
    )
    return CommissionedMachine(name, healthy, known, channel_map, rate, limit, about, alarms=alarms)


def _part(tree: Mapping[str, Any], name: str, kind: type, place: str) -> Any:
    value = tree.get(name)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind) or (isinstance(value, float) and not math.isfinite(value)):
        names = {dict: "a table", list: "a list", str: "a text", float: "a finite number"}
        raise InputError(f"{name} must be {names[kind]}, got {value!r:.60} ({place})")
    return value


def _healthy(row: Any, place: str) -> Learnt:
    """Return a healthy recording of the file."""
    if not isinstance(row, dict):
        raise InputError(f"a healthy recording must be a table, got {row!r:.60} ({place})")
    values = {name: _part(row, name, kind, place) for name, kind in _HEALTHY.items()}
    for name in ("rate", "seconds"):
        if not values[name] > 0.0:
            raise InputError(f"{name} must be > 0, got {values[name]:g} ({place})")
    if not all(isinstance(unit, str) for unit in values["units"].values()):
        raise InputError(f"units must be texts, got {values['units']!r:.60} ({place})")
    start_s = _moment(row, "start", place) if "start" in row else None
    lessons = {name: _lesson(name, values["lessons"], place) for name in values["lessons"]}
    units, rate, seconds = values["units"], values["rate"], values["seconds"]
    return Learnt(values["file"], values["digest"], units, rate, seconds, start_s, lessons)


def _about(row: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Return what people read of a healthy recording."""
    about: dict[str, Any] = _part({"about": {}, **row}, "about", dict, place)
    for name in _ABOUT.keys() & about.keys():
        _part(about, name, _ABOUT[name], place)
    for name in about.get("noise", {}):
        _part(about["noise"], name, float, place)
    if not all(isinstance(text, str) for text in about.get("wrong", ())):
        raise InputError(f"wrong must hold texts, got {about['wrong']!r:.60} ({place})")
    return about


def _moment(row: Mapping[str, Any], name: str, place: str) -> float:
    try:
        return datetime.fromisoformat(row[name]).timestamp()
    except (KeyError, TypeError, ValueError, OverflowError):
        got = repr(row.get(name))
        raise InputError(f"{name} must be a time as ISO 8601 writes it, got {got:.60} ({place})") from None


def _alarm(row: Any, place: str) -> JudgedAlarm:
    """Return what a person said of an alarm."""
    if not isinstance(row, dict):
        raise InputError(f"an alarm must be a table, got {row!r:.60} ({place})")
    texts = {name: _part({"reason": "", **row}, name, str, place) for name in ("alarm", "mark", "reason")}
    if texts["mark"] not in MARKS:
        raise InputError(f"mark must be one of {', '.join(MARKS)}, got {texts['mark']!r:.60} ({place})")
    leak = _part(row, "leak_lpm", float, place) if "leak_lpm" in row else None
    return JudgedAlarm(**texts, date_s=_moment(row, "date", place), onset_s=_moment(row, "onset", place), leak_lpm=leak)


def _lesson(name: str, lessons: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Return what a method was taught, its arrays of their shape and finite."""
    lesson = dict(_part(lessons, name, dict, place))
    for key, kind in _LESSONS.get(name, {}).items():
        if isinstance(kind, type):
            lesson[key] = _part(lesson, key, kind, place)
        elif kind:
            lesson[key] = _array(_part(lesson, key, list, place), kind, key, place)
        else:
            lesson[key] = _part(lesson, key, float, place)
    for key in {"start_s", "oil_degC"} & lesson.keys():
        _part(lesson, key, float, place)
    if name == "volume balance" and lesson["sums"].shape[1:] != (size := (len(lesson["terms"]) + 1,) * 2):
        raise InputError(f"sums must be of the shape (E, {size[0]}, {size[1]}), got {lesson['sums'].shape} ({place})")
    return lesson


def _array(values: Sequence[Any], dimensions: int, name: str, place: str) -> np.ndarray:
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} must hold numbers in equal rows, got {values!r:.60} ({place})") from None
    if array.ndim != dimensions or not np.isfinite(array).all():
        raise InputError(f"{name} must hold finite numbers in {dimensions} dimensions, got {values!r:.60} ({place})")
    return array
