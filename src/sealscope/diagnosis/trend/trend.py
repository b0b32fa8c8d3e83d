"""The trend of a machine over its recordings: level, healthy band, change, growth, and when it reaches a limit."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.inference.onset import Interval
from sealscope.diagnosis.trend.reading import Basis, LeakReading, reading_of, scatter_of
from sealscope.diagnosis.trend.timeline import DAY, Timeline, spaced, timeline
from sealscope.diagnosis.trend.wear import DayToDay, Episode, Levels, Wear, beyond, episodes, merged
from sealscope.diagnosis.verdict.diagnosis import next_check
from sealscope.diagnosis.verdict.evidence import Verdict
from sealscope.diagnosis.verdict.machine import AssumedMachine
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.errors import InputError
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.signals.filters import IntArray
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
_APART = "apart from the recordings before and after: it counts as if it were near"


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
        reached = None if wear is None or wear.reach is None or not self.points else wear.reach
        last = self.points[-1].day if self.points else 0.0
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "basis": self.basis,
            "unit": self.unit,
            "pressure_Pa": _plain(self.pressure),
            "recordings": len(self.points),
            "compared": len(self.rows),
            "first": self._moment(self.points[0].day) if self.points else None,
            "last": self._moment(last) if self.points else None,
            "now": None if wear is None else _interval(wear.now),
            "healthy": None if wear is None else _interval(wear.healthy),
            "day_to_day": None if wear is None else _plain(wear.scatter),
            "growth_per_month": None if wear is None else _interval(wear.growth),
            "step": None if wear is None or wear.step is None else _interval(wear.step),
            "onset": None if wear is None or wear.onset is None else self._moments(*wear.onset),
            "alarm": None if alarm is None else {"file": alarm.file, "time": self._moment(alarm.day)},
            "repairs": [{"file": point.file, "time": self._moment(point.day)} for point in self.repairs],
            "limit": _plain(self.limit),
            "repair_limit": self.repair.as_dict(),
            "days_to_limit": None if reached is None else _interval(reached),
            "limit_reached": None if reached is None else self._moments(*(last + days for days in reached)),
            "false_alarm_years": self.years,
            "healthy_recordings": self.healthy,
            "rig": None if self.machine is None else self.machine.as_dict(),
            "groups": list(self.groups),
            "points": [
                {
                    "file": point.file,
                    "time": self._moment(point.day),
                    "day": point.day,
                    **{name: _plain(getattr(point, name)) for name in ("value", "low", "high")},
                    "group": None if point.group < 0 else point.group,
                    "temperature_C": _plain(point.temperature),
                    "note": point.note,
                }
                for point in self.points
            ],
            "findings": [
                {name: getattr(finding, name) for name in ("code", "count", "severity", "text")}
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

    def _moments(self, *days: float) -> dict[str, str | float | None]:
        return dict(zip(("value", "low", "high"), map(self._moment, days), strict=True))


def _plain(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _interval(interval: Interval) -> dict[str, float | None]:
    return {name: _plain(value) for name, value in interval._asdict().items()}


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
    kept = np.flatnonzero(line.group >= 0)
    series = _series(line, kept, healthy, repair) if kept.size else None
    findings, rows = list(line.findings), kept
    stretches: tuple[Episode, ...] = ()
    points = [_point(reading, line.readings[0], note) for reading, note in zip(line.readings, line.notes, strict=True)]
    if series is not None:
        levels, few = series.levels, merged(series.levels)
        alone = np.flatnonzero(beyond(levels, series.prior)[1])
        if alone.size:
            files = ", ".join(line.readings[int(kept[k])].file for k in alone[:3])
            text = f"{alone.size} of {len(points)} {_APART} ({files})"
            findings.append(Finding("outlier", "warning", None, int(alone.size), None, text))
        for k, row in enumerate(kept):
            value, half = float(levels.value[k]), 1.96 * float(levels.error[k])
            points[row] = replace(
                points[row],
                value=value,
                low=value - half,
                high=value + half,
                group=int(line.group[row]),
                note=_APART if k in alone else "",
            )
        known = max(1, round(healthy * len(few) / len(levels)))
        stretches = tuple(episodes(few, series.prior, years=years, known=known, allowed=series.allowed))
        if len(few) < len(levels):
            rows = kept[[int(np.argmin(np.abs(levels.t - t))) for t in few.t]]
    trend = Trend(
        verdict="cannot tell",
        reason="",
        basis=line.basis,
        unit="L/min" if series is not None and series.states_flow else "%",
        pressure=series.pressure if series is not None and series.states_flow else None,
        points=tuple(points),
        groups=line.groups,
        episodes=stretches,
        rows=tuple(map(int, rows)),
        repair=repair,
        machine=line.readings[0].machine if line.readings else None,
        findings=tuple(findings),
        years=years,
        healthy=healthy,
        dated=dated,
    )
    verdict, reason = _verdict(trend)
    return replace(trend, verdict=verdict, reason=reason)


class _Series(NamedTuple):
    """Levels of readings in the trend's unit, and their prior.

    `states_flow`: whether the unit is L/min, at the `pressure` [Pa]; `allowed`: rise at which a repair is due, None
    where it cannot be stated in the unit.
    """

    levels: Levels
    prior: DayToDay
    states_flow: bool
    pressure: float
    allowed: float | None


def _series(line: Timeline, kept: IntArray, healthy: int, repair: RepairLimit) -> _Series:
    readings = [line.readings[k] for k in kept]
    t = np.array([_day(reading, line.readings[0]) for reading in readings])
    value, error = (np.array([reading.level[k] for reading in readings]) for k in (0, 1))
    usual, pressure = float(np.mean(value[:healthy])), float(np.median([reading.pressure for reading in readings]))
    scatter = scatter_of(line.basis or "ringing", usual)
    warmer, slope_sd = np.zeros(t.size), 0.0
    temperatures = [reading.temperature for reading in readings if reading.temperature is not None]
    if line.basis != "ringing" and len(temperatures) == t.size:
        warmer, slope_sd = np.array(temperatures) - temperatures[0], _PER_KELVIN_SD * abs(usual)
        value, error = value * np.exp(-_PER_KELVIN * warmer), error * np.exp(-_PER_KELVIN * warmer)
    flows = all(reading.states_flow for reading in readings)
    unit = pressure / LITRE_PER_MINUTE if flows else 100.0 / max(abs(usual), float(np.finfo(float).tiny))
    if line.basis == "ringing":
        unit, value = 100.0, value - usual
    allowed = None
    if repair.kind == "flow" and flows:
        allowed = repair.value / LITRE_PER_MINUTE
    elif repair.kind == "creep" and readings[0].area is not None:
        allowed = repair.value * readings[0].area / pressure * unit
    levels = Levels(t, value * unit, error * unit, line.group[kept], warmer, slope_sd * unit)
    return _Series(levels, scatter._replace(scale=scatter.scale * unit), flows, pressure, allowed)


def _day(reading: LeakReading, first: LeakReading) -> float:
    return ((reading.start or 0.0) - (first.start or 0.0)) / DAY


def _point(reading: LeakReading, first: LeakReading, note: str) -> TrendPoint:
    """Return the point of a recording that is left out."""
    day, start = _day(reading, first), reading.start or 0.0
    return TrendPoint(reading.file, start, day, None, None, None, -1, reading.temperature, note)


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
