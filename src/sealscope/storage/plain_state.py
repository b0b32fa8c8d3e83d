"""Convert arrays and dataclasses to plain values that JSON stores without loss, and back."""

from __future__ import annotations

import math
from base64 import b64decode, b64encode
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.storage.plain_values import convert_type, to_plain

_T = TypeVar("_T")
#: Most numbers in an array that is restored.
_MAX_SIZE = 50_000_000


def plain_array(values: NDArray[Any]) -> dict[str, Any]:
    """Convert an array of numbers to a mapping for JSON: its `shape`, and its values `f8`.

    The values are 64-bit floats, little endian, in base64 text. The columns of a structured array become the last axis.
    """
    values = np.ascontiguousarray(_as_plain_array(values), dtype="<f8")
    return {"shape": list(values.shape), "f8": b64encode(values.tobytes()).decode("ascii")}


def _as_plain_array(values: NDArray[Any]) -> NDArray[Any]:
    """Convert a structured array of floats to a plain array whose last axis holds the columns; return others as is."""
    names = values.dtype.names
    return values if names is None else values.view(float).reshape(*values.shape, len(names))


def restore(kind: type[_T], state: Any, name: str) -> _T:
    """Convert the entry `name` of a saved state to the type `kind`; raise InputError if it does not fit."""
    try:
        return convert_type(kind, state)
    except ValueError as error:
        raise InputError(f"saved state's {name} does not fit: {error}") from None


def restore_array(value: Any, name: str) -> NDArray[np.float64]:
    """Restore an array of doubles from the mapping that `plain_array` made.

    `name`: its name in errors. Raises InputError for any other value, and for more than `_MAX_SIZE` numbers.
    """
    try:
        shape = tuple(int(size) for size in value["shape"])
        if min(shape, default=0) < 0 or math.prod(shape) > _MAX_SIZE:
            raise ValueError(f"got shape {shape}")
        data = b64decode(value["f8"], validate=True)
        return np.frombuffer(data, dtype="<f8").reshape(shape).astype(np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"saved state's {name} must be an array with its shape: {error}") from None


def require_part(state: Any, name: str, kind: type | tuple[type, ...]) -> Any:
    """Return the entry `name` of a saved state; raise InputError if it is missing or not of the type `kind`."""
    if not isinstance(state, Mapping) or name not in state:
        raise InputError(f"saved state must have {name!r}, got {type(state).__name__} without it")
    value = state[name]
    if not isinstance(value, kind):
        raise InputError(f"saved state's {name} must be {kind}, got {type(value).__name__}")
    return value


def save_attributes(owner: Any, names: Iterable[str]) -> dict[str, Any]:
    """Convert the attributes of `owner` called `names` to plain values, which `restore_attributes` reads.

    A value with a method `state` is converted by this method, an array or a list of arrays by `plain_array`, and any
    other value by `to_plain`. Keys of the result are the names without leading underscores.
    """
    return {name.lstrip("_"): _save_value(getattr(owner, name)) for name in names}


def _save_value(value: Any) -> Any:
    """Convert the value of an attribute by the rules of `save_attributes`."""
    if callable(getattr(value, "state", None)):
        return value.state()
    if isinstance(value, np.ndarray):
        return plain_array(value)
    if isinstance(value, list) and value and isinstance(value[0], np.ndarray):
        return [plain_array(array) for array in value]
    return to_plain(value)


def restore_attributes(
    owner: Any, names: Iterable[str], state: Any, kinds: Mapping[str, Any] = MappingProxyType({})
) -> None:
    """Set the attributes of `owner` called `names` to the values that `save_attributes` saved in `state`.

    - A saved array must have the shape of the present one, except where the present one has an axis of length 0. If
      `owner` is a named tuple, its arrays are filled in place. The rule on shapes holds for each array of a list.
    - An attribute with a method `load_state` restores itself.
    - A saved None leaves an attribute unchanged if its present value is a float or None: `to_plain` saves NaN and
      infinite numbers as None.
    - Any other value must have the type that `kinds` states, by default the type of the present value.

    Raises InputError if an attribute is missing in `state` or breaks one of these rules.
    """
    for name in names:
        key, present = name.lstrip("_"), getattr(owner, name)
        saved = require_part(state, key, object)
        if hasattr(present, "load_state"):  # an object with a state restores itself
            present.load_state(saved)
        elif isinstance(present, np.ndarray) and isinstance(owner, tuple):
            present[:] = _restore_like(present, saved, key)
        elif isinstance(present, np.ndarray):
            setattr(owner, name, _restore_like(present, saved, key))
        elif isinstance(present, list) and present and isinstance(present[0], np.ndarray):
            if not isinstance(saved, list) or len(saved) != len(present):
                raise InputError(f"saved state's {key} must be a list of {len(present)} arrays, got another value")
            arrays = [_restore_like(array, value, key) for array, value in zip(present, saved, strict=True)]
            setattr(owner, name, arrays)
        elif saved is not None or not isinstance(present, float | None):
            setattr(owner, name, restore(kinds.get(name, type(present)), saved, key))


def _restore_like(present: NDArray[Any], saved: Any, name: str) -> NDArray[Any]:
    """Restore an array, saved as the entry `name` of a state, as `restore_attributes` describes."""
    values, shape = restore_array(saved, name), _as_plain_array(present).shape
    if values.ndim != len(shape) or any(
        length not in (saved_length, 0) for saved_length, length in zip(values.shape, shape, strict=True)
    ):
        raise InputError(f"saved state's {name} must have the shape {shape}, got {values.shape}")
    # of a structured array the saved values (n, columns) become n records
    return values.view(present.dtype)[:, 0] if present.dtype.names else values


class SavedAttributes:
    """An object whose attributes `SAVED` are saved as plain values for JSON; finite numbers are restored exactly.

    `SAVED_TYPES`: by name, the types of saved attributes whose first value has another type, such as None.
    """

    SAVED: ClassVar[tuple[str, ...]] = ()
    SAVED_TYPES: ClassVar[Mapping[str, Any]] = MappingProxyType({})

    def state(self) -> dict[str, Any]:
        """Return the attributes to save as plain values for JSON, which `load_state` restores."""
        return save_attributes(self, self.SAVED)

    def load_state(self, state: Any) -> None:
        """Restore the attributes that `state` saved; raise InputError if one is missing or does not fit."""
        restore_attributes(self, self.SAVED, state, self.SAVED_TYPES)
