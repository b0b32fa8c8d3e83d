"""Changes of the details' RMS in words and as method results, for both ways of looking for them."""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.blocks import QUANTITIES, Blocks
from sealscope.diagnosis.verdict import MethodResult, Verdict
from sealscope.recordings.recording import Array

#: Quantities that make the verdict; d1 holds noise alone, d3d4 follows from d3 and d4.
JUDGED = ("d2", "d3", "d4")


def excess(blocks: Blocks) -> Array:
    """Energy of d2..d4 beyond that of d1, relative to its mean: (n, 3 per chamber). White noise, which every level
    holds alike, drops out."""
    energy = np.exp(2.0 * blocks.log_rms)
    columns = []
    for chamber in range(len(blocks.chambers)):
        noise = energy[:, chamber * len(QUANTITIES)]
        for quantity in JUDGED:
            level = energy[:, chamber * len(QUANTITIES) + QUANTITIES.index(quantity)]
            columns.append((level - noise) / level.mean())
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


def method_result(name: str, score: float, threshold: float, reason: str) -> MethodResult:
    """One quantity's evidence; a change of d1 alone is a change of the noise, never a leak."""
    verdict: Verdict = "no leak"
    if score > threshold:
        verdict = "cannot tell" if name.startswith("d1 ") else "leak"
    return MethodResult(f"RMS of {name}", score, threshold, verdict, reason)
