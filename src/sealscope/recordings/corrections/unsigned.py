"""Speeds and flows without a sign: an encoder or a meter that counts pulses does not tell which way.

A speed that is never negative while the piston moves both ways has no sign, or the pump turns one way and a valve
chooses the side: the flow into A has its sign from the motion in both cases. It is that of a v + c (p_A - p_B), fitted
to what it makes of the speed: while the piston stands, the pump makes good what the loaded side loses. Without a
position the command gives the sign. The inspection calls it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sealscope.recordings.channels import Array
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import priors_of

_PRIORS = priors_of("sealscope.recordings")["unsigned"]
#: Turns of the fit: each takes the signs of the one before.
_TURNS = 5
_NAMES = {"omega": "speed", "q_pump": "flow"}


def with_signed_speed(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Give a speed or flow without a sign that of the flow into A; return the recording and what was found."""
    channels, findings = dict(recording.channels), list[Finding]()
    for name, word in _NAMES.items():
        if name not in recording or not _has_one_sign(recording[name]):
            continue
        way, source = _direction(recording, np.abs(recording[name]))
        if way is None:
            continue
        channels[name] = np.abs(recording[name]) * way
        text = f"{name}: the {word} has no sign while the piston moves both ways: taken from {source}"
        findings.append(Finding("unsigned_speed", "warning", name, len(recording), float(recording.t[0]), text))
    return (replace(recording, channels=channels) if findings else recording), findings


def _has_one_sign(values: Array) -> bool:
    """Test whether a channel (n,) stays on one side of zero, to within its noise."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return False
    back, forth = max(0.0, -float(finite.min())), max(0.0, float(finite.max()))
    noise: float = _PRIORS["noise"]
    return max(back, forth) > 0.0 and min(back, forth) <= noise * max(back, forth)


def _direction(recording: Recording, size: Array) -> tuple[Array | None, str]:
    """Return the sign (n,) of the flow into A and in words what tells it; None where nothing does, or it is one way."""
    if "x" in recording:
        speed = _speed(recording["x"], recording.rate)
        if _both_ways(speed) and _correlation(np.abs(speed), size) >= _PRIORS["correlation"]:
            return _fitted_signs(recording, speed, size), "the position's rate and the pressures"
        return None, ""
    if "u" not in recording or not _both_ways(recording["u"]):
        return None, ""
    tells = _correlation(np.abs(recording["u"]), size) >= _PRIORS["correlation"]
    return (np.where(recording["u"] < 0.0, -1.0, 1.0), "the command") if tells else (None, "")


def _speed(x: Array, rate: float) -> Array:
    half = max(1, round(_PRIORS["half"] * rate))
    known = np.isfinite(x)
    x = np.interp(np.arange(x.size), np.flatnonzero(known), x[known]) if known.any() else np.zeros(x.size)
    padded = np.concatenate([x[:1].repeat(half), x, x[-1:].repeat(half)])
    return np.asarray((padded[2 * half :] - padded[: -2 * half]) * (0.5 * rate / half))


def _both_ways(values: Array) -> bool:
    out, back = (float(np.nansum(np.maximum(way, 0.0))) for way in (values, -values))
    least: float = _PRIORS["least"]
    return min(out, back) > least * max(out, back) > 0.0


def _correlation(first: Array, second: Array) -> float:
    known = np.isfinite(first) & np.isfinite(second)
    if np.count_nonzero(known) < 3 or not (np.ptp(first[known]) > 0.0 and np.ptp(second[known]) > 0.0):
        return 0.0
    return float(np.corrcoef(first[known], second[known])[0, 1])


def _fitted_signs(recording: Recording, speed: Array, size: Array) -> Array:
    """Return the signs (n,) of a v + c (p_A - p_B), another `a` each way, fitted to the speed that they sign."""
    columns = [np.maximum(speed, 0.0), np.minimum(speed, 0.0)]
    if {"p_A", "p_B"} <= recording.channels.keys():
        columns.append(recording["p_A"] - recording["p_B"])
    design = np.column_stack(columns)
    known = np.isfinite(design).all(axis=1) & np.isfinite(size)
    scale = np.sqrt(np.mean(design[known] ** 2, axis=0))
    design = design / np.where(scale > 0.0, scale, 1.0)
    sign = np.where(speed < 0.0, -1.0, 1.0)
    for _ in range(_TURNS):
        fit = np.linalg.lstsq(design[known], (sign * size)[known], rcond=None)[0]
        fit = np.maximum(fit, 0.0)  # the pump makes good what leaks, and never adds to it
        predicted = np.where(known, design @ fit, speed)
        sign, before = np.where(predicted < 0.0, -1.0, 1.0), sign
        if np.array_equal(sign, before):
            break
    return sign
