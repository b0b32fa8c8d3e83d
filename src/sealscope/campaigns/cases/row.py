"""The row of a case: scores, and the statements of each detector."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from typing import Any

from sealscope.campaigns.cases.case import CampaignCase, CaseInputs
from sealscope.campaigns.plans.duty import COMMAND
from sealscope.diagnosis.verdict.evidence import LEAKS, Cause, Evidence, Verdict
from sealscope.errors import InputError, SealscopeError
from sealscope.evaluation.table import CANNOT_TELL
from sealscope.simulation.faults import parse_fault
from sealscope.storage.plain_values import convert_type

PISTON_LEAK, NO_CAUSE = "piston leak", "none"
#: Factor of recordings: the direction of the piston's stroke.
STROKE = "stroke"
#: Cause that a detector names if its channels cannot distinguish two -> those two.
_AMBIGUOUS_CAUSES = {"piston or pump leak": (PISTON_LEAK, "pump leak")}
#: detector -> (score, None for `cannot tell`; onset [s], None if it finds none)
Scores = Mapping[str, tuple[float | None, float | None]]


@dataclass(frozen=True)
class Statement:
    """Part of a detector's evidence that a row stores, with None for numbers that are not finite."""

    verdict: Verdict
    score: float | None = None
    threshold: float | None = None
    onset_s: float | None = None
    onset_interval_s: tuple[float, float] | None = None
    leak_lpm: float | None = None
    leak_interval_lpm: tuple[float, float] | None = None
    cause: Cause | None = None

    @classmethod
    def from_evidence(cls, evidence: Evidence | Statement) -> Statement:
        """Copy the stored fields of evidence, with None for numbers that are not finite."""
        values = {field.name: getattr(evidence, field.name) for field in fields(cls)}
        for name, value in values.items():
            numbers = value if isinstance(value, tuple) else (value,)
            if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
                values[name] = None
        return cls(**values)


@cache
def expected_cause(fault: str) -> str:
    """Return the cause that a detector should name for a fault, or the fault's text if no cause is defined for it."""
    try:
        parsed = parse_fault(fault)
    except InputError:  # faults of recordings are free text
        return fault
    return fault if parsed is None else parsed.row.cause or fault


def duty_label(levels: Mapping[str, str | float]) -> str:
    """Format the duty of a record, its command and stroke direction; scores are compared within a duty."""
    return ", ".join(str(levels[name]) for name in (COMMAND, STROKE) if name in levels)


def matches_cause(named: str, true_cause: str) -> bool:
    """Return True if a named cause is the true one, or an ambiguous cause that includes it."""
    return named == true_cause or true_cause in _AMBIGUOUS_CAUSES.get(named, ())


def finite_or_none(value: float | None) -> float | None:
    """Return the number, or None if it is None or not finite."""
    return None if value is None or not math.isfinite(value) else float(value)


def named_cause(evidence: Evidence | Statement) -> str:
    """Return the cause that evidence names: a leak, only with the verdict `leak`; a fault; `none`; or `cannot tell`.

    The verdict `leak` without a leak as its cause means a piston leak.
    """
    if evidence.verdict == "leak":
        return evidence.cause if evidence.cause in LEAKS else PISTON_LEAK
    if evidence.cause is not None and evidence.cause not in LEAKS:
        return evidence.cause
    return CANNOT_TELL if evidence.verdict == CANNOT_TELL else NO_CAUSE


def ranking_score(evidence: Evidence | Statement) -> float | None:
    """Return the score that ranks records by leakage; None for `cannot tell` or a cause that is no leak."""
    return evidence.score if named_cause(evidence) in (*LEAKS, NO_CAUSE) else None


def error_text(error: Exception) -> str:
    """Format an error in one line."""
    if isinstance(error, SealscopeError):
        return str(error)
    if isinstance(error, MemoryError):
        return "out of memory"
    return f"{type(error).__name__}: {error}".splitlines()[0]


@dataclass(frozen=True, kw_only=True)
class CaseRow(CaseInputs):
    """The stored result of a case: its inputs, and either scores or the `error` that prevented them.

    `flow_lpm`: simulated mean flow [L/min] of the leak while open; `scores` and `statements`: by the plan's name of the
    detector; `seconds`: processor time, which differs between runs and is not part of the result.
    """

    flow_lpm: float | None = None
    scores: Scores = field(default_factory=dict)
    error: str | None = None
    seconds: float = 0.0
    statements: Mapping[str, Statement] = field(default_factory=dict)

    def score(self, detector: str) -> float | None:
        """Return a detector's score; None for `cannot tell` or without a result."""
        return self.scores[detector][0] if detector in self.scores else None

    def as_dict(self) -> dict[str, Any]:
        """Convert the row to plain JSON values."""
        return {**self.__dict__, "statements": {name: asdict(statement) for name, statement in self.statements.items()}}

    @classmethod
    def from_case(cls, case: CampaignCase, **values: Any) -> CaseRow:
        """Build the row of a case, with its results or its `error`."""
        return cls(**{field.name: getattr(case, field.name) for field in fields(CaseInputs)}, **values)

    @classmethod
    def from_dict(cls, tree: Any) -> CaseRow:
        """Build a row from plain JSON values; raise ValueError if a field is missing, unknown or of another type."""
        return convert_type(cls, tree)
