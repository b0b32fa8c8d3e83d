"""From a time column to seconds and a sampling rate: numbers of any unit, epoch seconds, date stamps."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.channels import Array
from sealscope.units import to_si

_CLOCK = r"\d{1,2}:\d{2}(?::\d{2}(?:[.,]\d{1,9})?)?"
_STAMP = re.compile(
    rf"(?:(?P<date>\d{{4}}[-/]\d{{2}}[-/]\d{{2}})|(?P<day>\d{{1,2}})\.(?P<month>\d{{1,2}})\.(?P<year>\d{{4}})"
    rf"|(?P<first>\d{{1,2}})/(?P<second>\d{{1,2}})/(?P<year_last>\d{{4}}))?"
    rf"(?:(?:^|[T\s_])\s*(?P<clock>{_CLOCK})\s?(?P<half>[AaPp][Mm])?)?\s*(?P<zone>Z|UTC|[+-]\d{{2}}:?\d{{2}})?"
)
_LONGEST_STAMP = 64
_SINCE = re.compile(r"(?P<unit>[a-z]{1,20})\s{1,9}since\s{1,9}(?P<start>.{1,64})", re.IGNORECASE)
_LONG_UNITS = {"milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns", "days": "day", "day": "day"}
#: Numbers from here on, without a unit, are read as the time since 1970 in this unit.
_EPOCH = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"), (1e8, "s"))
#: Fewer samples do not tell how many share a stamp.
_FEWEST_SHARED = 20
_EARLIEST_EPOCH = 1e8  # [s]: March 1973, and no recording lasts three years


class TimeBase(NamedTuple):
    """`t`: (n,) [s], `rate` [Hz], `start`: what is known of the moment t = 0, `notes`: lines for the history."""

    t: Array
    rate: float
    start: dict[str, Any]
    notes: tuple[str, ...]


def _parsed_stamp(text: str) -> re.Match[str] | None:
    text = text.strip()
    match = _STAMP.fullmatch(text) if len(text) <= _LONGEST_STAMP else None
    return match if match and (match["date"] or match["year"] or match["first"] or match["clock"]) else None


def is_stamp(text: str) -> bool:
    """Return whether `text` is a date stamp or the time of a day that `stamps` can read."""
    return _parsed_stamp(text) is not None


def stamps(cells: Sequence[str]) -> NDArray[np.datetime64]:
    """Read stamps (ISO, day.month.year, month/day/year) and times of a day as datetime64[ns]; an empty cell is NaT.

    Dates with strokes begin with the month, but where the first number of any of them is over 12. Raises ValueError
    with the index of the first cell that is no stamp.
    """
    matches = [_parsed_stamp(cell) for cell in cells]
    day_first = any(match is not None and match["first"] and int(match["first"]) > 12 for match in matches)
    plain: list[str] = []
    for index, (cell, match) in enumerate(zip(cells, matches, strict=True)):
        if match is None:
            if cell.strip():
                raise ValueError(index)
            plain.append("NaT")
            continue
        hour, colon, rest = (match["clock"] or "00:00").replace(",", ".").partition(":")
        if match["half"]:  # 12 AM is midnight, 12 PM is noon
            hour = str(int(hour) % 12 + (12 if match["half"].lower() == "pm" else 0)) if 1 <= int(hour) <= 12 else "99"
        plain.append(f"{_date_of(match, day_first)}T{hour:0>2}{colon}{rest}")
    try:
        return np.array(plain, dtype="datetime64[ns]")
    except ValueError:  # the 30th of February
        for index, cell in enumerate(plain):
            try:
                np.datetime64(cell, "ns")
            except ValueError:
                raise ValueError(index) from None
        raise


def seconds_of(stamp: str) -> float | None:
    """Return an ISO stamp as seconds since 1970, to a millisecond; None where it is none."""
    try:
        moment = np.datetime64(stamp, "ms")
    except ValueError:
        return None
    return None if np.isnat(moment) else float(moment.astype(np.int64)) / 1e3


def _date_of(match: re.Match[str], day_first: bool) -> str:
    """Return the date of a stamp as ISO writes it; 1970-01-01 for the time of a day alone."""
    if match["first"]:
        month, day = (match["second"], match["first"]) if day_first else (match["first"], match["second"])
        return f"{match['year_last']}-{month:0>2}-{day:0>2}"
    if match["year"]:
        return f"{match['year']}-{match['month']:0>2}-{match['day']:0>2}"
    return (match["date"] or "1970-01-01").replace("/", "-")


def nominal_rate(t: Array) -> float:
    """Return the sampling rate [Hz] of time stamps `t` (n,): the shortest decimal that agrees with them.

    From the mean interval where they are uniform, else from the median interval. Raises InputError where no interval is
    positive.
    """
    steps = np.diff(t)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    if not steps.size:
        raise InputError("time must increase between some samples")
    step = float(np.median(steps))
    span = float(t[-1] - t[0])
    slack = 1e-9
    if np.isfinite(span) and steps.size == t.size - 1:
        mean = span / (t.size - 1)
        off_line = float(np.max(np.abs(t - t[0] - mean * np.arange(t.size))))
        if off_line < 0.6 * mean:
            step = mean
            slack = max(slack, min(2 * off_line / span, 1e-3))
    rate = 1.0 / step
    for digits in range(1, 16):
        rounded = float(f"{rate:.{digits}g}")
        if abs(rounded / rate - 1.0) <= slack:
            return rounded
    return rate


def _from_stamps(values: NDArray[np.datetime64]) -> tuple[Array, dict[str, Any]]:
    nanoseconds = values.astype("datetime64[ns]")
    known = ~np.isnat(nanoseconds)
    if not known.any():
        raise InputError("time must have a stamp in some row, got none")
    start = nanoseconds[known][0]
    t = (nanoseconds - start).astype(np.int64).astype(np.float64) / 1e9
    t[~known] = np.nan
    return t, {"start": str(start)}


def _from_numbers(values: Array, unit: str | None, name: str) -> tuple[Array, dict[str, Any], list[str]]:
    finite = values[np.isfinite(values)]
    if not finite.size:
        raise InputError("time must have a number in some row, got none")
    first = float(finite[0])
    since = _SINCE.fullmatch(unit.strip()) if unit else None
    if since:
        word = since["unit"].lower()
        origin = since["start"]
        seconds = to_si(values - first, _LONG_UNITS.get(word, word), "s", name="time")
        try:
            base = stamps([origin])[0]
            begin = base + np.timedelta64(round(to_si(first, _LONG_UNITS.get(word, word), "s") * 1e9), "ns")
        except (ValueError, OverflowError):
            return seconds, {"start": f"{first:g} {unit}"}, []
        return seconds, {"start": str(begin)}, []
    if unit is None:
        size = abs(first)
        if np.all(np.diff(finite) == 1) and finite.size == values.size and size < _EARLIEST_EPOCH:
            raise InputError(
                f"time must be in seconds, got a count of rows {first:g}, {first + 1:g}, ... in column {name}: "
                f"give the rate"
            )
        for least, epoch_unit in _EPOCH:
            if size >= least:
                seconds = to_si(values - first, epoch_unit, "s")
                epoch = to_si(first, epoch_unit, "s")
                return seconds, {"start_epoch_s": epoch}, [f"column {name} read as {epoch_unit} since 1970"]
        return values, {}, [f"column {name} has no unit: taken as s"]
    seconds = to_si(values, unit, "s", name="time")
    first = float(seconds[np.isfinite(values)][0])
    if first >= _EARLIEST_EPOCH:
        return to_si(values - float(finite[0]), unit, "s"), {"start_epoch_s": first}, []
    return seconds, {}, []


def time_base(values: NDArray[Any], unit: str | None, name: str) -> TimeBase:
    """Convert a time column's `values` (n,), numbers in `unit` or datetime64, to seconds and a rate.

    Stamps and epoch times are based at their first sample, whose moment is kept in `start`; other times are left where
    they are. Raises InputError.
    """
    notes: list[str] = []
    if values.dtype.kind == "M":
        t, start = _from_stamps(values)
    else:
        t, start, notes = _from_numbers(np.asarray(values, dtype=np.float64), unit, name)
    with np.errstate(invalid="ignore", over="ignore"):  # infinite times are findings, not warnings
        resolved = _finer(t)
        if resolved is not None:
            resolution, t = resolved
            notes.append(f"column {name} in steps of {resolution:g} s: samples in between taken as uniform")
        return TimeBase(t, nominal_rate(t), start, tuple(notes))


def _finer(t: Array) -> tuple[float, Array] | None:
    """Return the resolution [s] of times (n,) that several samples each share, and uniform times; None for others.

    Every stamp but the first and the last must stand on as many samples, to one, as its distance asks for.
    """
    if t.size < _FEWEST_SHARED or not np.isfinite(t).all():
        return None
    steps = np.diff(t)
    changes = np.flatnonzero(steps)
    if (steps < 0).any() or changes.size < 3 or 2 * changes.size > steps.size:
        return None
    resolution = float(steps[changes].min())
    counts = np.diff(changes) / np.round(steps[changes][1:] / resolution)
    usual = float(np.diff(changes).sum() / np.round(steps[changes][1:] / resolution).sum())
    if usual < 2.0 or np.abs(counts - usual).max() > 1.0:
        return None
    rate = usual / resolution
    for digits in range(1, 16):
        rounded = float(f"{rate:.{digits}g}")
        if abs(rounded / rate - 1.0) <= 1.0 / np.diff(changes).sum():
            rate = rounded
            break
    # a stamp says when its first sample was taken, to a sample
    begin = float(np.median(t[changes + 1] - (changes + 1) / rate))
    return resolution, begin + np.arange(t.size) / rate
