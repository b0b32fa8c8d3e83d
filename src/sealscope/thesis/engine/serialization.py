"""Products and runs as files without pickle: JSON for the structure, plain arrays for the numbers, in one .npz."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.recordings.recording import Recording
from sealscope.storage.atomic import atomic_write
from sealscope.storage.opening import open_inner
from sealscope.thesis.engine.context import SimulatedRun
from sealscope.thesis.engine.products import Claim, Figure, FigureCurve, Image, Number, Panel, ThesisTable

_log = logging.getLogger(__name__)
#: Most bytes that a kept file may unpack to.
_LARGEST = 4_000_000_000
_TYPES = {
    kind.__name__: kind
    for kind in (Claim, Figure, Image, Number, Panel, FigureCurve, ThesisTable, SimulatedRun, Recording)
}


def save(path: Path, value: Any, note: Mapping[str, Any] | None = None, *, compress: bool = False) -> None:
    """Write `value` (products, runs, and sequences, mappings, texts and numbers of them) and a `note` in plain JSON.

    Raises TypeError for what has no place in such a file, InputError where the folder cannot be written.
    """
    arrays: dict[str, Any] = {}
    members = {"value": _packed(value, arrays), "note": note}
    for name, member in members.items():
        arrays[name] = np.frombuffer(json.dumps(member, separators=(",", ":")).encode(), dtype=np.uint8)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        (np.savez_compressed if compress else np.savez)(file, **arrays)


def load(path: Path) -> Any | None:
    """Read what `save` wrote, sequences as tuples; None where the file is absent or is no such file."""
    return _read(path, "value")


def load_note(path: Path) -> dict[str, Any] | None:
    """Read the note that `save` wrote beside the value; None where there is none."""
    note = _read(path, "note")
    return note if isinstance(note, dict) else None


def _read(path: Path, member: str) -> Any:
    try:
        with open_inner(path, "a kept file") as opened, np.load(opened, allow_pickle=False) as file:
            if sum(entry.file_size for entry in file.zip.infolist()) > _LARGEST:
                return None
            content = json.loads(bytes(file[member]))
            return _unpacked(content, file) if member == "value" else content
    except Exception as error:  # unpacking a damaged file raises many kinds, as does building a product of its parts
        if not isinstance(error, FileNotFoundError):
            _log.debug("%s holds no %s: %s", path, member, error)
        return None


def _packed(value: Any, arrays: dict[str, Any]) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            raise TypeError(f"an array to keep must hold numbers, got {value.dtype}")
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, np.generic):
        return _packed(value.item(), arrays)
    if is_dataclass(value) and not isinstance(value, type):
        name = type(value).__name__
        if _TYPES.get(name) is not type(value):
            raise TypeError(f"a product must be one of {', '.join(_TYPES)}, got {name}")
        content = {f.name: _packed(getattr(value, f.name), arrays) for f in fields(value) if f.init}
        return {"type": name, "of": content}
    if isinstance(value, Mapping):
        return {"map": [[key, _packed(inner, arrays)] for key, inner in value.items()]}
    if isinstance(value, (tuple, list)):
        return [_packed(inner, arrays) for inner in value]
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    raise TypeError(f"a product must hold texts, numbers and arrays, got {type(value).__name__}")


def _unpacked(content: Any, arrays: Any) -> Any:
    if isinstance(content, list):
        return tuple(_unpacked(inner, arrays) for inner in content)
    if not isinstance(content, dict):
        return content
    if "array" in content:
        return arrays[content["array"]]
    if "map" in content:
        return {key: _unpacked(inner, arrays) for key, inner in content["map"]}
    return _TYPES[content["type"]](**{name: _unpacked(inner, arrays) for name, inner in content["of"].items()})
