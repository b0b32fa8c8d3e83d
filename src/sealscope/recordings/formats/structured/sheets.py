"""Sheets of a workbook that hold one run: one after the other, as rows ran out, or channels of one clock in each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.columns import ColumnMap, Source, listed
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.series import Clock, Series, table_of
from sealscope.recordings.formats.table import RawTable

#: A sheet goes on with another where it begins so many intervals after its end, at most.
_LONGEST_PAUSE = 3.0
#: Share of the time of the pressures that channels of another sheet must cover.
_LEAST_COVER = 0.9


@dataclass(frozen=True)
class _SheetRun:
    """What sheets hold: `t` (n,) [s] after `start`, or after any moment where that is None, and channels in SI."""

    sheets: tuple[str, ...]
    table: RawTable
    t: Array
    start: np.datetime64 | None
    rate: float
    channels: dict[str, Array]
    units: dict[str, str]
    history: tuple[str, ...]


def joined_sheets(tables: Sequence[tuple[str, RawTable]], place: str) -> tuple[RawTable, tuple[str, ...]]:
    """Return the table of the first sheet, with what others add to its run, and the names of the sheets in it.

    A sheet with the same channels is joined where its clock goes on within three intervals; one with other channels
    where it covers nine tenths of the time, its samples brought to the clock of the pressures. Notes say which were
    joined, and which of the same channels were not. `place`: the file, for messages.
    """
    name, first = tables[0]
    runs = _on_one_origin([run for own, table in tables if (run := _run(own, table)) is not None])
    if len(runs) < 2 or runs[0].sheets != (name,):
        return first, (name,)
    base, apart = _continued(runs[0], [run for run in runs[1:] if run.units == runs[0].units])
    beside: list[_SheetRun] = []
    left = [run for run in runs[1:] if run.units != base.units]
    while left:
        other, left = _continued(left[0], [run for run in left[1:] if run.units == left[0].units])[0], left[1:]
        left = [run for run in left if run.sheets[0] not in other.sheets]
        taken = {channel for run in (base, *beside) for channel in run.units}
        if not set(other.units) & taken and _covers(other, base):
            beside.append(other)
    notes = tuple(
        f"sheet {run.sheets[0]} not joined: it begins at {_shown(run, 0)}, {base.sheets[-1]} ends at {_shown(base, -1)}"
        for run in apart[:3]
    )
    used = tuple(sheet for run in (base, *beside) for sheet in run.sheets)
    if len(used) == 1:
        return replace(first, notes=(*first.notes, *notes)), used
    return _table([base, *beside], notes, place), used


def _run(sheet: str, table: RawTable) -> _SheetRun | None:
    """Return what a sheet holds; None where it has no clock of its own, or one that goes back."""
    if table.choice.time is None or table.description is not None:
        return None
    try:
        fields = table.samples({}, rate=None, infer_rate=True)
    except InputError:
        return None
    if not np.isfinite(fields.t).all() or not (np.diff(fields.t) >= 0).all():
        return None
    stamps = table.columns[-1]
    begin = fields.provenance
    start = None
    if "start" in begin:
        start = np.datetime64(str(begin["start"])).astype("datetime64[ns]")
    elif "start_epoch_s" in begin:
        start = np.datetime64(round(float(begin["start_epoch_s"]) * 1e9), "ns")
    elif stamps.dtype.kind == "M" and not table.choice.parts:  # times of the day
        start = stamps[~np.isnat(stamps)].min().astype("datetime64[ns]")
    return _SheetRun((sheet,), table, fields.t, start, fields.rate, fields.channels, fields.units, fields.history)


def _on_one_origin(runs: Sequence[_SheetRun]) -> list[_SheetRun]:
    """Return the runs, the times of those with a start after the earliest start of all."""
    starts = [run.start for run in runs if run.start is not None]
    origin = min(starts, default=None)
    return [
        run
        if run.start is None or origin is None
        else replace(run, t=run.t + (run.start - origin).astype(np.int64) / 1e9, start=origin)
        for run in runs
    ]


def _continued(first: _SheetRun, others: Sequence[_SheetRun]) -> tuple[_SheetRun, list[_SheetRun]]:
    """Return a run with the others that go on before and after it, and those that do not."""
    parts, left = [first], list(others)
    while True:
        before = next((run for run in left if _goes_on(run, parts[0])), None)
        after = next((run for run in left if _goes_on(parts[-1], run)), None)
        added = before or after
        if added is None:
            break
        left.remove(added)
        parts = [added, *parts] if before else [*parts, added]
    if len(parts) == 1:
        return first, left
    channels = {name: np.concatenate([part.channels[name] for part in parts]) for name in first.channels}
    t = np.concatenate([part.t for part in parts])
    return replace(first, sheets=tuple(part.sheets[0] for part in parts), t=t, channels=channels), left


def _goes_on(before: _SheetRun, after: _SheetRun) -> bool:
    pause = float(after.t[0] - before.t[-1])
    same = (before.start is None) == (after.start is None) and before.rate == after.rate
    return same and 0.0 < pause * before.rate <= _LONGEST_PAUSE


def _covers(other: _SheetRun, base: _SheetRun) -> bool:
    shared = min(other.t[-1], base.t[-1]) - max(other.t[0], base.t[0])
    same = (base.start is None) == (other.start is None)
    return same and bool(shared >= _LEAST_COVER * (base.t[-1] - base.t[0]) > 0.0)


def _shown(run: _SheetRun, index: int) -> str:
    time = float(run.t[index])
    return f"{time:g} s" if run.start is None else str(run.start + np.timedelta64(round(1e3 * time), "ms"))[:23]


def _table(runs: Sequence[_SheetRun], notes: tuple[str, ...], place: str) -> RawTable:
    """Return the table of runs on one clock, in SI units."""
    base = runs[0]
    series: list[Series] = []
    channels: dict[str, Source] = {}
    names: dict[str, str] = {}
    said = []
    for number, run in enumerate(runs):
        clock = Clock(number, partial(np.asarray, run.t), run.start)
        for name, values in run.channels.items():
            unit = run.units[name]
            channels[name] = Source.of(len(series), unit)
            label = Label(f"{name} [{unit}]", name, unit)
            series.append(Series(run.sheets[0], label, values.size, partial(np.asarray, values), clock))
        names.update(run.table.choice.names)
        if len(run.sheets) > 1:
            said.append(f"sheets {listed(run.sheets, 8)} joined: the clock goes on from one to the next")
        if number:
            said.append(f"{', '.join(run.channels)} read from sheet {run.sheets[0]}")
    time = base.table.choice.time_label
    label = Label("t [s]" if time is None else time.whole, "t", "s")
    unused = tuple(name for run in runs for name in run.table.choice.unused)
    choice = ColumnMap(len(series), label, channels, names=names, unused=unused)
    table = table_of(series, lambda *_: choice, base.table.kind, place, base.table.about)
    history = tuple(dict.fromkeys(line for run in runs for line in run.history))
    return replace(table, notes=(*history, *said, *notes, *table.notes))
