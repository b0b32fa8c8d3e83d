"""The folder of a reproduction: what is kept between calls, without pickle, each file whole or not at all.

`kept/items/ID.npz` holds an item's products with the key of what they rest on and the files drawn of them;
`kept/runs/KEY.npz` simulated runs, until a call ends; `kept/failed/ID.txt` the traceback of an item that failed. A file
is JSON for the structure and plain arrays for the numbers.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.recordings.recording import Recording
from sealscope.storage.atomic import atomic_write, remove_temporaries
from sealscope.storage.folders import inner_folder, locked
from sealscope.storage.opening import names_a_file, open_inner
from sealscope.thesis.engine.context import SimulatedRun
from sealscope.thesis.engine.products import Claim, Figure, FigureCurve, Image, Number, Panel, Product, ThesisTable

_log = logging.getLogger(__name__)
#: Most bytes that a kept file may unpack to.
_LARGEST = 4_000_000_000
_KINDS = (Claim, Figure, Image, Number, Panel, FigureCurve, ThesisTable, SimulatedRun, Recording)
_TYPES = {kind.__name__: kind for kind in _KINDS}


class ResultsFolder:
    """The kept part of a results folder. Raises InputError where it cannot be created."""

    def __init__(self, folder: Path) -> None:
        self.path = folder
        self._kept = inner_folder(folder, "kept")
        for name in ("items", "runs", "failed"):
            inner_folder(self._kept, name)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder while the block runs, and drop the runs when it ends well.

        Raises InputError where another call holds it.
        """
        with locked(self._kept / "lock", f"a results folder must be used by one call at a time, got {self.path}"):
            remove_temporaries(self.path)
            yield
            shutil.rmtree(self._kept / "runs", ignore_errors=True)

    def save(self, item: str, key: str, products: tuple[Product | Claim, ...], files: tuple[str, ...] = ()) -> None:
        """Save an item's products, the key of what they rest on, and the files drawn of them."""
        _save(self._kept / "items" / f"{item}.npz", products, {"key": key, "files": files}, compress=True)
        (self._kept / "failed" / f"{item}.txt").unlink(missing_ok=True)

    def products(self, item: str, key: str) -> tuple[Product | Claim, ...] | None:
        """Return the products of an item that are kept under the key."""
        path = self._kept / "items" / f"{item}.npz"
        note, products = _load(path, "note"), _load(path, "value")
        valid = isinstance(note, dict) and note.get("key") == key and isinstance(products, tuple)
        return products if valid else None

    def files(self, item: str, key: str) -> tuple[str, ...] | None:
        """Return the files drawn of an item's products under the key; None where those or a file are gone."""
        note = _load(self._kept / "items" / f"{item}.npz", "note")
        if not isinstance(note, dict) or note.get("key") != key or not isinstance(note.get("files"), tuple):
            return None
        files = tuple(map(str, note["files"]))
        return files if all(names_a_file(self.path / name) for name in files) else None

    def save_failure(self, item: str, trace: str) -> None:
        """Save the traceback of an item that failed."""
        with atomic_write(self._kept / "failed" / f"{item}.txt") as temporary:
            temporary.write_text(trace, encoding="utf-8")

    def run(self, key: str, simulate: Callable[[], SimulatedRun]) -> SimulatedRun:
        """Return the run kept under the key, or simulate it while other processes that want it wait."""
        path = self._kept / "runs" / f"{key}.npz"
        with locked(path.with_suffix(".lock"), None):
            run = _load(path, "value")
            if not isinstance(run, SimulatedRun):
                run = simulate()
                _save(path, run, None)
            return run


def _save(path: Path, value: Any, note: Mapping[str, Any] | None, *, compress: bool = False) -> None:
    """Write products or runs; raise TypeError for what has no place in such a file."""
    arrays: dict[str, Any] = {}

    def plain(of: Any) -> Any:
        if isinstance(of, np.ndarray) and of.dtype.kind in "biuf":
            arrays[name := f"a{len(arrays)}"] = of
            return {"$array": name}
        if isinstance(of, np.generic):
            return of.item()
        if is_dataclass(of) and _TYPES.get(type(of).__name__) is type(of):
            return {"$type": type(of).__name__, **{f.name: getattr(of, f.name) for f in fields(of) if f.init}}
        if isinstance(of, Mapping):
            return dict(of)
        raise TypeError(f"a product must hold texts, numbers and arrays of numbers, got {type(of).__name__}")

    for name, member in {"value": value, "note": note}.items():
        arrays[name] = np.frombuffer(json.dumps(member, default=plain, separators=(",", ":")).encode(), dtype=np.uint8)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        (np.savez_compressed if compress else np.savez)(file, **arrays)


def _load(path: Path, member: str) -> Any:
    """Read what `_save` wrote, sequences as tuples; None where the file is absent or is no such file."""
    try:
        with open_inner(path, "a kept file") as opened, np.load(opened, allow_pickle=False) as file:
            if sum(entry.file_size for entry in file.zip.infolist()) > _LARGEST:
                return None

            def built(of: dict[str, Any]) -> Any:
                if "$array" in of:
                    return file[of["$array"]]
                values = {name: _as_tuples(value) for name, value in of.items() if name != "$type"}
                return _TYPES[of["$type"]](**values) if "$type" in of else values

            return _as_tuples(json.loads(bytes(file[member]), object_hook=built))
    except Exception as error:  # unpacking a damaged file raises many kinds, as does building a product of its parts
        if not isinstance(error, FileNotFoundError):
            _log.debug("%s holds no %s: %s", path, member, error)
        return None


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list) else value
