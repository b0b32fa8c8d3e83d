"""The oil's temperature of a recording: measured, or stated beside its samples."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.formats.headings.preamble import stated_oil_temperature
from sealscope.recordings.recording import Recording


def oil_temperature(recording: Recording) -> float | None:
    """Return the oil's mean temperature [deg C], else what the file says beside its samples; None where neither is.

    Values that are no temperature of oil, below 213 K or above 473 K, count as missing.
    """
    if "T_oil" in recording and recording.units["T_oil"] == "K":
        known = recording["T_oil"][np.abs(recording["T_oil"] - 343.15) < 130.0]
        if known.size:
            return float(known.mean()) - 273.15
    return stated_oil_temperature(recording.provenance)
