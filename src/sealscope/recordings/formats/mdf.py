"""MDF 3 and 4, the measurement files of CANape and other tools, with asammdf: groups with a time channel each."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.channels import Array
from sealscope.recordings.formats.cells import MAX_WORD_FRACTION
from sealscope.recordings.formats.columns import Request
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import collect_remarks
from sealscope.recordings.formats.libraries import import_library
from sealscope.recordings.formats.table import Clock, RecordingFields, Series, build_fields


def read_mdf(path: Path, request: Request) -> RecordingFields:
    """Read the requested channels of an MDF file in physical values, without decoding bus frames; needs asammdf."""
    with import_library("asammdf", "MDF", "asammdf").MDF(path) as file:
        start_time = np.datetime64(file.header.start_time.astimezone(UTC).replace(tzinfo=None), "us")
        # a file without a date states 1980 or before
        start = start_time if start_time > np.datetime64("1980-01-02") else None
        series = []
        groups: list[Any] = file.groups
        names = _name_groups(groups)
        for number, group in enumerate(groups):
            count = int(group.channel_group.cycles_nr)
            master = file.masters_db.get(number)  # index of the group's time channel
            clock = None if master is None else Clock(number, partial(_read_times, file, number, start))
            name = names[number]
            for index, channel in enumerate(group.channels):
                if index != master:
                    label = Label.parse(channel.name, file.get_channel_unit(group=number, index=index) or None)
                    series.append(Series(name, label, count, partial(_read_values, file, number, index), clock))
        header = ("author", "department", "project", "subject", "comment")
        remarks = collect_remarks((name, getattr(file.header, name, "")) for name in header)
        return build_fields(series, request, f"MDF {file.version}", remarks, size=path.stat().st_size)


def _name_groups(groups: Sequence[Any]) -> list[str]:
    """List the names of groups of channels: of the acquisition, its source, or the comment; else they are numbered.

    If several groups have one name, their numbers are added to it.
    """
    names = []
    for number, group in enumerate(groups, 1):
        channel_group = group.channel_group
        source = getattr(channel_group, "acq_source", None)
        entries = (getattr(channel_group, "acq_name", ""), getattr(source, "name", ""), channel_group.comment)
        texts = (str(entry or "").strip() for entry in entries)
        names.append(next(filter(None, texts), f"group {number}"))
    return [f"{name} {k}" if names.count(name) > 1 else name for k, name in enumerate(names, 1)]


def _read_times(file: Any, group: int, start: np.datetime64 | None) -> tuple[Array, np.datetime64 | None]:
    """Read the times (n,) [s] of a group of channels; return them with `start`, the time stamp of 0 s."""
    return np.asarray(file.get_master(group), dtype=np.float64), start


def _read_values(file: Any, group: int, index: int) -> NDArray[Any]:
    """Read the samples (n,) of the channel `index` of a `group` of an open MDF file.

    Texts among numbers, such as `SNA`, become NaN if they are at most the fraction `MAX_WORD_FRACTION` of the samples.
    With more texts, or without numbers, the samples are returned as texts.
    """
    values = np.asarray(file.get(group=group, index=index).samples)
    if values.dtype.kind not in "OSU":
        return values
    raw = file.get(group=group, index=index, raw=True)
    numbers = np.asarray(raw.physical(ignore_value2text_conversions=True).samples)
    is_text = np.array([isinstance(cell, bytes | str) and bool(cell) for cell in values.tolist()])
    if numbers.dtype.kind not in "fiu" or np.count_nonzero(is_text) > MAX_WORD_FRACTION * is_text.size:
        return values
    return np.where(is_text, np.nan, numbers)
