"""MDF 3 and 4, the measurement files of CANape and its relatives, with asammdf: groups with a time channel each."""

from __future__ import annotations

from datetime import UTC
from functools import partial
from pathlib import Path
from traceback import walk_tb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.formats.cells import MOST_WORDS
from sealscope.recordings.formats.columns import Wanted
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import entries
from sealscope.recordings.formats.libraries import library
from sealscope.recordings.formats.table import Clock, RecordingFields, Series, table_of


def read_mdf(path: Path, request: Wanted) -> RecordingFields:
    """Read the wanted channels in physical values; frames of a bus that nobody has decoded are no channels."""
    with _opened(library("asammdf", "MDF", "asammdf").MDF, path) as file:
        moment = np.datetime64(file.header.start_time.astimezone(UTC).replace(tzinfo=None), "us")
        start = moment if moment > np.datetime64("1980-01-02") else None  # a file without a date has 1980 or before
        series = []
        groups: list[Any] = file.groups
        for number, group in enumerate(groups):
            count = int(group.channel_group.cycles_nr)
            master = file.masters_db.get(number)

            def seconds(number: int = number) -> Any:
                return np.asarray(file.get_master(number), dtype=np.float64), start

            clock = None if master is None else Clock(number, seconds)
            name = str(getattr(group.channel_group, "comment", "") or "").strip() or f"group {number + 1}"
            for index, channel in enumerate(group.channels):
                if index != master:
                    label = Label.parse(channel.name, file.get_channel_unit(group=number, index=index) or None)
                    series.append(Series(name, label, count, partial(_values, file, number, index), clock))
        header = ("author", "department", "project", "subject", "comment")
        remarks = entries((name, getattr(file.header, name, "")) for name in header)
        return table_of(series, request, f"MDF {file.version}", remarks, size=path.stat().st_size)


def _opened(MDF: Any, path: Path) -> Any:
    try:
        return MDF(path)
    except Exception as error:
        for frame, _ in walk_tb(error.__traceback__):  # what is half built has nothing to close, and would say so
            half: Any = frame.f_locals.get("self")
            if hasattr(half, "_closed"):
                half._closed = True
        raise


def _values(file: Any, group: int, index: int) -> NDArray[Any]:
    values = np.asarray(file.get(group=group, index=index).samples)
    if values.dtype.kind not in "OSU":
        return values
    # a conversion has texts for some values (`SNA`): these are missing, and the others numbers
    raw = file.get(group=group, index=index, raw=True)
    numbers = np.asarray(raw.physical(ignore_value2text_conversions=True).samples)
    named = np.array([isinstance(cell, bytes | str) and bool(cell) for cell in values.tolist()])
    if numbers.dtype.kind not in "fiu" or np.count_nonzero(named) > MOST_WORDS * named.size:
        return values
    return np.where(named, np.nan, numbers)
