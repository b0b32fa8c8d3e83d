"""The cycle of a duty: how long until the command, or the pressure difference, repeats."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.channels import Array
from sealscope.recordings.motion import moves
from sealscope.recordings.recording import Recording, remembered
from sealscope.storage.toml_file import priors_of

_CYCLE = priors_of("sealscope.recordings")["cycle"]


def find_cycle(recording: Recording) -> float | None:
    """Return the length of the duty's cycle [s], from the command or else from the pressures; None without a cycle.

    Computed once for a recording and what `Recording.only` makes of it. The command is used where it moves, else the
    pressure difference, else the only chamber pressure.
    """
    names = ("u",) if "u" in recording and moves(recording["u"]) else chambers_of(recording)

    def cycle(recording: Recording) -> float | None:
        signals = [recording[name] for name in names]
        return cycle_of(signals[0] - signals[1] if len(signals) == 2 else signals[0], recording.rate)

    return remembered(recording, "cycle", cycle, names) if names else None


def cycle_of(signal: Array, rate: float) -> float | None:
    """Return the period [s] of a signal (n,) sampled at `rate` [Hz]; None when nothing repeats.

    The first maximum of the autocorrelation after its first zero, at least 0.6 high, between 0.2 s and 20 s and
    repeated five times or more; refined by a parabola.
    """
    stride = max(1, int(rate / _CYCLE["rate"]))
    n = signal.size // stride
    if n < 32:
        return None
    slow = signal[: n * stride].reshape(-1, stride).mean(axis=1)
    slow = slow - slow.mean()
    if not np.any(slow):
        return None
    spectrum = np.abs(np.fft.rfft(slow, 2 * n)) ** 2
    correlation = np.fft.irfft(spectrum)[:n] / np.arange(n, 0, -1)
    correlation = correlation / correlation[0]
    longest = min(n // 5, int(_CYCLE["longest"] * rate / stride))
    below = np.flatnonzero(correlation[:longest] < 0)
    if below.size == 0:
        return None
    first = int(below[0])
    inner = correlation[first + 1 : longest - 1]
    peaks = np.flatnonzero((inner >= correlation[first : longest - 2]) & (inner > correlation[first + 2 : longest]))
    peaks = peaks[inner[peaks] >= _CYCLE["correlation"]]
    if peaks.size == 0:
        return None
    best = peaks[inner[peaks] >= inner[peaks].max() - 0.05][0]
    k = int(first + 1 + best)
    a, b, c = correlation[k - 1 : k + 2]
    lag = (k + 0.5 * (a - c) / (a - 2 * b + c)) * stride / rate
    return float(lag) if lag >= 0.2 else None


def fundamental(signal: Array, t: Array, cycle: float) -> float:
    """Return the fundamental frequency [Hz] of a signal (n,) at even instants `t` (n,) [s]: the slope of its phase.

    `cycle` [s]: about how long its cycle is (`cycle_of`), of which there must be two or more.
    """
    size = max(1, round(cycle / (t[1] - t[0])))
    count = t.size // size
    turned = (signal - signal.mean()) * np.exp(-2j * np.pi * t / cycle)
    phasors = turned[: count * size].reshape(count, size).mean(axis=1)
    phase = np.unwrap(np.angle(phasors))
    slope = np.polyfit(t[: count * size].reshape(count, size).mean(axis=1), phase, 1, w=np.abs(phasors))[0]
    return 1.0 / cycle + float(slope) / (2.0 * np.pi)
