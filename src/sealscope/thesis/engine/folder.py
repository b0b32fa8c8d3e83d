"""The folder of a reproduction: what is kept between calls, under keys of what it rests on.

`kept/items/ID.npz` holds the products of an item and its record; `kept/drawn/ID.json` which files were drawn of it;
`kept/runs/*.npz` simulated runs; `kept/failed/ID.txt` the traceback of an item that failed. Every file appears whole or
not at all, so that a call that is killed leaves all it finished.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sealscope.storage.atomic import atomic_write, remove_temporaries
from sealscope.storage.folders import inner_folder, locked
from sealscope.storage.opening import names_a_file, open_inner
from sealscope.thesis.engine.context import SimulatedRun
from sealscope.thesis.engine.products import Claim, Product
from sealscope.thesis.engine.serialization import load, load_note, save

#: Most bytes of runs that are kept; the ones unused for the longest time go first.
MOST_RUN_BYTES = 1_000_000_000
_LARGEST_NOTE = 1_000_000


class ResultsFolder:
    """The kept part of a results folder. Raises InputError where it cannot be created."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._kept = inner_folder(folder, "kept")
        for name in ("items", "drawn", "runs", "failed"):
            inner_folder(self._kept, name)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder while the block runs; raise InputError where another call holds it."""
        with locked(self._kept / "lock", f"a results folder must be used by one call at a time, got {self.folder}"):
            remove_temporaries(self.folder)
            yield

    def _item(self, item: str, quick: bool) -> Path:
        return self._kept / "items" / f"{item}{'.quick' if quick else ''}.npz"

    def record(self, item: str, quick: bool) -> dict[str, Any] | None:
        """Return what the kept product of an item rests on, None where there is none."""
        return load_note(self._item(item, quick))

    def products(self, item: str, quick: bool) -> tuple[Product | Claim, ...] | None:
        """Return the kept products of an item."""
        products = load(self._item(item, quick))
        return products if isinstance(products, tuple) else None

    def keep(self, item: str, quick: bool, record: dict[str, Any], products: tuple[Product | Claim, ...]) -> None:
        """Keep an item's products with what they rest on."""
        save(self._item(item, quick), products, record, compress=True)
        (self._kept / "failed" / f"{item}.txt").unlink(missing_ok=True)

    def keep_failure(self, item: str, trace: str) -> None:
        """Keep the traceback of an item that failed."""
        with atomic_write(self._kept / "failed" / f"{item}.txt") as temporary:
            temporary.write_text(trace, encoding="utf-8")

    def drawn(self, item: str) -> tuple[str, tuple[str, ...]]:
        """Return the key of what was last drawn of an item, empty where a file of it is gone, and the drawn files."""
        try:
            with open_inner(self._kept / "drawn" / f"{item}.json", "a note of drawn files") as file:
                note = json.loads(file.read(_LARGEST_NOTE))
            key, files = str(note["key"]), tuple(map(str, note["files"]))
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return "", ()
        return key if all(names_a_file(self.folder / name) for name in files) else "", files

    def keep_drawn(self, item: str, key: str, files: tuple[str, ...]) -> None:
        """Note what was drawn; remove files of an earlier drawing that are no longer made."""
        for name in set(self.drawn(item)[1]) - set(files):
            path = self.folder / name
            if path.parent.resolve().is_relative_to(self.folder.resolve()):  # the note may be a stranger's
                path.unlink(missing_ok=True)
        with atomic_write(self._kept / "drawn" / f"{item}.json") as temporary:
            temporary.write_text(json.dumps({"key": key, "files": files}, indent=1) + "\n", encoding="utf-8")

    def run(self, key: str, simulate: Callable[[], SimulatedRun]) -> SimulatedRun:
        """Return the run kept under `key`, or simulate it while other processes that want it wait."""
        path = self._kept / "runs" / f"{key}.npz"
        with locked(path.with_name(f"{key[:2]}.lock"), None):
            run = load(path)
            if isinstance(run, SimulatedRun):
                with suppress(OSError):
                    os.utime(path)
                return run
            run = simulate()
            save(path, run)
            self._remove_old_runs()
            return run

    def _remove_old_runs(self) -> None:
        runs = []
        for path in (self._kept / "runs").glob("*.npz"):
            with suppress(OSError):
                runs.append((path.stat().st_mtime, path.stat().st_size, path))
        total = sum(size for _, size, _ in runs)
        for _, size, path in sorted(runs):
            if total <= MOST_RUN_BYTES:
                break
            with suppress(OSError):
                path.unlink()
                total -= size
