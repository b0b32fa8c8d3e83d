"""Tails of the largest statistic of a scan, and the interval of the onset at which it is largest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array

#: 95 % of the time the likelihood ratio at the true instant is within this of its maximum: P(2 log LR <= x) = (1 -
#: exp(-x/2))^2 (Eo & Morley, Likelihood-ratio-based confidence sets for the timing of structural breaks, Quantitative
#: Economics 6 (2015) 463-497).
ONSET_CUT = -2.0 * float(np.log(1.0 - np.sqrt(0.95)))


def near_best(profile: Array, scale: float = 1.0) -> NDArray[np.intp]:
    """Return the places of a profile of twice the log likelihood (k,) that 95 % confidence cannot exclude.

    `scale`: variance of the scatter over the stated one.
    """
    return np.flatnonzero(profile >= profile.max() - scale * ONSET_CUT)


def upper_quantile(null: Array, probability: float) -> Array:
    """Return the threshold that a null sample (m, ...) exceeds with `probability`.

    Its order statistic of rank ceil((1 - p)(m + 1)), so that the probability is at most p.
    """
    m = null.shape[0]
    rank = min(m, int(np.ceil((1.0 - probability) * (m + 1) - 1e-9)))
    return np.asarray(np.sort(null, axis=0)[rank - 1])
