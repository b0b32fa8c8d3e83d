"""Times of a log: those of its samples from a time column, and when it was made.

A stamp is the text of a date, a time of day or both. Hours, minutes and seconds may stand in several columns, or parts
of a second beside a stamp.

When it was made is what the remarks above its samples, or the name of its file, say. Of a date such as 04-03-2026, the
order of day and month is taken from what determines it, and is not guessed.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.channels import Array, iter_stretches, summarize_intervals, take_finite
from sealscope.recordings.formats.headings.labels import WORDS, Label
from sealscope.recordings.formats.headings.preamble import scope_start
from sealscope.recordings.formats.times import row_order
from sealscope.recordings.formats.times.row_order import ClockEvent, OrderedRows, Wrap, order_rows
from sealscope.storage.opening import open_regular
from sealscope.units import same_dimension, to_si

#: Date such as 05/06/2024 or 05-06-24, in which the day or the month comes first.
_EITHER = r"(?P<first>\d{1,2})(?P<stroke>[/-])(?P<second>\d{1,2})(?P=stroke)(?P<year>\d{4}|\d{2})"
#: Forms of dates; whether `first` is the day or the month is decided from a whole column (`is_day_first`).
_DATES = (
    r"(?P<year>\d{4})[-/.](?P<month>\d{1,2})[-/.](?P<day>\d{1,2})",
    r"(?P<plain>(?P<year>(?:19|20)\d{2})(?P<month>\d{2})(?P<day>\d{2}))(?=[T\s]|\Z)",
    r"(?P<days>\d{1,5}) days?,?(?=\s)",  # a duration, as pandas writes it
    r"(?P<year>\d{4})年(?P<month>\d{1,2})月(?P<day>\d{1,2})日",
    r"(?P<day>\d{1,2})\.(?P<month>\d{1,2})\.(?P<year>\d{4}|\d{2})",
    r"(?P<day>\d{1,2})[-. /]{1,2}(?P<month>[^\W\d_]{3,9})[-. /]{1,2}(?P<year>\d{4}|\d{2})",
    r"(?P<month>[^\W\d_]{3,9})[. ]{1,2}(?P<day>\d{1,2}),? (?P<year>\d{4})",
    _EITHER,
    "",
)
_EITHER_DATE = re.compile(rf"\s*(?P<date>{_EITHER})")
_LAST_MONTH = 12
_WRONG_HOUR = 99  # hour of a wrong time on a 12-hour clock, such as 13 PM; numpy refuses it
#: A number, which is a stamp only if it has eight digits.
_BARE_NUMBER = re.compile(r"[+-]?\d*(?:[.,]\d*)?")
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
_MAX_STAMP = 64
_SINCE = re.compile(r"(?P<unit>[a-z]{1,20})\s{1,9}since\s{1,9}(?P<start>.{1,64})", re.IGNORECASE)
_LONG_UNITS = {"milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns", "days": "day", "day": "day"}
#: Smallest number without a unit that is read as the time since 1970, and its unit.
_EPOCH = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"), (1e8, "s"))
_MIN_SHARED = 20  # fewest samples from which the number of samples per stamp is estimated
#: Largest deviation of times from a uniform clock that is rounding, in intervals; limits of a rate's relative error.
_MAX_ROUNDING, _MIN_SLACK, _MAX_SLACK = 0.6, 1e-9, 1e-3
_MAX_RISING = 0.1  # largest number of rising steps over that of falling ones in a log that begins with the last sample
#: The date used for a time of day without a date.
_NO_DATE = "1970-01-01"
_DAY = 86400.0  # [s]
_HOURS_OF_HALF_DAY = 1, 12  # least and largest hour on a clock of 12 hours
_LATEST_CHANGE = 4  # daylight saving time changes before this hour of the day
#: Range of days since 1899-12-30 in the years 1982 to 2077.
_EXCEL_RANGE = (30_000, 65_000)
#: Largest intervals of numbers that count fractions of a day, and days: no logger samples every 2 or 12 us.
_MAX_FRACTION_STEP, _MAX_DAY_STEP = 2e-6, 1.2e-5
_DATENUM_OFFSET = 693_960  # MATLAB's datenum of 1899-12-30
#: Numbers from here on (December 2073 if counted from 1970) are seconds since 1904 (then December 2007).
_SINCE_1904, _FROM_1904_TO_1970 = 3.28e9, 2_082_844_800.0
#: Range of seconds since 1970, from March 1973 to the year 5138; smaller times count from the start of a recording.
_MIN_EPOCH, _MAX_EPOCH = 1e8, 1e11


class _Seconds(NamedTuple):
    """A time column in seconds, in the order of the file."""

    t: Array  # (n,) [s]
    start: dict[str, Any]  # provenance of the start (`start` or `start_epoch_s`), empty if t = 0 has no date
    notes: list[str]  # lines for the history
    wraps: tuple[Wrap, ...]  # steps by which the clock may jump
    reading: float  # reading of the clock at t = 0 [s], NaN if it does not begin anew at a known reading


class TimeBase(NamedTuple):
    """The sampling times of a log, in the order of time."""

    t: Array  # (m,) [s]
    rate: float  # sampling rate [Hz]
    start: dict[str, Any]  # provenance of the start (`start` or `start_epoch_s`), empty if t = 0 has no date
    notes: list[str]  # lines for the history
    rows: NDArray[np.intp] | None  # (m,): index of each row in the log; None if all rows stay where they are
    events: tuple[ClockEvent, ...]  # what was found and done about the order of the rows
    breaks: tuple[int, ...]  # indices in `t` of the rows before which the clock was set or the logger restarted


@dataclass
class TimeState:
    """State of a log's time column between two parts of the log, which are read one after the other."""

    head: Array | None = None  # numbers in the first part, if the column has no unit
    rate: float | None = None  # sampling rate [Hz]
    resolution: float | None = None  # step [s] of coarse times that several samples share
    last_time: Any = None  # last known time, as in the file
    last_seconds: float = 0.0  # the same time in seconds


def _parse_stamp(text: str) -> dict[str, str | None] | None:
    """Split a date stamp or time of day into its parts, name -> text or None; None for any other text.

    The names are those of the groups in `_DATES` and `_STAMPS`, such as `year`, `clock` (time of day) and `half` (AM or
    PM). A date of eight digits has the additional part `plain`.
    """
    text = text.strip()
    if len(text) > _MAX_STAMP or (_BARE_NUMBER.fullmatch(text) and len(text) != len("20240531")):
        return None  # too long, or a bare number that is no date of eight digits
    match = next(filter(None, (stamp.fullmatch(text) for stamp in _STAMPS)), None)
    if match is None:
        return None
    parts, month = match.groupdict(), match.groupdict().get("month")
    has_date = bool(parts.keys() - {"clock", "half"})  # the form has further groups, which are those of a date
    if not (parts["clock"] or has_date):
        return None
    if parts["clock"] and ":" not in parts["clock"] and "plain" not in parts:
        return None  # six digits are a time of day only after a date of eight digits
    if month and not month.isdecimal():
        name = month.casefold()
        parts["month"] = _MONTHS.get(name[:4], _MONTHS.get(name[:3]))  # beginnings have 4 or 3 letters
    return None if month and parts["month"] is None else parts


def is_stamp(text: str) -> bool:
    """Test whether `text` is a date stamp or time of day that `parse_stamps` can read."""
    return _parse_stamp(text) is not None


def parse_stamps(cells: Sequence[str], day_first: bool | None = None) -> NDArray[np.datetime64]:
    """Parse stamps (ISO, day.month.year, month/day/year) and times of day to datetime64[ns], NaT for empty cells.

    `day_first`: True if the day precedes the month in dates such as 05/06/2024 and 05-06-2024; by default decided from
    these cells (`is_day_first`). Raises ValueError with the index of the first cell that is not a stamp.
    """
    if day_first is None:
        day_first = is_day_first([ambiguous_dates(cells)])
    iso_stamps: list[str] = []
    for index, cell in enumerate(cells):
        parts = _parse_stamp(cell)
        if parts is None:
            if cell.strip():
                raise ValueError(index)
            iso_stamps.append("NaT")
            continue
        hour, colon, minutes = _format_clock(parts["clock"] or "00:00").partition(":")
        if half := parts["half"]:  # AM or PM; 12 AM is midnight, 12 PM is noon
            afternoon = 12 if half[0] in "pP" else 0
            hour = str(int(hour) % 12 + afternoon if 1 <= int(hour) <= 12 else _WRONG_HOUR)
        iso_stamps.append(f"{_iso_date(parts, day_first)}T{hour:0>2}{colon}{minutes}")
    try:
        return np.array(iso_stamps, dtype="datetime64[ns]")
    except ValueError:  # such as the 30th of February
        raise ValueError([text == "NaT" or parse_epoch(text) is not None for text in iso_stamps].index(False)) from None


def ambiguous_dates(cells: Iterable[str]) -> dict[str, None]:
    """Collect the dates like 05/06/2024 or 05-06-24 at the beginnings of `cells`, in order and each once, as keys."""
    return {match["date"]: None for cell in cells if (match := _EITHER_DATE.match(cell))}


def explicit_order(dates: Iterable[str]) -> bool | None:
    """Decide from dates such as 31/12/2024 if the day comes first; None if none has exactly one number over 12."""
    over_12 = ((first > _LAST_MONTH, second > _LAST_MONTH) for first, second, _ in map(_date_numbers, dates))
    return next((is_first_over for is_first_over, is_second_over in over_12 if is_first_over != is_second_over), None)


def is_day_first(columns: Collection[Iterable[str]]) -> bool:
    """Decide if the day precedes the month in dates such as 05/06/2024, the `ambiguous_dates` of similar columns.

    These criteria are applied in turn until one decides:

    - A date has a number over 12 (`explicit_order`).
    - No column goes back in time with one order, but some column does with the other.
    - The dates span a shorter time with one order than with the other.
    - The day comes first in dates with hyphens, the month in dates with slashes.
    """
    known_order = next((order for order in map(explicit_order, columns) if order is not None), None)
    if known_order is not None:
        return known_order
    has_hyphens = any("-" in text for column in columns for text in column)
    ranks = {}
    for day_first in (has_hyphens, not has_hyphens):
        days = [[_ordinal_day(text, day_first) for text in column] for column in columns]
        known_days = [day for dates in days for day in dates if day]
        goes_back = any(dates != sorted(dates) for dates in days)
        ranks[day_first] = goes_back, max(known_days, default=0) - min(known_days, default=0)
    return min(ranks, key=ranks.__getitem__)  # if both ranks are equal, the first order


def _ordinal_day(text: str, day_first: bool) -> int:
    """Compute the day number (`date.toordinal`) of a date such as 05/06/2024; 0 if there is no such day."""
    first, second, year = _date_numbers(text)
    try:
        return date(year, *((second, first) if day_first else (first, second))).toordinal()
    except ValueError:
        return 0


def _date_numbers(text: str) -> tuple[int, int, int]:
    """Split a date such as 05/06/2024 into its first number, its second number and its year."""
    first, second, year = re.split("[/-]", text)
    return int(first), int(second), int(year) + (2000 if len(year) == 2 else 0)


def counts_from_1970(clock: float) -> bool:
    """Test whether a clock reading [s] counts from 1970, i.e. would then be a time from March 1973 to the year 5138."""
    return _MIN_EPOCH < clock < _MAX_EPOCH


def iso_moment(moment: np.datetime64) -> str:
    """Format a time stamp in ISO form without trailing zeros, such as `2024-05-31T12:00:00.25`."""
    text = str(moment)
    return text.rstrip("0").rstrip(".") if "." in text else text


def clock_text(clock: float) -> str:
    """Format a clock reading [s] as date and time in UTC if it counts from 1970, else as seconds."""
    if not counts_from_1970(clock):
        return f"{clock:.0f} s"
    return str(np.datetime64(round(clock), "s")).replace("T", " ") + " UTC"


def parse_epoch(stamp: str) -> float | None:
    """Parse an ISO date and time to seconds since 1970, to a millisecond; None for any other text.

    A stamp without an offset such as `Z` or `+02:00` is taken as UTC.
    """
    try:
        moment = datetime.fromisoformat(stamp)
    except ValueError:
        return None
    moment = moment.replace(tzinfo=moment.tzinfo or UTC, microsecond=moment.microsecond // 1000 * 1000)
    return moment.timestamp()


def _format_clock(text: str) -> str:
    """Rewrite times of day such as `120000`, `59:59.9` and `12:00:00:250` as `hour:minute:second.fraction`."""
    text = text.replace(",", ".")
    if ":" not in text:
        return f"{text[:2]}:{text[2:4]}:{text[4:]}"
    if text.count(":") == 3:
        return ".".join(text.rsplit(":", 1))
    if text.count(":") == 1 and "." in text:  # minutes and seconds
        minute, _, second = text.partition(":")
        return f"00:{minute:0>2}:{second}"
    return text


def _iso_date(parts: Mapping[str, str | None], day_first: bool) -> str:
    """Format the date in the `parts` of a time stamp in ISO form, or 1970-01-01 if they contain no date."""
    if days := parts.get("days"):  # a duration
        return str(np.datetime64(_NO_DATE) + int(days))
    year, month, day = (parts.get(name) for name in ("year", "month", "day"))
    if "first" in parts:
        first, second = parts["first"], parts["second"]
        month, day = (second, first) if day_first else (first, second)
    return f"{'20' if len(year) == 2 else ''}{year}-{month:0>2}-{day:0>2}" if year else _NO_DATE


def timedelta_seconds(times: Any) -> Array:
    """Convert timedelta64 values of any shape to seconds, NaT to NaN."""
    return np.asarray(times / np.timedelta64(1, "ns"), dtype=np.float64) / 1e9


def nominal_rate(t: Array) -> float:
    """Estimate the nominal sampling rate [Hz] of times `t` (n,) [s].

    It is the decimal number with the fewest digits that agrees with the reciprocal of the mean interval, to within the
    rounding of the times. For times that do not increase throughout or are uneven (`_MAX_ROUNDING`), the median of the
    positive intervals is used instead. Raises InputError if no interval is positive.
    """
    intervals = summarize_intervals(t)
    span = float(t[-1] - t[0])
    if intervals.number and np.isfinite(span) and intervals.shortest > 0:
        mean = span / intervals.number
        max_deviation = max(
            float(np.abs(t[part] - t[0] - mean * np.arange(part.start, part.stop)).max())
            for part in iter_stretches(t.size)
        )
        if max_deviation < _MAX_ROUNDING * mean:  # by rounding, which may shift both ends of the span
            return _shortest_decimal(1.0 / mean, max(_MIN_SLACK, min(2 * max_deviation / span, _MAX_SLACK)))
    steps = np.diff(t)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    if not steps.size:
        raise InputError("time must increase between some samples")
    return _shortest_decimal(1.0 / float(np.median(steps)), _MIN_SLACK)


def interpolate_samples(t: Array, times: Array, values: Array, max_interval: float) -> Array:
    """Interpolate `values` (m,) at increasing `times` (m,) [s] linearly to the times `t` (n,) [s].

    The result is NaN beyond the ends, within intervals over `max_interval` median intervals, and for under two samples.
    """
    if times.size < 2:
        return np.full(t.size, np.nan)
    result, intervals = np.interp(t, times, values, left=np.nan, right=np.nan), np.diff(times)
    next_sample = np.clip(np.searchsorted(times, t), 1, times.size - 1)
    is_long = intervals > max_interval * float(np.median(intervals))
    # within a long interval, but not at the samples that bound it
    result[is_long[next_sample - 1] & (t > times[next_sample - 1]) & (t < times[next_sample])] = np.nan
    return result


def _shortest_decimal(value: float, slack: float) -> float:
    """Find the decimal number with the fewest digits that differs from `value` by at most the fraction `slack`."""
    decimals = (float(f"{value:.{digits}g}") for digits in range(1, 16))
    return next((decimal for decimal in decimals if abs(decimal / value - 1.0) <= slack), value)


def is_falling(times: NDArray[Any]) -> bool:
    """Test whether times (n,) decrease from sample to sample, as in logs that begin with the last sample.

    Neighbours may share a time, and a tenth of the steps may be those of a clock that begins anew.
    """
    n_falling, n_rising = np.count_nonzero(times[1:] < times[:-1]), np.count_nonzero(times[1:] > times[:-1])
    return bool(n_falling > 0 and n_rising <= _MAX_RISING * n_falling)


def _convert_stamps(values: NDArray[np.datetime64]) -> _Seconds:
    """Convert date stamps (n,) of a time column to seconds from the first one; raise InputError if all are missing.

    Times of day without a date may begin again at the full hour, after half a day or after a day. Dated stamps may step
    by an hour, as to daylight saving time, if one of them is before 4 o'clock; their date may be late or early, and
    their hours those of a clock without AM and PM.
    """
    nanoseconds = values.astype("datetime64[ns]")
    known = ~np.isnat(nanoseconds)
    if not known.any():
        raise InputError("time must have a stamp in some row, got none")
    stamps = nanoseconds[known]
    start = stamps[0]
    is_undated = bool((stamps < np.datetime64(_NO_DATE, "ns") + np.timedelta64(1, "D")).all())
    times_of_day = stamps - stamps.astype("datetime64[D]")
    hours = times_of_day // np.timedelta64(1, "h")
    least, largest = _HOURS_OF_HALF_DAY
    wraps: tuple[Wrap, ...] = (row_order.NEXT_DAY, row_order.NEXT_HOUR) if is_undated else (row_order.LATE_DATE,)
    if least <= hours.min() and hours.max() <= largest:
        wraps += (row_order.HALF_DAY,)
        is_midnight = (hours[1:] == largest) & (hours[:-1] == largest - 1) & (np.diff(stamps) > np.timedelta64(1, "D"))
        wraps += (row_order.HALF_DAY_MIDNIGHT,) if is_midnight.any() else ()
    if hours.min() < _LATEST_CHANGE and not is_undated:
        wraps += row_order.SUMMER_TIME
    t = timedelta_seconds(nanoseconds - start)
    if not is_undated:
        return _Seconds(t, {"start": iso_moment(start)}, [], wraps, np.nan)
    return _Seconds(t, {}, [], wraps, float(times_of_day[0] / np.timedelta64(1, "ns")) / 1e9)


def _convert_numbers(values: Array, unit: str | None, name: str, state: TimeState) -> _Seconds:
    """Convert a time column of numbers (n,) to seconds, those with an origin or since 1970 relative to the first.

    `unit`: may state an origin, as in `days since 1899-12-30`; None if it is to be guessed from the numbers of the
    log's first part, which `state` keeps. Raises InputError if no number is finite.
    """
    finite = take_finite(values)
    if not finite.size:
        raise InputError("time must have a number in some row, got none")
    first = float(finite[0])
    if unit is None:
        return _convert_without_unit(values, finite, name, state)
    if since := _SINCE.fullmatch(unit.strip()):
        unit_of_time = _LONG_UNITS.get(since["unit"].lower(), since["unit"].lower())
        seconds = to_si(values - first, unit_of_time, "s", name="time")
        try:
            elapsed = np.timedelta64(round(to_si(first, unit_of_time, "s") * 1e9), "ns")
            start = iso_moment(parse_stamps([since["start"]])[0] + elapsed)
        except (ValueError, OverflowError):  # no date in a known form, or one too far: stated as written
            start = f"{first:g} {unit}"
        return _Seconds(seconds, {"start": start}, [], (), np.nan)
    seconds = to_si(values, unit, "s", name="time")
    epoch = float(seconds[np.argmax(np.isfinite(values))])
    if epoch >= _MIN_EPOCH:
        # the difference is taken before the conversion, which would round such large times
        return _Seconds(to_si(values - first, unit, "s"), {"start_epoch_s": epoch}, [], (), np.nan)
    return _Seconds(seconds, {}, [], row_order.COUNTERS, 0.0)


def _convert_without_unit(values: Array, finite: Array, name: str, state: TimeState) -> _Seconds:
    """Convert a time column of numbers (n,) without a unit to seconds; `finite` (m,) are the finite ones of `values`.

    A long log is read in parts. The finite values of the first part, which `state` keeps, tell for all parts whether
    the numbers are days or seconds, and from which date they count. Raises InputError if the numbers only count rows.
    """
    first = float(finite[0])
    is_first_part = state.head is None
    head = finite if state.head is None else state.head
    state.head = head
    if (days := _detect_days(head)) is not None:
        origin, meaning = days
        note = f"column {name} read as {meaning}"
        if origin is None:  # fractions of a day have no start date
            return _Seconds((values - first) * _DAY, {}, [note], (row_order.NEXT_DAY,), first * _DAY)
        start = {"start": iso_moment(origin + np.timedelta64(round(first * _DAY * 1e6), "us"))}
        return _Seconds((values - first) * _DAY, start, [note], (row_order.LATE_DATE,), np.nan)
    is_row_count = is_first_part and finite.size == values.size and np.all(np.diff(finite) == 1)
    if is_row_count and abs(first) < _MIN_EPOCH:  # larger ones may be seconds since 1970, at 1 Hz
        raise InputError(
            f"time must be in seconds, got a count of rows {first:g}, {first + 1:g}, ... in column {name}: "
            f"give the rate, or the unit of its column (t={name} ms)"
        )
    unit = next((unit for min_value, unit in _EPOCH if abs(head[0]) >= min_value), None)
    if unit is None:
        return _Seconds(values, {}, [f"column {name} has no unit: taken as s"], row_order.COUNTERS, 0.0)
    epoch, year = to_si(first, unit, "s"), 1970
    if _SINCE_1904 <= epoch < _SINCE_1904 + 1e9:  # until 2039
        epoch, year = epoch - _FROM_1904_TO_1970, 1904
    note = f"column {name} read as {unit} since {year}"
    return _Seconds(to_si(values - first, unit, "s"), {"start_epoch_s": epoch}, [note], (), np.nan)


def _detect_days(values: Array) -> tuple[np.datetime64 | None, str] | None:
    """Find the meaning of numbers (n,) in a time column without a unit if they count days; None if they do not.

    Their steps, taken as seconds, must be shorter than those of any logger, and the first number must be a date from
    1982 to 2077 in the count of spreadsheets or of MATLAB. With such steps, numbers between 0 and 1 are fractions of a
    day. Returns (date of day 0, or None for fractions; meaning in words).
    """
    steps = np.diff(values)
    steps = steps[steps > 0]
    if not steps.size:
        return None
    step, first = float(np.median(steps)), float(values[0])
    origin = np.datetime64("1899-12-30", "us")
    if step <= _MAX_DAY_STEP:
        if _EXCEL_RANGE[0] <= first <= _EXCEL_RANGE[1]:
            return origin, "days since 1899-12-30, as spreadsheets count"
        if _EXCEL_RANGE[0] <= first - _DATENUM_OFFSET <= _EXCEL_RANGE[1]:
            return origin - np.timedelta64(_DATENUM_OFFSET, "D"), "days, as MATLAB counts"
    if step <= _MAX_FRACTION_STEP and values.min() >= 0.0 and values.max() <= 1.0:
        return None, "fractions of a day"
    return None


def time_base(
    values: NDArray[Any],
    unit: str | None,
    name: str,
    stated_rate: float | None = None,
    state: TimeState | None = None,
    channels: Sequence[Array] = (),
) -> TimeBase:
    """Convert the values (n,) of a time column, numbers in `unit` or datetime64, to seconds in the order of time.

    Stamps, and numbers that count from a date, become relative to their first sample; other times stay as they are,
    unless the clock wraps or begins anew (`order_rows`).

    - `name`: the column in messages.
    - `stated_rate` [Hz]: rate in the file, with which samples that share stamps are spaced.
    - `state`: state of the column after the previous part of the log, which is updated; None for a log read as a whole.
    - `channels`: samples (n,) of the channels, by which copies of rows and restarts of the logger are found.

    Raises InputError for a column that is empty, counts rows, does not increase or has no unit of time.
    """
    state = TimeState() if state is None else state
    notes: list[str] = []
    with np.errstate(invalid="ignore", over="ignore"):  # infinite times are findings, not warnings
        seconds = _convert_times(values, unit, name, state)
        notes += seconds.notes
        continues = state.last_time is not None and not seconds.start
        if continues:  # prefix the last time of the previous part of the log
            seconds = _convert_times(np.append(state.last_time, values), unit, name, state)
            channels = [np.append(np.nan, samples) for samples in channels]

        def space(t: Array) -> Array:
            """Space the times of samples that share each reading of a coarse clock."""
            if (spaced := _space_shared_times(t, state)) is None:
                return t
            state.resolution, t = spaced
            note = f"column {name} in steps of {state.resolution:g} s: samples in between taken as uniform"
            notes.extend([note] if note not in notes else [])
            return t

        intervals = summarize_intervals(seconds.t)
        shares_stamps = 2 * intervals.n_changes < intervals.number
        has_stated_rate = stated_rate is not None and shares_stamps
        ordered = order_rows(
            seconds.t, channels, seconds.wraps, seconds.reading, None if has_stated_rate or continues else space
        )
        ordered = _continue_times(ordered, state.last_seconds) if continues else ordered
        t = ordered.t
        is_known = np.isfinite(t)
        if is_known.any():
            last = t.size - 1 - int(np.argmax(is_known[::-1]))
            state.last_time = values[last if ordered.rows is None else ordered.rows[last]]
            state.last_seconds = float(t[last])
        t = t if ordered.breaks or has_stated_rate else space(t)
        notes += [f"column {name} {event.text}" for event in ordered.events]
        if has_stated_rate:
            assert stated_rate is not None
            notes.append(f"column {name}: samples share their stamps, taken at {stated_rate:g} Hz, as the file says")
            t, rate = t[0] + np.arange(t.size) / stated_rate, stated_rate
        else:
            longest_part = max(np.split(t, ordered.breaks), key=len)
            state.rate = nominal_rate(longest_part) if state.rate is None else state.rate
            rate = state.rate
        return TimeBase(t, rate, seconds.start, notes, ordered.rows, ordered.events, ordered.breaks)


def _convert_times(values: NDArray[Any], unit: str | None, name: str, state: TimeState) -> _Seconds:
    """Convert a time column, numbers in `unit` or datetime64 (n,), to seconds."""
    if values.dtype.kind == "M":
        return _convert_stamps(values)
    return _convert_numbers(np.asarray(values, dtype=np.float64), unit, name, state)


def _continue_times(ordered: OrderedRows, last_seconds: float) -> OrderedRows:
    """Remove the first row, which ends the previous part of a log at `last_seconds` [s], and count on from there."""
    if ordered.rows is None:
        t, rows, place = ordered.t[1:], None, 0
    else:
        place = int(np.flatnonzero(ordered.rows == 0)[0])
        t, rows = np.delete(ordered.t, place), np.delete(ordered.rows, place) - 1
    shift = last_seconds - float(ordered.t[place])
    breaks = tuple(row - (row > place) for row in ordered.breaks if row > place + 1)
    events = tuple(event._replace(row=max(0, event.row - 1)) for event in ordered.events)
    return OrderedRows(t + shift if shift else t, rows, breaks, events)


def _space_shared_times(t: Array, state: TimeState) -> tuple[float, Array] | None:
    """Replace the times of samples that share each reading of a coarse clock by evenly spaced times.

    Returns (clock step [s], new times (n,)), or None if a time is missing or steps back, if there are fewer than two
    samples per clock step on average, or if a step's number of samples differs from this average by more than one. A
    part of a log too short to show this gets the clock step and the rate of the earlier parts from `state`.
    """
    intervals = summarize_intervals(t)
    can_show = t.size >= _MIN_SHARED and intervals.n_changes >= 3
    if not np.isfinite(t).all() or intervals.shortest < 0 or (can_show and 2 * intervals.n_changes > intervals.number):
        return None
    steps = np.diff(t)
    changes = np.flatnonzero(steps)  # indices of the last samples before the time changes
    if can_show:
        resolution = float(steps[changes].min())
        n_steps = np.round(steps[changes][1:] / resolution)  # of the coarse clock, between changes of the time
        n_samples = np.diff(changes)
        samples_per_step = float(n_samples.sum() / n_steps.sum())
        if samples_per_step < 2.0 or np.abs(n_samples / n_steps - samples_per_step).max() > 1.0:
            return None
        # uncertain by one sample of all
        rate = _shortest_decimal(samples_per_step / resolution, slack=1.0 / float(n_samples.sum()))
    elif state.resolution is not None and state.rate is not None and steps.max(initial=0.0) < 1.5 * state.resolution:
        resolution, rate = state.resolution, state.rate
    else:
        return None
    # a time in the log is that of its first sample, whose index is `changes` + 1, to within one interval
    first_time = float(np.median(t[changes + 1] - (changes + 1) / rate)) if changes.size else float(t[0])
    return resolution, first_time + np.arange(t.size) / rate


_DATE, _HOURS, _SUBSECOND = ("year", "month", "day"), ("hour", "minute", "second"), ("ms", "us", "ns")
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
    if not only_subsecond and not columns_of_part.keys() >= {*_HOURS}:
        return {}
    date_parts = _DATE if columns_of_part.keys() >= {*_DATE} else ()
    parts = _SUBSECOND if only_subsecond else (*date_parts, *_HOURS, *_SUBSECOND)
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


_TIME = (
    r"(?:[-_ T.]?(?P<hour>[01]\d|2[0-3])[-_.h:]?(?P<minute>[0-5]\d)(?:[-_.m:]?(?P<second>[0-5]\d))?)?(?P<half>)(?!\d)"
)
_YEAR_FIRST = re.compile(r"(?<!\d)(?P<year>(?:19|20)\d\d)(?P<mark>[-_.]?)(?P<month>\d\d)(?P=mark)(?P<day>\d\d)" + _TIME)
_YEAR_LAST = r"(?<!\d)(?P<month>\d{1,2})(?P<mark>[-_.])(?P<day>\d{1,2})(?P=mark)(?P<year>(?:19|20)\d\d)"
#: Stamps on a 12-hour clock, which loggers write with the month first.
_TWELVE_HOURS = re.compile(
    r"(?<!\d)(?P<month>\d{1,2})[-_.](?P<day>\d{1,2})[-_.](?P<year>(?:19|20)\d\d)[-_ .]"
    r"(?P<hour>\d{1,2})[-_.:](?P<minute>[0-5]\d)[-_.:](?P<second>[0-5]\d)[-_ ]?(?P<half>[AP])M",
    re.IGNORECASE,
)
_MONTH_FIRST = re.compile(_YEAR_LAST + _TIME)
#: Order of a date -> pattern, in which day and month have changed places if the day is first.
_ORDERS = {"year": _YEAR_FIRST, "month": _MONTH_FIRST, "day": _MONTH_FIRST}
#: Names of a remark with the date, or date and time, of the start: in any language, and in those with the day first.
_START, _DAY_FIRST_START, _CLOCK_REMARK = (
    re.compile(WORDS["stated"][name], re.IGNORECASE) for name in ("start", "day_first_start", "clock")
)
_ONE_DAY = np.timedelta64(1, "D")
_NUMBER = re.compile(r"\d+")
_SLASHED_DATE = re.compile(r"(?<![\d/-])\d{1,2}([/-])\d{1,2}\1(?:\d{4}|\d{2})(?![\d/-])")
#: Most logs beside a log of which the beginnings are read, and bytes of each.
_MAX_FILES, _MAX_BYTES = 64, 2**16


def dates_in_name(name: str) -> dict[str, float]:
    """Parse the date and time in a file's name by each order that makes it a date: order -> seconds since 1970, as UTC.

    The orders are called by what is first: "year", "month" or "day". Empty if the name contains no date.
    """
    if (twelve := _TWELVE_HOURS.search(name)) is not None:
        start = _seconds(twelve.groupdict())
        return {} if start is None else {"month": start}
    starts = {}
    for order, pattern in _ORDERS.items():
        match = pattern.search(name)
        if match is None or (order == "month" and match["mark"] == "."):  # dates with dots begin with the day
            continue
        fields = match.groupdict()
        if order == "day":
            fields["day"], fields["month"] = fields["month"], fields["day"]
        if (start := _seconds(fields)) is not None:
            starts[order] = start
    return starts


def _seconds(fields: Mapping[str, str]) -> float | None:
    """Convert the parts of a date and time, name -> digits, to seconds since 1970; None if there is no such date."""
    hour = int(fields["hour"] or 0)
    if fields["half"]:  # AM or PM: 12 AM is midnight, 12 PM is noon
        hour = hour % 12 + (12 if fields["half"].upper() == "P" else 0)
    return parse_epoch(
        f"{fields['year']}-{int(fields['month']):02d}-{int(fields['day']):02d}"
        f"T{hour:02d}:{fields['minute'] or '00'}:{fields['second'] or '00'}"
    )


def parse_name(name: str, order: str | None = None) -> float | None:
    """Parse the date and time in a file's name to seconds since 1970, as if in UTC.

    `order`: that of the date, if it is known (`find_order`). None if the name contains no date, or an ambiguous one.
    """
    starts = dates_in_name(name)
    if order in starts:
        return starts[order]
    return next(iter(starts.values())) if len({*starts.values()}) == 1 else None


def find_order(path: Path) -> str | None:
    """Find the order of an ambiguous date in a file's name from the names beside it that differ by their numbers alone.

    It is the only order by which all of these names contain a date; None without one, or if the date is not ambiguous.
    """
    starts = dates_in_name(path.name)
    if len({*starts.values()}) < 2:
        return None
    orders = {*starts}
    for other in _iter_files_beside(path):
        orders &= {*dates_in_name(other.name)}
        if len(orders) <= 1:
            break
    return orders.pop() if len(orders) == 1 else None


def _iter_files_beside(path: Path) -> Iterator[Path]:
    """Yield the files in the folder of a file whose names differ from its name by their numbers alone."""
    name = _NUMBER.sub("#", path.name)
    with suppress(OSError):
        yield from (other for other in path.parent.iterdir() if _NUMBER.sub("#", other.name) == name)


def is_day_first_beside(path: Path, date: str) -> bool | None:
    """Find if the day comes first in dates such as 05/06/2024 of a log, by its file's name or the logs beside it.

    The `date` is one of the log, which may be that in the file's name; the logs beside it, of which the beginnings of
    the first `_MAX_FILES` are read, may have dates with a number over 12. None if neither tells.
    """
    if (named_start := parse_name(path.name, find_order(path))) is not None:
        day = np.datetime64(int(named_start), "s").astype("datetime64[D]")
        moments = {order: _possible_moments(date, "", (order,)) for order in (True, False)}
        orders = [
            order for order, of_order in moments.items() if [m.astype("datetime64[D]") for m in of_order] == [day]
        ]
        if len(orders) == 1:
            return orders[0]
    for other in islice(_iter_files_beside(path), _MAX_FILES):
        with suppress(OSError, InputError), open_regular(other, "a recording") as file:
            text = file.read(_MAX_BYTES).decode("latin-1")
            if (order := explicit_order(match[0] for match in _SLASHED_DATE.finditer(text))) is not None:
                return order
    return None


def stated_start(
    remarks: Mapping[str, str], path: Path, order: str | None, time_of_day: np.timedelta64 | None
) -> tuple[dict[str, Any], list[str]]:
    """Find the start of a recording in the remarks of its file: entry `start` of its provenance, lines for its history.

    The start is a moment in ISO form, or a date alone if no time of day is known. Whether an ambiguous date begins with
    the day is found by `is_day_first_beside`; otherwise there is no start.

    - `path`, `order`: the file, and the order of the date in its name, as from `find_order`.
    - `time_of_day`: that of 0 s, None if the time column does not tell.
    """
    if (scope_begin := scope_start(remarks)) is not None:
        return {"start": iso_moment(scope_begin)}, []
    clock = next((text for name, text in remarks.items() if _CLOCK_REMARK.fullmatch(name.strip())), "")
    is_unnamed = parse_name(path.name, order) is None
    ambiguous = f"name {path.name}" if is_unnamed and dates_in_name(path.name) else None
    for name, text in sorted(remarks.items(), key=lambda remark: ":" not in remark[1]):  # with a time of day first
        is_day_first = _DAY_FIRST_START.fullmatch(name.strip()) is not None
        if not (is_day_first or _START.fullmatch(name.strip())):
            continue
        moments = _possible_moments(text, clock, (True,) if is_day_first else (True, False))
        if len(moments) > 1 and (order_beside := is_day_first_beside(path, text)) is not None:
            moments = _possible_moments(text, clock, (order_beside,))
        if len(moments) == 1:
            day = moments[0].astype("datetime64[D]")
            if time_of_day is not None:
                return {"start": iso_moment(day.astype("datetime64[ns]") + time_of_day)}, []
            return {"start": iso_moment(moments[0]) if ":" in text + clock else str(day)}, []
        ambiguous = f"{name} {text}" if moments else ambiguous
    return {}, [f"date not used, as day or month may come first: {ambiguous}"] if ambiguous else []


def _possible_moments(text: str, clock: str, orders: tuple[bool, ...]) -> list[np.datetime64]:
    """List the moments that a date, or date and time, may mean; `orders`: True for the day first, False for the month.

    `clock`: time of the day, for a date without one; "" if unknown. Empty if the text contains no date.
    """
    moments = dict[np.datetime64, None]()
    for candidate in (text if ":" in text else f"{text} {clock}".strip(), text):
        for is_day_first in orders:
            with suppress(ValueError):
                moment = parse_stamps([candidate], is_day_first)[0]
                if moment - np.datetime64("1970-01-01") >= _ONE_DAY:  # not a time of day alone
                    moments[moment] = None
        if moments:
            break
    return list(moments)
