"""Compare a recording with leak-free ones: with several, by the scatter between recordings; with one or two, by the
scatter of blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.diagnosis.baseline.operating_point import LEVEL_RATIO, OperatingPoint, operating_point
from sealscope.diagnosis.changepoint.scatter import StepScan, permutations_for
from sealscope.diagnosis.changepoint.tails import upper_quantile
from sealscope.diagnosis.rms_change.blocks import QUANTITIES, Blocks, cut, whole_log_rms
from sealscope.diagnosis.rms_change.results import JUDGED, excess, largest_changes, method_result
from sealscope.diagnosis.verdict.evidence import Evidence, Verdict
from sealscope.recordings.recording import Array, Recording

#: Fewest comparable baseline recordings from which the scatter between recordings is estimated ...
FEWEST_RECORDINGS = 3
#: ... and from which the dependence of the details on the pressure level is estimated too.
FEWEST_FOR_LEVEL = 6
#: Fewest blocks of each side where blocks are compared.
FEWEST_BLOCKS = 12
#: How far outside the baseline's range of levels a recording may lie, as a share of the range and at least, in log
#: units.
LEVEL_MARGIN = 0.25
#: Scatter of the log RMS between recordings below which they are copies of one another.
_LEAST_SCATTER = 1e-9


@dataclass(frozen=True)
class Prediction:
    """What leak-free recordings lead one to expect of another at the same operating point: `mean` and standard
    `deviation` (f,) of its log RMS, degrees of freedom, and the `fitted` values (n, f) of the leak-free ones
    themselves."""

    mean: Array
    deviation: Array
    freedom: int
    fitted: Array


def predict(log_rms: Array, levels: Array, level: float) -> Prediction:
    """Normal prediction for one more recording from n leak-free ones.

    `log_rms`: (n, f); `levels`: (n,) log pressure levels. From six recordings on, the log RMS is a line over the
    level (least squares), else a constant; the deviation includes the estimate's own error (Montgomery, Peck &
    Vining, Introduction to Linear Regression Analysis, sec. 2.5).
    """
    n = len(levels)
    with_level = n >= FEWEST_FOR_LEVEL and np.ptp(levels) > 0
    design = np.stack([np.ones(n), levels - levels.mean()], axis=1) if with_level else np.ones((n, 1))
    at = np.array([1.0, level - float(levels.mean())]) if with_level else np.ones(1)
    coefficients, *_ = np.linalg.lstsq(design, log_rms, rcond=None)
    freedom = n - design.shape[1]
    residual = log_rms - design @ coefficients
    variance = np.sum(residual**2, axis=0) / freedom
    leverage = float(at @ np.linalg.solve(design.T @ design, at))
    return Prediction(at @ coefficients, np.sqrt(variance * (1.0 + leverage)), freedom, design @ coefficients)


def student_threshold(probability: float, freedom: int) -> float:
    """|t| that Student's t with `freedom` degrees of freedom exceeds with `probability`, both tails together."""
    from scipy.special import stdtrit

    return float(-stdtrit(freedom, probability / 2.0))


def _outside(level: float, levels: Array) -> bool:
    if len(levels) < FEWEST_FOR_LEVEL:
        return bool(np.all(np.abs(levels - level) > np.log(LEVEL_RATIO)))
    margin = max(LEVEL_MARGIN * float(np.ptp(levels)), float(np.log(LEVEL_RATIO)))
    return not levels.min() - margin <= level <= levels.max() + margin


def against(recording: Recording, baseline: Sequence[Recording], probability: float) -> Evidence:
    """Evidence from the comparison with the leak-free recordings of the same operating point."""
    point = operating_point(recording)
    levels = np.array([operating_point(leak_free).level for leak_free in baseline])
    if _outside(point.level, levels):
        return Evidence(
            "cannot tell",
            f"the pressure level, {_level(point)}, lies outside that of the {len(baseline)} comparable baseline "
            f"recordings, "
            f"{np.exp(levels.min()):.4g} to {np.exp(levels.max()):.4g}",
        )
    if len(baseline) >= FEWEST_RECORDINGS:
        return _by_recordings(recording, baseline, point.level, levels, probability)
    return _by_blocks(recording, baseline, probability)


def _level(point: OperatingPoint) -> str:
    return f"{np.exp(point.level):.4g} {point.units[0]} rms"


def _by_recordings(
    recording: Recording, baseline: Sequence[Recording], level: float, levels: Array, probability: float
) -> Evidence:
    known, measured = np.stack([whole_log_rms(one) for one in baseline]), whole_log_rms(recording)
    expected = predict(known, levels, level)
    if not (np.all(np.isfinite(measured)) and np.all(expected.deviation > _LEAST_SCATTER)):
        return Evidence(
            "cannot tell",
            f"the {len(baseline)} comparable baseline recordings do not scatter, or a pressure does not move: "
            "nothing to judge a change by",
        )
    changes = measured - expected.mean
    t = changes / expected.deviation
    chambers = operating_point(recording).chambers
    names = [f"{quantity} of {chamber}" for chamber in chambers for quantity in QUANTITIES]
    judged = [k for k, name in enumerate(names) if name.split()[0] in JUDGED]
    own = student_threshold(probability, expected.freedom)
    threshold = student_threshold(probability / len(judged), expected.freedom)
    methods = tuple(
        method_result(name, abs(float(t[k])), own, f"{100 * np.expm1(changes[k]):+.1f} % against the baseline")
        for k, name in enumerate(names)
    )
    noise = [k for k, name in enumerate(names) if name.startswith("d1 ")]
    noisy = bool(np.any(np.abs(t[noise]) > own))
    if noisy:
        t = t.copy()
        t[judged] = _without_noise(known, measured, expected, judged)
    score = float(np.max(np.abs(t[judged])))
    told = largest_changes([names[k] for k in judged], t[judged], changes[judged], np.full(len(judged), threshold))
    verdict: Verdict = "leak" if score > threshold else "no leak"
    against_what = (
        f"against {len(baseline)} comparable leak-free recordings (largest |t| {score:.1f}, threshold {threshold:.1f})"
    )
    reason = f"{told} {against_what}" if verdict == "leak" else f"no change of the details' RMS {against_what}"
    if noisy:
        reason += "; the noise (d1) changed too, and was taken out of the other details"
    return Evidence(verdict, reason, score, threshold, parts=methods)


def _without_noise(known: Array, measured: Array, expected: Prediction, judged: list[int]) -> Array:
    """t of the judged quantities' energy beyond that of their chamber's d1, relative to what was expected of the
    quantity: white noise drops out."""
    noise = [k - k % len(QUANTITIES) for k in judged]
    before = np.exp(2 * (known[:, judged] - expected.fitted[:, judged])) - np.exp(
        2 * (known[:, noise] - expected.fitted[:, judged])
    )
    after = np.exp(2 * (measured[judged] - expected.mean[judged])) - np.exp(
        2 * (measured[noise] - expected.mean[judged])
    )
    # more noise means more scatter of the energy, too: in proportion to it
    added = np.exp(2 * (measured[noise] - expected.mean[judged])) - np.exp(
        2 * (expected.mean[noise] - expected.mean[judged])
    )
    own = (1.0 + np.maximum(added, 0.0)) ** 2
    scatter = np.sqrt(np.sum((before - before.mean(axis=0)) ** 2, axis=0) / expected.freedom * (own + 1.0 / len(known)))
    return np.asarray((after - before.mean(axis=0)) / scatter)


def _by_blocks(recording: Recording, baseline: Sequence[Recording], probability: float) -> Evidence:
    before: list[Blocks] = [cut(one) for one in baseline]
    after = cut(recording)
    x = np.concatenate([*(one.log_rms for one in before), after.log_rms])
    split = len(x) - len(after.log_rms)
    if min(split, len(after.log_rms)) < FEWEST_BLOCKS:
        return Evidence(
            "cannot tell",
            f"too little to compare: {split} blocks of baseline and {len(after.log_rms)} of the recording, "
            f"{FEWEST_BLOCKS} of each are needed "
            f"(or {FEWEST_RECORDINGS} comparable baseline recordings, got {len(baseline)})",
        )
    still = next((one.still for one in (after, *before) if one.still is not None), None)
    if still is not None:
        return Evidence("cannot tell", f"the pressures cannot be trusted: {still}")
    joint = after.columns(*JUDGED)
    scan, orders = StepScan(x, joint, least=1), permutations_for(probability)
    observed = scan.observed()
    single = observed.single[split - 1]
    t2_null, single_null, _ = scan.null(orders, after=split)
    score, threshold = float(observed.joint[split - 1]), float(upper_quantile(t2_null, probability))
    thresholds = upper_quantile(single_null, probability)
    changes = x[split:].mean(axis=0) - x[:split].mean(axis=0)
    noisy = any(abs(single[k]) > thresholds[k] for k in after.columns("d1"))
    if noisy:
        beyond = excess(x, split)
        scan = StepScan(beyond, list(range(beyond.shape[1])), least=1)
        score = float(scan.observed().joint[split - 1])
        threshold = float(upper_quantile(scan.null(orders, 1, after=split)[0], probability))
    methods = tuple(
        method_result(
            name,
            abs(float(single[k])),
            float(thresholds[k]),
            f"{100 * np.expm1(changes[k]):+.1f} % against the baseline",
        )
        for k, name in enumerate(after.names)
    )
    verdict: Verdict = "leak" if score > threshold else "no leak"
    told = (
        largest_changes(after.names, single, changes, thresholds)
        if verdict == "leak"
        else "no change of the details' RMS"
    )
    count = f"{len(baseline)} comparable leak-free recording{'s' if len(baseline) > 1 else ''}"
    reason = (
        f"{told} against {count} (T2 {score:.1f}, threshold {threshold:.1f}, from the scatter within recordings alone: "
        f"give {FEWEST_RECORDINGS} or more to have the drift between recordings in it)"
    )
    if noisy:
        reason += "; the noise (d1) changed too, and was taken out of the other details"
    return Evidence(verdict, reason, score, threshold, parts=methods)
