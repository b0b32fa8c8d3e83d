"""The oil's temperature of a recording: measured, or stated beside its samples."""

from __future__ import annotations

from sealscope.recordings.formats.headings.preamble import stated_oil_temperature
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import priors_of


def oil_temperature(recording: Recording) -> float | None:
    """Return the oil's mean temperature [deg C], else what the file says beside its samples; None where neither is.

    Values that are no temperature of oil (`priors.toml`) count as missing.
    """
    if "T_oil" in recording and recording.units["T_oil"] == "K":
        oil = priors_of("sealscope.recordings")["oil"]
        known = recording["T_oil"][(recording["T_oil"] > oil["coldest"]) & (recording["T_oil"] < oil["hottest"])]
        if known.size:
            return float(known.mean()) - 273.15
    return stated_oil_temperature(recording.provenance)
