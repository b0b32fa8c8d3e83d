"""Describe the increase of a machine's leakage over its recordings in the form that `decision.decide` judges.

The sequential test of `wear` gives the chance that a healthy machine shows such an increase,

    chance = time between two recordings / mean time to a false alarm.

Other explanations are tested as in a diagnosis: changes of the terms of the volume balance in all recordings since the
onset, and of the ringing (RMS of the pressures' wavelet details) in the last recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.decision.decide import decide
from sealscope.diagnosis.decision.null import HealthyNull
from sealscope.diagnosis.estimate.interval import WITHIN_95, Interval
from sealscope.diagnosis.inference.comparison.recording_sums import RecordingSums
from sealscope.diagnosis.inference.comparison.rise import Rise
from sealscope.diagnosis.inference.hypotheses import LAWS
from sealscope.diagnosis.inference.leak_law import mixture_flow
from sealscope.diagnosis.inference.observable import LeakMeasure, LeakRise, Observable, Observed, Ringing
from sealscope.diagnosis.inference.volumes.rivals import rival_rises
from sealscope.diagnosis.rms_change.rms_detector import DETAILS, compare_summaries, has_same_rate
from sealscope.diagnosis.trend.reading import TrendPoint
from sealscope.diagnosis.trend.wear import Episode, Wear
from sealscope.diagnosis.verdict.evidence import RMS_CHANGE, Cause, Evidence, TotalLeakage
from sealscope.units import DAYS_PER_YEAR

#: Smallest number of comparable recordings for a verdict.
MIN_RECORDINGS = 3
#: Causes of a leak by the methods that separate less, or more, than the volume balance.
_CAUSES: dict[str, Cause] = {
    "pressure response": "piston, pump or external leak",
    "hold test": "piston or external leak",
}


def decide_trend(
    points: Sequence[TrendPoint],
    episode: Episode,
    *,
    trend_units_per_level: float,
    pressure: float | None,
    interval: float,
    years: float,
) -> Evidence:
    """Decide from the comparable recordings since the last repair if the leakage of a machine has increased.

    `points` are in the order of time; `episode` is what `find_episodes` found for them. `trend_units_per_level` is
    the factor from `LeakReading.level` to the unit of the trend; `pressure` [Pa] is the pressure difference for which a
    trend in L/min is stated, None for a trend in %; `interval` [days] is the median time between two recordings. The
    allowed probability of a false alarm is `interval` divided by `years`, the mean time between false alarms.
    """
    wear = episode.wear
    before, since = _split_at_onset(points, wear)
    # `interval` over the mean time until a healthy machine scores as high, exp(log_days); > 0 even if that underflows
    chance = float(np.clip(np.exp(np.log(interval) - episode.log_days), np.finfo(float).tiny, 1.0))
    if points[0].basis == "ringing":
        report = _report_ringing(before, wear, chance)
    else:
        leak = _measure_leak(points, wear, chance, trend_units_per_level, pressure)
        report = Observed(leak.provider, _rival_changes(points[-1], before, since), leak)
    if len(points) < MIN_RECORDINGS:
        lack = f"{len(points)} comparable recordings are too few, {MIN_RECORDINGS} are needed"
        report = Observed(report.provider, lack=lack)
    probability = interval / (years * DAYS_PER_YEAR)
    return decide(report, [_report_rms_change(points[-1], before)], HealthyNull(), probability)


def _measure_leak(
    points: Sequence[TrendPoint], wear: Wear, chance: float, trend_units_per_level: float, pressure: float | None
) -> LeakMeasure:
    """Describe the increase of the leakage since the last repair; flows are in the unit of the trend.

    `chance` is the probability of such an increase in a healthy machine; for the other arguments see `decide_trend`.
    The flow of the leak is proportional to p^k, with k from `LAWS` for a laminar leak, an orifice and laws
    between; the stated flow is the mean over these laws.
    """
    onset_day = -np.inf if wear.onset is None else wear.onset.value
    pressures_since = [point.pressure for point in points if point.day >= onset_day]
    pressure_ratio = float(np.median(pressures_since)) / pressure if pressure and pressures_since else 1.0
    # the flow at `pressure` is the level times `pressure` for a laminar leak, k = 1; other laws have a further factor
    exponents, probabilities = np.array([*LAWS.items()]).T
    flow_factors = pressure_ratio ** (1.0 - exponents)
    # mean flow of the pump in the trend's unit, converted like a level, which is a flow over a pressure
    pump_flow = float(np.median([point.pump / point.pressure for point in points])) * trend_units_per_level
    pump_flow = pump_flow if np.isfinite(pump_flow) else 0.0
    size_deviation = max(point.size_error for point in points)
    rise = _normal_rise(wear, chance)
    return LeakMeasure(
        provider=str(points[0].basis),
        cause=_CAUSES.get(str(points[0].basis), "piston or pump leak"),
        rise=rise,
        step_rise=None if rise is None else LeakRise(rise),
        rise_flow=mixture_flow(probabilities, wear.leak.value * flow_factors, wear.leak.deviation * flow_factors),
        rise_onset=wear.onset and Interval(*(points[0].seconds_since_1970(day) for day in wear.onset)),
        bound_flow=wear.bound,
        pump_flow=(pump_flow, pump_flow),  # also stands for the mean while the pump delivers
        lpm_per_flow=None if pressure is None else 1.0,  # flows are in L/min already
        size_deviation=size_deviation,
        total_leakage=None if pressure is None else _total_leakage(wear.total, size_deviation, pressure),
    )


def _normal_rise(wear: Wear, chance: float) -> Rise | None:
    """Describe the increase of the leakage as a normal estimate whose p-value is `chance`.

    The estimate is the median increase (`Wear.leak`) or, if that is 0, its upper bound; the standard deviation follows.
    The result is None for a chance >= 0.5 or a bound <= 0.
    """
    from scipy.special import ndtri

    score = -float(ndtri(chance))  # normal quantile of 1 - chance
    if not (score > 0.0 and wear.bound > 0.0):
        return None
    value = wear.leak.value or wear.bound
    return Rise(value, deviation=value / score, degrees_of_freedom=np.inf)


def _total_leakage(total: Interval, size_deviation: float, pressure: float) -> TotalLeakage:
    """Add the error of the machine's sizes to the interval of the present leakage `total` [L/min]."""
    half_width = WITHIN_95 * total.value * size_deviation  # part of the error that is due to the sizes
    below, above = (float(np.hypot(end - total.value, half_width)) for end in (total.low, total.high))
    return TotalLeakage(max(total.value, 0.0), (max(total.value - below, 0.0), max(total.value + above, 0.0)), pressure)


def _report_ringing(before: Sequence[TrendPoint], wear: Wear, chance: float) -> Observed:
    """Report the decrease of the pressures' ringing (RMS of their wavelet details) since the last repair.

    `wear.leak` is -100 times the change of the log RMS; `chance` is the probability of such a decrease in a healthy
    machine; `before` are the recordings before its onset. A decrease without an onset is reported as a change, but not
    as one of the ringing: nothing tells which recordings are healthy.
    """
    size = -wear.leak.value / 100.0  # change of the log RMS
    # a score is twice the logarithm of a likelihood ratio, here of 1 / chance
    fall = Observable(name="fall of the ringing", data=DETAILS, score=-2.0 * np.log(chance), chance=chance, size=size)
    ringing = Ringing(bound=np.inf, rate=0.0, healthy=len(before), is_dated=True)  # at rate 0 no bound is stated
    return Observed(RMS_CHANGE, (fall,), ringing=None if wear.onset is None else ringing)


def _split_at_onset(points: Sequence[TrendPoint], wear: Wear) -> tuple[list[TrendPoint], list[TrendPoint]]:
    """Split the recordings that can be compared with the last one into those before the leak's onset and those since.

    Without an onset, the second list has the recordings at the time of the last one, usually only this one.
    """
    onset = points[-1].day if wear.onset is None else wear.onset.value
    comparable = [point for point in points if point.group == points[-1].group]
    before = [point for point in comparable if point.day < onset]
    return before, comparable[len(before) :]


def _rival_changes(
    last: TrendPoint, before: Sequence[TrendPoint], since: Sequence[TrendPoint]
) -> tuple[Observable, ...]:
    """Test the other terms of the volume balance for a change at the onset of the leak, which may explain the increase.

    Recordings `before` and `since` the onset are compared, if their balance has the same terms as that of the `last`
    one. The result is empty if there are none, or if the last recording has no balance or several.
    """
    names = [roles.names for roles in last.terms]  # names of the terms of each balance
    sums_before, sums_since = (
        [point.sums for point in part if point.sums is not None and [roles.names for roles in point.terms] == names]
        for part in (before, since)
    )
    if not sums_before or not sums_since or len(names) != 1:
        return ()
    flow = float(np.mean([sums.flow for sums in sums_since]))
    pressure = float(np.mean([sums.pressure for sums in sums_since]))
    # all recordings since the onset as one; leaks in holds (`held`) are not compared
    judged = RecordingSums(np.sum([sums.sums for sums in sums_since], axis=0), flow, pressure, held=None)
    healthy = [replace(sums, held=None) for sums in sums_before]
    return rival_rises(judged, healthy, last.terms)


def _report_rms_change(last: TrendPoint, before: Sequence[TrendPoint]) -> Observed:
    """Test the ringing (RMS of the pressures' wavelet details) of the `last` recording for a change since the onset.

    It is compared with that of the recordings `before` the onset that have the same channels and sampling rate. Nothing
    is tested without them, or in a trend of the ringing itself.
    """
    judged = last.ringing
    observables: tuple[Observable, ...] = ()
    if judged is not None and last.basis != "ringing":
        healthy = [
            ringing
            for point in before
            if (ringing := point.ringing) is not None
            and (ringing.chambers, ringing.recorded) == (judged.chambers, judged.recorded)
            and has_same_rate(ringing.rate, judged.rate)
        ]
        if healthy:
            observables, _ = compare_summaries(judged, healthy, judged.chambers)
    return Observed(RMS_CHANGE, observables)
