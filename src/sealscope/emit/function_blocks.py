"""Kernels of three function blocks beside the estimator: a hold test, an alarm with a delay, and a recorder.

Each works on a record of its own, and is called once in each cycle of a controller.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sealscope.compiled import law
from sealscope.diagnosis.estimate.population import BOUND_PROBABILITY

#: Most means that a hold test keeps; as many are left when pairs of them are joined, each of twice the length.
N_MEANS = 32
#: Least number of means for a result, and of those that the noise is estimated from.
_LEAST_MEANS = 8
#: Results of a hold test: undecided, pass, fail.
UNDECIDED, PASS, FAIL = 0, 1, 2
#: State of the alarm block, with the status words of NAMUR NE 107.
GOOD, WARNING, ALARM = 0, 1, 2
NE_GOOD, NE_FAILURE, NE_CHECK, NE_OUT_OF_SPECIFICATION, NE_MAINTENANCE = 0, 1, 2, 3, 4
#: Samples of the recorder, and how many after the trigger.
N_RECORDED, N_AFTER = 2048, 512

HOLD_LAYOUT = np.dtype(
    [
        *((name, "i8") for name in ("n_means", "length", "n_in_mean", "result")),
        *((name, "f8") for name in ("total", "creep", "creep_low", "creep_high", "leak", "leak_low", "leak_high")),
        *((name, "f8") for name in ("seconds", "seconds_needed")),
        ("means", "f8", (N_MEANS,)),
    ]
)
ALARM_LAYOUT = np.dtype([(name, "i8") for name in ("level", "n_above_warning", "n_above_alarm", "latched", "status")])
RECORDER_LAYOUT = np.dtype(
    [*((name, "i8") for name in ("next", "n_stored", "n_after", "frozen")), ("samples", "f8", (4, N_RECORDED))]
)


def _student_quantiles() -> tuple[float, ...]:
    """Compute Student's t of a 95 % interval for 1, 2, ... degrees of freedom, up to those of a hold test."""
    from scipy.special import stdtrit

    return tuple(float(stdtrit(n, 0.5 + 0.5 * BOUND_PROBABILITY)) for n in range(1, N_MEANS))


_QUANTILES = _student_quantiles()


@law
def start_hold(m: Any) -> None:
    """Begin a hold test."""
    m.n_means = m.n_in_mean = m.result = 0
    m.length = 1
    m.total = m.creep = m.creep_low = m.creep_high = m.leak = m.leak_low = m.leak_high = 0.0
    m.seconds = m.seconds_needed = 0.0


@law
def add_hold_sample(m: Any, x: float, rate: float, area: float, most_creep: float) -> None:
    """Add a position x [m] of the held load to a hold test.

    `rate` [Hz]: calls a second; `area` [m^2]: of the loaded side; `most_creep` [m/s]: the limit, 0 for none. The
    samples are summed to at most `N_MEANS` means. Creep is the slope of a line through them; its interval is Student's,
    with the variance of the means inflated by their autocorrelation. The test passes if the whole interval is within
    the limit, and fails if it is outside (ISO 14253-1).
    """
    if not abs(x) < 1e30:
        return
    m.total += x
    m.n_in_mean += 1
    m.seconds += 1.0 / rate
    if m.n_in_mean < m.length:
        return
    m.means[int(m.n_means)] = m.total / m.length
    m.n_means += 1
    m.n_in_mean = 0
    m.total = 0.0
    if m.n_means == N_MEANS:
        for k in range(N_MEANS // 2):
            m.means[k] = 0.5 * (m.means[2 * k] + m.means[2 * k + 1])
        m.n_means = N_MEANS // 2
        m.length *= 2
    if m.n_means >= _LEAST_MEANS:
        _fit_creep(m, rate, area, most_creep)


@law
def _fit_creep(m: Any, rate: float, area: float, most_creep: float) -> None:
    """Fit a line through the means, and decide."""
    n, spacing = int(m.n_means), m.length / rate
    middle, mean = 0.5 * (n - 1.0), 0.0
    for k in range(n):
        mean += m.means[k] / n
    product = square = 0.0
    for k in range(n):
        product += (k - middle) * (m.means[k] - mean)
        square += (k - middle) * (k - middle)
    slope = product / square  # [m] a mean
    residual_square = neighbours = before = 0.0
    for k in range(n):
        residual = m.means[k] - mean - slope * (k - middle)
        residual_square += residual * residual
        neighbours += residual * before
        before = residual
    correlation = neighbours / residual_square if residual_square > 0.0 else 0.0
    correlation = min(max(correlation + 2.0 / n, 0.0), 0.9)  # + 2/n: the bias of a fitted line's residuals
    inflation = (1.0 + correlation) / (1.0 - correlation)
    # a position that rests on one count of its encoder shows no noise: its line is known to a tenth of the last change
    deviation = math.sqrt(max(residual_square / (n - 2.0) * inflation, 1e-24) / square)
    half_width = _QUANTILES[n - 3] * deviation
    m.creep, m.creep_low, m.creep_high = slope / spacing, (slope - half_width) / spacing, (slope + half_width) / spacing
    m.leak, m.leak_low, m.leak_high = area * m.creep, area * m.creep_low, area * m.creep_high
    m.result, m.seconds_needed = UNDECIDED, 0.0
    if most_creep > 0.0:
        least = max(m.creep_low, -m.creep_high, 0.0)  # of the magnitude of creep
        most = max(abs(m.creep_low), abs(m.creep_high))
        if most <= most_creep:
            m.result = PASS
        elif least > most_creep:
            m.result = FAIL
        else:
            # at the limit itself no test decides: four times as narrow an interval is asked for at most
            distance = max(abs(abs(m.creep) - most_creep), 0.25 * half_width / spacing)
            # the interval narrows with the time to the power 3/2
            m.seconds_needed = m.seconds * (math.exp(math.log(half_width / spacing / distance) / 1.5) - 1.0)
            m.seconds_needed = max(m.seconds_needed, 0.0)


@law
def start_alarm(m: Any) -> None:
    """Begin without an alarm."""
    m.level = m.n_above_warning = m.n_above_alarm = m.latched = m.status = 0


@law
def add_alarm_sample(
    m: Any, leak: float, valid: bool, acknowledge: bool, warning: float, alarm: float, hysteresis: float, delay: int
) -> None:
    """Compare a leak with the limits of a warning and of an alarm.

    All are in the same unit; `hysteresis` is a share of a limit, `delay` a number of calls. A level is reached after
    `delay` calls above its limit, and left below the limit less the hysteresis. An alarm stays until it is
    acknowledged, and comes back while the leak is above its limit.
    """
    if not valid:
        m.n_above_warning = m.n_above_alarm = 0
        m.status = NE_MAINTENANCE if m.latched == 1 else NE_CHECK
        return
    m.n_above_warning = min(m.n_above_warning + 1, delay) if leak > warning else 0
    m.n_above_alarm = min(m.n_above_alarm + 1, delay) if leak > alarm else 0
    if m.n_above_alarm >= delay and leak > alarm:
        m.level = ALARM
        m.latched = 1
    elif m.level == ALARM and leak < alarm * (1.0 - hysteresis):
        m.level = WARNING
    if m.level == GOOD and m.n_above_warning >= delay and leak > warning:
        m.level = WARNING
    if m.level == WARNING and leak < warning * (1.0 - hysteresis):
        m.level = GOOD
    if acknowledge and m.level != ALARM:
        m.latched = 0
    if m.level == ALARM or m.latched == 1:
        m.status = NE_MAINTENANCE
    else:
        m.status = NE_OUT_OF_SPECIFICATION if m.level == WARNING else NE_GOOD


@law
def start_recorder(m: Any) -> None:
    """Begin to record."""
    m.next = m.n_stored = m.n_after = m.frozen = 0


@law
def add_recorded_sample(m: Any, p_A: float, p_B: float, flow: float, x: float, trigger: bool, release: bool) -> None:
    """Store a sample in a ring, unless it is frozen.

    `trigger` freezes it after `N_AFTER` more samples, until it is read and `release` is set. The oldest sample stands
    at `next` once the ring is full, else at 0.
    """
    if release:
        start_recorder(m)
    if m.frozen == 1:
        return
    k = int(m.next)
    m.samples[0, k], m.samples[1, k], m.samples[2, k], m.samples[3, k] = p_A, p_B, flow, x
    m.next = (k + 1) % N_RECORDED
    m.n_stored = min(m.n_stored + 1, N_RECORDED)
    if m.n_after > 0 or trigger:
        m.n_after += 1
        if m.n_after >= N_AFTER:
            m.frozen = 1
