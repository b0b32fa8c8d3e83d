"""Whether readings can be those of a hydraulic machine: what every one shows, leaking or not, before any verdict.

Chamber pressures of a machine that moves have a size (friction sets it), swing more slowly than they are sampled,
differ between the chambers, and follow the command or the motion. Noise in their place, a copy of one in the other's
channel, a wrong unit or a wrong time unit lack one of these.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from sealscope.recordings.chambers import CHAMBERS, chambers_of
from sealscope.recordings.channels import UNUSED, Array
from sealscope.recordings.motion import constant
from sealscope.recordings.recording import Recording

#: What a chamber holds [Pa], gauge or absolute: not under an absolute vacuum and its sensor's error, not over 2000 bar.
LOWEST, HIGHEST = -2e5, 2e8
#: Least rms of the swing [Pa]: a hundredth of what a cylinder without load and with a light seal needs.
LEAST_SWING = 100.0
#: Share of white noise in a pressure or in the pressure difference over which nothing else is in it.
MOST_NOISE = 0.5
#: A copy differs by less than this share of the swing.
_COPY = 1e-6
_COPIED = "p_B is a copy of p_A, but chambers on either side of a piston move against each other"
#: Correlation at some delay from which a slow signal follows another one; and what independent noise reaches, over the
#: root of the number of slow samples.
LEAST_CORRELATION, _BY_CHANCE = 0.1, 5.0
#: Rate of the slow signals [Hz], longest delay [s], fewest samples.
_SLOW, _DELAY, _FEWEST = 20.0, 5.0, 400
#: Slow samples whose mean makes a step: noise hides the motion of a machine that is slow against its sampling.
_SCALES = (1, 4, 16)
#: Past values by which a slow pressure difference is foretold: a load that swings, even at two rates, takes four.
_PAST = 4
#: Angle and speed fit where the one's rate is so many times the other at most.
_MISFIT, _BELONGS = 5.0, 0.5


def no_readings(recording: Recording) -> str | None:
    """Return why a balance of volumes cannot take the pressures of a recording, None where it can.

    It needs no heed of their unit, zero and range, nor of how they follow one another: noise, a copy in the other's
    channel, or a wrong unit of the time are in its way.
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


def no_machine(recording: Recording) -> str | None:
    """Return why a recording without missing pressures is not one of a hydraulic machine, None where it may be.

    A channel that is constant or absent is no reason: others report it.
    """
    names = [name for name in chambers_of(recording) if len(recording) > 3 and not constant(recording[name])]
    signals = _signals(recording, names)
    if _copied(signals):
        return _COPIED
    with np.errstate(all="ignore"):
        return _out_of_range(recording, signals) or _time(recording) or _noise(signals) or _aside(recording, names)


def _out_of_range(recording: Recording, signals: Mapping[str, Array]) -> str | None:
    for name, values in signals.items():
        if any(recording.units[chamber] != "Pa" for chamber in chambers_of(recording)):
            return None
        swing = float(np.std(values))
        if not swing >= LEAST_SWING:
            return (
                f"{name} swings by {swing:.3g} Pa rms, less than the friction of any piston takes: is its unit right?"
            )
        low, high = float(values.min()), float(values.max())
        if name in CHAMBERS and not (low >= LOWEST and high <= HIGHEST):
            return f"{name} lies between {low:.3g} and {high:.3g} Pa, which no chamber holds: is its unit right?"
    return None


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


def _aside(recording: Recording, names: list[str]) -> str | None:
    """Say where the pressures follow neither each other, nor, as their difference, the command or a recorded motion."""
    if len(names) < 2:
        return None
    p_A, p_B = (_slow(recording[name], recording.rate) for name in CHAMBERS)
    if p_A.size < _FEWEST:
        return None
    delay = round(_DELAY * min(recording.rate, _SLOW))
    steps = ([np.diff(_slow(values, every, 1.0)) for values in (p_A, p_B)] for every in _SCALES)
    if not any(_follows(a, b, delay) for a, b in steps if a.size >= 0.25 * _FEWEST):
        return "p_A and p_B have nothing to do with each other: they are not of one machine"
    dp, moved = p_A - p_B, []
    whitening = _whitening(dp)
    for name in ("u", "omega", "theta", "x"):
        if name not in recording or not np.isfinite(recording[name]).all() or constant(recording[name]):
            continue
        other = _slow(recording[name], recording.rate)
        motion = np.gradient(other) if name in ("theta", "x") else other
        if _follows(dp, motion, delay) or _turns_with(dp, motion, whitening, delay):
            return None
        moved.append(name)
    if not moved:
        return None
    return f"the pressure difference p_A - p_B does not follow {', '.join(moved)}: they are not of one machine"


def _whitening(values: Array) -> Array:
    """Return the filter (`_PAST` + 1,) that leaves of a series (n,) what its past does not foretell (least squares)."""
    series = values - values.mean()
    past = np.lib.stride_tricks.sliding_window_view(series, _PAST)[:-1, ::-1]
    weights, *_ = np.linalg.lstsq(past, series[_PAST:], rcond=None)
    return np.concatenate([[1.0], -weights])


def _turns_with(dp: Array, motion: Array, whitening: Array, delay: int) -> bool:
    """Return whether what its past does not foretell of a pressure difference follows the sense of a motion, (n,) both.

    A load that swings may be ten times the friction, and moves otherwise than the piston: then the pressure difference
    does not follow the motion, but where the piston turns, friction turns with it. Both series go through the filter
    that whitens the first (Box, Jenkins, Time Series Analysis, 1976, section 11.2.1); correlation in both halves.
    """
    pressure, sense = (np.convolve(values, whitening, "valid") for values in (dp - dp.mean(), np.sign(motion)))
    return min(_by_halves(pressure, sense, delay)) >= _needed(dp.size)


def _follows(a: Array, b: Array, delay: int) -> bool:
    """Return whether two series (n,) follow each other in either half, in whichever sense."""
    return max(_by_halves(a, b, delay)) >= _needed(a.size)


def _by_halves(a: Array, b: Array, delay: int) -> list[float]:
    half = a.size // 2
    return [_correlation(a[part], b[part], delay) for part in (slice(half), slice(half, None))]


def _needed(size: int) -> float:
    """Return the correlation that halves of series of so many samples need."""
    return max(LEAST_CORRELATION, _BY_CHANCE / math.sqrt(size // 2))


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
