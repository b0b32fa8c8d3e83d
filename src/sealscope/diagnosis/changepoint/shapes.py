"""Shapes that the scans fit to a series of blocks: steps, growths and warm-ups, and where a step may lie."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.recording import Array


def least_blocks(n: int) -> int:
    """Return the fewest blocks on either side of a step in n blocks."""
    return max(3, round(0.03 * n))


def rises(t: Array, onsets: Array, duration: float = 0.0, length: float = 1.0) -> Array:
    """Return S (k, n): 0 before each onset (k,), 1 after onset + duration, a straight line between; all in blocks.

    `t` (n,): middles of the blocks; `length` of a block, over the distance of two: an abrupt step within a block moves
    it by the share that remains.
    """
    lead, width = (0.5 * length, length) if duration == 0.0 else (0.0, duration)
    return np.clip((t[None, :] + lead - onsets[:, None]) / width, 0.0, 1.0)


def warm_ups(u: Array, length: float, shares: tuple[float, ...]) -> Array:
    """Return exp(-u / (share length)) (k, n) of the blocks at `u` (n,) from the beginning, for each share (k,)."""
    return np.exp(-u[None, :] / (np.array(shares)[:, None] * length))
