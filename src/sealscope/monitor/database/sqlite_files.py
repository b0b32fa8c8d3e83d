"""Notice that files of a SQLite database were removed or replaced, which SQLite itself does not.

A database file in WAL mode has its last transactions in a second file, `-wal`. If somebody deletes this file after a
crash, or puts an older copy of the database in its place, SQLite opens the rest without a word, and blocks that were
acknowledged are gone. So the number of transactions is stored twice: in the database, and in a small file beside it.
If files are removed or replaced while the monitor runs, SQLite goes on writing to files without a name: the contents of
a removed `-wal` are still in reach, those of a replaced database are not.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

#: Ending of the file that counts transactions.
_COUNT_SUFFIX = ".count"


class FilesReplaced(Exception):  # noqa: N818 (says what happened)
    """Raised if the file of the database is no more the one that was opened; nothing can be stored meanwhile."""


class SqliteFiles:
    """The files of an open SQLite database at `path`: the database, its `-wal`, and the count of its transactions."""

    def __init__(self, path: Path) -> None:
        self.path, self._wal, self._count_file = path, Path(f"{path}-wal"), Path(f"{path}{_COUNT_SUFFIX}")
        self._database_number = _file_number(path)
        self._wal_number: tuple[int, int] | None = None  # None until the first transaction

    def stored_count(self) -> int:
        """Read the number of transactions in the file beside the database; 0 if there is none or it is damaged."""
        with suppress(OSError, ValueError):
            return int(self._count_file.read_text("ascii"))
        return 0

    def store_count(self, number: int) -> None:
        """Write the number of transactions beside the database, after each of them.

        It is not synced to the disk: after a power failure it may be too small, which does no harm.
        """
        with suppress(OSError):  # without the file, a loss is not noticed
            descriptor = os.open(self._count_file, os.O_WRONLY | os.O_CREAT, 0o666)
            try:
                os.pwrite(descriptor, b"%-20d" % number, 0)
            finally:
                os.close(descriptor)

    def check_database(self) -> None:
        """Raise FilesReplaced if the file of the database was removed or replaced since it was opened."""
        if _file_number(self.path) != self._database_number:
            raise FilesReplaced(f"{self.path.name} was removed or replaced while the monitor runs: restart the monitor")

    def note_wal(self) -> None:
        """Remember which file `-wal` is, after a transaction."""
        self._wal_number = _file_number(self._wal) or self._wal_number

    def is_wal_lost(self) -> bool:
        """Return True if the file `-wal` was removed or replaced since the last transaction."""
        return self._wal_number is not None and _file_number(self._wal) != self._wal_number


def _file_number(path: Path) -> tuple[int, int] | None:
    """Return the numbers by which the system knows a file, whatever its name; None if there is no such file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
