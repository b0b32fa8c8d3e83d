"""Viscous pressure drop per speed of the motion, a substitute for the temperature of the oil where none is logged.

The drop in lines and the friction of seals rise with the speed and with the viscosity of the oil. The coefficient b of
the speed is fitted to p_A - p_B over the samples in motion (`motion_fit`).
"""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.inference.changes.motion_fit import fit_difference
from sealscope.recordings.recording import Array, Recording


def estimate_viscous_drop(recording: Recording) -> Array | None:
    """Estimate the logarithm of the viscous pressure drop [Pa] per speed, and its standard error, shape (2,).

    A drop below its standard error is replaced by this error, so that the logarithm exists. Return None without
    enough motion.
    """
    fit = fit_difference(recording)
    if fit is None:
        return None
    # friction and viscous drop both resist the motion: a drop with the sign of the friction counts as positive
    drop = max(fit.drop * np.sign(fit.friction), fit.drop_error)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_drop = np.array([np.log(drop), fit.drop_error / drop])
    return log_drop if np.isfinite(log_drop).all() else None
