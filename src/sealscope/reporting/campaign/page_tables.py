"""Build the smaller tables of a campaign's page as text: errors of onsets and flows, faults, families and causes."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

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


class PageTable(NamedTuple):
    """A table of the campaign's page.

    `id`: identifier in the HTML; `about`: description; `heads`: of the columns; `rows`: cells as text; `words`: number
    of leading columns with text, not numbers.
    """

    id: str
    title: str
    about: str
    heads: list[str]
    rows: list[tuple[str, ...]]
    words: int = 1


def page_tables(judgement: Judgement, unit: str, part: str = "") -> dict[str, PageTable]:
    """Build the tables of `page_tables.toml` that are not empty, by name.

    `unit`: unit of the leak sizes; `part`: purpose of the campaign, such as "development", "" if not stated.
    """
    tables = {}
    for name, layout in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")).items():
        columns = layout["columns"]
        rows = [tuple(_format_cell(row, content) for content in columns.values()) for row in getattr(judgement, name)]
        if rows:
            title = layout["title"].format(part=f" ({part})" if part else "")
            heads = [head.format(unit=unit) for head in columns]
            tables[name] = PageTable(name, title, layout["about"], heads, rows, layout.get("words", 1))
    return tables


def _format_cell(row: Any, content: str) -> str:
    """Format the value of one cell, which is an attribute of `row`.

    `content`: optional format, an entry of `_FORMATS` or a format specification of Python, and path of the attribute.
    """
    format_name, _, path = content.rpartition(" ")
    value = resolve_attribute(row, path)
    return _FORMATS[format_name](value) if format_name in _FORMATS else format(value, format_name)


class CauseTable(NamedTuple):
    """The table of the causes that one detector names, as text.

    `columns`: named causes; `rows`: true cause, number of its records, and fraction of them for each named cause;
    `right`, `covered`: fractions of all records for which the true cause is named, alone and also within an ambiguous
    one.
    """

    detector: str
    columns: tuple[str, ...]
    rows: list[tuple[str, int, list[str]]]
    right: str
    covered: str


def cause_tables(judgement: Judgement) -> list[CauseTable]:
    """Build a table for each detector: fractions of records by true cause (rows) and by named cause (columns)."""
    tables = []
    for causes in judgement.causes:
        confusion = causes.confusion
        confusion_rows = zip(confusion.rows, confusion.counts, confusion.shares, strict=True)
        rows = [
            (name, int(counts.sum()), [f"{100 * share.value:.0f} %" if share.count else "·" for share in shares])
            for name, counts, shares in confusion_rows
            if counts.any()  # else no record has this cause
        ]
        right, covered = percent(confusion.accuracy), percent(causes.covered)
        tables.append(CauseTable(causes.detector, confusion.columns, rows, right, covered))
    return tables


def _format_quantile(quantile: IntervalEstimate) -> str:
    """Format a quantile with its interval, such as "1.2 (0.9–1.8)"; a number that is not finite is a dash."""
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
