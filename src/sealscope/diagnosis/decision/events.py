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
    """An event that may happen to a machine or its instruments within a recording, from `events.toml`."""

    name: str  # such as "piston leak" or "pump wear"
    cause: str | None  # heading under which a verdict names the event, None if no verdict names it
    probability: float  # prior probability that it begins within a recording
    affected: tuple[str, ...]  # patterns "data: name" of the observables that it changes
    scaled: tuple[str, ...]  # patterns of observables that it changes by multiplying both pressures by one factor
    disturbed: tuple[str, ...]  # patterns of observables that it may change as a side effect
    description: str  # phrase for what it changes, used in a verdict's reason: "the external leakage on side A"

    @property
    def is_sized(self) -> bool:
        """True if priors on the size of a change (in `Observable.advantage`) count for the event.

        They hold for the causes that a verdict names. An event without a cause, such as unsteady motion that looks like
        free air, may be of any size.
        """
        return self.cause is not None

    def affects(self, observable: Observable) -> bool:
        """Return True if the patterns `affected` state that the event changes an observable."""
        return _matches(f"{observable.data}: {observable.name}", self.affected)

    def scales(self, observable: Observable) -> bool:
        """Return True if the event changes an observable by multiplying both pressures by one factor (`scaled`)."""
        return _matches(f"{observable.data}: {observable.name}", self.scaled)

    def changes(self, observable: Observable) -> bool:
        """Return True if the event changes an observable, by itself (`affects`) or by scaling pressures (`scales`)."""
        return self.affects(observable) or self.scales(observable)

    def may_disturb(self, observable: Observable) -> bool:
        """Return True if the patterns `disturbed` state that the event may change an observable as a side effect."""
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
            scaled=tuple(row.get("scales", ())),
            disturbed=tuple(row.get("disturbs", ())),
            description=row["words"],
        )
        for name, row in rows.items()
    )
