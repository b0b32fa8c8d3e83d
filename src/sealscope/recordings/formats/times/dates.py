"""When a recording was made, as the remarks above its samples or the name of its file say.

Of a date such as 04-03-2026, the order of day and month is taken from what determines it, and is not guessed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.formats.headings.labels import WORDS
from sealscope.recordings.formats.headings.preamble import scope_start
from sealscope.recordings.formats.times.timebase import explicit_order, iso_moment, parse_epoch, parse_stamps
from sealscope.storage.opening import open_regular

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
_START, _DAY_FIRST_START, _CLOCK = (
    re.compile(WORDS["stated"][name], re.IGNORECASE) for name in ("start", "day_first_start", "clock")
)
_DAY = np.timedelta64(1, "D")
_NUMBER = re.compile(r"\d+")
_EITHER_DATE = re.compile(r"(?<![\d/-])\d{1,2}([/-])\d{1,2}\1(?:\d{4}|\d{2})(?![\d/-])")
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
            if (order := explicit_order(match[0] for match in _EITHER_DATE.finditer(text))) is not None:
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
    clock = next((text for name, text in remarks.items() if _CLOCK.fullmatch(name.strip())), "")
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
                if moment - np.datetime64("1970-01-01") >= _DAY:  # not a time of day alone
                    moments[moment] = None
        if moments:
            break
    return list(moments)
