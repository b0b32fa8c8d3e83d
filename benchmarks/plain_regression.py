"""What a plain regression calls a leak, beside which benchmarks put the verdicts of Sealscope.

The pump's volume over windows of 0.5 s with motion is regressed on motion either way, both pressures, time and the
integral of p_A - p_B, the speed through a median filter of 9 samples; the last coefficient is judged by its scatter
between the healthy recordings (Student's t, 1 %).
"""

from __future__ import annotations

import numpy as np
from scipy import stats
from scipy.signal import medfilt

import sealscope as ss


def windows(recording: ss.Recording, displacement: float) -> tuple[np.ndarray, np.ndarray]:
    """Return regressors and pump volumes of windows of 0.5 s in which the piston moves."""
    size, dt = int(0.5 * recording.rate), 1.0 / recording.rate
    dp, dx = recording["p_A"] - recording["p_B"], np.diff(recording["x"], prepend=recording["x"][0])
    volume = displacement / (2.0 * np.pi) * medfilt(recording["omega"], 9) * dt  # without glitches of single samples
    rows, left = [], []
    for first in range(0, len(recording) - size, size):
        part = slice(first, first + size)
        moved = dx[part]
        if np.ptp(recording["x"][part]) < 1e-3:
            continue
        ends = [recording[name][part.stop - 1] - recording[name][first] for name in ("p_A", "p_B")]
        rows.append([moved[moved > 0].sum(), moved[moved < 0].sum(), *ends, size * dt, dp[part].sum() * dt])
        left.append(volume[part].sum())
    return np.array(rows), np.array(left)


def regression(judged: ss.Recording, others: list[ss.Recording], displacement: float) -> bool:
    """Return whether the plain regression, fitted to the other runs together, calls the judged run a leak.

    `displacement` of the pump [m^3/rev].
    """
    parts = [windows(own, displacement) for own in (judged, *others)]

    def rise(k: int, reference: list[int]) -> float:
        x, y = (np.concatenate([parts[j][side] for j in reference]) for side in (0, 1))
        size = np.sqrt((x**2).mean(axis=0))
        left = parts[k][1] - parts[k][0] @ (np.linalg.lstsq(x / size, y, rcond=None)[0] / size)
        own = parts[k][0][:, -2:] / size[-2:]
        return float(np.linalg.lstsq(own, left, rcond=None)[0][-1])

    healthy = list(range(1, len(parts)))
    apart = np.array([rise(k, [j for j in healthy if j != k]) for k in healthy])
    t = rise(0, healthy) / np.sqrt(np.mean(apart**2))
    return bool(t > stats.t.ppf(0.99, len(apart)))
