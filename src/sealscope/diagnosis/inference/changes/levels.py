"""What else the chamber pressures show: friction, load and sensors, by their levels in either direction of motion.

Of each block four numbers are taken, of what moves: the level of each chamber's pressure, and half of what it differs
by between the directions. The force of the piston goes with speed, acceleration and position as well, throughout a
recording alike,

    p_i = level_i + half_i sign(v) + b_i v + c_i dv/dt + d_i x,    i = A, B.

A leak between the chambers moves none of them: the force that the piston needs sets their difference, the oil that is
enclosed their mean. Another cause moves some of them together, at one instant and in a known pattern: each pattern, a
subspace of the four, is a hypothesis. With S the covariance of neighbouring blocks' differences, which drifts and walks
hardly enter, coordinates S^(-1/2) (..) are alike in noise: the steps in the orthonormal directions of a pattern add up,
F the share by which each makes the residual smaller,

    rank = max over onsets of n log(1 + sum_j F_j) - (m - 1) log K,    F_j = exp(score_j / n) - 1,

a coefficient more costs log K (G. Schwarz, Ann. Statist. 6 (1978) 461).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.onset import RANK, Information, two_sided
from sealscope.diagnosis.inference.terms import HALF_DIFFERENCE
from sealscope.diagnosis.priors import priors
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.recording import Array, Recording

_TINY = float(np.finfo(float).tiny)
A, B, HALF_A, HALF_B = np.eye(4)
#: Oil that is lost lowers both levels; what raises them has many causes.
CHARGE, SUPPLY = "a loss of oil", "what feeds both chambers"
#: Name, and rows that span it; where a simpler pattern lies within, once with it first for each.
PATTERNS: tuple[tuple[str, list[list[Array]]], ...] = (
    (CHARGE, [[A + B]]),
    ("friction", [[A + B, HALF_A, HALF_B]]),
    ("friction", [[HALF_A - HALF_B]]),
    ("friction", [[A, B, HALF_A, HALF_B]]),
    (SUPPLY, [[A + B, HALF_A + HALF_B]]),
    ("load", [[A, B], [B, A], [A + B, A]]),
    ("zero of p_A", [[A]]),
    ("zero of p_B", [[B]]),
)


class Level(NamedTuple):
    """A pattern's test.

    `rank` among the patterns; twice the logarithm of the likelihood ratio, n log(1 + sum_j F_j), and its chance; the
    onset and the length of a block [s].
    """

    name: str
    rank: float
    score: float
    chance: float
    onset: float
    block: float


def _motion(recording: Recording) -> Array | None:
    """Return speed, acceleration and, of a recorded position, position (n, 2 or 3); None where no channel shows them.

    Each in a unit of its own size, NaN where samples are missing.
    """
    name = next((name for name in ("x", "theta", "omega", "u") if name in recording), None)
    if name is None:
        return None
    half = max(1, round(HALF_DIFFERENCE * recording.rate))
    speed = _slope(recording[name], half) if name in ("x", "theta") else recording[name]
    motion = [speed, _slope(speed, half)]
    if name == "x":
        motion.append(recording[name] - np.nanmean(recording[name]))
    return np.column_stack([column / max(float(np.nanpercentile(np.abs(column), 99.0)), _TINY) for column in motion])


def _slope(values: Array, half: int) -> Array:
    padded = np.pad(values, half, mode="edge")
    return np.asarray(padded[2 * half :] - padded[: -2 * half])


def levels(recording: Recording) -> tuple[Array, Array] | None:
    """Return times (K,) and the four numbers (K, 4) of each block; None where the pressures or the motion are missing.

    Least squares of what moves: both numbers of either pressure are free in each block, b, c and d are the recording's.
    Without a direction the numbers are the means and zero.
    """
    if not {"p_A", "p_B"} <= set(recording.channels):
        return None
    pressures = np.column_stack([recording["p_A"], recording["p_B"]])
    means, motion = pressures.mean(axis=0), _motion(recording)
    believed = priors("inference.changes")["levels"]
    if motion is None:
        motion, moving = np.zeros((len(recording), 0)), np.ones(len(recording))
        columns = np.column_stack([moving, pressures - means])
    else:
        whole = np.asarray(np.isfinite(motion).all(axis=1))
        motion = np.where(whole[:, None], motion, 0.0)
        moving = (whole & (np.abs(motion[:, 0]) > believed["slowest"])).astype(float)
        columns = np.column_stack([np.ones(len(recording)), np.sign(motion[:, 0]), motion, pressures - means])
    free, size = min(2, columns.shape[1] - 2), columns.shape[1]
    lengths, cycle = [len(recording) // count for count in believed["blocks"]], find_cycle(recording)
    if cycle is not None:
        samples = cycle * recording.rate
        lengths.insert(0, round(math.ceil(lengths[0] / samples) * samples))
    for length in lengths:
        count = len(recording) // max(length, 1)
        if length < 2 or count < believed["blocks"][-1]:
            continue
        rows = (columns * moving[:, None])[: count * length].reshape(count, length, size)
        gram = rows.transpose(0, 2, 1) @ rows
        if free == 2:
            ways = 0.5 * (gram[:, 0, :1] + np.multiply.outer(gram[:, 0, 1], [1.0, -1.0]))
            if ways.min() < believed["least"] * length:
                continue
        solved = np.linalg.solve(gram[:, :free, :free], gram[:, :free, free:])
        rest = (gram[:, free:, free:] - gram[:, free:, :free] @ solved).sum(axis=0)
        shared = np.linalg.lstsq(rest[:-2, :-2], rest[:-2, -2:], rcond=None)[0]
        fitted = solved[:, :, -2:] - solved[:, :, :-2] @ shared
        values = np.zeros((count, 4))
        values[:, : 2 * free] = fitted.reshape(count, 2 * free)
        values[:, :2] += means
        return recording.t[0] + (np.arange(count) + 0.5) * length / recording.rate, values
    return None


def level_tests(recording: Recording) -> tuple[Level, ...]:
    """Return the tests of all patterns, the most likely first."""
    estimated = levels(recording)
    if estimated is None:
        return ()
    time, values = estimated
    kept = np.flatnonzero(np.ptp(values, axis=0) > 0.0)
    change = np.diff(values[:, kept], axis=0)
    covariance = change.T @ change / len(change)
    size = np.sqrt(np.diag(covariance))
    eigen, basis = np.linalg.eigh(covariance / np.outer(size, size))
    root = np.zeros((len(kept), 4))
    root[:, kept] = (basis / np.sqrt(np.maximum(eigen, RANK))) @ basis.T / size
    mean, both, tested = values.mean(axis=0), values[:, :2].sum(axis=1), []
    scales = (("scale of p_A", A + HALF_A), ("scale of p_B", B + HALF_B))
    patterns = [*PATTERNS, *((name, [[mean * rows]]) for name, rows in scales)]
    for name, bases in patterns:
        tests = [_test(name, np.array(rows) @ root.T, values @ root.T, time) for rows in bases]
        least = min((test for test in tests if test is not None), key=lambda test: test.rank, default=None)
        if least is not None:
            after = time > least.onset
            falls = after.any() and not after.all() and both[after].mean() <= both[~after].mean()
            tested.append(least._replace(name=SUPPLY) if name == CHARGE and not falls else least)
    return tuple(sorted(tested, key=lambda test: -test.rank))


def _test(name: str, rows: Array, whitened: Array, time: Array) -> Level | None:
    """Return the test of whitened blocks (K, c) by the steps of `rows` (m, c), the first of them as it is."""
    basis, size = np.linalg.qr(rows.T)
    basis = basis[:, np.abs(np.diag(size)) > RANK * np.abs(size).max()]
    blocks = [Information(time, np.eye(len(time)), whitened @ direction) for direction in basis.T]
    tests = [test for component in blocks if (test := two_sided(component)) is not None]
    if not tests:
        return None
    half, count = 0.5 * len(time), len(tests)
    gains = np.array([test.likelihood - test.likelihood.max() + 0.5 * test.score for test in tests])
    shares = np.expm1(np.maximum(gains, 0.0) / half).sum(axis=0)
    best = int(np.argmax(shares))
    score = 2.0 * half * float(np.log1p(shares[best]))
    chance = 2.0 * count * min(test.law.chance(score) for test in tests)
    rank = score - (count - 1) * float(np.log(len(time)))
    onset, block = float(tests[0].onsets[best]), float(time[1] - time[0])
    return Level(name, rank, score, min(1.0, chance), onset, block)
