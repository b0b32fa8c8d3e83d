"""The table that judges detectors alike: by detector and size of leak, beside one that always fires and one that never
does."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable
from dataclasses import dataclass

from sealscope.errors import InputError
from sealscope.evaluation.binomial import Rate, rate_of
from sealscope.evaluation.confusion import CANNOT_TELL
from sealscope.evaluation.quantiles import Quantile
from sealscope.evaluation.rates import EstimateError, HourlyRate, delays, estimate_error, hourly_rate

ALWAYS, NEVER = "always fire", "never fire"
_VERDICTS = ("leak", "no leak", CANNOT_TELL)


@dataclass(frozen=True)
class Outcome:
    """What one detector said of one record, beside the truth.

    `case`: the record, the same name for each detector; `leak_lpm`: the true size, 0 without a leak, in L/min (any
    unit, the estimate's too); `hours`: operating time of the record; `alarm_s` and `onset_s`: time of the alarm and
    true onset in the record, where both are known; `estimate_lpm` with its interval, where there is one.
    """

    detector: str
    case: Hashable
    leak_lpm: float
    verdict: str
    hours: float | None = None
    alarm_s: float | None = None
    onset_s: float | None = None
    estimate_lpm: float | None = None
    estimate_interval_lpm: tuple[float, float] | None = None

    @property
    def premature(self) -> bool:
        """Whether the alarm came before the leak did."""
        timed = self.alarm_s is not None and self.onset_s is not None
        return self.verdict == "leak" and timed and self.alarm_s < self.onset_s  # type: ignore[operator]

    @property
    def detects(self) -> bool:
        """Whether it is an alarm, and not before the onset."""
        return self.verdict == "leak" and not self.premature


@dataclass(frozen=True)
class SummaryRow:
    """One detector at one size of leak.

    `detection`: alarms over all `n` records of that size, an alarm before the onset and `cannot tell` not among them;
    `cannot_tell`: over the same records; `false_alarm` and `per_hour`: of that detector on its leak-free records (None
    where there are none, or no hours); `informedness`: detection less false alarms, 0 for chance; `delay` (median) and
    `delay_ninety` [s] over all the leaks, None where onsets are unknown; `estimate`: error in L/min, where estimated.
    """

    detector: str
    leak_lpm: float
    n: int
    detection: Rate
    cannot_tell: Rate
    false_alarm: Rate | None
    per_hour: HourlyRate | None
    informedness: float
    delay: Quantile | None
    delay_ninety: Quantile | None
    estimate: EstimateError | None


def _checked(rows: Iterable[Outcome]) -> list[Outcome]:
    """The rows, each sound; the same case has the same truth for each detector, and is judged once by each."""
    sound: list[Outcome] = []
    truth: dict[Hashable, float] = {}
    judged: set[tuple[str, Hashable]] = set()
    for row in rows:
        if row.verdict not in _VERDICTS:
            raise InputError(f"the verdict must be one of {', '.join(_VERDICTS)}, got {row.verdict!r} ({row.case})")
        if not (math.isfinite(row.leak_lpm) and row.leak_lpm >= 0.0):
            raise InputError(f"the size of the leak must be >= 0, got {row.leak_lpm} ({row.case})")
        if row.detector in (ALWAYS, NEVER):
            raise InputError(f"the rows {ALWAYS!r} and {NEVER!r} are added by the summary itself")
        if truth.setdefault(row.case, row.leak_lpm) != row.leak_lpm:
            raise InputError(f"a case must have one true size, got {truth[row.case]} and {row.leak_lpm} ({row.case})")
        if (row.detector, row.case) in judged:
            raise InputError(f"a case must be judged once by each detector, got two rows ({row.detector}, {row.case})")
        judged.add((row.detector, row.case))
        sound.append(row)
    if not sound:
        raise InputError("a summary needs at least one row")
    return sound


def _references(rows: list[Outcome]) -> list[Outcome]:
    """The two detectors that do not look, on every case that any detector judged."""
    cases = {row.case: row for row in rows}
    return [
        Outcome(name, case, row.leak_lpm, verdict, row.hours)
        for name, verdict in ((ALWAYS, "leak"), (NEVER, "no leak"))
        for case, row in cases.items()
    ]


def _delay(rows: list[Outcome], confidence: float) -> tuple[Quantile | None, Quantile | None]:
    """Delays over all rows; none where an onset is unknown, or an alarm has no time."""
    if any(row.onset_s is None or (row.verdict == "leak" and row.alarm_s is None) for row in rows):
        return None, None
    alarms = [row.alarm_s if row.verdict == "leak" and row.alarm_s is not None else math.nan for row in rows]
    found = delays(alarms, [row.onset_s or 0.0 for row in rows], confidence)
    return found.median, found.ninety


def _estimate(rows: list[Outcome], confidence: float) -> EstimateError | None:
    if all(row.estimate_lpm is None for row in rows):
        return None
    limits = [row.estimate_interval_lpm or (math.nan, math.nan) for row in rows]
    return estimate_error(
        [math.nan if row.estimate_lpm is None else row.estimate_lpm for row in rows],
        [row.leak_lpm for row in rows],
        [low for low, _ in limits],
        [high for _, high in limits],
        confidence,
    )


def _false_alarms(leak_free: list[Outcome], confidence: float) -> tuple[Rate | None, HourlyRate | None]:
    if not leak_free:
        return None, None
    count = sum(row.verdict == "leak" for row in leak_free)
    hours = [row.hours for row in leak_free if row.hours is not None]
    hourly = hourly_rate(count, math.fsum(hours), confidence) if len(hours) == len(leak_free) else None
    return rate_of(count, len(leak_free), confidence), hourly


def summary(rows: Iterable[Outcome], confidence: float = 0.95) -> list[SummaryRow]:
    """One row for each detector and size of leak, sizes rising, and the rows `always fire` and `never fire` last.

    A detector without a record with a leak has one row of size 0, with no detection. Intervals as in `rate_of`,
    `hourly_rate`, `delays` and `estimate_error`. Raises InputError for an unknown verdict, a size < 0, a case with two
    truths or one judged twice.
    """
    sound = _checked(rows)
    table: list[SummaryRow] = []
    by_detector: dict[str, list[Outcome]] = {}
    for row in [*sound, *_references(sound)]:
        by_detector.setdefault(row.detector, []).append(row)
    for detector, own in by_detector.items():
        alarm, hourly = _false_alarms([row for row in own if row.leak_lpm == 0.0], confidence)
        by_size: dict[float, list[Outcome]] = {}
        for row in own:
            if row.leak_lpm > 0.0:
                by_size.setdefault(row.leak_lpm, []).append(row)
        for size in sorted(by_size) or [0.0]:
            here = by_size.get(size, [])
            detection = rate_of(sum(row.detects for row in here), len(here), confidence)
            unsure = here or own
            delay, ninety = _delay(here, confidence) if here else (None, None)
            table.append(
                SummaryRow(
                    detector=detector,
                    leak_lpm=size,
                    n=len(unsure),
                    detection=detection,
                    cannot_tell=rate_of(sum(r.verdict == CANNOT_TELL for r in unsure), len(unsure), confidence),
                    false_alarm=alarm,
                    per_hour=hourly,
                    informedness=detection.rate - alarm.rate if alarm else math.nan,
                    delay=delay,
                    delay_ninety=ninety,
                    estimate=_estimate(here, confidence) if here else None,
                )
            )
    return table
