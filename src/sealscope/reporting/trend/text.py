"""Format a trend as text for the terminal and the page."""

from __future__ import annotations

import csv
import io
import math

import numpy as np

from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.priors.trend import TREND
from sealscope.diagnosis.trend.machine_trend import Trend
from sealscope.diagnosis.trend.wear import Wear
from sealscope.paragraphs import format_count, paragraph, paragraphs
from sealscope.reporting.messages import machine_text, number, say, state_text
from sealscope.storage.csv_file import guard_cell
from sealscope.units import BAR, DAY, DAYS_PER_YEAR


def level_name(trend: Trend) -> str:
    """Return the label of the present level: "now" for the basis "ringing", which is no leakage, else "total"."""
    return "now" if trend.basis == "ringing" else "total"


def moment(trend: Trend, day: float) -> str:
    """Format a time of a trend, `day` days after its first recording, as a date; as "day N" without dates."""
    if not trend.dated or not trend.points:
        return f"day {day:.3g}"
    first, last = trend.points[0], trend.points[-1]
    return stamp(first.start + (day - first.day) * DAY, last.day - first.day)


def stamp(seconds: float, span_days: float) -> str:
    """Format a time [s since 1970] as a date in UTC, with the time of day if all shown times span less than 3 days."""
    text = str(np.datetime64(round(seconds * 1e3), "ms"))  # such as 2026-11-25T09:30:00.000
    return text[:16].replace("T", " ") if span_days < 3.0 else text[:10]


def recordings_text(trend: Trend) -> str:
    """Format the number of recordings of a trend, and the dates of the first and the last one."""
    count = format_count(len(trend.points), "recording")
    if not trend.points:
        return count
    first, last = (moment(trend, point.day) for point in (trend.points[0], trend.points[-1]))
    return f"{count}, {first} to {last}"


def headline(trend: Trend) -> str:
    """Format a trend in one line: the verdict, the date since which it holds, if known, and the recordings."""
    key, since = "trend", ""
    if trend.verdict == "no leak" and trend.repairs:  # a repair ended the earlier leak
        key, since = "trend_fell", moment(trend, trend.repairs[-1].day)
    elif trend.wear is not None and trend.wear.onset is not None:
        key, since = "trend_since", moment(trend, trend.wear.onset.value)
    return say(f"terminal.{key}", verdict=trend.decision.summary, since=since, recordings=recordings_text(trend))


def verdict_sentence(trend: Trend) -> str:
    """Format the verdict of a trend, or another cause than a leak, as a sentence for the heading of its page."""
    if trend.decision.summary != trend.verdict:  # the summary names another cause than a leak
        return trend.decision.summary[0].upper() + trend.decision.summary[1:]  # keeps other capitals
    if trend.verdict == "no leak":
        key = "fell" if trend.repairs else "no leak"
    elif trend.alarm is None or trend.wear is None:
        key = "cannot tell"
    elif trend.verdict == "leak":
        key = "grows" if trend.wear.step is None else "stepped"
    else:
        key = "ringing"  # an alarm by pressure oscillations, which show no size of a leak
    last_repair = moment(trend, trend.repairs[-1].day) if trend.repairs else ""
    return say(f"trend_headline.{key}", since=last_repair)


def figures(trend: Trend) -> dict[str, str]:
    """Format the numbers of a trend as text, by name; the text is "" or a remark if a number is not known.

    `total`: present leakage of pump and piston together or, for the basis "ringing", damping of the pressures' ringing;
    `leak`: its rise above the healthy level, for the verdict `leak`; `healthy`: range of 95 % of the healthy
    recordings, up to `healthy_end`; `since`: onset of the rise; `growth`: rise in a month, or in a sudden step;
    `limit`: repair limit, and the date at which the level reaches it. Levels are in `Trend.unit`.
    """
    wear = trend.wear
    if wear is None:
        return dict.fromkeys(("total", "leak", "healthy", "since", "growth", "limit"), "")
    at_pressure = "" if trend.pressure is None else f" at {number(trend.pressure / BAR, 2)} bar"
    # without a rig, leakage is in % of the healthy recordings' mean, by default that of the first recording alone;
    # ringing is always in % above this mean, with or without a rig
    reference = ""
    if trend.unit == "%" and trend.basis != "ringing":
        healthy_mean = "the first" if trend.healthy == 1 else f"the mean of the first {trend.healthy}"
        healthy_levels = [trend.points[row].value or 0.0 for row in trend.rows[: trend.healthy]]
        size = "the size of " if sum(healthy_levels) < 0.0 else ""  # errors may exceed the leakage of a tight machine
        reference = f" of {size}{healthy_mean}; no rig was stated"
    high = healthy_end(wear)
    is_whole = high == wear.healthy.high
    remark = "95 of 100 recordings" if is_whole else "cut off at the limit; some healthy recordings lie above"
    healthy = f"{number(wear.healthy.low, 2)} to {number(high, 2)} {trend.unit}{reference}, {remark}"
    since, growth = "", "not stated: the recordings are too few, or span less than a day"
    if wear.onset is not None:
        onset, earliest, latest = (moment(trend, day) for day in wear.onset)
        since = f"{onset} ({earliest} to {latest})"
    if wear.step is not None:
        growth = f"a step of {_format_estimate(wear.step, trend.unit)}"
    elif math.isfinite(wear.growth.value):
        growth = f"{_format_estimate(wear.growth, trend.unit)} a month"
    return {
        "total": f"{_format_estimate(trend.total or wear.total, trend.unit)}{at_pressure}",
        "leak": _format_estimate(trend.leak, trend.unit) if trend.verdict == "leak" and trend.leak else "",
        "healthy": healthy,
        "since": since,
        "growth": growth,
        "limit": "" if wear.reach is None or wear.limit is None else _format_reach(trend, wear.limit, wear.reach),
    }


def healthy_end(wear: Wear) -> float:
    """Compute the upper end of the healthy range, cut at the repair limit but not below the healthy mean."""
    high = wear.healthy.high
    return high if wear.limit is None else min(high, max(wear.limit, wear.healthy.value))


def _format_estimate(interval: Interval, unit: str) -> str:
    """Format an estimate with unit and interval, "open" for an infinite end; "not known" if it is not finite."""
    if not math.isfinite(interval.value):
        return "not known"
    ends = (number(end, 2) if math.isfinite(end) else "open" for end in (interval.low, interval.high))
    return f"{number(interval.value, 2)} {unit} ({' to '.join(ends)})"


def _format_reach(trend: Trend, limit: float, reach: Interval) -> str:
    """Format the repair limit, and the predicted date at which the leakage reaches it, or why none is stated.

    `limit`: in the unit of the trend; `reach` [days]: time from the last compared recording until then (`Wear.reach`).
    Without an alarm, or if that time is over `TREND.history.furthest`, at most the earliest date is stated.
    """
    limit_text = f"{number(limit, 2)} {trend.unit} in all"
    first, last = (trend.points[row].day for row in (trend.rows[0], trend.rows[-1]))
    max_days = TREND.history.furthest
    expected, earliest, latest = (moment(trend, last + days) if days <= max_days else "later" for days in reach)
    if reach.value == 0.0:
        return f"{limit_text} is reached"
    if trend.alarm is not None and reach.value <= max_days:
        return f"{limit_text}, reached {expected} ({earliest} to {latest}) at this rate"
    if reach.low > max_days:
        return f"{limit_text}, not within {max_days / DAYS_PER_YEAR:.0f} years"
    # no date is stated that is nearer than the mean interval between compared recordings
    if reach.low * max(len(trend.rows) - 1, 1) < last - first or math.isnan(reach.value):
        return f"{limit_text}; the recordings are too few to say when"
    return f"{limit_text}, not before {earliest} (95 %)"


def assumptions_text(trend: Trend) -> str:
    """Format the assumptions of a trend as sentences: method, machine data, oil temperature, healthy recordings."""
    machine = ""  # for "ringing" the text of the basis says that there are no L/min
    if trend.machine is not None and trend.basis not in (None, "ringing"):
        machine = "No L/min: area and displacement of this machine are not stated (--rig, --area, --displacement). "
        if trend.unit == "L/min":
            machine = f"Flows in L/min: {machine_text(trend.machine)}. "
    basis = "" if trend.basis is None else say(f"trend_basis.{trend.basis}")
    is_known = [point.temperature is not None for point in trend.points if point.value is not None]
    # the effect of the oil temperature is removed only if it is known in all recordings
    oil = "taken out" if all(is_known) and trend.basis != "ringing" else "not taken out"
    oil = oil if any(is_known) else "not known"
    first = "The first recording is" if trend.healthy == 1 else f"The first {trend.healthy} recordings are"
    return f"{basis}{machine}The oil's temperature is {oil}. {first} taken to be of a healthy machine."


def limit_note(trend: Trend) -> str:
    """Format the repair limit and its origin, with a remark if healthy recordings scatter beyond it."""
    origin = "" if trend.repair.stated else ", what a maker of excavators allows a cylinder in service"
    wear = trend.wear
    is_in_scatter = wear is not None and wear.limit is not None and wear.limit < wear.healthy.high
    scatter = "; healthy recordings of this machine scatter as far" if is_in_scatter else ""
    return f"{trend.repair} beyond the healthy level{origin}{scatter}"


def events(trend: Trend) -> list[str]:
    """List the alarms and repairs of a trend as lines of text, in the order of their times."""
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
    """Format a trend as text for the terminal; `whole`: with reason, assumptions, origin of the limit, all findings."""
    known_figures, findings = figures(trend), [finding.text for finding in trend.findings]
    rows = [("state", state_text(trend.state))]
    rows += [(level_name(trend), known_figures["total"])]
    rows += [(name, known_figures[name]) for name in ("leak", "healthy", "since", "growth", "limit")]
    rows += [("event", line) for line in events(trend)]
    if whole:
        rows += [("reason", trend.reason), ("assumed", assumptions_text(trend))]
        rows += [("limit", limit_note(trend)), *(("data", text) for text in findings)]
    else:
        more = f" (and {len(findings) - 1} more: -v)" if len(findings) > 1 else ""
        rows += [("data", findings[0] + more)] if findings else []
        rows += [("reason", trend.reason)] if trend.verdict == "cannot tell" else []
    rows.append(("next", trend.next_check))
    return "\n".join([paragraph(headline(trend), indent=2), *paragraphs(rows, columns=10)])


def trend_csv(trend: Trend) -> str:
    """Format a trend as CSV text, with a row for each recording, in the unit of the trend."""
    unit, time = trend.unit, "time" if trend.dated else "time [d]"
    levels = (f"level [{unit}]", f"low [{unit}]", f"high [{unit}]")
    with io.StringIO(newline="") as text:
        table = csv.writer(text, lineterminator="\n")
        table.writerow(("file", time, "day [d]", *levels, "group", "temperature [degC]", "note"))
        # the entries of a point have the order of the columns
        table.writerows(map(guard_cell, row.values()) for row in trend.as_dict()["points"])
        return text.getvalue()
