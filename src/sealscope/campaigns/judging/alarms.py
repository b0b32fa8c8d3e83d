"""Alarms of each detector on records that have something in common: a size of leak, levels, a fault, a family."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sealscope.campaigns.cases.case import FAMILY
from sealscope.campaigns.cases.row import cause_of, covers, named_cause
from sealscope.campaigns.judging.verdicts import JudgedRow, Verdicts, grouped, without_fault
from sealscope.evaluation.binomial import IntervalEstimate, Proportion, proportion
from sealscope.evaluation.table import CANNOT_TELL, events_per_hour

#: Two detectors that do not look, beside which the others are shown.
ALWAYS, NEVER = "always fire", "never fire"
#: What stands for all families together, and for all laws of a leak.
ALL, ANY_LAW = "all", "any"


@dataclass(frozen=True)
class AlarmShares:
    """Alarms of one detector on records that have something in common.

    `leak_lpm` (0: no leak, nan: any) and `law` of the leak, `fault` that is no leak, `family` of machines, `levels` of
    the factors: what they have in common, where it was asked for. `coverage`: how often a stated interval holds the
    flow that there was; `false_alarm` and `per_hour`: of that detector on its leak-free records, None where there are
    none, or no hours; `named`: alarms that name the fault's cause, alone or with the piston, None where the detector
    names no cause; `failed`: records without a result, which are among those that cannot be told.
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
    family: str = ALL
    levels: Mapping[str, str | float] = field(default_factory=dict)
    named: Proportion | None = None
    failed: int = 0

    @property
    def leak(self) -> str:
        """Size and law of the leak, in words."""
        return f"{self.leak_lpm:g} {self.law}" if self.leak_lpm else "no leak"

    @property
    def informedness(self) -> float:
        """Share of alarms less that of false alarms, 0 for chance."""
        return self.alarms.value - self.false_alarm.value if self.false_alarm else math.nan


@dataclass(frozen=True)
class Alarms:
    """Counts of the alarms in the verdicts of each detector, with intervals of `confidence`."""

    verdicts: Verdicts
    confidence: float

    def _with_references(self) -> Verdicts:
        """Append the verdicts of two detectors that do not look: one always fires, one never."""
        rows = [record.row for record in next(iter(self.verdicts.values()), ())]
        always = {name: [JudgedRow(row, verdict, None) for row in rows]
                  for name, verdict in ((ALWAYS, "leak"), (NEVER, "no leak"))}  # fmt: skip
        return {**self.verdicts, **always}

    def by_size(self, hours: float | None, together: bool = False) -> Iterator[AlarmShares]:
        """Yield alarms by size, or of all sizes `together`, with false alarms; those of the references last.

        A detector without a record with a leak has one row of size 0, with no detection.
        """
        for name, records in without_fault(self._with_references()).items():
            free, leaky = ([record for record in records if bool(record.size) == leaks] for leaks in (False, True))
            alarms = self._share(record.alarm for record in free) if free else None
            hourly = events_per_hour(alarms.count, hours * alarms.n, self.confidence) if alarms and hours else None
            for size, group in grouped(leaky or free, lambda record: math.nan if together else record.size).items():
                shares = self._shares(name, group, leak_lpm=size)
                detected = shares.alarms if leaky else self._share(())
                yield replace(shares, alarms=detected, false_alarm=alarms, per_hour=hourly)

    def by_cell(self) -> Iterator[AlarmShares]:
        """Yield the alarms at each size in each cell of the factors."""
        for name, records in without_fault(self.verdicts).items():
            cells = grouped(records, lambda record: (record.size, repr(tuple(record.row.levels.items()))))
            for (size, _), group in cells.items():
                yield self._shares(name, group, leak_lpm=size, levels=dict(group[0].row.levels))

    def by_fault(self) -> Iterator[AlarmShares]:
        """Yield the alarms on records with each fault that is no piston leak."""
        for name, records in self._with_references().items():
            faulty = (record for record in records if record.row.fault and record.size == 0)
            for fault, group in grouped(faulty, lambda record: record.row.fault).items():
                yield self._shares(name, group, fault=fault)

    def by_family(self) -> Iterator[AlarmShares]:
        """Yield the alarms by family, size and law; all families together first, none where there are no families.

        Each size has its laws apart, and together where there are several.
        """
        for name, records in without_fault(self.verdicts).items():
            members = (record for record in records if FAMILY in record.row.levels)
            families = grouped(members, lambda record: str(record.row.levels[FAMILY]))
            for family, relatives in {ALL: records, **families}.items() if families else ():
                for size, group in grouped(relatives, lambda record: record.size).items():
                    laws = grouped(group, lambda record: record.row.law) if size else {}
                    for law, of_law in laws.items() if len(laws) == 1 else {ANY_LAW: group, **laws}.items():
                        yield self._shares(name, of_law, family=family, leak_lpm=size, law=law)

    def _share(self, flags: Iterable[bool]) -> Proportion:
        values = list(flags)
        return proportion(sum(values), len(values), self.confidence)

    def _shares(self, detector: str, group: Sequence[JudgedRow], **common: Any) -> AlarmShares:
        statements = [(record, record.statement) for record in group if record.statement is not None]
        intervals = [(record.flow_lpm, statement.leak_interval_lpm) for record, statement in statements]
        naming = [
            record.alarm and covers(named_cause(statement), cause_of(record.row.fault))
            for record, statement in statements
        ]
        silent = [False] * (len(group) - len(statements))
        return AlarmShares(
            detector=detector,
            alarms=self._share(record.alarm for record in group),
            cannot_tell=self._share(record.verdict == CANNOT_TELL for record in group),
            coverage=self._share(ends[0] <= flow <= ends[1] for flow, ends in intervals if ends is not None),
            named=self._share(naming + silent) if statements else None,
            failed=sum(record.row.error is not None for record in group),
            **common,
        )
