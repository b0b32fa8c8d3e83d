"""The oil's temperature of a recording: measured, or stated beside its samples."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.formats.headings.preamble import stated_oil_temperature
from sealscope.recordings.recording import Recording


def oil_temperature(recording: Recording) -> float | None:
    """Return the oil's mean temperature [deg C], else what the file says beside its samples; None where neither is."""
    if "T_oil" in recording and np.any(known := np.isfinite(recording["T_oil"])):
        return float(recording["T_oil"][known].mean()) - 273.15
    return stated_oil_temperature(recording.provenance)
