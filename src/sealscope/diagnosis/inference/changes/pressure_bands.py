"""Spectra of both chamber pressures in octaves, which a filter of one sensor or its line makes unlike.

A low-pass filter takes more of one pressure the higher the frequency. With A_k, B_k the RMS of p_A and p_B in octave k,
from periodograms of Hann windows (Welch) of which a busy one counts, two numbers are compared with healthy recordings:

    ratio = mean over the upper two octaves of log(A_k / B_k),    tilt = ratio - the same mean over the lower two.

A filter changes both alike. A load that one chamber carries changes the ratio at all frequencies, and what moves slowly
changes the lower octaves; neither changes both numbers. So the larger of their two chances is stated. Called for
recordings with both chamber pressures (`healthy_levels`).

Source: P. D. Welch, IEEE Transactions on Audio and Electroacoustics 15 (1967) 70.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.differences import Estimate, PriorScatter, compare_estimates
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array, Recording

#: `Observable.data` of the comparison of the chambers' spectra, and its name.
SIDES, BESIDE = "sides", "p_A beside p_B"
#: Minimum number of octaves, and number of those at either end that are averaged.
MIN_OCTAVES, AVERAGED = 3, 2
#: Number of samples of the median that removes single wrong ones.
GLITCH = 3
#: Minimum power whose logarithm is taken [Pa^2].
MIN_POWER = 1e-6


class Octaves(NamedTuple):
    """Log ratio of p_A to p_B in the upper octaves, and its `tilt` from the lower to the upper ones."""

    ratio: float
    tilt: float


def compare_octaves(recording: Recording) -> Octaves | None:
    """Compare the spectra of p_A and p_B of a recording by two numbers, which a filter of one pressure changes.

    They are the log ratio of their RMS in the upper octaves, and its difference from that in the lower ones (tilt).
    Return None without both pressures, or if the recording is too short or has too few octaves.
    """
    priors = CHANGES.octaves
    if not set(CHAMBERS) <= set(recording.channels):
        return None
    length = round(priors.seconds * recording.rate)
    n_octaves = int(np.log2(max(min(priors.highest, priors.share * recording.rate) / priors.lowest, 1.0)))
    if n_octaves < MIN_OCTAVES or len(recording) < length:
        return None
    edges = np.asarray(priors.lowest * 2.0 ** np.arange(n_octaves + 1))
    log_A, log_B = (_log_octave_rms(recording[name], recording.rate, length, edges) for name in CHAMBERS)
    ratios = log_A - log_B
    ratio = float(ratios[-AVERAGED:].mean())
    octaves = Octaves(ratio, ratio - float(ratios[:AVERAGED].mean()))
    return octaves if np.isfinite(octaves).all() else None


def _log_octave_rms(values: Array, rate: float, length: int, edges: Array) -> Array:
    """Compute the log RMS (k,) of a signal in the octaves between `edges` (k + 1,) [Hz], while the machine is busy.

    `values` (n,): samples at `rate` [Hz]. The spectra are those of half-overlapping windows of `length` samples. A
    high quantile over the windows is taken in each octave (`octaves.busy` in `priors.toml`), to which neither rests
    nor a single shock contribute. Single wrong samples are removed by a median of three.
    """
    from scipy.ndimage import median_filter

    values = median_filter(values, GLITCH, mode="nearest")
    frequencies, taper = np.fft.rfftfreq(length, 1.0 / rate), np.hanning(length)
    octave = np.searchsorted(edges, frequencies, side="right") - 1
    powers = []
    for start in range(0, len(values) - length + 1, max(length // 2, 1)):
        window = values[start : start + length]
        power = np.abs(np.fft.rfft((window - window.mean()) * taper)) ** 2
        powers.append([power[octave == k].sum() for k in range(len(edges) - 1)])
    return np.asarray(0.5 * np.log(np.quantile(powers, CHANGES.octaves.busy, axis=0) + MIN_POWER))


def compare_spectra(judged: Octaves, healthy: Sequence[Octaves]) -> Observable | None:
    """Test for a new low-pass filter of one pressure, such as a clogged line, against healthy recordings.

    A filter changes ratio and tilt of the spectra in the same direction; otherwise the chance is 1. A tilt smaller
    than filters usually cause lowers the observable's advantage. Return None for too few healthy recordings.
    """
    prior, filtered = CHANGES.octaves, CHANGES.filtered

    def compare(values: Sequence[float], value: float) -> Observable | None:
        """Test if the judged ratio or tilt `value` differs from the healthy `values`; None if these are too few."""
        estimates = [Estimate(healthy_value, prior.error) for healthy_value in values]
        scatter = PriorScatter(prior.scatter, prior.recordings)
        return compare_estimates(BESIDE, SIDES, Estimate(value, prior.error), estimates, scatter)

    ratio = compare([octaves.ratio for octaves in healthy], judged.ratio)
    tilt = compare([octaves.tilt for octaves in healthy], judged.tilt)
    if ratio is None or tilt is None:
        return None
    weaker = max(ratio, tilt, key=lambda test: test.chance)
    if ratio.size * tilt.size <= 0.0:
        return replace(weaker, score=0.0, chance=1.0)
    deviations = np.log(max(abs(tilt.size), prior.error) / filtered.size) / filtered.spread
    return replace(weaker, size=tilt.size, advantage=-float(min(deviations, 0.0) ** 2))
