"""Find the leakage coefficient that gives a stated mean flow at the rig's own operating point."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from sealscope.errors import SimulationFailed
from sealscope.recordings.recording import Array
from sealscope.simulation.leaks import Leak

#: Relative distance from the mean asked for at which the search ends, and within which the closest run is taken after
#: the last: where friction sticks under a sampled controller, runs of nearly the same leak scatter by more.
TOLERANCE, SCATTERED = 1e-3, 1e-2
MOST_RUNS = 20
T = TypeVar("T")
_LEAST_SLOPE = 0.1


def leak_flow(leak: Leak, t: Array, dp: Array, dp_0: float) -> Array:
    """Compute |Q_L| [m^3/s] of a leak with a known coefficient under the pressure difference `dp` [Pa]."""
    from sealscope.physics.leakage import laminar_leakage, leakage_series

    size = (leak.coefficient or 0.0) * leak.opening.value_at(t)
    if leak.law == "laminar":
        return np.asarray(np.abs(laminar_leakage(dp, size)))  # type: ignore[arg-type]
    return np.asarray(np.abs(leakage_series(np.ascontiguousarray(dp), np.zeros_like(size), size, dp_0)))


def mean_while_open(leak: Leak, t: Array, flow: Array) -> float:
    """Compute the mean flow [m^3/s] while open, per unit of opening: sum of |Q_L| over sum of the opening."""
    opening = leak.opening.value_at(t)
    total = float(opening.sum())
    return float(flow.sum()) / total if total > 0 else 0.0


def scaled_size(mean: float, before: tuple[float, float], latest: tuple[float, float]) -> float:
    """Compute the coefficient to try next for a mean flow `mean` [m^3/s].

    `before`, `latest`: coefficient and mean flow of the former and of this run; with a coefficient of 0, the flow is
    that of a coefficient of 1. The slope d log flow / d log coefficient between the two is kept within what a leak can
    do, and is 1 where they do not tell.
    """
    (c_0, q_0), (c_1, q_1) = before, latest
    if c_1 == 0.0:
        return mean / q_1
    slope = 1.0
    if min(c_0, q_0, c_1, q_1) > 0.0 and abs(c_1 / c_0 - 1.0) >= 1e-6:
        slope = min(max(math.log(q_1 / q_0) / math.log(c_1 / c_0), _LEAST_SLOPE), 1.0)
    return float(c_1 * (mean / q_1) ** (1.0 / slope))


def size_leaks(
    leaks: Sequence[Leak],
    sizes: Array,
    measure: Callable[[Array], tuple[Array, T]],
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Array, T]:
    """Find the coefficients (n,) with which the leaks have their stated means; return them and the last measurement.

    `sizes`: the coefficients to begin with, of the other leaks those that stay; `measure(sizes)`: mean flows while open
    for a coefficient of 1 (n,), and anything else. A small leak's flow is proportional to its coefficient (friction
    sets the pressure difference), a large one's grows less. So each coefficient is scaled by (asked/got)^(1/s), s the
    slope d log flow / d log coefficient of that leak between the last two runs, until every mean is within `TOLERANCE`,
    starting from the rig without these leaks. Raises SimulationFailed where the search does not settle.
    """
    means = np.array([leak.mean or 0.0 for leak in leaks])
    sized = np.flatnonzero(means > 0.0)
    before = np.zeros((2, sizes.size))  # coefficients and mean flows of the run before
    closest: tuple[float, Array, T] | None = None
    for attempt in range(MOST_RUNS):
        if progress is not None:
            progress("sizing the leak", 1.0 - 0.5**attempt)
        units, measured = measure(sizes)
        flows = units * sizes
        worst = float(np.abs(flows[sized] / means[sized] - 1.0).max(initial=0.0))
        if worst < (closest[0] if closest else SCATTERED):
            closest = worst, sizes, measured
        if closest and (worst <= TOLERANCE or attempt == MOST_RUNS - 1):
            if progress is not None:
                progress("sizing the leak", 1.0)
            return closest[1:]
        following = sizes.copy()
        for k in sized:
            latest = sizes[k], flows[k] if sizes[k] > 0.0 else units[k]
            following[k] = scaled_size(means[k], (before[0, k], before[1, k]), latest)
        before, sizes = np.stack([sizes, flows]), following
    raise SimulationFailed(
        f"no leakage coefficient gives the mean asked for within {TOLERANCE:g}: "
        f"{', '.join(str(leak) for leak in leaks)} is more than this "
        "rig's pressures can drive; ask for a smaller leak"
    )
