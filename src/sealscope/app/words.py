"""What the tables of the workbench say of a log in words: its date, its length, its duty, and which duty was seen."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

#: Bins of a figure of the duty, and least width of all of them as a fraction of the largest value.
_BINS, _LEAST_SPAN = 6, 0.2
#: Figures of the duty: key, name, unit ("" for that of the log), factor to the unit.
_DUTIES = (
    ("oil_degC", "Oil temperature", "°C", 1.0),
    ("load_bar", "Load", "bar", 1.0),
    ("speed", "Speed", "", 1.0),
    ("moving", "Share in motion", "%", 100.0),
    ("minutes", "Length", "min", 1.0),
)


def format_date(row: Mapping[str, Any]) -> str:
    """Format when a log begins, with the zone that it states; else when its file was written, in the local time."""
    if (start := row.get("start_s")) is not None:
        zone = str(row.get("zone") or "")
        offset = datetime.fromisoformat(f"2000-01-01T00:00{zone}").tzinfo if zone not in ("", "Z") else UTC
        text = f"{datetime.fromtimestamp(start, offset):%Y-%m-%d %H:%M:%S}"
        return f"{text} ({'logger’s clock' if not zone else 'UTC' if zone == 'Z' else zone})"
    if (changed := row.get("changed_s")) is None:
        return "no date"
    local = datetime.fromtimestamp(changed, UTC).astimezone()
    return f"file of {local:%Y-%m-%d %H:%M:%S} (local time)"


def format_length(seconds: float) -> str:
    """Format a duration [s] in seconds, minutes or hours with three digits."""
    for unit, size in (("s", 1.0), ("min", 60.0)):
        if seconds < 120.0 * size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 3600.0:.3g} h"


def _duty_value(row: Mapping[str, Any], key: str, factor: float) -> float | None:
    value = row["duty"][key]
    return None if value is None else factor * value


def format_duty(row: Mapping[str, Any]) -> str:
    """Format the duty of a log, a dash for what is not known."""
    texts = []
    for key, _, unit, factor in _DUTIES:
        value = _duty_value(row, key, factor)
        shown = f"{value:.3g} {unit or row['duty']['speed_unit']}" if value is not None else "–"
        texts.append(format_length(60.0 * value) if key == "minutes" and value is not None else shown)
    return " · ".join(texts)


def cover_duty(rows: Sequence[Mapping[str, Any]], healthy: Collection[str]) -> list[dict[str, Any]]:
    """Count the healthy and the other logs in bins of each figure of the duty.

    `rows`: the logs that were read; `healthy`: keys of the healthy ones. Returns name, unit, ends of the bins, and for
    each bin the numbers of both; without bins if no log shows the figure. Equal days fall into one bin.
    """
    covered = []
    for key, name, unit, factor in _DUTIES:
        known = [(row, value) for row in rows if (value := _duty_value(row, key, factor)) is not None]
        cover: dict[str, Any] = {"name": name, "unit": unit, "edges": [], "counts": []}
        covered.append(cover)
        if not known:
            continue
        if not unit:
            cover["unit"] = known[0][0]["duty"]["speed_unit"]
        values = [value for _, value in known]
        low, high = min(values), max(values)
        half = 0.5 * max(high - low, _LEAST_SPAN * max(abs(low), abs(high)), 1e-9)
        first, width = 0.5 * (low + high) - half, 2.0 * half / _BINS
        cover["edges"] = [float(f"{first + k * width:.3g}") for k in range(_BINS + 1)]
        cover["counts"] = [[0, 0] for _ in range(_BINS)]
        for row, value in known:
            bin_counts = cover["counts"][max(0, min(_BINS - 1, int((value - first) / width)))]
            bin_counts[row["key"] not in healthy] += 1
    return covered
