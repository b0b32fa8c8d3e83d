"""A step of the leak's conductance in the followed parameters of a record.

A step d of G after block k adds N_b e_G d to the right sides of all later blocks (`pressure_track`); with everything
else eliminated its estimate is s_k / I_k with variance 1 / I_k, and z_k = s_k / sqrt(I_k) is standard normal where
nothing steps, with a known correlation between any two instants.
Source: P. de Jong, J. Penzer, Diagnosing shocks in time series, JASA 93 (1998) 796-806.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.diagnosis.pressure_model.laws import G
from sealscope.diagnosis.pressure_model.track import SIZE, Track, precision, right_sides, wander
from sealscope.recordings.recording import Array

#: Wandering that is tried, times the usual one: the likelihood chooses.
SCALES = (1.0, 2.0, 4.0)


@dataclass(frozen=True, eq=False)
class Steps:
    """A step of G after each block: `size`, `deviation` (b - 1,) [m^3/(s Pa)], `z` and their `correlation`; `level`
    (b,) the wandering G with no step, and its `level_deviation`; `scale` of the wandering that was chosen; `excess`:
    chi square of the blocks against the wandering, and its degrees of freedom."""

    size: Array
    deviation: Array
    z: Array
    correlation: Array
    level: Array
    level_deviation: Array
    scale: float
    excess: tuple[float, float]


def excess_of(steps: Steps) -> float:
    """Chi square of the blocks over its degrees of freedom, beside the best step either way (Birge's ratio)."""
    chi_square, freedom = steps.excess
    return float((chi_square - np.max(np.abs(steps.z)) ** 2) / freedom)


def steps_in(followed: Track, theta: Array, speed: float, scales: Sequence[float] = SCALES) -> Steps:
    """A step of G after each block, everything else free to wander; how much it wanders, the likelihood chooses."""
    anchor, centre = np.split(followed.anchor, 2)
    walk = np.tile(wander(theta, followed.units, followed.seconds, speed), (len(followed.N) - 1, 1))
    right = right_sides(followed.r, anchor, centre).reshape(-1)
    blocks = len(followed.N)
    best: tuple[float, float, Array, float] | None = None
    for scale in scales:
        L = np.asarray(np.linalg.cholesky(precision(followed.N, scale * walk, anchor)), dtype=np.float64)
        half = np.linalg.solve(L, right)
        fit = float(half @ half)
        likelihood = fit - 2.0 * np.sum(np.log(np.diagonal(L)))
        likelihood -= 2.0 * np.sum(np.log(scale * walk))
        if best is None or likelihood > best[0] + 2.0:
            best = (float(likelihood), scale, L, fit)
    assert best is not None
    _, scale, L, fit = best
    free, told = float(np.sum(anchor * centre**2)), 0
    for N, r in zip(followed.N, followed.r, strict=True):
        solution, _, rank, _ = np.linalg.lstsq(N, r, rcond=1e-12)
        free += float(r @ solution)
        told += int(rank)
    later_blocks = np.zeros((blocks, SIZE, blocks - 1))
    for k in range(1, blocks):
        later_blocks[k:, :, k - 1] = followed.N[k:, :, G]
    inner = later_blocks.reshape(blocks * SIZE, blocks - 1)
    level_rows = np.zeros((blocks * SIZE, blocks))
    level_rows[np.arange(blocks) * SIZE + G, np.arange(blocks)] = 1.0
    solved = np.linalg.solve(L, np.column_stack([inner, right, level_rows]))
    steps, half, levels = solved[:, : blocks - 1], solved[:, blocks - 1], solved[:, blocks:]
    later = np.cumsum(followed.N[::-1, G, G])[::-1]
    at = np.arange(1, blocks)
    information = later[np.maximum(at[:, None], at[None, :])] - steps.T @ steps
    right_sum = np.cumsum(followed.r[::-1, G])[::-1][1:]
    score = right_sum - steps.T @ half
    own = np.sqrt(np.diagonal(information))
    unit = followed.units[G]
    return Steps(
        score / own**2 * unit,
        unit / own,
        score / own,
        information / np.outer(own, own),
        levels.T @ half * unit,
        np.sqrt(np.sum(levels**2, axis=0)) * unit,
        scale,
        (free - fit, float(told - SIZE + np.count_nonzero(anchor))),
    )
