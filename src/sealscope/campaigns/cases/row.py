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
from sealscope.storage.plain_values import as_type

PISTON_LEAK, NO_CAUSE = "piston leak", "none"
#: The level that tells strokes in either direction, of recordings.
STROKE = "stroke"
#: A cause that a detector names where no channel tells two apart, and those two.
_EITHER = {"piston or pump leak": (PISTON_LEAK, "pump leak")}
#: detector -> (score, None where it cannot tell; onset [s], None where it finds none)
Scores = Mapping[str, tuple[float | None, float | None]]


@dataclass(frozen=True)
class Statement:
    """The figures of a detector's evidence that a row stores; those that are not finite are None."""

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
        """Select the figures of evidence that a row stores."""
        values = {field.name: getattr(evidence, field.name) for field in fields(cls)}
        for name, value in values.items():
            ends = value if isinstance(value, tuple) else (value,)
            if any(isinstance(end, float) and not math.isfinite(end) for end in ends):
                values[name] = None
        return cls(**values)


@cache
def cause_of(fault: str) -> str:
    """Return the cause that a detector should name for a fault as text; else the text itself."""
    try:
        parsed = parse_fault(fault)
    except InputError:  # of rows that were not simulated
        return fault
    return fault if parsed is None else parsed.row.cause or fault


def duty_of(levels: Mapping[str, str | float]) -> str:
    """Return the duty within which scores are compared: the command, and the direction of a stroke."""
    return ", ".join(str(levels[name]) for name in (COMMAND, STROKE) if name in levels)


def covers(named_cause_text: str, true: str) -> bool:
    """Return True if a named cause is the true one, alone or with another that no channel tells from it."""
    return named_cause_text == true or true in _EITHER.get(named_cause_text, ())


def finite(value: float | None) -> float | None:
    """Return the number, None where it is not finite."""
    return None if value is None or not math.isfinite(value) else float(value)


def named_cause(evidence: Evidence | Statement) -> str:
    """Return the cause that evidence names.

    A leak of the piston for `leak` (or of the pump, where it says so), `none` for a plain `no leak`, else `cannot
    tell`.
    """
    if evidence.verdict == "leak":
        return evidence.cause if evidence.cause in LEAKS else PISTON_LEAK
    if evidence.cause is not None and evidence.cause not in LEAKS:
        return evidence.cause
    return CANNOT_TELL if evidence.verdict == CANNOT_TELL else NO_CAUSE


def rank_of(evidence: Evidence | Statement) -> float | None:
    """Return the score by which records are ordered; None for `cannot tell` or another cause."""
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
    """The stored result of a case: its inputs and the scores; or the `error` of it.

    `flow_lpm`: mean leak [L/min] while open, as the run really had it; `scores` and `statements` by the
    plan's name of a detector; `seconds`: processor time, which takes no part in the result.
    """

    flow_lpm: float | None = None
    scores: Scores = field(default_factory=dict)
    error: str | None = None
    seconds: float = 0.0
    statements: Mapping[str, Statement] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Convert the row to plain JSON values."""
        return {**self.__dict__, "statements": {name: asdict(statement) for name, statement in self.statements.items()}}

    @classmethod
    def from_case(cls, case: CampaignCase, **values: Any) -> CaseRow:
        """Build the row of a case, with its results or its `error`."""
        return cls(**{field.name: getattr(case, field.name) for field in fields(CaseInputs)}, **values)

    @classmethod
    def from_dict(cls, tree: Any) -> CaseRow:
        """Read a row from plain values; raise ValueError for any others."""
        return as_type(cls, tree)
