"""p_A - p_B while a valve connects the chambers: the zeros of both sensors, without a load.

A damped actuator, whose pump rests, is moved to and fro from outside: the oil passes the valve, with a drop of pressure
that changes its sign with the motion. The mean of p_A - p_B over both directions is zero but for the sensors. Called
for comparisons with healthy recordings (`healthy_levels`).
"""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.inference.balance import flag_lowering, max_rest_rate
from sealscope.diagnosis.inference.equations.signals import MIN_REST, Signals
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.recording import Array, Recording

#: Minimum number of strokes in either direction, for a standard error.
MIN_STROKES = 2


def estimate_connected_difference(recording: Recording, turned: Array) -> Estimate | None:
    """Estimate the mean of p_A - p_B [Pa] of connected chambers.

    `turned` (n - 1,): angle by which the pump turns in each sampling interval [rad]. Strokes are motions of the piston
    past the resting pump (`flag_lowering`) in one direction. The means over the strokes of either direction are
    averaged. Return None for fewer than `MIN_STROKES` strokes in a direction, as of a load that is lowered.
    """
    signals = Signals(recording.channels, recording.rate)
    slowest = max_rest_rate(signals.step("x"), recording.rate, fraction=CHANGES.healthy.slowest)
    speed = signals.speed[1:]
    rows = np.flatnonzero(flag_lowering(turned, signals) & (np.abs(speed) > slowest))
    if not rows.size:
        return None
    way = np.sign(speed[rows])
    begins_stroke = (np.diff(way) != 0.0) | (np.diff(rows) > MIN_REST * recording.rate)
    first = np.concatenate([[0], np.flatnonzero(begins_stroke) + 1])
    lengths, is_outward = np.diff(np.append(first, len(rows))), way[first] > 0.0
    if min(is_outward.sum(), (~is_outward).sum()) < MIN_STROKES:
        return None
    difference = (recording["p_A"] - recording["p_B"])[1:][rows]
    means = np.add.reduceat(difference, first) / lengths
    ways = [means[is_outward], means[~is_outward]]
    errors = [values.std(ddof=1) / np.sqrt(len(values)) for values in ways]
    return Estimate(0.5 * float(ways[0].mean() + ways[1].mean()), 0.5 * float(np.hypot(*errors)))
