"""Rows of finished jobs in a file of a folder: each is on the disk before the next job's, so that a run can go on."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeVar

from sealscope.errors import InputError, UnreadableFile
from sealscope.storage import folders
from sealscope.storage.atomic import remove_temporaries
from sealscope.storage.opening import open_inner
from sealscope.storage.plain_values import parse_json

ROWS, LOCK = "rows.jsonl", ".lock"
#: Longest line of a row [bytes].
_LONGEST = 10_000_000


class StoredRow(Protocol):
    """A row that can be stored: an `id` and plain JSON values."""

    @property
    def id(self) -> str:
        """Name of the job whose row it is."""

    def as_dict(self) -> dict[str, Any]:
        """Return the row as plain JSON values."""


Row = TypeVar("Row", bound=StoredRow)


def read_rows(
    folder: Path, row_of: Callable[[Any], Row | None], what: str, parse: Callable[[bytes], Any] = parse_json
) -> dict[str, Row]:
    """Read the rows of a folder by id, the last of each; a torn last line is ignored.

    `row_of` makes a row of a line's JSON value, None where it does not count; `what` the rows are of stands in errors.
    Raises UnreadableFile for a line that is no row, with its place.
    """
    path = folder / ROWS
    rows: dict[str, Row] = {}
    try:
        with open_inner(path, f"{what}'s file of rows") as file:
            for number, line in enumerate(iter(lambda: file.readline(_LONGEST), b""), 1):
                if not line.endswith(b"\n") and len(line) < _LONGEST:
                    break
                try:
                    row = row_of(parse(line))
                except (ValueError, RecursionError):
                    raise UnreadableFile(
                        f"a line of {what} must be a row, got something else ({path}, line {number})"
                    ) from None
                if row is not None:
                    rows[row.id] = row
    except OSError as error:
        if not isinstance(error, FileNotFoundError):
            raise UnreadableFile(
                f"{what}'s file of rows must be readable, got: {error.strerror or error} ({path})"
            ) from None
    return rows


def stored(folder: Path, rows: Generator[Row, None, None], what: str, allow_nan: bool = False) -> Iterator[Row]:
    """Yield rows as their jobs end, each appended to the folder's file before; `rows` is closed at the end.

    Raises ValueError for a row with a number that is not finite, unless they are allowed (`allow_nan`).
    """
    with closing(rows), open_inner(folder / ROWS, f"{what}'s file of rows", "ab+") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _LONGEST))
        torn = file.read().rpartition(b"\n")[2]  # a line that was being written when the power went
        file.truncate(size - len(torn))
        for row in rows:
            line = json.dumps(row.as_dict(), allow_nan=allow_nan, sort_keys=True).encode() + b"\n"
            try:
                while line:  # past the buffer of `file`, which would be written again at its end
                    line = line[os.write(file.fileno(), line) :]
                os.fsync(file.fileno())
            except OSError as error:
                raise InputError(f"cannot write {folder / ROWS}: {error.strerror or error}") from error
            yield row


@contextmanager
def locked(folder: Path, what: str) -> Iterator[None]:
    """Hold the folder's lock; raise InputError where another process holds it.

    The lock ends with the process, however that ends.
    """
    busy = f"{what} must be run by one process at a time, got another at work ({folder})"
    with folders.locked(folder / LOCK, busy):
        remove_temporaries(folder)
        yield
