"""The trend in words: what a person reads first, on the terminal and on the page."""

from __future__ import annotations

import csv
import io
import math

import numpy as np

from sealscope.diagnosis.trend.timeline import DAY
from sealscope.diagnosis.trend.trend import Trend, TrendPoint
from sealscope.diagnosis.trend.wear import MONTH, Interval
from sealscope.reporting.messages import machine_text, number

#: Times are shown to the minute where all recordings lie within so many days.
_WITHIN_DAYS = 3.0
#: Furthest time that is stated, in months.
_FURTHEST = 120.0
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
    stamp = str(np.datetime64(round((first.start + (day - first.day) * DAY) * 1e3), "ms"))
    return stamp[:16].replace("T", " ") if last.day - first.day < _WITHIN_DAYS else stamp[:10]


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
    onset = wear.onset
    return f"{moment(trend, onset.value)} ({moment(trend, onset.low)} to {moment(trend, onset.high)})"


def headline(trend: Trend) -> str:
    """Return verdict and what it rests on, in one line."""
    count = len(trend.points)
    span = f", {moment(trend, trend.points[0].day)} to {moment(trend, trend.points[-1].day)}" if count else ""
    own = since(trend)
    if trend.verdict == "no leak" and trend.repairs:  # what was before is over
        own = f"{moment(trend, trend.repairs[-1].day)}, when the level fell"
    return f"{trend.verdict} in {count} recording{'' if count == 1 else 's'}{span}{f', since {own}' if own else ''}"


def sentence(trend: Trend) -> str:
    """Return the verdict as a sentence."""
    wear = trend.wear
    if trend.verdict == "no leak":
        fell = f", since {moment(trend, trend.repairs[-1].day)}" if trend.repairs else ""
        return f"The leakage does not grow{fell}"
    if trend.verdict == "leak" and wear is not None and trend.alarm is not None:
        return "The leakage grows" if wear.step is None else "The leakage stepped up"
    if trend.alarm is not None:
        return "The ringing of the pressures changed; a leak cannot be told from other causes"
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
    return f"{number(wear.healthy.low, 2)} to {number(wear.healthy.high, 2)} {trend.unit}, 95 of 100 recordings"


def level(trend: Trend) -> str | None:
    """Return the present level beside the healthy band, None where there is no level."""
    wear = trend.wear
    if wear is None or trend.basis is None:
        return None
    band = f"{number(wear.healthy.low, 2)} to {number(wear.healthy.high, 2)}"
    relative = "" if trend.unit == "L/min" or trend.basis == "ringing" else ", beside the first; no rig was stated"
    return f"{level_now(trend)}; healthy {band}; {_BASES[trend.basis]}{relative}"


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


def _wait(days: float) -> str:
    months = days / MONTH
    if not months <= _FURTHEST:
        return f"more than {_FURTHEST / 12:.0f} years"
    return f"{days:.0f} days" if months < 2.0 else f"{months:.0f} months"


def reach(trend: Trend) -> str | None:
    """Return when the level reaches the limit, None where no limit is known."""
    wear = trend.wear
    if wear is None or wear.reach is None or trend.limit is None:
        return None
    limit = f"{number(trend.limit, 2)} {trend.unit}"
    own = wear.reach
    if math.isnan(own.value):
        return None
    if own.value == 0.0:
        text = f"{limit} is reached"
    elif trend.alarm is None or not math.isfinite(own.value) or own.value / MONTH > _FURTHEST:
        text = f"{limit} not before {_wait(own.low)}" if own.low / MONTH <= _FURTHEST else f"{limit} not in sight"
    else:
        text = f"{limit} in {_wait(own.value)} ({_wait(own.low)} to {_wait(own.high)}) if it goes on so"
    limit_text = f"{trend.repair} beyond the healthy level"
    if not trend.repair.stated:
        limit_text += ", what a maker of excavators allows a cylinder in service"
    return f"{text}; the limit is {limit_text}"


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
    """Return the trend as lines for the terminal; `whole`: with the reason and all findings."""
    rows = [("now", level(trend)), ("growth", growth(trend)), ("limit", reach(trend))]
    rows += [("event", line) for line in events(trend)]
    findings = [finding.text for finding in trend.findings]
    if whole:
        rows += [("reason", trend.reason), *(("data", text) for text in findings)]
    elif findings:
        more = f" (and {len(findings) - 1} more, see -v)" if len(findings) > 1 else ""
        rows.append(("data", findings[0] + more))
    if trend.wear is None and not whole:
        rows.append(("reason", trend.reason))
    rows.append(("next", trend.next_check))
    return "\n".join([headline(trend), *(f"  {name:<8}{text}" for name, text in rows if text)])


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
