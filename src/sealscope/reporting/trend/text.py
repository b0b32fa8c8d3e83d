"""The trend in words: what a person reads first, on the terminal and on the page."""

from __future__ import annotations

import csv
import io
import math

import numpy as np

from sealscope.diagnosis.inference.onset import Interval
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.trend.trend import Trend
from sealscope.diagnosis.trend.wear import Wear
from sealscope.paragraphs import paragraph, paragraphs
from sealscope.recordings.formats.columns import counted
from sealscope.reporting.messages import machine_text, number, say, state_text
from sealscope.storage.csv_file import guard_cell
from sealscope.units import BAR, DAY, DAYS_PER_YEAR


def level_name(trend: Trend) -> str:
    """Return the name of a level: the total of pump and piston, or the ringing of now."""
    return "now" if trend.basis == "ringing" else "total"


def moment(trend: Trend, day: float) -> str:
    """Return a time of a trend: a date, with the time of day where the recordings lie close, or a number of days."""
    if not trend.dated or not trend.points:
        return f"day {day:.3g}"
    first, last = trend.points[0], trend.points[-1]
    return stamp(first.start + (day - first.day) * DAY, last.day - first.day)


def stamp(seconds: float, span_days: float) -> str:
    """Return a time [s since 1970] as a date, with the time of day where all times lie within three days."""
    text = str(np.datetime64(round(seconds * 1e3), "ms"))
    return text[:16].replace("T", " ") if span_days < 3.0 else text[:10]


def recordings(trend: Trend) -> str:
    """Count the recordings, and give the first and the last day."""
    count, ends = len(trend.points), [moment(trend, trend.points[k].day) for k in (0, -1) if trend.points]
    return ", ".join([counted(count, "recording"), *([" to ".join(ends)] if ends else [])])


def headline(trend: Trend) -> str:
    """Format the verdict and its basis in one line."""
    wear, line, since = trend.wear, "trend", ""
    if trend.verdict == "no leak" and trend.repairs:  # what was before is over
        line, since = "trend_fell", moment(trend, trend.repairs[-1].day)
    elif wear is not None and wear.onset is not None:
        line, since = "trend_since", moment(trend, wear.onset.value)
    return say(f"terminal.{line}", verdict=trend.verdict, since=since, recordings=recordings(trend))


def sentence(trend: Trend) -> str:
    """Return the verdict as a sentence."""
    key = "ringing"
    if trend.verdict == "no leak":
        key = "fell" if trend.repairs else "no leak"
    elif trend.alarm is None or trend.wear is None:
        key = "cannot tell"
    elif trend.verdict == "leak":
        key = "grows" if trend.wear.step is None else "stepped"
    return say(f"trend_headline.{key}", since=moment(trend, trend.repairs[-1].day) if trend.repairs else "")


def figures(trend: Trend) -> dict[str, str]:
    """Return the present total, the leak, the healthy total, since when it is another, growth and limit, in words.

    The total is what pump and piston pass together, the leak its rise over the healthy one. What is not known is an
    empty text.
    """
    wear = trend.wear
    if wear is None:
        return dict.fromkeys(("now", "leak", "healthy", "since", "growth", "limit"), "")
    at_pressure = "" if trend.pressure is None else f" at {number(trend.pressure / BAR, 2)} bar"
    of_first = " of the first; no rig was stated" if trend.unit == "%" and trend.basis != "ringing" else ""
    healthy = f"{number(wear.healthy.low, 2)} to {number(healthy_end(wear), 2)} {trend.unit}{of_first}"
    since, growth = "", "not stated: the recordings are too few, or span less than a day"
    if wear.onset is not None:
        value, low, high = (moment(trend, day) for day in wear.onset)
        since = f"{value} ({low} to {high})"
    if wear.step is not None:
        growth = f"a step of {_figure(wear.step, trend.unit)}"
    elif math.isfinite(wear.growth.value):
        growth = f"{_figure(wear.growth, trend.unit)} a month"
    rise = wear.step or Interval(*(level - wear.healthy.value for level in wear.now))
    return {
        "now": f"{_figure(wear.now, trend.unit)}{at_pressure}",
        "leak": _figure(rise, trend.unit) if trend.verdict == "leak" else "",
        "healthy": f"{healthy}, 95 of 100 recordings",
        "since": since,
        "growth": growth,
        "limit": "" if wear.reach is None or wear.limit is None else _reach(trend, wear.limit, wear.reach),
    }


def healthy_end(wear: Wear) -> float:
    """Return the upper end of the healthy range, cut off at the limit despite any wider scatter."""
    high = wear.healthy.high
    return high if wear.limit is None else min(high, max(wear.limit, wear.healthy.value))


def _figure(interval: Interval, unit: str) -> str:
    """Return an estimate with its interval; an end that is not known is left open."""
    if not math.isfinite(interval.value):
        return "not known"
    ends = (number(end, 2) if math.isfinite(end) else "open" for end in (interval.low, interval.high))
    return f"{number(interval.value, 2)} {unit} ({' to '.join(ends)})"


def _reach(trend: Trend, limit: float, reach: Interval) -> str:
    """Return when the level reaches its limit, `reach` days after the last recording."""
    named, first, last = f"{number(limit, 2)} {trend.unit} in all", trend.points[0].day, trend.points[-1].day
    furthest = priors("trend")["course"]["furthest"]
    value, low, high = (moment(trend, last + days) if days <= furthest else "later" for days in reach)
    if reach.value == 0.0:
        return f"{named} is reached"
    if trend.alarm is not None and reach.value <= furthest:
        return f"{named}, reached {value} ({low} to {high}) if it goes on so"
    if reach.low > furthest:
        return f"{named}, not within {furthest / DAYS_PER_YEAR:.0f} years"
    if reach.low * max(len(trend.rows) - 1, 1) < last - first or math.isnan(reach.value):
        return f"{named}; the recordings are too few to say when"
    return f"{named}, not before {low} (95 %)"


def assumed(trend: Trend) -> str:
    """Describe the basis of the levels: machine, estimate and oil temperature."""
    machine = ""
    if trend.machine is not None and trend.basis not in (None, "ringing"):
        machine = "No L/min: area and displacement of this machine are not stated (--rig, --area, --displacement). "
        if trend.unit == "L/min":
            machine = f"L/min rest on {machine_text(trend.machine)}. "
    basis = "" if trend.basis is None else say(f"trend_basis.{trend.basis}")
    known = [point.temperature is not None for point in trend.points if point.value is not None]
    oil = "taken out" if all(known) and trend.basis != "ringing" else "not taken out"
    oil = oil if any(known) else "not known"
    first = "The first recording is" if trend.healthy == 1 else f"The first {trend.healthy} recordings are"
    return f"{basis}{machine}The oil's temperature is {oil}. {first} taken to be of a healthy machine."


def limit_note(trend: Trend) -> str:
    """Describe the limit."""
    maker = "" if trend.repair.stated else ", what a maker of excavators allows a cylinder in service"
    within = trend.wear is not None and trend.wear.limit is not None and trend.wear.limit < trend.wear.healthy.high
    scatter = "; healthy recordings of this machine scatter as far" if within else ""
    return f"{trend.repair} beyond the healthy level{maker}{scatter}"


def events(trend: Trend) -> list[str]:
    """Return alarms and repairs, in the order of their times."""
    lines = []
    for episode in trend.episodes:
        if episode.fell:
            begin = trend.points[trend.rows[episode.begin]]
            lines.append(f"{moment(trend, begin.day)} the level fell: a repair, or a part exchanged ({begin.file})")
        if episode.alarm is not None:
            point = trend.points[trend.rows[episode.alarm]]
            lines.append(f"{moment(trend, point.day)} alarm ({point.file})")
    return lines


def trend_text(trend: Trend, *, whole: bool = False) -> str:
    """Return the trend as lines of at most 80 columns; `whole`: with the reason, what was assumed and all findings."""
    known, findings = figures(trend), [finding.text for finding in trend.findings]
    rows = [("state", state_text(trend.state))]
    rows += [(level_name(trend), known["now"])]
    rows += [(name, known[name]) for name in ("leak", "healthy", "since", "growth", "limit")]
    rows += [("event", line) for line in events(trend)]
    if whole:
        rows += [("reason", trend.reason), ("assumed", assumed(trend))]
        rows += [("limit", limit_note(trend)), *(("data", text) for text in findings)]
    else:
        more = f" (and {len(findings) - 1} more: -v)" if len(findings) > 1 else ""
        rows += [("data", findings[0] + more)] if findings else []
        rows += [("reason", trend.reason)] if trend.verdict == "cannot tell" else []
    rows.append(("next", trend.next_check))
    return "\n".join([paragraph(headline(trend), indent=2), *paragraphs(rows, 10)])


def trend_csv(trend: Trend) -> str:
    """Return the recordings of a trend as a table, one row each."""
    unit, time = trend.unit, "time" if trend.dated else "time [d]"
    levels = (f"level [{unit}]", f"low [{unit}]", f"high [{unit}]")
    with io.StringIO(newline="") as text:
        table = csv.writer(text, lineterminator="\n")
        table.writerow(("file", time, "day [d]", *levels, "group", "temperature [degC]", "note"))
        table.writerows(map(guard_cell, row.values()) for row in trend.as_dict()["points"])
        return text.getvalue()
