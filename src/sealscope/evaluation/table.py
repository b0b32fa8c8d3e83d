"""The summary of detectors by size of leak, beside one that always fires and one that never does."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable
from dataclasses import dataclass

from sealscope.errors import InputError
from sealscope.evaluation.binomial import IntervalEstimate, Proportion, proportion
from sealscope.evaluation.checks import share
from sealscope.evaluation.confusion import CANNOT_TELL

ALWAYS, NEVER = "always fire", "never fire"
_VERDICTS = ("leak", "no leak", CANNOT_TELL)


@dataclass(frozen=True)
class JudgedRecord:
    """The verdict of one detector on one record, beside the truth.

    `case`: the record, the same name for each detector; `leak_lpm`: the true size, 0 without a leak, in L/min or any
    other unit; `hours`: operating time of the record, None where it is not known.
    """

    detector: str
    case: Hashable
    leak_lpm: float
    verdict: str
    hours: float | None = None


@dataclass(frozen=True)
class SummaryRow:
    """One detector at one size of leak.

    `detection`: alarms over all `n` records of that size, `cannot tell` not among them; `cannot_tell`: over the same
    records; `false_alarm` and `per_hour`: of that detector on its leak-free records (None where there are none, or no
    hours); `informedness`: detection less false alarms, 0 for chance.
    """

    detector: str
    leak_lpm: float
    n: int
    detection: Proportion
    cannot_tell: Proportion
    false_alarm: Proportion | None
    per_hour: IntervalEstimate | None
    informedness: float


def poisson_interval(count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the exact interval (low, high) of a Poisson mean after `count` events.

    ``low = G(alpha/2; k), high = G(1 - alpha/2; k + 1)``, G the quantile of the gamma distribution of that shape; 0
    where there was no event. Raises InputError for an impossible count or confidence. Source: Garwood, Biometrika 28
    (1936) 437-442, doi 10.1093/biomet/28.3-4.437.
    """
    from scipy.special import gammainccinv, gammaincinv

    if count < 0 or count != int(count):
        raise InputError(f"a number of events must be whole and >= 0, got {count}")
    tail = (1.0 - share(confidence, "confidence")) / 2.0
    return 0.0 if count == 0 else float(gammaincinv(count, tail)), float(gammainccinv(count + 1, tail))


def events_per_hour(count: int, hours: float, confidence: float = 0.95) -> IntervalEstimate:
    """Return events per operating hour with their exact interval; InputError unless `hours` > 0."""
    if not (math.isfinite(hours) and hours > 0.0):
        raise InputError(f"operating hours must be > 0, got {hours}")
    low, high = poisson_interval(count, confidence)
    return IntervalEstimate(int(count), count / hours, low / hours, high / hours)


def _checked(records: Iterable[JudgedRecord]) -> list[JudgedRecord]:
    """Return the records; a case has the same truth for each detector, and is judged once by each."""
    checked: list[JudgedRecord] = []
    truth: dict[Hashable, float] = {}
    judged: set[tuple[str, Hashable]] = set()
    for record in records:
        case, size = record.case, record.leak_lpm
        if record.verdict not in _VERDICTS:
            raise InputError(f"the verdict must be one of {', '.join(_VERDICTS)}, got {record.verdict!r} ({case})")
        if not (math.isfinite(size) and size >= 0.0):
            raise InputError(f"the size of the leak must be >= 0, got {size} ({case})")
        if record.detector in (ALWAYS, NEVER):
            raise InputError(f"the rows {ALWAYS!r} and {NEVER!r} are added by the summary itself")
        if truth.setdefault(case, size) != size:
            raise InputError(f"a case must have one true size, got {truth[case]} and {size} ({case})")
        if (record.detector, case) in judged:
            raise InputError(f"a case must be judged once by each detector, got two rows ({record.detector}, {case})")
        judged.add((record.detector, case))
        checked.append(record)
    if not checked:
        raise InputError("a summary needs at least one row")
    return checked


def _references(records: list[JudgedRecord]) -> list[JudgedRecord]:
    """Return the verdicts of the two detectors that do not look, on every case that any detector judged."""
    cases = {record.case: record for record in records}
    return [
        JudgedRecord(name, case, record.leak_lpm, verdict, record.hours)
        for name, verdict in ((ALWAYS, "leak"), (NEVER, "no leak"))
        for case, record in cases.items()
    ]


def _false_alarms(
    leak_free: list[JudgedRecord], confidence: float
) -> tuple[Proportion | None, IntervalEstimate | None]:
    if not leak_free:
        return None, None
    count = sum(record.verdict == "leak" for record in leak_free)
    hours = [record.hours for record in leak_free if record.hours is not None]
    hourly = events_per_hour(count, math.fsum(hours), confidence) if len(hours) == len(leak_free) else None
    return proportion(count, len(leak_free), confidence), hourly


def summary(records: Iterable[JudgedRecord], confidence: float = 0.95) -> list[SummaryRow]:
    """Return one row for each detector and size of leak, sizes rising, `always fire` and `never fire` last.

    A detector without a record with a leak has one row of size 0, with no detection. Intervals as in `proportion` and
    `events_per_hour`. Raises InputError for an unknown verdict, a size < 0, a case with two truths or one judged
    twice.
    """
    checked = _checked(records)
    rows: list[SummaryRow] = []
    by_detector: dict[str, list[JudgedRecord]] = {}
    for record in [*checked, *_references(checked)]:
        by_detector.setdefault(record.detector, []).append(record)
    for detector, own in by_detector.items():
        false_alarm, hourly = _false_alarms([record for record in own if record.leak_lpm == 0.0], confidence)
        by_size: dict[float, list[JudgedRecord]] = {}
        for record in own:
            if record.leak_lpm > 0.0:
                by_size.setdefault(record.leak_lpm, []).append(record)
        for size in sorted(by_size) or [0.0]:
            here = by_size.get(size, [])
            detection = proportion(sum(record.verdict == "leak" for record in here), len(here), confidence)
            counted = here or own
            unsure = sum(record.verdict == CANNOT_TELL for record in counted)
            rows.append(
                SummaryRow(
                    detector=detector,
                    leak_lpm=size,
                    n=len(counted),
                    detection=detection,
                    cannot_tell=proportion(unsure, len(counted), confidence),
                    false_alarm=false_alarm,
                    per_hour=hourly,
                    informedness=detection.value - false_alarm.value if false_alarm else math.nan,
                )
            )
    return rows
