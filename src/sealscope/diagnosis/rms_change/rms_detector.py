"""The thesis's method as a detector: changes of the RMS of the pressures' db8 wavelet details.

The thesis compares the RMS of d1 to d4 and of d3*d4 before and after (its ch. 5 and Appendix C). It states a leak if
the RMS has decreased (p_A) or increased (p_B). Here d2 to d4 of all chambers are tested for a step of either sign
within the recording (`estimate.change`), or for a rise or fall against leak-free recordings (`inference.comparison`).

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

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.estimate.change import Information, StepTest, step_tests
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.estimate.population import Population, ScatterPrior, number_sessions
from sealscope.diagnosis.healthy import Healthy, Summary, healthy_summaries
from sealscope.diagnosis.inference.comparison.rise import Rise, rise_of_mixture
from sealscope.diagnosis.inference.observable import Observable, Observed, Ringing
from sealscope.diagnosis.learnt import learn_once
from sealscope.diagnosis.priors.rms_change import RMS_PRIORS
from sealscope.diagnosis.rms_change.rms_blocks import (
    DUTY,
    JUDGED,
    RmsBlocks,
    column_names,
    cut_blocks,
    judged_chambers,
    measure_levels,
)
from sealscope.diagnosis.verdict.evidence import RMS_CHANGE
from sealscope.recordings.channels import chambers_of
from sealscope.recordings.hydraulics import describe_missing_chambers
from sealscope.recordings.joining import start_seconds
from sealscope.recordings.motion import is_constant
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import QUANTITIES, min_samples


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


class RmsChange:
    """Detector of changes of the wavelet details' RMS, within a recording or against leak-free recordings."""

    name = RMS_CHANGE

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

    def learn(self, recording: Recording) -> Summary:
        """Summarise a healthy recording by the log RMS of its wavelet details, for comparison with later recordings."""
        return learn_once(recording, (self.name, "summary"), self._summarise)

    @staticmethod
    def _summarise(recording: Recording) -> Summary:
        """Compute the summary of a healthy recording (`learn`)."""
        levels, duty = measure_levels(recording)
        return {
            "chambers": list(judged_chambers(recording)),  # those of `levels`
            "recorded": list(chambers_of(recording)),
            "rate": recording.rate,
            "start_s": start_seconds(recording),  # [s since 1970], None if unknown
            "levels": levels,
            "duty": duty,
        }

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
        if summary["recorded"] == recorded and has_same_rate(summary["rate"], recording.rate)
    ]
    summaries = [summary for summary in comparable if set(chambers) <= set(summary["chambers"])]
    if not summaries:
        kind = f"the same chambers at {recording.rate:g} Hz"
        clipped = f"{' or '.join(chambers)} is mostly clipped in every baseline recording with {kind}"
        return Observed(RmsChange.name, lack=clipped if comparable else f"no baseline recording has {kind}")
    judged = RmsChange().learn(recording)
    observables, bound = compare_summaries(judged, summaries, chambers)
    is_dated = None not in [summary.get("start_s") for summary in (judged, *summaries)]
    ringing = Ringing(bound, recording.rate, len(summaries), is_dated, recording.unused)
    return Observed(RmsChange.name, observables, ringing=ringing)


def has_same_rate(rate: float, other: float) -> bool:
    """Return True if two sampling rates [Hz] are equal within the error of a logger's clock (0.1 %)."""
    return abs(rate / other - 1.0) < 1e-3


def compare_summaries(
    judged: Summary, summaries: Sequence[Summary], chambers: Sequence[str]
) -> tuple[tuple[Observable, ...], float]:
    """Test the RMS of every chamber pressure's wavelet details for a rise or fall against leak-free recordings.

    `judged` and `summaries` are summaries (`RmsChange.learn`) of the judged and the leak-free recordings, and
    `chambers` the pressures to compare. Returns an observable for each detail and chamber, and the 95 % upper bound of
    an undetected change g of the ringing (log RMS without noise): the smallest of those by the judged details d2 to d4,
    which all contain the ringing.
    """
    starts = [*(summary.get("start_s") for summary in summaries), judged.get("start_s")]
    times = None if None in starts else np.array(starts, dtype=float)
    duties = np.array([summary["duty"] for summary in summaries], dtype=float)
    levels = np.array([_summary_levels(summary, chambers) for summary in summaries])
    judged_levels, judged_duty = _summary_levels(judged, chambers), np.asarray(judged["duty"], dtype=float)
    observables, bounds = list[Observable](), list[float]()
    # changes g of the ringing, and fractions of energy that is not noise
    rises, weights = estimate_rises(judged_levels, judged_duty, levels, duties, times)
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


def _summary_levels(summary: Summary, chambers: Sequence[str]) -> Array:
    """Select the log RMS of the wavelet details (5 per chamber,) of the given chambers from a recording's summary."""
    levels = np.asarray(summary["levels"], dtype=float).reshape(len(summary["chambers"]), -1)
    return np.concatenate([levels[summary["chambers"].index(chamber)] for chamber in chambers])
