"""The page of a trend: one HTML file that works offline; recordings, healthy band, course and limit as SVG."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.diagnosis.trend.trend import Trend
from sealscope.diagnosis.trend.wear import Episode
from sealscope.reporting import messages, template
from sealscope.reporting.picture import Scale
from sealscope.reporting.trend import text
from sealscope.units import DAYS_PER_MONTH

#: Sizes of the picture: for a screen, and for a telephone; the margins round its frame.
SIZES = {"wide": (900.0, 320.0), "narrow": (420.0, 300.0)}
_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 12.0, 14.0, 26.0
#: Distances between two ticks: minutes, hours, days; in days.
_STEPS = (*(m / 1440 for m in (1, 5, 15, 60, 180, 360)), 1, 2, 7, 14, 30, 61, 91, 182, 365, 730, 1826)


def write_trend_page(path: str | os.PathLike[str], trend: Trend, *, title: str = "") -> Path:
    """Write the page of a trend, whole or not at all."""
    return template.write(template.check_page(path, card=False), render_trend_page(trend, title=title))


def render_trend_page(trend: Trend, *, title: str = "") -> str:
    """Return the page of a trend as HTML."""
    return template.render(
        "trend.html.j2",
        trend=trend,
        text=text,
        figures=text.figures(trend),
        title=title or "Trend of a machine",
        n=messages.number,
        chart=chart_of(trend),
    )


def level_chart(
    days: tuple[float, float],
    levels: tuple[float, float],
    limit: float | None,
    moment: Callable[[float], str],
    **shown: list[Any],
) -> dict[str, Any]:
    """Return levels over days as the template draws them: what is shown, and the picture of each of `SIZES`.

    `days`: of the first and the last recording, with a tick at the first; `levels`: ends of the axis; `limit`: drawn
    where it is on the axis; `moment`: a day in words; `shown`: points, bands and the like, in days and levels.
    """
    margin = 0.02 * (days[1] - days[0]) or 0.5
    first, last = days[0] - margin, days[1] + margin
    pictures = []
    for size, (width, height) in SIZES.items():
        scale = Scale(width - _LEFT - _RIGHT, height - _TOP - _BOTTOM, (first, last), levels)
        step = next((step for step in _STEPS if (last - first) / step <= width / 110.0), _STEPS[-1])
        ticks_of_days = np.arange(days[0], last, step).tolist()
        pictures.append(
            {
                "size": size,
                "width": width,
                "height": height,
                "left": _LEFT,
                "top": _TOP,
                "scale": scale,
                "x_ticks": [(float(scale.x(day)), moment(day)) for day in ticks_of_days],
                "y_ticks": scale.ticks(1, 4)["y_ticks"],
            }
        )
    nothing = {name: () for name in ("points", "course", "bands", "marks", "bounds", "beyond", "absent")}
    return {"pictures": pictures, "limit": None if limit is None or limit > levels[1] else limit, **nothing, **shown}


def chart_of(trend: Trend) -> dict[str, Any] | None:
    """Return what the template draws of a trend; None where no recording states a level."""
    known = [point for point in trend.points if point.value is not None]
    if not known or trend.wear is None:
        return None
    points = [
        {
            "day": point.day,
            "level": point.value,
            "low": point.low or 0.0,
            "high": point.high or 0.0,
            "kind": "apart" if point.note else "first" if point.group == 0 else "other",
            "title": f"{point.file}: {point.value:.3g} {trend.unit}",
        }
        for point in known
    ]
    days = [trend.points[row].day for row in trend.rows]
    bands = [
        (days[own.begin], days[min(own.end, len(days) - 1)], own.wear.healthy.low, own.wear.healthy.high)
        for own in trend.episodes
    ]
    marks = [(days[own.alarm], "") for own in trend.episodes if own.alarm is not None]
    return level_chart(
        (trend.points[0].day, trend.points[-1].day),
        _levels(trend),
        trend.limit,
        partial(text.moment, trend),
        points=points,
        course=[np.transpose(_course(days, own)) for own in trend.episodes],
        bands=bands,
        marks=[*marks, *((point.day, "other") for point in trend.repairs)],
        absent=[point.day for point in trend.points if point.value is None],
    )


def _levels(trend: Trend) -> tuple[float, float]:
    """Return the ends of the axis of levels: a limit is on it where it is near."""
    ends = [value for point in trend.points for value in (point.low, point.high) if value is not None]
    ends += [end for own in trend.episodes for end in (own.wear.healthy.low, own.wear.healthy.high)]
    low, high = min(ends), max(ends)
    if trend.unit == "L/min":
        low = min(low, 0.0)
    if trend.limit is not None and trend.limit < 2.5 * high:
        high = max(high, trend.limit)
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin


def _course(days: list[float], own: Episode) -> list[tuple[float, float]]:
    """Return corners (day, level) of the course that a stretch is described by."""
    first, last, wear = days[own.begin], days[own.end - 1], own.wear
    if own.alarm is None or wear.onset is None:
        rise = wear.growth.value if math.isfinite(wear.growth.value) else 0.0
        return [(first, wear.now.value - rise * (last - first) / DAYS_PER_MONTH), (last, wear.now.value)]
    onset = min(max(wear.onset.value, first), last)
    stepped = [(onset, wear.now.value)] if wear.step else []
    return [(first, wear.healthy.value), (onset, wear.healthy.value), *stepped, (last, wear.now.value)]
