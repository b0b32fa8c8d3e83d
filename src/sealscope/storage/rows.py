"""Store the results of jobs as rows of a file, each on the disk before the next, so that a run can be resumed."""

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

#: Names of the file of rows and of the lock, in the folder of the results.
ROWS, LOCK = "rows.jsonl", ".lock"
#: Longest line of a row [bytes].
_MAX_LINE = 10_000_000


class StoredRow(Protocol):
    """The result of a job that can be stored: it has an `id` and converts to plain JSON values."""

    @property
    def id(self) -> str:
        """Name of the job that gave this result; of several rows with the same name, the last is valid."""

    def as_dict(self) -> dict[str, Any]:
        """Return the result of the job as plain values for JSON."""


Row = TypeVar("Row", bound=StoredRow)


def read_rows(
    folder: Path, row_of: Callable[[Any], Row | None], what: str, parse: Callable[[bytes], Any] = parse_json
) -> dict[str, Row]:
    """Read the results of jobs that `store_rows` stored in a folder; return the last result of each job by its id.

    `parse`: function that parses a line to plain values; `row_of`: function that converts the plain values to a result,
    or to None to ignore the line; `what`: name of the folder in errors. An incomplete last line is ignored, and a
    missing file holds no results. Raises UnreadableFile if the file cannot be read or a line does not fit, and
    InputError for a link, a pipe and the like (`open_inner`).
    """
    path = folder / ROWS
    rows: dict[str, Row] = {}
    try:
        with open_inner(path, f"{what}'s file of rows") as file:
            for number, line in enumerate(iter(lambda: file.readline(_MAX_LINE), b""), start=1):
                # cut by a power loss; the beginning of a line longer than `_MAX_LINE` is refused below
                if not line.endswith(b"\n") and len(line) < _MAX_LINE:
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


def store_rows(folder: Path, rows: Generator[Row, None, None], what: str, allow_nan: bool = False) -> Iterator[Row]:
    """Append each row that the generator `rows` yields to the file `rows.jsonl` in a folder, then yield the row.

    The generator runs a job for each row; a row is on the disk before the next job starts. An incomplete last line of
    an interrupted run is removed first. `rows` is closed at the end; `what` names the folder in errors. Raises
    ValueError for a row with a number that is not finite, unless `allow_nan`, and InputError if writing fails.
    """
    with closing(rows), open_inner(folder / ROWS, f"{what}'s file of rows", "ab+") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _MAX_LINE))  # only the last line is of interest
        _, _, incomplete_line = file.read().rpartition(b"\n")  # empty unless a power loss cut a line off
        file.truncate(size - len(incomplete_line))
        for row in rows:
            line = json.dumps(row.as_dict(), allow_nan=allow_nan, sort_keys=True).encode() + b"\n"
            try:
                while line:  # without the buffer of `file`, which after an error would be written again by its close
                    line = line[os.write(file.fileno(), line) :]
                os.fsync(file.fileno())
            except OSError as error:
                raise InputError(f"cannot write {folder / ROWS}: {error.strerror or error}") from error
            yield row


@contextmanager
def lock_rows(folder: Path, what: str) -> Iterator[None]:
    """Lock the results stored in a folder against other processes while the block runs; remove old temporary files.

    Raises InputError if another process holds the lock; `what` names the folder in the error.
    """
    busy = f"{what} must be run by one process at a time, but another one is running ({folder})"
    with folders.lock_file(folder / LOCK, busy):
        remove_temporaries(folder)
        yield
