"""Rates in time and errors of estimates: false alarms per hour, run length, onset, delay, L/min and its interval."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.binomial import Rate, rate_of
from sealscope.evaluation.checks import Array, numbers, share
from sealscope.evaluation.quantiles import Quantile, quantile_of


@dataclass(frozen=True)
class HourlyRate:
    """`count` events in `hours`: events per hour with the exact interval (`low`, `high`) at `confidence`."""

    count: int
    hours: float
    per_hour: float
    low: float
    high: float
    confidence: float


@dataclass(frozen=True)
class FalseAlarms:
    """False alarms on leak-free records: per record and per operating hour, and the mean time between them in hours,
    its interval (`run_low`, `run_high`) with no upper end where there was none."""

    per_record: Rate
    hourly: HourlyRate
    run_hours: float
    run_low: float
    run_high: float


@dataclass(frozen=True)
class Mean:
    """The mean of `n` values and its interval (`low`, `high`) at `confidence`; no interval from one value."""

    n: int
    value: float
    low: float
    high: float
    confidence: float


@dataclass(frozen=True)
class EstimateError:
    """Errors of an estimate: `bias` (estimate less truth), root mean square error `rmse`, how often the estimate's own
    interval held the truth (`coverage`), and the records `without` an estimate."""

    bias: Mean
    rmse: Mean
    coverage: Rate
    without: int


@dataclass(frozen=True)
class Delays:
    """Detection delays [s] of `n` leaks: `median` and `ninety` (90 %) with intervals over all leaks, a missed leak
    counting as an infinite delay; `detected` in time, `premature`: alarms before the onset, which detect nothing."""

    n: int
    detected: Rate
    premature: Rate
    median: Quantile
    ninety: Quantile


@dataclass(frozen=True)
class OnsetErrors:
    """Errors of the onset [s]: signed `median` (late is positive), `median_size` and `ninety_size` of its size, and
    how often the stated interval held the true onset; over the records with an onset, `without` had none."""

    n: int
    without: int
    median: Quantile
    median_size: Quantile
    ninety_size: Quantile
    coverage: Rate


def poisson_interval(count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact interval (low, high) of a Poisson mean after `count` events.

    ``low = G(alpha/2; k), high = G(1 - alpha/2; k + 1)``, G the quantile of the gamma distribution of that shape; 0
    where there was no event. Raises InputError for an impossible count or confidence. Source: Garwood, Biometrika 28
    (1936) 437-442, doi 10.1093/biomet/28.3-4.437.
    """
    from scipy.special import gammainccinv, gammaincinv

    if count < 0 or count != int(count):
        raise InputError(f"a number of events must be whole and >= 0, got {count}")
    tail = (1.0 - share(confidence, "confidence")) / 2.0
    return 0.0 if count == 0 else float(gammaincinv(count, tail)), float(gammainccinv(count + 1, tail))


def hourly_rate(count: int, hours: float, confidence: float = 0.95) -> HourlyRate:
    """Events per operating hour with their exact interval; InputError unless `hours` > 0."""
    if not (math.isfinite(hours) and hours > 0.0):
        raise InputError(f"operating hours must be > 0, got {hours}")
    low, high = poisson_interval(count, confidence)
    return HourlyRate(int(count), float(hours), count / hours, low / hours, high / hours, confidence)


def false_alarms(alarms: npt.ArrayLike, hours: npt.ArrayLike, confidence: float = 0.95) -> FalseAlarms:
    """False alarms of a detector on leak-free records.

    `alarms` (n,): alarms in each record (0, 1, or more where it goes on after an alarm); `hours` (n,) or one number:
    the operating time of each. A record with an alarm counts once per record, each alarm counts per hour; the mean
    run length is hours/alarms (a monitor that is reset after each alarm), its interval the reciprocal of the rate's.
    """
    counts = numbers(alarms, "alarms")
    bad = np.flatnonzero((counts < 0.0) | (counts != np.floor(counts)))
    if bad.size:
        raise InputError(f"alarms must be whole numbers >= 0, got {counts[bad[0]]}")
    time = np.asarray(hours, dtype=np.float64)
    if time.ndim and time.shape != counts.shape:
        raise InputError(f"operating hours must be one number or as many as the records ({counts.size})")
    time = np.broadcast_to(time, counts.shape)
    if not np.all(np.isfinite(time) & (time > 0.0)):
        raise InputError("operating hours must be > 0 in each record")
    hourly = hourly_rate(int(counts.sum()), float(time.sum()), confidence)
    return FalseAlarms(
        per_record=rate_of(int(np.count_nonzero(counts)), counts.size, confidence),
        hourly=hourly,
        run_hours=1.0 / hourly.per_hour if hourly.count else math.inf,
        run_low=1.0 / hourly.high,
        run_high=1.0 / hourly.low if hourly.count else math.inf,
    )


def mean_of(values: npt.ArrayLike, confidence: float = 0.95) -> Mean:
    """The mean and its Student interval ``mean -+ t s/sqrt(n)``; infinite from one value, nan from none."""
    from scipy.special import stdtrit

    share(confidence, "confidence")
    array = np.asarray(values, dtype=np.float64).ravel()
    if array.size == 0:
        return Mean(0, math.nan, math.nan, math.nan, confidence)
    array = numbers(array, "values")
    n, value = array.size, float(array.mean())
    if n == 1:
        return Mean(1, value, -math.inf, math.inf, confidence)
    half = float(stdtrit(n - 1, 0.5 + confidence / 2.0) * array.std(ddof=1) / math.sqrt(n))
    return Mean(n, value, value - half, value + half, confidence)


def _held(low: npt.ArrayLike | None, high: npt.ArrayLike | None, truth: Array, confidence: float) -> Rate:
    """How often the stated intervals hold the truth."""
    low, high = _beside(low, truth.size, "lower limits"), _beside(high, truth.size, "upper limits")
    stated = ~(np.isnan(low) | np.isnan(high))
    return rate_of(int(np.count_nonzero((low <= truth) & (truth <= high) & stated)), int(stated.sum()), confidence)


def _beside(values: npt.ArrayLike | None, n: int, what: str) -> Array:
    array = np.full(n, math.nan) if values is None else np.asarray(values, dtype=np.float64)
    if array.shape != (n,):
        raise InputError(f"{what} must be as many as the true values, got {array.shape} for {n}")
    return array


def estimate_error(
    estimates: npt.ArrayLike,
    truth: npt.ArrayLike,
    low: npt.ArrayLike | None = None,
    high: npt.ArrayLike | None = None,
    confidence: float = 0.95,
) -> EstimateError:
    """Bias, rmse and coverage of an estimate (a leak in L/min) with intervals.

    All (n,) in one unit; nan where a record has no estimate or no interval. The interval of the rmse is the square
    root of the Student interval of the mean square error, cut at 0. Coverage is over the records with an interval.
    """
    true = numbers(truth, "true values")
    given = _beside(estimates, true.size, "estimates")
    known = np.isfinite(given)
    error = given[known] - true[known]
    square = mean_of(error**2, confidence)
    roots = [math.sqrt(max(x, 0.0)) if not math.isnan(x) else math.nan for x in (square.value, square.low, square.high)]
    return EstimateError(
        bias=mean_of(error, confidence),
        rmse=Mean(square.n, roots[0], roots[1], roots[2], confidence),
        coverage=_held(low, high, true, confidence),
        without=int(true.size - known.sum()),
    )


def delays(alarm_times: npt.ArrayLike, onsets: npt.ArrayLike, confidence: float = 0.95) -> Delays:
    """How long after its onset each leak raises the alarm.

    `alarm_times` (n,) [s], nan or inf where there was no alarm; `onsets` (n,) [s], true. An alarm before the onset is
    premature: it is a false alarm, and the leak counts as missed. Quantiles as `quantile_of`.
    """
    true = numbers(onsets, "true onsets")
    alarm = _beside(alarm_times, true.size, "alarm times")
    with np.errstate(invalid="ignore"):
        delay = np.where(np.isnan(alarm), math.inf, alarm - true)
    early = delay < 0.0
    delay = np.where(early, math.inf, delay)
    return Delays(
        n=true.size,
        detected=rate_of(int(np.isfinite(delay).sum()), true.size, confidence),
        premature=rate_of(int(early.sum()), true.size, confidence),
        median=quantile_of(delay, 0.5, confidence),
        ninety=quantile_of(delay, 0.9, confidence),
    )


def onset_errors(
    estimates: npt.ArrayLike,
    onsets: npt.ArrayLike,
    low: npt.ArrayLike | None = None,
    high: npt.ArrayLike | None = None,
    confidence: float = 0.95,
) -> OnsetErrors:
    """Errors of the estimated onsets [s] against the true ones, with order-statistic intervals.

    All (n,); nan where none was stated. Raises InputError where no record has an estimate.
    """
    true = numbers(onsets, "true onsets")
    given = _beside(estimates, true.size, "estimated onsets")
    known = np.isfinite(given)
    if not known.any():
        raise InputError(f"onset errors need at least one estimated onset, got none in {true.size} records")
    error = given[known] - true[known]
    return OnsetErrors(
        n=int(known.sum()),
        without=int(true.size - known.sum()),
        median=quantile_of(error, 0.5, confidence),
        median_size=quantile_of(np.abs(error), 0.5, confidence),
        ninety_size=quantile_of(np.abs(error), 0.9, confidence),
        coverage=_held(low, high, true, confidence),
    )
