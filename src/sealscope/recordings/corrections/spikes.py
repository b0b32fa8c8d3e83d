"""Single samples that a transmission error sets to zero or full scale: they are no readings.

Such a sample leaps and returns at once, by several times more than any other change around it. It is set to NaN and
bridged as a gap. The inspection calls it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.channels import SLOW, Array
from sealscope.recordings.motion import quantum
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import priors_of

_PRIORS = priors_of("sealscope.recordings")["spike"]
#: Samples on either side whose changes a spike is compared with, and the fewest of a channel.
_AROUND, _FEWEST = 10, 50
_QUANTA = 10.0
#: Changes that tell how large a channel's changes are.
_TOLD = 2**15


def without_spikes(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Set single samples that leap and return to NaN; return the recording and what was found."""
    channels, findings = dict(recording.channels), list[Finding]()
    for name, values in recording.channels.items():
        spikes = spike_rows(values) if name not in SLOW and name != "u" else np.empty(0, dtype=np.intp)
        if not spikes.size:
            continue
        channels[name] = values.copy()
        channels[name][spikes] = np.nan
        far = "samples leap and return" if spikes.size > 1 else "sample leaps and returns"
        text = f"{name}: {spikes.size} {far} at once, first to {values[spikes[0]]:g} {recording.units[name]}: left out"
        findings.append(Finding("spike", "note", name, spikes.size, float(recording.t[spikes[0]]), text))
    return (replace(recording, channels=channels) if findings else recording), findings


def spike_rows(values: Array) -> NDArray[np.intp]:
    """Return the rows of a channel (n,) whose sample leaps and returns."""
    known = np.flatnonzero(np.isfinite(values))
    if known.size < _FEWEST:
        return np.empty(0, dtype=np.intp)
    steps = np.diff(values[known])
    size = np.abs(steps)
    leap = np.where(steps[:-1] * steps[1:] < 0.0, np.minimum(size[:-1], size[1:]), 0.0)
    usual = float(np.quantile(size[:: max(1, size.size // _TOLD)], 0.9))
    least = _PRIORS["times"] * usual + _QUANTA * quantum(values[known])
    rows = []
    for k in np.flatnonzero(leap > least).tolist():
        around = np.r_[size[max(k - _AROUND, 0) : k], size[k + 2 : k + 2 + _AROUND]]
        if leap[k] > _PRIORS["times"] * around.max(initial=0.0):
            rows.append(known[k + 1])
    return np.array(rows if len(rows) <= _PRIORS["share"] * known.size else [], dtype=np.intp)
