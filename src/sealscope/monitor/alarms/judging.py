"""From estimates to alarms: thresholds in L/min, debounce, hysteresis; and what a person's word does to an alarm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from sealscope.errors import InputError
from sealscope.monitor.alarms.alarm import NEXT_CHECKS, Alarm, AlarmState, Level
from sealscope.monitor.stream.baseline import plain_dataclass
from sealscope.monitor.stream.estimates import BlockEstimate, WatchedLeak
from sealscope.storage.plain_state import plain_fields


@dataclass(frozen=True)
class Thresholds:
    """What makes an alarm.

    `warning_lpm`, `error_lpm`: leak from which it is one [L/min], None for no error level; `debounce`: successive
    blocks that must say so; `return_share`: it returns, or an error becomes a warning, below this share of the
    threshold; `false_alarms_per_1000_h`: the rate that the tests are set for.
    """

    warning_lpm: float = 0.0
    error_lpm: float | None = None
    debounce: int = 2
    return_share: float = 0.7
    false_alarms_per_1000_h: float = 1.0

    def by_chance(self, leak: WatchedLeak) -> float:
        """Return how many alarms as strong as a leak's a healthy machine raises per 1000 h, at most."""
        return self.false_alarms_per_1000_h * leak.rarity


@dataclass
class AlarmJudge:
    """The alarm of one actuator as block follows block: at most one at a time.

    `alarm`: the last one that is not normal; `raised`: alarms so far; `above`, `error`, `below`: successive blocks over
    the warning's and the error's threshold, and below what lets it return.
    """

    actuator: str
    alarm: Alarm | None = None
    raised: int = 0
    above: int = 0
    error: int = 0
    below: int = 0

    def take(
        self, estimate: BlockEstimate, leak: WatchedLeak | None, baseline: int, thresholds: Thresholds
    ) -> tuple[Alarm, str] | None:
        """Return the alarm and what happened to it ("raised", "error", "warning", "returned"), None for nothing.

        Blocks that are not judged change nothing.
        """
        if estimate.status not in ("watched", "alarm", "learning"):
            return None
        lpm = estimate.leak_lpm if leak is not None else 0.0
        level = self._level(leak, lpm, thresholds)
        self.above = self.above + 1 if level is not None else 0
        self.error = self.error + 1 if level == "error" else 0
        if self.alarm is None or not self.alarm.active:
            return self._begun(estimate, leak, baseline, thresholds)
        limit = thresholds.warning_lpm if self.alarm.level == "warning" else (thresholds.error_lpm or 0.0)
        low = leak is None or (lpm is not None and lpm < thresholds.return_share * limit)
        self.below = self.below + 1 if low else 0
        happened = ""
        if self.below >= thresholds.debounce:
            self.below = 0
            if self.alarm.level == "error" and level == "warning":
                self.alarm, happened = replace(self.alarm, level="warning"), "warning"
            else:
                over: AlarmState = "normal" if self.alarm.state == "acknowledged" else "returned"
                self.alarm, happened = replace(self.alarm, state=over), "returned"
        elif self.alarm.level == "warning" and self.error >= thresholds.debounce:
            # a higher level is a new call: it must be seen again
            self.alarm = replace(self.alarm, level="error", state="unacknowledged")
            happened = "error"
        now = replace(self.alarm, updated_s=estimate.t)
        if leak is not None:
            leak_lpm, interval = estimate.leak_lpm, estimate.leak_interval_lpm
            chance = thresholds.by_chance(leak)
            now = replace(now, leak_lpm=leak_lpm, leak_interval_lpm=interval, by_chance_per_1000_h=chance)
        self.alarm = None if now.state == "normal" else now
        return now, happened

    @staticmethod
    def _level(leak: WatchedLeak | None, lpm: float | None, thresholds: Thresholds) -> Level | None:
        if leak is None:
            return None
        if lpm is None:  # the balance does not state L/min: the leak is shown all the same
            return "warning"
        if thresholds.error_lpm is not None and lpm >= thresholds.error_lpm:
            return "error"
        return "warning" if lpm >= thresholds.warning_lpm else None

    def _begun(
        self, estimate: BlockEstimate, leak: WatchedLeak | None, baseline: int, thresholds: Thresholds
    ) -> tuple[Alarm, str] | None:
        if leak is None or self.above < thresholds.debounce:
            return None
        self.raised, self.below = self.raised + 1, 0
        self.alarm = Alarm(
            f"{self.actuator}-{self.raised}",
            self.actuator,
            "error" if self.error >= thresholds.debounce else "warning",
            "unacknowledged",
            estimate.t,
            estimate.t,
            leak.onset_s,
            leak.onset_interval_s,
            estimate.leak_lpm,
            estimate.leak_interval_lpm,
            leak.cause,
            leak.reason,
            NEXT_CHECKS.get(leak.cause, NEXT_CHECKS["piston or pump leak"]),
            baseline,
            by_chance_per_1000_h=thresholds.by_chance(leak),
        )
        return self.alarm, "raised"

    def marked(self, mark: str, at: float, until: float = 0.0) -> Alarm:
        """Return the alarm after a person's word: "acknowledged", "shelved", "false" or "repaired", at clock `at` [s].

        Raises InputError where there is no alarm, or nothing is left to acknowledge.
        """
        if self.alarm is None:
            raise InputError(f"{self.actuator} must have an alarm to be {mark}, got none")
        if mark == "acknowledged":
            if self.alarm.state == "acknowledged":
                raise InputError(f"{self.alarm.id} is acknowledged already")
            state: AlarmState = "acknowledged" if self.alarm.state == "unacknowledged" else "normal"
            now = replace(self.alarm, state=state, updated_s=at)
        elif mark == "shelved":
            now = replace(self.alarm, shelved_until_s=until, updated_s=at)
        elif mark in ("false", "repaired"):
            now = replace(self.alarm, state="normal", mark=mark, updated_s=at)
        else:
            raise InputError(f"an alarm must be marked acknowledged, shelved, false or repaired, got {mark[:40]!r}")
        self.alarm = None if now.state == "normal" else now
        self.above = self.error = self.below = 0
        return now

    def state(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        return {**vars(self), "alarm": None if self.alarm is None else plain_fields(self.alarm)}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> AlarmJudge:
        """Return what `state` was of; raises InputError where it does not fit."""
        return plain_dataclass(cls, dict(state), "alarm")
