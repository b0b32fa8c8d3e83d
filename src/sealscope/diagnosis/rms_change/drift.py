"""What a sound machine's details do by themselves within a recording: its sensors' noise and its own condition drift.

Energy of a detail d_j is that of white noise, which every level holds alike (d1 holds hardly anything else), and the
machine's own. With the noise's share r_j = E_1 / E_j of the energy, a noise louder by dn and a machine whose details
swing wider by dm move

    log RMS d_j by r_j dn + (1 - r_j) dm_j,   log RMS d3*d4 by the sum of both levels'.

dn of each chamber and dm_j of each level wander as random walks. So a level in which noise drowns the machine has
little room for the machine's drift, and none is taken for a leak that only follows d1.
"""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.changepoint.scatter import HealthyDrift
from sealscope.diagnosis.rms_change.blocks import QUANTITIES, Blocks
from sealscope.diagnosis.rms_change.results import JUDGED
from sealscope.recordings.recording import Array

#: How far a sound machine wanders in `WANDER_SECONDS`, one standard deviation: the noise of a pressure sensor and its
#: electronics ...
NOISE_WANDER = 0.02
#: ... and the machine's own part of a level's RMS. Friction and stiffness wander by a few percent (the pressure model
#: allows 6 % and 3 %), and the ringing after a reversal goes with either about in proportion.
MACHINE_WANDER = 0.04
WANDER_SECONDS = 90.0
#: Least share of a level that counts as the machine's own: E_1 / E_j is an estimate.
LEAST_SHARE = 0.05
#: The beginning is left out: pressures and speed settle within the first strokes after a start.
SETTLING_SECONDS = 10.0
SETTLING_CYCLES = 3.0
_SETTLING_AT_MOST = 1.0 / 8.0


def settled(blocks: Blocks) -> Blocks:
    """The blocks after the machine's start: without the first 10 s or three cycles, at most an eighth of them."""
    n = len(blocks.log_rms)
    if n == 0:
        return blocks
    start = max(SETTLING_SECONDS, SETTLING_CYCLES * (blocks.cycle or 0.0))
    first = min(int(n * _SETTLING_AT_MOST), int(np.ceil(start / _seconds(blocks))))
    return Blocks(
        blocks.edges[first:], blocks.log_rms[first:], blocks.chambers, blocks.phases, blocks.cycle, blocks.still
    )


def _seconds(blocks: Blocks) -> float:
    """Length of a block [s]."""
    return float(blocks.edges[-1] - blocks.edges[0]) / len(blocks.log_rms)


def own_shares(log_rms: Array) -> Array:
    """Share (5 per chamber,) of each quantity's energy that is the machine's own, 1 - r_j: 0 for d1, at least
    `LEAST_SHARE` for d2..d4, for d3d4 the sum of both levels'. `log_rms`: (n, 5 per chamber)."""
    level = log_rms.mean(axis=0)
    own = np.zeros(level.size)
    for first in range(0, level.size, len(QUANTITIES)):
        for quantity in JUDGED:
            column = first + QUANTITIES.index(quantity)
            noise = np.exp(2.0 * min(0.0, float(level[first] - level[column])))
            own[column] = max(1.0 - noise, LEAST_SHARE)
        own[first + QUANTITIES.index("d3d4")] = sum(own[first + QUANTITIES.index(one)] for one in ("d3", "d4"))
    return own


def drift_of(blocks: Blocks) -> HealthyDrift:
    """The drift that is allowed to the columns of `blocks.log_rms`, with a change of the noise as another step."""
    own = own_shares(blocks.log_rms)
    f, block = own.size, float(np.sqrt(_seconds(blocks) / WANDER_SECONDS))
    walks, other = [], []
    for first in range(0, f, len(QUANTITIES)):
        noise = np.zeros(f)
        for quantity in ("d1", *JUDGED):
            column, both = first + QUANTITIES.index(quantity), first + QUANTITIES.index("d3d4")
            noise[column] = 1.0 - own[column]
            machine = np.zeros(f)
            machine[column] = own[column]
            if quantity in ("d3", "d4"):
                noise[both] += noise[column]
                machine[both] = own[column]
            walks.append(MACHINE_WANDER * block * machine)
        walks.append(NOISE_WANDER * block * noise)
        other.append(noise)
    return HealthyDrift(np.stack(walks, axis=1), np.stack(other, axis=1))


def drift_beyond_noise(blocks: Blocks) -> HealthyDrift:
    """The drift that is allowed to `rms_results.excess` of the blocks: energies, which move twice as far as the RMS,
    of the machine alone."""
    own = own_shares(blocks.log_rms)[blocks.columns(*JUDGED)]
    block = float(np.sqrt(_seconds(blocks) / WANDER_SECONDS))
    return HealthyDrift(np.diag(2.0 * MACHINE_WANDER * block * own), np.zeros((own.size, 0)))
