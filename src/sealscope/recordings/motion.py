"""Motion of a machine in its readings: constant channels, held values, and the cycle of the duty.

A transducer's noise never stops: a value that stays unchanged for long is clipped, repeated or from a dead channel.
The duty's cycle is the period after which the command, or the pressure difference, repeats.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.channels import ROUNDING, Array, chambers_of, smallest_step
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.recording import Recording, compute_once

_HOLD = RECORDINGS.hold
#: Shortest run of equal values that can be stuck, and number of samples on either side with which it is compared.
_MIN_STUCK, _NEIGHBOURHOOD = 5, 100
_MAX_EXPECTED = 1e-6  # a run is stuck if fewer runs of its length than this are expected in the channel
_MIN_JUMP = 3.5  # smallest jump at an end of a stuck run, in quantisation steps: more than three


def is_constant(values: Array) -> bool:
    """Test whether all samples (n,), one or more, are equal; False if one is NaN or infinite."""
    return bool(np.ptp(values) == 0)


def is_moving(values: Array) -> bool:
    """Test whether a channel (n,) has no missing sample and at least two different values."""
    return values.size > 1 and bool(np.isfinite(values).all()) and not is_constant(values)


def find_holds(values: Array, rate: float) -> NDArray[np.bool_]:
    """Find the samples (n,) at which a pressure `values` repeats one value for longer than its noise allows.

    A run of equal samples is a hold if it is longer than both 1.5 s and 64 samples; a missing sample ends a run. The
    first sample of a hold is a reading and not flagged. `rate`: sampling rate [Hz].
    """
    max_length = max(round(_HOLD.seconds * rate), _HOLD.samples)
    edges = np.concatenate([[0], np.flatnonzero(values[1:] != values[:-1]) + 1, [len(values)]])
    lengths = np.diff(edges)
    is_hold = lengths > max_length
    flags = np.repeat(is_hold, lengths)
    flags[edges[:-1][is_hold]] = False
    return flags


def describe_hold(recording: Recording) -> str | None:
    """Describe a chamber pressure that does not move, although its noise should move it; None if there is none.

    Such a pressure repeats one value for too long (`find_holds`), or follows a straight line throughout. A pressure
    that is constant throughout (`quality.inspect` reports it), or has at most 64 samples, is skipped. No sample may be
    missing.
    """
    for name in chambers_of(recording):
        values = recording[name]
        if len(values) <= _HOLD.samples or is_constant(values):
            continue
        if len(holds := find_runs(find_holds(values, recording.rate))):
            first, length = holds[np.argmax(holds[:, 1])]  # the longest
            # the sample before the flagged ones is the reading that they repeat
            start, stop = (float(recording.t[k]) for k in (first - 1, first + length - 1))
            return f"{name} does not move from {start:.4g} s to {stop:.4g} s"
    return describe_line(recording)


def describe_line(recording: Recording) -> str | None:
    """Describe a chamber pressure that follows a straight line throughout, without noise; None if there is none.

    A pressure that is constant or has at most 64 samples is skipped, as in `describe_hold`.
    """
    for name in chambers_of(recording):
        values = recording[name]
        if len(values) <= _HOLD.samples or is_constant(values):
            continue
        if np.abs(np.diff(values, 2)).max() <= ROUNDING * np.abs(values).max():
            return f"{name} moves along a straight line only, as if its samples were interpolated"
    return None


def find_runs(flags: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Find the runs of True in `flags` (n,): first index and length of each (k, 2)."""
    padded = np.zeros(len(flags) + 2, dtype=bool)
    padded[1:-1] = flags
    edges = np.flatnonzero(padded[1:] != padded[:-1])  # starts and ends in turn
    return np.column_stack([edges[::2], edges[1::2] - edges[::2]])


def find_stuck(values: Array) -> NDArray[np.intp]:
    """Find runs of equal values that are too long for the signal around them: first index and length of each (k, 2).

    Let p be the fraction of samples that equal the previous one, among the 100 samples before or the 100 after the run,
    whichever is larger. By chance, a run of m equal samples begins at a given sample with the probability p^(m-1). A
    run is too long if fewer than 1e-6 such runs are expected in `values` (n,), all finite, and if the value jumps by
    more than 3.5 quantisation steps at one of its ends. The jump excludes a slow quantised signal, which changes in
    single steps. Runs of fewer than 5 samples, runs within 20 samples of an end of the channel, and runs in a channel
    of fewer than 200 samples are not found.
    """
    no_runs = np.empty((0, 2), dtype=np.intp)
    if values.size < 2 * _NEIGHBOURHOOD:
        return no_runs
    is_same = values[1:] == values[:-1]
    runs = find_runs(is_same)  # each is one shorter than the run of equal values
    runs = runs[runs[:, 1] >= _MIN_STUCK - 1]
    first, last = runs[:, 0], runs.sum(axis=1)  # the samples first..last are equal
    # runs near an end of the recording have too few neighbours
    inner = (first >= _NEIGHBOURHOOD // 5) & (last < values.size - 1 - _NEIGHBOURHOOD // 5)
    runs, first, last = runs[inner], first[inner], last[inner]
    if not runs.size:
        return no_runs
    n_unchanged = np.r_[0, np.cumsum(is_same)]

    def unchanged_fraction(begin: NDArray[Any], end: NDArray[Any]) -> Array:
        """Estimate the fraction of samples that equal the previous one in each range (k,) by the rule of succession."""
        begin, end = np.maximum(begin, 0), np.minimum(end, is_same.size)
        return np.asarray((n_unchanged[end] - n_unchanged[begin] + 1) / (end - begin + 2), dtype=np.float64)

    p_unchanged = np.maximum(
        unchanged_fraction(first - _NEIGHBOURHOOD, first), unchanged_fraction(last, last + _NEIGHBOURHOOD)
    )
    log_expected = np.log(values.size) + runs[:, 1] * np.log(p_unchanged)
    jump = np.maximum(np.abs(values[first] - values[first - 1]), np.abs(values[last + 1] - values[last]))
    is_stuck = (log_expected < np.log(_MAX_EXPECTED)) & (jump > 0.0)
    if is_stuck.any():
        is_stuck &= jump > _MIN_JUMP * smallest_step(np.unique(values))
    return np.column_stack([first[is_stuck], runs[is_stuck, 1] + 1])


_CYCLE = RECORDINGS.cycle
#: Fewest repetitions of a cycle, its shortest period [s], and fewest samples from which it is estimated.
_MIN_REPETITIONS, _MIN_PERIOD, _MIN_SAMPLES = 5, 0.2, 32
#: Peaks of the autocorrelation up to this much below the highest count as equally high, because of noise.
_EQUAL_PEAKS = 0.05


def find_cycle(recording: Recording) -> float | None:
    """Find the period [s] of the duty cycle, after which the machine's motion repeats; None if nothing repeats.

    The period is estimated from the command u if this moves and lacks no sample, else from p_A - p_B or the only
    chamber pressure. Also None if the recording has none of these channels. The result is cached with the recording.
    """
    names = ("u",) if "u" in recording and is_moving(recording["u"]) else chambers_of(recording)
    if not names:
        return None
    return compute_once(
        recording, "cycle", lambda part: estimate_period(duty_signal([part[name] for name in names]), part.rate), names
    )


def duty_signal(channels: Sequence[Array]) -> Array:
    """Compute the signal (n,) that shows the duty cycle: the only one of `channels` (n,), or p_A - p_B of two."""
    return channels[0] - channels[1] if len(channels) == 2 else channels[0]


def estimate_period(signal: Array, rate: float) -> float | None:
    """Estimate the period [s] of a signal (n,) sampled at `rate` [Hz]; None if nothing repeats.

    A signal of 100 Hz or more is first averaged to 50 to 75 Hz. The period is the lag of a peak of the autocorrelation,
    refined by a parabola. Peaks are searched for after the first negative value, and must reach 0.6 of the value at lag
    0. The first one that is at most 0.05 lower than the highest is taken. The period must be between 0.2 s and 20 s,
    and at most a fifth of the signal's duration. Also None for fewer than 32 averaged samples and for missing samples.
    """
    stride = max(1, int(rate / _CYCLE.rate))  # samples averaged to one, to save time
    n = signal.size // stride
    if n < _MIN_SAMPLES:
        return None
    resampled = signal[: n * stride].reshape(-1, stride).mean(axis=1)
    resampled = resampled - resampled.mean()
    if not np.any(resampled):  # constant
        return None
    spectrum = np.abs(np.fft.rfft(resampled, 2 * n)) ** 2  # with n zeros added: lags do not wrap around
    correlation = np.fft.irfft(spectrum)[:n] / np.arange(n, 0, -1)  # divided by the number of products at each lag
    correlation = correlation / correlation[0]
    max_lag = min(n // _MIN_REPETITIONS, int(_CYCLE.longest * rate / stride))
    negative = np.flatnonzero(correlation[:max_lag] < 0)  # none if a sample is missing, as then all lags are NaN
    if negative.size == 0:
        return None
    first = int(negative[0])  # beyond the peak at lag 0
    tail = correlation[first + 1 : max_lag - 1]
    peaks = np.flatnonzero((tail >= correlation[first : max_lag - 2]) & (tail > correlation[first + 2 : max_lag]))
    peaks = peaks[tail[peaks] >= _CYCLE.correlation]
    if peaks.size == 0:
        return None
    # the first of the nearly highest peaks: later ones are at multiples of the period
    first_high = peaks[tail[peaks] >= tail[peaks].max() - _EQUAL_PEAKS][0]
    k = int(first + 1 + first_high)
    left, peak, right = correlation[k - 1 : k + 2]  # left <= peak > right: the denominator below is not 0
    lag = (k + 0.5 * (left - right) / (left - 2 * peak + right)) * stride / rate  # vertex of the parabola through these
    return float(lag) if lag >= _MIN_PERIOD else None


def fundamental_frequency(signal: Array, t: Array, period: float) -> float:
    """Estimate the fundamental frequency [Hz] of a periodic signal (n,) from the slope of its phase over time.

    The signal, without its mean, is multiplied by exp(-2 pi i t/period) and averaged over each period. The phase of
    these averages changes at the rate 2 pi (f - 1/period), with the fundamental frequency f. `t` (n,): evenly spaced
    times [s]; `period` [s]: the approximate period, of which the signal must contain two or more.
    """
    n_period = max(1, round(period / (t[1] - t[0])))
    n_periods = t.size // n_period
    demodulated = (signal - signal.mean()) * np.exp(-2j * np.pi * t / period)
    phasors = demodulated[: n_periods * n_period].reshape(n_periods, n_period).mean(axis=1)  # one for each period
    times = t[: n_periods * n_period].reshape(n_periods, n_period).mean(axis=1)
    phase = np.unwrap(np.angle(phasors))
    slope, _ = np.polyfit(times, phase, 1, w=np.abs(phasors))  # the phase of a small average is uncertain
    return 1.0 / period + float(slope) / (2.0 * np.pi)
