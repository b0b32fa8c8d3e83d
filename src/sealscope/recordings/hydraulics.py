"""Check that readings can come from a hydraulic machine: no mere noise, no copied channel, no wrong unit of time."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.chambers import CHAMBERS, chambers_of
from sealscope.recordings.channels import UNUSED, Array
from sealscope.recordings.motion import is_constant
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.recording import Recording

_PRIORS = RECORDINGS.readings
#: Largest difference of a copied channel, by rounding, as a fraction of its standard deviation.
_COPY_TOLERANCE = 1e-6


def find_implausibility(recording: Recording) -> str | None:
    """Find a reason, in words, why the channels cannot come from one hydraulic machine; None if there is none.

    They cannot if p_B is a copy of p_A, if the motor speed differs from the rate of the motor angle by a constant
    factor, if p_A - p_B (or the only chamber pressure that varies) is nothing but noise, or if pressures in Pa stay
    below `readings.pressure` of `priors.toml`, as those of another unit would. Raw counts may have any offset and
    range. Constant and absent channels are ignored, as a chamber may rest at charge pressure.
    """
    # the third difference of `_is_noise` needs four samples
    names = [name for name in chambers_of(recording) if len(recording) > 3 and not is_constant(recording[name])]
    signals = {name: recording[name] for name in names}
    if len(names) == 2:
        signals["p_A - p_B"] = difference = signals["p_A"] - signals["p_B"]
        if np.std(difference) <= _COPY_TOLERANCE * max(np.std(signals[name]) for name in CHAMBERS):
            return "p_B is a copy of p_A, but chambers on either side of a piston move against each other"
    if reason := _describe_speed_mismatch(recording):
        return reason
    pressures = [np.abs(recording[name]).max() for name in names if recording.units[name] == "Pa"]
    if pressures and max(pressures) < _PRIORS.pressure:
        return f"the pressures stay below {max(pressures):.3g} Pa: is their unit right?"
    noise_tested = "p_A - p_B" if len(names) == 2 else next(iter(names), "")
    if noise_tested and _is_noise(signals[noise_tested], is_zero_known=len(names) == 2):
        return f"{noise_tested} is noise: the machine's motion does not show in it"
    return None


def _describe_speed_mismatch(recording: Recording) -> str | None:
    """Describe a motor speed that is a constant factor off the rate of the motor angle, as a wrong unit would cause.

    Returns None if the least-squares factor is between 1 / m and m, with m = `readings.misfit` of `priors.toml`, if the
    two do not correlate or are in raw counts, or if samples are missing.
    """
    if not {"theta", "omega"} <= {name for name, unit in recording.units.items() if unit != "count"}:
        return None
    n_mean = max(1, round(recording.rate / _PRIORS.rate))  # samples averaged to one, against noise
    n_samples = len(recording) // n_mean * n_mean
    theta, omega = (recording[name][:n_samples].reshape(-1, n_mean).mean(axis=1) for name in ("theta", "omega"))
    if theta.size < _PRIORS.samples or not np.isfinite(theta + omega).all():
        return None
    turning_rate = np.gradient(theta, n_mean / recording.rate)
    product, square = abs(float(turning_rate @ omega)), float(turning_rate @ turning_rate)  # the sign does not matter
    ratio = product / max(square, np.finfo(float).tiny)  # least-squares scale of the speed
    is_correlated = product >= _PRIORS.correlation * np.sqrt(square * float(omega @ omega)) > 0.0
    if not is_correlated or 1.0 / _PRIORS.misfit <= ratio <= _PRIORS.misfit:
        return None
    return f"the speed is {ratio:.3g} times that at which the angle turns: is the unit of the time right?"


def _is_noise(values: Array, is_zero_known: bool) -> bool:
    """Test whether a signal (n,) is mostly white noise, or has missing samples.

    White noise must have more than the fraction `readings.noise` (`priors.toml`) of the signal's variance, or of its
    mean square with `is_zero_known`: zero then means no load, so that a constant load is a signal. The mean square of
    the third difference of white noise is 20 times its variance.
    """
    power = np.mean(values**2) if is_zero_known else np.var(values)
    # `not <=`, so that missing samples count as noise
    return not np.mean(np.diff(values, 3) ** 2) <= 20.0 * _PRIORS.noise * power


def describe_missing_chambers(recording: Recording) -> str | None:
    """Report that a recording has no chamber pressure, and name its file's unused columns; None if it has one."""
    if chambers_of(recording):
        return None
    unused = [line for line in recording.history if line.startswith(UNUSED)]
    return "; ".join(["needs the pressure of a chamber (p_A or p_B)", *unused])
