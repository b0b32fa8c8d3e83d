"""One table of a plan as it is read: each entry by its rule, in one line with its place where it breaks it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from sealscope.errors import InputError


class Table:
    """One table of a plan as it is read: each entry by its rule, then none left over."""

    def __init__(self, given: Any, name: str, place: str) -> None:
        if not isinstance(given, Mapping):
            raise InputError(f"[{name}] must be a table, got {given!r} ({place})")
        self.left, self.name, self.place = dict(given), name, place

    def fail(self, rule: str) -> InputError:
        """The error that says the rule and the place."""
        return InputError(f"{self.name}.{rule} ({self.place})")

    def take(self, key: str, default: Any = None) -> Any:
        """The entry, or the default; InputError where there is neither."""
        if key in self.left:
            return self.left.pop(key)
        if default is None:
            raise self.fail(f"{key} is missing")
        return default

    def text(self, key: str, default: str | None = None) -> str:
        """An entry that is a text of one line."""
        value = self.take(key, default)
        if not isinstance(value, str) or "\n" in value or (default is None and not value.strip()):
            raise self.fail(f"{key} must be a text, got {value!r}")
        return value

    def number(self, key: str, default: float | None = None, unit: str = "") -> float:
        """An entry that is a finite number, or a text of a number with a unit of the dimension of `unit`."""
        value = self.take(key, default)
        if isinstance(value, str) and unit:
            from sealscope.units import parse_quantity

            try:
                return parse_quantity(value, unit)
            except InputError as error:
                raise self.fail(f"{key}: {error}") from None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            wanted = f"a number with its unit such as '180 {unit}'" if unit else "a number"
            raise self.fail(f"{key} must be {wanted}, got {value!r}")
        return float(value)

    def whole(self, key: str, default: int | None = None, least: int = 0) -> int:
        """An entry that is a whole number of at least `least`."""
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise self.fail(f"{key} must be a whole number >= {least}, got {value!r}")
        return value

    def choice(self, key: str, words: tuple[str, ...], default: str | None = None) -> str:
        """An entry that is one of the words."""
        value = self.take(key, default)
        if value not in words:
            raise self.fail(f"{key} must be one of {', '.join(words)}, got {value!r}")
        return str(value)

    def share(self, key: str, default: float | None = None) -> float:
        """An entry that is a number between 0 and 1."""
        value = self.number(key, default)
        if not 0.0 < value < 1.0:
            raise self.fail(f"{key} must be between 0 and 1, got {value:g}")
        return value

    def detectors(self) -> tuple[str, ...]:
        """The entry `detectors`: names of scorers, each once."""
        from sealscope.diagnosis.scorers import scorer

        given = self.take("detectors")
        if not isinstance(given, list) or not given:
            raise self.fail(f"detectors must be a list of names, got {given!r}")
        for name in given:
            try:
                scorer(name)
            except InputError as error:
                raise self.fail(f"detectors: {error}") from None
        if len(set(given)) < len(given):
            raise self.fail("detectors must be named once each")
        return tuple(given)

    def end(self) -> None:
        """Refuse what is left over."""
        if self.left:
            raise self.fail(f"{next(iter(self.left))} is not known")
