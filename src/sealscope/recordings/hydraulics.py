"""Whether readings can be those of a hydraulic machine: what every one shows, leaking or not, before any verdict.

Chamber pressures of a machine that moves swing more slowly than they are sampled and differ between the chambers, and
angle and speed belong together. Noise in their place, a copy of one in the other's channel, or a wrong unit of the time
lack one of these: the sensor is not connected, or the file is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sealscope.recordings.chambers import CHAMBERS, chambers_of
from sealscope.recordings.channels import UNUSED, Array
from sealscope.recordings.motion import constant
from sealscope.recordings.recording import Recording

#: Share of white noise in a pressure or in the pressure difference over which nothing else is in it.
MOST_NOISE = 0.5
#: A copy differs by less than this share of the swing.
_COPY = 1e-6
_COPIED = "p_B is a copy of p_A, but chambers on either side of a piston move against each other"
#: Rate of the slow signals [Hz], and their fewest samples.
_SLOW, _FEWEST = 20.0, 400
#: Angle and speed fit where the one's rate is so many times the other at most.
_MISFIT, _BELONGS = 5.0, 0.5


def no_readings(recording: Recording) -> str | None:
    """Return why the pressures of a recording are no readings of a machine, None where they may be.

    Their unit, zero and range do not matter, nor how they follow one another. A channel that is constant or absent is
    no reason: others report it.
    """
    names = [name for name in chambers_of(recording) if len(recording) > 3 and not constant(recording[name])]
    signals = _signals(recording, names)
    if _copied(signals):
        return _COPIED
    with np.errstate(all="ignore"):
        return _time(recording) or _noise(signals)


def _signals(recording: Recording, names: Sequence[str]) -> dict[str, Array]:
    signals = {name: recording[name] for name in names}
    if len(names) == 2:
        signals["p_A - p_B"] = signals["p_A"] - signals["p_B"]
    return signals


def _copied(signals: Mapping[str, Array]) -> bool:
    difference = signals.get("p_A - p_B")
    return difference is not None and bool(
        np.std(difference) <= _COPY * max(np.std(signals[name]) for name in CHAMBERS)
    )


def _noise(signals: Mapping[str, Array]) -> str | None:
    """Say which signal is white noise: its third differences, of 20 times the variance of such noise, are all of it."""
    for name, values in signals.items():
        share = float(np.mean(np.diff(values, 3) ** 2)) / 20.0 / float(np.var(values))
        if not share <= MOST_NOISE:
            return f"{name} is noise: the machine's motion does not show in it"
    return None


def _slow(values: Array, rate: float, slow: float = _SLOW) -> Array:
    """Return means (k,) of values (n,) sampled at `rate`, as many in a second as `slow` or fewer."""
    every = max(1, round(rate / slow))
    return np.asarray(values[: values.size // every * every].reshape(-1, every).mean(axis=1))


def _correlation(a: Array, b: Array, most: int) -> float:
    """Return the largest correlation of two series (n,), either sign, at a delay of at most so many samples."""
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    if not size > 0:
        return 0.0
    length = 1 << (2 * a.size - 1).bit_length()
    products = np.fft.irfft(np.fft.rfft(a, length) * np.conj(np.fft.rfft(b, length)), length)
    near = np.concatenate([products[: most + 1], products[-most:]])
    return float(np.abs(near).max()) / size


def _time(recording: Recording) -> str | None:
    """Say by how much angle and speed, which belong together, differ in time."""
    if any(name not in recording or recording.units[name] == "count" for name in ("theta", "omega")):
        return None
    theta, omega = (_slow(recording[name], recording.rate) for name in ("theta", "omega"))
    if theta.size < _FEWEST or not np.isfinite(theta + omega).all():
        return None
    every = max(1, round(recording.rate / _SLOW))
    turned = np.gradient(theta, every / recording.rate)
    factor = abs(float(turned @ omega)) / max(float(turned @ turned), np.finfo(float).tiny)
    if _correlation(turned, omega, 1) < _BELONGS or 1.0 / _MISFIT <= factor <= _MISFIT:
        return None
    return f"the speed is {factor:.3g} times that at which the angle turns: is the unit of the time right?"


def lack_of_chambers(recording: Recording) -> str | None:
    """Return that a recording has no chamber pressure, and which columns of its file were not used; None where it has.

    What the names of those columns tell stands in the same line, as the `--map` that would read them.
    """
    if chambers_of(recording):
        return None
    unused = [line for line in recording.history if line.startswith(UNUSED)]
    return "; ".join(["needs the pressure of a chamber (p_A or p_B)", *unused])
