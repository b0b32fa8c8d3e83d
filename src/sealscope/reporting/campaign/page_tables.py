"""Build the smaller tables of a campaign's page as text: errors of onsets and flows, faults, families and causes."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sealscope.campaigns.judging.judge import Judgement
from sealscope.campaigns.judging.tables import resolve_attribute
from sealscope.evaluation.binomial import IntervalEstimate, Proportion


def percent(proportion: Proportion | None) -> str:
    """Format a proportion with its interval, such as "98.5 % (95.1–99.6)"; a dash for None or without records."""
    if proportion is None or proportion.n == 0:
        return "–"
    value, low, high = map(_format_percent, (proportion.value, proportion.low, proportion.high))
    return f"{value} % ({low}–{high})"


def _format_percent(fraction: float) -> str:
    """Format a fraction in percent: two decimals below 9.95, else one, or none if it is whole or above 99.95."""
    value = 100.0 * fraction
    digits = 2 if value < 9.95 else 0 if value > 99.95 or value == round(value) else 1
    return f"{value:.{digits}f}"


def page_tables(judgement: Judgement, unit: str, part: str = "") -> dict[str, dict[str, Any]]:
    """Build the template's values for the tables of `page_tables.toml` that are not empty, by name.

    `words` is the number of leading columns with text, not numbers. `unit`: of the leak sizes; `part`: purpose of the
    campaign, such as "development", "" if not stated.
    """
    tables = {}
    for name, layout in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")).items():
        columns = layout["columns"]
        rows = [tuple(_format_cell(row, content) for content in columns.values()) for row in getattr(judgement, name)]
        if rows:
            tables[name] = {
                "id": name,
                "title": layout["title"].format(part=f" ({part})" if part else ""),
                "about": layout["about"],
                "heads": [head.format(unit=unit) for head in columns],
                "rows": rows,
                "words": layout.get("words", 1),
            }
    return tables


def _format_cell(row: Any, content: str) -> str:
    """Format the value of one cell, which is an attribute of `row`.

    `content`: optional format, an entry of `_FORMATS` or a format specification of Python, and path of the attribute.
    """
    format_name, _, path = content.rpartition(" ")
    value = resolve_attribute(row, path)
    return _FORMATS[format_name](value) if format_name in _FORMATS else format(value, format_name)


def cause_tables(judgement: Judgement) -> list[dict[str, Any]]:
    """Build the template's values for a table of each detector: fractions of records by true cause and by named cause.

    `rows`: true cause, number of its records, and fraction of them for each named cause (`columns`); `right`,
    `covered`: fractions of all records for which the true cause is named, alone and also within an ambiguous one.
    """
    tables = []
    for causes in judgement.causes:
        confusion = causes.confusion
        confusion_rows = zip(confusion.rows, confusion.counts, confusion.shares, strict=True)
        rows = [
            (name, int(counts.sum()), [f"{100 * share.value:.0f} %" if share.count else "·" for share in shares])
            for name, counts, shares in confusion_rows
            if counts.any()  # else no record has this cause
        ]
        rates = {"right": percent(confusion.accuracy), "covered": percent(causes.covered)}
        tables.append({"detector": causes.detector, "columns": confusion.columns, "rows": rows, **rates})
    return tables


def _format_quantile(quantile: IntervalEstimate) -> str:
    """Format a quantile, with its interval if an end is finite, such as "1.2 (0.9–1.8)"; a dash if it is not finite."""
    if not math.isfinite(quantile.value):
        return "–"
    if not (math.isfinite(quantile.low) or math.isfinite(quantile.high)):
        return f"{quantile.value:.2g}"
    ends = [f"{end:.2g}" if math.isfinite(end) else "–" for end in (quantile.low, quantile.high)]
    return f"{quantile.value:.2g} ({ends[0]}–{ends[1]})"


_FORMATS: Mapping[str, Callable[[Any], str]] = {
    "size": lambda size: f"{size:g}" if size else "no leak",
    "percent": percent,
    "quantile": _format_quantile,
}
