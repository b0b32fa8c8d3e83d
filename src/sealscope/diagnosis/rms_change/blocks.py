"""Cut a recording into blocks of equal standing and give each the RMS of its details.

A block is a whole share of the command's cycle, so that blocks of the same phase are alike but for noise and for what
has changed in the machine; where there is no cycle it is a window of fixed length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.motion import ROUNDING
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import Details, details

LEVELS = 4
#: The quantities of one chamber, in the order of the columns of `Blocks.log_rms`.
QUANTITIES = ("d1", "d2", "d3", "d4", "d3d4")
#: Length a block should have [s]: long enough for the RMS of d4 to be steady, short enough to place an onset.
BLOCK_SECONDS = 1.5
#: ... and fewest samples it should have: two periods of the slowest oscillation in d4, whose memory then ends in the
#: next block. It counts at sampling rates under 43 Hz.
BLOCK_SAMPLES = 64


@dataclass(frozen=True)
class Blocks:
    """log RMS of every quantity in every block.

    `edges`: (n + 1,) boundaries [s]; `log_rms`: (n, 5 per chamber), the phase's own level taken out; `chambers`:
    their names; `phases`: blocks a cycle (1: none); `cycle`: its length [s], None where no cycle was found; `still`:
    the first block in which a reading does not move, in words (its log RMS means nothing).
    """

    edges: Array
    log_rms: Array
    chambers: tuple[str, ...]
    phases: int
    cycle: float | None
    still: str | None = None

    @property
    def names(self) -> list[str]:
        """Names of the columns, such as "d3 of p_A"."""
        return [f"{quantity} of {chamber}" for chamber in self.chambers for quantity in QUANTITIES]

    def columns(self, *quantities: str) -> list[int]:
        """Indices of the named quantities in every chamber."""
        return [
            chamber * len(QUANTITIES) + QUANTITIES.index(quantity)
            for chamber in range(len(self.chambers))
            for quantity in quantities
        ]


def mean_squares(found: Details, bounds: np.ndarray) -> Array:
    """Mean square of d1..d4 and d3d4 between consecutive sample bounds: (len(bounds) - 1, 5)."""
    squares = np.vstack([found.values**2, found.product()[None, :] ** 2])
    sums = np.add.reduceat(squares, bounds[:-1], axis=1)
    sums[:, -1] = squares[:, bounds[-2] : bounds[-1]].sum(axis=1)
    return np.asarray((sums / np.diff(bounds)).T)


def whole_log_rms(recording: Recording) -> Array:
    """log RMS of every quantity over the whole recording but its edges: (5 per chamber,)."""
    rows = []
    for chamber in chambers_of(recording):
        found = details(recording[chamber])
        inside = found.inside()
        rows.append(mean_squares(found, np.array([inside.start, inside.stop]))[0])
    return np.asarray(0.5 * np.log(np.concatenate(rows)))


def cut(recording: Recording) -> Blocks:
    """Blocks of a uniformly sampled recording without missing samples, edges of the transform dropped."""
    chambers = chambers_of(recording)
    transformed = [details(recording[chamber]) for chamber in chambers]
    inside = transformed[0].inside()
    cycle = find_cycle(recording)
    wanted = max(BLOCK_SECONDS, BLOCK_SAMPLES / recording.rate)
    phases = 1 if cycle is None else max(1, round(cycle / wanted))
    length = wanted if cycle is None else cycle / phases * max(1, round(wanted / (cycle / phases)))
    count = int((inside.stop - inside.start) / (length * recording.rate))
    bounds = inside.start + np.round(np.arange(count + 1) * length * recording.rate).astype(np.int64)
    if count == 0:
        return Blocks(recording.t[bounds], np.empty((0, len(QUANTITIES) * len(chambers))), chambers, phases, cycle)
    with np.errstate(divide="ignore", over="ignore"):
        log_rms = 0.5 * np.log(np.concatenate([mean_squares(found, bounds) for found in transformed], axis=1))
    ends = recording.t[0] + bounds / recording.rate
    still = _still(recording, chambers, log_rms, ends)
    if still is not None:
        return Blocks(ends, log_rms, chambers, phases, cycle, still)
    if phases > 1:
        level = log_rms.mean(axis=0)
        for phase in range(min(phases, count)):
            same = log_rms[phase::phases]
            log_rms[phase::phases] = same - same.mean(axis=0) + level
    return Blocks(ends, log_rms, chambers, phases, cycle)


def _still(recording: Recording, chambers: tuple[str, ...], log_rms: Array, edges: Array) -> str | None:
    """The first block in which a chamber's details are mere rounding, or no number, in words."""
    for chamber, name in enumerate(chambers):
        levels = log_rms[:, chamber * len(QUANTITIES) : chamber * len(QUANTITIES) + LEVELS]
        floor = np.log(ROUNDING * np.abs(recording[name]).max())
        found = np.flatnonzero(~np.all(np.isfinite(levels) & (levels > floor), axis=1))
        if found.size:
            first = int(found[0])
            return f"{name} does not move from {edges[first]:.4g} s to {edges[first + 1]:.4g} s"
    return None
