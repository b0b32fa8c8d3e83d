"""A session of the workbench: a folder with a plain TOML file, which several processes may change.

The file names the logs, how they are read, the machines with their healthy recordings, and the verdicts that were
reached. It holds no samples: `app --replay` reaches the verdicts anew.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from sealscope.diagnosis.commissioned.machine import recordings_in
from sealscope.diagnosis.hold.set_up import parse_set_up
from sealscope.diagnosis.verdict.machine_sizes import build_stated_rig
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.recordings.formats.columns import check_request
from sealscope.storage.atomic import atomic_write, remove_temporaries
from sealscope.storage.folders import lock_file, make_folder
from sealscope.storage.toml_file import format_tables, read_model, read_toml

#: Name of a session's file, of the folders beside it, and number of its format.
FILE, DROPPED, MENDED, REPORTS, FORMAT = "session.toml", "dropped", "mended", "reports", 1
_HEAD = "# A session of `sealscope app`: logs, machines and verdicts. `sealscope app --replay FOLDER` judges it anew.\n"
#: Most files, machines and marks of a session.
_MAX_ENTRIES = 20_000
#: How long another process may hold the file [s].
_WAIT_S = 20.0
#: What may be stated of a hold test, by the arguments of `sealscope.hold_test`, and by the command line's options.
HOLD_FIELDS = {
    **{name: f"--{name}" for name in ("limit", "volume", "oil", "collected", "valve", "capped", "loaded")},
    "reference": "--at",
    "start": "--from",
    "end": "--until",
}
#: What a person makes of a recording of a machine.
Mark = Literal["healthy", "rejected", "suspect"]
MARKS: tuple[Mark, ...] = ("healthy", "rejected", "suspect")


@dataclass(frozen=True, kw_only=True)
class MendedLog:
    """A log that was rewritten (`recordings.mending.mend`): its key, the new file, and what was stated."""

    file: str
    target: str
    first_row: int | None = None
    heading_row: int | None = None
    delimiter: str | None = None
    decimal: str | None = None
    time_format: str | None = None
    time_column: int = 1


@dataclass(frozen=True, kw_only=True)
class ReachedVerdict:
    """A verdict on a recording, and what a person makes of it: "confirmed", "rejected" or ""."""

    file: str
    verdict: str
    summary: str = ""
    leak_lpm: float | None = None
    bound_lpm: float | None = None
    opinion: Literal["", "confirmed", "rejected"] = ""


@dataclass(frozen=True, kw_only=True)
class SessionMachine:
    """A machine of a session: what is stated of it, as texts of the command line's options, and its recordings' keys.

    `map` has the column of each channel, with the entries "*" and "group" as for `sealscope.read`; `bore`, `rod` and
    `rods` (the sides with a rod) are kept to be shown again: `area` follows from them. `repairs`: dates;
    `hold`: what is stated of a hold test (`HOLD_FIELDS`).
    """

    name: str
    map: dict[str, str] = field(default_factory=dict)
    rate: float | None = None
    rig: str | None = None
    area: tuple[str, ...] = ()
    bore: str | None = None
    rod: str | None = None
    rods: Literal["A", "B", "AB"] = "B"
    displacement: str | None = None
    limit: str | None = None
    healthy: tuple[str, ...] = ()
    rejected: tuple[str, ...] = ()
    suspect: tuple[str, ...] = ()
    repairs: tuple[str, ...] = ()
    hold: dict[str, str] = field(default_factory=dict)
    commissioned: bool = False
    verdicts: tuple[ReachedVerdict, ...] = ()

    @property
    def channel_map(self) -> Any:
        """The map as `sealscope.read` takes it; "auto" if nothing is mapped by hand."""
        return self.map if self.map and set(self.map) != {"*"} else "auto"

    def build_rig(self) -> Rig | None:
        """Build the rig that is stated, None if nothing is; raise InputError for an invalid text."""
        return build_stated_rig(self.rig, self.area, self.displacement)

    def check(self) -> None:
        """Raise InputError if one of the texts is not valid."""
        if not self.name.strip() or len(self.name) > 80 or self.name.startswith(".") or set(self.name) & set("/\\:\0"):
            raise InputError(f"a machine's name must be that of a file, of 1 to 80 characters, got {self.name[:80]!r}")
        if not self.name.isprintable():
            raise InputError(f"a machine's name must be printable, got {self.name!r}")
        check_request(self.channel_map, self.rate)
        if unknown := self.hold.keys() - HOLD_FIELDS:
            raise InputError(f"a hold test has {', '.join(HOLD_FIELDS)}, got {min(unknown)[:60]!r}")
        parse_set_up(area=self.area or None, **self.hold)
        RepairLimit.parse(self.limit)
        self.build_rig()

    def mark_file(self, file: str, mark: Mark | None) -> SessionMachine:
        """Return the machine with a recording marked, or without its mark."""
        lists: dict[str, Any] = {name: tuple(key for key in getattr(self, name) if key != file) for name in MARKS}
        if mark is not None:
            lists[mark] = (*lists[mark], file)
        return replace(self, **lists)

    def keep_verdict(self, verdict: ReachedVerdict) -> SessionMachine:
        """Return the machine with a verdict in place of an earlier one on the same recording."""
        verdicts = [other for other in self.verdicts if other.file != verdict.file]
        return replace(self, verdicts=(*verdicts, verdict))


@dataclass(frozen=True, kw_only=True)
class Session:
    """The content of a session's file; paths are relative to its folder if they lie in it."""

    format: int = FORMAT
    sources: tuple[str, ...] = ()
    machine: tuple[SessionMachine, ...] = ()
    mended: tuple[MendedLog, ...] = ()

    def find_machine(self, name: str) -> SessionMachine:
        """Find a machine by its name; raise InputError if there is none."""
        for machine in self.machine:
            if machine.name == name:
                return machine
        raise InputError(f"a machine must be known, got none called {name[:80]!r}")

    def with_machine(self, machine: SessionMachine, name: str | None = None) -> Session:
        """Return the session with a machine in place of that called `name`, by default of the same name, or added."""
        machine.check()
        name = machine.name if name is None else name
        names = [other.name.casefold() for other in self.machine if other.name != name]
        if machine.name.casefold() in names:
            raise InputError(f"a machine's name must be new, got {machine.name!r} again")
        if name not in [other.name for other in self.machine]:
            return replace(self, machine=(*self.machine, machine))
        return replace(self, machine=tuple(machine if other.name == name else other for other in self.machine))


class SessionFolder:
    """The folder of a session. `update` changes its file under a lock, so that several processes lose nothing."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder).absolute()
        self.file = self.folder / FILE
        self._lock, self._known = threading.RLock(), (None, Session())  # (stat of the file, its content)

    def open(self) -> None:
        """Create the folder if it is new; a folder of logs becomes the session of these."""
        if self.folder.exists() and not self.folder.is_dir():
            raise InputError(f"a session must be a folder, got a file ({self.folder})")
        make_folder(self.folder)
        remove_temporaries(self.folder, FILE)
        if not self.file.exists():
            has_logs = any(path.is_file() and not path.name.startswith(".") for path in self.folder.iterdir())
            self.update(lambda session: replace(session, sources=(".",) if has_logs else ()))
        self.read()

    def read(self) -> Session:
        """Read the session, again only if its file has changed; raise InputError if it is not valid."""
        with self._lock:
            try:
                status = self.file.stat()
            except OSError:
                return Session()
            stamp = (status.st_mtime_ns, status.st_size, status.st_ino)
            if self._known[0] != stamp:
                session = read_model(read_toml(self.file, "a session", str(self.file)), Session, str(self.file))
                if session.format != FORMAT:
                    raise InputError(f"a session's format must be {FORMAT}, got {session.format} ({self.file})")
                for machine in session.machine:
                    machine.check()
                self._known = (stamp, session)  # type: ignore[assignment]
            return self._known[1]

    def update(self, change: Callable[[Session], Session]) -> Session:
        """Apply a change to the newest content of the session's file, and write it whole; return the new content."""
        busy = f"a session must not be in use, got another process that writes it ({self.file})"
        with self._lock, lock_file(self.folder / f".{FILE}.lock", busy, _WAIT_S):
            session = change(self.read())
            if len(session.sources) > _MAX_ENTRIES or len(session.machine) > 200:
                raise InputError(f"a session must have at most {_MAX_ENTRIES} logs and 200 machines, got more")
            text = _HEAD + "\n".join(format_tables(_to_tree(session))) + "\n"
            with atomic_write(self.file) as temporary:
                temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")
            return self.read()

    def key_of(self, path: Path) -> str:
        """Return the name of a path in the session: relative to its folder if it lies in it."""
        absolute = Path(os.path.abspath(path))  # noqa: PTH100 - a link keeps its name
        return absolute.relative_to(self.folder).as_posix() if absolute.is_relative_to(self.folder) else str(absolute)

    def path_of(self, key: str) -> Path:
        """Return the path of a log by its key: that of the mended log, if it was mended."""
        mended = next((log.target for log in self.read().mended if log.file == key), key)
        return self.folder / mended

    def list_keys(self) -> tuple[list[str], list[tuple[str, str]]]:
        """List the keys of all logs, and the sources that cannot be listed, each with the reason."""
        keys: dict[str, None] = {}
        problems = []
        for source in self.read().sources:
            path = self.folder / source
            try:
                if not path.exists():
                    raise InputError(f"a log must exist, got no such file ({path})")
                if path.is_dir() and path.samefile(self.folder):  # its own files are no logs
                    found = [file for file in _list_folder(path) if file.name != FILE]
                else:
                    found = _list_folder(path) if path.is_dir() else [path]
            except (InputError, OSError, ValueError) as error:
                problems.append((source, str(error)))
                continue
            keys |= dict.fromkeys(map(self.key_of, found))
        return list(keys)[:_MAX_ENTRIES], problems

    def add_sources(self, paths: Iterable[Path]) -> Session:
        """Add folders and files to the session's sources, each once."""
        keys = [self.key_of(path) or "." for path in paths]
        return self.update(lambda session: replace(session, sources=tuple(dict.fromkeys((*session.sources, *keys)))))


def _list_folder(folder: Path) -> list[Path]:
    """List the recordings in a folder; none for a folder without one."""
    try:
        return recordings_in(folder)
    except InputError:
        if not folder.is_dir():
            raise
        return []


def _to_tree(value: Any) -> Any:
    """Convert a session to plain tables for TOML; what has its default value is left out, but the format."""
    if isinstance(value, tuple):
        return [_to_tree(item) for item in value]
    if not hasattr(value, "__dataclass_fields__"):
        return value
    tree = {item.name: _to_tree(getattr(value, item.name)) for item in fields(value)}
    return {name: item for name, item in tree.items() if item not in (None, [], {}, "") and item is not False}
