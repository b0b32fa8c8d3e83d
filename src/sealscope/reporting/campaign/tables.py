"""The tables of a campaign's page beside the main one: onsets, flows, causes, as text."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sealscope.campaigns.judging.judge import Judgement
from sealscope.evaluation.binomial import Rate
from sealscope.evaluation.quantiles import Quantile


def percent(rate: Rate | None) -> str:
    """A rate with its interval in per cent, a dash where nothing is known."""
    if rate is None or rate.n == 0:
        return "–"
    return f"{_p(rate.rate)} % ({_p(rate.low)}–{_p(rate.high)})"


def _p(share: float) -> str:
    value = 100.0 * share
    return (
        f"{value:.2f}" if value < 9.95 else f"{value:.0f}" if value > 99.95 or value == round(value) else f"{value:.1f}"
    )


@dataclass(frozen=True)
class CauseTable:
    """What one detector names (`columns`) for which cause there is: a name, the records, and the share of each."""

    detector: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, int, tuple[str, ...]], ...]
    right: str


def onset_lines(judgement: Judgement) -> list[tuple[str, str, str, str, str]]:
    """Detector, size, alarms with an onset, median size of the error [s], how often the interval holds it."""
    return [
        (
            one.detector,
            f"{one.leak_lpm:g}",
            str(one.errors.n),
            _quantile(one.errors.median_size),
            percent(one.errors.coverage) if one.errors.coverage.n else "–",
        )
        for one in judgement.onsets
    ]


def flow_lines(judgement: Judgement) -> list[tuple[str, str, str, str, str, str]]:
    """Detector, size, records with an estimate, its bias, its median error, how often its interval holds the flow."""
    return [
        (
            one.detector,
            f"{one.leak_lpm:g}" if one.leak_lpm else "no leak",
            str(one.errors.bias.n),
            f"{one.errors.bias.value:+.2g}",
            f"{one.median_size.value:.2g}",
            percent(one.errors.coverage) if one.errors.coverage.n else "–",
        )
        for one in judgement.estimates
    ]


def cause_tables(judgement: Judgement) -> list[CauseTable]:
    """For each detector that names causes, how often it names which."""
    found = []
    for one in judgement.named:
        confusion = one.confusion
        there = [i for i in range(len(confusion.rows)) if confusion.counts[i].any()]
        rows = tuple(
            (
                confusion.rows[i],
                int(confusion.counts[i].sum()),
                tuple(_share(confusion.rates[i][j]) for j in range(len(confusion.columns))),
            )
            for i in there
        )
        found.append(CauseTable(one.detector, confusion.columns, rows, percent(confusion.accuracy)))
    return found


def _share(rate: Rate) -> str:
    return f"{100 * rate.rate:.0f} %" if rate.count else "·"


def _quantile(one: Quantile) -> str:
    if not math.isfinite(one.value):
        return "–"
    if not (math.isfinite(one.low) or math.isfinite(one.high)):
        return f"{one.value:.2g}"
    ends = [f"{end:.2g}" if math.isfinite(end) else "–" for end in (one.low, one.high)]
    return f"{one.value:.2g} ({ends[0]}–{ends[1]})"
