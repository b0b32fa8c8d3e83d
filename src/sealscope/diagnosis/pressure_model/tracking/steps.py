"""A step of a leak in a record that is followed.

A step d of G after block k adds N_b e_G d to the right sides of all later blocks; with everything else eliminated its
estimate is s_k / I_k with variance 1 / I_k, and z_k = s_k / sqrt(I_k) is standard normal where nothing steps, with a
known correlation between any two instants. A step of an orifice's coefficient, which sound blocks do not have, is
estimated in the same way from the slopes of dp for it.

Source: P. de Jong, J. Penzer, Diagnosing shocks in time series, JASA 93 (1998) 796-806.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.diagnosis.pressure_model.model import G
from sealscope.diagnosis.pressure_model.tracking.chain import Chain, Drifting
from sealscope.diagnosis.pressure_model.tracking.laws import WORN_SEAL, Law
from sealscope.diagnosis.pressure_model.tracking.track import Track, right_sides
from sealscope.diagnosis.pressure_model.tracking.wander import SIZE, drift_courses, wander
from sealscope.recordings.recording import Array

#: Wandering that is tried, times the usual one: the likelihood chooses.
SCALES = (1.0, 2.0, 4.0)


@dataclass(frozen=True, eq=False)
class PossibleLeak:
    """A leak that would explain the record.

    `law`; `after` which block; `size`, `deviation`: of that law; `cost`: minus twice the log likelihood but for a
    constant.
    """

    law: Law
    after: int
    size: float
    deviation: float
    cost: float


@dataclass(frozen=True, eq=False)
class ConductanceSteps:
    """A step of a leak after each block.

    `size`, `deviation` (b - 1,) of its law; `z` and their `correlation`; `level`
    (b,) the wandering G with no step, and its `level_deviation`; `scale` of the wandering that was chosen; `excess`:
    chi square of the blocks against the wandering, and its degrees of freedom.
    """

    size: Array
    deviation: Array
    z: Array
    correlation: Array
    level: Array
    level_deviation: Array
    scale: float
    excess: tuple[float, float]


def excess_of(steps: ConductanceSteps) -> float:
    """Return the chi square of the blocks over its degrees of freedom, beside the best step (Birge's ratio).

    Where blocks are so far from the model that nothing is left of its digits, and no step can explain more than there
    is, the ratio is infinite: nothing is followed there.
    """
    chi_square, freedom = steps.excess
    ratio = float((chi_square - np.max(np.abs(steps.z)) ** 2) / freedom)
    return ratio if ratio >= 0.0 else np.inf


def steps_in(
    followed: Track,
    theta: Array,
    speed: float,
    scales: Sequence[float] = SCALES,
    law: Law = WORN_SEAL,
    beside: PossibleLeak | None = None,
    warming: bool = False,
) -> ConductanceSteps:
    """Estimate a step of a leak of a law after each block.

    Everything else is free to wander as far as the likelihood chooses, and to drift as in oil that warms where
    `warming`. `beside` a leak of the same law, which is taken away first, the steps are further ones.
    """
    anchor, centre = followed.anchor, followed.centre
    walk = np.tile(wander(theta, followed.units, followed.seconds, speed), (len(followed.N) - 1, 1))
    rise, r = followed.rise(law), followed.r
    rise_right = rise.right
    if beside is not None:
        size = np.where(np.arange(len(r)) > beside.after, beside.size / rise.unit, 0.0)
        r, rise_right = r - size[:, None] * rise.cross, rise_right - size * rise.own
    right = right_sides(r, anchor, centre).reshape(-1, 1)
    blocks = len(followed.N)
    best: tuple[float, float, Chain | Drifting, float] | None = None
    courses = drift_courses(theta, followed.units, blocks) if warming else None
    for scale in scales:
        wandering_only = Chain(followed.N, scale * walk, anchor)
        chain = wandering_only if courses is None else Drifting(wandering_only, followed.N, courses)
        fit = float(np.vdot(right, chain.solve(right)))
        likelihood = fit - chain.log_determinant()
        likelihood -= 2.0 * np.sum(np.log(scale * walk))
        if best is None or likelihood > best[0] + 2.0:
            best = (float(likelihood), scale, chain, fit)
    assert best is not None
    _, scale, chain, fit = best
    free, ranks = float(np.sum(anchor * centre**2)), 0
    for N, r_block in zip(followed.N, r, strict=True):
        solution, _, rank, _ = np.linalg.lstsq(N, r_block, rcond=1e-12)
        free += float(r_block @ solution)
        ranks += int(rank)
    later_blocks = np.zeros((blocks, SIZE, blocks - 1))
    for k in range(1, blocks):
        later_blocks[k:, :, k - 1] = rise.cross[k:]
    inner = later_blocks.reshape(blocks * SIZE, blocks - 1)
    level_rows = np.zeros((blocks * SIZE, blocks))
    level_rows[np.arange(blocks) * SIZE + G, np.arange(blocks)] = 1.0
    solved = chain.solve(np.hstack([inner, right, level_rows]))
    steps, middle, levels = solved[:, : blocks - 1], solved[:, blocks - 1], solved[:, blocks:]
    later = np.cumsum(rise.own[::-1])[::-1]
    at = np.arange(1, blocks)
    information = later[np.maximum(at[:, None], at[None, :])] - inner.T @ steps
    right_sum = np.cumsum(rise_right[::-1])[::-1][1:]
    score = right_sum - inner.T @ middle
    own = np.sqrt(np.diagonal(information))
    unit = followed.units[G]
    return ConductanceSteps(
        score / own**2 * rise.unit,
        rise.unit / own,
        score / own,
        information / np.outer(own, own),
        middle.reshape(blocks, SIZE)[:, G] * unit,
        np.sqrt(levels[np.arange(blocks) * SIZE + G, np.arange(blocks)]) * unit,
        scale,
        (free - fit, float(ranks - SIZE + np.count_nonzero(anchor))),
    )
