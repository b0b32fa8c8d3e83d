"""Checks of the numbers of an evaluation, each with a message of one line."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError

Array = npt.NDArray[np.float64]


def numbers(values: npt.ArrayLike, what: str) -> Array:
    """Convert `values` to a flat array of finite doubles, one or more; InputError names the first that is not."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{what} must be numbers") from None
    if array.ndim != 1:
        raise InputError(f"{what} must be one flat list, got {array.ndim} dimensions")
    if array.size < 1:
        raise InputError(f"{what} must be at least 1, got {array.size}")
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise InputError(f"{what} must be finite, got {array[bad[0]]} (number {bad[0] + 1} of {array.size})")
    return array


def sizes(values: npt.ArrayLike, what: str = "leak sizes") -> Array:
    """Convert `values` to sizes of leaks, all > 0: records without a leak belong to the false alarms."""
    array = numbers(values, what)
    bad = np.flatnonzero(array <= 0.0)
    if bad.size:
        raise InputError(f"{what} must be > 0, got {array[bad[0]]} (a record without a leak is no size of leak)")
    return array


def flags(values: npt.ArrayLike, n: int, what: str) -> npt.NDArray[np.bool_]:
    """Convert `values` to n truth values (True/False or 1/0)."""
    array = numbers(np.asarray(values, dtype=np.float64), what)
    if array.size != n:
        raise InputError(f"{what} must be as many as the records, got {array.size} for {n}")
    bad = np.flatnonzero((array != 0.0) & (array != 1.0))
    if bad.size:
        raise InputError(f"{what} must be yes or no (1 or 0), got {array[bad[0]]}")
    return np.asarray(array == 1.0, dtype=np.bool_)


#: Smallest probability that is asked for: what no number of records can show.
LEAST_SHARE = 1e-15


def share(value: float, what: str) -> float:
    """Convert `value` to a probability strictly between 0 and 1 whose inverse does not overflow."""
    if not 0.0 < value < 1.0:
        raise InputError(f"{what} must be between 0 and 1, got {value}")
    if value < LEAST_SHARE:
        raise InputError(f"{what} must be at least {LEAST_SHARE:g}, got {value:g}")
    return float(value)
