"""Columns of numbers on the disk, mapped into memory, and windows of them with a minimum and maximum for each pixel.

The arrays of a log are written while it is read, so that its first rows can be drawn before the last is read. They are
kept in the user's cache folder by the log's path, size and time, and made anew if they are gone.
"""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from platformdirs import user_cache_path

from sealscope.errors import InputError, SealscopeError
from sealscope.recordings.recording import Array
from sealscope.storage.atomic import atomic_write

#: Largest size of all cached arrays [bytes]; the tables that were used least lately are removed beyond it.
_MAX_BYTES = 20e9
_INDEX = "table.json"
#: Most points of a line in a window, and most bins of it.
_MAX_PIXELS = 4000


def cache_folder() -> Path:
    """Return the folder of cached tables: in `SEALSCOPE_CACHE_DIR` if that is set, else in the user's cache folder."""
    setting = os.environ.get("SEALSCOPE_CACHE_DIR")
    return (Path(setting) if setting else user_cache_path("sealscope", appauthor=False)) / "app"


@dataclass
class MappedTable:
    """Columns of numbers over time in a folder, of which `count` rows are written so far.

    `details`: what the reader says of the file, as plain values; `names`: headings of the columns; `error`: why reading
    ended early; `complete`: True once all rows are written; `begun`: set once there are rows, or an error.
    """

    folder: Path
    names: list[str] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    count: int = 0
    complete: bool = False
    error: str = ""
    begun: threading.Event = field(default_factory=threading.Event)

    def column(self, index: int) -> Array:
        """Map the values of a column (n,), or of the time for the index -1, into memory."""
        name = "t" if index < 0 else str(index)
        if self.count == 0:
            return np.empty(0)
        try:
            return np.memmap(self.folder / f"{name}.f8", dtype="<f8", mode="r", shape=(self.count,))
        except FileNotFoundError:  # the folder was just given its final name
            time.sleep(0.05)
            return np.memmap(self.folder / f"{name}.f8", dtype="<f8", mode="r", shape=(self.count,))

    def append(self, t: Array, columns: Sequence[Array]) -> None:
        """Write more rows: times (m,) and the values of each column (m,)."""
        for name, values in zip(("t", *map(str, range(len(columns)))), (t, *columns), strict=True):
            with (self.folder / f"{name}.f8").open("ab") as file:
                np.ascontiguousarray(values, dtype="<f8").tofile(file)
        self.count += len(t)  # after all columns are written

    def finish(self) -> None:
        """Write the index, which makes the table complete for later processes."""
        index = {"names": self.names, "details": self.details, "count": self.count}
        with atomic_write(self.folder / _INDEX) as temporary:
            temporary.write_text(json.dumps(index), encoding="utf-8")
        self.complete = True

    def window(self, indices: Sequence[int], begin: float | None, end: float | None, pixels: int) -> dict[str, Any]:
        """Reduce the rows with `begin` <= t <= `end` [s] to a minimum and a maximum of each column for each pixel.

        Returns `t` and `lines`, arrays in which a minimum and a maximum alternate, or the rows themselves if they are
        few; `first`, `last`: times of the whole table.
        """
        t = self.column(-1)
        if not len(t):
            return {"t": [], "lines": [[] for _ in indices], "first": 0.0, "last": 0.0, "whole": True}
        start = 0 if begin is None else int(np.searchsorted(t, begin, "left")) - 1
        stop = len(t) if end is None else int(np.searchsorted(t, end, "right")) + 1
        start, stop = max(0, min(start, len(t) - 1)), max(1, min(stop, len(t)))
        size = max(1, -(-(stop - start) // max(1, min(pixels, _MAX_PIXELS))))
        if size <= 2:
            rows = slice(start, stop)
            times = np.array(t[rows])
            lines = [np.where(np.isfinite(v := np.array(self.column(k)[rows])), v, np.nan) for k in indices]
        else:
            middle = np.minimum(np.arange(start, stop, size) + size // 2, stop - 1)
            times = np.column_stack([t[start:stop:size], t[middle]]).ravel()
            lines = [np.column_stack(reduce_extremes(self.column(k), start, stop, size)).ravel() for k in indices]
        return {"t": times, "lines": lines, "first": t[0], "last": t[-1], "whole": size <= 2}


def mean_rates(
    table: MappedTable, indices: Sequence[int], begin: float | None, end: float | None, pixels: int, shortest: float
) -> dict[str, Any]:
    """Compute the mean rate of change a minute of columns that accumulate, in bins of `shortest` [s] or longer.

    Arguments and result are as of `MappedTable.window`.
    """
    t = table.column(-1)
    if len(t) < 2:
        return {"t": [], "lines": [[] for _ in indices], "first": 0.0, "last": 0.0, "whole": True}
    start = 0 if begin is None else max(0, int(np.searchsorted(t, begin, "left")) - 1)
    stop = len(t) - 1 if end is None else min(len(t) - 1, int(np.searchsorted(t, end, "right")))
    start = min(start, len(t) - 2)
    stop = max(stop, start + 1)
    step = (float(t[-1]) - float(t[0])) / (len(t) - 1)
    least = max(1, round(shortest / max(step, 1e-12)))
    size = max(least, -(-(stop - start) // max(1, min(pixels, _MAX_PIXELS))))
    edges = np.append(np.arange(start, stop, size), stop)
    times = np.array(t[edges])
    spans = np.maximum(np.diff(times), 1e-12) / 60.0
    lines = [np.diff(np.array(table.column(k)[edges])) / spans for k in indices]
    middle = 0.5 * (times[1:] + times[:-1])
    return {"t": middle, "lines": lines, "first": t[0], "last": t[-1], "whole": size == least}


def reduce_extremes(values: Array, start: int, stop: int, size: int) -> tuple[Array, Array]:
    """Compute minimum and maximum of each `size` values from `start` to `stop`; NaN where there is no finite value."""
    whole = (stop - start) // size
    body = values[start : start + whole * size].reshape(whole, size)
    low, high = body.min(axis=1), body.max(axis=1)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        finite = np.where(np.isfinite(body), body, np.nan)
        low, high = np.fmin.reduce(finite, axis=1), np.fmax.reduce(finite, axis=1)
    if start + whole * size < stop:
        tail = values[start + whole * size : stop]
        tail = tail[np.isfinite(tail)]
        ends = (tail.min(), tail.max()) if tail.size else (np.nan, np.nan)
        low, high = np.append(low, ends[0]), np.append(high, ends[1])
    return low, high


#: Function that yields the parts of a table: names and `details`, times, and values of each column.
Source = Callable[[], Iterator[tuple[Sequence[str], Mapping[str, Any], Array, Sequence[Array]]]]


class TableCache:
    """Mapped tables by key, which are filled in the background by one thread each."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder or cache_folder()
        self._tables: dict[str, MappedTable] = {}
        self._lock = threading.Lock()
        self.n_filling = 0  # tables that somebody waits for; other work lets them go first

    def open(self, key: str, source: Source, wait: float = 0.0) -> MappedTable:
        """Return the table of a key, and begin to fill it by `source` if it is new.

        `wait`: time [s] to wait for the first rows.
        """
        digest = sha256(key.encode("utf-8", "surrogateescape")).hexdigest()[:32]
        with self._lock:
            table = self._tables.get(digest)
            if table is None:
                table = self._load(digest)
                if table is None:
                    table = self._start(digest, source)
                self._tables[digest] = table
        table.begun.wait(wait)
        return table

    def forget(self, key: str) -> None:
        """Forget a table, so that it is read anew."""
        digest = sha256(key.encode("utf-8", "surrogateescape")).hexdigest()[:32]
        with self._lock:
            self._tables.pop(digest, None)
            shutil.rmtree(self._folder / digest, ignore_errors=True)

    def _load(self, digest: str) -> MappedTable | None:
        """Load a complete table from the disk; None if there is none."""
        folder = self._folder / digest
        try:
            index = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
            table = MappedTable(folder, index["names"], index["details"], index["count"], complete=True)
            for number in range(-1, len(table.names)):
                table.column(number)
            table.begun.set()
            os.utime(folder)
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return table

    def _start(self, digest: str, source: Source) -> MappedTable:
        """Begin to fill a table in a thread."""
        folder = self._folder / digest
        shutil.rmtree(folder, ignore_errors=True)
        # a folder of this process until it is complete: two processes may fill the same table
        part = self._folder / f"{digest}.{os.getpid()}"
        shutil.rmtree(part, ignore_errors=True)
        try:
            part.mkdir(mode=0o700, parents=True)
        except OSError as error:
            raise InputError(f"cannot write to the cache {self._folder}: {error.strerror or error}") from None
        table = MappedTable(part)
        threading.Thread(target=self._fill, args=(table, folder, source), daemon=True).start()
        return table

    def _fill(self, table: MappedTable, folder: Path, source: Source) -> None:
        """Write the rows of a source to a table; an error becomes the table's `error`."""
        self.n_filling += 1
        try:
            for names, details, t, columns in source():
                table.names, table.details = list(names), dict(details)
                table.append(t, columns)
                table.begun.set()
            table.finish()
            with suppress(OSError):
                table.folder.rename(folder)
                table.folder = folder
            self._prune()
        except (SealscopeError, OSError, MemoryError) as error:
            table.error = " ".join((str(error) or "out of memory").split())
        except Exception as error:  # a defect must be said, not end in silence
            table.error = f"cannot read, got {type(error).__name__}: {error}"
        finally:
            self.n_filling -= 1
            table.begun.set()

    def _prune(self) -> None:
        """Remove the tables that were used least lately, beyond `_MAX_BYTES`."""
        entries = []
        for folder in self._folder.iterdir():
            with suppress(OSError):
                size = sum(file.stat().st_size for file in folder.iterdir())
                entries.append((folder.stat().st_mtime, size, folder))
        total = sum(size for _, size, _ in entries)
        used = {table.folder for table in self._tables.values()}
        for _, size, folder in sorted(entries, key=lambda entry: entry[0]):
            if total <= _MAX_BYTES:
                return
            if folder not in used:
                shutil.rmtree(folder, ignore_errors=True)
                total -= size
