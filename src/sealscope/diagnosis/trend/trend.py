"""The trend of a machine over its recordings: level, healthy band, change, growth, and when it reaches a limit."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.trend.reading import Basis, LeakReading, reading_of, scatter_of
from sealscope.diagnosis.trend.timeline import DAY, Timeline, spaced, timeline
from sealscope.diagnosis.trend.wear import Episode, Interval, Levels, Wear, WearPrior, episodes, merged, single_outliers
from sealscope.diagnosis.verdict.diagnosis import next_check
from sealscope.diagnosis.verdict.evidence import Verdict
from sealscope.diagnosis.verdict.machine import AssumedMachine
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Machine-years in which a healthy machine has one false alarm, unless the caller asks for another number.
YEARS = 10.0
_YEARS = (0.1, 1000.0)
#: A laminar leak goes with 1/viscosity: ISO VG 46 of viscosity index 100 has 117 mm^2/s at 20 deg C and 30 at 50
#: (ISO 3448), 4.5 % a kelvin; what the oil's sensor sees is not what the gap does. Mean and deviation [1/K].
_PER_KELVIN, _PER_KELVIN_SD = 0.04, 0.015
#: A step of so many deviations from day to day is surely found at the second recording after it.
_FOUND = 5.0
#: Fewest comparable recordings that show that nothing grows.
_FEWEST = 3


@dataclass(frozen=True)
class TrendPoint:
    """One recording of a trend.

    `start` [s since 1970], `day` since the first one; `value` and 95 % interval of its own error in the trend's unit,
    None where it is left out, for the reason `note`; `group` of comparable recordings, -1 where left out.
    """

    file: str
    start: float
    day: float
    value: float | None
    low: float | None
    high: float | None
    group: int
    temperature: float | None
    note: str = ""


@dataclass(frozen=True)
class Trend:
    """What the recordings of a single machine say of its leakage over time.

    Parameters
    ----------
    verdict : {"leak", "no leak", "cannot tell"}
        `leak` where the level rose beyond what a healthy machine does, and was not repaired since.
    reason : str
        Why, in one line.
    basis : str or None
        What the levels rest on: volume balance, pressure response, or the damping of the pressures' ringing.
    unit : str
        Unit of the levels: ``L/min``, or ``%`` of the first recordings where the machine's size is not known.
    pressure : float or None
        Pressure difference for which L/min are stated [Pa].
    points : tuple of TrendPoint
        The recordings in the order of their times.
    groups : tuple of str
        What sets each group of recordings apart from the first one.
    episodes : tuple of Episode
        Stretches between repairs; the last one is that of the machine as it is. Days of its `wear` count from the first
        recording.
    rows : tuple of int
        Numbers of the points that the episodes count.
    repair : RepairLimit
        Leak beyond the healthy level at which a repair is due; `limit` is that level.
    machine : AssumedMachine or None
        What was assumed of the machine, and who stated it.
    findings : tuple of Finding
        What is left out, not comparable or missing, and why.
    years : float
        Machine-years to a false alarm.
    healthy : int
        First recordings that were known to be healthy.
    dated : bool
        Whether the times are those of the recordings, as opposed to equal intervals.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import sealscope as ss
    >>> days = [ss.simulate(duration="40 s", seed=day, leak="0.02 L/min" if day >= 4 else None) for day in range(6)]
    >>> days = [replace(run, provenance={"start": f"2024-05-0{day + 1}T08:00"}) for day, run in enumerate(days)]
    >>> trend = ss.trend(days, rig="thesis")
    >>> trend.verdict, f"{trend.wear.now.value:.3f} {trend.unit}", trend.alarm.day
    ('leak', '0.020 L/min', 5.0)
    >>> trend.as_dict()["onset"]["value"]
    '2024-05-05T08:00:00'
    """

    verdict: Verdict
    reason: str
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
    def wear(self) -> Wear | None:
        """What the last stretch says, None where there is no level."""
        return self.episodes[-1].wear if self.episodes else None

    @property
    def limit(self) -> float | None:
        """Level at which a repair is due, None where the limit cannot be stated in the levels' unit."""
        return None if self.wear is None else self.wear.limit

    @property
    def alarm(self) -> TrendPoint | None:
        """The recording after which the last stretch alarmed, None where it did not."""
        number = self.episodes[-1].alarm if self.episodes else None
        return None if number is None else self.points[self.rows[number]]

    @property
    def repairs(self) -> tuple[TrendPoint, ...]:
        """The first recording of each stretch that began with a fall of the level."""
        return tuple(self.points[self.rows[own.begin]] for own in self.episodes if own.fell)

    @property
    def next_check(self) -> str:
        """What to check next on the machine."""
        if self.verdict == "no leak":
            return "Nothing needs a check; go on recording under the same duty."
        if self.verdict == "leak":
            return next_check("leak", "piston or pump leak")
        if self.wear is None:
            return next_check("cannot tell", None)
        return "Go on recording under the same duty, and compare the level with what a new machine passes."

    def as_dict(self) -> dict[str, Any]:
        """Return the trend as plain JSON values; a number that is not finite becomes null."""
        wear, alarm = self.wear, self.alarm
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "basis": self.basis,
            "unit": self.unit,
            "pressure_Pa": _plain(self.pressure),
            "recordings": len(self.points),
            "compared": len(self.rows),
            "first": self._moment(self.points[0].day) if self.points else None,
            "last": self._moment(self.points[-1].day) if self.points else None,
            "now": None if wear is None else _interval(wear.now),
            "healthy": None if wear is None else _interval(wear.healthy),
            "day_to_day": None if wear is None else _plain(wear.scatter),
            "growth_per_month": None if wear is None else _interval(wear.growth),
            "step": None if wear is None or wear.step is None else _interval(wear.step),
            "onset": None if wear is None or wear.onset is None else self._moments(wear.onset),
            "alarm": None if alarm is None else {"file": alarm.file, "time": self._moment(alarm.day)},
            "repairs": [{"file": point.file, "time": self._moment(point.day)} for point in self.repairs],
            "limit": _plain(self.limit),
            "repair_limit": self.repair.as_dict(),
            "days_to_limit": None if wear is None or wear.reach is None else _interval(wear.reach),
            "false_alarm_years": self.years,
            "healthy_recordings": self.healthy,
            "rig": None if self.machine is None else self.machine.as_dict(),
            "groups": list(self.groups),
            "points": [
                {
                    "file": point.file,
                    "time": self._moment(point.day),
                    "day": point.day,
                    "value": _plain(point.value),
                    "low": _plain(point.low),
                    "high": _plain(point.high),
                    "group": None if point.group < 0 else point.group,
                    "temperature_C": _plain(point.temperature),
                    "note": point.note,
                }
                for point in self.points
            ],
            "findings": [
                {"code": finding.code, "count": finding.count, "severity": finding.severity, "text": finding.text}
                for finding in self.findings
            ],
            "next_check": self.next_check,
        }

    def _moment(self, day: float) -> str | float | None:
        """Return a time as an ISO stamp, or in days where the times are not known."""
        if not math.isfinite(day):
            return None
        if not self.dated or not self.points:
            return day
        return str(np.datetime64(round((self.points[0].start + (day - self.points[0].day) * DAY) * 1e3), "ms"))[:19]

    def _moments(self, days: Interval) -> dict[str, str | float | None]:
        return {name: self._moment(getattr(days, name)) for name in ("value", "low", "high")}


def _plain(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _interval(interval: Interval) -> dict[str, float | None]:
    return {"value": _plain(interval.value), "low": _plain(interval.low), "high": _plain(interval.high)}


@checked_call
def trend(
    recordings: Iterable[Recording],
    *,
    rig: Rig | str | os.PathLike[str] | None = None,
    healthy: int = 1,
    limit: str | None = None,
    years: float = YEARS,
    every: float | None = None,
) -> Trend:
    """Return how the leakage of a single machine went over its recordings.

    Parameters
    ----------
    recordings : iterable of Recording
        Recordings of the machine, in any order; copies count once.
    rig : Rig, str or path-like, optional
        What may be assumed of the machine, as for `diagnose`; without it, and where the recordings do not tell, levels
        are relative.
    healthy : int, optional
        How many of the first recordings are known to be of a healthy machine.
    limit : str, optional
        Leak beyond the healthy level at which a repair is due, as a flow (``"5 mL/min"``) or as a speed of creep
        (``"8 mm/min"``, the default).
    years : float, optional
        Machine-years in which a healthy machine has one false alarm, 0.1 to 1000.
    every : float, optional
        Time between two recordings [s], of recordings without times, in the order of their files' names.

    Returns
    -------
    Trend
        Verdict, levels with intervals, healthy band, change, growth and time to the limit.

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
    readings = [reading_of(recording, rig) for recording in recordings]
    return trend_of(readings, healthy=healthy, limit=limit, years=years, every=every)


def trend_of(
    readings: Sequence[LeakReading],
    *,
    healthy: int = 1,
    limit: str | None = None,
    years: float = YEARS,
    every: float | None = None,
) -> Trend:
    """Return the trend of readings; arguments and errors as for `trend`."""
    if not (isinstance(healthy, int) and healthy >= 1):
        raise InputError(f"the number of healthy recordings must be 1 or more, got {healthy!r}")
    if not _YEARS[0] <= years <= _YEARS[1]:
        raise InputError(f"machine-years to a false alarm must be {_YEARS[0]:g} to {_YEARS[1]:g}, got {years!r}")
    if every is not None and not (math.isfinite(every) and every > 0.0):
        raise InputError(f"every must be > 0 s, got {every!r}")
    repair = RepairLimit.of(limit)
    line = timeline(readings if every is None else spaced(readings, every))
    return _trend(line, healthy=healthy, repair=repair, years=years, dated=every is None)


def _trend(line: Timeline, *, healthy: int, repair: RepairLimit, years: float, dated: bool) -> Trend:
    every = [*line.readings, *(reading for reading, _ in line.left_out)]
    first = min((reading.start or 0.0 for reading in every), default=0.0)
    series = _series(line, first, healthy, repair)
    findings = list(line.findings)
    stretches: tuple[Episode, ...] = ()
    rows: tuple[int, ...] = ()
    notes: dict[int, str] = {}
    if series is not None:
        alone = single_outliers(series.levels, series.prior)
        notes = dict.fromkeys(map(int, alone), "apart from the recordings before and after it, which agree: left out")
        if alone.size:
            files = ", ".join(line.readings[int(k)].file for k in alone[:3])
            text = f"{alone.size} of {len(every)} left out: apart from the recordings before and after ({files})"
            findings.append(Finding("outlier", "warning", None, int(alone.size), None, text))
        kept = np.setdiff1d(np.arange(len(series.levels)), alone)
        whole = series.levels.part(kept)
        few = merged(whole)
        known = max(1, int(np.count_nonzero(kept < healthy)))
        if len(few) < len(whole):
            known = max(1, round(known * len(few) / len(whole)))
        stretches = tuple(episodes(few, series.prior, years=years, known=known, allowed=series.allowed))
        rows = tuple(int(kept[np.argmin(np.abs(whole.t - t))]) for t in few.t)
    points, places = _points(line, series, notes, first)
    trend = Trend(
        verdict="cannot tell",
        reason="",
        basis=line.basis,
        unit="L/min" if series is not None and series.states_flow else "%",
        pressure=series.pressure if series is not None and series.states_flow else None,
        points=points,
        groups=line.groups,
        episodes=stretches,
        rows=tuple(places[row] for row in rows),
        repair=repair,
        machine=every[0].machine if every else None,
        findings=tuple(findings),
        years=years,
        healthy=healthy,
        dated=dated,
    )
    verdict, reason = _verdict(trend)
    return replace(trend, verdict=verdict, reason=reason)


@dataclass(frozen=True, eq=False)
class _Series:
    """Levels of readings in the trend's unit, and their prior.

    `states_flow`: whether the unit is L/min, at the `pressure` [Pa]; `allowed`: rise at which a repair is due, None
    where it cannot be stated in the unit.
    """

    levels: Levels
    prior: WearPrior
    states_flow: bool
    pressure: float
    allowed: float | None


def _series(line: Timeline, first: float, healthy: int, repair: RepairLimit) -> _Series | None:
    if line.basis is None:
        return None
    readings = line.readings
    t = np.array([((reading.start or 0.0) - first) / DAY for reading in readings])
    value = np.array([reading.level.value for reading in readings])
    error = np.array([reading.level.error for reading in readings])
    usual = float(np.mean(value[:healthy]))
    pressure = float(np.median([reading.pressure for reading in readings]))
    scatter = scatter_of(line.basis, usual)
    covariate, slope_sd = np.zeros(t.size), 0.0
    temperatures = [reading.temperature for reading in readings]
    if line.basis != "ringing" and all(own is not None for own in temperatures):
        warmer = np.array(temperatures, dtype=float) - float(temperatures[0] or 0.0)
        factor = np.exp(-_PER_KELVIN * warmer)
        value, error = value * factor, error * factor
        covariate, slope_sd = warmer, _PER_KELVIN_SD * abs(usual)
    flows = all(reading.states_flow for reading in readings)
    unit = pressure / LITRE_PER_MINUTE if flows else 100.0 / max(abs(usual), float(np.finfo(float).tiny))
    if line.basis == "ringing":
        unit, value = 100.0, value - usual
    allowed = None
    if repair.kind == "flow" and flows:
        allowed = repair.value / LITRE_PER_MINUTE
    elif repair.kind == "creep" and readings[0].area is not None:
        allowed = repair.value * readings[0].area / pressure * unit
    levels = Levels(t, value * unit, error * unit, line.group, covariate, slope_sd * unit)
    prior = WearPrior(replace(scatter, scale=scatter.scale * unit))
    return _Series(levels, prior, flows, pressure, allowed)


def _points(
    line: Timeline, series: _Series | None, notes: dict[int, str], first: float
) -> tuple[tuple[TrendPoint, ...], dict[int, int]]:
    """Return all recordings in the order of their times, and the place among them of each that takes part."""
    made: list[tuple[TrendPoint, int]] = []
    for k, reading in enumerate(line.readings if series is not None else ()):
        assert series is not None
        value, half = float(series.levels.value[k]), 1.96 * float(series.levels.error[k])
        point = TrendPoint(
            reading.file,
            reading.start or 0.0,
            float(series.levels.t[k]),
            value,
            value - half,
            value + half,
            int(line.group[k]),
            reading.temperature,
            notes.get(k, ""),
        )
        made.append((point, k))
    for reading, reason in line.left_out:
        start = reading.start or 0.0
        point = TrendPoint(
            reading.file, start, (start - first) / DAY, None, None, None, -1, reading.temperature, reason
        )
        made.append((point, -1))
    made.sort(key=lambda own: (own[0].start, own[0].file))
    return tuple(point for point, _ in made), {k: place for place, (_, k) in enumerate(made) if k >= 0}


def _verdict(trend: Trend) -> tuple[Verdict, str]:
    """Return the verdict and why."""
    wear = trend.wear
    if wear is None:
        reasons = dict.fromkeys(point.note for point in trend.points if point.note)
        return "cannot tell", "no recording states a level" + (f": {next(iter(reasons))}" if reasons else "")
    last = trend.episodes[-1]
    rate = f"1 false alarm in {trend.years:g} machine-years"
    if trend.basis == "ringing":
        if last.alarm is None:
            return "cannot tell", (
                f"the damping of the pressures' ringing did not change beyond the machine's own scatter ({rate}); it "
                "states no flow"
            )
        return "cannot tell", (
            f"the damping of the pressures' ringing rose beyond the machine's own scatter ({rate}): a leak, warmer "
            "oil, or another machine; without angle and position, or command, they cannot be told apart"
        )
    if last.alarm is not None:
        shape = "grows" if wear.step is None else "stepped up"
        return "leak", (
            f"the leakage {shape} beyond the machine's own scatter ({rate}); pump and piston are not told apart"
        )
    count = last.end - last.begin
    if count < _FEWEST:
        return "cannot tell", f"{count} comparable recordings are too few, {_FEWEST} are needed"
    found = _FOUND * max(wear.scatter, (wear.healthy.high - wear.healthy.low) / 3.92)
    if trend.limit is not None and wear.healthy.value + found > trend.limit:
        return "cannot tell", (
            f"the level scatters so much from recording to recording that a rise to the limit would not surely show: "
            f"{found:.2g} {trend.unit} would"
        )
    since = " since the repair" if last.fell else ""
    return "no leak", (
        f"no rise beyond the machine's own scatter{since} ({rate}); a step of {found:.2g} {trend.unit} would have shown"
    )
