"""The time in several columns: hours, minutes and seconds of their own, or parts of a second beside a stamp."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.channels import Array
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.units import same_dimension

_DATE, _CLOCK, _BELOW = ("year", "month", "day"), ("hour", "minute", "second"), ("ms", "us", "ns")
#: Nanoseconds of each part, and where it ends.
_NANOSECONDS = {"hour": 3600e9, "minute": 60e9, "second": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
_END = {"month": 13.0, "day": 32.0, "hour": 24.0, "minute": 60.0, "second": 60.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
#: Share of the steps that a rule must hold for: a log may have lost some samples.
_MOST = 0.9


def parts_of_time(labels: Sequence[Label], used: Container[int], below: bool = False) -> dict[str, int]:
    """Return part -> column of the time that several columns hold together: hours, minutes, seconds, and what is below.

    Year, month and day are added where all three are there; empty without hours, minutes and seconds, each once.
    `below`: only what stands beside a time of whole seconds: ms, us or ns.
    """
    held: dict[str, int] = {}
    for part, words in WORDS["part"].items():
        columns = [
            column
            for column, label in enumerate(labels)
            if label.name.strip().casefold() in words
            and column not in used
            and (label.unit is None or same_dimension(label.unit, "s"))
        ]
        if len(columns) == 1:
            held[part] = columns[0]
    if not below and not held.keys() >= {*_CLOCK}:
        return {}
    dated = _DATE if held.keys() >= {*_DATE} else ()
    return {part: held[part] for part in (() if below else (*dated, *_CLOCK)) + _BELOW if part in held}


def joined_time(base: NDArray[Any], parts: Mapping[str, Array], unit: str | None) -> NDArray[Any] | None:
    """Return the moments (n,) that a column of dates or of whole seconds and the `parts` (n,) of it make.

    `base`: datetime64, or doubles in `unit`. Where the parts hold hours, only its dates are used. None where the parts
    are none: hours that are no whole numbers, milliseconds since the start beside stamps.
    """
    below = [part for part in _BELOW if part in parts]
    fine = below[-1] if below else "second"
    for part, values in parts.items():
        known = values[np.isfinite(values)]
        end = 1e3 if part in below[1:] else _END.get(part, np.inf)  # microseconds beside milliseconds
        if not known.size or known.min() < 0.0 or known.max() >= end:
            return None
        if part != fine and not np.array_equal(known, np.floor(known)):
            return None
    scaled = [values * _NANOSECONDS[part] for part, values in parts.items() if part in _NANOSECONDS]
    offset = np.sum(scaled, axis=0)
    if "hour" in parts:
        return _dates(base, parts) + _nanoseconds(offset)
    if base.dtype.kind == "M":
        whole = base == base.astype("datetime64[s]").astype(base.dtype)
        known = ~np.isnat(base)
    else:
        whole, known = base == np.floor(base), np.isfinite(base)
    if unit not in (None, "s") or not whole[known].all() or not _falls_back(base[known], offset[known]):
        return None
    return base + _nanoseconds(offset) if base.dtype.kind == "M" else base + offset / 1e9


def _falls_back(base: NDArray[Any], offset: Array) -> bool:
    """Test whether the fraction of a second grows while the second stays, and begins again with the next."""
    steps = np.diff(base) / (np.timedelta64(1, "s") if base.dtype.kind == "M" else 1.0)
    same, next_one, change = steps == 0, steps == 1, np.diff(offset)
    if 2 * np.count_nonzero(same) < steps.size:
        return False
    grows = np.count_nonzero(change[same] > 0) >= _MOST * np.count_nonzero(same)
    return bool(grows and np.count_nonzero(change[next_one] < 0) >= _MOST * np.count_nonzero(next_one))


def _dates(base: NDArray[Any], parts: Mapping[str, Array]) -> NDArray[np.datetime64]:
    """Return the dates (n,) of `base` or of year, month and day; 1970-01-01 where neither holds any."""
    if all(part in parts for part in _DATE):
        year, month, day = (np.nan_to_num(parts[part], nan=1.0) for part in _DATE)
        months = ((np.clip(year, 1.0, 9999.0) - 1970) * 12 + month - 1).astype(np.int64).astype("datetime64[M]")
        dates = months.astype("datetime64[D]") + (day - 1).astype("timedelta64[D]")
        return np.asarray(dates.astype("datetime64[ns]"))
    if base.dtype.kind == "M":
        return base.astype("datetime64[D]").astype("datetime64[ns]")
    return np.full(base.shape, np.datetime64("1970-01-01", "ns"))


def _nanoseconds(offset: Array) -> NDArray[np.timedelta64]:
    result = np.round(np.nan_to_num(offset)).astype("timedelta64[ns]")
    result[~np.isfinite(offset)] = np.timedelta64("NaT")
    return result
