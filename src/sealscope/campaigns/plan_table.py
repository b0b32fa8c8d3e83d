"""One table of a plan as it is read: each entry by its rule, in one line with its place where it breaks it."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.parameters import Rig


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

    def detectors(self, views: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
        """The entry `detectors`: what `entries.entry` knows, each once."""
        from sealscope.campaigns.entries import check_entry

        given = self.take("detectors")
        if not isinstance(given, list) or not given:
            raise self.fail(f"detectors must be a list of names, got {given!r}")
        for name in given:
            if not isinstance(name, str):
                raise self.fail(f"detectors must be names, got {name!r}")
            try:
                check_entry(name, views)
            except InputError as error:
                raise self.fail(f"detectors: {error}") from None
        if len(set(given)) < len(given):
            raise self.fail("detectors must be named once each")
        return tuple(given)

    def views(self, given: Any) -> dict[str, tuple[str, ...]]:
        """The plan's table [views], name -> channels, and under "" the entry `channels` where there is one."""
        table = Table(given, "views", self.place)
        found = {}
        if "channels" in self.left:
            found[""] = self._channels("channels", self.left.pop("channels"))
        for name, channels in table.left.items():
            if not name.strip() or name != name.strip() or "@" in name:
                raise table.fail(f"{name} must be a plain name without '@'")
            found[name] = table._channels(name, channels)
        return found

    def _channels(self, key: str, given: Any) -> tuple[str, ...]:
        from sealscope.recordings.recording import CHANNEL_UNITS

        if not isinstance(given, list) or not given or len({repr(one) for one in given}) < len(given):
            raise self.fail(f"{key} must be a list of channels, each once, got {given!r}")
        for one in given:
            if one not in CHANNEL_UNITS:
                raise self.fail(f"{key} must be channels such as 'p_A', got {one!r}")
            if one == "q_leak":
                raise self.fail(f"{key} must not hold q_leak: it measures what detectors are to find")
        return tuple(given)

    def assumed(self, rig: Rig | None) -> Rig | None:
        """What the detectors may assume: the entries `assume`, a rig's name or file, and `assume_set`, values of its
        parameters; `rig` where there are none."""
        from sealscope.parameters import load_rig

        try:
            if "assume" in self.left:
                name = self.text("assume")
                beside = os.fspath(Path(self.place).parent / name) if name.endswith(".toml") else name
                rig = load_rig(beside)
            given = self.left.pop("assume_set", None)
            if given is None:
                return rig
            if not isinstance(given, Mapping):
                raise self.fail(f"assume_set must be a table of parameters, got {given!r}")
            return (rig or load_rig("thesis")).with_values(given, source="assumed by the plan")
        except InputError as error:
            if self.place in str(error):
                raise
            raise InputError(f"{self.name}.assume: {error} ({self.place})") from None

    def end(self) -> None:
        """Refuse what is left over."""
        if self.left:
            raise self.fail(f"{next(iter(self.left))} is not known")
