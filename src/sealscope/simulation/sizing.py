"""Search for the leakage coefficients that give stated mean flows at the rig's operating point."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from sealscope.errors import SimulationFailed
from sealscope.recordings.recording import Array
from sealscope.simulation.leaks import Leak

#: Relative error of a mean flow at which the search ends.
TOLERANCE = 1e-3
#: Relative error up to which the best run is accepted if the search has not ended after `MAX_RUNS`. Where friction
#: sticks under a sampled controller, the flows of nearly equal leaks scatter by more than `TOLERANCE`.
SCATTER_TOLERANCE = 1e-2
MAX_RUNS = 20
T = TypeVar("T")
#: Smallest slope of log flow over log coefficient that a leak has.
_MIN_SLOPE = 0.1


def leak_flow(leak: Leak, t: Array, dp: Array, dp_0: float) -> Array:
    """Compute the flow |Q_L| (n,) [m^3/s] of a leak at times `t` (n,) [s] under `dp` (n,) = p_A - p_B [Pa].

    The flow of an orifice is linear in dp for |dp| below about `dp_0` [Pa].
    """
    from sealscope.physics.leakage import laminar_leakage, leakage_series

    coefficient = (leak.coefficient or 0.0) * leak.opening.value_at(t)
    if leak.law == "laminar":
        return np.asarray(np.abs(laminar_leakage(dp, coefficient)))  # type: ignore[arg-type]
    Q_L = np.empty_like(coefficient)
    leakage_series(np.ascontiguousarray(dp), np.zeros_like(coefficient), coefficient, dp_0, Q_L)
    return np.abs(Q_L)


def mean_while_open(leak: Leak, t: Array, flow: Array) -> float:
    """Compute the mean flow [m^3/s] of a leak while it is open, sum(flow) / sum(opening); 0 if it never opens.

    `flow` (n,): |Q_L| [m^3/s] at the times `t` (n,) [s]. The time of a half open leak, with half the flow, counts half.
    """
    opening = leak.opening.value_at(t)
    opening_sum = float(opening.sum())
    return float(flow.sum()) / opening_sum if opening_sum > 0 else 0.0


def next_coefficient(mean: float, previous: tuple[float, float], latest: tuple[float, float]) -> float:
    """Compute the next leakage coefficient to try in the search for a stated mean flow.

    `mean` [m^3/s]: the mean flow to reach; `previous`, `latest`: (coefficient, mean flow) of the last two runs, (0, 0)
    for no run. If the `latest` coefficient is 0, its flow is the one that a coefficient of 1 would give in that run.

    The next coefficient is on the straight line through both runs on logarithmic scales. The line's slope is limited to
    0.1 .. 1, because a leak's flow grows with its coefficient, at most in proportion. It is 1 if the previous run had
    no leak or nearly the same coefficient.
    """
    c_0, q_0 = previous
    c_1, q_1 = latest
    if c_1 == 0.0:
        return mean / q_1
    slope = 1.0
    if min(c_0, q_0, c_1, q_1) > 0.0 and abs(c_1 / c_0 - 1.0) >= 1e-6:  # else rounding would decide the slope
        slope = min(max(math.log(q_1 / q_0) / math.log(c_1 / c_0), _MIN_SLOPE), 1.0)
    return float(c_1 * (mean / q_1) ** (1.0 / slope))


def size_leaks(
    leaks: Sequence[Leak],
    coefficients: Array,
    measure: Callable[[Array], tuple[Array, T]],
    progress: Callable[[str, float], None] | None = None,
    *,
    independent: bool = False,
) -> tuple[Array, T]:
    """Find the leakage coefficients (n,) that give the leaks' stated mean flows, by repeated simulation.

    `coefficients`: start values, which are kept for leaks without a stated mean flow. `measure(coefficients)` simulates
    the rig; it returns the mean flow [m^3/s] of each leak per unit of its coefficient (n,), and the run, of any type.
    For a coefficient of 0 the flow is that of a leak of coefficient 1 under the pressures of this run. Returns the
    coefficients found, and the run with them. `progress` is called with the name of the task and its completed
    fraction. `independent`: True if each leak is in a run of its own, so that it keeps its coefficient once its error
    is at most `TOLERANCE`.

    The search ends at a relative error of `TOLERANCE`, or after `MAX_RUNS` with the best run. Raises SimulationFailed
    if its error is not below `SCATTER_TOLERANCE`.
    """
    means = np.array([leak.mean or 0.0 for leak in leaks])
    indices = np.flatnonzero(means > 0.0)
    previous_coefficients = previous_flows = np.zeros(coefficients.size)
    best: tuple[Array, T] | None = None
    best_error = SCATTER_TOLERANCE  # a run with a larger error is never the best
    for attempt in range(MAX_RUNS):
        if progress is not None:
            progress("sizing the leak", 1.0 - 0.5**attempt)  # the number of attempts is not known beforehand
        unit_flows, run = measure(coefficients)
        flows = unit_flows * coefficients
        errors = np.abs(flows[indices] / means[indices] - 1.0)
        error = float(errors.max(initial=0.0))
        if error < best_error:
            best, best_error = (coefficients, run), error
        if best and (error <= TOLERANCE or attempt == MAX_RUNS - 1):
            if progress is not None:
                progress("sizing the leak", 1.0)
            return best
        next_coefficients = coefficients.copy()
        for k in indices[errors > TOLERANCE] if independent else indices:
            previous = previous_coefficients[k], previous_flows[k]
            latest_flow = flows[k] if coefficients[k] > 0.0 else unit_flows[k]  # else the flow of a coefficient of 1
            next_coefficients[k] = next_coefficient(means[k], previous, latest=(coefficients[k], latest_flow))
        previous_coefficients, previous_flows = coefficients, flows
        coefficients = next_coefficients
    raise SimulationFailed(
        f"no leakage coefficient gives the stated mean flow within {TOLERANCE:g}: {', '.join(map(str, leaks))} is more "
        "than this rig's pressures can drive; state a smaller leak"
    )
