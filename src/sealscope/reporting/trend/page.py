"""The page of a trend: one HTML file that works offline, for the screen and on paper."""

from __future__ import annotations

import os
from pathlib import Path

from sealscope.diagnosis.trend.trend import Trend
from sealscope.recordings.formats.columns import counted
from sealscope.reporting import messages, template
from sealscope.reporting.trend import text
from sealscope.reporting.trend.chart import SIZES, chart_of


def write_trend_page(path: str | os.PathLike[str], trend: Trend, *, title: str = "") -> Path:
    """Write the page of a trend, whole or not at all."""
    return template.write(template.check_page(path, card=False), render_trend_page(trend, title=title))


def render_trend_page(trend: Trend, *, title: str = "") -> str:
    """Return the page of a trend as HTML."""
    count = len(trend.points)
    span = f", {text.moment(trend, trend.points[0].day)} to {text.moment(trend, trend.points[-1].day)}" if count else ""
    return template.render(
        "trend.html.j2",
        trend=trend,
        text=text,
        title=title or "Trend of a machine",
        subtitle=f"{counted(count, 'recording')}{span}",
        n=messages.number,
        charts=[(size, chart) for size in SIZES if (chart := chart_of(trend, size)) is not None],
    )
