"""The Kalman filter over volumes, for recorded angle and position: it needs no model of friction or drive.

The volume that the pump has moved less that of the piston has leaked or is stored:

    z = D theta - A x = s + scale A x + (compliance + x slope) (p_A - p_B),   ds/dt = G (p_A - p_B) + bias_flow

with the states s, bias_flow, G, scale, compliance and slope. z is measured; its innovation is the volume balance. G
is the leakage of pump and piston together. `scale` is the error of the ratio of displacement to area, known within some
per cent; `bias_flow` comes from a zero error of the pressures times a leak, and walks from block to block.
"""

from __future__ import annotations

import math

import numpy as np

from sealscope.compiled import kernel, law
from sealscope.diagnosis.observer.estimates import SUMS, BlockRows, begin_sums, close_block
from sealscope.diagnosis.observer.model import G_UNIT, compliance, displacement, mean_area
from sealscope.physics.rig import RigNumbers
from sealscope.recordings.recording import Array

VOLUME_STATES = ("s", "bias_flow", "G", "scale", "compliance", "slope")
_S, _BIAS, _G, _SCALE, _COMPLIANCE, _SLOPE = range(len(VOLUME_STATES))
_M = len(VOLUME_STATES)
#: Deviations at the start: volume at rest 1 cm3, flow 1e-8 m3/s, pump leakage, ratio of displacement to area 15 %.
_START = (1e-6, 1e-8, 1.0, 0.15)
#: Uncertainty of the compliance as a share of the rig's: modulus, hoses and air.
_COMPLIANCE_SHARE = 0.5
#: Deviation of the flow from a pressure's zero error times a new leak, gained at every block [m^3/s].
_BIAS_FLOW = 1e-8
#: Drift of the compliance in a minute: 1 % (half a per cent a kelvin).
_COMPLIANCE_WALK = 0.01
#: Amplitude density of flow that no state explains [m^3/s per root hertz].
_FLOW_NOISE = 1e-10
#: Deviation of G at the start of every block, in units of `G_UNIT`.
_G_PRIOR = 3.0
#: Mean square of a block's normalised innovations from which on the model does not describe it.
_LOST = 8.0


@law
def take_volume(
    volume: float,
    swept: float,
    dp: float,
    h: float,
    area: float,
    y: np.ndarray,
    P: np.ndarray,
    sums: np.ndarray,
    noise: float,
    walk: np.ndarray,
    block: float,
    row: np.ndarray,
    held: np.ndarray,
    room: np.ndarray,
) -> bool:
    """Take a sample, h [s] after the one before; return whether it closed a block, whose estimates are in `row`.

    A block that the model does not describe, such as the one in which a large leak begins, teaches the slow states
    nothing: they are again what they were before it.

    `volume`: z [m^3]; `swept`: A x [m^3]; `dp`: p_A - p_B [Pa]; `y` (6,), `P` (6, 6) and `sums` are the filter's
    memory, `held` (7, 6) the states and covariances before this block; `noise`: variance of z [m^6]; `block`: length of
    a block [samples]; `room` (2, 6): used meanwhile.
    """
    if sums[5] == 0.0:
        sums[5] = 1.0
        sums[6] = dp
        y[_S] = volume
        return False
    if sums[0] == 0.0:
        for j in range(_M):
            held[_M, j] = y[j]
            for i in range(_M):
                held[i, j] = P[i, j]
    leaks = h * G_UNIT * 0.5 * (dp + sums[6])
    sums[6] = dp
    y[_S] += h * y[_BIAS] + leaks * y[_G]
    for j in range(_M):
        P[_S, j] += h * P[_BIAS, j] + leaks * P[_G, j]
    for j in range(_M):
        P[j, _S] += h * P[j, _BIAS] + leaks * P[j, _G]
    P[_S, _S] += _FLOW_NOISE**2 * h
    H, PH = room[0], room[1]
    H[_S] = 1.0
    H[_BIAS] = 0.0
    H[_G] = 0.0
    H[_SCALE] = swept
    H[_COMPLIANCE] = dp
    H[_SLOPE] = dp * swept / area
    variance = noise
    innovation = volume
    for i in range(_M):
        total = 0.0
        for j in range(_M):
            total += P[i, j] * H[j]
        PH[i] = total
        variance += H[i] * total
        innovation -= H[i] * y[i]
    white = innovation / math.sqrt(variance)
    sums[1] -= 0.5 * (white * white + math.log(variance))
    sums[2] += white * white
    sums[8] += white * sums[9]
    sums[9] = white
    for i in range(_M):
        y[i] += PH[i] / variance * innovation
        for j in range(_M):
            P[i, j] -= PH[i] * PH[j] / variance
    sums[7] += abs(dp)
    sums[0] += 1.0
    if sums[0] < block:
        return False
    lost = sums[2] > _LOST * sums[0]
    close_block(y, P, 0, _G, sums, walk, _G_PRIOR, row)
    if lost:
        for i in range(_M):
            if i not in (_S, _G):
                y[i] = held[_M, i]
                for j in range(_M):
                    P[i, j] = 0.0 if j in (_S, _G) else held[i, j]
                    P[j, i] = P[i, j]
                P[i, i] += walk[i]
        P[_S, _G] = 0.0
        P[_G, _S] = 0.0
        P[_S, _S] = _START[_S] ** 2
    return True


@kernel
def advance_volume(
    volume: np.ndarray,
    swept: np.ndarray,
    dp: np.ndarray,
    h: float,
    area: float,
    y: np.ndarray,
    P: np.ndarray,
    sums: np.ndarray,
    noise: float,
    walk: np.ndarray,
    block: int,
    rows: np.ndarray,
    held: np.ndarray,
) -> int:
    """Take samples, (n,) each, as `take_volume` does; return the number of `rows` written."""
    room = np.zeros((2, _M))
    written = 0
    for n in range(volume.size):
        row = rows[written]
        if take_volume(volume[n], swept[n], dp[n], h, area, y, P, sums, noise, walk, block, row, held, room):
            written += 1
    return written


@law
def start_volume(
    area: float,
    compliance: float,
    K_oil: float,
    block_s: float,
    y: np.ndarray,
    P: np.ndarray,
    sums: np.ndarray,
    walk: np.ndarray,
) -> None:
    """Write the memory before a first sample, and the variances that states gain from block to block of `block_s` [s].

    `area` of the piston [m^2]; `compliance` [m^3/Pa].
    """
    for i in range(_M):
        y[i] = 0.0
        walk[i] = 0.0
        for j in range(_M):
            P[i, j] = 0.0
    y[_G], y[_COMPLIANCE] = 0.5, compliance
    for i in range(len(_START)):
        P[i, i] = _START[i] ** 2
    P[_COMPLIANCE, _COMPLIANCE] = (_COMPLIANCE_SHARE * compliance) ** 2
    P[_SLOPE, _SLOPE] = (area / K_oil) ** 2
    begin_sums(y[_G], _START[_G], sums)
    share = block_s / 60.0
    walk[_BIAS] = _BIAS_FLOW**2
    walk[_SCALE] = 1e-14 * share
    walk[_COMPLIANCE] = (_COMPLIANCE_WALK * compliance) ** 2 * share
    walk[_SLOPE] = (_COMPLIANCE_WALK * area / K_oil) ** 2 * share


@kernel
def _start(
    area: float,
    compliance: float,
    K_oil: float,
    block_s: float,
    y: np.ndarray,
    P: np.ndarray,
    sums: np.ndarray,
    walk: np.ndarray,
) -> None:
    start_volume(area, compliance, K_oil, block_s, y, P, sums, walk)


class VolumeFilter:
    """The filter with its memory: `update` takes samples in order; `blocks` are its estimates so far."""

    def __init__(self, a: RigNumbers, rate: float, block: int, noise: float) -> None:
        self.displacement, self.area = displacement(a), mean_area(a)
        self.h, self.block, self.noise = 1.0 / rate, block, noise
        self.blocks = BlockRows(_M)
        self.y, self.P, self.sums, self.walk = np.empty(_M), np.empty((_M, _M)), np.empty(SUMS), np.empty(_M)
        self.held = np.zeros((_M + 1, _M))
        _start(self.area, compliance(a), a.K_oil, block * self.h, self.y, self.P, self.sums, self.walk)

    def update(self, theta: Array, x: Array, dp: Array) -> None:
        """Take more samples, (n,) each: angle [rad] and position [m] since the start, p_A - p_B [Pa]."""
        swept = self.area * x
        rows = self.blocks.buffer(theta.size // self.block + 1)
        written = advance_volume(
            self.displacement * theta - swept, swept, dp, self.h, self.area,
            self.y, self.P, self.sums, self.noise, self.walk, self.block, rows, self.held,
        )  # fmt: skip
        self.blocks.add(rows[:written])
