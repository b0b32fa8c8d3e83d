"""What a detector stated on one record, as a campaign keeps it, and the cause that is behind a record's fault."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sealscope.diagnosis.verdict.evidence import LEAKS, Evidence
from sealscope.evaluation.confusion import CANNOT_TELL

PISTON_LEAK, NONE = "piston leak", "none"
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


def cause_of(fault: str) -> str:
    """The cause behind a fault in words; one that has no name of its own is its own words."""
    return next((cause for words, cause in _CAUSES if fault.startswith(words)), fault)


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
        """What is kept of evidence; a number that is not finite is none."""
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
        """The statement of plain values; raises TypeError, KeyError or ValueError where they are none."""
        pairs = {name: _pair(tree[name]) for name in ("onset_interval_s", "leak_interval_lpm")}
        return cls(**{**tree, **pairs})

    @property
    def named(self) -> str:
        """The cause that it names: a leak of the piston for `leak` (or of the pump, where it says so), `none` for a
        plain `no leak`, `cannot tell`."""
        if self.verdict == "leak":
            return self.cause if self.cause in LEAKS else PISTON_LEAK
        if self.cause is not None and self.cause not in LEAKS:
            return self.cause
        return CANNOT_TELL if self.verdict == CANNOT_TELL else NONE

    @property
    def rank(self) -> float | None:
        """The score by which records can be put in order; None where it cannot tell, or names another cause."""
        return self.score if self.named in (*LEAKS, NONE) else None


def finite(value: float | None) -> float | None:
    """The number, None where it is not finite."""
    return None if value is None or not math.isfinite(value) else float(value)


def _pair(pair: Any) -> tuple[float, float] | None:
    if pair is None:
        return None
    low, high = (finite(one) for one in pair)
    return None if low is None or high is None else (low, high)
