"""The file of a commissioned machine: TOML that people read, with all that a diagnosis compares with.

It is a rig's file, too: `[rig]`, `[motor]` and so on state what is known of it, `[map]` its channels. Beside them
`[machine]` names it, `[learnt]` is what its healthy recordings say, for people to read, and each `[[healthy]]` is a
recording: the checksum of its file, and what it has taught each method. `[[alarms]]` is what persons said of alarms.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, PositiveFloat, create_model

from sealscope.calls import checked_call
from sealscope.diagnosis.commissioned.machine import CommissionedMachine, JudgedAlarm, Judgement
from sealscope.diagnosis.learnt import Learnt
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.parameters.load import OF_MACHINES
from sealscope.recordings.formats.columns import REST, check_call
from sealscope.storage.atomic import atomic_write
from sealscope.storage.plain_values import as_type
from sealscope.storage.toml_file import read_toml

#: Largest file read [bytes]: some 10 kB a recording.
LARGEST = 50_000_000
_HEAD = """\
# A machine commissioned by Sealscope: what its healthy recordings have taught. [machine], [map] and [rig] may be
# edited; [learnt] is written anew with each change; [[healthy]] is what diagnoses compare with.
"""


def _moment(text: Any) -> float:
    try:
        return datetime.fromisoformat(text).timestamp()
    except (TypeError, OverflowError):
        raise ValueError("must be a time as ISO 8601 writes it") from None


def _numbers(values: list[Any]) -> np.ndarray:
    try:
        array = np.array(values, dtype=float)
    except (TypeError, OverflowError):
        raise ValueError("must hold numbers in equal rows") from None
    if not np.isfinite(array).all():
        raise ValueError("must hold finite numbers")
    return array


_Moment = Annotated[float, BeforeValidator(_moment)]
_Numbers = Annotated[Any, AfterValidator(_numbers)]


def _table(extra: Literal["allow", "ignore"] = "ignore", **kinds: Any) -> Any:
    """Return the type of a table by the types of its values, in a tuple with None where a value may be absent."""
    config = ConfigDict(strict=True, allow_inf_nan=False, extra=extra)
    fields = {name: kind if isinstance(kind, tuple) else (kind, ...) for name, kind in kinds.items()}
    return create_model("Table", __config__=config, **fields)  # type: ignore[call-overload]


def _with_sums_of_its_terms(lesson: Any) -> Any:
    size = len(lesson.terms) + 1
    if lesson.sums.ndim != 3 or lesson.sums.shape[1:] != (size, size):
        raise ValueError(f"sums must be of the shape (E, {size}, {size}), got {lesson.sums.shape}")
    if lesson.shut_sums is not None and lesson.shut_sums.shape != (1, size + 1, size + 1):
        raise ValueError(f"shut_sums must be of the shape (1, {size + 1}, {size + 1}), got {lesson.shut_sums.shape}")
    return lesson


_BALANCE = _table(
    "allow",
    terms=list[str],
    scale=float,
    sums=_Numbers,
    shut_sums=(_Numbers, None),
    shut_odds=(float, None),
    flow=float,
    pressure=float,
    start_s=(float, None),
    oil_degC=(float, None),
)
#: What Sealscope's own methods were taught; those of others are plain tables.
_LESSONS = {
    "volume balance": (Annotated[_BALANCE, AfterValidator(_with_sums_of_its_terms)], None),
    "pressure response": (_table("allow", level=float), None),
    "rms change": (
        _table(
            "allow",
            chambers=list[str],
            recorded=(list[str], None),
            rate=float,
            start_s=(float, None),
            levels=_Numbers,
            duty=_Numbers,
        ),
        None,
    ),
}
_ABOUT = {"sha256": str, "pressure_bar": float, "oil_degC": float, "noise": dict[str, float], "wrong": list[str]}
_HEALTHY = _table(
    file=str,
    digest=str,
    units=dict[str, str],
    rate=PositiveFloat,
    seconds=PositiveFloat,
    start_s=(Annotated[_Moment, Field(alias="start")], None),
    lessons=_table("allow", **_LESSONS),
    about=(_table("allow", **{name: (kind, None) for name, kind in _ABOUT.items()}), None),
)
_ALARM = _table(
    alarm=str,
    mark=Judgement,
    date_s=Annotated[_Moment, Field(alias="date")],
    onset_s=Annotated[_Moment, Field(alias="onset")],
    leak_lpm=(float, None),
    reason=(str, None),
)
_FILE = _table(
    machine=_table(format=Literal[1], name=str, rate=(float, None), limit=(str, None), left_out=(list[str], None)),
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
    text = _HEAD + "\n".join(_lines(_tree(machine))) + "\n"
    if target.is_file():
        with atomic_write(target.with_suffix(".toml.bak")) as temporary:
            temporary.write_bytes(target.read_bytes())
    with atomic_write(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return target


def _tree(machine: CommissionedMachine) -> dict[str, Any]:
    """Return the tables of a machine's file."""
    from importlib.metadata import version

    summary, columns, now = machine.summary, machine.channel_map, datetime.now(UTC).isoformat(timespec="seconds")
    head = {"format": 1, "name": machine.name, "sealscope": version("sealscope"), "written": now}
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
        {"file": own.file, "digest": own.digest, "rate": own.rate, "seconds": own.seconds}
        | {"start": _stamp(own.start_s), "units": own.units, "about": own.about, "lessons": own.lessons}
        for own in machine.healthy
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
    tree = read_toml(Path(path), "a machine's file", place, LARGEST)
    rig = {name: table for name, table in tree.items() if name not in OF_MACHINES and name != "map"}
    try:
        stated = as_type(_FILE, tree).model_dump(exclude_unset=True)
        head, columns = stated["machine"], stated.get("map", {})
        check_call(columns, head.get("rate"))
        RepairLimit.of(head.get("limit"))
    except ValueError as error:
        raise InputError(f"{error} ({place})") from None
    return CommissionedMachine(
        name=head["name"],
        healthy=tuple(Learnt(**{"start_s": None, **row}) for row in stated["healthy"]),
        rig=Rig.from_dict(rig, place=place) if rig else None,
        channel_map=columns,
        rate=head.get("rate"),
        limit=head.get("limit"),
        left_out=tuple(head.get("left_out", ())),
        alarms=tuple(JudgedAlarm(**row) for row in stated.get("alarms", ())),
    )
