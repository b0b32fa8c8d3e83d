"""What a diagnosis says: one verdict for a recording, the evidence of every method, and the false-alarm probability
it was made for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Array

Verdict = Literal["leak", "no leak", "cannot tell"]
#: What a change can come from.
Cause = Literal[
    "piston leak",
    "piston or pump leak",
    "pump leak",
    "external leak",
    "friction change",
    "air in the oil",
    "sensor fault",
    "changed duty",
]
#: The causes for which the verdict is `leak`: piston and pump lie in parallel, and often no channel tells them apart.
LEAKS: tuple[Cause, ...] = ("piston leak", "piston or pump leak")
LITRE_PER_MINUTE = 1e-3 / 60.0


@dataclass(frozen=True)
class MethodResult:
    """One method's evidence: its score against the threshold that its false-alarm probability sets (None where it
    could not be computed)."""

    name: str
    score: float | None
    threshold: float | None
    verdict: Verdict
    reason: str = ""


@dataclass(frozen=True, eq=False)
class LeakCourse:
    """The leak over a recording: estimates `lpm` (k,) [L/min] at the instants `t` (k,) [s], each with its 95 %
    interval `low`, `high` (k,)."""

    t: Array
    lpm: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Evidence:
    """What a detector found in one recording; `methods` are its parts, each with a threshold of its own.

    `cause`: what the detector takes the change for, None where it cannot tell one cause from another or found no
    change; a detector that is sure that a change is no piston leak says `no leak` or `cannot tell`, and the cause.
    `course`: the leak over the recording, where the detector follows it.
    """

    verdict: Verdict
    reason: str
    score: float | None = None
    threshold: float | None = None
    onset_s: float | None = None
    onset_interval_s: tuple[float, float] | None = None
    leak_lpm: float | None = None
    leak_interval_lpm: tuple[float, float] | None = None
    methods: tuple[MethodResult, ...] = ()
    cause: Cause | None = None
    course: LeakCourse | None = None


@dataclass(frozen=True)
class Diagnosis:
    """The verdict on one recording.

    `onset_s`, `onset_interval_s` [s] on the recording's time axis; `leak_lpm`, `leak_interval_lpm` [L/min], None
    where the channels do not allow it; `false_alarm_probability`: the probability of `leak` on a leak-free recording
    for which `threshold` was set; `methods`: every detector's own evidence, each followed by its parts, the one that
    judged first; `quality`: findings on the data; `cause`: what the change is taken for, None where there is none or
    it cannot be told; `next_check`: what to check next, in words; `course`: the leak over the recording, where a
    detector follows it (not among the plain values).
    """

    file: str
    verdict: Verdict
    reason: str
    onset_s: float | None
    onset_interval_s: tuple[float, float] | None
    leak_lpm: float | None
    leak_interval_lpm: tuple[float, float] | None
    false_alarm_probability: float
    score: float | None
    threshold: float | None
    methods: tuple[MethodResult, ...]
    quality: tuple[Finding, ...]
    cause: Cause | None = None
    next_check: str = ""
    course: LeakCourse | None = None

    def as_dict(self) -> dict[str, Any]:
        """The diagnosis as plain JSON values, keys in the order of the output contract; a number that is not finite
        becomes null."""
        return {
            "file": self.file,
            "verdict": self.verdict,
            "reason": self.reason,
            "onset_s": _plain(self.onset_s),
            "onset_interval_s": _pair(self.onset_interval_s),
            "leak_lpm": _plain(self.leak_lpm),
            "leak_interval_lpm": _pair(self.leak_interval_lpm),
            "false_alarm_probability": self.false_alarm_probability,
            "score": _plain(self.score),
            "threshold": _plain(self.threshold),
            "methods": [
                {
                    "name": method.name,
                    "score": _plain(method.score),
                    "threshold": _plain(method.threshold),
                    "verdict": method.verdict,
                    "reason": method.reason,
                }
                for method in self.methods
            ],
            "quality": [
                {
                    "code": finding.code,
                    "channel": finding.channel,
                    "count": finding.count,
                    "first_t": _plain(finding.first_t),
                    "severity": finding.severity,
                    "text": finding.text,
                }
                for finding in self.quality
            ],
            "cause": self.cause,
            "next_check": self.next_check,
        }

    def __str__(self) -> str:
        since = "" if self.onset_s is None else f" since {self.onset_s:.1f} s"
        return f"{self.file}: {self.verdict}{since} ({self.reason})"


def _plain(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _pair(pair: tuple[float, float] | None) -> list[float | None] | None:
    return None if pair is None else [_plain(pair[0]), _plain(pair[1])]
