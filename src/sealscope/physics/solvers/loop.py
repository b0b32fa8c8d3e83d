"""A control loop around a rig, as arrays for compiled code: the solver calls the controller by its address."""

from __future__ import annotations

from math import isfinite, isnan
from typing import Any, NamedTuple

import numpy as np

from sealscope.compiled import call_at, law
from sealscope.physics.state import P_A, P_B, POSITION, THETA

#: Indices of `Loop.counters`:
#: - SPACING: the controller takes a sample at each SPACING-th output of the solver.
#: - DELAY: samples from a measurement to the time at which its voltage acts.
#: - SAMPLED: samples taken so far. REPORTED: 1 once the controller has reported a compensated flow, until then 0.
SPACING, DELAY, SAMPLED, REPORTED = range(4)
#: Indices of `Loop.numbers`: one count of the encoders of position [m] and angle [rad], lowest pressure [Pa] (that of
#: vapour if the oil boils), largest voltage [V], and the controller's last voltage before it was limited [V].
COUNT_X, COUNT_THETA, MIN_PRESSURE, MAX_VOLTAGE, LAST_VOLTAGE = range(5)


class Loop(NamedTuple):
    """Inputs, memory and outputs of a controller over a run, as arrays for compiled code.

    - `inputs` (samples, 5): time [s], target [m], speed of the target [m/s], noise of p_A and of p_B [Pa].
    - `volts` (samples + delay,): the voltage [V] that acts from each sample on.
    - `compensated` (samples,): leakage flow [m^3/s] that the controller compensates.
    - `measured` (7,): latest inputs of the control law: time, target, speed of the target, position [m], p_A and p_B
      [Pa], and motor angle [rad].
    - `memory`: state of the control law. Its first element is the compensated flow, NaN if the law reports none.
    - `addresses` (3,): memory addresses of the control law's machine code, of `memory` and of `measured`.
    - `numbers`, `counters`: indexed by the constants above.
    """

    inputs: np.ndarray
    volts: np.ndarray
    compensated: np.ndarray
    measured: np.ndarray
    memory: np.ndarray
    addresses: np.ndarray
    numbers: np.ndarray
    counters: np.ndarray


@law
def quantize(value: Any, count: float) -> Any:
    """Round numbers or arrays down to multiples of an encoder's step `count`; 0 leaves them unchanged."""
    return np.floor(value / count) * count if count > 0.0 else value


@law
def sample_controller(loop: Loop, k: int, y: np.ndarray) -> bool:
    """Measure the state `y` (14,) and call the controller for its sample number k; return False if it fails.

    The controller fails if its voltage is not finite. The voltage, limited to +-MAX_VOLTAGE, and a reported flow are
    stored in the `loop`. A sample that is already taken keeps its voltage, which the solver needs when it repeats a
    part of the run at half the step.
    """
    counters, numbers, measured = loop.counters, loop.numbers, loop.measured
    if k < counters[SAMPLED]:
        return True
    for m in range(3):  # time, target and its speed
        measured[m] = loop.inputs[k, m]
    measured[3] = quantize(y[POSITION], numbers[COUNT_X])
    measured[4] = max(y[P_A], numbers[MIN_PRESSURE]) + loop.inputs[k, 3]
    measured[5] = max(y[P_B], numbers[MIN_PRESSURE]) + loop.inputs[k, 4]
    measured[6] = quantize(y[THETA], numbers[COUNT_THETA])
    u = call_at(loop.addresses[0], loop.addresses[1], loop.addresses[2])  # law, memory, measured
    numbers[LAST_VOLTAGE] = u
    if not isfinite(u):
        return False
    compensated_flow = loop.memory[0]
    if not isnan(compensated_flow):
        loop.compensated[k] = compensated_flow
        counters[REPORTED] = 1
    loop.volts[k + counters[DELAY]] = min(max(u, -numbers[MAX_VOLTAGE]), numbers[MAX_VOLTAGE])
    counters[SAMPLED] = k + 1
    return True
