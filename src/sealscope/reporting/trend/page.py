"""The page of a trend: one HTML file that works offline, for the screen and on paper."""

from __future__ import annotations

import os
from pathlib import Path

from sealscope.diagnosis.trend.trend import Trend
from sealscope.errors import InputError
from sealscope.reporting import messages, template
from sealscope.reporting.trend import text
from sealscope.reporting.trend.chart import SIZES, chart_of

_SUFFIXES = (".html", ".htm", ".pdf")


def check_trend_page(path: str | os.PathLike[str]) -> Path:
    """Return the path of a page to write; raises InputError for another kind of file."""
    if Path(path).suffix.lower() not in _SUFFIXES:
        raise InputError(f"the page of a trend must be a file {', '.join(_SUFFIXES)}, got {os.fspath(path)}")
    return Path(path)


def write_trend_page(path: str | os.PathLike[str], trend: Trend, *, title: str = "") -> Path:
    """Write the page of a trend, whole or not at all."""
    return template.write(check_trend_page(path), render_trend_page(trend, title=title))


def render_trend_page(trend: Trend, *, title: str = "") -> str:
    """Return the page of a trend as HTML."""
    count = len(trend.points)
    span = f", {text.moment(trend, trend.points[0].day)} to {text.moment(trend, trend.points[-1].day)}" if count else ""
    return template.render(
        "trend.html.j2",
        trend=trend,
        text=text,
        title=title or "Trend of a machine",
        subtitle=f"{count} recording{'' if count == 1 else 's'}{span}",
        n=messages.number,
        charts=[(size, chart) for size in SIZES if (chart := chart_of(trend, size)) is not None],
    )
