"""The tables of a campaign's page beside the main one: onsets, flows, causes, as text."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sealscope.campaigns.judging.judge import Judgement
from sealscope.campaigns.judging.tables import attribute_of
from sealscope.evaluation.binomial import IntervalEstimate, Proportion


def percent(proportion: Proportion | None) -> str:
    """Return a proportion with its interval in per cent, a dash where nothing is known."""
    if proportion is None or proportion.n == 0:
        return "–"
    return f"{_p(proportion.value)} % ({_p(proportion.low)}–{_p(proportion.high)})"


def _p(share: float) -> str:
    value = 100.0 * share
    digits = 2 if value < 9.95 else 0 if value > 99.95 or value == round(value) else 1
    return f"{value:.{digits}f}"


class PageTable(NamedTuple):
    """A table of the page: `words`, how many columns of text stand first; `about`: what it shows, in a sentence."""

    id: str
    title: str
    about: str
    heads: list[str]
    rows: list[tuple[str, ...]]
    words: int = 1


def page_tables(judgement: Judgement, unit: str, part: str = "") -> dict[str, PageTable]:
    """Return the tables of statements, faults and families by name, without the empty ones."""
    tables = {}
    for name, layout in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")).items():
        columns = layout["columns"]
        rows = [tuple(_cell(row, content) for content in columns.values()) for row in getattr(judgement, name)]
        if rows:
            title = layout["title"].format(part=f" ({part})" if part else "")
            heads = [head.format(unit=unit) for head in columns]
            tables[name] = PageTable(name, title, layout["about"], heads, rows, layout.get("words", 1))
    return tables


def _cell(row: Any, content: str) -> str:
    """Format one cell of a row by the layout of its column."""
    how, _, path = content.rpartition(" ")
    value = attribute_of(row, path)
    return _FORMATS[how](value) if how in _FORMATS else format(value, how)


class CauseTable(NamedTuple):
    """The causes named by one detector (`columns`) for each true cause: its name, its records, the share of each.

    `right`: records whose cause is named alone; `covered`: alone or with the one that no channel tells from it.
    """

    detector: str
    columns: tuple[str, ...]
    rows: list[tuple[str, int, list[str]]]
    right: str
    covered: str


def cause_tables(judgement: Judgement) -> list[CauseTable]:
    """Tabulate the causes named by each detector, for each true cause."""
    tables = []
    for causes in judgement.causes:
        confusion = causes.confusion
        every = zip(confusion.rows, confusion.counts, confusion.shares, strict=True)
        rows = [(name, int(counts.sum()), [*map(_share, shares)]) for name, counts, shares in every if counts.any()]
        right, covered = percent(confusion.accuracy), percent(causes.covered)
        tables.append(CauseTable(causes.detector, confusion.columns, rows, right, covered))
    return tables


def _share(proportion: Proportion) -> str:
    return f"{100 * proportion.value:.0f} %" if proportion.count else "·"


def _quantile(quantile: IntervalEstimate) -> str:
    if not math.isfinite(quantile.value):
        return "–"
    if not (math.isfinite(quantile.low) or math.isfinite(quantile.high)):
        return f"{quantile.value:.2g}"
    ends = [f"{end:.2g}" if math.isfinite(end) else "–" for end in (quantile.low, quantile.high)]
    return f"{quantile.value:.2g} ({ends[0]}–{ends[1]})"


_FORMATS: Mapping[str, Callable[[Any], str]] = {
    "size": lambda size: f"{size:g}" if size else "no leak",
    "percent": percent,
    "quantile": _quantile,
}
