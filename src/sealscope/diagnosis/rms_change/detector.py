"""The thesis's method as a detector with a false-alarm probability: has the RMS of the db8 details of the chamber
pressures changed?

The thesis compares the RMS of d1..d4 and of d3*d4 before and after (its ch. 5 and Appendix C) and calls a leak where
it went down (p_A) or up (p_B). Here each of these changes is a method of its own with a threshold from the leak-free
scatter, and all chambers and levels d2..d4 together make the verdict. d1 is noise alone: where it changes too, the
sensors' noise is taken out of the other levels first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sealscope.diagnosis.changepoint.scatter import HealthyDrift, Scan, StepScan, permutations_for
from sealscope.diagnosis.changepoint.tails import near_best, upper_quantile
from sealscope.diagnosis.rms_change.against_baseline import against
from sealscope.diagnosis.rms_change.blocks import Blocks, cut
from sealscope.diagnosis.rms_change.drift import drift_beyond_noise, drift_of, settled
from sealscope.diagnosis.rms_change.results import JUDGED, describe_change, excess, largest_changes, method_result
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.motion import constant
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import shortest

#: Fewest blocks in which a change can be looked for: the covariance of six columns needs them.
FEWEST_BLOCKS = 24


class RmsChange:
    """Change of the details' RMS, within a recording or against leak-free ones."""

    name = "rms change"
    reads = ("u", "p_A", "p_B")

    def usable(self, recording: Recording) -> str | None:
        chambers = chambers_of(recording)
        if not chambers:
            return "needs the pressure of a chamber (p_A or p_B)"
        if len(recording) < shortest():
            return f"needs {shortest()} samples or more without a gap, got {len(recording)}"
        for chamber in chambers:
            if constant(recording[chamber]):
                return f"{chamber} is constant"
        return None

    def examine(self, recording: Recording, baseline: Sequence[Recording], false_alarm_probability: float) -> Evidence:
        if baseline:
            return against(recording, baseline, false_alarm_probability)
        return self._within(recording, false_alarm_probability)

    def _within(self, recording: Recording, probability: float) -> Evidence:
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
        return self._judged(settled(blocks), probability)

    def _judged(self, blocks: Blocks, probability: float) -> Evidence:
        x = blocks.log_rms
        drift, d1 = drift_of(blocks), blocks.columns("d1")
        scan = StepScan(x, blocks.columns(*JUDGED), drift)
        found = scan.observed()
        null, single_null, trend_null = scan.null(permutations_for(probability))
        threshold, most_even = (float(upper_quantile(one, probability)) for one in (null, trend_null))
        thresholds = upper_quantile(single_null, probability)
        methods = self._methods(blocks, found.single, thresholds)

        step = int(np.argmax(found.joint))
        changes = x[step + 1 :].mean(axis=0) - x[: step + 1].mean(axis=0)
        told = largest_changes(blocks.names, found.single[step], changes, thresholds)
        noise = StepScan(x[:, d1], list(range(len(d1))), HealthyDrift(drift.walks[d1], np.zeros((len(d1), 0))))
        noisy = noise.observed()
        even = found
        if float(noisy.joint.max()) > float(upper_quantile(noise.null(permutations_for(probability))[0], probability)):
            found, threshold = self._without_noise(blocks, int(np.argmax(noisy.joint)) + 1, probability)
            step = int(np.argmax(found.joint))
            even = noisy if noisy.trend > noisy.joint.max() else found
            told += ", beyond a change of the noise"
            if even is found and found.joint[step] <= threshold:
                reason = (
                    "the noise (d1) changed, and the other details by no more than it: a sensor or its "
                    "wiring changed, or the leak is hidden"
                )
                return Evidence("cannot tell", reason, float(found.joint[step]), threshold, parts=methods)
        score = float(found.joint[step])
        if not even.step_wins() and (score > threshold or even.trend > most_even or even is noisy):
            what = "the noise (d1) changed" if even is noisy else told
            reason = (
                f"{what}, evenly over the recording (trend T2 {even.trend:.1f}, step {even.joint.max():.1f}): a drift "
                "and a growing leak look alike"
            )
            return Evidence("cannot tell", reason, score, threshold, parts=methods)
        if score <= threshold:
            reason = (
                f"no change of the details' RMS within the recording beyond its scatter and a sound machine's drift "
                f"(T2 {score:.1f}, threshold {threshold:.1f}); "
                "a leak that was there from the start would need a --baseline to be seen"
            )
            return Evidence("no leak", reason, score, threshold, parts=methods)
        near = blocks.edges[near_best(found.joint) + 1]
        onset, interval = float(blocks.edges[step + 1]), (float(near[0]), float(near[-1]))
        reason = f"{told} at {onset:.1f} s (T2 {score:.1f}, threshold {threshold:.1f})"
        return Evidence("leak", reason, score, threshold, onset, interval, parts=methods)

    @staticmethod
    def _without_noise(blocks: Blocks, split: int, probability: float) -> tuple[Scan, float]:
        beyond = excess(blocks.log_rms, split)
        scan = StepScan(beyond, list(range(beyond.shape[1])), drift_beyond_noise(blocks))
        null, _, _ = scan.null(permutations_for(probability), seed=1)
        return scan.observed(), float(upper_quantile(null, probability))

    @staticmethod
    def _methods(blocks: Blocks, single: Array, thresholds: Array) -> tuple[Evidence, ...]:
        results = []
        for k, name in enumerate(blocks.names):
            step = int(np.argmax(np.abs(single[:, k])))
            score = abs(float(single[step, k]))
            change = float(blocks.log_rms[step + 1 :, k].mean() - blocks.log_rms[: step + 1, k].mean())
            reason = f"{describe_change(name, change)} at {blocks.edges[step + 1]:.1f} s"
            results.append(method_result(name, score, float(thresholds[k]), reason))
        return tuple(results)
