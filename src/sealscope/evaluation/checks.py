"""Convert and check the inputs of an evaluation; the argument `what` names the input in error messages."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError

Array = npt.NDArray[np.float64]


def as_numbers(values: npt.ArrayLike, what: str) -> Array:
    """Convert `values` to finite numbers (n,), n >= 1; raise InputError if they are not. `what`: name in messages."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{what} must be numbers") from None
    if array.ndim != 1:
        raise InputError(f"{what} must be one flat list, got {array.ndim} dimensions")
    if array.size < 1:
        raise InputError(f"{what} must be at least one number, got none")
    wrong = np.flatnonzero(~np.isfinite(array))
    if wrong.size:
        raise InputError(f"{what} must be finite, got {array[wrong[0]]} (number {wrong[0] + 1} of {array.size})")
    return array


def as_sizes(values: npt.ArrayLike, what: str = "leak sizes") -> Array:
    """Convert `values` to leak sizes (n,) > 0; raise InputError if they are not. `what`: name in messages."""
    array = as_numbers(values, what)
    wrong = np.flatnonzero(array <= 0.0)
    if wrong.size:
        raise InputError(f"{what} must be > 0, got {array[wrong[0]]} (a record without a leak has no leak size)")
    return array


def as_flags(values: npt.ArrayLike, n: int, what: str) -> npt.NDArray[np.bool_]:
    """Convert `n` values True/False or 1/0 to booleans; raise InputError for others. `what`: name in messages."""
    array = as_numbers(np.asarray(values, dtype=np.float64), what)
    if array.size != n:
        raise InputError(f"{what} must be as many as the records, got {array.size} for {n}")
    wrong = np.flatnonzero((array != 0.0) & (array != 1.0))
    if wrong.size:
        raise InputError(f"{what} must be yes or no (1 or 0), got {array[wrong[0]]}")
    return np.asarray(array == 1.0, dtype=np.bool_)


#: Smallest probability that is accepted; no number of records can show a smaller one.
MIN_PROBABILITY = 1e-15


def as_probability(value: float, what: str) -> float:
    """Convert a probability to a float; raise InputError unless 1e-15 <= `value` < 1. `what`: name in messages."""
    if not 0.0 < value < 1.0:
        raise InputError(f"{what} must be between 0 and 1, got {value}")
    if value < MIN_PROBABILITY:
        raise InputError(f"{what} must be at least {MIN_PROBABILITY:g}, got {value:g}")
    return float(value)
