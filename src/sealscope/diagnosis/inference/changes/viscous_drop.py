"""Pressure drop over the speed of the motion, which goes with the oil's viscosity: a thermometer where none is logged.

The friction of seals and the drop in lines rise with the speed and with the viscosity of the oil. The coefficient b of
the speed is fitted to p_A - p_B over the samples in motion, as in `healthy_levels`. Its standard error is that of
residuals that are correlated within each of some parts of the recording (cluster-robust).

Source: K.-Y. Liang, S. L. Zeger, Biometrika 73 (1986) 13 (the standard error).
"""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.inference.changes.healthy_levels import fit_robustly, select_motion
from sealscope.recordings.recording import Array, Recording, compute_once

#: Number of parts of a recording whose residuals count as independent.
PARTS = 20
#: Indices of the columns sign(v) and v.
DIRECTION, SPEED = 0, 2


def estimate_viscous_drop(recording: Recording) -> Array | None:
    """Estimate the logarithm of the viscous pressure drop over the speed, and its standard error, once for a recording.

    A drop that is not clearly positive counts as its own standard error. Returns None without enough motion.
    """
    return compute_once(recording, ("viscous drop",), _estimate_drop)


@np.errstate(all="ignore")
def _estimate_drop(recording: Recording) -> Array | None:
    """Fit the drop by `healthy_levels` and compute the cluster-robust standard error of its logarithm."""
    motion = select_motion(recording)
    if motion is None:
        return None
    rows, design, top_speed = motion
    difference = recording["p_A"][rows] - recording["p_B"][rows]
    coefficients, weight = fit_robustly(design, difference)
    weighted = design * weight[:, None]
    residual = (difference - design @ coefficients) * weight
    edges = np.linspace(0, len(rows), PARTS + 1).astype(int)[:-1]
    # error^2 = P / (P - 1) sum over P parts of (influence of the part's residuals on the coefficient)^2
    scores = np.add.reduceat(weighted * residual[:, None], edges, axis=0)
    influence = np.linalg.pinv(weighted.T @ weighted)[SPEED] @ scores.T
    error = float(np.sqrt(PARTS / (PARTS - 1.0) * influence @ influence))
    # friction and viscous drop both resist the motion: their coefficients have the same sign
    drop = max(float(coefficients[SPEED] * np.sign(coefficients[DIRECTION])), error)
    log_drop = np.array([np.log(drop / top_speed), error / drop])  # with its standard error
    return log_drop if np.isfinite(log_drop).all() else None
