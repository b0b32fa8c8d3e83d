"""Cut a recording into comparable blocks, and compute for each the RMS of the wavelet details and features of the duty.

The details are those of each chamber pressure, d1 to d4 with the wavelet db8 (`signals.details`). The duty is how the
machine is moved and loaded, measured by the command and p_A - p_B. A block is a whole fraction or multiple of the
duty's cycle (`find_cycle`), so that blocks of the same phase differ only by noise and by changes of the machine.
Without a cycle, a block is a window of fixed length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.priors.rms_change import RMS_PRIORS
from sealscope.recordings.channels import CHAMBERS, ROUNDING, chambers_of
from sealscope.recordings.corrections.gaps import flag_bridged
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.quality import is_mostly_clipped
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import QUANTITIES, details, find_inside, mean_squares, segment_means
from sealscope.signals.filters import IntArray, reach

#: Wavelet quantities on which an alarm may rest: d1 is almost only noise, and d3d4 follows from d3 and d4.
JUDGED = ("d2", "d3", "d4")
#: Most samples whose wavelet details are computed together.
_STRETCH = 2**18
#: Features of a block's duty, in the order of the columns of `RmsBlocks.duty`.
DUTY = tuple(vars(RMS_PRIORS.duty))


@dataclass(frozen=True)
class RmsBlocks:
    """Log RMS of every wavelet quantity (`QUANTITIES`) and features of the duty, in n blocks of a recording.

    If the duty repeats, the mean differences between the phases, the blocks of a cycle, are removed from both.
    """

    edges: Array  # (n + 1,): start of each block and end of the last one [s]
    log_rms: Array  # (n, 5 per chamber): logarithm of the RMS of each quantity
    # (n, 4), see `DUTY`: log RMS of the command, of its rate and of the pressure difference dp, and mean(dp)/RMS(dp)
    duty: Array
    chambers: tuple[str, ...]  # names of the chamber pressures
    cycle: float | None  # period of the duty [s], None if nothing repeats
    frozen: str | None = None  # description of the first block with a stuck pressure reading, if any
    n_left_out: int = 0  # number of blocks that were left out because samples are missing

    @property
    def share(self) -> float:
        """Fraction of the recording's blocks that are used; in the others too many samples are missing."""
        return len(self.log_rms) / max(len(self.log_rms) + self.n_left_out, 1)

    @property
    def seconds(self) -> float:
        """Length of a block [s]; 0 if there are no blocks."""
        # the smallest difference, since a block that was left out makes the difference of two starts larger
        return float(np.diff(self.edges).min()) if len(self.log_rms) else 0.0

    def without_start(self) -> RmsBlocks:
        """Return a copy without the first blocks, at most an eighth, in which pressures and speed settle."""
        n_blocks, prior = len(self.log_rms), RMS_PRIORS.blocks
        start_s = max(prior.settling, prior.settling_cycles * (self.cycle or 0.0))
        first = min(n_blocks // 8, int(np.ceil(start_s / self.seconds))) if n_blocks else 0
        return replace(self, edges=self.edges[first:], log_rms=self.log_rms[first:], duty=self.duty[first:])


def column_names(chambers: Sequence[str]) -> list[str]:
    """Return the names of the columns of `RmsBlocks.log_rms`, such as "d3 of p_A" for a wavelet detail of p_A."""
    return [f"{quantity} of {chamber}" for chamber in chambers for quantity in QUANTITIES]


def judged_chambers(recording: Recording) -> tuple[str, ...]:
    """Name the recorded chamber pressures that are not mostly clipped; all of them if none would be left."""
    chambers = chambers_of(recording)
    return tuple(name for name in chambers if not is_mostly_clipped(recording[name], recording.units[name])) or chambers


def measure_levels(recording: Recording) -> tuple[Array, Array]:
    """Compute a row of `RmsBlocks.log_rms` and of `RmsBlocks.duty` for a whole recording as one block.

    Its ends are left out, as the wavelet transform depends on padding there.
    """
    chambers, inside = judged_chambers(recording), find_inside(len(recording))
    bounds = np.array([inside.start, inside.stop])
    log_rms, duty = _measure_blocks(recording, _measure_details(recording, chambers, bounds), bounds)
    return log_rms[0], duty[0]


def _measure_details(recording: Recording, chambers: Sequence[str], bounds: IntArray) -> Array:
    """Compute the mean squares (n, 5 c) of the details of c chamber pressures in blocks that end at `bounds` (n + 1,).

    The details are computed for some samples at a time, with those on which they depend, as they are many in a long
    recording: for a few blocks, or for parts of a long block.
    """
    before, after = reach()[-1]
    parts = np.ceil(np.diff(bounds) / _STRETCH).astype(np.int64)  # of each block
    starts = np.repeat(np.cumsum(parts) - parts, parts)  # number of the first part of its block, for each part
    lengths = np.repeat(np.diff(bounds) / parts, parts)
    edges = np.repeat(bounds[:-1], parts) + np.rint((np.arange(len(starts)) - starts) * lengths).astype(np.int64)
    edges = np.append(edges, bounds[-1])
    size = max(1, _STRETCH // int(np.diff(edges).max()))  # parts at a time
    energies = []
    for first in range(0, len(starts), size):
        limits = edges[first : first + size + 1]
        begin, end = limits[0] - before, limits[-1] + after
        chunk = [mean_squares(details(recording[chamber][begin:end]), limits - begin) for chamber in chambers]
        energies.append(np.hstack(chunk))
    if len(starts) == len(parts):
        return np.concatenate(energies)
    sums = np.add.reduceat(np.concatenate(energies) * np.diff(edges)[:, None], np.cumsum(parts) - parts)
    return np.asarray(sums / np.diff(bounds)[:, None])


def _measure_blocks(recording: Recording, energies: Array, bounds: IntArray) -> tuple[Array, Array]:
    """Compute `RmsBlocks.log_rms` and `RmsBlocks.duty` of n blocks.

    `energies` (n, 5 c): mean squares of the wavelet details of each judged chamber, `bounds` (n + 1,): sample indices
    of the blocks' ends. The load is p_A - p_B, even if one of them is clipped, or the pressure of the only recorded
    chamber minus its mean. The log RMS is -inf for a detail that is 0, such as that of a stuck reading.
    """
    chambers = chambers_of(recording)
    if len(chambers) == len(CHAMBERS):
        load = recording["p_A"] - recording["p_B"]
    else:
        load = recording[chambers[0]] - recording[chambers[0]].mean()
    command = recording.channels.get("u", np.zeros(len(recording)))  # without u: equal in all blocks
    means, square_means = [], []  # over all samples, and over each block
    for signal in (command, np.gradient(command) * recording.rate, load):  # one by one, as they are long
        squares = np.square(signal)
        means.append(squares.mean())
        square_means.append(segment_means(squares[None], bounds)[0])
    # lower limit, so that the logarithm is finite in blocks at standstill
    floor = np.maximum(RMS_PRIORS.blocks.standstill**2 * np.array(means)[:, None], np.finfo(float).tiny)
    with np.errstate(divide="ignore", over="ignore"):
        log_rms = 0.5 * np.log(energies)
        duty_log_rms = 0.5 * np.log(square_means + floor)  # rows: command, its rate, load
    direction = segment_means(load[None], bounds) / np.exp(duty_log_rms[-1:])  # mean over RMS of the load
    return log_rms, np.vstack([duty_log_rms, direction]).T


def cut_blocks(recording: Recording) -> RmsBlocks:
    """Cut a uniformly sampled recording without gaps into blocks, and measure each.

    Blocks in which too many samples were missing are left out, and so are the ends, where the wavelet transform depends
    on padding. If the duty repeats, the mean differences between the phases of its cycle are removed, unless a reading
    is stuck, whose log RMS has no mean.
    """
    chambers = judged_chambers(recording)
    cycle = find_cycle(recording)
    bounds, phases = _block_bounds(find_inside(len(recording)), recording.rate, cycle)
    if len(bounds) == 1:  # too short for a block
        no_rms, no_duty = np.empty((0, len(QUANTITIES) * len(chambers))), np.empty((0, len(DUTY)))
        return RmsBlocks(recording.t[bounds], no_rms, no_duty, chambers, cycle)
    energies = _measure_details(recording, chambers, bounds)
    log_rms, duty = _measure_blocks(recording, energies, bounds)
    times = recording.t[0] + bounds / recording.rate
    is_complete = ~flag_bridged(recording, bounds)
    frozen = _find_frozen(recording, chambers, log_rms, is_complete, times)
    log_rms, duty = log_rms[is_complete], duty[is_complete]
    phase_of_block = np.flatnonzero(is_complete) % phases
    if frozen is None and phases > 1:
        for values in (log_rms, duty):  # replace the mean of every phase by the mean of all blocks
            mean = values.mean(axis=0) if len(values) else 0.0
            for phase in np.unique(phase_of_block):
                values[phase_of_block == phase] += mean - values[phase_of_block == phase].mean(axis=0)
    # starts of the complete blocks, and the end of the last one
    end = times[1:][is_complete][-1:] if is_complete.any() else times[:1]
    edges = np.append(times[:-1][is_complete], end)
    return RmsBlocks(edges, log_rms, duty, chambers, cycle, frozen, n_left_out=int(np.count_nonzero(~is_complete)))


def _block_bounds(inside: slice, rate: float, cycle: float | None) -> tuple[IntArray, int]:
    """Choose the sample indices at which blocks begin and end (n + 1,), and the number of blocks per duty cycle.

    `inside` are the samples at which the wavelet details do not depend on padding, `rate` is the sampling rate [Hz],
    and `cycle` the period of the duty [s], or None.
    """
    prior, n_samples = RMS_PRIORS.blocks, inside.stop - inside.start
    block_s = prior_s = max(prior.seconds, prior.samples / rate)
    phases = 1
    if cycle is not None:  # a whole fraction of the cycle, or a multiple if the cycle is shorter than `prior_s`
        phases = max(1, round(cycle / prior_s))
        phase_s = cycle / phases
        block_s = phase_s * max(1, round(prior_s / phase_s))
    if n_samples > prior.most * block_s * rate:  # too many blocks: make them longer, of whole cycles without phases
        block_s *= phases * math.ceil(n_samples / (prior.most * phases * block_s * rate))
        phases = 1
    n_blocks = int(n_samples / (block_s * rate))
    return inside.start + np.round(np.arange(n_blocks + 1) * block_s * rate).astype(np.int64), phases


def _find_frozen(
    recording: Recording, chambers: Sequence[str], log_rms: Array, is_complete: NDArray[np.bool_], times: Array
) -> str | None:
    """Describe the first block in which a pressure reading is stuck; None if no reading is stuck.

    A reading is stuck if one of its details d1 to d4 is only rounding error or not finite. Only complete blocks are
    searched; `times` (n + 1,) are the bounds of all [s]. If several readings are stuck, the first chamber is described.
    """
    floor = np.log([ROUNDING * np.abs(recording[name]).max() for name in chambers])[:, None]
    levels = log_rms.reshape(len(log_rms), len(chambers), -1)[:, :, :-1]  # without d3d4
    is_frozen = is_complete[:, None] & ~np.all(np.isfinite(levels) & (levels > floor), axis=2)
    if not is_frozen.any():
        return None
    chamber = int(np.argmax(is_frozen.any(axis=0)))
    block = int(np.argmax(is_frozen[:, chamber]))
    return f"{chambers[chamber]} does not move from {times[block]:.4g} s to {times[block + 1]:.4g} s"
