"""The duty cycle of a machine: the period after which its command, or its pressure difference, repeats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sealscope.recordings.channels import Array, chambers_of
from sealscope.recordings.motion import is_moving
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.recording import Recording, compute_once

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
