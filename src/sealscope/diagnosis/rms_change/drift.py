"""Drift of a healthy machine's details within a recording: its sensors' noise and its own condition.

Energy of a detail d_j is that of white noise, which every level holds alike (d1 holds hardly anything else), and the
machine's own. With the noise's share r_j = E_1 / E_j of the energy, noise that rises by dn and a machine's part of the
details that grows by dm move

    log RMS d_j by r_j dn + (1 - r_j) dm_j,   log RMS d3*d4 by the sum of both levels'.

dn of each chamber and dm_j of each level are random walks. So a level in which noise drowns the machine has little room
for the machine's drift, and none is taken for a leak that only follows d1.
"""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.changepoint.scatter import HealthyDrift
from sealscope.diagnosis.rms_change.blocks import JUDGED, QUANTITIES, RmsBlocks
from sealscope.recordings.recording import Array

#: Walk of a healthy machine in `WANDER_SECONDS`, one standard deviation: the noise of a pressure sensor and its
#: electronics ...
NOISE_WANDER = 0.02
#: ... and the machine's own part of a level's RMS. Friction and stiffness walk by a few percent (the pressure model
#: allows 6 % and 3 %), and the ringing after a reversal goes with either about in proportion.
MACHINE_WANDER = 0.04
WANDER_SECONDS = 90.0
#: Least share of a level that counts as the machine's own: E_1 / E_j is an estimate.
LEAST_SHARE = 0.05


def own_shares(log_rms: Array) -> Array:
    """Return the share (5 per chamber,) of each quantity's energy that is the machine's own, 1 - r_j.

    0 for d1, at least `LEAST_SHARE` for d2..d4, for d3d4 the sum of both levels'. `log_rms`: (n, 5 per chamber).
    """
    level = log_rms.mean(axis=0)
    own = np.zeros(level.size)
    for first in range(0, level.size, len(QUANTITIES)):
        for quantity in JUDGED:
            column = first + QUANTITIES.index(quantity)
            noise = np.exp(2.0 * min(0.0, float(level[first] - level[column])))
            own[column] = max(1.0 - noise, LEAST_SHARE)
        own[first + QUANTITIES.index("d3d4")] = sum(own[first + QUANTITIES.index(name)] for name in ("d3", "d4"))
    return own


def drift_of(blocks: RmsBlocks) -> HealthyDrift:
    """Return the drift of the columns of `blocks.log_rms`, with a change of the noise as another step."""
    own = own_shares(blocks.log_rms)
    f, block = own.size, float(np.sqrt(blocks.seconds / WANDER_SECONDS))
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


def drift_beyond_noise(blocks: RmsBlocks) -> HealthyDrift:
    """Return the drift of `blocks.excess`: energies, which move twice as far as the RMS, of the machine alone."""
    own = own_shares(blocks.log_rms)[blocks.columns(*JUDGED)]
    block = float(np.sqrt(blocks.seconds / WANDER_SECONDS))
    return HealthyDrift(np.diag(2.0 * MACHINE_WANDER * block * own), np.zeros((own.size, 0)))
