"""What the header and the name of a recording's file state beside its samples: start time and oil temperature."""

from __future__ import annotations

import re
from numbers import Real
from pathlib import Path

import numpy as np

from sealscope.recordings.formats.headings.labels import Label, find_name_and_unit, is_oil_temperature, names_oil
from sealscope.recordings.formats.times.timebase import counts_from_1970, parse_epoch, parse_name
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.recording import Recording

_DAY = 86400.0  # [s]
_MAX_SECONDS = 1e11  # start [s] beyond which times are in another unit than s: it would be in the year 5138
_TEMPERATURE = re.compile(
    r"(?P<value>[-+]?\d{1,3}(?:[.,]\d{1,3})?)\s*(?P<unit>°\s?[CF]|deg\s?[CF]|[CFK]\b|℃)", re.IGNORECASE
)


def oil_temperature(recording: Recording) -> float | None:
    """Find the oil temperature [deg C], the mean of T_oil or else the value in the file's header; None if unknown."""
    measured = measured_oil_temperature(recording)
    return _stated_oil_temperature(recording) if measured is None else measured


def measured_oil_temperature(recording: Recording) -> float | None:
    """Compute the mean [deg C] of the plausible readings of the channel T_oil; None if there are none.

    Plausible readings are within the range `oil` of `priors.toml`. A channel in raw counts has none.
    """
    if "T_oil" not in recording or recording.units["T_oil"] != "K":
        return None
    limits, kelvin = RECORDINGS.oil, recording["T_oil"]
    plausible = kelvin[(kelvin > limits.coldest) & (kelvin < limits.hottest)]
    return float(plausible.mean()) - 273.15 if plausible.size else None


def _stated_oil_temperature(recording: Recording) -> float | None:
    """Find the first plausible oil temperature [deg C] in the remarks of a recording's file; None if there is none.

    A remark that names the oil goes before one such as `Temperature` or `TT101`. That of something else, such as
    `Ambient temperature`, does not count. Plausible values are within the range `oil` of `priors.toml`.
    """
    limits = RECORDINGS.oil
    for label, text in sorted(recording.remarks.items(), key=lambda remark: not names_oil(remark[0])):
        name, unit_of_name = find_name_and_unit(Label.parse(label))
        match = _TEMPERATURE.search(f"{text} {unit_of_name or ''}")  # the unit is in the text or in the name
        # a name without letters may be the hour of a clock
        if match is None or not any(map(str.isalpha, name)) or not is_oil_temperature(name):
            continue
        value = float(match["value"].replace(",", "."))
        unit = match["unit"].upper().replace("℃", "C")[-1]  # C, F or K
        celsius = (value - 32.0) / 1.8 if unit == "F" else value - 273.15 if unit == "K" else value
        if limits.coldest < celsius + 273.15 < limits.hottest:
            return celsius
    return None


def start_seconds(recording: Recording, file: str = "") -> float | None:
    """Find the time of a recording's first sample [s since 1970]; None if it is not known.

    The time of t = 0 is the entry `start_epoch_s` or `start` of the provenance. Without these entries it is the date in
    the file's name: the entry `file` of the provenance, or the argument `file` if that entry is missing, too; so it is
    if the entry `start` is that day without a time. Dates and times are taken as UTC; a date alone means midnight.
    """
    start, provenance = time_zero(recording), recording.provenance
    named_start = parse_name(str(provenance.get("file") or file), provenance.get("name_order"))
    has_time = "T" in str(provenance.get("start", "T"))
    if start is None or (not has_time and named_start is not None and 0.0 <= named_start - start < _DAY):
        start = named_start
    if start is None:
        return None
    known = np.flatnonzero(np.isfinite(recording.t))  # samples with a time, which the first may lack
    first = float(recording.t[known[0]]) - int(known[0]) / recording.rate if known.size else 0.0
    return start + first if abs(start + first) < _MAX_SECONDS else None


def file_seconds(recording: Recording, path: Path) -> float:
    """Find the time of a file's first sample [s since 1970].

    If it is not known (`start_seconds`), it is the time of the file's last change minus the duration of the recording.
    """
    start = start_seconds(recording, path.name)
    if start is not None:
        return start
    times = recording.t[np.isfinite(recording.t)]
    return path.stat().st_mtime - (float(times[-1] - times[0]) if times.size else 0.0)


def time_zero(recording: Recording) -> float | None:
    """Find the time of t = 0 [s since 1970] in the entry `start_epoch_s` or else `start` of the provenance, or None.

    A `start_epoch_s` outside of March 1973 to the year 5138 (`counts_from_1970`) is ignored.
    """
    epoch = recording.provenance.get("start_epoch_s")
    if isinstance(epoch, Real) and counts_from_1970(float(epoch)):
        return float(epoch)
    return parse_epoch(str(recording.provenance.get("start", "")))
