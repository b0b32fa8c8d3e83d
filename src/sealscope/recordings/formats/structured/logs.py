"""Text logs of any shape: a table with one time, a time for each channel, a row for each sample of one channel."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.formats import text
from sealscope.recordings.formats.columns import ColumnMap
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import exported_from
from sealscope.recordings.formats.headings.proposal import is_time, unit_of_time
from sealscope.recordings.formats.series import CLOCK_LABEL, Clock, Series, table_of
from sealscope.recordings.formats.structured.long_table import long_columns, read_long
from sealscope.recordings.formats.table import Choose, RawTable
from sealscope.recordings.formats.text_layout import Layout
from sealscope.units import to_si

#: The number of a column of times: `t.1` of pandas, `Time 2 - slow` of catman.
_NUMBER = re.compile(r"[\s._(-]{0,4}\d{1,4}\b.{0,60}")


def read_text(path: Path, choose: Choose) -> RawTable:
    """Read the chosen columns of a text log."""
    layout = text.look_at(path)
    shape = long_columns(layout.labels)
    if shape is not None and not _fits(layout, choose):
        return read_long(path, choose, layout, shape)
    times = _times_of_channels(layout.labels)
    if times:
        try:
            return _each_on_its_clock(path, choose, layout, times)
        except InputError:
            if not _fits(layout, choose):
                raise
    return text.read_table(path, choose, layout)


def is_one_table(path: Path) -> bool:
    """Return whether a text log is a table with one time: rows that can be read one after the other."""
    labels = text.look_at(path).labels
    return long_columns(labels) is None and not _times_of_channels(labels)


def _fits(layout: Layout, choose: Choose) -> bool:
    """Return whether the columns as they stand are those of a recording."""
    try:
        choose(layout.labels, layout.rate)
    except InputError:
        return False
    return True


def _times_of_channels(labels: Sequence[Label]) -> list[int]:
    """Return the columns of times of a table in which each channel, or group of channels, follows its own; else none.

    They bear one name, but for a number at its end.
    """
    names = [_NUMBER.sub("", label.name.casefold()) for label in labels]
    if names.count(names[0]) < 2 or not is_time(labels[0]):
        return []
    times = [column for column, label in enumerate(labels) if is_time(label)]
    apart = all(after - before > 1 for before, after in zip(times, [*times[1:], len(labels)], strict=True))
    return times if len({names[column] for column in times}) == 1 and len(times) > 1 and apart else []


@dataclass(frozen=True)
class _Several(ColumnMap):
    """Columns to read, several of them as times."""

    wanted: tuple[tuple[int, bool], ...] = field(default=())

    @property
    def columns(self) -> list[tuple[int, bool]]:
        return list(self.wanted)


def _each_on_its_clock(path: Path, choose: Choose, layout: Layout, times: Sequence[int]) -> RawTable:
    """Read the chosen channels, each with the times before it, and bring them to one clock."""
    place = str(path)
    labels = layout.labels
    values = [column for column in range(len(labels)) if column not in times and labels[column].whole]
    choice = choose([*(labels[column] for column in values), CLOCK_LABEL], layout.rate)
    wanted = [values[column] for column, _ in choice.columns if column < len(values)]
    owner = {column: max(time for time in times if time < column) for column in wanted}
    read = [(column, column in times) for column in sorted({*wanted, *owner.values()})]
    table = text.read_table(path, lambda *_: _Several(None, None, {}, wanted=tuple(read)), layout)
    samples = dict(zip((column for column, _ in read), table.columns, strict=True))
    start = exported_from(layout.about)
    clocks = {time: _clock(samples[time], labels[time], time, start) for time in set(owner.values())}
    series = []
    for column in values:
        if column not in owner:
            series.append(Series("", labels[column], 0, partial(np.empty, 0)))
            continue
        kept = _known(samples[owner[column]])
        own = samples[column][kept]
        series.append(Series("", labels[column], own.size, partial(np.asarray, own), clocks[owner[column]]))
    joined = table_of(series, choose, layout.kind, place, layout.about, layout.rate)
    return replace(joined, notes=(*table.notes, f"{len(clocks)} columns of times, one for each channel", *joined.notes))


def _known(times: NDArray[Any]) -> NDArray[np.bool_]:
    return np.asarray(~np.isnat(times) if times.dtype.kind == "M" else np.isfinite(times))


def _clock(times: NDArray[Any], label: Label, key: int, start: np.datetime64 | None) -> Clock:
    known = times[_known(times)]
    if known.size == 0:
        raise UnreadableFile(f"time must have a number in some row, got none in column {label.whole}")
    if known.dtype.kind == "M":
        first = known[0]
        return Clock(key, partial(np.asarray, (known - first).astype(np.int64) / 1e9), first)
    seconds = to_si(known, label.unit or unit_of_time(label) or "s", "s", name="time")
    return Clock(key, partial(np.asarray, seconds), start)
