"""What this room needs to know of a diagnosis (attributes of the public output contract), and marks on a time axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Protocol

from sealscope.errors import InputError
from sealscope.recordings.recording import Array


class FindingLike(Protocol):
    """One finding on the quality of the data; `severity` is "note", "warning" or "fatal"."""

    @property
    def code(self) -> str: ...
    @property
    def channel(self) -> str | None: ...
    @property
    def count(self) -> int | None: ...
    @property
    def first_t(self) -> float | None: ...
    @property
    def text(self) -> str: ...
    @property
    def severity(self) -> str: ...


class MethodLike(Protocol):
    """What one detection method says of a recording."""

    @property
    def name(self) -> str: ...
    @property
    def score(self) -> float | None: ...
    @property
    def threshold(self) -> float | None: ...
    @property
    def verdict(self) -> str: ...
    @property
    def reason(self) -> str: ...


class CourseLike(Protocol):
    """The leak over a recording [L/min] at instants `t` [s], with the ends of its 95 % interval."""

    @property
    def t(self) -> Array: ...
    @property
    def lpm(self) -> Array: ...
    @property
    def low(self) -> Array: ...
    @property
    def high(self) -> Array: ...


class DiagnosisLike(Protocol):
    """The verdict on one recording, with everything that a program reading `diagnose --format jsonl` gets."""

    @property
    def file(self) -> str | None: ...
    @property
    def verdict(self) -> str: ...
    @property
    def reason(self) -> str: ...
    @property
    def onset_s(self) -> float | None: ...
    @property
    def onset_interval_s(self) -> tuple[float, float] | None: ...
    @property
    def leak_lpm(self) -> float | None: ...
    @property
    def leak_interval_lpm(self) -> tuple[float, float] | None: ...
    @property
    def false_alarm_probability(self) -> float | None: ...
    @property
    def score(self) -> float | None: ...
    @property
    def threshold(self) -> float | None: ...
    @property
    def quality(self) -> Sequence[FindingLike]: ...
    @property
    def methods(self) -> Sequence[MethodLike]: ...
    @property
    def cause(self) -> str | None: ...
    @property
    def next_check(self) -> str: ...
    @property
    def course(self) -> CourseLike | None: ...


@dataclass(frozen=True)
class Mark:
    """A moment that the caller wants to see on every chart: `t` [s] on the recording's own time axis, and its label.

    `known=True` says that the moment is known from elsewhere (the leak was put in on purpose); it is drawn apart from
    what the diagnosis found. Raises InputError when `t` is not finite.
    """

    t: float
    label: str
    known: bool = False

    def __post_init__(self) -> None:
        if not isfinite(self.t):
            raise InputError(f"time of the mark {self.label!r} must be finite, got {self.t}")
