"""What else the chamber pressures show: friction, load and sensors, by their levels in either direction of motion.

Of each block four numbers are taken, the mean of each chamber's pressure over both directions and half of what it
differs by between them,

    p_i = level_i + half_i sign(v),    i = A, B.

A leak between the chambers moves none of them: the force that the piston needs sets their difference, the oil that is
enclosed their mean. Another cause moves some of them together, at one instant and in a known pattern: each pattern, a
subspace of the four, is a hypothesis. With S the covariance of neighbouring blocks' differences, which drifts and walks
hardly enter, coordinates S^(-1/2) (..) are alike in noise: the steps in the orthonormal directions of a pattern add up,
F the share by which each makes the residual smaller,

    rank = max over onsets of n sum_j F_j - (m - 1) log K,    F_j = exp(score_j / n) - 1,

a coefficient more costs log K (G. Schwarz, Ann. Statist. 6 (1978) 461).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.beliefs import beliefs
from sealscope.diagnosis.inference.onset import Information, two_sided
from sealscope.diagnosis.inference.terms import HALF_DIFFERENCE
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.recordings.recording import Array, Recording

_RANK = 1e-9  # directions that carry less than this share of the largest carry nothing
A, B, HALF_A, HALF_B = np.eye(4)
#: Oil that is lost lowers both levels; what raises them has many causes.
CHARGE = "a loss of oil"
#: What a pattern means, and rows that span it; where a simpler pattern lies within, once with it first for each.
PATTERNS: dict[str, tuple[Cause, list[list[Array]]]] = {
    CHARGE: ("external leak", [[A + B]]),
    "friction": ("friction change", [[A + B, HALF_A, HALF_B]]),
    "load": ("changed duty", [[A, B], [B, A], [A + B, A]]),
    "zero of p_A": ("sensor fault", [[A]]),
    "zero of p_B": ("sensor fault", [[B]]),
}


class Level(NamedTuple):
    """A pattern's test.

    `rank` among the patterns; twice the logarithm of the likelihood ratio, n log(1 + sum_j F_j), and its chance; the
    onset and the length of a block [s].
    """

    name: str
    cause: Cause | None
    rank: float
    score: float
    chance: float
    onset: float
    block: float


def directions(recording: Recording) -> Array | None:
    """Return the direction of motion at each sample, 1, -1 or 0; None where no channel shows it."""
    name = next((name for name in ("x", "theta", "omega", "u") if name in recording), None)
    if name not in ("x", "theta"):
        return None if name is None else np.asarray(np.sign(recording[name]))
    half = max(1, round(HALF_DIFFERENCE * recording.rate))
    padded = np.pad(recording[name], half, mode="edge")
    return np.asarray(np.sign(padded[2 * half :] - padded[: -2 * half]))


def levels(recording: Recording) -> tuple[Array, Array] | None:
    """Return times (K,) and the four numbers (K, 4) of each block; None where the pressures or the motion are missing.

    Without a direction the halves are zero.
    """
    if not {"p_A", "p_B"} <= set(recording.channels):
        return None
    way = directions(recording)
    believed = beliefs("inference.other_steps")["levels"]
    for count in believed["blocks"]:
        length = len(recording) // count
        if length < 2:
            continue
        p = np.stack([recording[name][: count * length].reshape(count, length) for name in ("p_A", "p_B")])
        time = recording.t[0] + (np.arange(count) + 0.5) * length / recording.rate
        if way is None:
            level = p.mean(axis=2).T
            return time, np.column_stack([level, np.zeros_like(level)])
        own = way[: count * length].reshape(count, length)
        shares = np.stack([(own > 0.0).mean(axis=1), (own < 0.0).mean(axis=1)])
        if shares.min() < believed["least"]:
            continue
        out, back = ((p * (own == sign)).mean(axis=2) / share for sign, share in zip((1.0, -1.0), shares, strict=True))
        return time, np.vstack([0.5 * (out + back), 0.5 * (out - back)]).T
    return None


def level_tests(recording: Recording) -> tuple[Level, ...]:
    """Return the tests of all patterns, the most likely first."""
    made = levels(recording)
    if made is None:
        return ()
    time, values = made
    kept = np.flatnonzero(np.ptp(values, axis=0) > 0.0)
    change = np.diff(values[:, kept], axis=0)
    covariance = change.T @ change / len(change)
    size = np.sqrt(np.diag(covariance))
    eigen, basis = np.linalg.eigh(covariance / np.outer(size, size))
    root = np.zeros((len(kept), 4))
    root[:, kept] = (basis / np.sqrt(np.maximum(eigen, _RANK))) @ basis.T / size
    mean, both, tested = values.mean(axis=0), values[:, :2].sum(axis=1), []
    patterns = dict(PATTERNS)
    for side, own in (("A", A + HALF_A), ("B", B + HALF_B)):
        patterns[f"scale of p_{side}"] = "sensor fault", [[mean * own]]
    for name, (cause, bases) in patterns.items():
        tests = [_test(name, cause, np.array(own) @ root.T, values @ root.T, time) for own in bases]
        least = min((test for test in tests if test is not None), key=lambda test: test.rank, default=None)
        if least is not None:
            after = time > least.onset
            falls = after.any() and not after.all() and both[after].mean() <= both[~after].mean()
            tested.append(least._replace(cause=None) if name == CHARGE and not falls else least)
    return tuple(sorted(tested, key=lambda test: -test.rank))


def _test(name: str, cause: Cause, rows: Array, whitened: Array, time: Array) -> Level | None:
    """Return the test of whitened blocks (K, c) by the steps of `rows` (m, c), the first of them as it is."""
    basis, size = np.linalg.qr(rows.T)
    basis = basis[:, np.abs(np.diag(size)) > _RANK * np.abs(size).max()]
    blocks = [Information(time, np.eye(len(time)), whitened @ own) for own in basis.T]
    tests = [test for own in blocks if (test := two_sided(own)) is not None]
    if not tests:
        return None
    half, count = 0.5 * len(time), len(tests)
    gains = np.array([test.likelihood - test.likelihood.max() + 0.5 * test.score for test in tests])
    shares = np.expm1(np.maximum(gains, 0.0) / half).sum(axis=0)
    best = int(np.argmax(shares))
    score = 2.0 * half * float(np.log1p(shares[best]))
    chance = 2.0 * count * min(test.law.chance(score) for test in tests)
    rank = 2.0 * half * float(shares[best]) - (count - 1) * float(np.log(len(time)))
    onset, block = float(tests[0].onsets[best]), float(time[1] - time[0])
    return Level(name, cause, rank, score, min(1.0, chance), onset, block)
