"""How far the parameters of a sound machine wander while it runs, and where their means may be."""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.pressure_model.model import (
    BIAS,
    C_C,
    F_C,
    F_CFR,
    F_V,
    GAIN,
    K_BRK,
    LEAD,
    OFFSET,
    SIDE,
    SOUND,
    STROKE,
    G,
    K,
)
from sealscope.recordings.recording import Array

#: How far each parameter may wander in 90 s (standard deviation): shares of its value, lead in s, G in m^3/(s Pa).
WANDER = {GAIN: 2e-3, K: 0.03, F_C: 0.06, F_V: 0.06, K_BRK: 0.02, C_C: 0.02}
WANDER_REST = {LEAD: 1e-4, G: 3e-14, F_CFR: 2e-8, STROKE: 0.02, OFFSET: 0.05, SIDE: 0.01}
_WANDER_SECONDS = 90.0
#: The bias of the speed settles within a minute of a start: this share of the command's speed in 6 s.
WANDER_BIAS = 0.003
#: Where the record's mean parameters may be, around the first fit (standard deviations as above).
ANCHOR = {GAIN: 0.02, K: 0.1, F_C: 0.1, F_V: 0.15, K_BRK: 0.1, C_C: 0.15}
ANCHOR_REST = {LEAD: 5e-4, G: 1.5e-12, F_CFR: 5e-7, STROKE: 0.3, OFFSET: 0.2, SIDE: 0.1}
#: How far oil that warms takes them from the first block to the last (standard deviation, over a course that is even,
#: half of it besides over one that bends): shares, and G in m^3/(s Pa).
DRIFT = {K: 0.1, F_C: 0.15, F_V: 0.4, K_BRK: 0.1, C_C: 0.1}
DRIFT_REST = {G: 3e-13}
#: What wanders: the parameters of a sound machine and a constant of dp.
SIZE = SOUND + 1


def _deviations(theta: Array, shares: dict[int, float], rest: dict[int, float]) -> Array:
    return np.array([shares.get(k, 0.0) * abs(theta[k]) + rest.get(k, 0.0) for k in range(SOUND)])


def wandering(theta: Array, seconds: float, speed: float) -> Array:
    """Return the standard deviation (13,) by which the parameters of a sound machine wander in so many seconds."""
    walk = _deviations(theta, WANDER, WANDER_REST)
    walk *= np.sqrt(seconds / _WANDER_SECONDS)
    walk[BIAS] = WANDER_BIAS * speed * np.sqrt(seconds / 6.0)
    return walk


def wander(theta: Array, units: Array, seconds: float, speed: float) -> Array:
    """Return the standard deviation (p,) of the walk from block to block, in `units`."""
    return np.append(wandering(theta, seconds, speed), 1500.0 * np.sqrt(seconds / _WANDER_SECONDS)) / units


def drift_courses(theta: Array, units: Array, blocks: int) -> Array:
    """Return what oil that warms adds to the parameters (b, p, q), in `units`.

    Each drifts over an even course and over one that bends.
    """
    deviation = np.append(_deviations(theta, DRIFT, DRIFT_REST), 0.0) / units
    drifting = np.flatnonzero(deviation)
    tau = np.linspace(-0.5, 0.5, blocks)
    shapes = np.column_stack([tau, 0.5 * 6.0 * (tau**2 - np.mean(tau**2))])
    courses = np.zeros((blocks, units.size, drifting.size, 2))
    courses[:, drifting, np.arange(drifting.size)] = deviation[drifting, None] * shapes[:, None]
    return courses.reshape(blocks, units.size, -1)


def anchor_weight(theta: Array, units: Array) -> Array:
    """Return the weight (p,) of the first fit on the record's mean parameters."""
    deviation = _deviations(theta, ANCHOR, ANCHOR_REST)
    weight = np.zeros(SIZE)
    known = deviation > 0
    weight[:SOUND][known] = (units[:SOUND][known] / deviation[known]) ** 2
    return weight
