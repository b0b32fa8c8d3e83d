"""The row that a case leaves: scores, and what each detector stated."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from sealscope.campaigns.cases.case import Case
from sealscope.diagnosis.verdict.evidence import LEAKS, Evidence
from sealscope.evaluation.confusion import CANNOT_TELL

PISTON_LEAK, NO_CAUSE = "piston leak", "none"
#: First words of a fault as plans have it, and the cause that a detector should name for it.
_CAUSES = (
    ("pump leak", "pump leak"),
    ("rod seal", "external leak"),
    ("external leak", "external leak"),
    ("friction", "friction change"),
    ("air", "air in the oil"),
    ("sensor", "sensor fault"),
    ("duty", "changed duty"),
)
#: detector -> (score, None where it cannot tell; onset [s], None where it finds none)
Scores = Mapping[str, tuple[float | None, float | None]]


def cause_of(fault: str) -> str:
    """Return the cause behind a fault as text; a fault that has no cause of its own is its own."""
    return next((cause for beginning, cause in _CAUSES if fault.startswith(beginning)), fault)


def finite(value: float | None) -> float | None:
    """Return the number, None where it is not finite."""
    return None if value is None or not math.isfinite(value) else float(value)


def _pair(pair: Any) -> tuple[float, float] | None:
    if pair is None:
        return None
    low, high = (finite(end) for end in pair)
    return None if low is None or high is None else (low, high)


@dataclass(frozen=True)
class Statement:
    """One detector's evidence on one record as plain values: its verdict by its own threshold, and its estimates."""

    verdict: str
    score: float | None = None
    threshold: float | None = None
    onset_s: float | None = None
    onset_interval_s: tuple[float, float] | None = None
    leak_lpm: float | None = None
    leak_interval_lpm: tuple[float, float] | None = None
    cause: str | None = None

    @classmethod
    def of(cls, evidence: Evidence) -> Statement:
        """Return what a row keeps of evidence; a number that is not finite becomes None."""
        return cls(
            evidence.verdict,
            finite(evidence.score),
            finite(evidence.threshold),
            finite(evidence.onset_s),
            _pair(evidence.onset_interval_s),
            finite(evidence.leak_lpm),
            _pair(evidence.leak_interval_lpm),
            evidence.cause,
        )

    @classmethod
    def from_dict(cls, tree: Mapping[str, Any]) -> Statement:
        """Return the statement of plain values; raise TypeError, KeyError or ValueError where they are none."""
        pairs = {name: _pair(tree[name]) for name in ("onset_interval_s", "leak_interval_lpm")}
        return cls(**{**tree, **pairs})

    @property
    def named(self) -> str:
        """The cause that it names.

        A leak of the piston for `leak` (or of the pump, where it says so), `none` for a plain `no leak`, else
        `cannot tell`.
        """
        if self.verdict == "leak":
            return self.cause if self.cause in LEAKS else PISTON_LEAK
        if self.cause is not None and self.cause not in LEAKS:
            return self.cause
        return CANNOT_TELL if self.verdict == CANNOT_TELL else NO_CAUSE

    @property
    def rank(self) -> float | None:
        """The score by which records can be ordered; None where it cannot tell, or names another cause."""
        return self.score if self.named in (*LEAKS, NO_CAUSE) else None


@dataclass(frozen=True)
class CaseRow:
    """What a campaign stores of a case: its inputs, where the record was made, the scores; or the `error` of it.

    `flow_lpm`: mean leak [L/min] while open, as the run really had it; `place`: operating point and length of the
    record, plain values; `scores` by the plan's name of a detector, `statements` by `PlanDetector.key`; `seconds`:
    processor time, which takes no part in the result and is not in the final table.
    """

    id: str
    use: str
    leak_lpm: float
    fault: str
    levels: Mapping[str, str | float]
    replicate: int
    flow_lpm: float | None = None
    place: Mapping[str, Any] = field(default_factory=dict)
    scores: Scores = field(default_factory=dict)
    error: str | None = None
    seconds: float = 0.0
    statements: Mapping[str, Statement] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the row as plain JSON values."""
        return asdict(self)

    @classmethod
    def of(cls, case: Case, **values: Any) -> CaseRow:
        """Return the row of a case, with its results or its `error`."""
        return cls(case.id, case.use, case.leak_lpm, case.fault, case.levels, case.replicate, **values)

    @classmethod
    def from_dict(cls, tree: Mapping[str, Any]) -> CaseRow:
        """Return the row of plain values; raise TypeError, KeyError or ValueError where they are none."""
        scores = {str(name): (_number(score), _number(onset)) for name, (score, onset, *_) in tree["scores"].items()}
        statements = {str(name): Statement.from_dict(plain) for name, plain in tree.get("statements", {}).items()}
        return cls(**{**tree, "scores": scores, "statements": statements})


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
