"""Scan for a step near an instant, in a series that drifts evenly."""

from __future__ import annotations

import math

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
    best = (0.0, 0.0)
    near = max(near, 2.0 * half)
    first, last = np.searchsorted(t, [onset - reach - near, onset + reach + near])
    t, values = t[first:last], values[first:last]
    edges = t[:-1] + half
    whole = np.isfinite(values) & (np.abs(t - onset) >= half)
    for edge in edges[np.abs(edges - onset) <= near]:
        within = whole & (np.abs(t - edge) < reach)
        after = within & (t > edge)
        if min(np.count_nonzero(after), np.count_nonzero(within & ~after)) < fewest:
            continue
        x = np.stack([np.ones(within.sum()), t[within] - edge, after[within].astype(np.float64)], axis=1)
        inverse = np.linalg.inv(x.T @ x)
        beta = inverse @ (x.T @ values[within])
        rest = values[within] - x @ beta
        deviation = math.sqrt(float(rest @ rest) / (rest.size - 3) * float(inverse[2, 2]))
        size = float(beta[2])
        ratio = size / max(deviation, 1e-12 * (1.0 + abs(size)))
        if abs(ratio) > abs(best[1]):
            best = (size, ratio)
    return best
