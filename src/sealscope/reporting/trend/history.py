"""Write the page of a commissioned machine: its newest verdict, and all its recordings over time."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording
from sealscope.reporting import charts, messages, template
from sealscope.reporting.picture import Picture
from sealscope.reporting.trend.page import level_pictures
from sealscope.reporting.trend.text import stamp
from sealscope.units import DAY


class Judged(NamedTuple):
    """A diagnosed recording; `start_s`: its start [s since 1970], None if unknown; `read`: function that reads it."""

    diagnosis: Diagnosis
    start_s: float | None
    read: Callable[[], Recording]


#: Leak of a recording [L/min]: (estimate, lower, upper end of its interval), or (bound, None, bound).
_Level = tuple[float, float | None, float]


def write_history_page(
    path: str | os.PathLike[str], judged: Sequence[Judged], *, title: str, left_out: int = 0
) -> Path:
    """Write the page of a machine (`render_history_page`) as .html, .htm or .pdf, and return its path."""
    return template.write(template.parse_page_path(path, card=False), render_history_page(judged, title, left_out))


def render_history_page(judged: Sequence[Judged], title: str, left_out: int = 0) -> str:
    """Render the page of a machine as HTML; raise InputError if there are no recordings.

    `judged`: the machine's diagnosed recordings, in any order; `title`: name of the machine; `left_out`: number of
    files that could not be read or diagnosed.
    """
    if not judged:
        raise InputError("the page of a machine must have at least 1 recording, got 0")
    first = -math.inf  # recordings without a date come first
    ordered = sorted(judged, key=lambda item: (first if item.start_s is None else item.start_s, item.diagnosis.file))
    newest = ordered[-1].diagnosis
    dates = _format_dates(ordered)
    page_charts, drawn, files = _draw_comparison(ordered)
    entries = zip(ordered, dates, strict=True)
    rows = [{"file": Path(entry.diagnosis.file).name, "date": date, "d": entry.diagnosis} for entry, date in entries]
    return template.render(
        "history.html.j2",
        d=newest,
        messages=messages,
        title=title,
        rows=rows[::-1],  # the newest first
        undated=sum(entry.start_s is None for entry in ordered),
        left_out=left_out,
        levels=history_pictures(ordered),
        charts=page_charts,
        drawn=drawn,
        files=files,
        chart_data=None if drawn is None else drawn.data,
    )


def history_pictures(ordered: Sequence[Judged]) -> dict[str, Picture] | None:
    """Draw each recording's leak flow [L/min], or its bound, over time as `level_pictures`; None if none is known.

    `ordered`: recordings in the order of their start; if a date is missing, the axis counts the recordings from 1.
    """
    levels = [_leak_level(entry.diagnosis) for entry in ordered]
    known_levels = [level for level in levels if level is not None]
    if not known_levels:
        return None
    has_dates = all(entry.start_s is not None for entry in ordered)
    # `or`: for type checkers
    days = [(entry.start_s or 0.0) / DAY if has_dates else float(k + 1) for k, entry in enumerate(ordered)]
    limit = ordered[-1].diagnosis.limit_lpm
    leaks = [lpm for lpm, low, _ in known_levels if low is not None]
    # every leak is within the frame, and so is the upper end of its interval up to twice the largest leak; a bound
    # above these and above 8 times the median would flatten the others: it is drawn as a symbol at the top
    max_shown = max(8.0 * float(np.median([lpm for lpm, *_ in known_levels])), 2.0 * max(leaks, default=0.0))
    upper_ends = [min(high, max_shown) for _, low, high in known_levels if low is not None]
    bounds = [lpm for lpm, low, _ in known_levels if low is None and lpm <= max_shown]
    shown_values = [*leaks, *upper_ends, *bounds]
    shown_values += [] if limit is None or limit > max_shown else [limit]
    top = 1.08 * max(shown_values, default=0.0) or 1.0  # 8 % margin

    def format_day(day: float) -> str:
        """Format a value of the time axis as a date or, without dates, as a recording's number, "" if not whole."""
        if has_dates:
            return stamp(day * DAY, days[-1] - days[0])
        return f"{day:g}" if day.is_integer() else ""

    def draw_levels(picture: Picture) -> None:
        """Draw each recording as a point with interval, or as a symbol for a bound, one above the frame, or none."""
        for entry, day, level in zip(ordered, days, levels, strict=True):
            if level is None:
                picture.symbol("absent", day, down=picture.height - 4.0)
                continue
            lpm, low, high = level
            title = f"{Path(entry.diagnosis.file).name}: {messages.format_leak_flow(entry.diagnosis)}"
            if lpm > top:
                picture.symbol("beyond", day, down=6.0, title=title)
            elif low is None:
                picture.symbol("bound", day, down=float(picture.y(lpm)), title=title)
            else:
                picture.point("point", day, lpm, (low, min(high, top)), title)

    ends = (days[0], days[-1])
    return level_pictures(ends, levels=(0.0, top), limit=limit, format_day=format_day, draw=draw_levels)


def _leak_level(diagnosis: Diagnosis) -> _Level | None:
    """Return the leak flow of a diagnosis or, for verdicts other than `leak`, its upper bound; None if not known."""
    if diagnosis.leak_lpm is not None and diagnosis.leak_interval_lpm is not None:
        return diagnosis.leak_lpm, *diagnosis.leak_interval_lpm
    bound = diagnosis.bound_lpm
    return None if bound is None else (bound, None, bound)


def _format_dates(ordered: Sequence[Judged]) -> list[str]:
    """Format the start of each recording as a date, with the time of day if all are within 3 days; "–" if unknown."""
    starts = [entry.start_s for entry in ordered if entry.start_s is not None]
    span_days = (max(starts) - min(starts)) / DAY if starts else 0.0
    return [messages.ABSENT if entry.start_s is None else stamp(entry.start_s, span_days) for entry in ordered]


def _draw_comparison(ordered: Sequence[Judged]) -> tuple[list[charts.Chart], charts.DrawnCharts | None, list[str]]:
    """Draw the channels of the newest and of an earlier recording in the same charts, from a common start.

    The earlier recording is the last one with the verdict `no leak` or, if there is none, the last before the newest.
    Returns the charts, their drawn lines, and the names of the two files; or ([], None, []) if there is only one
    recording, no common channel, or a time that does not increase.
    """
    *earlier, newest = ordered
    if not earlier:
        return [], None, []
    healthy = [entry for entry in earlier if entry.diagnosis.verdict == "no leak"]
    reference = (healthy or earlier)[-1]
    latest, other = newest.read(), reference.read()
    if not all(recording.t.size and np.all(np.diff(recording.t) > 0.0) for recording in (latest, other)):
        return [], None, []
    files = [Path(judged.diagnosis.file).name for judged in (newest, reference)]
    other_t = other.t - other.t[0] + latest.t[0]
    comparison = []
    for name in latest.channels:
        if name not in other or latest.units[name] != other.units[name]:
            continue
        pressure_unit = latest.pressure_unit
        unit, values = charts.display_values(latest, name, pressure_unit)
        # the other recording at the times of the newest one
        samples = np.interp(latest.t, other_t, other[name], left=np.nan, right=np.nan)
        resampled = replace(latest, channels={name: samples})  # to be displayed in the units of the newest recording
        other_values = charts.display_values(resampled, name, pressure_unit)[1]
        lines = (charts.ChartLine(files[0], "a", values), charts.ChartLine(files[1], "b", other_values))
        comparison.append(charts.Chart(f"over-{name}", "channels", name, unit, lines))
    if not comparison:
        return [], None, []
    drawn = charts.draw(latest, chambers=[], charts=comparison, diagnosis=newest.diagnosis, marks=[])
    return comparison, drawn, files
