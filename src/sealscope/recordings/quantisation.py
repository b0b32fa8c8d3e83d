"""The quantisation step of a channel, as it shows in the samples."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.channels import Array

#: Changes up to this fraction of a reading's largest value are rounding errors: the reading does not move.
ROUNDING = 1e-9
#: A longer channel is thinned to this many samples, or up to twice as many.
_QUANTUM_SAMPLES = 2**15


def smallest_step(values: Array) -> float:
    """Find the smallest step of sorted `values` (n > 0,) that exceeds `ROUNDING` times their range; 0 if none does."""
    steps = np.diff(values)
    steps = steps[steps > ROUNDING * (values[-1] - values[0])]
    return float(steps.min()) if steps.size else 0.0


def estimate_quantum(values: Array) -> float:
    """Estimate the quantisation step of finite values (n > 0,), thinned if they are many; 0 if all are equal."""
    return smallest_step(np.unique(values[:: max(1, values.size // _QUANTUM_SAMPLES)]))
