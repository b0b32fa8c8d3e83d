"""From a time column to seconds and a sampling rate: numbers of any unit, epoch seconds, date stamps."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.units import to_si

#: How dates are written; what `first` and `second` are follows from all stamps of a column.
_DATES = (
    r"(?P<year>\d{4})[-/.](?P<month>\d{1,2})[-/.](?P<day>\d{1,2})",
    r"(?P<plain>(?P<year>(?:19|20)\d{2})(?P<month>\d{2})(?P<day>\d{2}))(?=[T\s]|\Z)",
    r"(?P<days>\d{1,5}) days?,?(?=\s)",  # a length of time, as pandas writes it
    r"(?P<year>\d{4})年(?P<month>\d{1,2})月(?P<day>\d{1,2})日",
    r"(?P<day>\d{1,2})\.(?P<month>\d{1,2})\.(?P<year>\d{4}|\d{2})",
    r"(?P<day>\d{1,2})[-. /]{1,2}(?P<month>[^\W\d_]{3,9})[-. /]{1,2}(?P<year>\d{4}|\d{2})",
    r"(?P<month>[^\W\d_]{3,9})[. ]{1,2}(?P<day>\d{1,2}),? (?P<year>\d{4})",
    r"(?P<first>\d{1,2})(?P<stroke>[/-])(?P<second>\d{1,2})(?P=stroke)(?P<year>\d{4}|\d{2})",
    "",
)
#: A number, which is no stamp but a date of eight digits.
_PLAIN = re.compile(r"[+-]?\d*(?:[.,]\d*)?")
_CLOCK = r"\d{1,2}:\d{2}(?::\d{2}(?:[.,:]\d{1,9})?|[.,]\d{1,9})?|\d{6}(?:[.,]\d{1,9})?"
_STAMPS = [
    re.compile(
        rf"{date},?(?:(?:^|[T\s_]|(?<=日))(?:\s*-)?\s*(?P<clock>{_CLOCK})\s?(?P<half>[AaPp]\.?[Mm]\.?)?)?\s*"
        r"(?:Z|UTC|GMT|[+-]\d{2}:?\d{2})?"
    )
    for date in _DATES
]
#: Beginning of a month's name -> its number.
_MONTHS = {beginning: number for number, names in WORDS["month"].items() for beginning in names}
_LONGEST_STAMP = 64
_SINCE = re.compile(r"(?P<unit>[a-z]{1,20})\s{1,9}since\s{1,9}(?P<start>.{1,64})", re.IGNORECASE)
_LONG_UNITS = {"milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns", "days": "day", "day": "day"}
#: Numbers from here on, without a unit, are read as the time since 1970 in this unit.
_EPOCH = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"), (1e8, "s"))
#: Fewer samples do not tell how many share a stamp.
_FEWEST_SHARED = 20
#: The date of a time of the day alone.
_NO_DATE = "1970-01-01"
#: A step of one hour to so many usual intervals, between midnight and four, is a change of daylight saving time.
_HOUR, _DAY, _NEAR, _LATEST_CHANGE = 3600.0, 86400.0, 3.0, 4
#: Days since 1899-12-30 from 1982 to 2078, and the largest intervals [day] that are none of seconds.
_EXCEL = (30_000, 65_000)
_LARGEST_STEP, _LARGEST_STEP_OF_DAYS = 2e-6, 1.2e-5
_OFFSET_OF_DATENUM = 693_960
#: Seconds since 1904 begin here, in 2008: those since 1970 would be in 2074.
_SINCE_1904, _FROM_1904_TO_1970 = 3.28e9, 2_082_844_800.0
_EARLIEST_EPOCH, _LATEST_EPOCH = 1e8, 1e11  # [s]: March 1973, and no recording lasts three years; the year 5138
#: Times (n,) [s], what is known of the moment 0, and lines for the history.
_Seconds = tuple[Array, dict[str, Any], list[str]]


def _parsed_stamp(text: str) -> dict[str, str | None] | None:
    """Return the parts of a stamp by the names of their groups; None for any other text."""
    text = text.strip()
    if len(text) > _LONGEST_STAMP or (_PLAIN.fullmatch(text) and len(text) != len("20240531")):
        return None
    match = next(filter(None, (stamp.fullmatch(text) for stamp in _STAMPS)), None)
    if match is None or not (match["clock"] or len(match.groupdict()) > len(("clock", "half"))):
        return None
    parts, month = match.groupdict(), match.groupdict().get("month")
    if match["clock"] and ":" not in match["clock"] and "plain" not in parts:
        return None  # six digits are a clock behind a date of eight alone
    if month and not month.isdecimal():
        name = month.casefold()
        parts["month"] = _MONTHS.get(name[:4], _MONTHS.get(name[:3]))
    return None if month and parts["month"] is None else parts


def is_stamp(text: str) -> bool:
    """Return whether `text` is a date stamp or the time of a day that `stamps` can read."""
    return _parsed_stamp(text) is not None


def stamps(cells: Sequence[str]) -> NDArray[np.datetime64]:
    """Read stamps (ISO, day.month.year, month/day/year) and times of a day as datetime64[ns]; an empty cell is NaT.

    Dates with strokes begin with the month, but where the first number of any of them is over 12; dates with hyphens
    begin with the day, but where the second number is over 12. Raises ValueError with the index of the first cell that
    is no stamp.
    """
    parsed = [_parsed_stamp(cell) for cell in cells]
    day_first = any(int(parts.get("first") or 0) > 12 for parts in parsed if parts is not None)
    plain: list[str] = []
    for index, (cell, parts) in enumerate(zip(cells, parsed, strict=True)):
        if parts is None:
            if cell.strip():
                raise ValueError(index)
            plain.append("NaT")
            continue
        hour, colon, rest = _clock(parts["clock"] or "00:00").partition(":")
        if half := parts["half"]:  # 12 AM is midnight, 12 PM is noon
            hour = str(int(hour) % 12 + (12 if half.lower() == "pm" else 0)) if 1 <= int(hour) <= 12 else "99"
        plain.append(f"{_date_of(parts, day_first)}T{hour:0>2}{colon}{rest}")
    try:
        return np.array(plain, dtype="datetime64[ns]")
    except ValueError:  # the 30th of February
        raise ValueError(next(index for index, text in enumerate(plain) if not _is_moment(text))) from None


def _is_moment(text: str) -> bool:
    try:
        return bool(np.datetime64(text, "ns")) or True
    except ValueError:
        return False


def counts_from_1970(clock: float) -> bool:
    """Return whether a clock [s] is that of a date, as opposed to one that counts from the start of a machine."""
    return _EARLIEST_EPOCH < clock < _LATEST_EPOCH


def seconds_of(stamp: str) -> float | None:
    """Return an ISO stamp as seconds since 1970, to a millisecond; None where it is none."""
    try:
        moment = np.datetime64(stamp, "ms")
    except ValueError:
        return None
    return None if np.isnat(moment) else float(moment.astype(np.int64)) / 1e3


def _clock(text: str) -> str:
    """Return a time of the day as `hour:minute:second.fraction`; `59:59.9` has no hour, `12:00:00:250` four parts."""
    text = text.replace(",", ".")
    if ":" not in text:
        return f"{text[:2]}:{text[2:4]}:{text[4:]}"
    if text.count(":") == 3:
        return ".".join(text.rsplit(":", 1))
    return f"00:{text:0>2}" if text.count(":") == 1 and "." in text else text


def _date_of(parts: Mapping[str, str | None], day_first: bool) -> str:
    """Return the date of a stamp as ISO writes it; 1970-01-01 for the time of a day alone."""
    if days := parts.get("days"):
        return str(np.datetime64(_NO_DATE) + int(days))
    year, month, day = (parts.get(name) for name in ("year", "month", "day"))
    first, second = parts.get("first"), parts.get("second")
    if first and second:
        day_first = day_first or (parts["stroke"] == "-" and int(second) <= 12)
        month, day = (second, first) if day_first else (first, second)
    return f"{'20' if len(year) == 2 else ''}{year}-{month:0>2}-{day:0>2}" if year else _NO_DATE


def nominal_rate(t: Array) -> float:
    """Return the sampling rate [Hz] of time stamps `t` (n,): the shortest decimal that agrees with them.

    From the mean interval where they are uniform, else from the median interval. Raises InputError where no interval is
    positive.
    """
    steps = np.diff(t)
    span = float(t[-1] - t[0])
    if steps.size and np.isfinite(span) and steps.min() > 0:
        mean = span / steps.size
        off_line = float(np.abs(t - t[0] - mean * np.arange(t.size)).max())
        if off_line < 0.6 * mean:
            return _shortest(1.0 / mean, max(1e-9, min(2 * off_line / span, 1e-3)))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    if not steps.size:
        raise InputError("time must increase between some samples")
    return _shortest(1.0 / float(np.median(steps)), 1e-9)


def _shortest(value: float, slack: float) -> float:
    """Return the shortest decimal that agrees with a value to a share of it."""
    decimals = (float(f"{value:.{digits}g}") for digits in range(1, 16))
    return next((decimal for decimal in decimals if abs(decimal / value - 1.0) <= slack), value)


def falling(times: NDArray[Any]) -> bool:
    """Return whether every time (n,) is before the one above it, as in logs that begin with the last sample."""
    return len(times) > 1 and bool(np.all(times[1:] < times[:-1]))


def _from_stamps(values: NDArray[np.datetime64], name: str) -> _Seconds:
    nanoseconds = values.astype("datetime64[ns]")
    known = ~np.isnat(nanoseconds)
    if not known.any():
        raise InputError("time must have a stamp in some row, got none")
    start = nanoseconds[known][0]
    t = (nanoseconds - start).astype(np.int64).astype(np.float64) / 1e9
    t[~known] = np.nan
    undated = bool((nanoseconds[known] < np.datetime64(_NO_DATE, "ns") + np.timedelta64(1, "D")).all())
    hour = int((nanoseconds[known] - nanoseconds[known].astype("datetime64[D]")).min() / np.timedelta64(1, "h"))
    steps = {
        -_DAY: "has no date: begins again with the next day",
        -_HOUR: "has no date: begins again with the next hour",
    }
    if not undated:
        changed = "steps by an hour: taken for daylight saving time, the hour left out"
        steps = dict.fromkeys((-_HOUR, _HOUR), changed) if hour < _LATEST_CHANGE else {}
    notes = []
    for step, what in steps.items():
        if (wrapped := _unwrapped(t, step)) is not None:
            t = wrapped
            notes.append(f"column {name} {what}")
    return t, {} if undated else {"start": str(start)}, notes


def _unwrapped(t: Array, step: float) -> Array | None:
    """Return times (n,) without a single jump by `step` [s], to a few usual intervals; None where there is no such."""
    steps = np.diff(t)
    forward = steps[np.isfinite(steps) & (steps > 0)]
    if not forward.size:
        return None
    usual = float(np.median(forward))
    jumps = np.flatnonzero(np.abs(steps - step - usual) <= _NEAR * usual)
    if len(jumps) != 1 or usual * _NEAR >= 0.1 * abs(step):
        return None
    result = t.copy()
    result[jumps[0] + 1 :] -= step
    return result


def _from_numbers(values: Array, unit: str | None, name: str) -> _Seconds:
    """Read numbers in a unit, or without: seconds, a time since 1970 in the unit that their size tells, or days."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        raise InputError("time must have a number in some row, got none")
    first = float(finite[0])
    if unit is None:
        return _without_unit(values, finite, name)
    if since := _SINCE.fullmatch(unit.strip()):
        word = _LONG_UNITS.get(since["unit"].lower(), since["unit"].lower())
        seconds = to_si(values - first, word, "s", name="time")
        try:
            elapsed = np.timedelta64(round(to_si(first, word, "s") * 1e9), "ns")
            return seconds, {"start": str(stamps([since["start"]])[0] + elapsed)}, []
        except (ValueError, OverflowError):
            return seconds, {"start": f"{first:g} {unit}"}, []
    seconds = to_si(values, unit, "s", name="time")
    begin = float(seconds[np.isfinite(values)][0])
    if begin >= _EARLIEST_EPOCH:
        return to_si(values - first, unit, "s"), {"start_epoch_s": begin}, []
    return seconds, {}, []


def _without_unit(values: Array, finite: Array, name: str) -> _Seconds:
    first = float(finite[0])
    if (days := _days_since(finite)) is not None:
        origin, what = days
        begin = {} if origin is None else {"start": str(origin + np.timedelta64(round(first * _DAY * 1e6), "us"))}
        return (values - first) * _DAY, begin, [f"column {name} read as {what}"]
    if np.all(np.diff(finite) == 1) and finite.size == values.size and abs(first) < _EARLIEST_EPOCH:
        raise InputError(
            f"time must be in seconds, got a count of rows {first:g}, {first + 1:g}, ... in column {name}: "
            f"give the rate, or the unit of its column (t={name} ms)"
        )
    unit = next((unit for least, unit in _EPOCH if abs(first) >= least), None)
    if unit is None:
        return values, {}, [f"column {name} has no unit: taken as s"]
    epoch, year = to_si(first, unit, "s"), 1970
    if _SINCE_1904 <= epoch < _SINCE_1904 + 1e9:
        epoch, year = epoch - _FROM_1904_TO_1970, 1904
    return to_si(values - first, unit, "s"), {"start_epoch_s": epoch}, [f"column {name} read as {unit} since {year}"]


def _days_since(values: Array) -> tuple[np.datetime64 | None, str] | None:
    """Return the origin of numbers that are days, as seconds sampled faster than any logger does; None for seconds."""
    steps = np.diff(values)
    steps = steps[steps > 0]
    if not steps.size:
        return None
    step, first, origin = float(np.median(steps)), float(values[0]), np.datetime64("1899-12-30", "us")
    if step <= _LARGEST_STEP_OF_DAYS:
        if _EXCEL[0] <= first <= _EXCEL[1]:
            return origin, "days since 1899-12-30, as spreadsheets count"
        if _EXCEL[0] <= first - _OFFSET_OF_DATENUM <= _EXCEL[1]:
            return origin - np.timedelta64(_OFFSET_OF_DATENUM, "D"), "days, as MATLAB counts"
    if step <= _LARGEST_STEP and values.min() >= 0.0 and values.max() <= 1.0:
        return None, "a share of the day"
    return None


def time_base(
    values: NDArray[Any], unit: str | None, name: str, stated_rate: float | None = None
) -> tuple[Array, float, dict[str, Any], list[str]]:
    """Convert a time column's `values` (n,), numbers in `unit` or datetime64, to seconds and a rate.

    Returns the times (n,) [s], the rate [Hz], what is known of the moment 0, and lines for the history. Stamps and
    epoch times are based at their first sample; other times are left where they are. The `stated_rate` of a file [Hz]
    places samples that share their stamps. Raises InputError.
    """
    if values.dtype.kind == "M":
        t, start, notes = _from_stamps(values, name)
    else:
        t, start, notes = _from_numbers(np.asarray(values, dtype=np.float64), unit, name)
    with np.errstate(invalid="ignore", over="ignore"):  # infinite times are findings, not warnings
        if stated_rate is not None and t.size > 1 and 2 * np.count_nonzero(np.diff(t)) < t.size - 1:
            notes.append(f"column {name}: samples share their stamps, taken at {stated_rate:g} Hz, as the file says")
            return t[0] + np.arange(t.size) / stated_rate, stated_rate, start, notes
        resolved = _finer(t)
        if resolved is not None:
            resolution, t = resolved
            notes.append(f"column {name} in steps of {resolution:g} s: samples in between taken as uniform")
        return t, nominal_rate(t), start, notes


def _finer(t: Array) -> tuple[float, Array] | None:
    """Return the resolution [s] of times (n,) that samples share as their distances ask for, and uniform times."""
    steps = np.diff(t)
    if t.size < _FEWEST_SHARED or 2 * np.count_nonzero(steps) > steps.size:
        return None
    changes = np.flatnonzero(steps)
    if not np.isfinite(t).all() or (steps < 0).any() or changes.size < 3:
        return None
    resolution = float(steps[changes].min())
    counts = np.diff(changes) / np.round(steps[changes][1:] / resolution)
    usual = float(np.diff(changes).sum() / np.round(steps[changes][1:] / resolution).sum())
    if usual < 2.0 or np.abs(counts - usual).max() > 1.0:
        return None
    rate = _shortest(usual / resolution, 1.0 / float(np.diff(changes).sum()))
    # a stamp says when its first sample was taken, to a sample
    begin = float(np.median(t[changes + 1] - (changes + 1) / rate))
    return resolution, begin + np.arange(t.size) / rate
