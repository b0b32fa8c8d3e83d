"""A detector of one's own: has the energy of the pressures' ringing changed?

After each reversal the oil columns ring; a leak damps them, so the energy of their band changes. The record is cut into
blocks, and the blocks of its second half (or of all of it, where leak-free recordings are given) are compared with the
leak-free ones by Student's t. It reports the chance of the difference; Sealscope decides what that means.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import stdtr

from sealscope.diagnosis.detectors.registry import make_observable
from sealscope.diagnosis.inference.observable import Observed
from sealscope.parameters import Rig
from sealscope.recordings import Recording
from sealscope.signals.details import details

CHAMBERS = ("p_A", "p_B")
LEVEL = 3  # of db8; at 500 Hz the band from 31 to 62 Hz
BLOCK_SECONDS = 4.0
FEWEST = 8


def log_energy(recording: Recording, chamber: str) -> np.ndarray:
    """Log energy of the ringing's band in each block (n,)."""
    transformed = details(recording[chamber])
    ringing = transformed[LEVEL][transformed.inside(LEVEL)]
    width = max(1, round(BLOCK_SECONDS * recording.rate))
    count = ringing.size // width
    blocks = ringing[: count * width].reshape(count, width)
    return np.log(np.mean(blocks**2, axis=1))


def student_t(before: np.ndarray, after: np.ndarray) -> float:
    """Student's t of the difference of two means with one variance."""
    n, m = before.size, after.size
    pooled = (np.var(before, ddof=1) * (n - 1) + np.var(after, ddof=1) * (m - 1)) / (n + m - 2)
    return float((after.mean() - before.mean()) / math.sqrt(pooled * (1 / n + 1 / m)))


class RingingEnergy:
    """Change of the energy of the pressures' ringing, in either direction."""

    name = "ringing energy"  # that of the entry point

    def __init__(self, rig: Rig) -> None:
        """`rig` is what a detector may assume of the machine; this one assumes nothing."""

    def usable(self, recording: Recording) -> str | None:
        chambers = [name for name in CHAMBERS if name in recording]
        if not chambers:
            return "needs the pressure of a chamber (p_A or p_B)"
        needed = math.ceil((2 * FEWEST + 1) * BLOCK_SECONDS * recording.rate) + 226
        if len(recording) < needed:
            return f"needs {needed} samples or more without a gap, got {len(recording)}"
        for name in chambers:
            if np.ptp(recording[name]) == 0:
                return f"{name} is constant"
        return None

    def observe(self, recording: Recording, baseline: Sequence[Recording] = ()) -> Observed:
        chambers = [name for name in CHAMBERS if name in recording]
        changes = []
        for chamber in chambers:
            energy = log_energy(recording, chamber)
            healthy = [log_energy(other, chamber) for other in baseline if chamber in other]
            half = energy.size // 2
            before, after = (np.concatenate(healthy), energy) if healthy else (energy[:half], energy[half:])
            if not np.isfinite(energy).all() or not np.isfinite(before).all():
                return Observed(self.name, lack=f"{chamber} does not move all the time")
            tail = stdtr(before.size + after.size - 2, -abs(student_t(before, after)))
            # a rise or a fall, in either chamber: as many tests, of which the rarest counts
            chance = min(1.0, 2 * len(chambers) * float(tail))
            changes.append(make_observable(f"ringing of {chamber}", chance, size=after.mean() - before.mean()))
        return Observed(self.name, tuple(changes))
