"""The thesis's method as a detector: changes of the RMS of the pressures' db8 wavelet details.

The thesis compares the RMS of d1 to d4 and of d3*d4 before and after (its ch. 5 and Appendix C). It states a leak if
the RMS has decreased (p_A) or increased (p_B). Here d2 to d4 of all chambers are tested for a step of either sign
within the recording (`estimate.change`), or for a rise or fall against leak-free recordings (`inference.comparison`).

A recording is cut into comparable blocks. The duty is how the machine is moved and loaded, measured by the command and
p_A - p_B. A block is a whole fraction or multiple of the duty's cycle (`find_cycle`), so that blocks of the same phase
differ only by noise and by changes of the machine. Without a cycle, a block is a window of fixed length.

The ringing is an oscillation of the pressures, which a leak damps. A detail d_j has the energy E_j = (1 + g)^2 S_j +
E_1. S_j is the mean energy of the machine's ringing in d_j, g the relative change of the ringing's amplitude, and E_1
the energy of white noise, which is equal in every detail; d1 is almost only noise. To first order g follows from

    y = log RMS d_j - log sqrt(S_j + E_1) = w g + error,    w = S_j / (S_j + E_1),

with E_1 measured in d1 of the same block or recording. A change of the noise therefore cancels, and the weight w is
small where noise dominates. For d1, y is the log RMS itself. The effect of the duty (how the machine is moved and
loaded) is eliminated: g follows powers of the duty's features (`DUTY`) with priors on the exponents (`priors.toml`).
For a duty that does not repeat, g has a wider random walk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.change import Information, StepTest, step_tests
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.estimate.population import Population, ScatterPrior, number_sessions
from sealscope.diagnosis.healthy import (
    MAX_LOGARITHM,
    Healthy,
    Positive,
    Summary,
    Texts,
    Time,
    Values,
    healthy_summaries,
)
from sealscope.diagnosis.inference.comparison import Rise, rise_of_mixture
from sealscope.diagnosis.inference.observable import Observable, Observed, Ringing
from sealscope.diagnosis.priors.rms_change import RMS_PRIORS
from sealscope.diagnosis.verdict.evidence import RMS_CHANGE
from sealscope.recordings.channels import CHAMBERS, ROUNDING, chambers_of
from sealscope.recordings.corrections.gaps import flag_bridged
from sealscope.recordings.header import start_seconds
from sealscope.recordings.motion import find_cycle, is_constant
from sealscope.recordings.quality import describe_missing_chambers, is_mostly_clipped
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import (
    QUANTITIES,
    IntArray,
    details,
    find_inside,
    mean_squares,
    min_samples,
    reach,
    segment_means,
)

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


def subtract_noise(log_rms: Array, healthy: Array) -> tuple[Array, Array]:
    """Compute the change of the log RMS of wavelet details relative to healthy values, with the noise removed.

    `log_rms` (n, 5 per chamber) are values of n blocks or recordings, for the details d1 to d4 and the product d3d4.
    S_j is estimated from `healthy` (k, 5 per chamber), as the mean energy of d_j minus that of d1. Returns the changes
    y and the fractions w of the energy that is not noise, both (n, 5 per chamber):

        d2, d3, d4:   y = log RMS - log sqrt(S_j + E_1),    w = S_j / (S_j + E_1)
        d1:           y = log RMS,    w = 1
        d3d4:         y = log RMS minus the terms log sqrt(S_j + E_1) of both d3 and d4,    w = 1.
    """
    y, weight = np.array(log_rms), np.ones_like(log_rms)
    min_signal_fraction = RMS_PRIORS.walk.least  # S_j is a difference of two estimates, which might be negative
    for d1 in range(0, log_rms.shape[1], len(QUANTITIES)):  # column of each chamber's d1
        noise = np.exp(2.0 * log_rms[:, d1])
        d3, d4, product = (d1 + QUANTITIES.index(name) for name in ("d3", "d4", "d3d4"))
        for column in range(d1 + 1, product):
            noise_energy, energy = np.exp(2.0 * healthy[:, [d1, column]]).mean(axis=0)
            signal = max(energy - noise_energy, min_signal_fraction * energy)
            y[:, column] -= 0.5 * np.log(signal + noise)
            weight[:, column] = signal / (signal + noise)
        # to first order the log RMS of d3d4 changes by the sum of the changes of d3 and d4
        y[:, product] += y[:, d3] - log_rms[:, d3] + y[:, d4] - log_rms[:, d4]
    return y, weight


def change_information(blocks: RmsBlocks) -> tuple[list[Information], Array]:
    """Compute the likelihood of the relative change g of the ringing in each block of a recording.

    Returns for each column of `blocks.log_rms` a normal likelihood of g over the blocks, and the means of w (columns,).
    """
    changes, weight = subtract_noise(blocks.log_rms, blocks.log_rms)
    variances = np.mean(np.diff(changes, axis=0) ** 2, axis=0) / 2.0  # a difference has twice the variance
    features = DUTY[:-1]  # no direction: it belongs to the phase of a cycle, whose mean difference is removed already
    duty = (blocks.duty - blocks.duty.mean(axis=0))[:, : len(features)]
    exponent_sd = np.array([getattr(RMS_PRIORS.duty, name) for name in features])
    time = blocks.edges[:-1] + 0.5 * blocks.seconds
    walks = RMS_PRIORS.walk
    # convert scales for `walk.time` to the length of all blocks: a random walk grows with the root of the time; the
    # linear change is given the same scale
    walk_scale = float(np.sqrt(len(time) * blocks.seconds / walks.time))
    machine_walk = walks.duty if blocks.cycle is None else walks.machine
    results = list[Information]()
    for name, y, w, variance in zip(column_names(blocks.chambers), changes.T, weight.T, variances, strict=True):
        drift_scale = (walks.noise if name.startswith("d1 ") else machine_walk) * walk_scale
        precision, vector = w**2 / variance, w * y / variance
        # eliminate the exponents of the duty D, which have normal priors: P - P D (D'P D + 1/sd^2)^-1 D'P
        weighted = precision[:, None] * duty
        gain = weighted @ np.linalg.inv(duty.T @ weighted + np.diag(exponent_sd**-2))
        precision, vector = np.diag(precision) - gain @ weighted.T, vector - gain @ (duty.T @ vector)
        results.append(Information(time, precision, vector, slope=drift_scale, walk=drift_scale))
    return results, weight.mean(axis=0)


def estimate_rises(
    log_rms: Array, duty: Array, healthy: Array, healthy_duty: Array, times: Array | None = None
) -> tuple[list[Rise], Array]:
    """Estimate the change g of the log RMS of wavelet details (ringing) relative to n leak-free recordings.

    `log_rms` (5 per chamber,) and `duty` (4,), the features `DUTY`, are those of the judged recording, `healthy` (n, 5
    per chamber) and `healthy_duty` (n, 4) those of the leak-free ones. `times` (n + 1,) are the start times [s], with
    that of the judged recording at the end; None if unknown. Returns the change of each wavelet quantity, and the
    fractions of energy that are not noise in the leak-free recordings, (5 per chamber,). g is the log RMS without its
    noise (`subtract_noise`) over this fraction.

    The model is the sum of a common mean, an effect of the duty, independent scatter, and an Ornstein-Uhlenbeck process
    over time, independent between sessions, which are separated by pauses. The likelihood is averaged over a prior on
    the rate of this process.
    """
    prior, walk, n = RMS_PRIORS.recordings, RMS_PRIORS.walk, len(healthy)
    exponent_sd = np.array([getattr(RMS_PRIORS.duty, name) for name in DUTY])
    # effects of exponents of one standard deviation, relative to the judged recording (last row)
    effects = (np.vstack([healthy_duty, duty]) - duty) * exponent_sd
    # quantiles of the half-Cauchy prior on the standard deviation that the process gains in `walk.time`
    probabilities = (np.arange(walk.tried) + 0.5) / walk.tried
    walk_sd = walk.machine * np.tan(0.5 * np.pi * probabilities)
    # within a time t, short compared with 1/rate, the process gains the variance 2 rate t session^2
    rates = (walk_sd / prior.session) ** 2 / (2.0 * walk.time)
    elapsed, same_session = np.zeros((n + 1, n + 1)), np.ones((n + 1, n + 1))  # without dates: one session
    if times is not None:
        sessions = number_sessions(list(times), prior.pause)
        elapsed = np.abs(np.subtract.outer(times, times))
        same_session = np.equal.outer(sessions, sessions).astype(float)
    walk_covariances = prior.session**2 * np.exp(-rates[:, None, None] * elapsed) * same_session
    population = Population(walk_covariances + effects @ effects.T, np.zeros(len(rates)))  # rates are equally likely
    y, weights = subtract_noise(np.vstack([log_rms, healthy]), healthy)
    weight = weights[1:].mean(axis=0)
    rises = []
    for judged_g, healthy_g, w in zip(y[0] / weight, y[1:].T / weight[:, None], weight, strict=True):
        scatter = float(np.hypot(prior.scatter, prior.error / w))  # g = y / w has the error of y over w
        predicted = population.predict_with_prior(healthy_g[None], ScatterPrior(scatter, prior.freedom))
        rises.append(rise_of_mixture(predicted, judged_g[None]))
    return rises, weight


#: Kind of data (`Observable.data`) of the judged details d2 to d4.
DETAILS = "details"


@dataclass(frozen=True, eq=False, kw_only=True)
class DetailSummary(Summary):
    """Summary of a healthy recording by the RMS of its wavelet details (`RmsChange.learn`).

    `chambers`: pressures of the `levels` (5 per chamber,), a row of `RmsBlocks.log_rms`; `recorded`: all recorded
    chamber pressures; `rate`: sampling rate [Hz]; `start_s`: date [s since 1970]; `duty` (4,): the features `DUTY`.
    """

    method: ClassVar[str] = RMS_CHANGE

    chambers: Texts
    recorded: Texts
    rate: Positive
    start_s: Time | None = None
    levels: Values
    duty: Values

    def check(self) -> None:
        """Check shapes and logarithms; raise ValueError if they are not valid."""
        expected = (len(QUANTITIES) * len(self.chambers),)
        if not self.chambers or self.levels.shape != expected or self.duty.shape != (len(DUTY),):
            shapes = f"{self.levels.shape} and {self.duty.shape}"
            raise ValueError(f"levels and duty must be of the shapes {expected} and ({len(DUTY)},), got {shapes}")
        if not max(np.abs(self.levels).max(), np.abs(self.duty).max()) < MAX_LOGARITHM:
            raise ValueError(f"levels and duty must be logarithms with a magnitude below {MAX_LOGARITHM:g}")

    def levels_of(self, chambers: Sequence[str]) -> Array:
        """Select the log RMS of the wavelet details (5 per chamber,) of the given chambers."""
        levels = self.levels.reshape(len(self.chambers), -1)
        return np.concatenate([levels[self.chambers.index(chamber)] for chamber in chambers])


class RmsChange:
    """Detector of changes of the wavelet details' RMS, within a recording or against leak-free recordings."""

    name, summary_type = RMS_CHANGE, DetailSummary

    def __init__(self, rig: object = None) -> None:
        """Create the detector; `rig` is ignored, as the method needs no assumption on the machine."""

    def usable(self, recording: Recording) -> str | None:
        """Return the reason why a recording cannot be judged: no chamber pressure, too short or constant; else None."""
        if missing := describe_missing_chambers(recording):
            return missing
        if len(recording) < min_samples():
            return f"needs {min_samples()} samples or more without a gap, got {len(recording)}"
        frozen = next((name for name in chambers_of(recording) if is_constant(recording[name])), None)
        return None if frozen is None else f"{frozen} is constant"

    def learn(self, recording: Recording) -> DetailSummary:
        """Summarise a healthy recording by the log RMS of its wavelet details, for comparison with later recordings."""
        levels, duty = measure_levels(recording)
        return DetailSummary(
            chambers=list(judged_chambers(recording)),
            recorded=list(chambers_of(recording)),
            rate=recording.rate,
            start_s=start_seconds(recording),
            levels=levels,
            duty=duty,
        )

    def observe(self, recording: Recording, baseline: Sequence[Healthy] = ()) -> Observed:
        """Test the RMS of the wavelet details against `baseline` or, without one, for a change within the recording."""
        min_rate: float = RMS_PRIORS.rate.slowest
        if recording.rate < min_rate:
            rule = f"needs {min_rate:g} Hz or more to see the ringing that a leak damps"
            return Observed(self.name, lack=f"{rule}, got {recording.rate:g} Hz: is the unit of the time right?")
        if baseline:
            return observe_against(recording, baseline)
        blocks = cut_blocks(recording)
        if blocks.frozen is not None:
            return Observed(self.name, lack=f"the pressures cannot be trusted: {blocks.frozen}")
        if len(blocks.log_rms) < (min_blocks := RMS_PRIORS.blocks.fewest):
            short = f"too short to be its own baseline: {len(blocks.log_rms)} blocks, {min_blocks} are needed"
            return Observed(self.name, lack=f"{short}; give leak-free recordings as --baseline")
        return observe_within(blocks.without_start(), recording.rate, recording.unused)


def observe_within(blocks: RmsBlocks, rate: float, unused: tuple[str, ...] = ()) -> Observed:
    """Test the wavelet details of every chamber pressure for a step of their RMS within one recording.

    The more significant of a step up and a step down is reported for each detail, with their common onset. The bound of
    an undetected change of the ringing is the smallest by a judged detail, as the ringing changes in all of them.
    `rate` is the sampling rate [Hz]; `unused`, for the report, are the names of columns that are not used as channels.
    """
    changes = dict[str, tuple[StepTest, float]]()  # by detail: the more significant test, and the change of the log RMS
    judged_steps, bounds = list[StepTest](), list[float]()
    # of the change g of the ringing, i.e. of the log RMS without noise; fractions of energy that is not noise
    likelihoods, weights = change_information(blocks)
    for name, likelihood, weight in zip(column_names(blocks.chambers), likelihoods, weights, strict=True):
        steps = step_tests(likelihood, signs=(1.0, -1.0))
        if not steps:
            return Observed(RmsChange.name, lack=f"{name} gives no information in most blocks")
        up, down = steps
        step, sign = (up, 1.0) if up.chance <= down.chance else (down, -1.0)
        changes[name] = step, sign * weight * step.fitted.value
        if _is_judged(name):
            judged_steps.append(step)
            bounds.append(max(up.bound(), down.bound()))
    rarest = min(judged_steps, key=lambda step: step.chance)
    # a step that half of all healthy recordings would show (p-value 0.5) tells nothing about the onset
    onset_likelihood = np.sum([step.likelihood for step in judged_steps if step is rarest or step.chance < 0.5], axis=0)
    onset = replace(rarest, likelihood=onset_likelihood, best=int(onset_likelihood.argmax())).onset()
    observables = [
        _make_observable(name, size, step.score, step.chance, blocks.chambers, onset)
        for name, (step, size) in changes.items()
    ]
    # blocks that were left out may lie anywhere; `judged_until` counts them as if they were the last ones
    return Observed(
        RmsChange.name,
        tuple(observables),
        share=blocks.share,
        judged_until=blocks.share,
        ringing=Ringing(min(bounds), rate, healthy=0, is_dated=True, unused=unused),  # one recording needs no date
    )


def observe_against(recording: Recording, baseline: Sequence[Healthy]) -> Observed:
    """Test the RMS of a recording's wavelet details for changes against leak-free recordings.

    Of `baseline`, only recordings with the same chamber pressures and sampling rate are used, in which none of the
    judged pressures (`judged_chambers`) is mostly clipped.
    """
    chambers, recorded = judged_chambers(recording), list(chambers_of(recording))
    # the duty is computed from all recorded chambers, which must therefore be the same
    comparable = [
        summary
        for summary in healthy_summaries(RmsChange(), baseline)
        if summary.recorded == recorded and has_same_rate(summary.rate, recording.rate)
    ]
    summaries = [summary for summary in comparable if set(chambers) <= set(summary.chambers)]
    if not summaries:
        kind = f"the same chambers at {recording.rate:g} Hz"
        clipped = f"{' or '.join(chambers)} is mostly clipped in every baseline recording with {kind}"
        return Observed(RmsChange.name, lack=clipped if comparable else f"no baseline recording has {kind}")
    (judged,) = healthy_summaries(RmsChange(), [recording])  # computed once
    observables, bound = compare_summaries(judged, summaries, chambers)
    is_dated = None not in [summary.start_s for summary in (judged, *summaries)]
    ringing = Ringing(bound, recording.rate, len(summaries), is_dated, recording.unused)
    return Observed(RmsChange.name, observables, ringing=ringing)


def has_same_rate(rate: float, other: float) -> bool:
    """Return True if two sampling rates [Hz] are equal within the error of a logger's clock (0.1 %)."""
    return abs(rate / other - 1.0) < 1e-3


def compare_summaries(
    judged: DetailSummary, summaries: Sequence[DetailSummary], chambers: Sequence[str]
) -> tuple[tuple[Observable, ...], float]:
    """Test the RMS of every chamber pressure's wavelet details for a rise or fall against leak-free recordings.

    `judged` and `summaries` are summaries (`RmsChange.learn`) of the judged and the leak-free recordings, and
    `chambers` the pressures to compare. Returns an observable for each detail and chamber, and the 95 % upper bound of
    an undetected change g of the ringing (log RMS without noise): the smallest of those by the judged details d2 to d4,
    which all contain the ringing.
    """
    starts = [summary.start_s for summary in (*summaries, judged)]
    times = None if None in starts else np.array(starts, dtype=float)
    duties = np.array([summary.duty for summary in summaries])
    levels = np.array([summary.levels_of(chambers) for summary in summaries])
    observables, bounds = list[Observable](), list[float]()
    # changes g of the ringing, and fractions of energy that is not noise
    rises, weights = estimate_rises(judged.levels_of(chambers), judged.duty, levels, duties, times)
    for name, rise, weight in zip(column_names(chambers), rises, weights, strict=True):
        change = rise._replace(value=abs(rise.value))  # a fall is tested like a rise of the same size
        score = 2.0 * change.log_ratio(change.value)
        observables.append(_make_observable(name, weight * rise.value, score, change.chance, chambers))
        if _is_judged(name):
            bounds.append(change.bound())
    return tuple(observables), min(bounds)


def _is_judged(column: str) -> bool:
    """Return True if a column, such as "d3 of p_A", may raise an alarm: if its wavelet detail is one of `JUDGED`."""
    return column.split(maxsplit=1)[0] in JUDGED


def _make_observable(
    column: str, size: float, score: float, chance: float, chambers: Sequence[str], onset: Interval | None = None
) -> Observable:
    """Make the observable for the change of one wavelet detail, named by its `column`, such as "d3 of p_A".

    `size` is the change of the log RMS, and `chance` the p-value of this test alone. d1 and d3d4, which are not judged,
    have a kind of data of their own: a leak may change it, but is not detected by it (`decision/events.toml`).
    """
    n_tests = 2 * len(JUDGED) * len(chambers)  # for a rise and a fall of each judged detail
    return Observable(
        name=f"{'rise' if size > 0.0 else 'fall'} of {column}",
        data=DETAILS if _is_judged(column) else "noise of details",
        score=score,
        chance=min(1.0, n_tests * chance),
        onset=onset,
        size=size,
    )
