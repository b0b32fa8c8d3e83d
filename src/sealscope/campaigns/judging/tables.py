"""A judgement as tables, and the files of a campaign's result: the same rows give the same bytes."""

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
#: Name of a column -> value; every row of a table has the same columns.
TableRow = dict[str, Value]
_SHARE = ("count", "of", "fraction", "low", "high")


@dataclass(frozen=True)
class PriorKnowledge:
    """A detector's knowledge besides the recording.

    `onset`: whether it knew the true onset of the leak; `channels`: those it saw; `rig`: the rig that it assumes, ""
    for none.
    """

    onset: bool
    channels: tuple[str, ...]
    rig: str

    def plain(self) -> TableRow:
        """Format the knowledge for a table."""
        return {"onset": "yes" if self.onset else "no", "channels": " ".join(self.channels), "rig": self.rig}


@cache
def _columns() -> dict[str, dict[str, str]]:
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def attribute_of(source: Any, path: str) -> Any:
    """Find an attribute by its path through mappings and tuples; None where one on the way is None."""
    for name in path.split("."):
        if source is None:
            return None
        source = (
            source[name]
            if isinstance(source, Mapping)
            else source[int(name)]
            if name.isdigit()
            else getattr(source, name)
        )
    return source


def _cells(column: str, content: str, row: Any, factors: Sequence[str]) -> TableRow:
    """Build the cells of one column of `tables.toml`: one, or several by name."""
    *how, path = content.split(" ")
    value = attribute_of(row, path)
    if path == "levels":
        return {name: value.get(name) for name in factors}
    if "share" in how:
        is_stated = value is not None and (value.n or "stated" not in how)
        parts = (value.count, value.n, value.value, value.low, value.high) if is_stated else (None,) * 5
        return {f"{column}: {part}": value_of_part for part, value_of_part in zip(_SHARE, parts, strict=True)}
    return {column: "any" if "size" in how and math.isnan(value) else value}


def tables_of(
    judgement: Judgement, unit: str = "L/min", known: Mapping[str, PriorKnowledge] | None = None, part: str = ""
) -> dict[str, list[TableRow]]:
    """Build every table of a judgement by the stem of its file, as `tables.toml` lays them out.

    Sizes of leaks in `unit`, `known`: what each detector was given, `part`: what the campaign's families are for.
    """
    j, knowledge = judgement, {name: row.plain() for name, row in (known or {}).items()}
    factors = list(dict.fromkeys(name for cell in j.cells for name in cell.levels))
    rows: dict[str, Iterable[Any]] = {
        "table": (*j.table, *j.overall),
        "pod": ({"pod": pod, "at": entry} for pod in j.pods for entry in pod.sizes),
        "roc": j.rocs,
        "cells": j.cells,
        "onsets": j.onsets,
        "estimates": j.flows,
        "thresholds": ({"detector": name, "duty": duty, "at": entry} for (name, duty), entry in j.thresholds.items()),
        "faults": j.faults,
        "causes": (
            {"detector": row.detector, "true": true, "named": named, "records": share}
            for row in j.causes
            for true, shares in zip(row.confusion.rows, row.confusion.shares, strict=True)
            for named, share in zip(row.confusion.columns, shares, strict=True)
            if share.n
        ),
        "families": ({"of": row, "part": part, "detector": row.detector} for row in j.families),
    }

    def laid_out(columns: Mapping[str, str], row: Any) -> TableRow:
        cells: TableRow = {}
        for column, content in columns.items():
            if content.startswith("known ") and knowledge:
                cells[column] = attribute_of(
                    knowledge.get(attribute_of(row, "detector")), content.removeprefix("known ")
                )
            elif not content.startswith("known "):
                name = column.format(unit=unit)
                cells |= _cells(name, content, row, factors)
        return cells

    return {name: [laid_out(_columns()[name], row) for row in table] for name, table in rows.items()}


def records_table(rows: Iterable[CaseRow], detectors: Sequence[str], unit: str = "L/min") -> list[TableRow]:
    """Build the table of all records in the order of their ids, without values that differ from run to run."""
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
            for column, content in _columns()["records"].items():
                record[f"{name}: {column}"] = attribute_of(row.statements.get(name), content)
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
        write_csv(path, list(rows[0]), rows)
        paths.append(path)
    return paths
