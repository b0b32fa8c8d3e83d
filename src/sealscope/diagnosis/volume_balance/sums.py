"""What a block's samples become, compiled: columns of volumes, what offset, slope and dp leave of them, and means.

Each block is gone through by itself, so that its figures do not depend on the blocks beside it.
"""

from __future__ import annotations

import numpy as np

from sealscope.compiled import kernel, law
from sealscope.recordings.recording import Array

#: Sums may be taken in any order, several samples to a register; NaN and infinity stay what they are.
_ANY_ORDER = {"reassoc", "nsz", "contract"}
_TINY = float(np.finfo(float).tiny)
#: Rows of what `block_means` returns.
NOISE, ABS_DP, ROOT_DP, ABS_FLOW, LIFT, MOTION, WALK, SWINGING, FILLED = range(9)


@law
def _sign(value: float) -> float:
    return 1.0 if value > 0.0 else (-1.0 if value < 0.0 else 0.0)


@law
def _smooth_into(values: Array, half: int, sums: Array, smooth: Array) -> None:
    """Write means of values (L,) over `half` samples to either side, fewer at the ends; `sums` (L + 1,) is scratch."""
    size = values.size
    sums[0] = 0.0
    for t in range(size):
        sums[t + 1] = sums[t] + values[t]
    for t in range(size):
        first, last = max(t - half, 0), min(t + half + 1, size)
        smooth[t] = (sums[last] - sums[first]) / (last - first)


@kernel
def volume_columns(x: Array, turned: Array, by_angle: bool, dp: Array, step: float, half: int) -> tuple[Array, Array]:
    """Return the columns (n, 7, L) of volumes that all blocks have, and dp smoothed (n, L).

    Parameters
    ----------
    x : Array, shape (n, L)
        Position times area [m^3].
    turned : Array, shape (n, L)
        Angle of the pump [m^3], or its flow [m^3/s], times the displacement; `by_angle` says which.
    by_angle : bool
    dp : Array, shape (n, L)
        p_A - p_B [Pa].
    step : float
        Time between samples [s].
    half : int
        Samples to either side over which dp and flow are smoothed.
    """
    count, size = x.shape
    columns = np.empty((count, 7, size))
    smoothed = np.empty((count, size))
    sums = np.empty(size + 1)
    flows = np.empty(size)
    trapezium = 0.5 * step
    for k in range(count):
        y, theta, flow, area, area_root, by_pump, by_side = columns[k]
        smooth = smoothed[k]
        if by_angle:
            for t in range(size):
                theta[t] = turned[k, t]
            flow[0], flow[-1] = (theta[1] - theta[0]) / step, (theta[-1] - theta[-2]) / step
            for t in range(1, size - 1):
                flow[t] = (theta[t + 1] - theta[t - 1]) / (2.0 * step)
        else:
            theta[0] = 0.0
            for t in range(size):
                flow[t] = turned[k, t]
            for t in range(1, size):
                theta[t] = theta[t - 1] + trapezium * (flow[t] + flow[t - 1])
        _smooth_into(dp[k], half, sums, smooth)
        _smooth_into(flow, half, sums, flows)
        y[0], area[0], area_root[0], by_pump[0], by_side[0] = x[k, 0], 0.0, 0.0, 0.0, 0.0
        root = _sign(smooth[0]) * np.sqrt(abs(smooth[0]))
        for t in range(1, size):
            before, root = root, _sign(smooth[t]) * np.sqrt(abs(smooth[t]))
            y[t] = x[k, t]
            moved = y[t] - y[t - 1]
            area[t] = area[t - 1] + trapezium * (dp[k, t] + dp[k, t - 1])
            area_root[t] = area_root[t - 1] + trapezium * (root + before)
            by_pump[t] = by_pump[t - 1] + _sign(flows[t]) * moved
            by_side[t] = by_side[t - 1] + _sign(smooth[t]) * moved
    return columns, smoothed


@kernel
def carried_columns(x: Array, p_A: Array, p_B: Array, flow: Array, smooth: Array, step: float, half: int) -> Array:
    """Return what tells the oil stored in the side that carries the load, and compressed there: columns (n, 5, L).

    The side of the lower pressure is open to the supply, or holds oil of its own. With side A carrying the oil stored
    is the integral of ``(V_A + A_A x)/K dp_A``, with side B that of ``-(V_B - A_B x)/K dp_B``. The columns: rise of p_B
    while B carries, integrals of x dp_A and of x dp_B while that side carries, and rise of p_A while A carries. Oil
    that the pump delivers there gives way by dp/K of its volume: the integral of the flow's size times dp while it
    delivers into the side that carries. Rises are those of means, which count no noise where the sides change over, and
    what shorter means differ from them: a piston that starts and stops rings on its oil.

    Parameters
    ----------
    x, p_A, p_B : Array, shape (n, L)
        Position [m], pressures [Pa].
    flow, smooth : Array, shape (n, L)
        Flow of the pump [m^3/s], and p_A - p_B smoothed [Pa].
    step : float
        Time between samples [s].
    half : int
        Samples to either side over which pressures and flow are smoothed; a third of it for the shorter means.
    """
    count, size = x.shape
    columns = np.zeros((count, 5, size))
    sums = np.empty(size + 1)
    above, below, flows = np.empty(size), np.empty(size), np.empty(size)
    near_A, near_B = np.empty(size), np.empty(size)
    for k in range(count):
        rise_B, rise_x_A, rise_x_B, rise_A, compressed = columns[k]
        _smooth_into(p_A[k], half, sums, above)
        _smooth_into(p_B[k], half, sums, below)
        _smooth_into(p_A[k], half // 3, sums, near_A)
        _smooth_into(p_B[k], half // 3, sums, near_B)
        _smooth_into(flow[k], half, sums, flows)
        before = 0.0
        for t in range(size):
            dp = smooth[k, t]
            now = abs(flows[t]) * dp if flows[t] * dp > 0.0 else 0.0
            if t > 0:
                on_A = dp > 0.0
                up_A = above[t] - above[t - 1] if on_A else 0.0
                up_B = 0.0 if on_A else below[t] - below[t - 1]
                middle = 0.5 * (x[k, t] + x[k, t - 1])
                rise_A[t], rise_B[t] = rise_A[t - 1] + up_A, rise_B[t - 1] + up_B
                rise_x_A[t], rise_x_B[t] = rise_x_A[t - 1] + middle * up_A, rise_x_B[t - 1] + middle * up_B
                compressed[t] = compressed[t - 1] + 0.5 * step * (now + before)
            before = now
        for t in range(size):
            on_A = smooth[k, t] > 0.0
            ring_A = near_A[t] - above[t] if on_A else 0.0
            ring_B = 0.0 if on_A else near_B[t] - below[t]
            rise_A[t], rise_B[t] = rise_A[t] + ring_A, rise_B[t] + ring_B
            rise_x_A[t], rise_x_B[t] = rise_x_A[t] + x[k, t] * ring_A, rise_x_B[t] + x[k, t] * ring_B
    return columns


def _beyond(columns: Array, pressure: Array, step: float) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Return what offset, slope and dp leave of columns (n, c, L), slopes, coefficients of dp, steady, along, d' d.

    tau is the time from the middle of the block; the tilt of dp and what is left of it, d, are orthogonal to it:

        tilt = dp' tau / tau' tau,    d = dp - mean(dp) - tilt tau,
        rest = column - mean - slope' tau - stored d,    stored = column' d / d' d,

    with slope = slope' - stored tilt beside the stored oil.
    """
    count, width, size = columns.shape
    rest = np.empty((count, width, size))
    slope, stored = np.empty((count, width)), np.empty((count, width))
    steady, along, pressed = np.empty(count), np.empty(count), np.empty(count)
    tau = (np.arange(size) - 0.5 * (size - 1)) * step
    own = np.sum(tau**2)
    dp = np.empty(size)
    for k in range(count):
        first, total, tilted = pressure[k, 0], 0.0, 0.0
        for t in range(size):
            total += pressure[k, t] - first
        mean = total / size
        for t in range(size):
            dp[t] = (pressure[k, t] - first) - mean
        for t in range(size):
            tilted += dp[t] * tau[t]
        tilt, swept, left = tilted / own, 0.0, 0.0
        for t in range(size):
            swept += dp[t] * dp[t]
        for t in range(size):
            dp[t] -= tilt * tau[t]
            left += dp[t] * dp[t]
        along[k] = tilt * own / max(swept, _TINY)
        steady[k] = own * (1.0 - tilt * along[k])
        left = max(left, _TINY)
        pressed[k] = left
        for j in range(width):
            column, beyond = columns[k, j], rest[k, j]
            first, total, leaned, share = column[0], 0.0, 0.0, 0.0
            for t in range(size):
                total += column[t] - first
            mean = total / size
            for t in range(size):
                beyond[t] = (column[t] - first) - mean
                leaned += beyond[t] * tau[t]
            lean = leaned / own
            for t in range(size):
                beyond[t] -= lean * tau[t]
                share += beyond[t] * dp[t]
            share /= left
            for t in range(size):
                beyond[t] -= share * dp[t]
            slope[k, j], stored[k, j] = lean - share * tilt, share
    return rest, slope, stored, steady, along, pressed


beyond_pressure = kernel(_beyond, _ANY_ORDER)


def _means(
    y: Array, flow: Array, integral: Array, dp: Array, smooth: Array, both: Array, step: float, half: int
) -> Array:
    """Return figures (9, n) of blocks of L samples, in the order of `NOISE` to `FILLED`.

    Parameters
    ----------
    y, flow, integral : Array, shape (n, L)
        Displaced volume [m^3], flow of the pump [m^3/s], what is left of the integral of dp [Pa s].
    dp, smooth, both : Array, shape (n, L)
        p_A - p_B, the same smoothed, p_A + p_B [Pa].
    step : float
        Time between samples [s].
    half : int
        Samples to either side over which the flow is smoothed.

    Notes
    -----
    White noise of a slow signal has a sixth of the mean square of the second differences as its variance. The integral
    sums the noise of dp up to a random walk: sum_t I_t sum_{j <= t} noise_j step / sum_t I_t^2 has the variance
    step^2 sum_j (sum_{t >= j} I_t)^2 / (sum_t I_t^2)^2, times that of the noise.

    `SWINGING` is the share of the way that the piston goes while dp has another sign than dp smoothed. On a single rod
    the higher pressure says whose area moves oil. Noise changes the sign near zero, and is passed quickly; a circuit
    that swings between its valves changes it faster than the samples, or their means, can tell.
    """
    count, size = dp.shape
    figures = np.empty((9, count))
    sums, flows = np.empty(size + 1), np.empty(size)
    tenth = max(1, size // 10)
    for k in range(count):
        noise = 0.0
        for t in range(2, size):
            noise += ((dp[k, t] - dp[k, t - 1]) - (dp[k, t - 1] - dp[k, t - 2])) ** 2
        noise /= 6.0 * (size - 2)
        absolute, root, rough = 0.0, 0.0, 0.0
        for t in range(size):
            absolute += abs(smooth[k, t])
            root += np.sqrt(abs(smooth[k, t]))
            rough += np.sqrt(abs(dp[k, t]))
        absolute, root, rough = absolute / size, root / size, rough / size
        _smooth_into(flow[k], half, sums, flows)
        moved = 0.0
        for t in range(size):
            moved += abs(flows[t])
        work = 0.0
        for t in range(1, size):
            work += 0.5 * (dp[k, t] + dp[k, t - 1]) * (y[k, t] - y[k, t - 1])
        own, walk, reach = 0.0, 0.0, 0.0
        for t in range(size - 1, -1, -1):
            own += integral[k, t] ** 2
            reach += integral[k, t]
            walk += reach**2
        way, other = 0.0, 0.0
        for t in range(size):
            before, after = max(t - 1, 0), min(t + 1, size - 1)
            gone = abs(y[k, after] - y[k, before]) / (after - before)
            way += gone
            other += gone if _sign(dp[k, t]) != _sign(smooth[k, t]) else 0.0
        begun, ended = 0.0, 0.0
        for t in range(tenth):
            begun += both[k, t]
            ended += both[k, size - 1 - t]
        figures[NOISE, k], figures[ABS_DP, k], figures[ROOT_DP, k] = noise, absolute, root
        figures[ABS_FLOW, k] = moved / size
        figures[LIFT, k] = rough / max(root, _TINY) - 1.0
        figures[MOTION, k] = work / (size * step)
        figures[WALK, k] = noise * step**2 * walk / max(own, _TINY) ** 2
        figures[SWINGING, k] = other / max(way, _TINY)
        figures[FILLED, k] = (ended - begun) / tenth
    return figures


block_means = kernel(_means, _ANY_ORDER)
