"""The file of a commissioned machine: TOML that people read and edit, with its lessons in a file beside it.

It is a rig's file, too: `[rig]`, `[motor]` and so on state what is known of it, `[map]` its channels. Beside them
`[machine]` names it, `[learnt]` is what its healthy recordings say, for people to read, and each `[[healthy]]` names a
recording and the checksum of what it has taught, its lesson in the file beside (`lessons_file`). `[[alarms]]` is what
persons said of alarms.

The lessons are written before the text, with those of the text that is there and of the one that is kept as `.bak`. So
each text finds its lessons whenever a writer is killed.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from sealscope.calls import checked_call
from sealscope.diagnosis.commissioned.lessons_file import (
    SUFFIX,
    format_lesson,
    list_of,
    make_table,
    read_lessons,
    read_lines,
    table_of,
    write_lines,
)
from sealscope.diagnosis.commissioned.machine import CommissionedMachine, JudgedAlarm, Judgement, Origin
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.parameters.load import OF_MACHINES
from sealscope.recordings.formats.columns import REST, check_call
from sealscope.storage.atomic import atomic_write, check_folder
from sealscope.storage.folders import locked
from sealscope.storage.plain_values import as_type
from sealscope.storage.toml_file import parse_toml, read_toml

#: What this version writes and reads; names in [machine] that are written anew with each change.
_FORMAT, _REWRITTEN = 2, ("sealscope", "written", "lessons")
#: Lessons that neither text names are kept while the file is smaller [bytes].
_SPARE = 5_000_000
#: Longest wait for another process that writes [s], and what is said then.
_LONGEST_WAIT, _BUSY = 60.0, "a machine's file must be free to be written, got another process that writes it ({})"
_HEAD = """\
# A machine commissioned by Sealscope. [machine], [map] and [rig] may be edited; [learnt] is written anew with each
# change; a [[healthy]] is a recording that diagnoses compare with: without it, the recording is forgotten. What the
# recordings have taught is in the file of lessons beside this one: move them together.
"""


def _moment(text: Any) -> float:
    try:
        moment = datetime.fromisoformat(text).timestamp()
        datetime.fromtimestamp(moment, UTC)
    except (TypeError, ValueError, OverflowError, OSError):
        raise ValueError("must be a time as ISO 8601 writes it") from None
    return moment


#: A file's name, which leads to no other folder.
_FILE_NAME = re.compile(r"[^/\\\0:]{1,200}\.lessons")
_Moment = Annotated[float, BeforeValidator(_moment)]


def _check_format(number: int) -> int:
    if number != _FORMAT:
        raise ValueError(f"must be {_FORMAT}, got {number}: commission it anew")
    return number


_HEALTHY = make_table(file=str, lesson=Annotated[str, Field(pattern="^[0-9a-f]{64}$")])
_ALARM = make_table(
    alarm=str,
    mark=Judgement,
    date_s=Annotated[_Moment, Field(alias="date")],
    onset_s=Annotated[_Moment, Field(alias="onset")],
    leak_lpm=(float, None),
    reason=(str, None),
)
_FILE = make_table(
    machine=make_table(
        format=Annotated[int, AfterValidator(_check_format)],
        name=str,
        rate=(float, None),
        limit=(str, None),
        left_out=(list_of(str), None),
    ),
    map=(table_of(str), None),
    healthy=list_of(_HEALTHY, fewest=1),
)


@checked_call
def write_machine(machine: CommissionedMachine, path: str | os.PathLike[str]) -> Path:
    """Write a machine's file completely or not at all; an existing file is kept as `.toml.bak`.

    A link is written through. Its lessons are written beside it, as `.lessons`.

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
        The path does not end in .toml, or cannot be written, or writing would undo what another has changed since the
        machine was loaded.

    Examples
    --------
    >>> import sealscope as ss
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     ss.write(ss.simulate(duration="20 s"), Path(folder, "healthy.nc"))
    ...     path = ss.write_machine(ss.commission(folder), Path(folder, "machine.toml"))
    ...     ss.read_machine(path)
    <CommissionedMachine machine: 1 healthy recording>
    """
    target = _resolve(path)
    with locked(_lock_of(target), _BUSY.format(target), _LONGEST_WAIT):
        if machine.origin is not None and machine.origin.path == target and target.exists():
            change = _change_since(machine.origin, _parts(_read(target)), _parts(_tree_of(machine, target)))
            if change is not None:
                raise InputError(f"a machine's file must be as it was read, got {change}: load it again ({target})")
        _write(machine, target)
    return Path(path)


def update_machine(
    path: str | os.PathLike[str], change: Callable[[CommissionedMachine], CommissionedMachine]
) -> CommissionedMachine:
    """Read, change and write a machine's file without losing the changes of another process.

    `change` is called once, and once more where the file has changed meanwhile; nobody waits for the first call. Raises
    InputError as `read_machine`, `write_machine` and `change` do; then the file stays as it was.
    """
    target = _resolve(path)
    machine = read_machine(target)
    changed = change(machine)
    with locked(_lock_of(target), _BUSY.format(target), _LONGEST_WAIT):
        if machine.origin != Origin(target, frozenset(_parts(_read(target)))):
            changed = change(read_machine(target))
        _write(changed, target)
    return changed


def _resolve(path: str | os.PathLike[str]) -> Path:
    """Follow a path's links to the file to write; InputError where its name does not end in .toml."""
    target = _follow(path)
    if target.suffix.lower() != ".toml":
        raise InputError(f"a machine's file must end in .toml, got {target}")
    check_folder(target)
    return target


def _follow(path: str | os.PathLike[str]) -> Path:
    """Follow a path's links to a file; InputError where they end in a circle."""
    try:
        return Path(path).resolve()
    except (OSError, RuntimeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error).partition(" from ")[0]
        raise InputError(f"a machine's file must be readable, got: {reason} ({os.fspath(path)})") from None


def _lock_of(target: Path) -> Path:
    return target.with_name(f".{target.name}.lock")


def _write(machine: CommissionedMachine, target: Path) -> None:
    """Write lessons, kept text and text, in this order: each text finds its lessons after any of them.

    Raises InputError where the text would not be read again.
    """
    lessons, data = [format_lesson(learnt) for learnt in machine.healthy], _format_text(machine, target)
    _stated_in(parse_toml(data, "a machine's file", str(target)), str(target))
    backup, lines = target.with_suffix(".toml.bak"), {line.checksum: line for line in lessons}
    texts = [(path, _read_if_there(path)) for path in (target, backup)]
    present = {line.checksum: line for path, tree in texts for line in read_lines(_lessons_path(path, tree))}
    for checksum in (checksum for _, tree in texts for checksum in _lessons_named(tree) if checksum in present):
        lines.setdefault(checksum, present[checksum])
    size = sum(len(line.data) for line in lines.values())
    for checksum, line in present.items():  # of texts that were renamed or copied
        if checksum not in lines and (size := size + len(line.data)) < _SPARE:
            lines[checksum] = line
    write_lines([*lines.values()], target.with_suffix(SUFFIX))
    if target.is_file():
        with atomic_write(backup) as temporary:
            temporary.write_bytes(target.read_bytes())
    with atomic_write(target) as temporary:
        temporary.write_bytes(data)


def _format_text(machine: CommissionedMachine, target: Path) -> bytes:
    return (_HEAD + "\n".join(_lines(_tree(machine, target))) + "\n").encode()


def _tree_of(machine: CommissionedMachine, target: Path) -> dict[str, Any]:
    """Return the tables of a machine's text as they are read again."""
    return parse_toml(_format_text(machine, target), "a machine's file", str(target))


def _read_alarms(rows: Any) -> tuple[JudgedAlarm, ...]:
    """Read the rows of [[alarms]], one after the other; ValueError for the first that breaks a rule."""
    if not isinstance(rows, list):
        raise ValueError(f"alarms must be tables, got {rows!r:.60}")
    alarms = []
    for number, row in enumerate(rows, 1):
        try:
            alarms.append(JudgedAlarm(**as_type(_ALARM, row).model_dump(exclude_unset=True)))
        except ValueError as error:
            raise ValueError(f"alarms[{number}].{error}") from None
    return tuple(alarms)


def _parts(tree: Mapping[str, Any]) -> dict[bytes, str]:
    """Return the hash and name of each part of a machine's text that another process may add or remove."""

    def hash_of(value: Any) -> bytes:
        return sha256(json.dumps(value, sort_keys=True, default=str).encode()).digest()[:16]

    head = {name: value for name, value in tree["machine"].items() if name not in _REWRITTEN}
    tables = {name: table for name, table in tree.items() if name not in OF_MACHINES}
    parts = {hash_of([head, tables]): "another statement of the machine"}
    parts |= {hash_of(row["lesson"]): f"another recording, {row['file']}" for row in tree["healthy"]}
    return parts | {hash_of(row): f"another mark of {row['alarm']}" for row in tree.get("alarms", ())}


def _change_since(origin: Origin, present: Mapping[bytes, str], written: Mapping[bytes, str]) -> str | None:
    """Name a part added to, or removed from, a machine's file that writing would undo; None for nothing.

    `present`: parts of the file; `written`: parts of the machine to be written, which was read with those of `origin`.
    """
    added = [name for part, name in present.items() if part not in origin.parts and part not in written]
    removed = [name for part, name in written.items() if part in origin.parts and part not in present]
    return next(iter((*added, *removed)), None)


def _read(path: Path) -> dict[str, Any]:
    """Return the tables of a machine's text, checked but for its rig; InputError where one breaks a rule."""
    tree = read_toml(path, "a machine's file", str(path))
    _stated_in(tree, str(path))
    return tree


def _read_if_there(path: Path) -> dict[str, Any]:
    """Return the tables of a machine's text, none where it cannot be read."""
    try:
        return read_toml(path, "a machine's file", str(path))
    except InputError:
        return {}


def _lessons_named(tree: Mapping[str, Any]) -> list[str]:
    """Return the checksums of the lessons that a machine's text, valid or not, names."""
    rows = tree.get("healthy")
    checksums = [row.get("lesson") for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
    return [checksum for checksum in checksums if isinstance(checksum, str)]


def _lessons_path(path: Path, tree: Mapping[str, Any]) -> Path:
    """Return a machine's file of lessons: the one of the same name if it exists, else the one its text states."""
    default, head = path.with_suffix(SUFFIX), tree.get("machine")
    name = head.get("lessons") if isinstance(head, dict) else None
    if default.exists() or not isinstance(name, str) or _FILE_NAME.fullmatch(name) is None:
        return default
    return path.with_name(name) if path.with_name(name).exists() else default


def _tree(machine: CommissionedMachine, path: Path) -> dict[str, Any]:
    """Return the tables of a machine's file at `path`."""
    from importlib.metadata import version

    summary, columns, now = machine.summary, machine.channel_map, datetime.now(UTC).isoformat(timespec="seconds")
    head = {
        "format": _FORMAT,
        "name": machine.name,
        "lessons": path.with_suffix(SUFFIX).name,
        "sealscope": version("sealscope"),
        "written": now,
    }
    head |= {"rate": machine.rate, "limit": machine.limit, "left_out": machine.left_out or None}
    tree: dict[str, Any] = {"machine": head}
    if columns:
        tree["map"] = {REST: columns} if isinstance(columns, str) else columns
    if machine.rig is not None:
        tree |= machine.rig.as_dict()
    smallest = {} if summary.smallest is None else {"smallest_leak": summary.smallest._asdict()}
    terms = {name: term._asdict() for name, term in summary.terms.items()}
    tree["learnt"] = {"problems": summary.problems, "noise": summary.noise, **smallest, "terms": terms}
    tree["healthy"] = [{"file": learnt.file, "lesson": format_lesson(learnt).checksum} for learnt in machine.healthy]
    tree["alarms"] = [
        {"alarm": alarm.alarm, "mark": alarm.mark, "date": _stamp(alarm.date_s), "onset": _stamp(alarm.onset_s)}
        | {"leak_lpm": alarm.leak_lpm or None, "reason": alarm.reason or None}
        for alarm in machine.alarms
    ]
    return tree


def _stamp(moment: float | None) -> str | None:
    return None if moment is None else datetime.fromtimestamp(moment, UTC).isoformat()


def _lines(tree: Mapping[str, Any], path: str = "", head: str = "") -> list[str]:
    """Return the lines of a table: its values, tables of figures alone among them, then the tables within."""
    lines, within = list[str](), list[str]()
    for name, value in tree.items():
        place = f"{path}.{_key(name)}" if path else _key(name)
        figures = isinstance(value, Mapping) and all(
            isinstance(item, str | float | int | None) for item in value.values()
        )
        if isinstance(value, Mapping) and not (path and value and figures):
            within += _lines(value, place, f"[{place}]")
        elif isinstance(value, list) and not path:
            within += [line for row in value for line in _lines(row, place, f"[[{place}]]")]
        elif value is not None:
            lines.append(f"{_key(name)} = {_value(value)}")
    return [*(["", head, *lines] if lines else []), *within]


def _key(name: str) -> str:
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else _value(name)


def _value(value: Any) -> str:
    """Format a plain value as TOML, without members that are None; numbers to the last digit."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        members = (f"{_key(name)} = {_value(item)}" for name, item in value.items() if item is not None)
        return "{ " + ", ".join(members) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, str):  # names of files may be no text
        value = value.encode("utf-8", "backslashreplace").decode()
    return json.dumps(value, ensure_ascii=False, default=str).replace("\x7f", "\\u007f")


@checked_call
def read_machine(path: str | os.PathLike[str]) -> CommissionedMachine:
    """Read a machine's file.

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
    >>> ss.read_machine("absent.toml")
    Traceback (most recent call last):
    sealscope.errors.InputError: a machine's file must be readable, got: No such file or directory (absent.toml)
    """
    place, target = os.fspath(path), _follow(path)
    tree = read_toml(target, "a machine's file", place)
    stated = _stated_in(tree, place)
    head, rig = stated["machine"], {name: table for name, table in tree.items() if name not in (*OF_MACHINES, "map")}
    lessons = _lessons_path(target, tree)
    if not lessons.exists():
        rule = (
            f"{lessons.name} must lie beside a machine's file, got none: move it there, or commission the machine anew"
        )
        raise InputError(f"{rule} ({place})")
    return CommissionedMachine(
        name=head["name"],
        healthy=tuple(read_lessons(lessons, {row["lesson"]: row["file"] for row in stated["healthy"]})),
        rig=Rig.from_dict(rig, place=place) if rig else None,
        channel_map=stated.get("map", {}),
        rate=head.get("rate"),
        limit=head.get("limit"),
        left_out=tuple(head.get("left_out", ())),
        alarms=stated["alarms"],
        origin=Origin(target, frozenset(_parts(tree))),
    )


def _stated_in(tree: dict[str, Any], place: str) -> dict[str, Any]:
    """Return the checked tables of a machine's text; InputError, with the `place`, where a value breaks a rule."""
    try:
        stated: dict[str, Any] = as_type(_FILE, tree).model_dump(exclude_unset=True)
        check_call(stated.get("map", {}), stated["machine"].get("rate"))
        RepairLimit.of(stated["machine"].get("limit"))
        stated["alarms"] = _read_alarms(tree.get("alarms", []))
        if len({row["lesson"] for row in stated["healthy"]}) < len(stated["healthy"]):
            raise ValueError("healthy must name each lesson once")
    except ValueError as error:
        raise InputError(f"{error} ({place})") from None
    return stated
