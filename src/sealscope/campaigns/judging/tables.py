"""A judgement as tables, and the files of a campaign's result: the same rows give the same bytes."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.judging.judge import ALLOWED_DETECTION, Judgement
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.evaluation.binomial import Proportion
from sealscope.storage.atomic import atomic_write

Value = str | float | int | None


@dataclass(frozen=True)
class ResultTable:
    """A table: its file's stem, columns, rows."""

    name: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]


@dataclass(frozen=True)
class PriorKnowledge:
    """What a detector was given beside the recording.

    `onset`: whether it knew the true onset of the leak; `channels`: those it saw; `rig`: the rig that it assumes, ""
    for none.
    """

    onset: bool
    channels: tuple[str, ...]
    rig: str


def _of(proportion: Proportion | None) -> tuple[Value, ...]:
    if proportion is None:
        return (None,) * 5
    return (proportion.count, proportion.n, proportion.value, proportion.low, proportion.high)


def _columns(what: str) -> tuple[str, ...]:
    return tuple(f"{what}: {part}" for part in ("count", "of", "fraction", "low", "high"))


def _stated_coverage(coverage: Proportion) -> tuple[Value, ...]:
    return _of(coverage if coverage.n else None)


def _size(leak_lpm: float) -> Value:
    return "any" if math.isnan(leak_lpm) else leak_lpm


def tables_of(
    judgement: Judgement, unit: str = "L/min", known: Mapping[str, PriorKnowledge] | None = None, part: str = ""
) -> list[ResultTable]:
    """Return every table of a judgement.

    Sizes of leaks in `unit`, `known`: what each detector was given, `part`: what the campaign's families are for.
    """
    by_size = [make(judgement, unit) for make in (_pods, _rocs, _cells, _onsets, _flows)]
    return [
        _main(judgement, unit, known or {}),
        *by_size,
        _thresholds(judgement),
        _faults(judgement),
        _causes(judgement),
        _families(judgement, unit, known or {}, part),
    ]


def _main(judgement: Judgement, unit: str, known: Mapping[str, PriorKnowledge]) -> ResultTable:
    """Return detector by size of leak, beside one that always fires and one that never does."""
    columns = (
        "detector", f"leak [{unit}]", *_columns("detected"), *_columns("false alarms"), *_columns("cannot tell"),
        "false alarms per hour", "per hour: low", "per hour: high", "detected less false alarms",
        *(("true onset given", "channels given", "rig assumed") if known else ()),
    )  # fmt: skip
    rows = []
    for row in (*judgement.table, *judgement.overall):
        hour = row.per_hour
        hourly = (None, None, None) if hour is None else (hour.value, hour.low, hour.high)
        fractions = (*_of(row.detection), *_of(row.false_alarm), *_of(row.cannot_tell))
        given = known.get(row.detector)
        prior: tuple[Value, ...] = (None,) * 3 if known else ()
        if given is not None:
            prior = ("yes" if given.onset else "no", " ".join(given.channels), given.rig)
        rows.append((row.detector, _size(row.leak_lpm), *fractions, *hourly, row.informedness, *prior))
    return ResultTable("table", columns, tuple(rows))


def _families(judgement: Judgement, unit: str, known: Mapping[str, PriorKnowledge], part: str) -> ResultTable:
    """Return what each detector finds in each family of machines, beside what the Cramer-Rao bound allows to find."""
    columns = (
        "part", "family", "detector", "channels given", "rig assumed", f"leak [{unit}]", "law", *_columns("alarms"),
        *_columns("cannot tell"), *_columns("interval holds the flow"),
        *_columns(f"bound allows {ALLOWED_DETECTION:.0%} detection"), *_columns("alarms where the bound allows"),
        "failed",
    )  # fmt: skip
    rows: list[tuple[Value, ...]] = []
    for row in judgement.families:
        given = known.get(row.detector)
        prior = (None, None) if given is None else (" ".join(given.channels), given.rig)
        stated = *_of(row.alarms), *_of(row.cannot_tell), *_stated_coverage(row.coverage)
        shares = (*stated, *_of(row.reachable), *_of(row.allowed))
        rows.append((part, row.family, row.detector, *prior, row.leak_lpm, row.law, *shares, row.failed))
    return ResultTable("families", columns, tuple(rows))


def _thresholds(judgement: Judgement) -> ResultTable:
    columns = (
        "detector", "duty", "leak-free records", "threshold", "asked probability", "expected probability", "low",
        "high",
    )  # fmt: skip
    rows = tuple(
        (name, duty, at.n, at.value, at.false_alarm_probability, at.expected, at.low, at.high)
        for (name, duty), at in judgement.thresholds.items()
    )
    return ResultTable("thresholds", columns, rows)


def _pods(judgement: Judgement, unit: str) -> ResultTable:
    columns = (
        "detector", f"leak [{unit}]", *_columns("detected"), "one-sided lower bound",
        f"a50 [{unit}]", f"a90 [{unit}]", f"a90/95 [{unit}]", f"a90/95 without a curve [{unit}]", "curve",
    )  # fmt: skip
    rows: list[tuple[Value, ...]] = []
    for pod in judgement.pods:
        curve = pod.curve
        sizes: tuple[Value, ...] = (None,) * 3 if curve is None else (curve.a50, curve.a90, curve.a90_95)
        how = pod.why if curve is None else curve.estimator
        rows += [(pod.detector, at.size, *_of(at.proportion), at.lower, *sizes, pod.proven, how) for at in pod.sizes]
    return ResultTable("pod", columns, tuple(rows))


def _rocs(judgement: Judgement, unit: str) -> ResultTable:
    columns = ("detector", f"leak [{unit}]", "AUC", "low", "high")
    rows = tuple(
        (roc.detector, _size(roc.leak_lpm), roc.area.value, roc.area.low, roc.area.high) for roc in judgement.rocs
    )
    return ResultTable("roc", columns, rows)


def _cells(judgement: Judgement, unit: str) -> ResultTable:
    factors = list(dict.fromkeys(name for cell in judgement.cells for name in cell.levels))
    columns = ("detector", f"leak [{unit}]", *factors, *_columns("alarms"))
    rows = tuple(
        (cell.detector, cell.leak_lpm, *(cell.levels.get(name) for name in factors), *_of(cell.alarms))
        for cell in judgement.cells
    )
    return ResultTable("cells", columns, rows)


def _onsets(judgement: Judgement, unit: str) -> ResultTable:
    columns = (
        "detector", f"leak [{unit}]", "alarms", "median error [s]", "median size [s]", "median size: low",
        "median size: high", "90 % size [s]", *_columns("interval holds the onset"),
    )  # fmt: skip
    rows: list[tuple[Value, ...]] = []
    for onset in judgement.onsets:
        errors, size = onset.errors, onset.errors.median_size
        sizes = (size.value, size.low, size.high, errors.ninety_size.value)
        stated = _stated_coverage(errors.coverage)
        rows.append((onset.detector, onset.leak_lpm, errors.n, errors.median.value, *sizes, *stated))
    return ResultTable("onsets", columns, tuple(rows))


def _flows(judgement: Judgement, unit: str) -> ResultTable:
    """Return errors of the flow that detectors state, leak-free records (size 0) among them."""
    columns = (
        "detector", f"leak [{unit}]", "with an estimate", "without", f"bias [{unit}]", "bias: low", "bias: high",
        f"median error [{unit}]", f"median size of the error [{unit}]", f"rms error [{unit}]",
        *_columns("interval holds the flow"),
    )  # fmt: skip
    rows: list[tuple[Value, ...]] = []
    for flow in judgement.flows:
        errors, bias = flow.errors, flow.errors.bias
        sizes = (bias.value, bias.low, bias.high, flow.median.value, flow.median_size.value, errors.rmse.value)
        rows.append((flow.detector, flow.leak_lpm, bias.n, errors.without, *sizes, *_stated_coverage(errors.coverage)))
    return ResultTable("estimates", columns, tuple(rows))


def _causes(judgement: Judgement) -> ResultTable:
    """Return which cause each detector names for which there is; one line for each pair."""
    columns = ("detector", "there is", "named", *_columns("records"))
    rows = tuple(
        (causes.detector, true, named, *_of(causes.confusion.shares[i][j]))
        for causes in judgement.causes
        for i, true in enumerate(causes.confusion.rows)
        for j, named in enumerate(causes.confusion.columns)
        if causes.confusion.counts[i].any()
    )
    return ResultTable("causes", columns, rows)


def _faults(judgement: Judgement) -> ResultTable:
    columns = (
        "detector",
        "fault that is no leak",
        *_columns("alarms"),
        *_columns("cannot tell"),
        *_columns("alarms that name it"),
    )
    rows = tuple(
        (fault.detector, fault.fault, *_of(fault.alarms), *_of(fault.cannot_tell), *_of(fault.named))
        for fault in judgement.faults
    )
    return ResultTable("faults", columns, rows)


_STATED = (
    "verdict", "threshold", "onset [s]", "onset: low", "onset: high", "flow", "flow: low", "flow: high", "cause",
)  # fmt: skip


def _stated(statement: Evidence | None) -> tuple[Value, ...]:
    if statement is None:
        return (None,) * len(_STATED)
    onset, flow = statement.onset_interval_s or (None, None), statement.leak_interval_lpm or (None, None)
    timed = (statement.onset_s, *onset)
    return (statement.verdict, statement.threshold, *timed, statement.leak_lpm, *flow, statement.cause)


def rows_table(rows: Iterable[CaseRow], detectors: Sequence[str], unit: str = "L/min") -> ResultTable:
    """Return every record of a campaign in the order of its id, without what differs from run to run."""
    ordered = sorted(rows, key=lambda row: row.id)
    factors = list(dict.fromkeys(name for row in ordered for name in sorted(row.levels)))
    keys = sorted({key for row in ordered for key in row.statements})
    columns = (
        "id", "use", f"leak [{unit}]", "fault", *factors, "replicate", f"flow [{unit}]", *detectors,
        *(f"{key}: {part}" for key in keys for part in _STATED), "error",
    )  # fmt: skip
    body = tuple(
        (
            row.id, row.use, row.leak_lpm, row.fault, *(row.levels.get(name) for name in factors), row.replicate,
            row.flow_lpm, *(row.scores[name][0] if name in row.scores else None for name in detectors),
            *(value for key in keys for value in _stated(row.statements.get(key))), row.error,
        )
        for row in ordered
    )  # fmt: skip
    return ResultTable("records", columns, body)


def write_tables(folder: Path, tables: Iterable[ResultTable]) -> list[Path]:
    """Write each table that has rows as `NAME.csv`, numbers in full; return the files."""
    paths = []
    for table in tables:
        path = folder / f"{table.name}.csv"
        if not table.rows:
            path.unlink(missing_ok=True)
            continue
        with (
            atomic_write(path) as temporary,
            temporary.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file,
        ):
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(table.columns)
            writer.writerows([["" if value is None else value for value in row] for row in table.rows])
        paths.append(path)
    return paths
