"""Arrays and dataclasses as plain values that JSON holds to the bit, and back."""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections.abc import Iterable, Mapping
from dataclasses import is_dataclass
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.storage.plain_values import as_type

_T = TypeVar("_T")
#: Most numbers of one array: what is larger is no state of a stream.
_LARGEST = 50_000_000


def plain_array(values: NDArray[Any]) -> dict[str, Any]:
    """Convert an array of numbers to a mapping of its shape and its bytes (little endian, base64).

    Named columns are the last axis, without their names.
    """
    values = np.ascontiguousarray(_unnamed(values), dtype="<f8")
    return {"shape": list(values.shape), "f8": b64encode(values.tobytes()).decode("ascii")}


def _unnamed(values: NDArray[Any]) -> NDArray[Any]:
    """Convert an array of named columns, all floats, to one with the columns as last axis."""
    names = values.dtype.names
    return values if names is None else values.view(float).reshape(*values.shape, len(names))


def plain_fields(values: Any) -> dict[str, Any]:
    """Return the fields of a dataclass of plain values; lists are copied, for they may grow."""
    return {name: list(value) if isinstance(value, list) else value for name, value in vars(values).items()}


def restored(kind: type[_T], state: Any, name: str) -> _T:
    """Restore a part of a saved state as the dataclass `kind`; raise InputError where it does not fit."""
    try:
        return as_type(kind, state)
    except ValueError as error:
        raise InputError(f"saved state's {name} does not fit: {error}") from None


def array_of(value: Any, name: str) -> NDArray[np.float64]:
    """Restore the array of a mapping by `plain_array`; `name` stands in the error.

    Raises InputError where it is none.
    """
    try:
        shape = tuple(int(size) for size in value["shape"])
        if min(shape, default=0) < 0 or np.prod(shape, dtype=float) > _LARGEST:
            raise ValueError(f"got shape {shape}")
        data = b64decode(value["f8"], validate=True)
        return np.frombuffer(data, dtype="<f8").reshape(shape).astype(np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"saved state's {name} must be an array with its shape: {error}") from None


def part_of(state: Any, name: str, kind: type | tuple[type, ...]) -> Any:
    """Return the part `name` of a saved state; raise InputError where it is missing or of a wrong kind."""
    if not isinstance(state, Mapping) or name not in state:
        raise InputError(f"saved state must have {name!r}, got {type(state).__name__} without")
    value = state[name]
    if not isinstance(value, kind):
        raise InputError(f"saved state's {name} must be {kind}, got {type(value).__name__}")
    return value


def count_of(state: Any, name: str) -> int:
    """Return a whole number >= 0 of a saved state; raise InputError for anything else."""
    value = part_of(state, name, object)
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise InputError(f"saved state's {name} must be a whole number >= 0, got {value!r}")
    return int(value)


def numbers_of(state: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return numbers of this shape from a saved state; raise InputError for anything else."""
    try:
        values = np.asarray(part_of(state, name, object))
        if values.size and values.dtype.kind not in "fi":
            raise TypeError(f"got {values.dtype}")
    except (TypeError, ValueError) as error:
        raise InputError(f"saved state's {name} must hold numbers: {error}") from None
    if values.shape != shape:
        raise InputError(f"saved state's {name} must have shape {shape}, got {values.shape}")
    return values.astype(np.float64)


def saved(owner: Any, names: Iterable[str]) -> dict[str, Any]:
    """Convert attributes to plain values, for `recall`: numbers, texts, lists, arrays, dataclasses, states.

    A number that is not finite is null.
    """
    return {name.lstrip("_"): _plain(getattr(owner, name)) for name in names}


def _plain(value: Any) -> Any:
    if callable(getattr(value, "state", None)):
        return value.state()
    if is_dataclass(value):
        return plain_fields(value)
    if isinstance(value, np.ndarray):
        return plain_array(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return list(value) if isinstance(value, tuple | list) else dict(value) if isinstance(value, dict) else value


def recall(owner: Any, names: Iterable[str], state: Any, kinds: Mapping[str, Any] = MappingProxyType({})) -> None:
    """Set the attributes that `saved` returned; null stands for a number left unchanged, or None.

    `kinds`: types of attributes that may be None, or hold others. Raises InputError where one is missing or unlike what
    is there: in its type, or in the shape of an array but for axes that are empty.
    """
    for name in names:
        plain, present = name.lstrip("_"), getattr(owner, name)
        value = part_of(state, plain, object)
        if isinstance(present, np.ndarray):
            value, kind, present = array_of(value, plain), present.dtype, _unnamed(present)
            if value.ndim != present.ndim or any(
                b not in (a, 0) for a, b in zip(value.shape, present.shape, strict=True)
            ):
                raise InputError(f"saved state's {plain} must have the shape {present.shape}, got {value.shape}")
            if kind.names:
                value = value.view(kind)[:, 0]
        elif hasattr(present, "recall"):
            present.recall(value)
            continue
        elif value is not None or not isinstance(present, float | None):
            value = restored(kinds.get(name, type(present)), value, plain)
        if isinstance(owner, tuple):
            present[:] = value
        elif value is not None:
            setattr(owner, name, value)
