"""Count each detector's alarms on groups of records: by size of the leak, levels of the factors, fault or family."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sealscope.campaigns.cases.row import expected_cause, matches_cause
from sealscope.campaigns.judging.verdicts import JudgedRow, Verdicts, group_by
from sealscope.campaigns.plans.duty import ALL_FAMILIES, FAMILY
from sealscope.evaluation.binomial import IntervalEstimate, Proportion, proportion
from sealscope.evaluation.table import CANNOT_TELL, events_per_hour

#: Reference detectors that ignore the record; they are listed for comparison.
ALWAYS, NEVER = "always fire", "never fire"
#: Label of all laws of a leak together.
ANY_LAW = "any"


@dataclass(frozen=True)
class AlarmFractions:
    """Fractions of alarms, missing verdicts and correct statements of one detector on a group of records.

    The group is defined by `leak_lpm` (0: no leak, nan: any size), `law`, `fault`, `family` and `levels`.

    - `alarms`: fraction with the verdict `leak`
    - `cannot_tell`: fraction with the verdict `cannot tell`, which includes the records without a result
    - `failed`: number of records without a result
    - `coverage`: of the intervals stated for the leak flow, fraction that contains the true flow
    - `named`: fraction with an alarm that names the cause of the group's `fault`; None without stated verdicts
    - `false_alarm`, `per_hour`: fraction of leak-free records with an alarm, and false alarms per operating hour; only
      in results by size of the leak, None without leak-free records or (`per_hour`) operating time
    """

    detector: str
    alarms: Proportion
    cannot_tell: Proportion
    coverage: Proportion
    false_alarm: Proportion | None = None
    per_hour: IntervalEstimate | None = None
    leak_lpm: float = 0.0
    law: str = ANY_LAW
    fault: str = ""
    family: str = ALL_FAMILIES
    levels: Mapping[str, str | float] = field(default_factory=dict)
    named: Proportion | None = None
    failed: int = 0

    @property
    def leak(self) -> str:
        """Mean flow [L/min] and law of the leak as text, such as "0.05 laminar", or "no leak"."""
        return f"{self.leak_lpm:g} {self.law}" if self.leak_lpm else "no leak"

    @property
    def informedness(self) -> float:
        """Youden's J of a group with a leak: fraction of alarms minus `false_alarm`, nan if that is None."""
        return self.alarms.value - self.false_alarm.value if self.false_alarm else math.nan


def add_references(verdicts: Verdicts) -> Verdicts:
    """Add the verdicts of two reference detectors, which always or never raise an alarm."""
    records = next(iter(verdicts.values()))  # the same for all detectors
    references = {
        name: [JudgedRow(record.row, verdict, None) for record in records]
        for name, verdict in ((ALWAYS, "leak"), (NEVER, "no leak"))
    }
    return {**verdicts, **references}


def alarms_by_size(
    verdicts: Verdicts, confidence: float, hours: float | None, pooled: bool = False
) -> Iterator[AlarmFractions]:
    """Yield the fractions of alarms of each detector for each size of leak; if `pooled`, for all sizes together.

    The size is the planned mean flow. If all records are leak-free, each detector has one result: 0 alarms of 0
    records. `hours`: operating time of one record [h], None to omit the rate of false alarms.
    """
    for name, records in verdicts.items():
        leak_free = [record for record in records if not record.size]
        leaky = [record for record in records if record.size]
        false_alarm = _fraction((record.alarm for record in leak_free), confidence) if leak_free else None
        per_hour = None
        if false_alarm and hours:
            per_hour = events_per_hour(false_alarm.count, hours * false_alarm.n, confidence)
        groups = group_by(leaky or leak_free, lambda record: math.nan if pooled else record.size)
        for size, group in groups.items():
            fractions = _summarise(name, group, confidence, leak_lpm=size)
            detected = fractions.alarms if leaky else _fraction((), confidence)  # 0 of 0
            yield replace(fractions, alarms=detected, false_alarm=false_alarm, per_hour=per_hour)


def alarms_by_cell(verdicts: Verdicts, confidence: float) -> Iterator[AlarmFractions]:
    """Yield each detector's fractions of alarms for each size of leak and combination of the factors' levels."""
    for name, records in verdicts.items():
        # levels as text, since mixed types cannot be sorted
        cells = group_by(records, lambda record: (record.size, repr(tuple(record.row.levels.items()))))
        for (size, _), group in cells.items():
            yield _summarise(name, group, confidence, leak_lpm=size, levels=dict(group[0].row.levels))


def alarms_by_fault(verdicts: Verdicts, confidence: float) -> Iterator[AlarmFractions]:
    """Yield each detector's fraction of alarms for each fault without a piston leak."""
    for name, records in verdicts.items():
        faulty = (record for record in records if record.row.fault and record.size == 0)
        for fault, group in group_by(faulty, lambda record: record.row.fault).items():
            yield _summarise(name, group, confidence, fault=fault)


def alarms_by_family(verdicts: Verdicts, confidence: float) -> Iterator[AlarmFractions]:
    """Yield each detector's fractions of alarms for each family of machines, size of leak and law of the leak.

    The results of all families together come first. A size that occurs with several laws also has a result for all laws
    together, and leak-free records have only this result.
    """
    for name, records in verdicts.items():
        members = (record for record in records if FAMILY in record.row.levels)
        families = group_by(members, lambda record: str(record.row.levels[FAMILY]))
        if not families:
            continue
        for family, family_records in {ALL_FAMILIES: records, **families}.items():
            for size, group in group_by(family_records, lambda record: record.size).items():
                laws = group_by(group, lambda record: record.row.law) if size else {}  # size 0: leak-free
                by_law = laws if len(laws) == 1 else {ANY_LAW: group, **laws}
                for law, law_records in by_law.items():
                    yield _summarise(name, law_records, confidence, family=family, leak_lpm=size, law=law)


def _fraction(flags: Iterable[bool], confidence: float) -> Proportion:
    """Compute the fraction of flags that are True, with its confidence interval."""
    values = list(flags)
    return proportion(sum(values), len(values), confidence)


def _summarise(detector: str, group: Sequence[JudgedRow], confidence: float, **group_fields: Any) -> AlarmFractions:
    """Compute a detector's fractions of alarms on a group of records, which the fields `group_fields` describe."""
    statements = [(record.flow_lpm, record.statement) for record in group if record.statement is not None]
    intervals = [(flow, statement.leak_interval_lpm) for flow, statement in statements]
    names_fault = (
        record.alarm and matches_cause(record.named_cause, expected_cause(record.row.fault)) for record in group
    )
    return AlarmFractions(
        detector=detector,
        alarms=_fraction((record.alarm for record in group), confidence),
        cannot_tell=_fraction((record.verdict == CANNOT_TELL for record in group), confidence),
        coverage=_fraction(
            (interval[0] <= flow <= interval[1] for flow, interval in intervals if interval is not None), confidence
        ),
        named=_fraction(names_fault, confidence) if statements else None,
        failed=sum(record.row.error is not None for record in group),
        **group_fields,
    )
