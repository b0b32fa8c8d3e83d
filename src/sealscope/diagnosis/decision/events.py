"""The table of possible events: their frequency, and the observables they change (`events.toml`)."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache, lru_cache
from importlib.resources import files

from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.verdict.evidence import Cause


@dataclass(frozen=True)
class Event:
    """An event of `events.toml`, with its prior probability in a recording.

    `cause`: heading under which a verdict names it, None if none does; `affected`, `disturbed`: patterns "data: name"
    of observables that it changes, and of those it may change as a side effect; `description`: its words in a reason.
    """

    name: str
    cause: Cause | None
    probability: float
    affected: tuple[str, ...]
    disturbed: tuple[str, ...]
    description: str

    @property
    def is_sized(self) -> bool:
        """True if the sizes of the event's observables count (`Observable.advantage`).

        A prior on the sizes exists only for events that a verdict names.
        """
        return self.cause is not None

    def affects(self, observable: Observable) -> bool:
        """Test whether the event changes an observable."""
        return _matches(f"{observable.data}: {observable.name}", self.affected)

    def may_disturb(self, observable: Observable) -> bool:
        """Test whether the event may change an observable as a side effect."""
        return _matches(f"{observable.data}: {observable.name}", self.disturbed)


@lru_cache(maxsize=4096)
def _matches(key: str, patterns: tuple[str, ...]) -> bool:
    """Test whether an observable's "data: name" matches one of the patterns."""
    return any(fnmatchcase(key, pattern) for pattern in patterns)


@cache
def load_events() -> Sequence[Event]:
    """Read the table of events."""
    rows = tomllib.loads((files("sealscope.diagnosis.decision") / "events.toml").read_text("utf-8"))
    return tuple(
        Event(
            name,
            row["cause"] or None,
            row["probability"]["value"],
            tuple(row["moves"]),
            tuple(row.get("disturbs", ())),
            row["words"],
        )
        for name, row in rows.items()
    )
