"""Cut a recording into blocks that compare with each other, and give each the RMS of its details and of its duty.

A block is a whole share of the command's cycle, so that blocks of the same phase differ by noise and by changes of the
machine alone; where there is no cycle it is a window of fixed length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sealscope.diagnosis.priors import priors
from sealscope.recordings.chambers import CHAMBERS, chambers_of
from sealscope.recordings.corrections.gaps import touched
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.motion import ROUNDING
from sealscope.recordings.quality import mostly_clipped
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import QUANTITIES, Details, details, mean_squares, segment_means
from sealscope.signals.filters import IntArray

#: Quantities that make the verdict; d1 holds noise alone, d3d4 follows from d3 and d4.
JUDGED = ("d2", "d3", "d4")
#: What is known of a block's duty, in the order of the columns of `RmsBlocks.duty`.
DUTY = ("command", "rate", "load", "direction")


@dataclass(frozen=True)
class RmsBlocks:
    """Log RMS of every quantity (`QUANTITIES`) in every block.

    `edges` (n + 1,): where each block begins and the last ends [s]; `log_rms` (n, 5 per chamber), `duty` (n, 4): log
    RMS of the command, of its rate of change, and of the pressure difference, and the mean of the latter over its RMS;
    the phase's own level is taken out of both. `chambers`: their names; `phases`: blocks a cycle (1: none); `cycle`:
    its length [s], None without a cycle; `still`: the first block in which a reading does not move, as text (its log
    RMS means nothing); `left_out`: blocks with missing samples, which are not among these.
    """

    edges: Array
    log_rms: Array
    duty: Array
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
        return columns_of(self.chambers)

    @property
    def seconds(self) -> float:
        """Length of a block [s]."""
        return float(np.diff(self.edges).min()) if len(self.log_rms) else 0.0

    def without_start(self) -> RmsBlocks:
        """Return the blocks after the machine's start: without 10 s or three cycles, at most an eighth of them."""
        n, believed = len(self.log_rms), priors("rms_change")["blocks"]
        start = max(believed["settling"], believed["settling_cycles"] * (self.cycle or 0.0))
        first = min(n // 8, int(np.ceil(start / self.seconds))) if n else 0
        return replace(self, edges=self.edges[first:], log_rms=self.log_rms[first:], duty=self.duty[first:])


def columns_of(chambers: Sequence[str]) -> list[str]:
    """Return the names of the columns of `RmsBlocks.log_rms`."""
    return [f"{quantity} of {chamber}" for chamber in chambers for quantity in QUANTITIES]


def judged_chambers(recording: Recording) -> tuple[str, ...]:
    """Return the chambers to judge: those with readings not mostly clipped, or all."""
    chambers = chambers_of(recording)
    return tuple(name for name in chambers if not mostly_clipped(recording[name])) or chambers


def whole_levels(recording: Recording) -> tuple[Array, Array]:
    """Return the log RMS (5 per judged chamber,) and the duty (4,) of the whole recording but its edges."""
    transformed = [details(recording[chamber]) for chamber in judged_chambers(recording)]
    inside = transformed[0].inside()
    log_rms, duty = _columns(recording, transformed, np.array([inside.start, inside.stop]))
    return log_rms[0], duty[0]


def _columns(recording: Recording, transformed: list[Details], bounds: IntArray) -> tuple[Array, Array]:
    """Return log RMS (n, 5 per chamber) and duty (n, 4) between consecutive sample bounds."""
    chambers = chambers_of(recording)
    if len(chambers) == len(CHAMBERS):
        load = recording["p_A"] - recording["p_B"]
    else:
        load = recording[chambers[0]] - recording[chambers[0]].mean()
    command = recording.channels.get("u", np.zeros(len(recording)))
    squares = np.stack([command, np.gradient(command) * recording.rate, load]) ** 2
    rest = np.maximum(
        priors("rms_change")["blocks"]["standstill"] ** 2 * squares.mean(axis=1, keepdims=True), np.finfo(float).tiny
    )
    with np.errstate(divide="ignore", over="ignore"):
        energies = np.concatenate([mean_squares(signal, bounds) for signal in transformed], axis=1)
        log_rms, duty = 0.5 * np.log(energies), 0.5 * np.log(segment_means(squares, bounds) + rest)
    return log_rms, np.vstack([duty, segment_means(load[None], bounds) / np.exp(duty[-1:])]).T


def cut_blocks(recording: Recording) -> RmsBlocks:
    """Cut a uniformly sampled recording without missing samples into blocks, edges of the transform dropped."""
    chambers, rate, believed = judged_chambers(recording), recording.rate, priors("rms_change")["blocks"]
    transformed = [details(recording[chamber]) for chamber in chambers]
    inside, cycle = transformed[0].inside(), find_cycle(recording)
    target = max(believed["seconds"], believed["samples"] / rate)
    phases = 1 if cycle is None else max(1, round(cycle / target))
    length = target if cycle is None else cycle / phases * max(1, round(target / (cycle / phases)))
    samples = inside.stop - inside.start
    if samples > believed["most"] * length * rate:
        length *= phases * math.ceil(samples / (believed["most"] * phases * length * rate))
        phases = 1
    count = int(samples / (length * rate))
    bounds = inside.start + np.round(np.arange(count + 1) * length * rate).astype(np.int64)
    if count == 0:
        empty = np.empty((0, len(QUANTITIES) * len(chambers)))
        return RmsBlocks(recording.t[bounds], empty, np.empty((0, len(DUTY))), chambers, phases, cycle)
    log_rms, duty = _columns(recording, transformed, bounds)
    ends, kept = recording.t[0] + bounds / rate, ~touched(recording, bounds)
    floor = np.log([ROUNDING * np.abs(recording[name]).max() for name in chambers])[:, None]
    levels = log_rms.reshape(count, len(chambers), -1)[:, :, :-1]  # of d1 to d4; else rounding, or no number
    fixed = kept[:, None] & ~np.all(np.isfinite(levels) & (levels > floor), axis=2)
    still = None
    if fixed.any():
        chamber = int(np.argmax(fixed.any(axis=0)))
        first = int(np.argmax(fixed[:, chamber]))
        still = f"{chambers[chamber]} does not move from {ends[first]:.4g} s to {ends[first + 1]:.4g} s"
    elif phases > 1:
        for values in (log_rms, duty):
            level = values[kept].mean(axis=0)
            for phase in range(min(phases, count)):
                same = np.flatnonzero(kept)[np.flatnonzero(kept) % phases == phase]
                if same.size:
                    values[same] += level - values[same].mean(axis=0)
    edges = np.append(ends[:-1][kept], ends[1:][kept][-1:] if kept.any() else ends[:1])
    return RmsBlocks(edges, log_rms[kept], duty[kept], chambers, phases, cycle, still, int(np.count_nonzero(~kept)))
