"""The oil temperature of a recording: measured, or stated in the file's header."""

from __future__ import annotations

import re

from sealscope.recordings.formats.headings.labels import Label, find_name_and_unit, is_oil_temperature, names_oil
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.recording import Recording

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
