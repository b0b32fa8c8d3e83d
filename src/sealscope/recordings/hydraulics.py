"""Whether readings can be those of a hydraulic machine: noise, a copied channel or a wrong unit of time cannot."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.chambers import CHAMBERS, chambers_of
from sealscope.recordings.channels import UNUSED, Array
from sealscope.recordings.motion import constant
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import priors_of

_PRIORS = priors_of("sealscope.recordings")["readings"]
#: Share of its swing by which a copy differs, of rounding.
_COPY = 1e-6


def no_readings(recording: Recording) -> str | None:
    """Return why pressures and speed are no readings of one machine, None where they may be.

    White noise has third differences of 20 times its variance. One chamber alone may rest at the charge pressure, as in
    a lift: what drives a leak, p_A - p_B, must move. Unit, zero and range of the pressures do not matter; a constant or
    absent channel is no reason.
    """
    names = [name for name in chambers_of(recording) if len(recording) > 3 and not constant(recording[name])]
    signals = {name: recording[name] for name in names}
    if len(names) == 2:
        signals["p_A - p_B"] = difference = signals["p_A"] - signals["p_B"]
        if np.std(difference) <= _COPY * max(np.std(signals[name]) for name in CHAMBERS):
            return "p_B is a copy of p_A, but chambers on either side of a piston move against each other"
    if {"theta", "omega"} <= {name for name, unit in recording.units.items() if unit != "count"}:
        every = max(1, round(recording.rate / _PRIORS["rate"]))
        theta, omega = (_means(recording[name], every) for name in ("theta", "omega"))
        if theta.size >= _PRIORS["samples"] and np.isfinite(theta + omega).all():
            turned = np.gradient(theta, every / recording.rate)
            product, square = abs(float(turned @ omega)), float(turned @ turned)
            factor = product / max(square, np.finfo(float).tiny)
            correlated = product >= _PRIORS["correlation"] * np.sqrt(square * float(omega @ omega)) > 0.0
            if correlated and not 1.0 / _PRIORS["misfit"] <= factor <= _PRIORS["misfit"]:
                return f"the speed is {factor:.3g} times that at which the angle turns: is the unit of the time right?"
    driving = "p_A - p_B" if len(names) == 2 else next(iter(names), "")
    if driving and _is_noise(signals[driving]):
        return f"{driving} is noise: the machine's motion does not show in it"
    return None


def _is_noise(values: Array) -> bool:
    return not np.mean(np.diff(values, 3) ** 2) <= 20.0 * _PRIORS["noise"] * np.var(values)


def _means(values: Array, every: int) -> Array:
    return np.asarray(values[: values.size // every * every].reshape(-1, every).mean(axis=1))


def lack_of_chambers(recording: Recording) -> str | None:
    """Describe a lack of chamber pressures, with the unused columns and a map that would read them; None otherwise."""
    if chambers_of(recording):
        return None
    unused = [line for line in recording.history if line.startswith(UNUSED)]
    return "; ".join(["needs the pressure of a chamber (p_A or p_B)", *unused])
