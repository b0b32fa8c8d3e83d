"""Results of long computations in files, from which later processes restore them without loss.

A file holds the SHA-256 of a JSON text, a line feed and the JSON text. A file that is cut off or altered is therefore
found, and counts as missing. Values are mappings with names as keys, lists, tuples, arrays of numbers or flags, texts,
numbers and None, at any depth.
"""

from __future__ import annotations

import json
import os
import tempfile
from base64 import b64decode, b64encode
from collections.abc import Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

import numpy as np

#: Result of `restore_result` for a file that is missing or not valid.
MISSING: Final = object()
#: Ending of the files' names.
SUFFIX = ".result"
#: Keys that mark an array, a tuple and a mapping in the JSON text.
_ARRAY, _TUPLE, _TABLE = "array", "tuple", "table"


def keep_result(file: Path, value: Any) -> None:
    """Write a value to a file, for `restore_result`; a value of another type, or a full disk, leaves no file."""
    try:
        data = plain_json(value).encode("ascii")
    except TypeError:
        return
    with suppress(OSError):
        handle, name = tempfile.mkstemp(dir=file.parent)
        try:
            with os.fdopen(handle, "wb") as content:
                content.write(sha256(data).hexdigest().encode() + b"\n" + data)
            Path(name).replace(file)  # whole or not at all for other processes
        except OSError:
            Path(name).unlink(missing_ok=True)


def plain_json(value: Any) -> str:
    """Convert a value to a JSON text without loss; raise TypeError for a type that is not supported."""
    return json.dumps(_to_json(value), separators=(",", ":"))


def restore_result(file: Path) -> Any:
    """Read the value that `keep_result` wrote to a file; return `MISSING` if there is none."""
    try:
        checksum, _, data = file.read_bytes().partition(b"\n")
        if sha256(data).hexdigest().encode() != checksum:
            return MISSING
        return _from_json(json.loads(data))
    except (OSError, ValueError, TypeError, KeyError):
        return MISSING


def remove_oldest(folder: Path, most: int) -> None:
    """Remove the oldest results in a folder, so that at most `most` remain."""
    with suppress(OSError):
        files = sorted(folder.glob(f"*{SUFFIX}"), key=lambda file: file.stat().st_mtime)
        for file in files[: max(0, len(files) - most)]:
            file.unlink(missing_ok=True)


def _to_json(value: Any) -> Any:
    """Convert a value to what JSON stores without loss; raise TypeError for a type that is not supported."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Mapping):
        if not all(isinstance(name, str) for name in value):
            raise TypeError("the keys of a mapping must be texts")
        return {_TABLE: {name: _to_json(member) for name, member in value.items()}}
    if isinstance(value, tuple):
        return {_TUPLE: [_to_json(item) for item in value]}
    if isinstance(value, list):
        return [_to_json(item) for item in value]
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        values = np.ascontiguousarray(value)
        return {_ARRAY: b64encode(values.tobytes()).decode(), "type": values.dtype.str, "shape": list(value.shape)}
    raise TypeError(f"a kept value must be plain, got {type(value).__name__}")


def _from_json(value: Any) -> Any:
    """Restore a value from what `_to_json` made of it."""
    if isinstance(value, list):
        return [_from_json(item) for item in value]
    if not isinstance(value, dict):
        return value
    if _TABLE in value:
        return {name: _from_json(member) for name, member in value[_TABLE].items()}
    if _TUPLE in value:
        return tuple(_from_json(item) for item in value[_TUPLE])
    values = np.frombuffer(b64decode(value[_ARRAY]), dtype=np.dtype(value["type"]))
    return values.reshape(value["shape"]).copy()
