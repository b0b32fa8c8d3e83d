"""The trend of a machine over its recordings: leakage, healthy range, change, growth and time to the repair limit.

The increase of its leakage is described in the form that `decision.decide` judges. The sequential test of `wear` gives
the chance that a healthy machine shows such an increase,

    chance = time between two recordings / mean time to a false alarm.

Other explanations are tested as in a diagnosis: changes of the terms of the volume balance in all recordings since the
onset, and of the ringing (RMS of the pressures' wavelet details) in the last recording.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.decision.case import HealthyNull
from sealscope.diagnosis.decision.decide import decide
from sealscope.diagnosis.estimate.interval import WITHIN_95, Interval
from sealscope.diagnosis.hold.recorded_holds import SEPARATE_LEAKS
from sealscope.diagnosis.hold.result import HoldResult
from sealscope.diagnosis.inference.comparison import RecordingSums, Rise
from sealscope.diagnosis.inference.hypotheses import LAWS
from sealscope.diagnosis.inference.leak_flow import mixture_flow
from sealscope.diagnosis.inference.observable import LeakMeasure, LeakRise, Observable, Observed, Ringing
from sealscope.diagnosis.inference.volumes.volume_detector import rival_rises
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.rms_change.rms_detector import DETAILS, compare_summaries, has_same_rate
from sealscope.diagnosis.trend.reading import (
    Basis,
    LeakReading,
    TrendPoint,
    build_timeline,
    estimate_reading,
    hold_reading,
    list_findings,
    scatter_prior,
)
from sealscope.diagnosis.trend.wear import Episode, Levels, Wear, find_episodes, outlier_excess
from sealscope.diagnosis.verdict.evidence import LEAK, NO_LEAK, RMS_CHANGE, Cause, Evidence, TotalLeakage, Verdict
from sealscope.diagnosis.verdict.machine_sizes import AssumedMachine
from sealscope.diagnosis.verdict.severity import LEAK_OVER_LIMIT, MachineState, RepairLimit, state_of
from sealscope.errors import InputError
from sealscope.paragraphs import join_names
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.storage.plain_values import to_plain
from sealscope.units import DAYS_PER_YEAR, LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig


@dataclass(frozen=True)
class Trend:
    """Leakage of a single machine over time, from its recordings.

    Parameters
    ----------
    decision : Evidence
        Verdict, reason, leak, bound and onset, as in a diagnosis. The verdict is `leak` if the level rose more than a
        healthy machine's may, a leak explains the rise, and no repair followed.
    basis : str or None
        Method by which the levels were estimated: "hold test", "volume balance", "pressure response" or "ringing".
    unit, pressure : str, float or None
        ``L/min`` at this pressure difference [Pa], or ``%`` of the healthy recordings' mean if the sizes are not known;
        for "ringing" ``%`` above this mean. The pressure is None for ``%``.
    points : tuple of TrendPoint
        The recordings in the order of their times.
    groups : tuple of str
        A text for each group of comparable recordings on its difference from the first group.
    episodes : tuple of Episode
        The periods between repairs, the present one last; days in their `wear` count from the first recording.
    rows : tuple of int
        Indices of the points that are compared, or nearest to the compared averages (`Levels.average_neighbours`); the
        rows of an `Episode` are indices into `rows`.
    repair : RepairLimit
        Leak above the healthy level at which a repair is due.
    machine : AssumedMachine or None
        What was assumed of the machine, and who stated it.
    findings : tuple of Finding
        Recordings that are left out or not comparable, and other findings on the data.
    years, healthy : float, int
        Mean time to a false alarm [machine-years], and number of first recordings that were known to be healthy.
    dated : bool
        True if the recordings have dates, False if equal intervals are assumed.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import sealscope as ss
    >>> days = [ss.simulate(duration="40 s", seed=day, leak="0.02 L/min" if day >= 4 else None) for day in range(6)]
    >>> days = [replace(run, provenance={"start": f"2024-05-0{day + 1}T08:00"}) for day, run in enumerate(days)]
    >>> trend = ss.trend(days, rig="thesis")
    >>> trend.verdict, f"{trend.wear.total.value:.3f} {trend.unit}", trend.alarm.day
    ('leak', '0.020 L/min', 5.0)
    >>> trend.as_dict()["onset"]["value"]
    '2024-05-05T08:00:00'
    """

    decision: Evidence
    basis: Basis | None
    unit: str
    pressure: float | None
    points: tuple[TrendPoint, ...]
    groups: tuple[str, ...]
    episodes: tuple[Episode, ...]
    rows: tuple[int, ...]
    repair: RepairLimit
    machine: AssumedMachine | None
    findings: tuple[Finding, ...]
    years: float
    healthy: int
    dated: bool

    @property
    def verdict(self) -> Verdict:
        """The verdict, one of "leak", "no leak" and "cannot tell"."""
        return self.decision.verdict

    @property
    def reason(self) -> str:
        """Reason for the verdict in one line, with the false-alarm rate."""
        is_repaired = bool(self.episodes) and self.episodes[-1].fell  # the last period began with a repair
        rate = f"1 false alarm in {self.years:g} machine-years"
        return f"{self.decision.reason}{' since the repair' if is_repaired else ''} ({rate})"

    @property
    def wear(self) -> Wear | None:
        """Level, change and growth of the leakage since the last repair; None if no recordings can be compared."""
        return self.episodes[-1].wear if self.episodes else None

    @property
    def total(self) -> Interval | None:
        """Present flow past pump and piston with its 95 % interval, in the trend's unit; None if it is not known."""
        total = self.decision.total_leakage
        if total is None or total.lpm is None or total.interval_lpm is None:
            return None if self.wear is None else self.wear.total
        return Interval(total.lpm, *total.interval_lpm)

    @property
    def leak(self) -> Interval | None:
        """Increase of the flow past pump and piston over that of the healthy machine; None if nothing changed."""
        value, interval = self.decision.leak_lpm, self.decision.leak_interval_lpm
        if value is not None and interval is not None:
            return Interval(value, *interval)
        return None if self.wear is None or self.wear.onset is None else self.wear.leak

    @property
    def limit(self) -> float | None:
        """Level at which a repair is due, in the trend's unit; None if the repair limit cannot be converted to it."""
        return None if self.wear is None else self.wear.limit

    @property
    def alarm(self) -> TrendPoint | None:
        """First recording since the last repair at which the test raised an alarm; None if it did not."""
        row = self.episodes[-1].alarm if self.episodes else None
        return None if row is None else self.points[self.rows[row]]

    @property
    def repairs(self) -> tuple[TrendPoint, ...]:
        """The first recording after each repair, in the order of time."""
        return tuple(self.points[self.rows[episode.begin]] for episode in self.episodes if episode.fell)

    @property
    def next_check(self) -> str:
        """Next check to make on the machine, in one or two sentences."""
        if self.verdict == NO_LEAK and self.decision.cause is None:
            return "Nothing needs a check; go on recording under the same duty."
        if self.verdict == LEAK and self.basis == "hold test":
            return SEPARATE_LEAKS
        return state_of(self.verdict, self.decision.cause).action

    @property
    def state(self) -> MachineState:
        """State of the machine by NAMUR NE 107, such as "good"; a failure if a leak is surely over the repair limit."""
        condition: str = self.verdict
        if self.verdict == LEAK and self.wear is not None and self.limit is not None:
            condition = LEAK_OVER_LIMIT if self.wear.total.low > self.limit else LEAK
        elif self.verdict == NO_LEAK:
            condition = "watched"  # as for a running machine; the condition "no leak" is that of a single recording
        return state_of(condition, self.decision.cause, action=self.next_check)

    def as_dict(self) -> dict[str, Any]:
        """Return the trend as plain values for JSON; a number that is not finite becomes None."""
        wear, alarm, total = self.wear, self.alarm, self.decision.total_leakage
        days = [point.day for point in self.points] or [math.nan]
        limit_day = None
        if wear is not None and wear.reach is not None:
            last_compared = self.points[self.rows[-1]].day
            limit_day = Interval(*(last_compared + days_to_limit for days_to_limit in wear.reach))
        points = [
            {"file": point.file, "time": self._format_day(point.day)}
            | {name: getattr(point, name) for name in ("day", "value", "low", "high")}
            | {"group": None if point.group < 0 else point.group, "temperature_C": point.temperature}
            | {"note": point.note}
            for point in self.points
        ]
        return to_plain(  # type: ignore[no-any-return]
            {
                "verdict": self.verdict,
                "reason": self.reason,
                "cause": self.decision.cause,
                "chance": self.decision.chance,
                **{name: getattr(self.decision, name) for name in ("leak_lpm", "leak_interval_lpm", "bound_lpm")},
                "total_leakage": total and {"lpm": total.lpm, "interval_lpm": total.interval_lpm},
                "basis": self.basis,
                "unit": self.unit,
                "pressure_Pa": self.pressure,
                "recordings": len(points),
                "compared": len(self.rows),
                "first": self._format_day(days[0]),
                "last": self._format_day(days[-1]),
                "total_level": self.total,
                "leak_level": self.leak,
                "healthy": wear and wear.healthy,
                "day_to_day": wear and wear.scatter,
                "growth_per_month": wear and wear.growth,
                "step": wear and wear.step,
                "onset": self._format_days(wear and wear.onset),
                "alarm": alarm and {"file": alarm.file, "time": self._format_day(alarm.day)},
                "repairs": [{"file": point.file, "time": self._format_day(point.day)} for point in self.repairs],
                "limit": self.limit,
                "repair_limit": self.repair.as_dict(),
                "days_to_limit": wear and wear.reach,
                "limit_reached": self._format_days(limit_day),
                "false_alarm_years": self.years,
                "healthy_recordings": self.healthy,
                "rig": self.machine and self.machine.as_dict(),
                "groups": self.groups,
                "points": points,
                "findings": [
                    {name: getattr(finding, name) for name in ("code", "count", "severity", "text")}
                    for finding in self.findings
                ],
                "next_check": self.next_check,
                "state": self.state.as_dict(),
            }
        )

    def _format_day(self, day: float) -> str | float | None:
        """Format days since the first recording as an ISO date and time; return `day` if undated or not finite."""
        if not math.isfinite(day) or not self.dated:
            return day
        time_ms = np.datetime64(round(self.points[0].seconds_since_1970(day) * 1e3), "ms")
        return str(time_ms)[:19]  # without the fraction of a second

    def _format_days(self, days: Interval | None) -> dict[str, str | float | None] | None:
        """Format value and limits of an interval of days by `_format_day`; None if `days` is None."""
        return days and {name: self._format_day(day) for name, day in days._asdict().items()}


@checked_call
def trend(
    recordings: Iterable[Recording | LeakReading | HoldResult],
    *,
    rig: Rig | str | os.PathLike[str] | None = None,
    healthy: int = 1,
    limit: str | None = None,
    years: float = 10.0,
    every: float | None = None,
) -> Trend:
    """Estimate the trend of a single machine's leakage over its recordings.

    Parameters
    ----------
    recordings : iterable of Recording
        Recordings of the machine in any order, or readings of them (`estimate_reading`), or
        results of hold tests; copies count once.
    rig : Rig, str or path-like, optional
        Sizes of the machine, as for `diagnose`; without it levels are relative, unless the recordings state the
        machine.
    healthy : int, optional
        Number of first recordings that are known to be of a healthy machine.
    limit : str, optional
        Leak above the healthy level at which a repair is due, as a flow (``"5 mL/min"``) or as a creep speed of the
        piston (``"8 mm/min"``, the default).
    years : float, optional
        Mean time to a false alarm of a healthy machine [machine-years], 0.1 to 1000.
    every : float, optional
        Time between two recordings [s]. With it, the recordings are dated at equal intervals in the order of their
        files' names.

    Returns
    -------
    Trend
        Verdict, levels with intervals, healthy range, change, growth and time to the limit.

    Raises
    ------
    InputError
        The time of a recording is not known and `every` is not given, or a number is out of its range.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import sealscope as ss
    >>> days = [ss.simulate(duration="40 s", seed=seed) for seed in range(4)]
    >>> days = [replace(day, provenance={"start": f"2024-05-0{k + 1}T08:00"}) for k, day in enumerate(days)]
    >>> ss.trend(days).verdict
    'no leak'
    """
    if not (isinstance(healthy, int) and healthy >= 1):
        raise InputError(f"the number of healthy recordings must be 1 or more, got {healthy!r}")
    if not 0.1 <= years <= 1000.0:
        raise InputError(f"machine-years to a false alarm must be 0.1 to 1000, got {years!r}")
    if every is not None and not (math.isfinite(every) and every > 0.0):
        raise InputError(f"every must be > 0 s, got {every!r}")
    readings = [
        item
        if isinstance(item, LeakReading)
        else hold_reading(item)
        if isinstance(item, HoldResult)
        else estimate_reading(item, rig)
        for item in recordings
    ]
    points, differences = build_timeline(readings, every)
    rows = tuple(k for k, point in enumerate(points) if point.group >= 0)  # -1: the recording is left out
    compared = [points[k] for k in rows]
    states_flow = bool(compared) and all(point.states_flow for point in compared)
    notes = [point.note for point in points if point.note]
    lack = f"no recording states a level: {notes[0]}" if notes else "no recording states a level"
    result = Trend(
        # replaced by `_add_episodes` if there are comparable recordings
        decision=decide(Observed("", lack=lack), (), HealthyNull(), false_alarm_probability=0.0),
        basis=compared[0].basis if compared else None,
        unit="L/min" if states_flow else "%",
        pressure=float(np.median([point.pressure for point in compared])) if states_flow else None,
        points=tuple(points),
        groups=differences,
        episodes=(),
        rows=rows,
        machine=points[0].machine if points else None,
        findings=tuple(list_findings(points, differences)),
        repair=RepairLimit.parse(limit),
        years=years,
        healthy=healthy,
        dated=every is None,
    )
    return _add_episodes(result) if compared else result


def _add_episodes(trend: Trend) -> Trend:
    """Add to a trend the leakage in each comparable recording, the episodes between repairs, and the decision."""
    levels, trend_units_per_level = _convert_levels(trend)
    points, findings = _add_values(trend, levels)
    averages, rows = levels.average_neighbours(), trend.rows  # very many recordings are averaged
    n_healthy = max(1, _count_healthy(trend) * len(averages) // len(levels))  # number of healthy averages
    allowed_rise = _allowed_rise(trend, trend_units_per_level)
    episodes = tuple(find_episodes(averages, years=trend.years, n_healthy=n_healthy, allowed_rise=allowed_rise))
    if averages is not levels:  # recordings nearest to the averages
        rows = tuple(rows[int(np.argmin(np.abs(levels.t - t)))] for t in averages.t)
    decision = decide_trend(
        [points[row] for row in rows[episodes[-1].begin :]],  # since the last repair
        episodes[-1],
        trend_units_per_level=trend_units_per_level,
        pressure=trend.pressure,
        interval=levels.interval,
        years=trend.years,
    )
    return replace(trend, points=points, findings=findings, episodes=episodes, rows=rows, decision=decision)


def _add_values(trend: Trend, levels: Levels) -> tuple[tuple[TrendPoint, ...], tuple[Finding, ...]]:
    """Add the values and 95 % intervals of `levels` to the points of a trend, and a finding if there are outliers."""
    points, findings = [*trend.points], [*trend.findings]
    _, excess = outlier_excess(levels)  # a level that the next one confirms is a change of the machine and no outlier
    outliers = np.flatnonzero(excess)
    remark = "far from the recordings before and after, and counted as if nearer"
    for k, row in enumerate(trend.rows):
        value, half_width = float(levels.value[k]), WITHIN_95 * float(levels.error[k])
        note = remark if k in outliers else ""
        points[row] = replace(points[row], value=value, low=value - half_width, high=value + half_width, note=note)
    if outliers.size:
        files = join_names((points[trend.rows[k]].file for k in outliers), 3)
        text = f"{outliers.size} of {len(points)} {remark} ({files})"
        findings.append(Finding("outlier", "warning", channel=None, count=outliers.size, first_t=None, text=text))
    return tuple(points), tuple(findings)


def _count_healthy(trend: Trend) -> int:
    """Count the compared recordings among the first `trend.healthy`, without copies; return at least 1."""
    digests = dict.fromkeys(point.digest for point in trend.points)  # in the order of time, copies once
    healthy_digests = list(digests)[: trend.healthy]
    return max(1, sum(trend.points[row].digest in healthy_digests for row in trend.rows))


def _convert_levels(trend: Trend) -> tuple[Levels, float]:
    """Convert the leakage levels of the compared recordings to the trend's unit and to one oil temperature.

    Conductances [m^3/(s Pa)] become L/min at the trend's pressure, or % of the healthy recordings' mean. If the oil
    temperature of every recording is known, they are converted to that of the first. Returns the converted levels, and
    the factor from `LeakReading.level` to the trend's unit.
    """
    compared = [trend.points[k] for k in trend.rows]
    t, group, value, error = (
        np.array([getattr(point, name) for point in compared]) for name in ("day", "group", "level", "error")
    )
    usual = float(np.mean(value[: _count_healthy(trend)]))  # mean level of the healthy recordings
    prior = scatter_prior(trend.basis or "ringing", usual)  # compared recordings have a basis: never None here
    warming, slope_sd = np.zeros(t.size), 0.0  # warming of the oil [K], standard deviation of the level's change per K
    temperatures = [point.temperature for point in compared if point.temperature is not None]
    if trend.basis != "ringing" and len(temperatures) == t.size:
        warming = np.array(temperatures) - temperatures[0]
        slope_sd = INFERENCE.oil.per_kelvin_deviation * abs(usual)
        correction = np.exp(-INFERENCE.oil.per_kelvin * warming)
        value, error = value * correction, error * correction
    if trend.basis == "ringing":  # a negative log RMS: its difference from the healthy mean, in %
        factor, value = 100.0, value - usual
    elif trend.pressure is not None:
        factor = trend.pressure / LITRE_PER_MINUTE
    else:
        factor = 100.0 / max(abs(usual), float(np.finfo(float).tiny))
    prior = prior._replace(scale=prior.scale * factor)
    levels = Levels(
        t, value * factor, error * factor, group, covariate=warming, prior=prior, slope_sd=slope_sd * factor
    )
    return levels, factor


def _allowed_rise(trend: Trend, trend_units_per_level: float) -> float | None:
    """Convert the repair limit of a trend, a flow or a creep speed, to its unit; None if that is impossible."""
    compared = [trend.points[k] for k in trend.rows]
    if trend.repair.kind == "flow" and trend.pressure is not None:  # a trend in L/min
        return trend.repair.value / LITRE_PER_MINUTE
    if trend.repair.kind == "creep" and compared[0].area is not None:
        pressure = float(np.median([point.pressure for point in compared]))
        conductance = trend.repair.value * compared[0].area / pressure
        return conductance * trend_units_per_level
    return None


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
