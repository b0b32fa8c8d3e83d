"""Estimate the leakage between the chambers on line from a controller's measurements, by a Kalman filter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from sealscope.compiled import law, make_record, record_dtype

BLOCK = 0.5  # length of a block [s] over which volumes are balanced
MIN_DP = 20e3  # blocks with a smaller mean pressure difference [Pa] are not used
SHUT = 2.0  # a pilot-operated valve counts as shut above this multiple of the sum of its cracking and opening pressures
#: Prior standard deviations: of the compliance and the area (relative), and of the conductance [m^3/(s Pa)].
_SD_C, _SD_AREA, _SD_G = 0.3, 0.01, 1e-11
#: Standard deviations of the model's errors in a block, relative to the compressed and to the swept volume.
_COMPRESSION_ERROR, _SWEPT_ERROR = 0.02, 2e-4
#: Noise variance of an averaged pressure, relative to that of a single sample: that of `_LAG` at 500 Hz.
_MEAN_NOISE = 0.1
#: Standard deviation of the conductance's random walk in a block: absolute [m^3/(s Pa)], and relative.
_WALK, _RELATIVE_WALK = 1e-15, 0.03
#: A block with an innovation above this many standard deviations is left out as an outlier. If the next block is an
#: outlier with the same sign, a leak has opened suddenly.
_OUTLIER_SDS = 4.0
_LAG = 0.01  # time constant [s] of the average of all four signals
#: Parameters (`Balance`) and state of the observer. `length`: intervals in a block; `turned_forward`, `turned_back`:
#: rotation within the block in either direction [rad]; `outlier_G`: change of conductance that the last tested block
#: implies if it is an outlier, else 0; `means`: averages of angle, position, p_A and p_B up to now; `begin`: these
#: averages when the block began; `state`: conductance [m^3/(s Pa)], relative errors of 1/K and of the area; `P`: its
#: covariance; `n_blocks`: number of blocks used.
OBSERVER = record_dtype(
    *("D", "area_A", "area_B", "V_A", "V_B", "K", "x_step", "noise", "shut", "rate", "length", "lag_gain"),
    *("count", "sum_dp", "min_dp", "max_dp", "turned_forward", "turned_back", "outlier_G", "n_blocks"),
    begin=(4,),
    means=(4,),
    state=(3,),
    P=(3, 3),
)


@law
def update_observer(m: Any, theta: float, x: float, p_A: float, p_B: float) -> None:
    """Update the estimate of the leakage between the chambers with one sample of the measurements.

    `m`: record `OBSERVER`, the memory; `theta` [rad]: angle of the pump; `x` [m]: position; `p_A`, `p_B` [Pa].

    A Kalman filter estimates the conductance G between the chambers from the volume balance of each block of `BLOCK`
    seconds. The chamber with the higher pressure is balanced, because a check valve may feed the other. For chamber A,
    D dtheta - A dx - (V(x)/K) dp_A - (|p_A - p_B|/K) D dtheta_in = G integral of (p_A - p_B) dt. For chamber B, dp_B
    takes the place of dp_A, and both compression terms, those with 1/K, are positive. D is the displacement of the
    pump, A the piston area, V(x) the volume of the chamber, and K the bulk modulus. dtheta, dx and dp_A are the changes
    of angle, position and p_A in the block. dtheta_in is the rotation that pumps oil into the balanced chamber; this
    oil is compressed from the other chamber's lower pressure. The filter also estimates the relative errors of 1/K and
    of the area. Friction and load do not enter.
    """
    sample, means = (theta, x, p_A, p_B), m.means  # `means`: moving averages of the same four signals
    if m.count == 0.0:
        for k in range(4):
            means[k] = m.begin[k] = sample[k]
    previous_angle = means[0]
    for k in range(4):
        means[k] = means[k] + m.lag_gain * (sample[k] - means[k])
    dp, turned = means[2] - means[3], means[0] - previous_angle  # p_A - p_B, and rotation since the last sample
    m.min_dp, m.max_dp = min(m.min_dp, dp), max(m.max_dp, dp)
    m.sum_dp += dp
    m.turned_forward += max(turned, 0.0)
    m.turned_back += max(-turned, 0.0)
    m.count += 1.0
    if m.count > m.length:  # a sample between two blocks counts half in either (trapezoidal rule)
        _update_with_block(m, m.sum_dp - 0.5 * dp)
        m.count, m.sum_dp, m.min_dp, m.max_dp, m.turned_forward, m.turned_back = 1.0, 0.5 * dp, dp, dp, 0.0, 0.0
        for k in range(4):
            m.begin[k] = means[k]


@law
def _update_with_block(m: Any, dp_sum: float) -> None:
    """Update the Kalman filter of a leak observer with the volume balance of the block of samples that ends now.

    `m`: record `OBSERVER`, the memory of the filter; `dp_sum`: sum of p_A - p_B [Pa] over the block's samples, of which
    the first (except in the first block of a run) and the last count half. The block is left out if

    - the mean of p_A - p_B is within +-`MIN_DP`;
    - p_A - p_B changes its sign, or is at times too small to shut a check valve;
    - its innovation (measured minus predicted leakage) exceeds `_OUTLIER_SDS` standard deviations. If the last block
      before it that passed the other tests was an outlier, too, and implied a change of the conductance G in the same
      direction, a leak may have opened. The block is then used, with a larger variance of G.
    """
    dp_integral = dp_sum / m.rate
    if abs(dp_integral) < MIN_DP * m.length / m.rate or m.min_dp * m.max_dp <= 0.0:
        return
    if min(abs(m.min_dp), abs(m.max_dp)) < m.shut:
        return
    begin, end, state, P = m.begin, m.means, m.state, m.P  # begin, end: averages of angle, position, p_A and p_B
    pumped, travel = m.D * (end[0] - begin[0]), end[1] - begin[1]
    mid_position = 0.5 * (end[1] + begin[1])
    if dp_integral > 0.0:
        side_area, intake_angle = m.area_A, m.turned_forward
        V, dp_side = m.V_A + side_area * mid_position, end[2] - begin[2]
    else:
        side_area, intake_angle = m.area_B, m.turned_back
        V, dp_side = m.V_B - side_area * mid_position, begin[3] - end[3]  # with dp_integral < 0, turns both signs below
    swept = side_area * travel
    # oil in the chamber is compressed by the pressure change, incoming oil by the mean pressure difference
    compressed = (V * dp_side + m.D * intake_angle * dp_integral * m.rate / m.length) / m.K
    leaked = pumped - swept - compressed
    # at both ends a uniform error of one encoder count (1/12) and the noise of an averaged pressure; the model's errors
    noise = (side_area * m.x_step) ** 2 / 6.0 + 2.0 * _MEAN_NOISE * (V / m.K * m.noise) ** 2
    variance = noise + (_COMPRESSION_ERROR * compressed) ** 2 + (_SWEPT_ERROR * swept) ** 2
    row = (dp_integral, compressed, swept)  # the model is leaked = row . state
    innovation = leaked - (row[0] * state[0] + row[1] * state[1] + row[2] * state[2])
    walk = (_WALK + _RELATIVE_WALK * abs(state[0])) ** 2
    innovation_variance = row[0] * row[0] * walk + variance
    for i in range(3):
        for k in range(3):
            innovation_variance += row[i] * P[i, k] * row[k]
    if innovation**2 > _OUTLIER_SDS**2 * innovation_variance:
        previous_outlier_G = m.outlier_G
        m.outlier_G = innovation / dp_integral
        if previous_outlier_G * m.outlier_G <= 0.0:
            return
        jump_variance = m.outlier_G**2  # G may have changed by this outlier_G
        walk, innovation_variance = walk + jump_variance, innovation_variance + row[0] * row[0] * jump_variance
    else:
        m.outlier_G = 0.0
    P[0, 0] += walk
    gain_0 = (P[0, 0] * row[0] + P[0, 1] * row[1] + P[0, 2] * row[2]) / innovation_variance
    gain_1 = (P[1, 0] * row[0] + P[1, 1] * row[1] + P[1, 2] * row[2]) / innovation_variance
    gain_2 = (P[2, 0] * row[0] + P[2, 1] * row[1] + P[2, 2] * row[2]) / innovation_variance
    gain = (gain_0, gain_1, gain_2)
    for i in range(3):
        state[i] += gain[i] * innovation
        for k in range(3):  # P row = gain innovation_variance, as P is symmetric
            P[i, k] -= gain[i] * gain[k] * innovation_variance
    m.n_blocks += 1.0


@dataclass(frozen=True)
class Balance:
    """The leak observer's model of the machine, from which it computes the volume balance of a chamber."""

    D: float  # [m^3/rad] displacement of the pump
    area_A: float  # [m^2] piston areas
    area_B: float
    V_A: float  # [m^3] volumes of the chambers at mid-stroke
    V_B: float
    K: float  # [Pa] bulk modulus of the oil
    x_step: float  # [m] position change of one encoder count
    noise: float  # [Pa] standard deviation of a pressure sample
    #: |p_A - p_B| [Pa] above which the pilot-operated check valve of the chamber with the higher pressure is shut; 0
    #: without such valves.
    shut: float = 0.0


def make_observer(balance: Balance, rate: float) -> Any:
    """Make the memory of a leak observer that samples at `rate` [Hz], a record (1,) `OBSERVER`."""
    return make_record(
        OBSERVER,
        balance,
        rate=rate,
        length=max(2, round(BLOCK * rate)),
        lag_gain=1.0 - math.exp(-1.0 / (rate * _LAG)),
        min_dp=math.inf,
        max_dp=-math.inf,
        P=np.diag(np.square([_SD_G, _SD_C, _SD_AREA])),
    )
