"""One TOML table of a plan: each entry checked by its rule, and none left over."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sealscope.campaigns.plans.detectors import check_detector
from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.parameters import Rig


class PlanTable:
    """The entries of one table; each is taken by a method that checks it, `end` refuses what is left over."""

    def __init__(self, given: Any, name: str, place: str) -> None:
        if not isinstance(given, Mapping):
            raise InputError(f"[{name}] must be a table, got {given!r} ({place})")
        self.left, self.name, self.place = dict(given), name, place

    def fail(self, rule: str) -> InputError:
        """Return the error that names the rule and the place."""
        return InputError(f"{self.name}.{rule} ({self.place})")

    def beside(self, name: str) -> str:
        """Return the path of a file named in the plan, which lies beside the plan; another name as it is."""
        return os.fspath(Path(self.place).parent / name) if name.endswith(".toml") else name

    def take(self, key: str, default: Any = None) -> Any:
        """Take the entry, or the default; raise InputError where there is neither."""
        if key in self.left:
            return self.left.pop(key)
        if default is None:
            raise self.fail(f"{key} is missing")
        return default

    def text(self, key: str, default: str | None = None) -> str:
        """Take a text of one line."""
        value = self.take(key, default)
        if not isinstance(value, str) or "\n" in value or (default is None and not value.strip()):
            raise self.fail(f"{key} must be a text, got {value!r}")
        return value

    def number(self, key: str, default: float | None = None, unit: str = "") -> float:
        """Take a finite number, or a text of a number with a unit of the dimension of `unit`."""
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

    def whole(self, key: str, default: int | None = None, least: int = 0, most: int = 2**53) -> int:
        """Take a whole number from `least` to `most`."""
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise self.fail(f"{key} must be a whole number >= {least}, got {value!r}")
        if value > most:
            raise self.fail(f"{key} must be at most {most}, got {value}")
        return value

    def flag(self, key: str) -> bool:
        """Take a truth value, false by default."""
        value = self.left.pop(key, False)
        if not isinstance(value, bool):
            raise self.fail(f"{key} must be true or false, got {value!r}")
        return value

    def choice(self, key: str, choices: tuple[str, ...], default: str | None = None) -> Any:
        """Take one of the `choices`."""
        value = self.take(key, default)
        if value not in choices:
            raise self.fail(f"{key} must be one of {', '.join(choices)}, got {value!r}")
        return value

    def share(self, key: str, default: float | None = None) -> float:
        """Take a number between 0 and 1."""
        value = self.number(key, default)
        if not 0.0 < value < 1.0:
            raise self.fail(f"{key} must be between 0 and 1, got {value:g}")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """Take a list of one text or more."""
        return self.checked_texts(self.take(key), f"{key} must be a list of names")

    def checked_texts(self, given: Any, rule: str) -> tuple[str, ...]:
        """Return `given` as texts; raise InputError with the rule where it is no list of one text or more."""
        if not isinstance(given, list) or not given or not all(isinstance(text, str) for text in given):
            raise self.fail(f"{rule}, got {given!r}")
        return tuple(given)

    def tables(self, key: str) -> list[PlanTable]:
        """Take a list of one table or more."""
        given = self.take(key)
        if not isinstance(given, list) or not given:
            raise self.fail(f"{key} must be a list of tables, got {given!r}")
        return [PlanTable(entries, f"{self.name}.{key}[{k}]", self.place) for k, entries in enumerate(given, 1)]

    def detectors(self, views: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
        """Take the entry `detectors`: names that `plan_detector` knows, each once."""
        names = self.texts("detectors")
        for name in names:
            try:
                check_detector(name, views)
            except InputError as error:
                raise self.fail(f"detectors: {error}") from None
        if len(set(names)) < len(names):
            raise self.fail("detectors must be named once each")
        return names

    def views(self, given: Any) -> dict[str, tuple[str, ...]]:
        """Read the plan's table [views], name -> channels, and under "" the entry `channels` where there is one."""
        table = PlanTable(given, "views", self.place)
        views = {}
        if "channels" in self.left:
            views[""] = self._channels("channels", self.left.pop("channels"))
        for name, channels in table.left.items():
            if not name.strip() or name != name.strip() or "@" in name:
                raise table.fail(f"{name} must be a plain name without '@'")
            views[name] = table._channels(name, channels)
        return views

    def _channels(self, key: str, given: Any) -> tuple[str, ...]:
        from sealscope.recordings.recording import CHANNEL_UNITS

        texts = isinstance(given, list) and all(isinstance(channel, str) for channel in given)
        if not texts or not given or len(set(given)) < len(given):
            raise self.fail(f"{key} must be a list of channels, each once, got {given!r}")
        for channel in given:
            if channel not in CHANNEL_UNITS:
                raise self.fail(f"{key} must be channels such as 'p_A', got {channel!r}")
            if channel == "q_leak":
                raise self.fail(f"{key} must not hold q_leak: it measures what detectors are to find")
        return tuple(given)

    def assumed(self, rig: Rig | None) -> Rig | None:
        """Take the rig that detectors may assume.

        The entries are `assume`, a rig's name or file, and `assume_set`, values of its parameters; `rig` is returned
        where there are none.
        """
        from sealscope.parameters import load_rig

        try:
            if "assume" in self.left:
                rig = load_rig(self.beside(self.text("assume")))
            given = self.left.pop("assume_set", None)
            if given is None:
                return rig
            if not isinstance(given, Mapping):
                raise self.fail(f"assume_set must be a table of parameters, got {given!r}")
            return (rig or load_rig("thesis")).with_overrides(given, source="assumed by the plan")
        except InputError as error:
            if self.place in str(error):
                raise
            raise InputError(f"{self.name}.assume: {error} ({self.place})") from None

    def end(self) -> None:
        """Raise InputError for an entry that no method took."""
        if self.left:
            raise self.fail(f"{next(iter(self.left))} is not known")
