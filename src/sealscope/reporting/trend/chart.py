"""The chart of a trend: recordings with their intervals, the healthy band, the course and the limit, as SVG."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from sealscope.diagnosis.trend.trend import Trend
from sealscope.diagnosis.trend.wear import MONTH, Episode
from sealscope.reporting.picture import ticks
from sealscope.reporting.trend.text import moment

#: Sizes of the picture: for a screen, and for a telephone.
SIZES = {"wide": (900.0, 320.0), "narrow": (420.0, 300.0)}
#: The limit is drawn where it is below so many times the highest level; else it is named only.
_NEAR = 2.5
_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 12.0, 14.0, 26.0
#: Distances between two ticks: minutes, hours, days; in days.
_STEPS = (*(m / 1440 for m in (1, 5, 15, 60, 180, 360)), 1, 2, 7, 14, 30, 61, 91, 182, 365, 730, 1826)


@dataclass(frozen=True)
class Scale:
    """Where days and levels stand in a picture of `width` x `height`, inside its frame."""

    width: float
    height: float
    days: tuple[float, float]
    levels: tuple[float, float]

    @property
    def frame(self) -> dict[str, float]:
        """Size of the picture and sides of its frame, as a template draws them."""
        sides = {"left": _LEFT, "right": self.width - _RIGHT, "top": _TOP, "bottom": self.height - _BOTTOM}
        return {"width": self.width, "height": self.height, **sides}

    def x(self, day: float) -> float:
        """Return where a day stands."""
        first, last = self.days
        return _LEFT + (day - first) / (last - first) * (self.width - _LEFT - _RIGHT)

    def y(self, level: float) -> float:
        """Return where a level stands."""
        low, high = self.levels
        return _TOP + (high - level) / (high - low) * (self.height - _TOP - _BOTTOM)


def chart_of(trend: Trend, size: str) -> dict[str, Any] | None:
    """Return what the template draws, in a box of one of `SIZES`; None where no recording states a level."""
    known = [point for point in trend.points if point.value is not None]
    if not known or trend.wear is None:
        return None
    scale = Scale(*SIZES[size], with_margin(trend.points[0].day, trend.points[-1].day), _levels(trend))
    low, high = scale.levels
    points = [
        {
            "x": scale.x(point.day),
            "y": scale.y(point.value or 0.0),
            "low": scale.y(max(point.low or 0.0, low)),
            "high": scale.y(min(point.high or 0.0, high)),
            "kind": "apart" if point.note else "first" if point.group == 0 else "other",
            "title": f"{point.file}: {point.value:.3g} {trend.unit}",
        }
        for point in known
    ]
    course, bands = [], []
    for number, own in enumerate(trend.episodes):
        line = _course(trend, own)
        course.append("M" + "L".join(f"{scale.x(day):.1f} {scale.y(level):.1f}" for day, level in line))
        end = trend.episodes[number + 1].begin if number + 1 < len(trend.episodes) else None
        left, right = scale.x(line[0][0]), scale.x(line[-1][0] if end is None else trend.points[trend.rows[end]].day)
        top, bottom = scale.y(min(own.wear.healthy.high, high)), scale.y(max(own.wear.healthy.low, low))
        bands.append({"x": left, "width": max(right - left, 2.0), "y": top, "height": max(bottom - top, 1.0)})
    limit = None if trend.limit is None or trend.limit > high else scale.y(trend.limit)
    marks = [
        {"x": scale.x(trend.points[trend.rows[own.alarm]].day), "kind": ""}
        for own in trend.episodes
        if own.alarm is not None
    ]
    marks += [{"x": scale.x(point.day), "kind": "other"} for point in trend.repairs]
    return {
        **scale.frame,
        "points": points,
        "course": course,
        "bands": bands,
        "limit": limit,
        "marks": marks,
        "bounds": [],
        "beyond": [],
        "absent": [scale.x(point.day) for point in trend.points if point.value is None],
        "x_ticks": [(scale.x(day), moment(trend, day)) for day in day_ticks(scale, trend.points[0].day)],
        "y_ticks": [(scale.y(level), f"{level:.6g}") for level in ticks(low, high, 4)],
    }


def with_margin(first: float, last: float) -> tuple[float, float]:
    """Return the ends of the axis of days from the first to the last."""
    margin = 0.02 * (last - first) or 0.5
    return first - margin, last + margin


def _levels(trend: Trend) -> tuple[float, float]:
    ends = [value for point in trend.points for value in (point.low, point.high) if value is not None]
    ends += [end for own in trend.episodes for end in (own.wear.healthy.low, own.wear.healthy.high)]
    low, high = min(ends), max(ends)
    if trend.unit == "L/min":
        low = min(low, 0.0)
    if trend.limit is not None and trend.limit < _NEAR * high:
        high = max(high, trend.limit)
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin


def _course(trend: Trend, own: Episode) -> list[tuple[float, float]]:
    """Return corners (day, level) of the course that a stretch is described by."""
    first, last = trend.points[trend.rows[own.begin]].day, trend.points[trend.rows[own.end - 1]].day
    wear = own.wear
    if own.alarm is None or wear.onset is None:
        rise = wear.growth.value if math.isfinite(wear.growth.value) else 0.0
        return [(first, wear.now.value - rise * (last - first) / MONTH), (last, wear.now.value)]
    onset = min(max(wear.onset.value, first), last)
    corners = [(first, wear.healthy.value), (onset, wear.healthy.value)]
    return (
        [*corners, (onset, wear.now.value), (last, wear.now.value)] if wear.step else [*corners, (last, wear.now.value)]
    )


def day_ticks(scale: Scale, origin: float) -> list[float]:
    """Return days for ticks, round distances from `origin` apart, as many as have room."""
    first, last = scale.days
    most = scale.width / 110.0
    step = next((step for step in _STEPS if (last - first) / step <= most), _STEPS[-1])
    begin = math.ceil((first - origin) / step - 1e-9)
    return [origin + step * k for k in range(begin, math.floor((last - origin) / step) + 1)]
