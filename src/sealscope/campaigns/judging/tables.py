"""Convert a judgement to tables and write them as a campaign's result files; equal results give identical files."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.judging.judge import Judgement
from sealscope.storage.csv_file import write_csv

Value = str | float | int | None
#: Values of one row by name of the column; every row of a table has the same columns.
TableRow = dict[str, Value]
#: Columns into which a proportion is written: `count` of the number `of` records, their fraction and its interval.
_PROPORTION = ("count", "of", "fraction", "low", "high")


@dataclass(frozen=True)
class PriorKnowledge:
    """The information that a detector is given before it judges a record.

    `onset`: True if it knows the true onset of the leak; `channels` that it may read; `rig`: name of the rig that it
    assumes, "" if the plan states none.
    """

    onset: bool
    channels: tuple[str, ...]
    rig: str


@cache
def _table_layouts() -> dict[str, dict[str, str]]:
    """Load the tables' layouts: for each column, flags and the dotted path of an attribute, as in "share alarms"."""
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def resolve_attribute(source: Any, path: str) -> Any:
    """Return the value at a dotted path of attributes, keys and indices; None if a value along the path is None."""
    for name in path.split("."):
        if source is None:
            return None
        if isinstance(source, Mapping):
            source = source[name]
        else:
            source = source[int(name)] if name.isdigit() else getattr(source, name)
    return source


def _build_cells(column: str, content: str, row: Any, factors: Sequence[str]) -> TableRow:
    """Build the cells of a table's row that one entry of `tables.toml` fills; return them by name of the column.

    `column`: name of the entry; `content`: its text, i.e. flags, which the head of `tables.toml` explains, and the
    dotted path of an attribute of the result `row`. The path "levels" fills a column for each of the plan's `factors`.
    """
    *flags, path = content.split(" ")
    value = resolve_attribute(row, path)
    if path == "levels":
        return {name: value.get(name) for name in factors}
    if "share" in flags:
        is_stated = value is not None and (value.n or "stated" not in flags)
        numbers = (value.count, value.n, value.value, value.low, value.high) if is_stated else (None,) * 5
        return {f"{column}: {part}": number for part, number in zip(_PROPORTION, numbers, strict=True)}
    return {column: "any" if "size" in flags and math.isnan(value) else value}


def build_tables(
    judgement: Judgement, unit: str, known: Mapping[str, PriorKnowledge], part: str
) -> dict[str, list[TableRow]]:
    """Build the tables of a campaign's results, with the columns that `tables.toml` lists; return them by name.

    `unit`: unit of the leaks' sizes; `known`: by detector, the information that it was given; `part`: purpose of the
    plan, such as development or judging.
    """
    knowledge = {
        name: {"onset": "yes" if row.onset else "no", "channels": " ".join(row.channels), "rig": row.rig}
        for name, row in known.items()
    }
    factors = list(dict.fromkeys(name for cell in judgement.cells for name in cell.levels))
    # by table, the objects that fill its rows; a dictionary has several, by the first name in their dotted paths
    rows: dict[str, Iterable[Any]] = {
        "table": (*judgement.table, *judgement.overall),
        "pod": ({"pod": pod, "at": entry} for pod in judgement.pods for entry in pod.sizes),
        "roc": judgement.rocs,
        "cells": judgement.cells,
        "onsets": judgement.onsets,
        "estimates": judgement.flows,
        "thresholds": (
            {"detector": name, "duty": duty, "at": entry} for (name, duty), entry in judgement.thresholds.items()
        ),
        "faults": judgement.faults,
        "causes": (
            {"detector": row.detector, "true": true_cause, "named": cause, "records": fraction}
            for row in judgement.causes
            for true_cause, fractions in zip(row.confusion.rows, row.confusion.shares, strict=True)
            for cause, fraction in zip(row.confusion.columns, fractions, strict=True)
            if fraction.n  # records with the true cause; 0 for a cause that is only named
        ),
        "families": ({"of": row, "part": part, "detector": row.detector} for row in judgement.families),
    }

    def build_row(columns: Mapping[str, str], row: Any) -> TableRow:
        """Build the row of a table with the contents `columns` from the object `row` that fills it."""
        cells: TableRow = {}
        for column, content in columns.items():
            is_known = content.startswith("known ")  # of the information that the row's detector was given
            # None, for empty cells, for the reference detectors (`add_references`)
            source = knowledge.get(resolve_attribute(row, "detector")) if is_known else row
            cells |= _build_cells(column.format(unit=unit), content, source, factors)
        return cells

    return {name: [build_row(_table_layouts()[name], row) for row in table] for name, table in rows.items()}


def records_table(rows: Sequence[CaseRow], detectors: Sequence[str], unit: str) -> list[TableRow]:
    """Build the table of all records with inputs, scores and statements (verdict, onset, flow, cause), sorted by id.

    Run times are left out, because they would differ between two runs of the same campaign.
    """
    factors = list(dict.fromkeys(name for row in rows for name in sorted(row.levels)))
    stating_detectors = sorted({name for row in rows for name in row.statements})
    table = []
    for row in sorted(rows, key=lambda row: row.id):
        record: TableRow = {
            "id": row.id,
            "use": row.use,
            f"leak [{unit}]": row.leak_lpm,
            "fault": row.fault,
            **{name: row.levels.get(name) for name in factors},
            "replicate": row.replicate,
            f"flow [{unit}]": row.flow_lpm,
            **{name: row.score(name) for name in detectors},
        }
        for name in stating_detectors:
            for column, content in _table_layouts()["records"].items():
                record[f"{name}: {column}"] = resolve_attribute(row.statements.get(name), content)
        table.append({**record, "error": row.error})
    return table


def write_tables(folder: Path, tables: Mapping[str, Sequence[TableRow]]) -> list[Path]:
    """Write each table as `NAME.csv` into a folder, with all digits; return the paths of the files.

    For an empty table, the file of an earlier run is removed.
    """
    paths = []
    for name, rows in tables.items():
        path = folder / f"{name}.csv"
        if not rows:
            path.unlink(missing_ok=True)
            continue
        write_csv(path, list(rows[0]), rows)
        paths.append(path)
    return paths
