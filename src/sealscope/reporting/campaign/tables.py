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


@dataclass(frozen=True)
class PageTable:
    """A table of the page: `words`, how many columns of text stand first; `about`: what it shows, in a sentence."""

    id: str
    title: str
    about: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: int = 1


def page_tables(judgement: Judgement, unit: str, part: str = "") -> dict[str, PageTable]:
    """Return the tables of what detectors state and of faults and families, by name; those that have rows."""
    shown = (
        PageTable(
            "flows",
            "How much",
            "The flow that a detector states less the flow that the record really had, over all records with an "
            "estimate, alarm or not; how often its interval holds the true flow.",
            ("Detector", f"Leak [{unit}]", "Estimates", f"Bias [{unit}]", f"Median size of the error [{unit}]",
             "Interval holds it"),
            tuple(
                (
                    of.detector, f"{of.leak_lpm:g}" if of.leak_lpm else "no leak", str(of.errors.bias.n),
                    f"{of.errors.bias.value:+.2g}", f"{of.median_size.value:.2g}", percent(of.errors.coverage),
                )
                for of in judgement.flows
            ),
        ),
        PageTable(
            "families",
            f"Family by family ({part})" if part else "Family by family",
            "Machines that depart from the rig as their family says. The bound allows a leak where the best test at "
            "the stated false-alarm probability, by the Cramer-Rao bound of its machine from pressures and command, "
            "finds it nine times in ten; the last column counts those alone.",
            ("Detector", "Family", f"Leak [{unit}]", "Alarms", "Cannot tell", "Interval holds the flow",
             "Bound allows", "Alarms where it does"),
            tuple(
                (
                    of.detector, of.family, f"{of.leak_lpm:g} {of.law}" if of.leak_lpm else "no leak",
                    percent(of.alarms), percent(of.cannot_tell), percent(of.coverage), _of(of.reachable),
                    _counted(of.allowed),
                )
                for of in judgement.families
            ),
            words=3,
        ),
        PageTable(
            "onsets",
            "Since when",
            "The onset that a detector finds in its alarms less the true one: the median size of the error, and how "
            "often the stated interval holds the true onset.",
            ("Detector", f"Leak [{unit}]", "Alarms with an onset", "Median size of the error [s]", "Interval holds it"),
            tuple(
                (
                    of.detector, f"{of.leak_lpm:g}", str(of.errors.n), _quantile(of.errors.median_size),
                    percent(of.errors.coverage),
                )
                for of in judgement.onsets
            ),
        ),
        PageTable(
            "faults",
            "Other faults",
            "Alarms on records with a fault that is no piston leak: what a detector cannot tell from a leak. An alarm "
            "that names the fault, as a piston or pump leak does a pump leak, is no false one.",
            ("Detector", "Fault", "Alarms", "Alarms that name it", "Cannot tell"),
            tuple(
                (of.detector, of.fault, percent(of.alarms), percent(of.named), percent(of.cannot_tell))
                for of in judgement.faults
            ),
            words=2,
        ),
    )  # fmt: skip
    return {table.id: table for table in shown if table.rows}


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
