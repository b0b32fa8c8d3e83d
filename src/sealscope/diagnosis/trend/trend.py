"""The trend of a machine over its recordings: level, healthy band, change, growth, and when it reaches a limit."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.decision.verdicts import decide_verdict
from sealscope.diagnosis.inference.onset import WITHIN_95, Interval
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.trend.reading import (
    Basis,
    LeakReading,
    TrendPoint,
    findings_of,
    reading_of,
    scatter_of,
    timeline,
)
from sealscope.diagnosis.trend.wear import Episode, Levels, Wear, episodes, outlier_excess
from sealscope.diagnosis.verdict.evidence import CANNOT_TELL, LEAK, NO_LEAK, Verdict
from sealscope.diagnosis.verdict.machine import AssumedMachine
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.diagnosis.verdict.states import MachineState, state_of
from sealscope.errors import InputError
from sealscope.recordings.formats.columns import listed
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.storage.plain_values import plain
from sealscope.units import DAY, LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig


#: Fewest comparable recordings of which a trend is stated.
FEWEST = 3


@dataclass(frozen=True)
class Trend:
    """Leakage of a single machine over time, from its recordings.

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
        """Wear of the last stretch, None where there is no level."""
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
        return tuple(self.points[self.rows[episode.begin]] for episode in self.episodes if episode.fell)

    @property
    def next_check(self) -> str:
        """Next check on the machine."""
        if self.verdict == NO_LEAK:
            return "Nothing needs a check; go on recording under the same duty."
        if self.verdict == LEAK:
            return state_of(LEAK, "piston or pump leak").action
        if self.wear is None:
            return state_of(CANNOT_TELL).action
        return "Go on recording under the same duty, and compare the level with what a new machine passes."

    @property
    def state(self) -> MachineState:
        """State of the machine as NAMUR NE 107 names it, as of a diagnosis."""
        over = self.verdict == LEAK and self.wear is not None and self.limit is not None
        if over and self.wear.now.low > self.limit:  # type: ignore[union-attr, operator]
            return state_of("leak over the limit", action=self.next_check)
        return state_of("watched" if self.verdict == NO_LEAK else self.verdict, action=self.next_check)

    def as_dict(self) -> dict[str, Any]:
        """Return the trend as plain JSON values; a number that is not finite becomes null."""
        alarm, days = self.alarm, [point.day for point in self.points] or [math.nan]
        names = ("now", "healthy", "scatter", "growth", "step", "onset", "reach")
        now, healthy, scatter, growth, step, onset, reach = (self.wear and getattr(self.wear, name) for name in names)
        points = [
            {"file": point.file, "time": self._moment(point.day), "day": point.day}
            | {
                "value": point.value,
                "low": point.low,
                "high": point.high,
                "group": None if point.group < 0 else point.group,
            }
            | {"temperature_C": point.temperature, "note": point.note}
            for point in self.points
        ]
        return plain(  # type: ignore[no-any-return]
            {
                "verdict": self.verdict,
                "reason": self.reason,
                "basis": self.basis,
                "unit": self.unit,
                "pressure_Pa": self.pressure,
                "recordings": len(points),
                "compared": len(self.rows),
                "first": self._moment(days[0]),
                "last": self._moment(days[-1]),
                "now": now,
                "healthy": healthy,
                "day_to_day": scatter,
                "growth_per_month": growth,
                "step": step,
                "onset": self._moments(onset),
                "alarm": alarm and {"file": alarm.file, "time": self._moment(alarm.day)},
                "repairs": [{"file": point.file, "time": self._moment(point.day)} for point in self.repairs],
                "limit": self.limit,
                "repair_limit": self.repair.as_dict(),
                "days_to_limit": reach,
                "limit_reached": self._moments(reach and Interval(*(days[-1] + wait for wait in reach))),
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

    def _moment(self, day: float) -> str | float | None:
        """Format a time as an ISO stamp, or in days if the times are not known."""
        if not math.isfinite(day) or not self.dated:
            return day
        return str(np.datetime64(round((self.points[0].start + (day - self.points[0].day) * DAY) * 1e3), "ms"))[:19]

    def _moments(self, days: Interval | None) -> dict[str, str | float | None] | None:
        return days and {name: self._moment(day) for name, day in days._asdict().items()}


@checked_call
def trend(
    recordings: Iterable[Recording | LeakReading],
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
        Recordings of the machine, in any order, or readings of them; copies count once.
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
    if not (isinstance(healthy, int) and healthy >= 1):
        raise InputError(f"the number of healthy recordings must be 1 or more, got {healthy!r}")
    if not 0.1 <= years <= 1000.0:
        raise InputError(f"machine-years to a false alarm must be 0.1 to 1000, got {years!r}")
    if every is not None and not (math.isfinite(every) and every > 0.0):
        raise InputError(f"every must be > 0 s, got {every!r}")
    readings = [
        recording if isinstance(recording, LeakReading) else reading_of(recording, rig) for recording in recordings
    ]
    points, differences = timeline(readings, every)
    return _make_trend(
        points, differences, repair=RepairLimit.of(limit), years=years, healthy=healthy, dated=every is None
    )


def _make_trend(points: Sequence[TrendPoint], differences: tuple[str, ...], **stated: Any) -> Trend:
    """Make the trend of readings in the order of their times; `stated`: further fields of it."""
    rows = tuple(k for k, point in enumerate(points) if point.group >= 0)
    kept = [points[k] for k in rows]
    flows = bool(kept) and all(point.states_flow for point in kept)
    trend = Trend(
        verdict=decide_verdict(False, math.inf, 0.0),
        reason="",
        basis=kept[0].basis if kept else None,
        unit="L/min" if flows else "%",
        pressure=float(np.median([point.pressure for point in kept])) if flows else None,
        points=tuple(points),
        groups=differences,
        episodes=(),
        rows=rows,
        machine=points[0].machine if points else None,
        findings=tuple(findings_of(points, differences)),
        **stated,
    )
    if kept:
        trend = _with_levels(trend)
    verdict, reason = _verdict(trend)
    return replace(trend, verdict=verdict, reason=reason)


def _with_levels(trend: Trend) -> Trend:
    """Add levels and episodes to a trend of at least one comparable recording."""
    levels, allowed = _levels(trend)
    merged, points, rows = levels.merged(), [*trend.points], trend.rows
    outliers = np.flatnonzero(outlier_excess(levels)[1])
    remark = "apart from the recordings before and after: it counts as if it were near"
    findings = [*trend.findings]
    if outliers.size:
        files = listed((points[rows[k]].file for k in outliers), 3)
        text = f"{outliers.size} of {len(points)} {remark} ({files})"
        findings.append(Finding("outlier", "warning", None, outliers.size, None, text))
    for k, row in enumerate(rows):
        value, half = float(levels.value[k]), WITHIN_95 * float(levels.error[k])
        note = remark if k in outliers else ""
        points[row] = replace(points[row], value=value, low=value - half, high=value + half, note=note)
    healthy_count = max(1, _count_healthy(trend) * len(merged) // len(levels))
    return replace(
        trend,
        points=tuple(points),
        findings=tuple(findings),
        episodes=tuple(episodes(merged, years=trend.years, known=healthy_count, allowed=allowed)),
        rows=tuple(rows[int(np.argmin(np.abs(levels.t - t)))] for t in merged.t) if merged is not levels else rows,
    )


def _count_healthy(trend: Trend) -> int:
    """Count the compared recordings among the first ones, known to be healthy; at least the first."""
    first = dict.fromkeys(point.digest for point in trend.points)  # a copy counts once
    healthy_digests = {*islice(first, trend.healthy)}
    return max(1, sum(trend.points[row].digest in healthy_digests for row in trend.rows))


def _levels(trend: Trend) -> tuple[Levels, float | None]:
    """Return the levels in the trend's unit, and the rise at which a repair is due, None where unknown."""
    kept = [trend.points[k] for k in trend.rows]
    t, group, value, error = (
        np.array([getattr(point, name) for point in kept]) for name in ("day", "group", "level", "error")
    )
    usual, pressure = (
        float(np.mean(value[: _count_healthy(trend)])),
        float(np.median([point.pressure for point in kept])),
    )
    prior = scatter_of(trend.basis or "ringing", usual)
    warmer, slope_sd = np.zeros(t.size), 0.0
    temperatures = [point.temperature for point in kept if point.temperature is not None]
    if trend.basis != "ringing" and len(temperatures) == t.size:
        slope, deviation = (priors("inference")["oil"][name] for name in ("per_kelvin", "per_kelvin_deviation"))
        warmer, slope_sd = np.array(temperatures) - temperatures[0], deviation * abs(usual)
        value, error = (values * np.exp(-slope * warmer) for values in (value, error))
    flows = trend.pressure is not None
    unit = pressure / LITRE_PER_MINUTE if flows else 100.0 / max(abs(usual), float(np.finfo(float).tiny))
    if trend.basis == "ringing":
        unit, value = 100.0, value - usual
    allowed = None
    if trend.repair.kind == "flow" and flows:
        allowed = trend.repair.value / LITRE_PER_MINUTE
    elif trend.repair.kind == "creep" and kept[0].area is not None:
        allowed = trend.repair.value * kept[0].area / pressure * unit
    prior = prior._replace(scale=prior.scale * unit)
    return Levels(t, value * unit, error * unit, group, warmer, prior, slope_sd * unit), allowed


def _verdict(trend: Trend) -> tuple[Verdict, str]:
    """Decide on a trend by its alarm and by the step that would have shown, and say why."""
    rate, wear = f"1 false alarm in {trend.years:g} machine-years", trend.wear
    if wear is None:
        notes = dict.fromkeys(point.note for point in trend.points if point.note)
        reason = ": ".join(["no recording states a level", *list(notes)[:1]])
        return decide_verdict(False, math.inf, 0.0), reason
    last, beyond_scatter = trend.episodes[-1], f"beyond the machine's own scatter ({rate})"
    if trend.basis == "ringing":
        ringing = "the damping of the pressures' ringing"
        reason = f"{ringing} did not change {beyond_scatter}; it states no flow"
        if last.alarm is not None:
            reason = (
                f"{ringing} rose {beyond_scatter}: a leak, warmer oil, or another machine; without angle and position, "
                "or command, they cannot be told apart"
            )
        return decide_verdict(False, math.inf, 0.0), reason
    if last.alarm is not None:
        shape = "grows" if wear.step is None else "stepped up"
        reason = f"the leakage {shape} {beyond_scatter}; pump and piston are not told apart"
        return decide_verdict(True, math.inf, 0.0), reason
    count = last.end - last.begin
    if count < FEWEST:
        reason = f"{count} comparable recordings are too few, {FEWEST} are needed"
        return decide_verdict(False, math.inf, 0.0), reason
    half = (wear.healthy.high - wear.healthy.low) / (2.0 * WITHIN_95)
    detectable = priors("trend")["course"]["detectable"] * max(wear.scatter, half)
    allowed = math.inf if trend.limit is None else trend.limit - wear.healthy.value
    verdict = decide_verdict(False, detectable, allowed)
    if verdict == NO_LEAK:
        since = " since the repair" if last.fell else ""
        return verdict, (
            f"no rise beyond the machine's own scatter{since} ({rate}); a step of {detectable:.2g} {trend.unit} would "
            "have shown"
        )
    return verdict, (
        f"the level scatters so much from recording to recording that a rise to the limit would not surely show: "
        f"{detectable:.2g} {trend.unit} would"
    )
