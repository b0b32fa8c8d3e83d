"""A judgement as tables, and the files of a campaign's result: the same rows give the same bytes."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sealscope.campaigns.cases.row import CaseRow, Statement
from sealscope.campaigns.judging.judge import ALLOWED_DETECTION, Judgement
from sealscope.evaluation.binomial import IntervalEstimate, Proportion
from sealscope.storage.atomic import atomic_write

Value = str | float | int | None
#: Name of a column -> value; every row of a table has the same columns.
TableRow = dict[str, Value]
_ONSET = "true onset given"


@dataclass(frozen=True)
class PriorKnowledge:
    """What a detector was given beside the recording.

    `onset`: whether it knew the true onset of the leak; `channels`: those it saw; `rig`: the rig that it assumes, ""
    for none.
    """

    onset: bool
    channels: tuple[str, ...]
    rig: str


def _share(what: str, share: Proportion | None) -> TableRow:
    """Return the five columns of a proportion, empty where there is none."""
    parts = (None,) * 5 if share is None else (share.count, share.n, share.value, share.low, share.high)
    return {f"{what}: {part}": of for part, of in zip(("count", "of", "fraction", "low", "high"), parts, strict=True)}


def _coverage(what: str, coverage: Proportion) -> TableRow:
    return _share(f"interval holds the {what}", coverage if coverage.n else None)


def _interval(what: str, name: str, estimate: IntervalEstimate | None) -> TableRow:
    parts = (None,) * 3 if estimate is None else (estimate.value, estimate.low, estimate.high)
    return dict(zip((name, f"{what}: low", f"{what}: high"), parts, strict=True))


def _known(known: PriorKnowledge | None) -> TableRow:
    if known is None:
        return dict.fromkeys((_ONSET, "channels given", "rig assumed"))
    onset = "yes" if known.onset else "no"
    return {_ONSET: onset, "channels given": " ".join(known.channels), "rig assumed": known.rig}


def _size(leak_lpm: float) -> Value:
    return "any" if math.isnan(leak_lpm) else leak_lpm


def tables_of(
    judgement: Judgement, unit: str = "L/min", known: Mapping[str, PriorKnowledge] | None = None, part: str = ""
) -> dict[str, list[TableRow]]:
    """Return every table of a judgement by the stem of its file.

    Sizes of leaks in `unit`, `known`: what each detector was given, `part`: what the campaign's families are for.
    """
    leak, known, j = f"leak [{unit}]", known or {}, judgement
    factors = list(dict.fromkeys(name for cell in j.cells for name in cell.levels))
    return {
        "table": [
            {
                "detector": row.detector, leak: _size(row.leak_lpm), **_share("detected", row.detection),
                **_share("false alarms", row.false_alarm), **_share("cannot tell", row.cannot_tell),
                **_interval("per hour", "false alarms per hour", row.per_hour),
                "detected less false alarms": row.informedness,
                **(_known(known.get(row.detector)) if known else {}),
            }
            for row in (*j.table, *j.overall)
        ],
        "pod": [
            {
                "detector": pod.detector, leak: at.size, **_share("detected", at.proportion),
                "one-sided lower bound": at.lower, f"a50 [{unit}]": pod.curve.a50 if pod.curve else None,
                f"a90 [{unit}]": pod.curve.a90 if pod.curve else None,
                f"a90/95 [{unit}]": pod.curve.a90_95 if pod.curve else None,
                f"a90/95 without a curve [{unit}]": pod.proven,
                "curve": pod.curve.estimator if pod.curve else pod.why,
            }
            for pod in j.pods
            for at in pod.sizes
        ],
        "roc": [
            {
                "detector": roc.detector, leak: _size(roc.leak_lpm),
                "AUC": roc.area.value, "low": roc.area.low, "high": roc.area.high,
            }
            for roc in j.rocs
        ],
        "cells": [
            {
                "detector": cell.detector, leak: cell.leak_lpm, **{name: cell.levels.get(name) for name in factors},
                **_share("alarms", cell.alarms),
            }
            for cell in j.cells
        ],
        "onsets": [
            {
                "detector": onset.detector, leak: onset.leak_lpm, "alarms": onset.errors.n,
                "median error [s]": onset.errors.median.value,
                **_interval("median size", "median size [s]", onset.errors.median_size),
                "90 % size [s]": onset.errors.ninety_size.value, **_coverage("onset", onset.errors.coverage),
            }
            for onset in j.onsets
        ],
        "estimates": [
            {
                "detector": flow.detector, leak: flow.leak_lpm, "with an estimate": flow.errors.n,
                "without": flow.errors.without, **_interval("bias", f"bias [{unit}]", flow.errors.bias),
                f"median error [{unit}]": flow.errors.median.value,
                f"median size of the error [{unit}]": flow.errors.median_size.value,
                f"rms error [{unit}]": flow.errors.rmse.value, **_coverage("flow", flow.errors.coverage),
            }
            for flow in j.flows
        ],
        "thresholds": [
            {
                "detector": name, "duty": duty, "leak-free records": at.n, "threshold": at.value,
                "asked probability": at.false_alarm_probability, "expected probability": at.expected,
                "low": at.low, "high": at.high,
            }
            for (name, duty), at in j.thresholds.items()
        ],
        "faults": [
            {
                "detector": fault.detector, "fault that is no leak": fault.fault, **_share("alarms", fault.alarms),
                **_share("cannot tell", fault.cannot_tell), **_share("alarms that name it", fault.named),
            }
            for fault in j.faults
        ],
        "causes": [
            {
                "detector": causes.detector, "there is": true, "named": named,
                **_share("records", causes.confusion.shares[i][k]),
            }
            for causes in j.causes
            for i, true in enumerate(causes.confusion.rows)
            for k, named in enumerate(causes.confusion.columns)
            if causes.confusion.counts[i].any()
        ],
        "families": [
            {
                "part": part, "family": row.family, "detector": row.detector,
                **{name: of for name, of in _known(known.get(row.detector)).items() if name != _ONSET},
                leak: row.leak_lpm, "law": row.law, **_share("alarms", row.alarms),
                **_share("cannot tell", row.cannot_tell), **_coverage("flow", row.coverage),
                **_share(f"bound allows {ALLOWED_DETECTION:.0%} detection", row.reachable),
                **_share("alarms where the bound allows", row.allowed), "failed": row.failed,
            }
            for row in j.families
        ],
    }  # fmt: skip


def _stated(name: str, statement: Statement | None) -> TableRow:
    own = statement or Statement("cannot tell")
    onset, flow = own.onset_interval_s or (None, None), own.leak_interval_lpm or (None, None)
    return {
        f"{name}: verdict": statement.verdict if statement else None, f"{name}: threshold": own.threshold,
        f"{name}: onset [s]": own.onset_s, f"{name}: onset: low": onset[0], f"{name}: onset: high": onset[1],
        f"{name}: flow": own.leak_lpm, f"{name}: flow: low": flow[0], f"{name}: flow: high": flow[1],
        f"{name}: cause": own.cause,
    }  # fmt: skip


def records_table(rows: Iterable[CaseRow], detectors: Sequence[str], unit: str = "L/min") -> list[TableRow]:
    """Return every record of a campaign in the order of its id, without what differs from run to run."""
    ordered = sorted(rows, key=lambda row: row.id)
    factors = list(dict.fromkeys(name for row in ordered for name in sorted(row.levels)))
    stating = sorted({name for row in ordered for name in row.statements})
    table = []
    for row in ordered:
        record: TableRow = {
            "id": row.id,
            "use": row.use,
            f"leak [{unit}]": row.leak_lpm,
            "fault": row.fault,
            **{name: row.levels.get(name) for name in factors},
            "replicate": row.replicate,
            f"flow [{unit}]": row.flow_lpm,
            **{name: row.scores[name][0] if name in row.scores else None for name in detectors},
        }
        for name in stating:
            record |= _stated(name, row.statements.get(name))
        table.append({**record, "error": row.error})
    return table


def write_tables(folder: Path, tables: Mapping[str, Sequence[TableRow]]) -> list[Path]:
    """Write each table that has rows as `NAME.csv`, numbers in full; return the files."""
    paths = []
    for name, rows in tables.items():
        path = folder / f"{name}.csv"
        if not rows:
            path.unlink(missing_ok=True)
            continue
        with (
            atomic_write(path) as temporary,
            temporary.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file,
        ):
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        paths.append(path)
    return paths
