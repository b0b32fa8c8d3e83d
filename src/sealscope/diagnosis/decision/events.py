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
        """True if large or small changes by the event are less probable than usual ones, by a prior on their sizes.

        This is so for events that a verdict may name, i.e. that have a cause. The prior is in `Observable.advantage`.
        """
        return self.cause is not None

    def affects(self, observable: Observable) -> bool:
        """Return True if the event changes the quantity that an observable tests.

        Its "data: name" must then match one of the patterns `affected`.
        """
        return _matches(f"{observable.data}: {observable.name}", self.affected)

    def may_disturb(self, observable: Observable) -> bool:
        """Return True if the event may change, as a side effect, the quantity that an observable tests.

        Its "data: name" must then match one of the patterns `disturbed`.
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
            row["cause"] or None,
            row["probability"]["value"],
            tuple(row["moves"]),
            tuple(row.get("disturbs", ())),
            row["words"],
        )
        for name, row in rows.items()
    )
