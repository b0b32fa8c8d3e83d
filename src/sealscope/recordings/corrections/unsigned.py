"""Speeds and flows without a sign: an encoder or a flow meter that counts pulses does not measure the direction.

If a speed is never negative while the piston moves both ways, it has no sign, or the pump turns one way and a valve
chooses the side. In both cases the flow into A has the sign of a v + c (p_A - p_B), fitted iteratively to the signed
magnitude; the pressure term is the flow that replaces leakage while the piston stands. Without a position the sign is
that of the command. Called by the inspection.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sealscope.recordings.channels import Array
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording

_PRIORS = RECORDINGS.unsigned
#: Most iterations of the fit; each uses the signs of the previous one.
_MAX_ITERATIONS = 5
_NAMES = {"omega": "speed", "q_pump": "flow"}


def restore_speed_sign(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Give a speed or flow without a sign the sign of the flow into A; return the recording and the findings."""
    channels, findings = dict(recording.channels), list[Finding]()
    for name, quantity in _NAMES.items():
        if name not in recording or not _has_one_sign(recording[name]):
            continue
        sign, source = _find_sign(recording, np.abs(recording[name]))
        if sign is None:
            continue
        channels[name] = np.abs(recording[name]) * sign
        text = f"{name}: the {quantity} has no sign while the piston moves both ways: taken from {source}"
        findings.append(Finding("unsigned_speed", "note", name, len(recording), float(recording.t[0]), text))
    return (replace(recording, channels=channels) if findings else recording), findings


def _has_one_sign(values: Array) -> bool:
    """Test whether a channel (n,) stays on one side of zero, to within its noise."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return False
    smaller, larger = sorted((max(0.0, -float(finite.min())), max(0.0, float(finite.max()))))
    return larger > 0.0 and smaller <= _PRIORS.noise * larger


def _find_sign(recording: Recording, magnitude: Array) -> tuple[Array | None, str]:
    """Find the sign (n,) of the flow into A and a description of its source.

    (None, "") if position and command do not determine it, or the motion is one way. `magnitude`: absolute speed or
    flow (n,).
    """
    if "x" in recording:
        speed = _piston_speed(recording["x"], recording.rate)
        if _moves_both_ways(speed) and _correlation(np.abs(speed), magnitude) >= _PRIORS.correlation:
            return _fit_signs(recording, speed, magnitude), "the position's rate and the pressures"
        return None, ""
    if "u" not in recording or not _moves_both_ways(recording["u"]):
        return None, ""
    is_correlated = _correlation(np.abs(recording["u"]), magnitude) >= _PRIORS.correlation
    return (np.where(recording["u"] < 0.0, -1.0, 1.0), "the command") if is_correlated else (None, "")


def _piston_speed(x: Array, rate: float) -> Array:
    """Differentiate a position (n,) [m] by central differences over `_PRIORS.half` [s] on either side; return [m/s]."""
    n_half = max(1, round(_PRIORS.half * rate))
    known = np.isfinite(x)
    x = np.interp(np.arange(x.size), np.flatnonzero(known), x[known]) if known.any() else np.zeros(x.size)
    # the position is constant before the beginning and after the end
    padded = np.concatenate([x[:1].repeat(n_half), x, x[-1:].repeat(n_half)])
    return np.asarray((padded[2 * n_half :] - padded[: -2 * n_half]) * (0.5 * rate / n_half))


def _moves_both_ways(values: Array) -> bool:
    """Test whether the smaller of the sums of positive and of negative values (n,) is over `least` times the larger."""
    smaller, larger = sorted(float(np.nansum(np.maximum(signed, 0.0))) for signed in (values, -values))
    return smaller > _PRIORS.least * larger > 0.0


def _correlation(first: Array, second: Array) -> float:
    """Compute the correlation of the rows known in both channels (n,); 0 if either is constant."""
    known = np.isfinite(first) & np.isfinite(second)
    if np.count_nonzero(known) < 3 or not (np.ptp(first[known]) > 0.0 and np.ptp(second[known]) > 0.0):
        return 0.0
    return float(np.corrcoef(first[known], second[known])[0, 1])


def _fit_signs(recording: Recording, speed: Array, magnitude: Array) -> Array:
    """Estimate the signs (n,) of the flow into A: fit a v + c (p_A - p_B) to sign x magnitude, take the fit's sign.

    `a` depends on the direction. The first signs are those of the piston's `speed` v [m/s]; the fit is repeated until
    no sign changes.
    """
    columns = [np.maximum(speed, 0.0), np.minimum(speed, 0.0)]
    if {"p_A", "p_B"} <= recording.channels.keys():
        columns.append(recording["p_A"] - recording["p_B"])
    design = np.column_stack(columns)
    known = np.isfinite(design).all(axis=1) & np.isfinite(magnitude)
    scale = np.sqrt(np.mean(design[known] ** 2, axis=0))
    design = design / np.where(scale > 0.0, scale, 1.0)
    sign = np.where(speed < 0.0, -1.0, 1.0)
    for _ in range(_MAX_ITERATIONS):
        fit = np.linalg.lstsq(design[known], (sign * magnitude)[known], rcond=None)[0]
        fit = np.maximum(fit, 0.0)  # the pump replaces leakage, so that no coefficient is negative
        predicted = np.where(known, design @ fit, speed)
        sign, previous = np.where(predicted < 0.0, -1.0, 1.0), sign
        if np.array_equal(sign, previous):
            break
    return sign
