"""Friction, drifts and spectra of the pressures over a whole recording, compared with healthy recordings.

- The friction is half the change of p_A - p_B from one direction of motion to the other. Its logarithm is compared,
  since friction of seals and guides changes in proportion.
- A drift of one pressure only is a drift of that sensor's offset; the charge pressure changes both pressures alike. The
  drifts are fitted over the samples in which the piston moves (`motion_fit`), and a second time over the low values of
  each pressure, which also show a loss of oil (`charge_pressure`).
- A filter of one sensor changes the ratio and the phase of the spectra of both pressures (`pressure_bands`).

A number is tested against its scatter between healthy recordings (`differences`). Called for recordings with both
chamber pressures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.healthy import Healthy, Summary, healthy_summaries
from sealscope.diagnosis.inference.changes.charge_pressure import (
    DRIFT,
    LowDrifts,
    compare_low_drifts,
    estimate_low_drifts,
)
from sealscope.diagnosis.inference.changes.motion_fit import TIME, fit_difference, fit_robustly, select_motion
from sealscope.diagnosis.inference.changes.pressure_bands import PAIRS, Octaves, compare_spectra, compute_octaves
from sealscope.diagnosis.inference.changes.signals import SIGNALS
from sealscope.diagnosis.inference.differences import (
    Estimate,
    PriorScatter,
    compare_estimates,
    compare_with_healthy,
)
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Recording, compute_once

#: Smallest number that is divided by.
TINY = 1e-300
#: Names of the observables: of friction, and of drifts, which are rival descriptions of the same data.
FRICTION, DRIFTS = "friction", ("drift of p_A", "drift of p_B", "drift of both")


class HealthyLevels:
    """Comparison of a recording's friction, drifts and spectra with those of healthy recordings."""

    name = SIGNALS

    def learn(self, recording: Recording) -> Summary | None:
        """Summarise a recording by friction, drifts and spectra, for comparison with other recordings.

        The summary maps names to numbers, such as "friction_pressure" [Pa], and each name in `PAIRS` (a pair of
        channels) to spectra: an array (4, k) with the fields of `Octaves` in k octaves. Entries that the recorded
        channels do not allow, or for which the piston moves too little, are missing. Return None if nothing can be
        estimated. The summary is computed only once for a recording.
        """
        return compute_once(recording, ("healthy levels",), _estimate_levels)

    def compare(self, recording: Recording, baseline: Sequence[Healthy]) -> Iterator[Observable]:
        """Compare friction, drifts and spectra of a recording with those of healthy ones; yield one test for each.

        Quantities that the recording, or too many of the healthy recordings in `baseline`, do not have are left out.
        """
        judged = self.learn(recording)
        if judged is None:
            return
        healthy = healthy_summaries(self, baseline)
        if (low_drifts := _low_drifts(judged)) is not None:
            healthy_drifts = [drifts for summary in healthy if (drifts := _low_drifts(summary)) is not None]
            yield from compare_low_drifts(low_drifts, healthy_drifts)
        if (spectra := compare_spectra(_octaves(judged), [_octaves(summary) for summary in healthy])) is not None:
            yield spectra
        if "drift_A" not in judged:  # friction and drifts in motion are known together or not at all
            return
        healthy = [summary for summary in healthy if "drift_A" in summary]
        if (friction := _compare_friction(judged, healthy)) is not None:
            yield friction
        drift_A, drift_B = (
            np.array([float(summary[name]) for summary in (*healthy, judged)]) for name in ("drift_A", "drift_B")
        )
        tests = [
            compare_with_healthy(name, DRIFT, float(drift[-1]), drift[:-1].tolist(), CHANGES.healthy.drift)
            for name, drift in zip(DRIFTS, (drift_A, drift_B, drift_A - drift_B), strict=True)
        ]
        if None not in tests:
            yield from _describe_drifts(*tests)  # type: ignore[arg-type]


def _octaves(summary: Summary) -> dict[str, Octaves]:
    """Read the spectra of all pairs of channels in a recording's summary, by the names of the pairs in `PAIRS`."""
    return {name: Octaves(*np.asarray(summary[name], dtype=float)) for name in PAIRS if name in summary}


def _low_drifts(summary: Summary) -> LowDrifts | None:
    """Read the drifts of the low pressures from a recording's summary; None if the summary contains no such drift."""
    if not set(LowDrifts._fields) & set(summary):
        return None
    return LowDrifts(*(float(summary.get(name, np.nan)) for name in LowDrifts._fields))


def _compare_friction(judged: Summary, healthy: Sequence[Summary]) -> Observable | None:
    """Test whether the friction of a recording, as a pressure difference, is higher than in healthy recordings.

    Logarithms are compared. The sign of the friction depends on the sign of the motion's channel, so it is taken from
    the sum over the healthy recordings of friction / standard error. A friction that does not exceed its standard error
    with this sign is not used. Return None if the recording, or too many of the healthy recordings, have no usable
    value.
    """
    prior = CHANGES.healthy
    pressures = [
        (float(summary["friction_pressure"]), float(summary["friction_error"]))
        for summary in healthy
        if {"friction_pressure", "friction_error"} <= set(summary)
    ]
    sign = np.sign(sum(pressure / max(error, TINY) for pressure, error in pressures))

    def log_friction(pressure: float, error: float) -> Estimate:
        """Compute the logarithm of a positive friction `pressure` [Pa], with the standard error of the logarithm."""
        return Estimate(float(np.log(pressure)), float(np.hypot(prior.friction_error, error / pressure)))

    usable = [log_friction(sign * pressure, error) for pressure, error in pressures if sign * pressure > error]
    pressure, error = sign * float(judged["friction_pressure"]), float(judged["friction_error"])
    if not pressure > error:
        return None
    scatter = PriorScatter(prior.friction_scatter, prior.recordings)
    return compare_estimates(FRICTION, FRICTION, log_friction(pressure, error), usable, scatter, above=True)


def _describe_drifts(drift_A: Observable, drift_B: Observable, difference_AB: Observable) -> Iterator[Observable]:
    """Yield three alternative explanations of drifting pressures: p_A drifts, p_B drifts, or both drift alike.

    `drift_A`, `drift_B`, `difference_AB`: tests of the drifts of p_A, p_B and p_A - p_B. The `chance` of a test is its
    p-value. A common drift does not explain a drift of the difference, so the third explanation gets

        chance = min(1, chance_A chance_B / chance_difference),    score = max(0, score_A + score_B - score_difference).
    """
    yield drift_A
    yield drift_B
    chance = drift_A.chance * drift_B.chance / max(difference_AB.chance, TINY)
    score = max(drift_A.score + drift_B.score - difference_AB.score, 0.0)
    yield replace(difference_AB, chance=min(chance, 1.0), score=score)  # named DRIFTS[2], "drift of both"


@np.errstate(all="ignore")
def _estimate_levels(recording: Recording) -> Summary | None:
    """Estimate friction, drifts and spectra in a recording, as numbers or arrays by their names.

    Values that the recording does not allow are left out. Friction and drifts in motion are all left out if one of them
    is not finite. The result is None if no value is left.
    """
    motion, fit = select_motion(recording), fit_difference(recording)
    levels = dict[str, float]()
    if motion is not None and fit is not None:
        drift_A, drift_B = (
            float(fit_robustly(motion.design, recording[name][motion.rows])[0][TIME]) for name in CHAMBERS
        )
        levels |= {
            "friction_pressure": fit.friction,
            "friction_error": fit.friction_error,
            "drift_A": drift_A,
            "drift_B": drift_B,
        }
    if not np.isfinite(list(levels.values())).all():
        levels = {}
    if (low_drifts := estimate_low_drifts(recording)) is not None:
        levels |= {name: value for name, value in low_drifts._asdict().items() if np.isfinite(value)}
    spectra = {
        name: np.stack(octaves)
        for name, pair in PAIRS.items()
        if (octaves := compute_octaves(recording, pair)) is not None
    }
    return {**levels, **spectra} or None
