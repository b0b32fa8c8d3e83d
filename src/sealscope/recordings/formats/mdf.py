"""MDF 3 and 4, the measurement files of CANape and its relatives, with asammdf: groups with a time channel each."""

from __future__ import annotations

from datetime import UTC
from functools import partial
from pathlib import Path
from traceback import walk_tb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.channels import Array
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import entries
from sealscope.recordings.formats.libraries import library
from sealscope.recordings.formats.table import MOST_WORDS, Choose, Clock, RawTable, Series, table_of


def read_mdf(path: Path, choose: Choose) -> RawTable:
    """Read the chosen channels of an MDF file in physical values; raise MissingExtra where asammdf is absent.

    Frames of a bus that nobody has decoded are no channels.
    """
    with _opened(library("asammdf", "MDF", "asammdf").MDF, path) as file:
        start = _start(file)
        series = []
        groups: list[Any] = file.groups
        for number, group in enumerate(groups):
            count = int(group.channel_group.cycles_nr)
            master = file.masters_db.get(number)
            clock = None if master is None else Clock(number, partial(_seconds, file, number, start))
            name = str(getattr(group.channel_group, "comment", "") or "").strip() or f"group {number + 1}"
            for index, channel in enumerate(group.channels):
                if index != master:
                    label = Label.parse(channel.name, file.get_channel_unit(group=number, index=index) or None)
                    series.append(Series(name, label, count, partial(_values, file, number, index), clock))
        header = ("author", "department", "project", "subject", "comment")
        about = entries((name, getattr(file.header, name, "")) for name in header)
        return table_of(series, choose, f"MDF {file.version}", str(path), about)


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
    numbers = np.asarray(
        file.get(group=group, index=index, raw=True).physical(ignore_value2text_conversions=True).samples
    )
    named = np.array([isinstance(cell, bytes | str) and bool(cell) for cell in values.tolist()])
    if numbers.dtype.kind not in "fiu" or np.count_nonzero(named) > MOST_WORDS * named.size:
        return values
    return np.where(named, np.nan, numbers)


def _seconds(file: Any, group: int, start: np.datetime64 | None) -> tuple[Array, np.datetime64 | None]:
    return np.asarray(file.get_master(group), dtype=np.float64), start


def _start(file: Any) -> np.datetime64 | None:
    """Return the moment of the measurement's beginning in UTC; None where the file has none (1980 and before)."""
    moment = np.datetime64(file.header.start_time.astimezone(UTC).replace(tzinfo=None), "us")
    return moment if moment > np.datetime64("1980-01-02") else None
