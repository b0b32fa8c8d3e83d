"""Friction, drifts and spectra of the pressures over a whole recording, compared with healthy recordings.

- The friction is half the change of p_A - p_B from one direction of motion to the other. Its logarithm is compared,
  since friction of seals and guides changes in proportion.
- A drift of one pressure only is a drift of that sensor's offset; the charge pressure changes both pressures alike. The
  drifts are fitted over the samples in which the piston moves (`motion_fit`), and a second time over the low values of
  each pressure, which also show a loss of oil (`charge_pressure`). From day to day the zeros of both sensors are
  compared while a valve connects the chambers (`estimate_connected_difference`): the pump rests, the actuator is moved
  to and fro from outside, and the drop of pressure in the valve changes its sign with the motion.
- A filter of one sensor changes the ratio and the phase of the spectra of both pressures (`pressure_bands`).

A number is tested against its scatter between healthy recordings (`observable.compare_estimates`). Called for
recordings with both chamber pressures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.population import ScatterPrior
from sealscope.diagnosis.healthy import Healthy, Summary, healthy_summaries
from sealscope.diagnosis.inference.changes.charge_pressure import (
    DRIFT,
    PUMP,
    compare_low_drifts,
    estimate_low_drifts,
    subtract_drifts,
    turned_angle,
)
from sealscope.diagnosis.inference.changes.features import SIGNALS
from sealscope.diagnosis.inference.changes.motion_fit import (
    TIME,
    fit_difference,
    fit_robustly,
    select_motion,
)
from sealscope.diagnosis.inference.changes.pressure_bands import PAIRS, Octaves, compare_spectra, compute_all_octaves
from sealscope.diagnosis.inference.equations.signals import Signals
from sealscope.diagnosis.inference.machine_states import MIN_REST, flag_lowering, number_strokes, rest_limit
from sealscope.diagnosis.inference.observable import Observable, compare_estimates
from sealscope.diagnosis.learnt import learn_once
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.channels import CHAMBERS, flow_source
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.smoothing import TINY

#: Names of the observables: of friction, and of drifts, which are rival descriptions of the same data.
FRICTION, DRIFTS = "friction", ("drift of p_A", "drift of p_B", "drift of both")
#: Kinds of drifts of p_A and p_B in a recording's summary: in motion, and of the lowest readings.
MOTION, LOW = "drift", "low"
#: Keys of the drifts, and of their standard errors.
DRIFT_KEYS = tuple(f"{kind}_{side}{suffix}" for kind in (MOTION, LOW) for side in "AB" for suffix in ("", "_error"))
#: Name of the observable of the zeros of both sensors, and keys of p_A - p_B of connected chambers and of its error.
ZEROS, ZERO_KEYS = "drift of p_A - p_B", ("connected_difference", "connected_difference_error")
#: Quantile, over healthy recordings, of the size of a friction of the wrong sign over its error (`_compare_friction`).
UPPER_QUARTILE = 0.75
#: Keys of the friction and of its standard error in a recording's summary.
FRICTION_KEYS = ("friction_pressure", "friction_error")


class HealthyLevels:
    """Comparison of a recording's friction, drifts and spectra with those of healthy recordings."""

    name = SIGNALS

    def learn(self, recording: Recording) -> Summary | None:
        """Summarise a recording by friction, drifts and spectra; None if nothing can be estimated.

        The summary maps names to numbers, such as "friction_pressure" [Pa], and each name in `PAIRS` (a pair of
        channels) to an array (4, k) with the fields of `Octaves` in k octaves. Unknown entries are missing.
        """
        return learn_once(recording, ("healthy levels",), _estimate_levels)

    def compare(self, recording: Recording, baseline: Sequence[Healthy]) -> Iterator[Observable]:
        """Compare friction, spectra and drifts of the pressures with those of the healthy recordings in `baseline`.

        There are two kinds of drift, of the mean pressures during motion and of the lowest readings. A quantity that is
        missing in the recording or in too many healthy ones has no test.
        """
        judged = self.learn(recording)
        if judged is None:
            return
        healthy = healthy_summaries(self, baseline)
        yield from compare_low_drifts(_read_drifts(judged, LOW), [_read_drifts(summary, LOW) for summary in healthy])
        healthy_spectra = [_read_octaves(summary) for summary in healthy]
        if (spectra := compare_spectra(_read_octaves(judged), healthy_spectra)) is not None:
            yield spectra
        if (friction := _compare_friction(judged, healthy)) is not None:
            yield friction
        yield from _compare_drifts(judged, healthy, recording.duration)
        if (zeros := _compare_zeros(judged, healthy)) is not None:
            yield zeros


def _read_octaves(summary: Summary) -> dict[str, Octaves]:
    """Read the spectra of all pairs of channels in a recording's summary, by the names of the pairs in `PAIRS`."""
    return {name: Octaves(*np.asarray(summary[name], dtype=float)) for name in PAIRS if name in summary}


def _read_drifts(summary: Summary, kind: str) -> dict[str, Estimate]:
    """Read the known drifts of p_A and p_B, by "A" and "B", from a recording's summary; `kind`: `MOTION` or `LOW`."""
    keys = {side: (f"{kind}_{side}", f"{kind}_{side}_error") for side in "AB"}
    return {
        side: Estimate(float(summary[key]), float(summary[error_key]))
        for side, (key, error_key) in keys.items()
        if {key, error_key} <= set(summary)
    }


def _compare_friction(judged: Summary, healthy: Sequence[Summary]) -> Observable | None:
    """Test whether the friction of a recording, as a pressure difference, is higher than in healthy recordings.

    The logarithms of the friction are compared. Return None if the judged friction is not usable, or fewer than
    `MIN_HEALTHY` healthy ones.

    - The sign that stands for friction against the motion depends on which channel measured the motion. It is the sign
      of the sum of friction / error over the healthy recordings.
    - A healthy friction of the other sign is an error. All errors are therefore multiplied by max(1, q), where q is the
      upper quartile of abs(friction) / error over the healthy recordings, counted as 0 where the sign is right.
    - The standard error of a logarithm is error / friction and `healthy.friction_error` (`priors.toml`), added in
      quadrature.
    - A friction is usable if it has the right sign and exceeds its error.
    """
    key, error_key = FRICTION_KEYS
    prior = CHANGES.healthy
    known = [summary for summary in healthy if set(FRICTION_KEYS) <= set(summary)]
    if not known or not set(FRICTION_KEYS) <= set(judged):
        return None
    ratios = np.array([float(summary[key]) / max(float(summary[error_key]), TINY) for summary in known])
    sign = float(np.sign(ratios.sum()))
    inflation = max(1.0, float(np.quantile(np.maximum(-sign * ratios, 0.0), UPPER_QUARTILE)))

    def log_friction(summary: Summary) -> Estimate | None:
        """Return the logarithm of a recording's friction, or None if it is not usable."""
        pressure, error = sign * float(summary[key]), inflation * float(summary[error_key])
        if not pressure > error:
            return None
        return Estimate(float(np.log(pressure)), float(np.hypot(prior.friction_error, error / pressure)))

    healthy_logs = [friction for summary in known if (friction := log_friction(summary)) is not None]
    judged_log = log_friction(judged)
    if judged_log is None:
        return None
    scatter = ScatterPrior(deviation=prior.friction_scatter, recordings=prior.recordings)
    return compare_estimates(FRICTION, FRICTION, judged_log, healthy_logs, scatter, above=True)


def _compare_drifts(judged: Summary, healthy: Sequence[Summary], duration: float) -> Iterator[Observable]:
    """Compare the drifts of p_A and p_B during motion [Pa over the recording] with those of healthy recordings.

    `duration` [s]: that of the judged recording. Yields a test for each of three alternative explanations: p_A drifts,
    p_B drifts, or both drift alike. Yields nothing unless the judged recording and enough healthy ones have both
    drifts. If both drift alike, p_A - p_B does not drift, and p-value and score of this explanation are

        chance = min(1, chance_A chance_B / chance_difference),    score = max(0, score_A + score_B - score_difference).

    A score is the square of a z score. With equal errors of both drifts, z_A^2 + z_B^2 = z_mean^2 + z_difference^2, so
    that what remains is the score of their mean; a p-value is about exp(-z^2 / 2).
    """
    judged_drifts = _read_drifts(judged, MOTION)
    if len(judged_drifts) < 2:
        return
    healthy_drifts = [drifts for summary in healthy if len(drifts := _read_drifts(summary, MOTION)) > 1]
    prior = CHANGES.healthy
    scatter = ScatterPrior(prior.drift, recordings=prior.drift_recordings, inflation=prior.drift_inflation)
    drift_A, drift_B = (
        compare_estimates(name, DRIFT, judged_drifts[side], [drifts[side] for drifts in healthy_drifts], scatter)
        for side, name in zip("AB", DRIFTS[:2], strict=True)
    )
    differences = [subtract_drifts(drifts) for drifts in healthy_drifts]
    # named "drift of both", since it becomes that test at the end; its size, which is not used, stays that of p_A - p_B
    difference = compare_estimates(DRIFTS[2], DRIFT, subtract_drifts(judged_drifts), differences, scatter)
    if drift_A is None or drift_B is None or difference is None:
        return
    for drift in (drift_A, drift_B):  # a drift that is fast for the zero of a sensor is rather one of the load
        yield replace(drift, advantage=-CHANGES.zero_drift.penalty(drift.size / duration, above=True))
    chance = drift_A.chance * drift_B.chance / max(difference.chance, TINY)
    score = max(drift_A.score + drift_B.score - difference.score, 0.0)
    yield replace(difference, chance=min(chance, 1.0), score=score)


def _compare_zeros(judged: Summary, healthy: Sequence[Summary]) -> Observable | None:
    """Compare p_A - p_B of connected chambers with that of healthy recordings; None if it is missing in too many."""
    if not set(ZERO_KEYS) <= set(judged):
        return None
    judged_zero, *healthy_zeros = (
        Estimate(*(float(summary[key]) for key in ZERO_KEYS))
        for summary in (judged, *healthy)
        if set(ZERO_KEYS) <= set(summary)
    )
    prior = CHANGES.healthy
    scatter = ScatterPrior(prior.drift, recordings=prior.drift_recordings, inflation=prior.drift_inflation)
    return compare_estimates(ZEROS, DRIFT, judged_zero, healthy_zeros, scatter)


@np.errstate(all="ignore")
def _estimate_levels(recording: Recording) -> Summary | None:
    """Estimate friction, drifts and spectra of a recording (`HealthyLevels.learn`); None if none can be estimated."""
    levels = dict[str, float]()
    if (fit := fit_difference(recording)) is not None:
        levels |= dict(zip(FRICTION_KEYS, (fit.friction, fit.friction_error), strict=True))
    if (motion := select_motion(recording)) is not None:
        # residuals may be correlated within a stroke
        drifts = {
            side: fit_robustly(motion.design, recording[f"p_{side}"][motion.rows], [TIME], motion.strokes)[0]
            for side in "AB"
        }
        if np.isfinite([*drifts.values()]).all():
            levels |= _list_drifts(drifts, MOTION)
    levels |= _list_drifts(estimate_low_drifts(recording), LOW)
    flow_channel = flow_source(recording.channels)
    if flow_channel in PUMP and {"x", *CHAMBERS} <= set(recording.channels):
        difference = estimate_connected_difference(recording, turned_angle(recording, flow_channel))
        if difference is not None and np.isfinite(difference).all():
            levels |= dict(zip(ZERO_KEYS, difference, strict=True))
    all_octaves = zip(PAIRS, compute_all_octaves(recording, list(PAIRS.values())), strict=True)
    spectra = {name: np.stack(octaves) for name, octaves in all_octaves if octaves is not None}
    return {**levels, **spectra} or None


def _list_drifts(drifts: Mapping[str, Estimate], kind: str) -> dict[str, float]:
    """List drifts and their standard errors for a recording's summary, from which `_read_drifts` reads them."""
    values = {f"{kind}_{side}": drift.value for side, drift in drifts.items()}
    return values | {f"{kind}_{side}_error": drift.deviation for side, drift in drifts.items()}


#: Minimum number of strokes in either direction, for a standard error.
MIN_STROKES = 2


def estimate_connected_difference(recording: Recording, turned: Array) -> Estimate | None:
    """Estimate the mean of p_A - p_B [Pa] of connected chambers.

    `turned` (n - 1,): angle by which the pump turns in each sampling interval [rad]. Strokes are motions of the piston
    past the resting pump (`flag_lowering`) in one direction. The means over the strokes of either direction are
    averaged. Return None for fewer than `MIN_STROKES` strokes in a direction, as of a load that is lowered.
    """
    signals = Signals(recording.channels, recording.rate)
    slowest = rest_limit(signals.step("x"), recording.rate, fraction=CHANGES.healthy.slowest)
    speed = signals.speed[1:]
    is_lowered = flag_lowering(turned, signals["x"], signals.compute_pressure_difference(), recording.rate)
    rows = np.flatnonzero(is_lowered & (np.abs(speed) > slowest))
    if not rows.size:
        return None
    strokes = number_strokes(speed[rows], rows, longest_gap=MIN_REST * recording.rate)
    first, lengths = np.unique(strokes, return_index=True, return_counts=True)[1:]
    is_outward = speed[rows[first]] > 0.0
    if min(is_outward.sum(), (~is_outward).sum()) < MIN_STROKES:
        return None
    difference = (recording["p_A"] - recording["p_B"])[1:][rows]
    means = np.add.reduceat(difference, first) / lengths
    ways = [means[is_outward], means[~is_outward]]
    errors = [values.std(ddof=1) / np.sqrt(len(values)) for values in ways]
    return Estimate(0.5 * float(ways[0].mean() + ways[1].mean()), 0.5 * float(np.hypot(*errors)))
