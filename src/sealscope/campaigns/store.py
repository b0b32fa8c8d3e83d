"""A campaign's folder: rows appended safely while it runs, and what it was made from."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from sealscope.campaigns.work import Row
from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.atomic import atomic_write

#: What rows of one folder must share, and how it is called.
_SAME = {
    "format": "form of rows",
    "name": "campaign",
    "world": "rig, bench, length, onset or seed",
    "code": "program code",
    "way": "way of making rows (run by run, or in batches on which device)",
    "rate_within": "false-alarm rate, at which its detectors search within a record",
    "assumed": "rig that its detectors assume",
    "plug_ins": "detectors of other distributions",
    "views": "channels that its detectors see",
}
#: The form of a row: 2 since rows keep what each detector stated.
FORMAT = 2
ROWS, HEAD, LOCK = "rows.jsonl", "campaign.json", ".lock"


def read_rows(folder: Path) -> dict[str, Row]:
    """Rows by case id, the last of each; a torn last line is passed over. Raises UnreadableFile for a line that is no
    row."""
    path = folder / ROWS
    if not path.is_file():
        return {}
    found: dict[str, Row] = {}
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            if not line.endswith(b"\n"):
                break
            try:
                row = Row.from_dict(json.loads(line))
            except (ValueError, TypeError, KeyError, AttributeError, IndexError):
                raise UnreadableFile(
                    f"a line of a campaign must be a row, got something else ({path}, line {number})"
                ) from None
            found[row.id] = row
    return found


def head(folder: Path) -> dict[str, Any] | None:
    """What the folder's campaign was made from, None where there is none yet."""
    path = folder / HEAD
    if not path.is_file():
        return None
    try:
        tree = json.loads(path.read_bytes())
    except (OSError, ValueError):
        tree = None
    if not isinstance(tree, dict):
        raise UnreadableFile(f"a campaign's head must be a JSON object, got something else ({path})")
    return tree


def begin(folder: Path, made_from: Mapping[str, Any]) -> None:
    """Make the folder a campaign's, or go on in it; raises InputError where it holds rows of another one."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"a campaign's folder must be one or become one, got: {error.strerror} ({folder})") from None
    before = head(folder)
    if before is not None and (folder / ROWS).is_file():
        for key, words in _SAME.items():
            if before.get(key) != made_from[key]:
                raise InputError(
                    f"a campaign goes on only with the same {words}: its rows would not belong together; choose "
                    f"another folder or remove this one ({folder})"
                )
    with atomic_write(folder / HEAD) as temporary:
        temporary.write_text(json.dumps(made_from, indent=1, sort_keys=True) + "\n", encoding="utf-8")


class Appender:
    """The one writer of a campaign's rows: each line is on disk before the next is begun."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / ROWS
        self._file: IO[bytes] | None = None

    def __enter__(self) -> Appender:
        file = self._path.open("ab+")
        size = file.seek(0, os.SEEK_END)
        keep = size
        while keep and _byte(file, keep - 1) != b"\n":  # a line that was being written when the power went
            keep -= 1
        if keep < size:
            file.truncate(keep)
        self._file = file
        return self

    def append(self, row: Row) -> None:
        """Write one row and have it on disk."""
        assert self._file is not None
        self._file.write(json.dumps(row.as_dict(), allow_nan=False, sort_keys=True).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()


def _byte(file: IO[bytes], at: int) -> bytes:
    file.seek(at)
    return file.read(1)


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Hold the folder against a second run of the same campaign; raises InputError where one is at work.

    The hold ends with the process, however that ends. Where the system has no such lock nothing is held.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(
                f"a campaign must be run by one process at a time, got another at work ({folder})"
            ) from None
        yield
