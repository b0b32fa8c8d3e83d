"""TDMS files of LabVIEW and other tools, with npTDMS: groups of channels, each with its own sampling interval."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.recordings.formats.columns import Request
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import collect_attributes, stated_rate
from sealscope.recordings.formats.libraries import import_library
from sealscope.recordings.formats.table import Clock, RecordingFields, Series, build_fields, uniform_clock

_UNITS = ("unit_string", "NI_UnitDescription", "units", "unit", "Unit")


def read_tdms(path: Path, request: Request) -> RecordingFields:
    """Read the requested channels of a TDMS file, each with its waveform interval, if stated, as its clock."""
    with import_library("nptdms", "TDMS", "npTDMS").TdmsFile.open(path) as file:
        series = []
        for group in file.groups():
            for channel in group.channels():
                properties, count = channel.properties, len(channel)
                unit = next((str(properties[key]) for key in _UNITS if properties.get(key)), None)
                read_values = partial(channel.__getitem__, slice(None))
                clock = _waveform_clock(properties, count)
                series.append(Series(group.name, Label.parse(channel.name, unit), count, read_values, clock))
        remarks, *group_remarks = (collect_attributes(member.properties) for member in (file, *file.groups()))
        rate = next(filter(None, map(stated_rate, (remarks, *group_remarks))), None)
        return build_fields(series, request, "TDMS", remarks, rate, size=path.stat().st_size)


def _waveform_clock(properties: Mapping[str, Any], count: int) -> Clock | None:
    """Build the sampling times of a channel from its waveform properties; None if these state no interval."""
    step = properties.get("wf_increment")
    if not isinstance(step, float | int) or not step > 0:
        return None
    start = properties.get("wf_start_time")
    moment = None if start is None else np.datetime64(start).astype("datetime64[ns]")
    if moment is not None and (np.isnat(moment) or moment < np.datetime64("1971-01-01")):
        moment = None  # a logger without a clock writes 1904
    first = float(properties.get("wf_start_offset", 0.0))
    return uniform_clock("waveform", count, float(step), first=first, start=moment)
