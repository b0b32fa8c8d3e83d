"""The row of a record: its inputs, and the scores and statements of each detector on it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from typing import Any

from sealscope.campaigns.cases.case import CampaignCase, CaseInputs
from sealscope.campaigns.plans.duty import COMMAND
from sealscope.diagnosis.verdict.evidence import LEAKS, Evidence, Verdict
from sealscope.diagnosis.verdict.severity import joint_causes
from sealscope.errors import InputError, SealscopeError
from sealscope.evaluation.table import CANNOT_TELL
from sealscope.simulation.faults import parse_fault
from sealscope.storage.plain_values import convert_type

PISTON_LEAK, NO_CAUSE = "piston leak", "none"
#: Factor of recordings: the direction of the piston's stroke.
STROKE = "stroke"
#: Names of ambiguous causes, for detectors whose channels cannot distinguish several causes, with these causes.
_AMBIGUOUS_CAUSES = {
    "piston or pump leak": (PISTON_LEAK, "pump leak"),
    "piston or external leak": (PISTON_LEAK, "external leak"),
    "piston, pump or external leak": (PISTON_LEAK, "pump leak", "external leak"),
    **joint_causes(),
}
#: By detector, its score, None without one (`Statement.ranking_score`), and its estimate of the onset [s], or None.
Scores = Mapping[str, tuple[float | None, float | None]]


@dataclass(frozen=True)
class Statement:
    """The stored statement of a detector on a record: fields of `Evidence`, None if not stated or not finite.

    - `verdict`: `leak`, `no leak` or `cannot tell`
    - `score`, `threshold`: the detector's statistic, and the value above which a change is detected
    - `onset_s`, `onset_interval_s` [s]: time at which the leak began, and its 95 % interval
    - `leak_lpm`, `leak_interval_lpm` [L/min]: flow of the leak, and its 95 % interval
    - `cause`: cause that the detector names, a type of leak or another fault
    """

    verdict: Verdict
    score: float | None = None
    threshold: float | None = None
    onset_s: float | None = None
    onset_interval_s: tuple[float, float] | None = None
    leak_lpm: float | None = None
    leak_interval_lpm: tuple[float, float] | None = None
    cause: str | None = None

    @classmethod
    def from_evidence(cls, evidence: Evidence) -> Statement:
        """Copy the stored fields of a detector's evidence; a number or an interval that is not finite becomes None."""
        values = {field.name: getattr(evidence, field.name) for field in fields(cls)}
        for name, value in values.items():
            numbers = value if isinstance(value, tuple) else (value,)  # both ends of an interval must be finite
            if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
                values[name] = None
        return cls(**values)

    @property
    def named_cause(self) -> str:
        """Cause that the detector names: a leak of `LEAKS`, another fault, "none" or "cannot tell".

        With the verdict `leak` it is `cause` if that is in `LEAKS`, otherwise "piston leak". With any other verdict it
        is `cause` if that is not in `LEAKS`, such as an external leak; otherwise it is "cannot tell" for that verdict,
        and "none" for `no leak`.
        """
        if self.verdict == "leak":
            return self.cause if self.cause in LEAKS else PISTON_LEAK
        if self.cause is not None and self.cause not in LEAKS:
            return self.cause
        return CANNOT_TELL if self.verdict == CANNOT_TELL else NO_CAUSE

    @property
    def ranking_score(self) -> float | None:
        """The score, by which records are ranked (ROC); None if `named_cause` is another fault or "cannot tell"."""
        return self.score if self.named_cause in (*LEAKS, NO_CAUSE) else None


@cache
def expected_cause(fault: str) -> str:
    """Find the cause that a detector should name for a fault, such as "friction change" for "friction x1.3".

    The result is the text of the fault if no cause is defined for it.
    """
    try:
        parsed = parse_fault(fault)
    except InputError:  # faults of recordings are free text
        return fault
    return fault if parsed is None else parsed.row.cause or fault


def duty_label(levels: Mapping[str, str | float]) -> str:
    """Format the duty of a record, i.e. its command and stroke direction; return "" if `levels` has neither."""
    return ", ".join(str(levels[name]) for name in (COMMAND, STROKE) if name in levels)


def matches_cause(named: str, true_cause: str) -> bool:
    """Return True if the cause that a detector names is the true cause, or an ambiguous cause that includes it."""
    return named == true_cause or true_cause in _AMBIGUOUS_CAUSES.get(named, ())


def error_text(error: Exception) -> str:
    """Format an error as one line of text."""
    if isinstance(error, SealscopeError):
        return str(error)
    if isinstance(error, MemoryError):
        return "out of memory"
    return f"{type(error).__name__}: {error}".splitlines()[0]


@dataclass(frozen=True, kw_only=True)
class CaseRow(CaseInputs):
    """The stored result of one record: its inputs, and either scores or the error that prevented them.

    - `flow_lpm` [L/min]: simulated mean flow of the leak while it is open, None if it is not known
    - `scores`, `statements`: by detector; scorers, which only compute a score, make no statement
    - `error`: text of the error, None if there was no error
    - `seconds`: processor time, which differs between runs and is not part of the result
    """

    flow_lpm: float | None = None
    scores: Scores = field(default_factory=dict)
    error: str | None = None
    seconds: float = 0.0
    statements: Mapping[str, Statement] = field(default_factory=dict)

    def score(self, detector: str) -> float | None:
        """Return the score of a detector, given by its name; None if the detector has no result or stated no score."""
        return self.scores[detector][0] if detector in self.scores else None

    def as_dict(self) -> dict[str, Any]:
        """Convert the stored result of a record to a dictionary of plain JSON values."""
        return {**self.__dict__, "statements": {name: asdict(statement) for name, statement in self.statements.items()}}

    @classmethod
    def from_case(cls, case: CampaignCase, **values: Any) -> CaseRow:
        """Build the row of a case from its inputs and `values`, which are its results or its `error`."""
        return cls(**{field.name: getattr(case, field.name) for field in fields(CaseInputs)}, **values)

    @classmethod
    def from_dict(cls, tree: Any) -> CaseRow:
        """Build a row from plain JSON values; raise ValueError if a field is missing, unknown or of another type."""
        return convert_type(cls, tree)
