"""The table of possible events: their frequency, and the observables they move (`events.toml`)."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from importlib.resources import files

from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.verdict.evidence import Cause


@dataclass(frozen=True)
class Event:
    """An event.

    Parameters
    ----------
    name : str
        Row of `events.toml`.
    cause : str or None
        Heading under which it is named; None where it is never named.
    probability : float
        Chance that it begins in a recording.
    moves : tuple of str
        Patterns of the observables that show it, as "data: name".
    disturbs : tuple of str
        Patterns of those that it may move as well.
    words : str
        What is said of it.
    """

    name: str
    cause: Cause | None
    probability: float
    moves: tuple[str, ...]
    disturbs: tuple[str, ...]
    words: str

    @property
    def is_sized(self) -> bool:
        """Test whether the event has a size, judged by the `advantage` of its observables; an unnamed one none."""
        return self.cause is not None

    def does_move(self, observable: Observable) -> bool:
        """Test whether the event moves an observable."""
        return _matches(observable, self.moves)

    def does_disturb(self, observable: Observable) -> bool:
        """Test whether the event may move an observable as a side effect."""
        return _matches(observable, self.disturbs)


def _matches(observable: Observable, patterns: Sequence[str]) -> bool:
    key = f"{observable.data}: {observable.name}"
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
