"""The folder of a reproduction: what is kept between calls, under keys of what it rests on.

`kept/items/ID.npz` the products of an item with its record; `kept/drawn/ID.json` which files were drawn of it;
`kept/runs/*.npz` simulated runs; `kept/failed/ID.txt` the traceback of an item that failed. Every file appears whole
or not at all, so that a call broken off leaves all it finished.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

from sealscope.errors import InputError
from sealscope.thesis.engine.context import SimulatedRun
from sealscope.thesis.engine.kept import load, read_json, save, write_json

#: Most bytes of runs that are kept; the ones unused for the longest time go first.
MOST_RUN_BYTES = 1_000_000_000
_TEMPORARY_AGE = 3600.0


@dataclass(frozen=True)
class Record:
    """What a kept product rests on.

    `key`: the item, its sources and libraries; `sheet`: the data sheet's hash, None where the maker did not look at
    it; `runs`: the key of simulation, None where it ran nothing; `asked`: stamps of other items' products it took.
    """

    key: str
    sheet: str | None = None
    runs: str | None = None
    asked: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0

    def stamp(self) -> str:
        """A short name of this product, the same only for one that rests on the same."""
        text = json.dumps([self.key, self.sheet, self.runs, sorted(self.asked.items())])
        return hashlib.sha256(text.encode()).hexdigest()[:24]


class Store:
    """The kept part of a results folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.kept = folder / "kept"
        try:
            for name in ("items", "drawn", "runs", "failed"):
                (self.kept / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"a folder to write into must be one or become one, got: {error.strerror} ({folder})"
            ) from None

    def _item(self, item: str, quick: bool) -> Path:
        return self.kept / "items" / f"{item}{'.quick' if quick else ''}.npz"

    def record(self, item: str, quick: bool) -> Record | None:
        """What the kept product of an item rests on, None where there is none."""
        path = self._item(item, quick)
        noted = read_json(path.with_suffix(".json"))
        if not noted or not path.is_file():
            return None
        with suppress(TypeError):
            return Record(**noted)
        return None

    def products(self, item: str, quick: bool) -> tuple[Any, ...] | None:
        """The kept products of an item."""
        found = load(self._item(item, quick))
        return found if isinstance(found, tuple) else None

    def keep(self, item: str, quick: bool, record: Record, products: tuple[Any, ...]) -> None:
        """Keep an item's products; the record is written last, so that it never stands without them."""
        path = self._item(item, quick)
        path.with_suffix(".json").unlink(missing_ok=True)
        save(path, products, small=True)
        write_json(path.with_suffix(".json"), asdict(record))
        (self.kept / "failed" / f"{item}.txt").unlink(missing_ok=True)

    def failed(self, item: str, trace: str) -> None:
        """Keep the traceback of an item that failed."""
        (self.kept / "failed" / f"{item}.txt").write_text(trace, encoding="utf-8")

    def drawn(self, item: str) -> tuple[str, tuple[str, ...]]:
        """Key of what was last drawn of an item and its files, relative to the folder; ("", ()) where one is gone."""
        noted = read_json(self.kept / "drawn" / f"{item}.json")
        files = tuple(noted.get("files", ()))
        if not all((self.folder / name).is_file() for name in files):
            return "", ()
        return str(noted.get("key", "")), files

    def keep_drawn(self, item: str, key: str, files: tuple[str, ...]) -> None:
        """Note what was drawn; files of an earlier drawing that are no longer made are removed."""
        path = self.kept / "drawn" / f"{item}.json"
        for name in set(read_json(path).get("files", ())) - set(files):
            (self.folder / name).unlink(missing_ok=True)
        write_json(path, {"key": key, "files": list(files)})

    def run(self, key: str, make: Callable[[], SimulatedRun]) -> SimulatedRun:
        """The run kept under `key`, or made now by one process while others that want it wait."""
        path = self.kept / "runs" / f"{key}.npz"
        found = self._load_run(path)
        if found is None:
            with held(self.kept / "runs" / f"{key[:2]}.lock"):
                found = self._load_run(path)
                if found is None:
                    made = make()
                    save(path, made)
                    self._prune_runs()
                    return made
        return found

    def _load_run(self, path: Path) -> SimulatedRun | None:
        found = load(path)
        if not isinstance(found, SimulatedRun):
            return None
        with suppress(OSError):
            os.utime(path)
        return found

    def _prune_runs(self) -> None:
        entries = []
        for entry in os.scandir(self.kept / "runs"):
            with suppress(OSError):
                if entry.name.endswith(".npz"):
                    entries.append((entry.stat().st_mtime, entry.stat().st_size, entry.path))
        total = sum(size for _, size, _ in entries)
        for _, size, path in sorted(entries):
            if total <= MOST_RUN_BYTES:
                break
            with suppress(OSError):
                Path(path).unlink()
                total -= size

    def clean(self) -> None:
        """Remove the temporary files that a killed call left."""
        old = time.time() - _TEMPORARY_AGE
        for path in self.folder.rglob(".*.part"):
            with suppress(OSError):
                if path.stat().st_mtime < old:
                    path.unlink()


@contextmanager
def held(path: Path, *, wait: bool = True) -> Iterator[bool]:
    """Hold a lock file while the block runs, giving whether it is held; the system frees it when the process ends.

    Where `wait` is false and another process holds it, the block runs with False.
    """
    with path.open("a+b") as file:
        got = _lock(file, wait)
        try:
            yield got
        finally:
            if got:
                _unlock(file)


if sys.platform == "win32":  # pragma: no cover
    import msvcrt

    def _lock(file: IO[bytes], wait: bool) -> bool:
        while True:
            try:
                file.seek(0)
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            except OSError:
                if not wait:
                    return False
                time.sleep(0.05)
            else:
                return True

    def _unlock(file: IO[bytes]) -> None:
        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)

else:
    import fcntl

    def _lock(file: IO[bytes], wait: bool) -> bool:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            return False
        return True

    def _unlock(file: IO[bytes]) -> None:
        fcntl.flock(file, fcntl.LOCK_UN)
