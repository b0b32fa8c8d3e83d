"""The tables of a campaign's page beside the main one: onsets, flows, causes, as text."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
    return (
        f"{value:.2f}" if value < 9.95 else f"{value:.0f}" if value > 99.95 or value == round(value) else f"{value:.1f}"
    )


def fault_lines(judgement: Judgement) -> list[tuple[str, str, str, str, str]]:
    """Return detector, fault, alarms, those of them that name its cause, cannot tell."""
    return [
        (fault.detector, fault.fault, percent(fault.alarms), percent(fault.named), percent(fault.cannot_tell))
        for fault in judgement.faults
    ]


@dataclass(frozen=True)
class CauseTable:
    """What one detector names (`columns`) for which cause there is: a name, the records, and the share of each.

    `right`: records whose cause is named alone; `covered`: alone or with the one that no channel tells from it.
    """

    detector: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, int, tuple[str, ...]], ...]
    right: str
    covered: str


def onset_lines(judgement: Judgement) -> list[tuple[str, str, str, str, str]]:
    """Return detector, size, alarms with an onset, median size of the error [s], coverage of the interval."""
    return [
        (
            onset.detector,
            f"{onset.leak_lpm:g}",
            str(onset.errors.n),
            _quantile(onset.errors.median_size),
            percent(onset.errors.coverage),
        )
        for onset in judgement.onsets
    ]


def family_lines(judgement: Judgement) -> list[tuple[str, str, str, str, str, str, str, str]]:
    """Return detector, family, leak, alarms, cannot tell, coverage of the flow, what the bound allows, alarms there."""
    return [
        (
            row.detector,
            row.family,
            f"{row.leak_lpm:g} {row.law}" if row.leak_lpm else "no leak",
            percent(row.alarms),
            percent(row.cannot_tell),
            percent(row.coverage),
            _of(row.reachable),
            _counted(row.allowed),
        )
        for row in judgement.families
    ]


def flow_lines(judgement: Judgement) -> list[tuple[str, str, str, str, str, str]]:
    """Return detector, size, records with an estimate, its bias, its median error, coverage of the interval."""
    return [
        (
            flow.detector,
            f"{flow.leak_lpm:g}" if flow.leak_lpm else "no leak",
            str(flow.errors.bias.n),
            f"{flow.errors.bias.value:+.2g}",
            f"{flow.median_size.value:.2g}",
            percent(flow.errors.coverage),
        )
        for flow in judgement.flows
    ]


def cause_tables(judgement: Judgement) -> list[CauseTable]:
    """Return, for each detector that names causes, how often it names which."""
    tables = []
    for causes in judgement.causes:
        confusion = causes.confusion
        there = [i for i in range(len(confusion.rows)) if confusion.counts[i].any()]
        rows = tuple(
            (
                confusion.rows[i],
                int(confusion.counts[i].sum()),
                tuple(_share(confusion.shares[i][j]) for j in range(len(confusion.columns))),
            )
            for i in there
        )
        tables.append(
            CauseTable(causes.detector, confusion.columns, rows, percent(confusion.accuracy), percent(causes.covered))
        )
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
