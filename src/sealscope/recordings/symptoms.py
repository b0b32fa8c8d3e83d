"""What can be seen in the values of one channel, each by a test that quantised, slow and resting signals pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.motion import runs_of, spacing
from sealscope.recordings.recording import Array

_FEWEST_AT_RAIL = 5
_LONG_RUN = 20
_HUM_BAND = 5.0
_HUM_POWER_FROM = 20.0
_HUM_OVER_REST = 4.0
_HUM_OVER_FLOOR = 10.0


class Holes(NamedTuple):
    """Missing samples: how many, where first, runs, the longest; `every`: k where only each k-th row has one."""

    samples: int
    first: int
    runs: int
    longest: int
    every: int


class Rail(NamedTuple):
    """Samples at one end of a clipped channel: `low` or `high` side, the value there, how many, where first."""

    side: str
    value: float
    samples: int
    first: int


class Line(NamedTuple):
    """A spectral line: frequency [Hz], amplitude [the channel's unit], its share of the power over 20 Hz."""

    frequency: float
    amplitude: float
    share: float


def missing(values: Array) -> Holes | None:
    """NaN samples, and whether they are a slower channel's rows in between."""
    absent = np.isnan(values)
    if not absent.any():
        return None
    runs = runs_of(absent)
    present = np.flatnonzero(~absent)
    every = 0
    if present.size >= 3:
        spacing = np.diff(present)
        usual = int(np.median(spacing))
        if usual >= 2 and np.mean(spacing == usual) > 0.95:
            every = usual
    return Holes(int(absent.sum()), int(runs[0, 0]), len(runs), int(runs[:, 1].max()), every)


def infinite(values: Array) -> NDArray[np.intp]:
    """Indices of infinite samples."""
    return np.flatnonzero(np.isinf(values))


def clipped(values: Array, still: NDArray[np.intp], low: bool = True) -> list[Rail]:
    """The ends at which values are cut off.

    A cut-off piles up at its value what lay beyond: far more samples than any of the five levels next to it, in runs
    that the signal enters or leaves by more than three quantisation steps (one, for a long run). The crest of a slow
    quantised signal also holds many samples, but its neighbours hold nearly as many and it is entered step by step; a
    channel that rests at two levels, such as a square wave, has as many samples at the other. A run among `still`, as
    `stuck` gives them, that stands at an end of the values is a cut-off too.
    """
    levels, counts = np.unique(values, return_counts=True)
    if levels.size < 3:
        return []
    fine = spacing(levels)
    found = []
    for side, top, others in (("high", -1, slice(-6, -1)), ("low", 0, slice(1, 6))):
        if side == "low" and not low:
            continue
        runs = runs_of(values == levels[top])
        first, length = runs[np.argmax(runs[:, 1])]
        before, after = values[max(first - 1, 0)], values[min(first + length, values.size - 1)]
        drop = max(abs(before - levels[top]), abs(after - levels[top]))
        piled = counts[top] >= _FEWEST_AT_RAIL and counts[top] > 5 * counts[others].max()
        if (piled and length >= 3 and drop > (1.5 if length >= _LONG_RUN else 3.5) * fine) or (
            values[still[:, 0]] == levels[top]
        ).any():
            found.append(Rail(side, float(levels[top]), int(counts[top]), int(runs[0, 0])))
    return found


def hum(values: Array, rate: float) -> list[Line]:
    """Lines of the mains, 50 or 60 Hz, that stand clear of the spectrum within 5 Hz.

    Hann-windowed periodogram of the values less their straight line; the amplitude of a line is 2 |X| / sum(w). Clear
    means 10 times the median and 4 times the largest of what lies beside it. Nothing is looked for in under 1.5 s.
    """
    count = values.size
    if count / rate < 1.5:
        return []
    x = np.arange(count) - (count - 1) / 2
    centred = values - values.mean()
    centred = centred - x * (x @ centred) / (x @ x)
    if not centred.any():
        return []
    window = np.hanning(count)
    size = _smooth_size(count)
    amplitudes = 2 * np.abs(np.fft.rfft(centred * window, size)) / window.sum()
    frequencies = np.fft.rfftfreq(size, 1 / rate)
    # amplitude^2/2 summed over bins counts each line's power 1.5 size/count times, as wide as Hann's window makes it
    power = float((amplitudes[frequencies >= _HUM_POWER_FROM] ** 2).sum()) / 2 / (1.5 * size / count)
    lines = []
    for mains in (50.0, 60.0):
        if mains + _HUM_BAND >= rate / 2:
            continue
        off = np.abs(frequencies - mains)
        near = off <= max(0.1, 0.5 * rate / count)
        beside = (off > max(0.5, 2.5 * rate / count)) & (off <= _HUM_BAND)
        peak, rest = float(amplitudes[near].max(initial=0.0)), amplitudes[beside]
        if rest.size >= 10 and peak > _HUM_OVER_REST * rest.max() and peak > _HUM_OVER_FLOOR * np.median(rest):
            lines.append(Line(mains, peak, min(1.0, peak**2 / 2 / power)))
    return lines


def _smooth_size(count: int) -> int:
    """The least 2^a 3^b 5^c >= count: a transform of a prime length takes many times as long."""
    best = 1 << (count - 1).bit_length()
    five = 1
    while five < best:
        three = five
        while three < best:
            two = three << max(0, (-(-count // three) - 1).bit_length())
            best = min(best, two)
            three *= 3
        five *= 5
    return best
