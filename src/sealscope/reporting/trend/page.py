"""The page of a trend: one HTML file that works offline; recordings, healthy band, course and limit as SVG."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sealscope.diagnosis.trend.trend import Trend
from sealscope.diagnosis.trend.wear import MONTH, Episode
from sealscope.reporting import messages, template
from sealscope.reporting.picture import ticks
from sealscope.reporting.trend import text

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
        charts=[(size, chart) for size in SIZES if (chart := chart_of(trend, size)) is not None],
    )


@dataclass(frozen=True)
class Scale:
    """Where days and levels stand in a picture of one of `SIZES`, inside its frame."""

    size: str
    days: tuple[float, float]
    levels: tuple[float, float]

    def x(self, day: float) -> float:
        """Return where a day stands."""
        (first, last), width = self.days, SIZES[self.size][0]
        return _LEFT + (day - first) / (last - first) * (width - _LEFT - _RIGHT)

    def y(self, level: float) -> float:
        """Return where a level stands; at the frame where it is beyond."""
        (low, high), height = self.levels, SIZES[self.size][1]
        return _TOP + (high - min(max(level, low), high)) / (high - low) * (height - _TOP - _BOTTOM)

    def limit(self, level: float | None) -> float | None:
        """Return where a limit stands, None for one above the frame."""
        return None if level is None or level > self.levels[1] else self.y(level)

    def day_ticks(self, origin: float) -> list[float]:
        """Return days for ticks, round distances from `origin` apart, as many as have room."""
        first, last = self.days
        most = SIZES[self.size][0] / 110.0
        step = next((step for step in _STEPS if (last - first) / step <= most), _STEPS[-1])
        begin = math.ceil((first - origin) / step - 1e-9)
        return [origin + step * k for k in range(begin, math.floor((last - origin) / step) + 1)]

    def picture(self, x_ticks: list[tuple[float, str]], **shown: Any) -> dict[str, Any]:
        """Return what the template draws: the frame, its ticks, and what is shown in it."""
        width, height = SIZES[self.size]
        nothing = {name: () for name in ("points", "course", "bands", "marks", "bounds", "beyond", "absent")}
        return {
            "width": width,
            "height": height,
            "left": _LEFT,
            "right": width - _RIGHT,
            "top": _TOP,
            "bottom": height - _BOTTOM,
            "x_ticks": x_ticks,
            "y_ticks": [(self.y(level), f"{level:.6g}") for level in ticks(*self.levels, 4)],
            **nothing,
            **shown,
        }


def chart_of(trend: Trend, size: str) -> dict[str, Any] | None:
    """Return what the template draws, in a box of one of `SIZES`; None where no recording states a level."""
    known = [point for point in trend.points if point.value is not None]
    if not known or trend.wear is None:
        return None
    scale = Scale(size, with_margin(trend.points[0].day, trend.points[-1].day), _levels(trend))
    points = [
        {
            "x": scale.x(point.day),
            "y": scale.y(point.value or 0.0),
            "low": scale.y(point.low or 0.0),
            "high": scale.y(point.high or 0.0),
            "kind": "apart" if point.note else "first" if point.group == 0 else "other",
            "title": f"{point.file}: {point.value:.3g} {trend.unit}",
        }
        for point in known
    ]
    days = [trend.points[row].day for row in trend.rows]
    course, bands, marks = [], [], []
    for own in trend.episodes:
        line, healthy = _course(days, own), own.wear.healthy
        course.append("M" + "L".join(f"{scale.x(day):.1f} {scale.y(level):.1f}" for day, level in line))
        left, right = scale.x(days[own.begin]), scale.x(days[min(own.end, len(days) - 1)])
        top, bottom = scale.y(healthy.high), scale.y(healthy.low)
        bands.append({"x": left, "width": max(right - left, 2.0), "y": top, "height": max(bottom - top, 1.0)})
        marks += [] if own.alarm is None else [{"x": scale.x(days[own.alarm]), "kind": ""}]
    marks += [{"x": scale.x(point.day), "kind": "other"} for point in trend.repairs]
    return scale.picture(
        [(scale.x(day), text.moment(trend, day)) for day in scale.day_ticks(trend.points[0].day)],
        points=points,
        course=course,
        bands=bands,
        marks=marks,
        limit=scale.limit(trend.limit),
        absent=[scale.x(point.day) for point in trend.points if point.value is None],
    )


def with_margin(first: float, last: float) -> tuple[float, float]:
    """Return the ends of the axis of days from the first to the last."""
    margin = 0.02 * (last - first) or 0.5
    return first - margin, last + margin


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
        return [(first, wear.now.value - rise * (last - first) / MONTH), (last, wear.now.value)]
    onset = min(max(wear.onset.value, first), last)
    stepped = [(onset, wear.now.value)] if wear.step else []
    return [(first, wear.healthy.value), (onset, wear.healthy.value), *stepped, (last, wear.now.value)]
