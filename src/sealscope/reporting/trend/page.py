"""Write the page of a trend, the leakage of one machine over its recordings, as one HTML file that works offline."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from sealscope.diagnosis.trend.machine_trend import Trend
from sealscope.diagnosis.trend.wear import Episode
from sealscope.reporting import messages, template
from sealscope.reporting.picture import Picture
from sealscope.reporting.trend import text
from sealscope.units import DAYS_PER_MONTH

#: Sizes of the picture for a screen and for a telephone, and its margins left of the frame, above, right and below.
SIZES = {"wide": (900.0, 320.0), "narrow": (420.0, 300.0)}
_MARGINS = (58.0, 14.0, 12.0, 26.0)
#: Width of a tick's label with its margin, and half of the label's width, in pixels.
_TICK_WIDTH, _HALF_LABEL = 110.0, 22.0
#: Pause between two recordings, over their median distance, from which no line is drawn through it.
PAUSE = 3.0
#: Distances between two ticks [d], from a minute to five years.
_STEPS = (*(m / 1440 for m in (1, 5, 15, 60, 180, 360)), 1, 2, 7, 14, 30, 61, 91, 182, 365, 730, 1826)


def write_trend_page(path: str | os.PathLike[str], trend: Trend, *, title: str = "") -> Path:
    """Write the page of a trend as .html, .htm or .pdf, and return its path; raise InputError if that fails."""
    return template.write(template.parse_page_path(path, card=False), render_trend_page(trend, title=title))


def render_trend_page(trend: Trend, *, title: str = "") -> str:
    """Render the page of a trend as HTML; `title`: its title, "" for "Trend of a machine"."""
    return template.render(
        "trend.html.j2",
        trend=trend,
        text=text,
        figures=text.figures(trend),
        title=title or "Trend of a machine",
        n=messages.number,
        chart=trend_pictures(trend),
    )


def level_pictures(
    days: tuple[float, float],
    levels: tuple[float, float],
    limit: float | None,
    format_day: Callable[[float], str],
    draw: Callable[[Picture], None],
) -> dict[str, Picture]:
    """Draw the leakage of a machine over time, as one picture for each of the `SIZES`, "wide" and "narrow".

    `days`: first and last value of the time axis, which `format_day` formats; `levels`: ends of the leakage axis;
    `limit`: repair limit, drawn unless it lies above the axis; `draw`: draws the recordings into a picture.
    """
    margin = 0.02 * (days[1] - days[0]) or 0.5  # half a day if there is one time only
    first, last = days[0] - margin, days[1] + margin
    left, top, right, bottom = _MARGINS
    pictures = {}
    for size, (width, height) in SIZES.items():
        picture = Picture(width - left - right, height - top - bottom, (first, last), levels, margins=_MARGINS)
        # the shortest step between ticks for which their labels have room
        step = next((step for step in _STEPS if (last - first) / step <= width / _TICK_WIDTH), _STEPS[-1])
        picture.frame(count=4)
        for day in np.arange(days[0], last, step).tolist():
            has_room = picture.x(day) + _HALF_LABEL <= picture.width
            picture.below(day, format_day(day), anchor="middle" if has_room else "end")
        if limit is not None and limit <= levels[1]:
            picture.level("limit", limit)
        draw(picture)
        pictures[size] = picture
    return pictures


def trend_pictures(trend: Trend) -> dict[str, Picture] | None:
    """Draw the leakage over time as a picture for each of the `SIZES`; return None if no leakage is known."""
    if trend.wear is None or all(point.value is None for point in trend.points):
        return None
    days = trend.points[0].day, trend.points[-1].day
    format_day, draw = partial(text.moment, trend), partial(_draw_trend, trend)
    return level_pictures(days, _y_limits(trend), trend.limit, format_day, draw)


def _draw_trend(trend: Trend, picture: Picture) -> None:
    """Draw recordings, alarms and repairs of a trend into a picture, and healthy range and fitted line by episode.

    An episode is the recordings from one repair to the next.
    """
    days = [trend.points[row].day for row in trend.rows]
    for episode in trend.episodes:
        healthy = episode.wear.healthy
        healthy_high = text.healthy_end(episode.wear)
        stop = days[min(episode.end, len(days) - 1)]  # the next episode's first recording, if there is one
        picture.box("healthy", days[episode.begin], stop, healthy.low, healthy_high)
        if episode.alarm is not None:
            picture.mark("mark", days[episode.alarm])
    for point in trend.repairs:
        picture.mark("mark other", point.day)
    for point in trend.points:
        if point.value is None:
            picture.symbol("absent", point.day, down=picture.height - 4.0)
            continue
        # another style for a recording with a note, and for one that is not comparable with the first group
        style = "point apart" if point.note else "point" if point.group == 0 else "point other"
        title = f"{point.file}: {point.value:.3g} {trend.unit}"
        low, high = (point.value if end is None else end for end in (point.low, point.high))
        picture.point(style, point.day, point.value, (low, high), title)
    pauses = find_pauses([point.day for point in trend.points])
    for episode in trend.episodes:
        for part in _cut_line(_fitted_line(days, episode), pauses):
            picture.line("course", *np.transpose(part))  # days and levels of the vertices


def find_pauses(days: list[float]) -> list[tuple[float, float]]:
    """Find the pauses between recordings, as (begin, end) [d], in which no line is drawn.

    `days` (n,): times of the recordings in order. A pause is longer than `PAUSE` times the median distance.
    """
    distances = np.diff(days)
    usual = float(np.median(distances[distances > 0.0])) if np.any(distances > 0.0) else math.inf
    return [(begin, end) for begin, end in pairwise(days) if end - begin > PAUSE * usual]


def _cut_line(
    vertices: list[tuple[float, float]], pauses: list[tuple[float, float]]
) -> Iterator[list[tuple[float, float]]]:
    """Cut a line with `vertices` (day, level), in the order of time, at the `pauses`; yield its parts."""
    days, levels = (list(values) for values in zip(*vertices, strict=True))
    begin = days[0]
    for pause_begin, pause_end in [*pauses, (days[-1], math.inf)]:
        if pause_begin < begin:
            continue
        end = min(pause_begin, days[-1])
        inner = [vertex for vertex in vertices if begin < vertex[0] < end]
        ends = [(day, float(np.interp(day, days, levels))) for day in (begin, end)]
        # at a step two vertices have one day: the part before it ends at the lower one
        yield [ends[0], *inner, ends[1] if end < days[-1] else vertices[-1]]
        begin = pause_end
        if begin > days[-1]:
            return


def _y_limits(trend: Trend) -> tuple[float, float]:
    """Compute the limits (low, high) of the leakage axis, which include intervals, healthy ranges and, in L/min, zero.

    The repair limit is included if it is below 2.5 times the highest of these, as a higher one would flatten the curve.
    """
    ends = [value for point in trend.points for value in (point.low, point.high) if value is not None]
    ends += [end for episode in trend.episodes for end in (episode.wear.healthy.low, episode.wear.healthy.high)]
    low, high = min(ends), max(ends)
    if trend.unit == "L/min":
        low = min(low, 0.0)
    if trend.limit is not None and trend.limit < 2.5 * high:
        high = max(high, trend.limit)
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin


def _fitted_line(days: list[float], episode: Episode) -> list[tuple[float, float]]:
    """Compute the vertices (day, leakage) of the line fitted to an episode.

    It ends with the last recording of the episode, at the leakage then (`Wear.total`): for the last episode, the
    present one. With an alarm and an onset it rises from the healthy level, linearly or in a step, else all along with
    the fitted growth. `days` [d]: times of the compared recordings (`Trend.rows`).
    """
    first, last, wear = days[episode.begin], days[episode.end - 1], episode.wear
    if episode.alarm is None or wear.onset is None:
        growth_per_month = wear.growth.value if math.isfinite(wear.growth.value) else 0.0
        start_level = wear.total.value - growth_per_month * (last - first) / DAYS_PER_MONTH
        return [(first, start_level), (last, wear.total.value)]
    onset = min(max(wear.onset.value, first), last)
    step_end = [(onset, wear.total.value)] if wear.step else []
    return [(first, wear.healthy.value), (onset, wear.healthy.value), *step_end, (last, wear.total.value)]
