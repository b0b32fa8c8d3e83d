"""Cut a recording into blocks that compare with each other, and give each the RMS of its details.

A block is a whole share of the command's cycle, so that blocks of the same phase differ by noise and by changes of the
machine alone; where there is no cycle it is a window of fixed length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.gaps import touched
from sealscope.recordings.motion import ROUNDING
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import Details, details

LEVELS = 4
#: The quantities of one chamber, in the order of the columns of `RmsBlocks.log_rms`.
QUANTITIES = ("d1", "d2", "d3", "d4", "d3d4")
#: Quantities that make the verdict; d1 holds noise alone, d3d4 follows from d3 and d4.
JUDGED = ("d2", "d3", "d4")
#: Length a block should have [s]: long enough for the RMS of d4 to be steady, short enough to place an onset.
BLOCK_SECONDS = 1.5
#: ... and fewest samples it should have: two periods of the slowest oscillation in d4, whose memory then ends in the
#: next block. It counts at sampling rates under 43 Hz.
BLOCK_SAMPLES = 64
#: The beginning is left out: pressures and speed settle within the first strokes after a start.
_SETTLING_SECONDS, _SETTLING_CYCLES, _SETTLING_AT_MOST = 10.0, 3.0, 1.0 / 8.0


@dataclass(frozen=True)
class RmsBlocks:
    """Log RMS of every quantity in every block.

    `edges` (n + 1,): where each block begins and the last ends [s]; `log_rms` (n, 5 per chamber): the phase's own level
    taken out; `chambers`: their names; `phases`: blocks a cycle (1: none); `cycle`: its length [s], None without a
    cycle; `still`: the first block in which a reading does not move, as text (its log RMS means nothing); `left_out`:
    blocks with missing samples, which are not among these.
    """

    edges: Array
    log_rms: Array
    chambers: tuple[str, ...]
    phases: int
    cycle: float | None
    still: str | None = None
    left_out: int = 0

    @property
    def share(self) -> float:
        """Share of all blocks that are not left out."""
        return len(self.log_rms) / max(len(self.log_rms) + self.left_out, 1)

    @property
    def names(self) -> list[str]:
        """Names of the columns, such as "d3 of p_A"."""
        return [f"{quantity} of {chamber}" for chamber in self.chambers for quantity in QUANTITIES]

    @property
    def seconds(self) -> float:
        """Length of a block [s]."""
        if self.left_out:
            return float(np.diff(self.edges).min())
        return float(self.edges[-1] - self.edges[0]) / len(self.log_rms)

    def columns(self, *quantities: str) -> list[int]:
        """Return the indices of the named quantities in every chamber."""
        return [
            chamber * len(QUANTITIES) + QUANTITIES.index(quantity)
            for chamber in range(len(self.chambers))
            for quantity in quantities
        ]

    def settled(self) -> RmsBlocks:
        """Return the blocks after the machine's start: without 10 s or three cycles, at most an eighth of them."""
        n = len(self.log_rms)
        if n == 0:
            return self
        start = max(_SETTLING_SECONDS, _SETTLING_CYCLES * (self.cycle or 0.0))
        first = min(int(n * _SETTLING_AT_MOST), int(np.ceil(start / self.seconds)))
        return replace(self, edges=self.edges[first:], log_rms=self.log_rms[first:])


def mean_squares(transformed: Details, bounds: np.ndarray) -> Array:
    """Return the mean squares of d1..d4 and d3d4 between consecutive sample bounds: (len(bounds) - 1, 5)."""
    squares = np.vstack([transformed.values**2, transformed.product()[None, :] ** 2])
    sums = np.add.reduceat(squares, bounds[:-1], axis=1)
    sums[:, -1] = squares[:, bounds[-2] : bounds[-1]].sum(axis=1)
    return np.asarray((sums / np.diff(bounds)).T)


def whole_log_rms(recording: Recording) -> Array:
    """Return the log RMS of every quantity over the whole recording but its edges: (5 per chamber,)."""
    rows = []
    for chamber in chambers_of(recording):
        transformed = details(recording[chamber])
        inside = transformed.inside()
        rows.append(mean_squares(transformed, np.array([inside.start, inside.stop]))[0])
    return np.asarray(0.5 * np.log(np.concatenate(rows)))


def cut(recording: Recording) -> RmsBlocks:
    """Cut a uniformly sampled recording without missing samples into blocks, edges of the transform dropped."""
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
        return RmsBlocks(recording.t[bounds], np.empty((0, len(QUANTITIES) * len(chambers))), chambers, phases, cycle)
    with np.errstate(divide="ignore", over="ignore"):
        log_rms = 0.5 * np.log(np.concatenate([mean_squares(chamber, bounds) for chamber in transformed], axis=1))
    ends = recording.t[0] + bounds / recording.rate
    kept = ~touched(recording, bounds)
    still = _still(recording, chambers, log_rms, ends, kept)
    if still is None and phases > 1:
        level = log_rms[kept].mean(axis=0)
        for phase in range(min(phases, count)):
            same = np.flatnonzero(kept)[np.flatnonzero(kept) % phases == phase]
            if same.size:
                log_rms[same] = log_rms[same] - log_rms[same].mean(axis=0) + level
    edges = np.append(ends[:-1][kept], ends[1:][kept][-1:] if kept.any() else ends[:1])
    return RmsBlocks(edges, log_rms[kept], chambers, phases, cycle, still, int(np.count_nonzero(~kept)))


def _still(
    recording: Recording, chambers: tuple[str, ...], log_rms: Array, edges: Array, kept: Array | np.ndarray
) -> str | None:
    """Say in which of the `kept` blocks a chamber's details are rounding, or no number, first; None for none."""
    for chamber, name in enumerate(chambers):
        levels = log_rms[:, chamber * len(QUANTITIES) : chamber * len(QUANTITIES) + LEVELS]
        floor = np.log(ROUNDING * np.abs(recording[name]).max())
        still = np.flatnonzero(kept & ~np.all(np.isfinite(levels) & (levels > floor), axis=1))
        if still.size:
            return f"{name} does not move from {edges[still[0]]:.4g} s to {edges[still[0] + 1]:.4g} s"
    return None


def excess(log_rms: Array, split: int) -> Array:
    """Return the energy of d2..d4 beyond that of d1, from its mean, in parts of the level's energy.

    `log_rms` (n, 5 per chamber); `split`: the first block after a change of the noise; returns (n, 3 per chamber).
    White noise, which every level holds alike, drops out of the mean. As the scatter of an energy goes with the energy,
    each side of `split` has a scale s of its own and counts as n/s^2 in the mean: while nothing but the noise has
    changed, blocks of both sides scatter alike, and the difference of their means no more than that of random halves.
    """
    energy = np.exp(2.0 * log_rms)
    sides = (slice(None, split), slice(split, None))
    columns = []
    for first in range(0, energy.shape[1], len(QUANTITIES)):
        for quantity in JUDGED:
            level = energy[:, first + QUANTITIES.index(quantity)]
            beyond = level - energy[:, first]
            scales = [float(level[side].mean()) for side in sides]
            weights = [level[side].size / scale**2 for side, scale in zip(sides, scales, strict=True)]
            mean = np.average([beyond[side].mean() for side in sides], weights=weights)
            columns.append(
                np.concatenate([(beyond[side] - mean) / scale for side, scale in zip(sides, scales, strict=True)])
            )
    return np.stack(columns, axis=1)
