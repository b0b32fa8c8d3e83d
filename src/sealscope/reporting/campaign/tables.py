"""The tables of a campaign's page beside the main one: onsets, flows, causes, as text."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import NamedTuple

from sealscope.campaigns.judging.judge import Judgement
from sealscope.evaluation.binomial import IntervalEstimate, Proportion


def percent(proportion: Proportion | None) -> str:
    """Return a proportion with its interval in per cent, a dash where nothing is known."""
    if proportion is None or proportion.n == 0:
        return "–"
    return f"{_p(proportion.value)} % ({_p(proportion.low)}–{_p(proportion.high)})"


def _of(proportion: Proportion | None) -> str:
    return "–" if proportion is None else f"{proportion.count} of {proportion.n}"


def _counted(proportion: Proportion | None) -> str:
    return _of(proportion) if proportion is None or not proportion.n else f"{_of(proportion)}, {percent(proportion)}"


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
    """Return the tables of what detectors state and of faults and families, by name; those that have rows."""
    rows: dict[str, list[tuple[str, ...]]] = {
        "flows": [
            (
                of.detector, f"{of.leak_lpm:g}" if of.leak_lpm else "no leak", str(of.errors.n),
                f"{of.errors.bias.value:+.2g}", f"{of.errors.median_size.value:.2g}", percent(of.errors.coverage),
            )
            for of in judgement.flows
        ],
        "families": [
            (
                of.detector, of.family, f"{of.leak_lpm:g} {of.law}" if of.leak_lpm else "no leak",
                percent(of.alarms), percent(of.cannot_tell), percent(of.coverage), _of(of.reachable),
                _counted(of.allowed),
            )
            for of in judgement.families
        ],
        "onsets": [
            (
                of.detector, f"{of.leak_lpm:g}", str(of.errors.n), _quantile(of.errors.median_size),
                percent(of.errors.coverage),
            )
            for of in judgement.onsets
        ],
        "faults": [
            (of.detector, of.fault, percent(of.alarms), percent(of.named), percent(of.cannot_tell))
            for of in judgement.faults
        ],
    }  # fmt: skip
    tables = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    tables["families"]["title"] += f" ({part})" if part else ""
    return {
        name: PageTable(name, own["title"], own["about"], [head.format(unit=unit) for head in own["heads"]],
                        rows[name], own.get("words", 1))
        for name, own in tables.items() if rows[name]
    }  # fmt: skip


class CauseTable(NamedTuple):
    """What one detector names (`columns`) for which cause there is: a name, the records, and the share of each.

    `right`: records whose cause is named alone; `covered`: alone or with the one that no channel tells from it.
    """

    detector: str
    columns: tuple[str, ...]
    rows: list[tuple[str, int, list[str]]]
    right: str
    covered: str


def cause_tables(judgement: Judgement) -> list[CauseTable]:
    """Return, for each detector that names causes, how often it names which."""
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
