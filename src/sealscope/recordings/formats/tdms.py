"""TDMS files of LabVIEW and its relatives, with npTDMS: groups of channels, each with the rate of its waveform."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.recordings.formats.columns import Wanted
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import entries, stated_rate
from sealscope.recordings.formats.libraries import library
from sealscope.recordings.formats.table import Clock, RecordingFields, Series, table_of, uniform

_UNITS = ("unit_string", "NI_UnitDescription", "units", "unit", "Unit")


def read_tdms(path: Path, request: Wanted) -> RecordingFields:
    """Read the wanted channels; one with the waveform's interval (``wf_increment``) has a clock."""
    nptdms = library("nptdms", "TDMS", "npTDMS")
    library("nptdms.log", "TDMS", "npTDMS").log_manager.set_level(logging.ERROR)  # a last segment cut short is read
    with nptdms.TdmsFile.open(path) as file:
        series = []
        for group in file.groups():
            for channel in group.channels():
                properties = channel.properties
                label = Label.parse(
                    channel.name, next((str(properties[key]) for key in _UNITS if properties.get(key)), None)
                )
                values = partial(channel.__getitem__, slice(None))
                series.append(Series(group.name, label, len(channel), values, _clock(properties, len(channel))))
        remarks, *group_remarks = (
            entries((name, value) for name, value in member.properties.items() if isinstance(value, str | int | float))
            for member in (file, *file.groups())
        )
        stated = next(filter(None, map(stated_rate, (remarks, *group_remarks))), None)
        return table_of(series, request, "TDMS", remarks, stated, size=path.stat().st_size)


def _clock(properties: Mapping[str, Any], count: int) -> Clock | None:
    step = properties.get("wf_increment")
    if not isinstance(step, float | int) or not step > 0:
        return None
    start = properties.get("wf_start_time")
    moment = None if start is None else np.datetime64(start).astype("datetime64[ns]")
    if moment is not None and (np.isnat(moment) or moment < np.datetime64("1971-01-01")):
        moment = None  # a logger without a clock writes 1904
    return uniform("waveform", count, float(step), float(properties.get("wf_start_offset", 0.0)), moment)
