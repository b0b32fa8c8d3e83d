"""TDMS files of LabVIEW and its relatives, with npTDMS: groups of channels, each with the rate of its waveform."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import entries, stated_rate
from sealscope.recordings.formats.libraries import library
from sealscope.recordings.formats.table import Choose, Clock, RawTable, Series, table_of, uniform

_UNITS = ("unit_string", "NI_UnitDescription", "units", "unit", "Unit")


def read_tdms(path: Path, choose: Choose) -> RawTable:
    """Read the chosen channels of a TDMS file; raise MissingExtra where npTDMS is absent.

    A channel with the waveform's interval (``wf_increment``) has a clock; one without needs a time column or a rate.
    """
    nptdms = library("nptdms", "TDMS", "npTDMS")
    library("nptdms.log", "TDMS", "npTDMS").log_manager.set_level(logging.ERROR)  # a last segment cut short is read
    with nptdms.TdmsFile.open(path) as file:
        series = [
            Series(
                group.name,
                Label.parse(channel.name, _unit(channel.properties)),
                len(channel),
                partial(_values, channel),
                _clock(channel.properties, len(channel)),
            )
            for group in file.groups()
            for channel in group.channels()
        ]
        about = _texts(file.properties)
        stated = [stated_rate(_texts(member.properties)) for member in (file, *file.groups())]
        rate = next((rate for rate in stated if rate is not None), None)
        return table_of(series, choose, "TDMS", str(path), about, rate)


def _texts(properties: Mapping[str, Any]) -> dict[str, str]:
    return entries((name, value) for name, value in properties.items() if isinstance(value, str | int | float))


def _values(channel: Any) -> NDArray[Any]:
    return np.asarray(channel[:])


def _unit(properties: Mapping[str, Any]) -> str | None:
    return next((str(properties[key]) for key in _UNITS if properties.get(key)), None)


def _clock(properties: Mapping[str, Any], count: int) -> Clock | None:
    step = properties.get("wf_increment")
    if not isinstance(step, float | int) or not step > 0:
        return None
    start = properties.get("wf_start_time")
    moment = None if start is None else np.datetime64(start).astype("datetime64[ns]")
    if moment is not None and (np.isnat(moment) or moment < np.datetime64("1971-01-01")):
        moment = None  # a logger without a clock writes 1904
    return uniform("waveform", count, float(step), float(properties.get("wf_start_offset", 0.0)), moment)
