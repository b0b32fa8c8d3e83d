"""Spikes: single samples that a transmission error sets to zero or full scale.

The value leaps and returns at once. The leap is several times larger than any other one nearby, than the channel's
slope there, and than its usual changes. A pressure that rises within one sample is kept, because it does not return.
Spikes are set to NaN and bridged as gaps. Called by the inspection.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.channels import SLOW, Array, estimate_quantum
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.quality import Finding, locate_rows
from sealscope.recordings.recording import Recording

_PRIORS = RECORDINGS.spike
#: Number of leaps on either side with which a spike is compared, and fewest samples of a channel.
_NEIGHBOURS, _MIN_SAMPLES = 10, 50
_MIN_QUANTA = 10.0  # smallest spike, in quantisation steps
#: More changes are thinned to this many, or up to twice as many, to estimate the usual size of a change.
_N_CHANGES = 2**15


def remove_spikes(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Replace spikes by NaN in all channels but slow ones and the command u, which may jump.

    Returns the recording, and a finding for each channel with spikes.
    """
    channels, findings = dict(recording.channels), list[Finding]()
    for name, values in recording.channels.items():
        spikes = find_spikes(values) if name not in SLOW and name != "u" else np.empty(0, dtype=np.intp)
        if not spikes.size:
            continue
        channels[name] = values.copy()
        channels[name][spikes] = np.nan
        phrase = "sample leaps and returns" if spikes.size == 1 else "samples leap and return"
        first = recording.format_value(name, values[spikes[0]])
        text = f"{name}: {spikes.size} {phrase} at once, first to {first}: left out"
        places = locate_rows(recording.t, spikes)
        findings.append(Finding("spike", "note", name, spikes.size, float(recording.t[spikes[0]]), text, places))
    return (replace(recording, channels=channels) if findings else recording), findings


def find_spikes(values: Array) -> NDArray[np.intp]:
    """Find the indices of the samples at which a channel (n,) leaps and returns at once.

    Such a sample lies above both neighbours, or below both. With m = `spike.times` (`priors.toml`), the smaller of its
    two steps must exceed m times the usual step (the 0.9 quantile) plus 10 quantisation steps, and also m times the
    local slope and any other leap nearby. The number of a logger's errors has a Poisson distribution with the mean
    `spike.share` times the number of samples. If the probability of at least as many errors as spikes is below
    `spike.tail`, the signal itself leaps, and the result is empty; also for fewer than 50 finite samples.
    """
    from scipy.special import pdtrc

    known = np.flatnonzero(np.isfinite(values))
    if known.size < _MIN_SAMPLES:
        return np.empty(0, dtype=np.intp)
    steps = np.diff(values[known])
    step_sizes = np.abs(steps)
    # jumps[k]: if sample k + 1 leaps and returns, the smaller of its two changes, else 0
    jumps = np.where(steps[:-1] * steps[1:] < 0.0, np.minimum(step_sizes[:-1], step_sizes[1:]), 0.0)
    thinned_sizes = step_sizes[:: max(1, step_sizes.size // _N_CHANGES)]  # enough for a quantile
    usual_step = float(np.quantile(thinned_sizes, 0.9))
    threshold = _PRIORS.times * usual_step + _MIN_QUANTA * estimate_quantum(values[known])
    # larger change just before or after the leap; the slope is the larger of this and the mean change across the leap
    outer_steps = np.maximum(np.append(0.0, step_sizes[:-2]), np.append(step_sizes[2:], 0.0))
    slopes = np.maximum(0.5 * np.abs(steps[:-1] + steps[1:]), outer_steps)
    rows = []
    for k in np.flatnonzero(jumps > threshold).tolist():
        nearby_jumps = np.r_[jumps[max(k - _NEIGHBOURS, 0) : k], jumps[k + 1 : k + 1 + _NEIGHBOURS]]
        if jumps[k] > _PRIORS.times * max(slopes[k], nearby_jumps.max(initial=0.0)):
            rows.append(known[k + 1])
    # more leaps than the errors of a logger explain; pdtrc: Poisson probability of more events than its first argument
    is_signal = bool(rows) and pdtrc(len(rows) - 1, _PRIORS.share * known.size) < _PRIORS.tail
    return np.array([] if is_signal else rows, dtype=np.intp)
