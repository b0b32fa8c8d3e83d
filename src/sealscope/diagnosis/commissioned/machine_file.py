"""Read and write the file of a commissioned machine: TOML that people can edit.

A second file in the same folder holds the summaries of the healthy recordings (`healthy_file`). Tables of the TOML:

- `[machine]`: name of the machine and its settings.
- `[rig]`, `[motor]` and so on, `[map]`: parameters and channels of the machine, as in a rig's file.
- `[learnt]`: figures from the healthy recordings, for people to read.
- `[[healthy]]`: name of a healthy recording, and checksum of its summary in the second file.
- `[[alarms]]`: judgement of a person on an alarm.

The second file is written before the TOML. It includes the summaries that the present TOML and its backup, `.bak`,
refer to. So no TOML ever lacks a summary, even if the writer is killed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from sealscope.calls import checked_call
from sealscope.diagnosis.commissioned.healthy_file import (
    SUFFIX,
    Line,
    format_summary,
    list_type,
    read_lines,
    read_summaries,
    table_type,
    uniform_table_type,
    write_lines,
)
from sealscope.diagnosis.commissioned.machine import CommissionedMachine, JudgedAlarm, Judgement, Origin
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.parameters.rig import MACHINE_TABLES
from sealscope.recordings.formats.columns import REST, check_request
from sealscope.storage.atomic import atomic_write, check_folder
from sealscope.storage.folders import lock_file
from sealscope.storage.plain_values import convert_type
from sealscope.storage.toml_file import format_tables, parse_toml, read_toml

#: Format that this version writes and reads.
_FORMAT = 3
#: Names in [machine] that are written anew with each change.
_REWRITTEN = ("sealscope", "written", "summaries")
#: Summaries that no machine's file refers to are kept as long as all summaries are smaller than this [bytes].
_SPARE = 5_000_000
#: Longest wait [s] for another process that writes, and the error after it.
_LONGEST_WAIT = 60.0
_BUSY = "a machine's file must not be in use, got another process that writes it ({})"
_HEAD = """\
# A machine commissioned by Sealscope. [machine], [map] and [rig] may be edited; [learnt] is written anew with each
# change; a [[healthy]] is a recording that diagnoses compare with: without it, the recording is forgotten. The numbers
# of the recordings are in the file of healthy summaries beside this one: move them together.
"""


def parse_moment(text: Any) -> float:
    """Parse an ISO 8601 time, in UTC unless it states a zone, to seconds since 1970; raise ValueError if not valid."""
    try:
        moment = datetime.fromisoformat(text)
        seconds = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
        datetime.fromtimestamp(seconds, UTC)  # raises for a time that could not be written again
    except (TypeError, ValueError, OverflowError, OSError):
        raise ValueError("must be a time in the format of ISO 8601") from None
    return seconds


_Moment = Annotated[float, BeforeValidator(parse_moment)]


def _check_format(number: int) -> int:
    """Return the format number of a machine's file; raise ValueError unless it is the one that this version reads."""
    if number != _FORMAT:
        raise ValueError(f"must be {_FORMAT}, got {number}: commission it anew")
    return number


_HEALTHY = table_type(file=str, summary=Annotated[str, Field(pattern="^[0-9a-f]{64}$")])
_ALARM = table_type(
    alarm=str,
    mark=Judgement,
    date_s=Annotated[_Moment, Field(alias="date")],
    onset_s=Annotated[_Moment, Field(alias="onset")],
    leak_lpm=(float, None),
    reason=(str, None),
)
_FILE = table_type(
    machine=table_type(
        format=Annotated[int, AfterValidator(_check_format)],
        name=str,
        # a file in the same folder
        summaries=(Annotated[str, Field(pattern=r"^[^/\\\x00:]{1,200}\.healthy$")], None),
        rate=(float, None),
        limit=(str, None),
        left_out=(list_type(str), None),
    ),
    map=(uniform_table_type(str), None),
    healthy=list_type(_HEALTHY, min_length=1),
)


@checked_call
def write_machine(machine: CommissionedMachine, path: str | os.PathLike[str]) -> Path:
    """Write a machine's file completely or not at all; an existing file is kept as `.toml.bak`.

    If the path is a link, the file it leads to is written. The summaries of the healthy recordings are written to a
    second file of the same name with the ending `.healthy`.

    Parameters
    ----------
    machine : CommissionedMachine
        The machine, for example from `sealscope.commission`.
    path : str or path-like
        The file, ending in .toml.

    Returns
    -------
    pathlib.Path
        The path of the written file.

    Raises
    ------
    InputError
        The path does not end in .toml or cannot be written, or writing would undo a change that another process has
        made since the machine was loaded.

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
    target = _resolve_target(path)
    with _lock(target):
        _write_files(machine, target)
    return Path(path)


def update_machine(
    path: str | os.PathLike[str], change: Callable[[CommissionedMachine], CommissionedMachine]
) -> CommissionedMachine:
    """Apply a `change` to the machine of a file, and return the changed machine.

    If another process writes the file meanwhile, `change` is called a second time, with the machine of the new file.
    Raises InputError as `read_machine`, `write_machine` and `change` do; the file then stays as it was.
    """
    target = _resolve_target(path)
    machine = read_machine(target)
    changed = change(machine)
    with _lock(target):
        if machine.origin != Origin(target, frozenset(_hash_parts(_read_checked(target)))):
            changed = change(read_machine(target))
        _write_files(changed, target)
    return changed


def _resolve_target(path: str | os.PathLike[str]) -> Path:
    """Follow the links of a path to the file to write; raise InputError unless it ends in .toml and has a folder."""
    target = _follow_links(path)
    if target.suffix.lower() != ".toml":
        raise InputError(f"a machine's file must end in .toml, got {target}")
    check_folder(target)
    return target


def _follow_links(path: str | os.PathLike[str]) -> Path:
    """Follow the links of a path to a file; raise InputError if the links end in a circle."""
    try:
        return Path(path).resolve()
    except (OSError, RuntimeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error).partition(" from ")[0]
        raise InputError(f"a machine's file must be readable, got: {reason} ({os.fspath(path)})") from None


def _lock(target: Path) -> AbstractContextManager[object]:
    """Lock the file `target` against other writers; entering raises InputError if one holds the lock for over 60 s."""
    return lock_file(target.with_name(f".{target.name}.lock"), _BUSY.format(target), _LONGEST_WAIT, like=target)


def _write_files(machine: CommissionedMachine, target: Path) -> None:
    """Write the files of a machine: the summaries, then a backup of the present TOML file, then the new TOML file.

    With this order, an interruption leaves a complete TOML file at `target` and all summaries that it names. Summaries
    that neither the machine nor the present TOML file or its backup names are kept as long as the total size stays
    below `_SPARE`. Raises InputError if the TOML file could not be read back, or if it would undo a change by another
    process.
    """
    new_lines = [format_summary(recording) for recording in machine.healthy]
    tree = _build_tree(machine, target, new_lines)
    data = (_HEAD + "\n".join(format_tables(tree)) + "\n").encode()
    new_tree = parse_toml(data, "a machine's file", str(target))  # as it will be read back
    _convert_tree(new_tree, str(target))  # raises InputError
    if change := _find_change(machine.origin, target, new_tree):
        raise InputError(f"a machine's file must not have changed, got {change}: load it again ({target})")
    backup = target.with_suffix(".toml.bak")
    present_lines, named_checksums = dict[str, Line](), list[str]()
    for path in (target, backup):
        try:
            tree = _read_checked(path)
        except InputError:  # names no summaries that could be read
            tree = {"machine": {}, "healthy": []}
        present_lines |= {line.checksum: line for line in read_lines(_summaries_path(path, tree))}
        named_checksums += [row["summary"] for row in tree["healthy"]]
    lines = {checksum: present_lines[checksum] for checksum in named_checksums if checksum in present_lines}
    lines |= {line.checksum: line for line in new_lines}
    size = sum(len(line.data) for line in lines.values())
    for checksum, line in present_lines.items():  # renamed or copied TOML files may name other summaries
        if checksum not in lines:
            size += len(line.data)
            if size < _SPARE:
                lines[checksum] = line
    # all belong to the owner of the TOML file, with its permissions, whoever adds a recording
    write_lines([*lines.values()], target.with_suffix(SUFFIX), like=target)
    if target.is_file():
        with atomic_write(backup, like=target) as temporary:
            temporary.write_bytes(target.read_bytes())
    with atomic_write(target) as temporary:
        temporary.write_bytes(data)


def _parse_alarms(rows: Any) -> tuple[JudgedAlarm, ...]:
    """Parse the tables `[[alarms]]` one at a time, to save memory; ValueError states the number of a wrong one."""
    if not isinstance(rows, list):
        raise ValueError(f"alarms must be tables, got {rows!r:.60}")
    alarms = []
    for number, row in enumerate(rows, 1):
        try:
            alarms.append(JudgedAlarm(**convert_type(_ALARM, row).model_dump(exclude_unset=True)))
        except ValueError as error:
            raise ValueError(f"alarms[{number}].{error}") from None
    return tuple(alarms)


def _hash_parts(tree: Mapping[str, Any]) -> dict[bytes, str]:
    """Hash each part of a machine's file; return a mapping from hash to the description of a change of that part.

    Parts are the statements about the machine, each healthy recording (its summary, not its name), and each alarm.
    """

    def hash_value(value: Any) -> bytes:
        """Compute the first 16 bytes of the SHA-256 of a value as JSON."""
        return sha256(json.dumps(value, sort_keys=True, default=str).encode()).digest()[:16]

    statements = {name: value for name, value in tree["machine"].items() if name not in _REWRITTEN}
    rig_and_map = {name: table for name, table in tree.items() if name not in MACHINE_TABLES}
    parts = {hash_value([statements, rig_and_map]): "another statement of the machine"}
    parts |= {hash_value(row["summary"]): f"another recording, {row['file']}" for row in tree["healthy"]}
    return parts | {hash_value(row): f"another mark of {row['alarm']}" for row in tree.get("alarms", ())}


def _find_change(origin: Origin | None, target: Path, new_tree: Mapping[str, Any]) -> str | None:
    """Find the first change of the file `target` by another process, which writing `new_tree` would undo, or None.

    A part (`_hash_parts`) was added if only the present file has it, and removed if only the present file lacks it. A
    machine that was not loaded from this file (`origin`) replaces it unchecked.
    """
    if origin is None or origin.path != target or not target.exists():
        return None
    present, written = _hash_parts(_read_checked(target)), _hash_parts(new_tree)
    changes = [text for part, text in present.items() if part not in origin.parts and part not in written]
    changes += [text for part, text in written.items() if part in origin.parts and part not in present]
    return changes[0] if changes else None


def _read_checked(path: Path) -> dict[str, Any]:
    """Read the tables of a machine's file and check all but those of the rig; raise InputError if one is not valid."""
    tree = read_toml(path, "a machine's file", str(path))
    _convert_tree(tree, str(path))
    return tree


def _summaries_path(path: Path, tree: Mapping[str, Any]) -> Path:
    """Return the path of the file of summaries that belongs to a machine's file at `path`, with the tables `tree`.

    It has the same name with the suffix `.healthy`. If it does not exist, `summaries` of `[machine]` may name it.
    """
    same_name = path.with_suffix(SUFFIX)
    named = path.with_name(tree["machine"].get("summaries", same_name.name))
    return named if named.exists() and not same_name.exists() else same_name


def _build_tree(machine: CommissionedMachine, path: Path, summaries: Sequence[Line]) -> dict[str, Any]:
    """Build the nested tables of a machine's file at `path`, with the `summaries` of its healthy recordings.

    Values that are None are not written (`format_tables`).
    """
    from importlib.metadata import version

    machine_table = {
        "format": _FORMAT,
        "name": machine.name,
        "summaries": path.with_suffix(SUFFIX).name,
        "sealscope": version("sealscope"),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "rate": machine.rate,
        "limit": machine.limit,
        "left_out": machine.left_out or None,
    }
    tree: dict[str, Any] = {"machine": machine_table}
    if machine.channel_map:
        is_auto = isinstance(machine.channel_map, str)  # "auto": all channels are found by the names of the columns
        tree["map"] = {REST: machine.channel_map} if is_auto else machine.channel_map
    if machine.rig is not None:
        tree |= machine.rig.as_dict()
    summary = machine.summary
    smallest = {} if summary.smallest is None else {"smallest_leak": summary.smallest._asdict()}
    tree["learnt"] = {"problems": summary.problems, "noise": summary.noise, **smallest}
    entries = zip(machine.healthy, summaries, strict=True)
    tree["healthy"] = [{"file": entry.file, "summary": line.checksum} for entry, line in entries]
    tree["alarms"] = [
        {
            "alarm": alarm.alarm,
            "mark": alarm.mark,
            "date": datetime.fromtimestamp(alarm.date_s, UTC).isoformat(),
            "onset": datetime.fromtimestamp(alarm.onset_s, UTC).isoformat(),
            "leak_lpm": alarm.leak_lpm,
            "reason": alarm.reason or None,
        }
        for alarm in machine.alarms
    ]
    return tree


@checked_call
def read_machine(path: str | os.PathLike[str]) -> CommissionedMachine:
    """Read the file of a commissioned machine, with the summaries of its healthy recordings.

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
        The file cannot be read, is of another format, or one of its values is not valid.

    Examples
    --------
    >>> import sealscope as ss
    >>> ss.read_machine("absent.toml")
    Traceback (most recent call last):
    sealscope.errors.InputError: a machine's file must be readable, got: No such file or directory (absent.toml)
    """
    place, target = os.fspath(path), _follow_links(path)
    tree = read_toml(target, "a machine's file", place)
    tables = _convert_tree(tree, place)
    machine_table = tables["machine"]
    rig_tables = {name: table for name, table in tree.items() if name not in (*MACHINE_TABLES, "map")}
    summaries = _summaries_path(target, tree)
    if not summaries.exists():
        rule = "must be in the folder of the machine's file: move it there, or commission the machine anew"
        raise InputError(f"{summaries.name} {rule} ({place})")
    return CommissionedMachine(
        name=machine_table["name"],
        healthy=tuple(read_summaries(summaries, {row["summary"]: row["file"] for row in tables["healthy"]})),
        rig=Rig.from_dict(rig_tables, place=place) if rig_tables else None,
        channel_map=tables.get("map", {}),
        rate=machine_table.get("rate"),
        limit=machine_table.get("limit"),
        left_out=tuple(machine_table.get("left_out", ())),
        alarms=tables["alarms"],
        origin=Origin(target, frozenset(_hash_parts(tree))),
    )


def _convert_tree(tree: dict[str, Any], place: str) -> dict[str, Any]:
    """Check the tables of a machine's file, raising InputError with the path `place`, and convert their values.

    Returns `machine`, `map` (if any), `healthy` and `alarms`, with times in seconds. The rig's tables are not checked.
    """
    try:
        tables: dict[str, Any] = convert_type(_FILE, tree).model_dump(exclude_unset=True)
        check_request(tables.get("map", {}), tables["machine"].get("rate"))
        RepairLimit.parse(tables["machine"].get("limit"))  # raises InputError, a ValueError
        tables["alarms"] = _parse_alarms(tree.get("alarms", []))
        if len({row["summary"] for row in tables["healthy"]}) < len(tables["healthy"]):
            raise ValueError("healthy must name each summary once")
    except ValueError as error:
        raise InputError(f"{error} ({place})") from None
    return tables
