"""Time in several columns: hours, minutes and seconds, or parts of a second beside a time stamp."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.channels import Array
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.units import same_dimension

_DATE, _CLOCK, _SUBSECOND = ("year", "month", "day"), ("hour", "minute", "second"), ("ms", "us", "ns")
#: Nanoseconds of each part, and the upper limit of its value.
_NANOSECONDS = {"hour": 3600e9, "minute": 60e9, "second": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
_UPPER_LIMIT = {
    "month": 13.0, "day": 32.0, "hour": 24.0, "minute": 60.0, "second": 60.0, "ms": 1e3, "us": 1e6, "ns": 1e9
}  # fmt: skip
_MIN_FRACTION = 0.9  # fraction of the steps that must follow a rule: a log may have lost some samples


def find_time_parts(labels: Sequence[Label], used: Container[int], only_subsecond: bool = False) -> dict[str, int]:
    """Find the columns of the parts of the time, such as "hour"; return a mapping from part to column.

    Hours, minutes and seconds must have one column each, else the mapping is empty. Parts of a second are added, and
    year, month and day if all three exist. With `only_subsecond`, there is a time column of whole seconds, and only the
    parts of a second are searched for. Columns in `used` are left out.
    """
    columns_of_part: dict[str, int] = {}
    for part, words in WORDS["part"].items():
        columns = [
            column
            for column, label in enumerate(labels)
            if label.name.strip().casefold() in words
            and column not in used
            and (label.unit is None or same_dimension(label.unit, "s"))
        ]
        if len(columns) == 1:
            columns_of_part[part] = columns[0]
    if not only_subsecond and not columns_of_part.keys() >= {*_CLOCK}:
        return {}
    date_parts = _DATE if columns_of_part.keys() >= {*_DATE} else ()
    parts = _SUBSECOND if only_subsecond else (*date_parts, *_CLOCK, *_SUBSECOND)
    return {part: columns_of_part[part] for part in parts if part in columns_of_part}


def combine_time_parts(base: NDArray[Any], parts: Mapping[str, Array], unit: str | None) -> NDArray[Any] | None:
    """Combine several columns of a time, such as date, hours and minutes, to time stamps or seconds (n,).

    `base` (n,): the time column, datetime64 or doubles in `unit`, of which only dates are used beside a part "hour";
    `parts`: part -> values (n,). None if these cannot be parts of a time, such as milliseconds since the start.
    """
    subsecond_parts = [part for part in _SUBSECOND if part in parts]
    smallest_part = subsecond_parts[-1] if subsecond_parts else "second"
    for part, values in parts.items():
        known = values[np.isfinite(values)]
        # if there are milliseconds, microseconds are parts of a millisecond
        limit = 1e3 if part in subsecond_parts[1:] else _UPPER_LIMIT.get(part, np.inf)
        if not known.size or known.min() < 0.0 or known.max() >= limit:
            return None
        # only the smallest part may have a fraction
        if part != smallest_part and not np.array_equal(known, np.floor(known)):
            return None
    scaled = [values * _NANOSECONDS[part] for part, values in parts.items() if part in _NANOSECONDS]
    offset = np.sum(scaled, axis=0)
    if "hour" in parts:
        return _date_stamps(base, parts) + _to_timedelta(offset)
    if base.dtype.kind == "M":
        is_whole = base == base.astype("datetime64[s]").astype(base.dtype)
        known = ~np.isnat(base)
    else:
        is_whole, known = base == np.floor(base), np.isfinite(base)
    if unit not in (None, "s") or not is_whole[known].all() or not _restarts_each_second(base[known], offset[known]):
        return None
    return base + _to_timedelta(offset) if base.dtype.kind == "M" else base + offset / 1e9


def _restarts_each_second(base: NDArray[Any], offset: Array) -> bool:
    """Test whether the parts of a second grow from sample to sample and restart when the next second begins.

    `base` (n,): whole seconds, numbers or datetime64; `offset` (n,): the parts of a second [ns]. A tenth of the steps
    may differ. False if fewer than half of the steps are within a second, because the parts then show no order.
    """
    steps = np.diff(base) / (np.timedelta64(1, "s") if base.dtype.kind == "M" else 1.0)
    is_same_second, is_next_second, change = steps == 0, steps == 1, np.diff(offset)
    if 2 * np.count_nonzero(is_same_second) < steps.size:  # most seconds have one sample
        return False
    grows = np.count_nonzero(change[is_same_second] > 0) >= _MIN_FRACTION * np.count_nonzero(is_same_second)
    return bool(
        grows and np.count_nonzero(change[is_next_second] < 0) >= _MIN_FRACTION * np.count_nonzero(is_next_second)
    )


def _date_stamps(base: NDArray[Any], parts: Mapping[str, Array]) -> NDArray[np.datetime64]:
    """Build stamps (n,) at midnight from year, month and day in `parts`, else from `base` (n,), else of 1970-01-01.

    NaT where year, month or day is missing.
    """
    if all(part in parts for part in _DATE):
        is_known = np.isfinite([parts[part] for part in _DATE]).all(axis=0)
        year, month, day = (np.where(is_known, parts[part], 1.0) for part in _DATE)
        # months since 1970, as numpy counts them
        months = ((np.clip(year, 1.0, 9999.0) - 1970) * 12 + month - 1).astype(np.int64).astype("datetime64[M]")
        dates = months.astype("datetime64[D]") + (day - 1).astype("timedelta64[D]")
        return np.where(is_known, dates.astype("datetime64[ns]"), np.datetime64("NaT"))
    if base.dtype.kind == "M":
        return base.astype("datetime64[D]").astype("datetime64[ns]")
    return np.full(base.shape, np.datetime64("1970-01-01", "ns"))


def _to_timedelta(offset: Array) -> NDArray[np.timedelta64]:
    """Convert nanoseconds (n,) to timedelta64, NaT for values that are not finite."""
    result = np.round(np.nan_to_num(offset)).astype("timedelta64[ns]")
    result[~np.isfinite(offset)] = np.timedelta64("NaT")
    return result
