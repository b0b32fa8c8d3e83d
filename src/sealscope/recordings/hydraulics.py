"""Check that readings can come from a hydraulic machine: no mere noise, no copied channel, no wrong units."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.channels import CHAMBERS, COUNTS, UNUSED, Array, chambers_of
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.proposal import is_pressure
from sealscope.recordings.motion import is_constant
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.recording import Recording

_PRIORS = RECORDINGS.readings
_COPY_TOLERANCE = 1e-6  # largest difference of a copied channel, by rounding, as a fraction of its standard deviation


def find_implausibility(recording: Recording) -> str | None:
    """Find a reason, in words, why the channels cannot come from one hydraulic machine; None if there is none.

    There are four such reasons:

    - p_B is a copy of p_A, up to a constant.
    - The motor speed differs from the rate of the motor angle by a large constant factor.
    - Pressures in Pa stay below `readings.pressure` of `priors.toml`, as those in another unit would.
    - p_A - p_B, or the only chamber pressure that varies, is nothing but noise.

    Constant and absent channels are ignored: a chamber may rest at charge pressure. Raw counts may have any range. The
    chamber pressures must have no missing samples, which would count as noise.
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
    """Describe the factor between the motor speed and the rate of the motor angle if a unit seems to be wrong.

    Speed and angle are averaged to `readings.rate` of `priors.toml`. Returns None if the least-squares factor is
    between 1 / m and m, with m = `readings.misfit`. Also None if the speed hardly correlates with the rate of the
    angle, if either channel is absent or in raw counts, or if averages are missing or fewer than `readings.samples`.
    """
    if not {"theta", "omega"} <= {name for name, unit in recording.units.items() if unit != COUNTS}:
        return None
    n_mean = max(1, round(recording.rate / _PRIORS.rate))  # samples averaged to one, against noise
    n_samples = len(recording) // n_mean * n_mean
    theta, omega = (recording[name][:n_samples].reshape(-1, n_mean).mean(axis=1) for name in ("theta", "omega"))
    if theta.size < _PRIORS.samples or not np.isfinite(theta + omega).all():
        return None
    turning_rate = np.gradient(theta, n_mean / recording.rate)
    product, square = abs(float(turning_rate @ omega)), float(turning_rate @ turning_rate)  # a unit changes no sign
    ratio = product / max(square, np.finfo(float).tiny)  # least-squares scale of the speed
    is_correlated = product >= _PRIORS.correlation * np.sqrt(square * float(omega @ omega)) > 0.0
    if not is_correlated or 1.0 / _PRIORS.misfit <= ratio <= _PRIORS.misfit:
        return None
    return f"the speed is {ratio:.3g} times that at which the angle turns: is the unit of the time right?"


def _is_noise(values: Array, is_zero_known: bool) -> bool:
    """Test whether a signal (n,) is mostly white noise (`readings.noise` of `priors.toml`), or has missing samples.

    With `is_zero_known`, i.e. for p_A - p_B, zero means no load, and the mean square is taken instead of the variance:
    then a constant load is a signal. A single pressure has the charge pressure as an offset.
    """
    power = np.mean(values**2) if is_zero_known else np.var(values)
    # the third difference of white noise has 20 times its variance; `not <=`: missing samples count as noise
    return not np.mean(np.diff(values, 3) ** 2) <= 20.0 * _PRIORS.noise * power


def describe_missing_chambers(recording: Recording) -> str | None:
    """Describe the lack of a chamber pressure, with the file's unused columns; None if there is a chamber pressure."""
    if chambers_of(recording):
        return None
    unused = [line for line in recording.history if line.startswith(UNUSED)]
    pressures = [name for name in recording.unused if is_pressure(Label.parse(name))]
    maps = [f"--map '{channel}={name}'" for channel, name in zip(("p_A", "p_B"), pressures, strict=False)]
    hint = f", such as by {' '.join(maps)}" if maps else ""
    return "; ".join([f"needs the pressure of a chamber (p_A or p_B){hint}", *unused])
