"""A loop around a rig: the methods call the controller by its address at each of its samples."""

from __future__ import annotations

from math import isfinite, isnan
from typing import NamedTuple

import numpy as np

from sealscope.compiled import call_at, law
from sealscope.physics.state import P_A, P_B, POSITION, THETA

#: Places of `Loop.whole`: outputs of the solver between two samples, samples from a measurement to its voltage, samples
#: that were taken, whether a flow that is made good was reported.
APART, DELAY, TAKEN, REPORTED = range(4)
#: Places of `Loop.numbers`: a count of position [m] and angle [rad], the lowest pressure [Pa], the largest voltage [V],
#: the last voltage that the controller asked for [V].
COUNT_X, COUNT_THETA, FLOOR, LIMIT, ASKED = range(5)


class Loop(NamedTuple):
    """A controller over a run.

    `inputs` (samples, 5): time [s], target [m], its speed [m/s], noise of p_A and p_B [Pa]; `volts` (samples + delay,)
    that act from each sample on; `compensated` (samples,) the flow [m^3/s] that is made good; `measured` (7,) of the
    last sample, which the law reads; `memory` of the law, whose first number is that flow or NaN; `addresses` (3,) of
    the law, its memory and `measured`; `numbers`, `whole`: see above.
    """

    inputs: np.ndarray
    volts: np.ndarray
    compensated: np.ndarray
    measured: np.ndarray
    memory: np.ndarray
    addresses: np.ndarray
    numbers: np.ndarray
    whole: np.ndarray


@law
def quantize(value: float, count: float) -> float:
    """Round a value down to whole counts of an encoder; a `count` of 0 leaves it."""
    return np.floor(value / count) * count if count > 0.0 else value  # type: ignore[no-any-return]


@law
def sample_controller(loop: Loop, k: int, y: np.ndarray) -> bool:
    """Call the controller at its sample k of the state `y`, once; return False where its voltage is not finite."""
    whole, numbers, measured = loop.whole, loop.numbers, loop.measured
    if k < whole[TAKEN]:
        return True
    for m in range(3):
        measured[m] = loop.inputs[k, m]
    measured[3] = quantize(y[POSITION], numbers[COUNT_X])
    measured[4] = max(y[P_A], numbers[FLOOR]) + loop.inputs[k, 3]
    measured[5] = max(y[P_B], numbers[FLOOR]) + loop.inputs[k, 4]
    measured[6] = quantize(y[THETA], numbers[COUNT_THETA])
    u = call_at(loop.addresses[0], loop.addresses[1], loop.addresses[2])
    numbers[ASKED] = u
    if not isfinite(u):
        return False
    flow = loop.memory[0]
    if not isnan(flow):
        loop.compensated[k] = flow
        whole[REPORTED] = 1
    loop.volts[k + whole[DELAY]] = min(max(u, -numbers[LIMIT]), numbers[LIMIT])
    whole[TAKEN] = k + 1
    return True
