"""The trend in words: what a person reads first, on the terminal and on the page."""

from __future__ import annotations

import csv
import io
import math
from textwrap import fill

import numpy as np

from sealscope.diagnosis.inference.onset import Interval
from sealscope.diagnosis.trend.reading import DAY, TrendPoint
from sealscope.diagnosis.trend.trend import Trend
from sealscope.diagnosis.trend.wear import MONTH
from sealscope.recordings.formats.columns import counted
from sealscope.reporting.messages import machine_text, number

#: Times are shown to the minute where all recordings lie within so many days.
_WITHIN_DAYS = 3.0
#: Furthest time that is stated [days].
_FURTHEST = 120.0 * MONTH
_BASES = {
    "volume balance": "by the volume balance",
    "pressure response": "by the pressures' response",
    "ringing": "the damping of the pressures' ringing, relative: no L/min",
}


def moment(trend: Trend, day: float) -> str:
    """Return a time of a trend: a date, with the time of day where the recordings lie close, or a number of days."""
    if not trend.dated or not trend.points:
        return f"day {day:.3g}"
    first, last = trend.points[0], trend.points[-1]
    return stamp(first.start + (day - first.day) * DAY, last.day - first.day)


def stamp(seconds: float, span_days: float) -> str:
    """Return a time [s since 1970] as a date, with the time of day where all times lie within a few days."""
    text = str(np.datetime64(round(seconds * 1e3), "ms"))
    return text[:16].replace("T", " ") if span_days < _WITHIN_DAYS else text[:10]


def figure(interval: Interval, unit: str, digits: int = 2) -> str:
    """Return an estimate with its interval; an end that is not known is left open."""
    if not math.isfinite(interval.value):
        return "not known"
    ends = (number(end, digits) if math.isfinite(end) else "open" for end in (interval.low, interval.high))
    return f"{number(interval.value, digits)} {unit} ({' to '.join(ends)})"


def since(trend: Trend) -> str | None:
    """Return since when the level is not that of before, with its interval; None where it did not change."""
    wear = trend.wear
    if wear is None or wear.onset is None:
        return None
    value, low, high = (moment(trend, day) for day in wear.onset)
    return f"{value} ({low} to {high})"


def headline(trend: Trend) -> str:
    """Return verdict and what it rests on, in one line."""
    count, wear = len(trend.points), trend.wear
    onset = "" if wear is None or wear.onset is None else f" since {moment(trend, wear.onset.value)}"
    if trend.verdict == "no leak" and trend.repairs:  # what was before is over
        onset = f" since {moment(trend, trend.repairs[-1].day)}, when the level fell"
    span = f", {moment(trend, trend.points[0].day)} to {moment(trend, trend.points[-1].day)}" if count else ""
    return f"{trend.verdict}{onset}: {counted(count, 'recording')}{span}"


def sentence(trend: Trend) -> str:
    """Return the verdict as a sentence."""
    wear = trend.wear
    if trend.verdict == "no leak":
        fell = f", since {moment(trend, trend.repairs[-1].day)}" if trend.repairs else ""
        return f"The leakage does not grow{fell}"
    if trend.verdict == "leak" and wear is not None and trend.alarm is not None:
        return "The leakage grows" if wear.step is None else "The leakage stepped up"
    if trend.alarm is not None:
        return "The ringing of the pressures changed; a leak cannot be separated from other causes"
    return "Cannot tell"


def title_of_levels(trend: Trend) -> str:
    """Return what the levels are, with their unit."""
    what = "Damping of the pressures' ringing" if trend.basis == "ringing" else "The leakage over time"
    return f"{what} [{trend.unit}]"


def level_now(trend: Trend) -> str | None:
    """Return the present level, None where there is none."""
    wear = trend.wear
    if wear is None:
        return None
    at = "" if trend.pressure is None else f" at {number(trend.pressure / 1e6, 2)} MPa"
    return f"{figure(wear.now, trend.unit)}{at}"


def healthy(trend: Trend) -> str | None:
    """Return where a recording of the healthy machine lies, None where no level is known."""
    wear = trend.wear
    if wear is None:
        return None
    of_first = " of the first; no rig was stated" if trend.unit == "%" and trend.basis != "ringing" else ""
    ends = f"{number(wear.healthy.low, 2)} to {number(wear.healthy.high, 2)} {trend.unit}{of_first}"
    return f"{ends}, 95 of 100 recordings"


def assumed(trend: Trend) -> str:
    """Return what the levels rest on."""
    first = "The first recording is" if trend.healthy == 1 else f"The first {trend.healthy} recordings are"
    basis = "" if trend.basis is None else f"Levels {_BASES[trend.basis]}. "
    if trend.basis == "ringing":
        basis = f"Levels: {_BASES[trend.basis]}. "
    temperature = any(point.temperature is not None for point in trend.points)
    oil = "The oil's temperature is taken out. " if temperature else "The oil's temperature is not known. "
    machine = ""
    if trend.machine is not None and trend.basis not in (None, "ringing"):
        machine = f"L/min rest on {machine_text(trend.machine)}. "
        if trend.unit != "L/min":
            machine = "No L/min: area and displacement of this machine are not stated (--rig, --area, --displacement). "
    return f"{basis}{machine}{oil}{first} taken to be of a healthy machine."


def group_note(trend: Trend, point: TrendPoint) -> str:
    """Return what sets a recording's group apart from the first one."""
    return trend.groups[point.group] if point.group > 0 else ""


def growth(trend: Trend) -> str | None:
    """Return how the level changes, None where there is no level."""
    wear = trend.wear
    if wear is None:
        return None
    if wear.step is not None:
        return f"a step of {figure(wear.step, trend.unit)}"
    if not math.isfinite(wear.growth.value):
        return "not stated: the recordings are too few, or span less than a day"
    return f"{figure(wear.growth, trend.unit)} a month"


def reach(trend: Trend) -> str | None:
    """Return when the level reaches the limit, None where no limit is known."""
    wear = trend.wear
    if wear is None or wear.reach is None or trend.limit is None:
        return None
    limit, last, own = f"{number(trend.limit, 2)} {trend.unit}", trend.points[-1].day, wear.reach
    value, low, high = (moment(trend, last + days) if days <= _FURTHEST else "later" for days in own)
    if own.value == 0.0:
        return f"{limit} is reached"
    if trend.alarm is not None and own.value <= _FURTHEST:
        return f"{limit}, reached {value} ({low} to {high}) if it goes on so"
    if own.low > _FURTHEST:
        return f"{limit}, not within {_FURTHEST / MONTH / 12.0:.0f} years"
    if own.low * max(len(trend.rows) - 1, 1) < last - trend.points[0].day or math.isnan(own.value):
        return f"{limit}; the recordings are too few to say when"
    return f"{limit}, not before {low} (95 %)"


def limit_note(trend: Trend) -> str:
    """Return what the limit is."""
    maker = "" if trend.repair.stated else ", what a maker of excavators allows a cylinder in service"
    return f"{trend.repair} beyond the healthy level{maker}"


def events(trend: Trend) -> list[str]:
    """Return alarms and repairs, in the order of their times."""
    lines = []
    for own in trend.episodes:
        if own.fell:
            begin = trend.points[trend.rows[own.begin]]
            lines.append(f"{moment(trend, begin.day)} the level fell: a repair, or a part exchanged ({begin.file})")
        if own.alarm is not None:
            point = trend.points[trend.rows[own.alarm]]
            lines.append(f"{moment(trend, point.day)} alarm ({point.file})")
    return lines


def trend_text(trend: Trend, *, whole: bool = False) -> str:
    """Return the trend as lines of at most 80 columns; `whole`: with the reason, what was assumed and all findings."""
    rows = [("now", level_now(trend)), ("healthy", healthy(trend)), ("growth", growth(trend)), ("limit", reach(trend))]
    rows += [("event", line) for line in events(trend)]
    findings = [finding.text for finding in trend.findings]
    if whole:
        rows += [("since", since(trend)), ("reason", trend.reason), ("assumed", assumed(trend))]
        rows += [("limit", limit_note(trend)), *(("data", text) for text in findings)]
    elif findings:
        rows.append(("data", findings[0] + (f" (and {len(findings) - 1} more: -v)" if len(findings) > 1 else "")))
    if not whole and trend.verdict == "cannot tell":
        rows.append(("reason", trend.reason))
    rows.append(("next", trend.next_check))
    lines = [fill(text, 80, initial_indent=f"  {name:<8}", subsequent_indent=10 * " ") for name, text in rows if text]
    return "\n".join([fill(headline(trend), 80, subsequent_indent="  "), *lines])


def trend_csv(trend: Trend) -> str:
    """Return the recordings of a trend as a table, one row each."""
    rows = trend.as_dict()["points"]
    unit = trend.unit
    names = {
        "file": "file",
        "time": "time" if trend.dated else "time [d]",
        "day": "day [d]",
        "value": f"level [{unit}]",
        "low": f"low [{unit}]",
        "high": f"high [{unit}]",
        "group": "group",
        "temperature_C": "temperature [degC]",
        "note": "note",
    }
    with io.StringIO(newline="") as text:
        table = csv.writer(text, lineterminator="\n")
        table.writerow(names.values())
        table.writerows(["" if row[name] is None else row[name] for name in names] for row in rows)
        return text.getvalue()
