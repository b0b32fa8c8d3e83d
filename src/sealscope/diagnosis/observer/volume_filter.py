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

from sealscope.compiled import kernel
from sealscope.diagnosis.observer.estimates import BlockRows, close_block, new_sums
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
) -> int:
    """Advance the filter over samples of spacing h, (n,) each; return the number of `rows` written.

    `volume`: z [m^3]; `swept`: A x [m^3]; `dp`: p_A - p_B [Pa]; `y` (6,), `P` (6, 6) and `sums` are the filter's
    memory; `noise`: variance of z [m^6].
    """
    H, PH = np.zeros(_M), np.zeros(_M)
    written = 0
    for n in range(volume.size):
        if sums[5] == 0.0:
            sums[5] = 1.0
            sums[6] = dp[n]
            y[_S] = volume[n]
            continue
        leaks = h * G_UNIT * 0.5 * (dp[n] + sums[6])
        sums[6] = dp[n]
        y[_S] += h * y[_BIAS] + leaks * y[_G]
        for j in range(_M):
            P[_S, j] += h * P[_BIAS, j] + leaks * P[_G, j]
        for j in range(_M):
            P[j, _S] += h * P[j, _BIAS] + leaks * P[j, _G]
        P[_S, _S] += _FLOW_NOISE**2 * h
        H[_S] = 1.0
        H[_SCALE] = swept[n]
        H[_COMPLIANCE] = dp[n]
        H[_SLOPE] = dp[n] * swept[n] / area
        variance = noise
        innovation = volume[n]
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
        sums[7] += abs(dp[n])
        sums[0] += 1.0
        if sums[0] >= block:
            close_block(y, P, 0, _G, sums, walk, _G_PRIOR, rows[written])
            written += 1
    return written


class VolumeFilter:
    """The filter with its memory: `update` takes samples in order; `blocks` are its estimates so far."""

    def __init__(self, a: RigNumbers, rate: float, block: int, noise: float) -> None:
        self.displacement, self.area = displacement(a), mean_area(a)
        self.h, self.block, self.noise = 1.0 / rate, block, noise
        self.blocks = BlockRows(_M)
        self.y = np.zeros(_M)
        self.y[_G], self.y[_COMPLIANCE] = 0.5, compliance(a)
        spread = np.array([*_START, _COMPLIANCE_SHARE * compliance(a), self.area / a.K_oil])
        self.P = np.diag(spread**2)
        self.sums = new_sums(self.y[_G], spread[_G])
        share = block * self.h / 60.0
        self.walk = np.zeros(_M)
        self.walk[_BIAS] = _BIAS_FLOW**2
        self.walk[_SCALE] = 1e-14 * share
        self.walk[_COMPLIANCE] = (_COMPLIANCE_WALK * compliance(a)) ** 2 * share
        self.walk[_SLOPE] = (_COMPLIANCE_WALK * self.area / a.K_oil) ** 2 * share

    def update(self, theta: Array, x: Array, dp: Array) -> None:
        """Take more samples, (n,) each: angle [rad] and position [m] since the start, p_A - p_B [Pa]."""
        swept = self.area * x
        rows = self.blocks.buffer(theta.size // self.block + 1)
        written = advance_volume(
            self.displacement * theta - swept, swept, dp, self.h, self.area,
            self.y, self.P, self.sums, self.noise, self.walk, self.block, rows,
        )  # fmt: skip
        self.blocks.add(rows[:written])
