"""The oil temperature of a recording: measured, or stated in the file's header."""

from __future__ import annotations

from sealscope.recordings.formats.headings.preamble import stated_oil_temperature
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.recording import Recording


def oil_temperature(recording: Recording) -> float | None:
    """Find the oil temperature [deg C], the mean of T_oil or else the value in the file's header; None if unknown."""
    measured = measured_oil_temperature(recording)
    return stated_oil_temperature(recording.provenance) if measured is None else measured


def measured_oil_temperature(recording: Recording) -> float | None:
    """Compute the mean [deg C] of the plausible readings of the channel T_oil; None if there are none.

    Plausible readings are within the range `oil` of `priors.toml`. A channel in raw counts has none.
    """
    if "T_oil" not in recording or recording.units["T_oil"] != "K":
        return None
    limits, kelvin = RECORDINGS.oil, recording["T_oil"]
    plausible = kelvin[(kelvin > limits.coldest) & (kelvin < limits.hottest)]
    return float(plausible.mean()) - 273.15 if plausible.size else None
