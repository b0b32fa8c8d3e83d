"""Changes of the details' RMS in words and as method results, for both ways of looking for them."""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.rms_change.blocks import QUANTITIES
from sealscope.diagnosis.verdict.evidence import Evidence, Verdict
from sealscope.recordings.recording import Array

#: Quantities that make the verdict; d1 holds noise alone, d3d4 follows from d3 and d4.
JUDGED = ("d2", "d3", "d4")


def excess(log_rms: Array, split: int) -> Array:
    """Energy of d2..d4 beyond that of d1, from its mean, in parts of the level's energy on either side of `split`.

    `log_rms`: (n, 5 per chamber), `split`: the block from which the noise is another one; (n, 3 per chamber). White
    noise, which every level holds alike, drops out of the mean. As the scatter of an energy goes with the energy, each
    side has a scale s of its own and counts as n/s^2 in the mean: while nothing but the noise has changed, blocks of
    both sides scatter alike, and the difference of their means no more than that of random halves.
    """
    energy = np.exp(2.0 * log_rms)
    sides = (slice(None, split), slice(split, None))
    columns = []
    for first in range(0, energy.shape[1], len(QUANTITIES)):
        for quantity in JUDGED:
            level = energy[:, first + QUANTITIES.index(quantity)]
            beyond = level - energy[:, first]
            scales = [float(level[side].mean()) for side in sides]
            weights = [level[side].size / scale**2 for side, scale in zip(sides, scales, strict=True)]
            mean = np.average([beyond[side].mean() for side in sides], weights=weights)
            columns.append(
                np.concatenate([(beyond[side] - mean) / scale for side, scale in zip(sides, scales, strict=True)])
            )
    return np.stack(columns, axis=1)


def describe_change(name: str, change: float) -> str:
    """A change of log RMS in words."""
    percent = 100.0 * np.expm1(change)
    return f"RMS of {name} {'rose' if percent > 0 else 'fell'} by {abs(percent):.1f} %"


def largest_changes(names: list[str], single: Array, changes: Array, thresholds: Array) -> str:
    """The significant changes in words, the clearest first, at most three."""
    order = [k for k in np.argsort(-np.abs(single) / thresholds) if not names[k].startswith("d3d4")]
    told = [k for k in order if abs(single[k]) > thresholds[k]][:3] or order[:1]
    return ", ".join(describe_change(names[k], float(changes[k])) for k in told)


def method_result(name: str, score: float, threshold: float, reason: str) -> Evidence:
    """One quantity's evidence; a change of d1 alone is a change of the noise, never a leak."""
    verdict: Verdict = "no leak"
    if score > threshold:
        verdict = "cannot tell" if name.startswith("d1 ") else "leak"
    return Evidence(verdict, reason, score, threshold, detector=f"RMS of {name}")
