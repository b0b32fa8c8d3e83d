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
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from sealscope.calls import checked_call
from sealscope.diagnosis.commissioned.lessons_file import (
    SUFFIX,
    Line,
    format_lesson,
    make_table,
    read_lessons,
    read_lines,
    write_lines,
)
from sealscope.diagnosis.commissioned.machine import CommissionedMachine, JudgedAlarm, Judgement
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.parameters.load import OF_MACHINES
from sealscope.recordings.formats.columns import REST, check_call
from sealscope.storage.atomic import atomic_write, check_folder
from sealscope.storage.plain_values import as_type
from sealscope.storage.toml_file import LARGEST, read_toml

#: What this version writes and reads.
_FORMAT = 2
_HEAD = """\
# A machine commissioned by Sealscope. [machine], [map] and [rig] may be edited; [learnt] is written anew with each
# change; a [[healthy]] is a recording that diagnoses compare with: without it, the recording is forgotten. What the
# recordings have taught is in the file of lessons beside this one: move them together.
"""


def _moment(text: Any) -> float:
    try:
        return datetime.fromisoformat(text).timestamp()
    except (TypeError, OverflowError):
        raise ValueError("must be a time as ISO 8601 writes it") from None


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
        left_out=(list[str], None),
    ),
    map=(dict[str, str], None),
    healthy=Annotated[list[_HEALTHY], Field(min_length=1)],  # type: ignore[valid-type]
    alarms=(list[_ALARM], None),  # type: ignore[valid-type]
)


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
    check_folder(target)
    taught = [format_lesson(learnt) for learnt in machine.healthy]
    data = (_HEAD + "\n".join(_lines(_tree(machine, taught, target))) + "\n").encode()
    if len(data) > LARGEST:
        raise InputError(f"a machine's file must be at most {LARGEST} bytes, got {len(data)} ({target})")
    backup, lines = target.with_suffix(".toml.bak"), {line.checksum: line for line in taught}
    for text in (target, backup):
        tree = _read_if_there(text)
        named = set(_lessons_named(tree)) - lines.keys()
        lines |= {line.checksum: line for line in read_lines(_lessons_path(text, tree), named)} if named else {}
    write_lines(lines.values(), target.with_suffix(SUFFIX))
    if target.is_file():
        with atomic_write(backup) as temporary:
            temporary.write_bytes(target.read_bytes())
    with atomic_write(target) as temporary:
        temporary.write_bytes(data)
    return target


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
    """Return the file of lessons of a text: that of its name, or where there is none that which it states."""
    beside, head = path.with_suffix(SUFFIX), tree.get("machine")
    stated = head.get("lessons") if isinstance(head, dict) else None
    if beside.exists() or not isinstance(stated, str) or _FILE_NAME.fullmatch(stated) is None:
        return beside
    return path.with_name(stated) if path.with_name(stated).exists() else beside


def _tree(machine: CommissionedMachine, lines: Iterable[Line], path: Path) -> dict[str, Any]:
    """Return the tables of a machine's file at `path`, whose lessons are these lines."""
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
    tree["healthy"] = [
        {"file": learnt.file, "lesson": line.checksum} for learnt, line in zip(machine.healthy, lines, strict=True)
    ]
    tree["alarms"] = [
        {"alarm": own.alarm, "mark": own.mark, "date": _stamp(own.date_s), "onset": _stamp(own.onset_s)}
        | {"leak_lpm": own.leak_lpm or None, "reason": own.reason or None}
        for own in machine.alarms
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
            isinstance(own, str | float | int | None) for own in value.values()
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
    """Return a plain value as TOML, without what is None; numbers to the last digit."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        stated = (f"{_key(name)} = {_value(own)}" for name, own in value.items() if own is not None)
        return "{ " + ", ".join(stated) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, str):  # names of files may be no text
        value = value.encode("utf-8", "backslashreplace").decode()
    return json.dumps(value, ensure_ascii=False, default=str).replace("\x7f", "\\u007f")


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
    tree = read_toml(Path(path), "a machine's file", place)
    rig = {name: table for name, table in tree.items() if name not in OF_MACHINES and name != "map"}
    try:
        stated = as_type(_FILE, tree).model_dump(exclude_unset=True)
        head, columns = stated["machine"], stated.get("map", {})
        check_call(columns, head.get("rate"))
        RepairLimit.of(head.get("limit"))
        files = {row["lesson"]: row["file"] for row in stated["healthy"]}
        if len(files) < len(stated["healthy"]):
            raise ValueError("healthy must name each lesson once")
    except ValueError as error:
        raise InputError(f"{error} ({place})") from None
    lessons = _lessons_path(Path(path), tree)
    if not lessons.exists():
        rule = (
            f"{lessons.name} must lie beside a machine's file, got none: move it there, or commission the machine anew"
        )
        raise InputError(f"{rule} ({place})")
    return CommissionedMachine(
        name=head["name"],
        healthy=tuple(read_lessons(lessons, files)),
        rig=Rig.from_dict(rig, place=place) if rig else None,
        channel_map=columns,
        rate=head.get("rate"),
        limit=head.get("limit"),
        left_out=tuple(head.get("left_out", ())),
        alarms=tuple(JudgedAlarm(**row) for row in stated.get("alarms", ())),
    )
