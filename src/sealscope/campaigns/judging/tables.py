"""A judgement as tables, and the files of a campaign's result: the same rows give the same bytes."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sealscope.campaigns.cases.row import CaseRow, Statement
from sealscope.campaigns.judging.judge import Judgement
from sealscope.evaluation.binomial import Rate
from sealscope.recordings.atomic import atomic_write

Cell = str | float | int | None


@dataclass(frozen=True)
class Sheet:
    """A table: its file's stem, columns, rows."""

    name: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def _rate(rate: Rate | None) -> tuple[Cell, ...]:
    return (None,) * 5 if rate is None else (rate.count, rate.n, rate.rate, rate.low, rate.high)


def _rate_columns(what: str) -> tuple[str, ...]:
    return tuple(f"{what}: {part}" for part in ("count", "of", "rate", "low", "high"))


def _size(leak_lpm: float) -> Cell:
    return "any" if math.isnan(leak_lpm) else leak_lpm


def sheets(judgement: Judgement, unit: str = "L/min") -> list[Sheet]:
    """Every table of a judgement; sizes of leaks in `unit`, rates as shares with their intervals."""
    by_size = [make(judgement, unit) for make in (_table, _pod, _roc, _cells, _onsets, _estimates)]
    return [*by_size, _thresholds(judgement), _faults(judgement), _named(judgement)]


def _table(judgement: Judgement, unit: str) -> Sheet:
    """Detector by size of leak, beside one that always fires and one that never does."""
    columns = (
        "detector", f"leak [{unit}]", *_rate_columns("detected"), *_rate_columns("false alarms"),
        *_rate_columns("cannot tell"), "false alarms per hour", "per hour: low", "per hour: high",
        "detected less false alarms",
    )  # fmt: skip
    rows = []
    for row in (*judgement.table, *judgement.overall):
        hourly = (
            (None, None, None) if row.per_hour is None else (row.per_hour.per_hour, row.per_hour.low, row.per_hour.high)
        )
        rates = (*_rate(row.detection), *_rate(row.false_alarm), *_rate(row.cannot_tell))
        rows.append((row.detector, _size(row.leak_lpm), *rates, *hourly, row.informedness))
    return Sheet("table", columns, tuple(rows))


def _thresholds(judgement: Judgement) -> Sheet:
    columns = (
        "detector", "command rms [V]", "cycle [s]", "leak-free records", "threshold", "asked rate", "expected rate",
        "low", "high",
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    calibration = judgement.calibration
    for name in calibration.detectors if calibration is not None else ():
        for group in calibration.groups if calibration is not None else ():
            one = group.thresholds.get(name)
            values = (None,) * 5 if one is None else (one.value, one.rate, one.expected, one.low, one.high)
            rows.append((name, group.point.command_rms, group.point.cycle, group.records, *values))
    return Sheet("thresholds", columns, tuple(rows))


def _pod(judgement: Judgement, unit: str) -> Sheet:
    columns = (
        "detector", f"leak [{unit}]", *_rate_columns("detected"), "one-sided lower bound",
        f"a50 [{unit}]", f"a90 [{unit}]", f"a90/95 [{unit}]", f"a90/95 without a curve [{unit}]", "curve",
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for pod in judgement.pods:
        curve = pod.curve
        sizes: tuple[Cell, ...] = (None,) * 3 if curve is None else (curve.a50, curve.a90, curve.a90_95)
        told = pod.why if curve is None else curve.estimator
        rows += [(pod.detector, one.size, *_rate(one.rate), one.lower, *sizes, pod.proven, told) for one in pod.rates]
    return Sheet("pod", columns, tuple(rows))


def _roc(judgement: Judgement, unit: str) -> Sheet:
    columns = ("detector", f"leak [{unit}]", "AUC", "low", "high")
    rows = tuple(
        (one.detector, _size(one.leak_lpm), one.area.value, one.area.low, one.area.high) for one in judgement.rocs
    )
    return Sheet("roc", columns, rows)


def _cells(judgement: Judgement, unit: str) -> Sheet:
    factors = list(dict.fromkeys(name for cell in judgement.cells for name in cell.levels))
    columns = ("detector", f"leak [{unit}]", *factors, *_rate_columns("alarms"))
    rows = tuple(
        (cell.detector, cell.leak_lpm, *(cell.levels.get(name) for name in factors), *_rate(cell.alarms))
        for cell in judgement.cells
    )
    return Sheet("cells", columns, rows)


def _onsets(judgement: Judgement, unit: str) -> Sheet:
    columns = (
        "detector", f"leak [{unit}]", "alarms", "median error [s]", "median size [s]", "median size: low",
        "median size: high", "90 % size [s]", *_rate_columns("interval holds the onset"),
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for one in judgement.onsets:
        errors = one.errors
        size = errors.median_size
        stated = _rate(errors.coverage if errors.coverage.n else None)
        sizes = (size.value, size.low, size.high, errors.ninety_size.value)
        rows.append((one.detector, one.leak_lpm, errors.n, errors.median.value, *sizes, *stated))
    return Sheet("onsets", columns, tuple(rows))


def _estimates(judgement: Judgement, unit: str) -> Sheet:
    """Errors of the flow that detectors state, leak-free records (size 0) among them."""
    columns = (
        "detector", f"leak [{unit}]", "with an estimate", "without", f"bias [{unit}]", "bias: low", "bias: high",
        f"median error [{unit}]", f"median size of the error [{unit}]", f"rms error [{unit}]",
        *_rate_columns("interval holds the flow"),
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for one in judgement.estimates:
        errors = one.errors
        bias = errors.bias
        sizes = (bias.value, bias.low, bias.high, one.median.value, one.median_size.value, errors.rmse.value)
        stated = _rate(errors.coverage if errors.coverage.n else None)
        rows.append((one.detector, one.leak_lpm, bias.n, errors.without, *sizes, *stated))
    return Sheet("estimates", columns, tuple(rows))


def _named(judgement: Judgement) -> Sheet:
    """Which cause each detector names for which there is; one line for each pair."""
    columns = ("detector", "there is", "named", *_rate_columns("records"))
    rows = tuple(
        (one.detector, true, said, *_rate(one.confusion.rates[i][j]))
        for one in judgement.named
        for i, true in enumerate(one.confusion.rows)
        for j, said in enumerate(one.confusion.columns)
        if one.confusion.counts[i].any()
    )
    return Sheet("causes", columns, rows)


def _faults(judgement: Judgement) -> Sheet:
    columns = ("detector", "fault that is no leak", *_rate_columns("alarms"), *_rate_columns("cannot tell"))
    rows = tuple((one.detector, one.fault, *_rate(one.alarms), *_rate(one.cannot_tell)) for one in judgement.faults)
    return Sheet("faults", columns, rows)


_STATED = (
    "verdict", "threshold", "onset [s]", "onset: low", "onset: high", "flow", "flow: low", "flow: high", "cause",
)  # fmt: skip


def _stated(statement: Statement | None) -> tuple[Cell, ...]:
    if statement is None:
        return (None,) * len(_STATED)
    onset, flow = statement.onset_interval_s or (None, None), statement.leak_interval_lpm or (None, None)
    timed = (statement.onset_s, *onset)
    return (statement.verdict, statement.threshold, *timed, statement.leak_lpm, *flow, statement.cause)


def rows_sheet(rows: Iterable[CaseRow], detectors: Sequence[str], unit: str = "L/min") -> Sheet:
    """Every record of a campaign in the order of its id, without what differs from run to run."""
    found = sorted(rows, key=lambda row: row.id)
    factors = list(dict.fromkeys(name for row in found for name in sorted(row.levels)))
    keys = sorted({key for row in found for key in row.statements})
    columns = (
        "id", "use", f"leak [{unit}]", "fault", *factors, "replicate", f"flow [{unit}]", *detectors,
        *(f"{key}: {part}" for key in keys for part in _STATED), "error",
    )  # fmt: skip
    body = tuple(
        (
            row.id, row.use, row.leak_lpm, row.fault, *(row.levels.get(name) for name in factors), row.replicate,
            row.flow_lpm, *(row.scores[name][0] if name in row.scores else None for name in detectors),
            *(cell for key in keys for cell in _stated(row.statements.get(key))), row.error,
        )
        for row in found
    )  # fmt: skip
    return Sheet("records", columns, body)


def write_sheets(folder: Path, found: Iterable[Sheet]) -> list[Path]:
    """Write each table that has rows as `NAME.csv`, numbers in full; gives the files."""
    paths = []
    for sheet in found:
        path = folder / f"{sheet.name}.csv"
        if not sheet.rows:
            path.unlink(missing_ok=True)
            continue
        with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(sheet.columns)
            writer.writerows([["" if value is None else value for value in row] for row in sheet.rows])
        paths.append(path)
    return paths
