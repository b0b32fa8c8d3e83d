"""Friction and drifts of the pressures over a whole recording, compared with healthy recordings.

Each chamber pressure is fitted over the samples in which the piston moves, by

    p_i = level_i(x) + half_i sign(v) + b_i v + c_i dv/dt + drift_i t/T,    i = A, B,

with the level free in each of some bins of the position and t/T the time over the recording's duration, by iteratively
reweighted least squares (weights of Cauchy's law), so that contact with a workpiece does not count. The friction is
half_A - half_B, the pressure that reverses with the motion. A drift of one pressure alone is a drift of its sensor's
offset; the charge pressure changes both alike. The scatter of these numbers between healthy recordings is their null
(`differences`). Called for recordings with both chamber pressures and a motion.

Source: P. W. Holland, R. E. Welsch, Communications in Statistics A6 (1977) 813 (the weights).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.healthy import Healthy, Summary, healthy_summaries
from sealscope.diagnosis.inference.changes.levels import motion_columns, motion_scales
from sealscope.diagnosis.inference.changes.signals import SIGNALS
from sealscope.diagnosis.inference.differences import compare_with_healthy
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array, Recording, compute_once

#: Number of bins of the position.
BINS = 24
#: Maximum and minimum number of rows of a fit, and its number of iterations.
MAX_ROWS, MIN_ROWS, ITERATIONS = 4000, 200, 8
#: Scale of the weights' decrease with the residual, over the median residual.
WEIGHT_SCALE = 2.0
#: Minimum chance or length that is divided by, and minimum pressure [Pa].
TINY, MIN_PRESSURE = 1e-300, 1.0
#: Names of the observables: of the friction, and of the drifts, which are rival descriptions of the same data.
FRICTION, DRIFTS = "friction", ("drift of p_A", "drift of p_B", "drift of both")


class HealthyLevels:
    """Comparison of a recording's friction and drifts with those of healthy recordings."""

    name = SIGNALS

    def learn(self, recording: Recording) -> Summary | None:
        """Estimate the logarithm of the friction [Pa] and the drifts of p_A and p_B [Pa], once for a recording."""
        return compute_once(recording, ("healthy levels",), _estimate_levels)

    def compare(self, recording: Recording, baseline: Sequence[Healthy]) -> Iterator[Observable]:
        """Yield the differences of friction and of the drifts of p_A and p_B from those of healthy recordings."""
        summaries, judged = healthy_summaries(self, baseline), self.learn(recording)
        if judged is None:
            return
        prior, entries = CHANGES.healthy, [*summaries, judged]  # the judged one is the last
        friction = [float(entry["friction"]) for entry in entries]
        prior_scatter = prior.scatter, prior.recordings
        change = compare_with_healthy(
            FRICTION, FRICTION, friction[-1], friction[:-1], prior.friction, above=True, prior_scatter=prior_scatter
        )
        if change is not None:
            yield change
        drift_A, drift_B = (np.array([float(entry[name]) for entry in entries]) for name in ("drift_A", "drift_B"))
        drifts = [
            compare_with_healthy(name, "drift", float(drift[-1]), drift[:-1].tolist(), prior.drift)
            for name, drift in zip(DRIFTS, (drift_A, drift_B, drift_A - drift_B), strict=True)
        ]
        if None not in drifts:
            yield from _describe_drifts(*drifts)  # type: ignore[arg-type]


def _describe_drifts(drift_A: Observable, drift_B: Observable, difference_AB: Observable) -> Iterator[Observable]:
    """Yield three alternatives: a drift of p_A alone, of p_B alone, and of both alike, which leaves their difference.

    `drift_A`, `drift_B`, `difference_AB`: tests of the drifts of p_A, p_B and p_A - p_B.
    """
    yield drift_A
    yield drift_B
    # a common drift explains both drifts except their difference
    chance = drift_A.chance * drift_B.chance / max(difference_AB.chance, TINY)
    score = max(drift_A.score + drift_B.score - difference_AB.score, 0.0)
    yield replace(difference_AB, chance=min(chance, 1.0), score=score)


@np.errstate(all="ignore")
def _estimate_levels(recording: Recording) -> Summary | None:
    """Estimate log friction and drifts by the module's equation; None without a channel or enough motion."""
    motion = select_motion(recording)
    if motion is None:
        return None
    (half_A, drift_A), (half_B, drift_B) = (
        fit_robustly(motion.design, recording[name][motion.rows])[0][:2] for name in CHAMBERS
    )
    friction = float(np.log(max(abs(half_A - half_B), MIN_PRESSURE)))
    levels = {"friction": friction, "drift_A": float(drift_A), "drift_B": float(drift_B)}
    return levels if np.isfinite(list(levels.values())).all() else None


class Motion(NamedTuple):
    """Samples in motion: their indices `rows` (n,), and the columns `design` (n, m) of the module's equation.

    The columns are the sign of the speed, time, speed, acceleration, and bins of the position; the speed is relative to
    `top_speed`.
    """

    rows: NDArray[np.intp]
    design: Array
    top_speed: float


def select_motion(recording: Recording) -> Motion | None:
    """Select the samples in motion; None without both chamber pressures, a motion, or enough samples."""
    if len(recording) < MIN_ROWS or not set(CHAMBERS) <= set(recording.channels):
        return None
    motion = motion_columns(recording.channels, recording.rate)
    if motion is None:
        return None
    scales = motion_scales(motion)
    motion = motion / scales
    is_known = np.isfinite(motion).all(axis=1) & np.isfinite(recording["p_A"]) & np.isfinite(recording["p_B"])
    rows = np.flatnonzero(is_known & (np.abs(motion[:, 0]) > CHANGES.healthy.slowest))
    if len(rows) < MIN_ROWS:
        return None
    rows = rows[:: max(1, len(rows) // MAX_ROWS)]
    speed, time = motion[rows, 0], (recording.t[rows] - recording.t[rows].mean()) / recording.duration
    position = motion[rows, 2] if motion.shape[1] > 2 else np.zeros(len(rows))
    bins = np.minimum((BINS * (position - position.min()) / max(float(np.ptp(position)), TINY)), BINS - 1)
    occupied = np.eye(BINS)[bins.astype(int)]
    design = np.column_stack([np.sign(speed), time, motion[rows, :2], occupied[:, occupied.any(axis=0)]])
    return Motion(rows, design, float(scales[0]))


def fit_robustly(design: Array, values: Array) -> tuple[Array, Array]:
    """Fit coefficients (m,) to values (n,) by reweighted least squares, with weights 1/sqrt(1 + (residual/scale)^2).

    Returns the coefficients and the weights (n,).
    """
    weight = np.ones(len(values))
    for _ in range(ITERATIONS):
        coefficients = np.linalg.lstsq(design * weight[:, None], values * weight, rcond=None)[0]
        residual = np.abs(values - design @ coefficients)
        scale = WEIGHT_SCALE * float(np.median(residual)) + MIN_PRESSURE
        weight = 1.0 / np.hypot(1.0, residual / scale)
    return np.asarray(coefficients), weight
