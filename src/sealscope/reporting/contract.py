"""Marks on a time axis."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from sealscope.errors import InputError


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
