"""The page of a commissioned machine: its newest verdict, and all its recordings on one axis of time."""

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
    """A diagnosis, the start of its recording [s since 1970] or None, and a function to read it again."""

    diagnosis: Diagnosis
    start_s: float | None
    read: Callable[[], Recording]


#: What a recording states of the leak [L/min]: figure, ends of its interval; a bound where the lower one is None.
_Level = tuple[float, float | None, float]


def write_history_page(
    path: str | os.PathLike[str], judged: Sequence[Judged], *, title: str, left_out: int = 0
) -> Path:
    """Write the page of a machine, whole or not at all; arguments and errors as for `render_history_page`."""
    return template.write(template.check_page(path, card=False), render_history_page(judged, title, left_out))


def render_history_page(judged: Sequence[Judged], title: str, left_out: int = 0) -> str:
    """Return the page of a machine as HTML: its recordings and their diagnoses, in any order.

    `title`: name of the machine; `left_out`: files that could not be read. Raises InputError without a recording.
    """
    if not judged:
        raise InputError("the page of a machine must have at least 1 recording, got 0")
    ordered = sorted(
        judged, key=lambda entry: (-math.inf if entry.start_s is None else entry.start_s, entry.diagnosis.file)
    )
    newest = ordered[-1].diagnosis
    dates = _dates(ordered)
    shown, drawn, files = _overlay(ordered)
    rows = [
        {"file": Path(entry.diagnosis.file).name, "date": date, "d": entry.diagnosis}
        for entry, date in zip(ordered, dates, strict=True)
    ]
    return template.render(
        "history.html.j2",
        d=newest,
        messages=messages,
        title=title,
        rows=rows[::-1],
        undated=sum(entry.start_s is None for entry in ordered),
        left_out=left_out,
        levels=history_pictures(ordered),
        charts=shown,
        drawn=drawn,
        files=files,
        chart_data=None if drawn is None else drawn.data,
    )


def history_pictures(ordered: Sequence[Judged]) -> dict[str, Picture] | None:
    """Return the pictures of recordings in their order.

    Days of their dates, numbers from 1 where a date is not known. None where no recording states a figure or a bound.
    """
    levels = [_level(entry.diagnosis) for entry in ordered]
    known = [level for level in levels if level is not None]
    if not known:
        return None
    dated = all(entry.start_s is not None for entry in ordered)
    days = [(entry.start_s or 0.0) / DAY if dated else float(k + 1) for k, entry in enumerate(ordered)]
    limit = ordered[-1].diagnosis.limit_lpm
    far = 8.0 * float(np.median([lpm for lpm, *_ in known])) or math.inf  # beyond it others would be pressed flat
    near = [value for lpm, _, high in known for value in (lpm, high) if value <= far and value < math.inf]
    near += [] if limit is None or limit > far else [limit]
    top = 1.08 * max(near, default=0.0) or 1.0

    def moment(day: float) -> str:
        return stamp(day * DAY, days[-1] - days[0]) if dated else f"{day:g}" if day.is_integer() else ""

    def draw(picture: Picture) -> None:
        for entry, day, level in zip(ordered, days, levels, strict=True):
            if level is None:
                picture.symbol("absent", day, picture.height - 4.0)
                continue
            lpm, low, high = level
            title = f"{Path(entry.diagnosis.file).name}: {messages.flow(entry.diagnosis)}"
            if lpm > top:
                picture.symbol("beyond", day, 6.0, title)
            elif low is None:
                picture.symbol("bound", day, float(picture.y(lpm)), title)
            else:
                picture.point("point", day, lpm, (low, min(high, top)), title)

    return level_pictures((days[0], days[-1]), (0.0, top), limit, moment, draw)


def _level(diagnosis: Diagnosis) -> _Level | None:
    leak, bound = diagnosis.leak_lpm, diagnosis.bound_lpm
    if diagnosis.verdict != "leak":
        return None if bound is None or not math.isfinite(bound) else (bound, None, bound)
    if leak is None or not math.isfinite(leak):
        return None
    low, high = diagnosis.leak_interval_lpm or (leak, leak)
    return leak, low if math.isfinite(low) else 0.0, high


def _dates(ordered: Sequence[Judged]) -> list[str]:
    known = [entry.start_s for entry in ordered if entry.start_s is not None]
    span = (max(known) - min(known)) / DAY if known else 0.0
    return [messages.ABSENT if entry.start_s is None else stamp(entry.start_s, span) for entry in ordered]


def _overlay(ordered: Sequence[Judged]) -> tuple[list[charts.Chart], charts.DrawnCharts | None, list[str]]:
    """Draw the newest recording's channels, with those of the last earlier one judged `no leak` over them.

    Both begin together. With them the two files; nothing where there is no other recording, or no channel of both.
    """
    *before, newest = ordered
    healthy = [latest for latest in before if latest.diagnosis.verdict == "no leak"]
    if not before:
        return [], None, []
    reference = (healthy or before)[-1]
    latest, other = newest.read(), reference.read()
    if not all(recording.t.size and np.all(np.diff(recording.t) > 0.0) for recording in (latest, other)):
        return [], None, []
    files = [Path(judged.diagnosis.file).name for judged in (newest, reference)]
    t = other.t - other.t[0] + latest.t[0]
    shown = []
    for name in latest.channels:
        if name not in other or latest.units[name] != other.units[name]:
            continue
        pressure_unit = latest.pressure_unit
        unit, values = charts.shown_values(latest, name, pressure_unit)
        over = replace(latest, channels={name: np.interp(latest.t, t, other[name], left=np.nan, right=np.nan)})
        values_over = charts.shown_values(over, name, pressure_unit)[1]
        lines = (charts.ChartLine(files[0], "a", values), charts.ChartLine(files[1], "b", values_over))
        shown.append(charts.Chart(f"over-{name}", "channels", name, unit, lines))
    return (shown, charts.draw(latest, [], shown, newest.diagnosis, []), files) if shown else ([], None, [])
