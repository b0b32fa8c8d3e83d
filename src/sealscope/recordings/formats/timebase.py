"""From a time column to seconds and a sampling rate: numbers of any unit, epoch seconds, date stamps."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.units import to_si

_EITHER = r"(?P<first>\d{1,2})(?P<stroke>[/-])(?P<second>\d{1,2})(?P=stroke)(?P<year>\d{4}|\d{2})"
#: How dates are written; what `first` and `second` are follows from all dates of a column (`day_before_month`).
_DATES = (
    r"(?P<year>\d{4})[-/.](?P<month>\d{1,2})[-/.](?P<day>\d{1,2})",
    r"(?P<plain>(?P<year>(?:19|20)\d{2})(?P<month>\d{2})(?P<day>\d{2}))(?=[T\s]|\Z)",
    r"(?P<days>\d{1,5}) days?,?(?=\s)",  # a length of time, as pandas writes it
    r"(?P<year>\d{4})年(?P<month>\d{1,2})月(?P<day>\d{1,2})日",
    r"(?P<day>\d{1,2})\.(?P<month>\d{1,2})\.(?P<year>\d{4}|\d{2})",
    r"(?P<day>\d{1,2})[-. /]{1,2}(?P<month>[^\W\d_]{3,9})[-. /]{1,2}(?P<year>\d{4}|\d{2})",
    r"(?P<month>[^\W\d_]{3,9})[. ]{1,2}(?P<day>\d{1,2}),? (?P<year>\d{4})",
    _EITHER,
    "",
)
_EITHER_DATE = re.compile(rf"\s*(?P<date>{_EITHER})")
_LAST_MONTH = 12
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


@dataclass
class LogTime:
    """The time of a log, known from the parts read before.

    `head`: their first times, without a unit; `rate`: of the samples [Hz]; `resolution`: of times that these share [s];
    `last`: the last time, as the file has it, and where it is, `end` [s].
    """

    head: Array | None = None
    rate: float | None = None
    resolution: float | None = None
    last: Any = None
    end: float = 0.0


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
    """Test whether `text` is a date stamp or the time of a day that `stamps` can read."""
    return _parsed_stamp(text) is not None


def stamps(cells: Sequence[str], day_first: bool | None = None) -> NDArray[np.datetime64]:
    """Read stamps (ISO, day.month.year, month/day/year) and times of a day as datetime64[ns]; an empty cell is NaT.

    `day_first`: the order of dates such as 05/06/2024 and 05-06-2024, by default what these cells tell
    (`day_before_month`). Raises ValueError with the index of the first cell that is no stamp.
    """
    if day_first is None:
        day_first = day_before_month([either_dates(cells)])
    plain: list[str] = []
    for index, cell in enumerate(cells):
        parts = _parsed_stamp(cell)
        if parts is None:
            if cell.strip():
                raise ValueError(index)
            plain.append("NaT")
            continue
        hour, colon, rest = _clock(parts["clock"] or "00:00").partition(":")
        if half := parts["half"]:  # 12 AM is midnight, 12 PM is noon
            hour = str(int(hour) % 12 + (12 if half[0] in "pP" else 0)) if 1 <= int(hour) <= 12 else "99"
        plain.append(f"{_date_of(parts, day_first)}T{hour:0>2}{colon}{rest}")
    try:
        return np.array(plain, dtype="datetime64[ns]")
    except ValueError:  # the 30th of February
        raise ValueError(next(index for index, text in enumerate(plain) if not _is_moment(text))) from None


def either_dates(cells: Iterable[str]) -> dict[str, None]:
    """Return the dates of stamps that begin with the day or the month, each once, as they follow each other."""
    return {match["date"]: None for cell in cells if (match := _EITHER_DATE.match(cell))}


def stated_order(dates: Iterable[str]) -> bool | None:
    """Test whether the day is before the month in the first unambiguous one of the `either_dates`; None without.

    It has one number over 12.
    """
    over = ((first > _LAST_MONTH, second > _LAST_MONTH) for first, second, _ in map(_numbers, dates))
    return next((first for first, second in over if first != second), None)


def day_before_month(columns: Collection[Iterable[str]]) -> bool:
    """Decide whether the day stands before the month in the `either_dates` of columns that follow one rule.

    By their `stated_order`; else in the order in which no column goes back; else in which they span less time; else
    before a hyphen and not before a stroke.
    """
    stated = next((order for order in map(stated_order, columns) if order is not None), None)
    if stated is not None:
        return stated
    hyphen = any("-" in text for column in columns for text in column)
    ranks = {}
    for day_first in (hyphen, not hyphen):
        days = [[_day(text, day_first) for text in column] for column in columns]
        ends = [day for dates in days for day in dates if day]
        ranks[day_first] = any(dates != sorted(dates) for dates in days), max(ends, default=0) - min(ends, default=0)
    return min(ranks, key=ranks.__getitem__)


def _day(either: str, day_first: bool) -> int:
    """Return the number of a day, 0 for one that no calendar has."""
    first, second, year = _numbers(either)
    try:
        return date(year, *((second, first) if day_first else (first, second))).toordinal()
    except ValueError:
        return 0


def _numbers(either: str) -> tuple[int, int, int]:
    first, second, year = re.split("[/-]", either)
    return int(first), int(second), int(year) + (2000 if len(year) == 2 else 0)


def _is_moment(text: str) -> bool:
    try:
        np.datetime64(text, "ns")
    except ValueError:
        return False
    return True


def counts_from_1970(clock: float) -> bool:
    """Test whether a clock [s] counts from 1970, and not from the start of a machine."""
    return _EARLIEST_EPOCH < clock < _LATEST_EPOCH


def iso_moment(moment: np.datetime64) -> str:
    """Format a moment as an ISO stamp, without trailing zeros: `2024-05-31T12:00:00.25`."""
    text = str(moment)
    return text.rstrip("0").rstrip(".") if "." in text else text


def clock_text(clock: float) -> str:
    """Format a clock [s]: the date and time of the day in UTC if it counts from 1970, else seconds."""
    if not counts_from_1970(clock):
        return f"{clock:.0f} s"
    return str(np.datetime64(round(clock), "s")).replace("T", " ") + " UTC"


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
    if "first" in parts:
        month, day = (parts["first"], parts["second"])[:: -1 if day_first else 1]
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
    """Test whether every time (n,) is before the one above it, as in logs that begin with the last sample."""
    return len(times) > 1 and bool(np.all(times[1:] < times[:-1]))


def _from_stamps(values: NDArray[np.datetime64], name: str, log: LogTime) -> _Seconds:
    nanoseconds = values.astype("datetime64[ns]")
    known = ~np.isnat(nanoseconds)
    if not known.any():
        raise InputError("time must have a stamp in some row, got none")
    undated = bool((nanoseconds[known] < np.datetime64(_NO_DATE, "ns") + np.timedelta64(1, "D")).all())
    goes_on = undated and log.last is not None
    if goes_on:
        nanoseconds, known = np.append(log.last, nanoseconds), np.append(True, known)
    start = nanoseconds[known][0]
    t = (nanoseconds - start).astype(np.int64).astype(np.float64) / 1e9
    t[~known] = np.nan
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
        if (wrapped := _unwrapped(t, step, once=not undated)) is not None:
            t = wrapped
            notes.append(f"column {name} {what}")
    return t[1:] + log.end if goes_on else t, {} if undated else {"start": iso_moment(start)}, notes


def _unwrapped(t: Array, step: float, once: bool) -> Array | None:
    """Return times (n,) without jumps by `step` [s], to a few usual intervals; None without, or if not just `once`."""
    steps = np.diff(t)
    forward = steps[np.isfinite(steps) & (steps > 0)]
    if not forward.size:
        return None
    usual = float(np.median(forward))
    jumps = np.flatnonzero(np.abs(steps - step - usual) <= _NEAR * usual)
    if not jumps.size or (once and jumps.size > 1) or usual * _NEAR >= 0.1 * abs(step):
        return None
    return t - step * np.searchsorted(jumps + 1, np.arange(t.size), side="right")


def _from_numbers(values: Array, unit: str | None, name: str, log: LogTime) -> _Seconds:
    """Read numbers in a unit, or without: seconds, a time since 1970 in the unit that their size tells, or days."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        raise InputError("time must have a number in some row, got none")
    first = float(finite[0])
    if unit is None:
        return _without_unit(values, finite, name, log)
    if since := _SINCE.fullmatch(unit.strip()):
        word = _LONG_UNITS.get(since["unit"].lower(), since["unit"].lower())
        seconds = to_si(values - first, word, "s", name="time")
        try:
            elapsed = np.timedelta64(round(to_si(first, word, "s") * 1e9), "ns")
            return seconds, {"start": iso_moment(stamps([since["start"]])[0] + elapsed)}, []
        except (ValueError, OverflowError):
            return seconds, {"start": f"{first:g} {unit}"}, []
    seconds = to_si(values, unit, "s", name="time")
    begin = float(seconds[np.isfinite(values)][0])
    if begin >= _EARLIEST_EPOCH:
        return to_si(values - first, unit, "s"), {"start_epoch_s": begin}, []
    return seconds, {}, []


def _without_unit(values: Array, finite: Array, name: str, log: LogTime) -> _Seconds:
    first, begins = float(finite[0]), log.head is None
    log.head = head = finite if log.head is None else log.head
    if (days := _days_since(head)) is not None:
        origin, note = days[0], f"column {name} read as {days[1]}"
        if origin is None:  # it has no start, and goes on
            return (values - (first if log.last is None else log.last)) * _DAY + log.end, {}, [note]
        begin = {"start": iso_moment(origin + np.timedelta64(round(first * _DAY * 1e6), "us"))}
        return (values - first) * _DAY, begin, [note]
    counted = begins and finite.size == values.size and np.all(np.diff(finite) == 1)
    if counted and abs(first) < _EARLIEST_EPOCH:
        raise InputError(
            f"time must be in seconds, got a count of rows {first:g}, {first + 1:g}, ... in column {name}: "
            f"give the rate, or the unit of its column (t={name} ms)"
        )
    unit = next((unit for least, unit in _EPOCH if abs(head[0]) >= least), None)
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
    values: NDArray[Any], unit: str | None, name: str, stated_rate: float | None = None, log: LogTime | None = None
) -> tuple[Array, float, dict[str, Any], list[str]]:
    """Convert a time column's `values` (n,), numbers in `unit` or datetime64, to seconds and a rate.

    Returns the times (n,) [s], the rate [Hz], what is known of the moment 0, and lines for the history. Stamps and
    epoch times are based at their first sample; other times are left where they are. The `stated_rate` of a file [Hz]
    places samples that share their stamps. The values may go on from those of `log`, which then has theirs, too. Raises
    InputError.
    """
    log = LogTime() if log is None else log
    if values.dtype.kind == "M":
        t, start, notes = _from_stamps(values, name, log)
    else:
        t, start, notes = _from_numbers(np.asarray(values, dtype=np.float64), unit, name, log)
    known = np.flatnonzero(np.isfinite(t))
    if known.size:
        log.last, log.end = values[known[-1]], float(t[known[-1]])
    with np.errstate(invalid="ignore", over="ignore"):  # infinite times are findings, not warnings
        if stated_rate is not None and t.size > 1 and 2 * np.count_nonzero(np.diff(t)) < t.size - 1:
            notes.append(f"column {name}: samples share their stamps, taken at {stated_rate:g} Hz, as the file says")
            return t[0] + np.arange(t.size) / stated_rate, stated_rate, start, notes
        resolved = _finer(t, log)
        if resolved is not None:
            log.resolution, t = resolved
            notes.append(f"column {name} in steps of {log.resolution:g} s: samples in between taken as uniform")
        log.rate = nominal_rate(t) if log.rate is None else log.rate
        return t, log.rate, start, notes


def _finer(t: Array, log: LogTime) -> tuple[float, Array] | None:
    """Return the resolution [s] of times (n,) that samples share as their distances ask for, and uniform times.

    A part too short to tell, and without a gap, is taken as those before it.
    """
    steps = np.diff(t)
    changes = np.flatnonzero(steps)
    if not np.isfinite(t).all() or (steps < 0).any():
        return None
    if t.size >= _FEWEST_SHARED and changes.size >= 3:
        if 2 * changes.size > steps.size:
            return None
        resolution = float(steps[changes].min())
        many = np.round(steps[changes][1:] / resolution)
        counts, usual = np.diff(changes) / many, float(np.diff(changes).sum() / many.sum())
        if usual < 2.0 or np.abs(counts - usual).max() > 1.0:
            return None
        rate = _shortest(usual / resolution, 1.0 / float(np.diff(changes).sum()))
    elif log.resolution is not None and log.rate is not None and steps.max(initial=0.0) < 1.5 * log.resolution:
        resolution, rate = log.resolution, log.rate
    else:
        return None
    # a stamp says when its first sample was taken, to a sample
    begin = float(np.median(t[changes + 1] - (changes + 1) / rate)) if changes.size else float(t[0])
    return resolution, begin + np.arange(t.size) / rate
