"""The table of events that may happen to a machine: their frequency, and what they change (`events.toml`)."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache, lru_cache
from importlib.resources import files

from sealscope.diagnosis.inference.observable import Observable


@dataclass(frozen=True)
class Event:
    """An event that may happen to a machine or its instruments within a recording, from `events.toml`.

    `name`: such as "piston leak" or "pump wear"; `cause`: heading under which a verdict names the event, None if a
    verdict never does; `probability`: prior probability that it begins within a recording; `affected`: patterns "data:
    name" of the observables that it changes; `disturbed`: patterns of those that it may change as a side effect;
    `description`: what it changes in the words of a reason, such as "the external leakage on side A".
    """

    name: str
    cause: str | None
    probability: float
    affected: tuple[str, ...]
    disturbed: tuple[str, ...]
    description: str

    @property
    def is_sized(self) -> bool:
        """True if the event has a prior on the sizes of its changes, by which changes of unusual size count less.

        Events with a cause, which a verdict may name, have such a prior. It is part of `Observable.advantage`.
        """
        return self.cause is not None

    def affects(self, observable: Observable) -> bool:
        """Return True if the event changes the quantity that an observable (test result) is about.

        The "data: name" of the observable must match one of the patterns `affected`.
        """
        return _matches(f"{observable.data}: {observable.name}", self.affected)

    def may_disturb(self, observable: Observable) -> bool:
        """Return True if the event may change, as a side effect, the quantity that an observable is about.

        The "data: name" of the observable must match one of the patterns `disturbed`.
        """
        return _matches(f"{observable.data}: {observable.name}", self.disturbed)


@lru_cache(maxsize=4096)
def _matches(key: str, patterns: tuple[str, ...]) -> bool:
    """Return True if the `key` "data: name" of an observable matches one of the patterns; "*" stands for any text."""
    return any(fnmatchcase(key, pattern) for pattern in patterns)


@cache
def load_events() -> Sequence[Event]:
    """Read the events that may happen to a machine, with their prior probabilities, from `events.toml`."""
    rows = tomllib.loads((files("sealscope.diagnosis.decision") / "events.toml").read_text("utf-8"))
    return tuple(
        Event(
            name,
            cause=row["cause"] or None,
            probability=row["probability"]["value"],
            affected=tuple(row["moves"]),
            disturbed=tuple(row.get("disturbs", ())),
            description=row["words"],
        )
        for name, row in rows.items()
    )
