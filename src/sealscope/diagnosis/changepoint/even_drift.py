"""Scan for a step near an instant, in a series that drifts evenly."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.recording import Array


def step_near(
    t: Array, values: Array, half: float, onset: float, *, near: float, reach: float, fewest: int
) -> tuple[float, float]:
    """Return the surest step of a series at an edge of blocks near an onset: its size, and size over its deviation.

    `values` (n,) of blocks with the middles `t` (n,) [s] and half the length `half` [s] are fitted by a line and a step
    (least squares) within `reach` [s] of each edge that is within `near` [s] (two blocks at least) of the onset. The
    block that holds the onset counts on neither side. (0, 0) without `fewest` blocks on either side.
    """
    near = max(near, 2.0 * half)
    first, last = np.searchsorted(t, [onset - reach - near, onset + reach + near])
    t, values = t[first:last], values[first:last]
    edges = t[:-1] + half
    edges = edges[np.abs(edges - onset) <= near]
    whole = np.isfinite(values) & (np.abs(t - onset) >= half)
    away = t - edges[:, None]  # from every edge
    after = whole & (away > 0.0) & (away < reach)
    before = whole & (away <= 0.0) & (away > -reach)
    enough = np.minimum(np.count_nonzero(after, axis=1), np.count_nonzero(before, axis=1)) >= fewest
    if not np.any(enough):
        return 0.0, 0.0
    away, after, weight = away[enough], after[enough], (before | after)[enough].astype(np.float64)
    # without the mean and the line, of the step and of the values (Frisch, Waugh): one coefficient is left
    count = weight.sum(axis=1, keepdims=True)
    line, step, rest = (
        weight * (each - np.sum(weight * each, axis=1, keepdims=True) / count)
        for each in (away, after.astype(np.float64), np.broadcast_to(np.where(whole, values, 0.0), away.shape))
    )
    along = np.sum(line**2, axis=1, keepdims=True)
    step -= np.sum(line * step, axis=1, keepdims=True) / along * line
    rest -= np.sum(line * rest, axis=1, keepdims=True) / along * line
    own = np.sum(step**2, axis=1)
    size = np.sum(step * rest, axis=1) / own
    rest -= size[:, None] * step
    deviation = np.sqrt(np.sum(rest**2, axis=1) / (count[:, 0] - 3.0) / own)
    ratio = size / np.maximum(deviation, 1e-12 * (1.0 + np.abs(size)))
    best = int(np.argmax(np.abs(ratio)))
    return float(size[best]), float(ratio[best])
