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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.population import ScatterPrior
from sealscope.diagnosis.healthy import MAX_LOGARITHM, Healthy, Magnitude, Number, Summary, Values, healthy_summaries
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
from sealscope.diagnosis.inference.changes.pressure_bands import (
    MIN_OCTAVES,
    PAIRS,
    Octaves,
    compare_spectra,
    compute_all_octaves,
)
from sealscope.diagnosis.inference.equations.signals import Signals
from sealscope.diagnosis.inference.machine_states import MIN_REST, flag_lowering, number_strokes, rest_limit
from sealscope.diagnosis.inference.observable import Observable, compare_estimates
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.channels import CHAMBERS, flow_source
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.smoothing import TINY

#: Names of the observables: of friction, and of drifts, which are rival descriptions of the same data.
FRICTION, DRIFTS = "friction", ("drift of p_A", "drift of p_B", "drift of both")
#: Name of the observable of the zeros of both sensors.
ZEROS = "drift of p_A - p_B"
#: Quantile, over healthy recordings, of the size of a friction of the wrong sign over its error (`_compare_friction`).
UPPER_QUARTILE = 0.75


@dataclass(frozen=True, eq=False, kw_only=True)
class LevelSummary(Summary):
    """Friction, drifts and spectra of a healthy recording (`HealthyLevels.learn`), with standard errors.

    - `friction_pressure`: friction as a pressure difference [Pa];
    - `drift_A`, `drift_B`: drifts of the pressures in motion [Pa over the recording]; `low_A`, `low_B`: those of the
      lowest readings;
    - `connected_difference`: p_A - p_B of connected chambers [Pa];
    - `octaves` and the like (4, k): the fields of `Octaves` in k octaves, for each pair of channels in `PAIRS`.
    """

    method: ClassVar[str] = SIGNALS

    friction_pressure: Number | None = None
    friction_error: Magnitude | None = None
    drift_A: Number | None = None
    drift_A_error: Magnitude | None = None
    drift_B: Number | None = None
    drift_B_error: Magnitude | None = None
    low_A: Number | None = None
    low_A_error: Magnitude | None = None
    low_B: Number | None = None
    low_B_error: Magnitude | None = None
    connected_difference: Number | None = None
    connected_difference_error: Magnitude | None = None
    octaves: Values | None = None
    octaves_A_x: Values | None = None
    octaves_B_x: Values | None = None
    octaves_A_omega: Values | None = None
    octaves_B_omega: Values | None = None

    @property
    def friction(self) -> Estimate | None:
        """Friction as a pressure difference [Pa]."""
        return _known_estimates(friction=(self.friction_pressure, self.friction_error)).get("friction")

    @property
    def zero(self) -> Estimate | None:
        """Pressure difference p_A - p_B of connected chambers [Pa]."""
        return _known_estimates(zero=(self.connected_difference, self.connected_difference_error)).get("zero")

    @property
    def drifts(self) -> dict[str, Estimate]:
        """Known drifts of p_A and p_B in motion, by "A" and "B"."""
        return _known_estimates(A=(self.drift_A, self.drift_A_error), B=(self.drift_B, self.drift_B_error))

    @property
    def low_drifts(self) -> dict[str, Estimate]:
        """Known drifts of the lowest readings of p_A and p_B, by "A" and "B"."""
        return _known_estimates(A=(self.low_A, self.low_A_error), B=(self.low_B, self.low_B_error))

    @property
    def spectra(self) -> dict[str, Octaves]:
        """Known spectra of pairs of channels, by their names in `PAIRS`."""
        return {name: Octaves(*values) for name in PAIRS if (values := getattr(self, name)) is not None}

    def check(self) -> None:
        """Check the spectra; raise ValueError if they are not valid."""
        for name in PAIRS:
            if (values := getattr(self, name)) is None:
                continue
            if values.ndim != 2 or len(values) != len(Octaves._fields) or values.shape[1] < MIN_OCTAVES:
                shape = f"({len(Octaves._fields)}, k), k >= {MIN_OCTAVES}"
                raise ValueError(f"{name} must be of the shape {shape}, got {values.shape}")
            if not np.abs(values).max() < MAX_LOGARITHM or (values[-1] < 0.0).any():
                rule = f"must hold logarithms, phases and variances below {MAX_LOGARITHM:g} in magnitude"
                raise ValueError(f"{name} {rule}")


def _known_estimates(**pairs: tuple[float | None, float | None]) -> dict[str, Estimate]:
    """Join values and their standard errors by name, as far as both are known."""
    known = {name: (value, error) for name, (value, error) in pairs.items() if value is not None and error is not None}
    return {name: Estimate(value, error) for name, (value, error) in known.items()}


class HealthyLevels:
    """Comparison of a recording's friction, drifts and spectra with those of healthy recordings."""

    name, summary_type = SIGNALS, LevelSummary

    @np.errstate(all="ignore")
    def learn(self, recording: Recording) -> LevelSummary | None:
        """Summarise a recording by friction, drifts and spectra; None if nothing can be estimated."""
        nothing = (None, None)
        motion, drifts, zero = select_motion(recording), dict[str, Estimate](), None
        fit = fit_difference(recording, motion)
        if motion is not None:
            # residuals may be correlated within a stroke
            drifts = {
                side: fit_robustly(motion.design, recording[f"p_{side}"][motion.rows], [TIME], motion.strokes)[0]
                for side in "AB"
            }
        flow_channel = flow_source(recording.channels)
        if flow_channel in PUMP and {"x", *CHAMBERS} <= set(recording.channels):
            zero = estimate_connected_difference(recording, turned_angle(recording, flow_channel))
        if not np.isfinite([*drifts.values()]).all():
            drifts = {}
        if zero is not None and not np.isfinite(zero).all():
            zero = None
        low_drifts = estimate_low_drifts(recording)
        drift_A, drift_B, low_A, low_B = (
            estimates.get(side, nothing) for estimates in (drifts, low_drifts) for side in "AB"
        )
        summary = LevelSummary(
            friction_pressure=None if fit is None else fit.friction,
            friction_error=None if fit is None else fit.friction_error,
            drift_A=drift_A[0],
            drift_A_error=drift_A[1],
            drift_B=drift_B[0],
            drift_B_error=drift_B[1],
            low_A=low_A[0],
            low_A_error=low_A[1],
            low_B=low_B[0],
            low_B_error=low_B[1],
            connected_difference=None if zero is None else zero.value,
            connected_difference_error=None if zero is None else zero.deviation,
        )
        all_octaves = zip(PAIRS, compute_all_octaves(recording, list(PAIRS.values())), strict=True)
        spectra: dict[str, Any] = {name: np.stack(octaves) for name, octaves in all_octaves if octaves is not None}
        summary = replace(summary, **spectra)
        return summary if summary.table() else None

    def compare(self, recording: Recording, baseline: Sequence[Healthy]) -> Iterator[Observable]:
        """Compare friction, spectra and drifts of the pressures with those of the healthy recordings in `baseline`.

        There are two kinds of drift, of the mean pressures during motion and of the lowest readings. A quantity that is
        missing in the recording or in too many healthy ones has no test.
        """
        for judged in healthy_summaries(self, [recording]):
            healthy = healthy_summaries(self, baseline)
            yield from compare_low_drifts(judged.low_drifts, [summary.low_drifts for summary in healthy])
            if (spectra := compare_spectra(judged.spectra, [summary.spectra for summary in healthy])) is not None:
                yield spectra
            if (friction := _compare_friction(judged, healthy)) is not None:
                yield friction
            yield from _compare_drifts(judged, healthy, recording.duration)
            if (zeros := _compare_zeros(judged, healthy)) is not None:
                yield zeros


def _compare_friction(judged: LevelSummary, healthy: Sequence[LevelSummary]) -> Observable | None:
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
    prior = CHANGES.healthy
    known = [friction for summary in healthy if (friction := summary.friction) is not None]
    if not known or judged.friction is None:
        return None
    ratios = np.array([pressure / max(error, TINY) for pressure, error in known])
    sign = float(np.sign(ratios.sum()))
    inflation = max(1.0, float(np.quantile(np.maximum(-sign * ratios, 0.0), UPPER_QUARTILE)))

    def log_friction(friction: Estimate) -> Estimate | None:
        """Return the logarithm of a recording's friction, or None if it is not usable."""
        pressure, error = sign * friction.value, inflation * friction.deviation
        if not pressure > error:
            return None
        return Estimate(float(np.log(pressure)), float(np.hypot(prior.friction_error, error / pressure)))

    healthy_logs = [logarithm for friction in known if (logarithm := log_friction(friction)) is not None]
    judged_log = log_friction(judged.friction)
    if judged_log is None:
        return None
    scatter = ScatterPrior(deviation=prior.friction_scatter, recordings=prior.recordings)
    return compare_estimates(FRICTION, FRICTION, judged_log, healthy_logs, scatter, above=True)


def _compare_drifts(judged: LevelSummary, healthy: Sequence[LevelSummary], duration: float) -> Iterator[Observable]:
    """Compare the drifts of p_A and p_B during motion [Pa over the recording] with those of healthy recordings.

    `duration` [s]: that of the judged recording. Yields a test for each of three alternative explanations: p_A drifts,
    p_B drifts, or both drift alike. Yields nothing unless the judged recording and enough healthy ones have both
    drifts. If both drift alike, p_A - p_B does not drift, and p-value and score of this explanation are

        chance = min(1, chance_A chance_B / chance_difference),    score = max(0, score_A + score_B - score_difference).

    A score is the square of a z score. With equal errors of both drifts, z_A^2 + z_B^2 = z_mean^2 + z_difference^2, so
    that what remains is the score of their mean; a p-value is about exp(-z^2 / 2).
    """
    judged_drifts = judged.drifts
    if len(judged_drifts) < 2:
        return
    healthy_drifts = [drifts for summary in healthy if len(drifts := summary.drifts) > 1]
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


def _compare_zeros(judged: LevelSummary, healthy: Sequence[LevelSummary]) -> Observable | None:
    """Compare p_A - p_B of connected chambers with that of healthy recordings; None if it is missing in too many."""
    if judged.zero is None:
        return None
    healthy_zeros = [zero for summary in healthy if (zero := summary.zero) is not None]
    prior = CHANGES.healthy
    scatter = ScatterPrior(prior.drift, recordings=prior.drift_recordings, inflation=prior.drift_inflation)
    return compare_estimates(ZEROS, DRIFT, judged.zero, healthy_zeros, scatter)


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
