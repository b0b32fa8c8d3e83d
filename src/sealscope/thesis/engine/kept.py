"""Products and runs as files without pickle: plain JSON for the shape, plain arrays for the numbers, in one .npz."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.recordings.atomic import atomic_write
from sealscope.recordings.recording import Recording
from sealscope.thesis.engine.context import SimulatedRun
from sealscope.thesis.engine.products import Claim, Curve, Figure, Image, Number, Panel, Table

_TYPES = {one.__name__: one for one in (Claim, Curve, Figure, Image, Number, Panel, Table, SimulatedRun, Recording)}
_SHAPE = "shape"


def save(path: Path, value: Any, *, small: bool = False) -> None:
    """Write `value` (products, runs, and lists, tuples, mappings, texts and numbers of them) as one file; `small`:
    compressed.

    Raises TypeError for what cannot be kept, InputError where the folder cannot be written.
    """
    arrays: dict[str, Any] = {}
    shape = json.dumps(_packed(value, arrays), separators=(",", ":"))
    arrays[_SHAPE] = np.frombuffer(shape.encode(), dtype=np.uint8)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        (np.savez_compressed if small else np.savez)(file, **arrays)


def load(path: Path) -> Any | None:
    """What `save` wrote, sequences as tuples; None where the file is absent or cannot be read as such."""
    try:
        with np.load(path, allow_pickle=False) as file:
            shape = json.loads(bytes(file[_SHAPE]))
            return _unpacked(shape, file)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None


def write_json(path: Path, value: Any) -> None:
    """Write plain values as JSON, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def read_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a JSON file; empty where the file is absent or holds no mapping."""
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}


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
        return {"type": name, "of": {f.name: _packed(getattr(value, f.name), arrays) for f in fields(value)}}
    if isinstance(value, Mapping):
        return {"map": [[key, _packed(inner, arrays)] for key, inner in value.items()]}
    if isinstance(value, (tuple, list)):
        return [_packed(inner, arrays) for inner in value]
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    raise TypeError(f"a product must hold texts, numbers and arrays, got {type(value).__name__}")


def _unpacked(shape: Any, arrays: Any) -> Any:
    if isinstance(shape, list):
        return tuple(_unpacked(inner, arrays) for inner in shape)
    if not isinstance(shape, dict):
        return shape
    if "array" in shape:
        return arrays[shape["array"]]
    if "map" in shape:
        return {key: _unpacked(inner, arrays) for key, inner in shape["map"]}
    return _TYPES[shape["type"]](**{name: _unpacked(inner, arrays) for name, inner in shape["of"].items()})
