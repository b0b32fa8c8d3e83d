"""First-order recursive filters, such as a transducer's lag.

`scipy.signal.lfilter` computes the same, but its import takes as long as a short diagnosis. Called by the instruments
of the simulator and by the fit of the pressures' response.
"""

from __future__ import annotations

import numpy as np

from sealscope.compiled import kernel
from sealscope.signals.details import Array


def filter_recursively(values: Array, decay: float, b_0: float, b_1: float = 0.0, carried: float = 0.0) -> Array:
    """Compute y_k = decay y_(k-1) + b_0 x_k + b_1 x_(k-1) for the samples x (n,); `carried`: y_0 less b_0 x_0."""
    output = np.empty(np.size(values))
    _filter(np.ascontiguousarray(values, np.float64), decay, b_0, b_1, carried, output)
    return output


@kernel
def _filter(values: Array, decay: float, b_0: float, b_1: float, carried: float, output: Array) -> None:
    """Write the recursion of `filter_recursively` to `output` (n,)."""
    for k in range(values.size):
        output[k] = b_0 * values[k] + carried
        carried = b_1 * values[k] + decay * output[k]
