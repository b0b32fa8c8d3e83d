"""The oil temperature of a recording: measured, or stated in the file's header."""

from __future__ import annotations

from sealscope.recordings.formats.headings.preamble import stated_oil_temperature
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.recording import Recording


def oil_temperature(recording: Recording) -> float | None:
    """Compute the mean oil temperature [deg C] of a recording; None if it is not known.

    The channel T_oil is averaged, without readings that no hydraulic oil can have (`oil` in `priors.toml`). Without
    such readings the temperature in the file's header is taken.
    """
    if "T_oil" in recording and recording.units["T_oil"] == "K":
        limits = RECORDINGS.oil
        plausible = recording["T_oil"][(recording["T_oil"] > limits.coldest) & (recording["T_oil"] < limits.hottest)]
        if plausible.size:
            return float(plausible.mean()) - 273.15
    return stated_oil_temperature(recording.provenance)
