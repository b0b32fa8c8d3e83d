"""The thesis's method as a detector with a false-alarm probability: a change of the RMS of the db8 details.

The thesis compares the RMS of d1..d4 and of d3*d4 before and after (its ch. 5 and Appendix C) and calls a leak where
it went down (p_A) or up (p_B). Here each of these changes is a part of the evidence with a threshold from the leak-free
scatter, and all chambers and levels d2..d4 together make the verdict. d1 is noise alone: where it changes too, the
sensors' noise is taken out of the other levels first.

Within a recording the change is a step at any instant. Against leak-free recordings it is a change of the level: of
single strokes, and from three recordings of a repeated duty on, by the scatter between recordings (`by_recordings`),
with one or two recordings of a repeated duty by the scatter of blocks. The details follow the duty: where strokes
change within the recording, before and after cannot be compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.baseline.duty import StrokeChange, duty_changes
from sealscope.diagnosis.baseline.operating_point import operating_point
from sealscope.diagnosis.changepoint.scatter import HealthyDrift, Scan, StepScan
from sealscope.diagnosis.changepoint.tails import near_best
from sealscope.diagnosis.rms_change.blocks import JUDGED, RmsBlocks, cut, excess
from sealscope.diagnosis.rms_change.by_recordings import (
    WITHOUT_NOISE,
    LeakFree,
    by_recordings,
    change_text,
    largest_changes,
    outside_levels,
    part,
    parts_against,
)
from sealscope.diagnosis.rms_change.drift import drift_beyond_noise, drift_of
from sealscope.diagnosis.verdict.evidence import Evidence, Verdict
from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.hydraulics import lack_of_chambers
from sealscope.recordings.motion import constant
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import shortest

#: Fewest blocks in which a change can be looked for (the covariance of six columns needs them), and fewest of each side
#: where blocks of several recordings are compared.
FEWEST_BLOCKS, FEWEST_BLOCKS_A_SIDE = 24, 12
#: Lowest rate [Hz]: the ringing of a hydraulic line of some metres lies over 4 Hz.
SLOWEST_RATE = 8.0
#: Lowest rate [Hz] at which the ringing of the piston on its oil, 70 Hz on the packaged rigs, reaches into the judged
#: details: d2 ends at a quarter of the rate, and d1 is noise. Below, leaks of up to 0.5 L/min changed nothing in them.
RINGING_RATE = 250.0
#: Fewest baseline recordings of a repeated duty from which the scatter between recordings is estimated.
FEWEST_RECORDINGS = 3


class RmsChange:
    """Change of the details' RMS, within a recording or against leak-free ones."""

    name = "rms change"
    reads = ("u", "omega", "theta", "x", "p_A", "p_B")

    def __init__(self, rig: object = None) -> None:
        """Nothing is assumed of the machine."""

    def usable(self, recording: Recording) -> str | None:
        """Return None when the recording has a chamber pressure that moves, else the reason why not."""
        if lack := lack_of_chambers(recording):
            return lack
        if len(recording) < shortest():
            return f"needs {shortest()} samples or more without a gap, got {len(recording)}"
        for chamber in chambers_of(recording):
            if constant(recording[chamber]):
                return f"{chamber} is constant"
        return None

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        """Return the evidence on a recording that is `usable`, within it or against the baseline."""
        if recording.rate < SLOWEST_RATE:
            return Evidence(
                "cannot tell",
                f"needs {SLOWEST_RATE:g} Hz or more to see the ringing that a leak damps, got {recording.rate:g} Hz",
            )
        if baseline:
            return against(recording, baseline, false_alarm_probability)
        blocks = cut(recording)
        n = len(blocks.log_rms)
        if n < FEWEST_BLOCKS:
            return Evidence(
                "cannot tell",
                f"too short to be its own baseline: {n} blocks, {FEWEST_BLOCKS} are needed; give leak-free "
                f"recordings as --baseline",
            )
        if blocks.still is not None:
            return Evidence("cannot tell", f"the pressures cannot be trusted: {blocks.still}")
        evidence = _of_one_duty(within(blocks.settled(), false_alarm_probability), duty_changes(recording))
        return replace(_where_it_rings(evidence, recording.rate), share=blocks.share)


def _where_it_rings(evidence: Evidence, rate: float) -> Evidence:
    """Return `no leak` of a recording too slow to show the ringing that a leak damps as `cannot tell`."""
    if evidence.verdict != "no leak" or rate >= RINGING_RATE:
        return evidence
    return replace(
        evidence,
        verdict="cannot tell",
        reason=(
            f"at {rate:g} Hz the details end at {rate / 4:g} Hz and do not show the ringing that a leak damps "
            f"({RINGING_RATE:g} Hz or more would): a leak of any size may change nothing in them; {evidence.reason}"
        ),
    )


def _of_one_duty(evidence: Evidence, changes: Sequence[StrokeChange]) -> Evidence:
    """Return the evidence within a recording as `cannot tell` where the duty changed."""
    if not changes:
        return evidence
    certain = any(change.certain for change in changes)
    more = f" (and {len(changes) - 1} more changes)" if len(changes) > 1 else ""
    other = "" if certain else ", by another duty or by a leak that takes as much"
    return replace(
        evidence,
        verdict="cannot tell",
        reason=f"{changes[0].text}{more}{other}: before and after cannot be compared; {evidence.reason}",
        onset_s=None,
        onset_interval_s=None,
        cause="changed duty" if certain else None,
    )


def within(blocks: RmsBlocks, probability: float) -> Evidence:
    """Return the evidence of a step within the blocks of one recording."""
    x = blocks.log_rms
    drift, d1 = drift_of(blocks), blocks.columns("d1")
    scan, result, (threshold, thresholds, most_even) = _scanned(
        StepScan(x, blocks.columns(*JUDGED), drift), probability
    )
    parts = []
    for k, name in enumerate(blocks.names):
        step = int(np.argmax(np.abs(result.single[:, k])))
        change = float(x[step + 1 :, k].mean() - x[: step + 1, k].mean())
        reason = f"{change_text(name, change)} at {blocks.edges[step + 1]:.1f} s"
        parts.append(part(name, float(result.single[step, k]), thresholds[k], reason))

    step = int(np.argmax(result.joint))
    changes = x[step + 1 :].mean(axis=0) - x[: step + 1].mean(axis=0)
    changed = largest_changes(blocks.names, result.single[step], changes, thresholds)
    noise_scan = StepScan(x[:, d1], list(range(len(d1))), HealthyDrift(drift.walks[d1], np.zeros((len(d1), 0))))
    noise = noise_scan.observed()
    even = result
    noisy = noise_scan.alarms(probability)
    if noisy:
        beyond = excess(x, int(np.argmax(noise.joint)) + 1)
        over_noise = StepScan(beyond, list(range(beyond.shape[1])), drift_beyond_noise(blocks))
        scan, result, (threshold, *_) = _scanned(over_noise, probability)
        step = int(np.argmax(result.joint))
        even = noise if noise.trend > noise.joint.max() else result
        changed += ", beyond a change of the noise"
    score = float(result.joint[step])
    chance = scan.chance(score)
    onset, interval = None, None
    verdict: Verdict = "cannot tell"
    if noisy and even is result and score <= threshold:
        reason = (
            "the noise (d1) changed, and the other details by no more than it: a sensor or its wiring changed, or the "
            "leak is hidden"
        )
    elif not even.step_wins() and (score > threshold or even.trend > most_even or even is noise):
        what = "the noise (d1) changed" if even is noise else changed
        reason = (
            f"{what}, evenly over the recording (trend T2 {even.trend:.1f}, step {even.joint.max():.1f}): a drift "
            "and a growing leak look alike"
        )
    elif score <= threshold and scan.wander > 1.0:
        reason = (
            f"the details' RMS wander {scan.wander:g} times as much as those of a healthy machine (T2 {score:.1f}, "
            f"threshold {threshold:.1f}): a leak would be hidden among their changes"
        )
    elif score <= threshold:
        verdict = "no leak"
        reason = (
            f"no change of the details' RMS within the recording beyond its scatter and a healthy machine's drift (T2 "
            f"{score:.1f}, threshold {threshold:.1f}); a leak that was there from the start would need a --baseline to "
            "be seen"
        )
    else:
        verdict = "leak"
        near = blocks.edges[near_best(result.joint) + 1]
        onset, interval = float(blocks.edges[step + 1]), (float(near[0]), float(near[-1]))
        reason = f"{changed} at {onset:.1f} s (T2 {score:.1f}, threshold {threshold:.1f})"
    return Evidence(verdict, reason, score, threshold, onset, interval, parts=tuple(parts), chance=chance)


def _scanned(scan: StepScan, probability: float) -> tuple[StepScan, Scan, tuple[float, Array, float]]:
    """Return a scan with its statistics and thresholds.

    Where it would alarm, by the drift that makes the record likeliest: under a load, where friction is larger, the
    ringing follows a drift of the friction more than in proportion.
    """
    result, limits = scan.observed(), scan.thresholds(probability)
    if float(result.joint.max()) > limits[0] and (other := scan.likeliest()).wander > scan.wander:
        return other, other.observed(), other.thresholds(probability)
    return scan, result, limits


def against(recording: Recording, baseline: Sequence[Recording], probability: float) -> Evidence:
    """Return the evidence from the comparison with leak-free recordings of the same operating point."""
    point = operating_point(recording)
    if len(baseline) >= FEWEST_RECORDINGS or point.direction != 0:
        return by_recordings(recording, LeakFree.of(baseline), probability)
    levels = np.array([operating_point(other).level for other in baseline])
    if (refusal := outside_levels(point, levels)) is not None:
        return Evidence("cannot tell", refusal)
    return _by_blocks(recording, baseline, probability)


def _by_blocks(recording: Recording, baseline: Sequence[Recording], probability: float) -> Evidence:
    before = [cut(other) for other in baseline]
    after = cut(recording)
    x = np.concatenate([*(blocks.log_rms for blocks in before), after.log_rms])
    split = len(x) - len(after.log_rms)
    if min(split, len(after.log_rms)) < FEWEST_BLOCKS_A_SIDE:
        return Evidence(
            "cannot tell",
            f"too little to compare: {split} blocks of baseline and {len(after.log_rms)} of the recording, "
            f"{FEWEST_BLOCKS_A_SIDE} of each are needed "
            f"(or {FEWEST_RECORDINGS} comparable baseline recordings, got {len(baseline)})",
        )
    still = next((blocks.still for blocks in (after, *before) if blocks.still is not None), None)
    if still is not None:
        return Evidence("cannot tell", f"the pressures cannot be trusted: {still}")
    scan = StepScan(x, after.columns(*JUDGED), least=1)
    result = scan.observed()
    score, single = float(result.joint[split - 1]), result.single[split - 1]
    threshold, thresholds, _ = scan.thresholds(probability, after=split)
    changes = x[split:].mean(axis=0) - x[:split].mean(axis=0)
    noisy = any(abs(single[k]) > thresholds[k] for k in after.columns("d1"))
    if noisy:
        beyond = excess(x, split)
        scan = StepScan(beyond, list(range(beyond.shape[1])), least=1)
        score = float(scan.observed().joint[split - 1])
        threshold = scan.thresholds(probability, after=split)[0]
    changed = "no change of the details' RMS"
    if score > threshold:
        changed = largest_changes(after.names, single, changes, thresholds)
    reason = (
        f"{changed} against {len(baseline)} comparable leak-free recording{'s' if len(baseline) > 1 else ''} (T2 "
        f"{score:.1f}, threshold {threshold:.1f}, from the scatter within recordings alone: give {FEWEST_RECORDINGS} "
        f"or more to have the drift between recordings in it){WITHOUT_NOISE if noisy else ''}"
    )
    parts = parts_against(after.names, single, thresholds, changes)
    verdict: Verdict = "leak" if score > threshold else "no leak"
    return Evidence(verdict, reason, score, threshold, parts=parts, share=after.share, chance=scan.chance(score))
