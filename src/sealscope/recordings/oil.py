"""The oil temperature of a recording: measured, or stated in the file's header."""

from __future__ import annotations

from sealscope.recordings.formats.headings.preamble import stated_oil_temperature
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.recording import Recording


def oil_temperature(recording: Recording) -> float | None:
    """Compute the mean oil temperature [deg C] of a recording; None if it is not known.

    Readings of the channel T_oil that hydraulic oil can have (`oil` in `priors.toml`) are averaged. If there are none,
    the temperature in the header of the file is returned.
    """
    if "T_oil" in recording and recording.units["T_oil"] == "K":
        limits = RECORDINGS.oil
        plausible = recording["T_oil"][(recording["T_oil"] > limits.coldest) & (recording["T_oil"] < limits.hottest)]
        if plausible.size:
            return float(plausible.mean()) - 273.15
    return stated_oil_temperature(recording.provenance)
