"""Alarms: from estimates to alarms by thresholds in L/min, debounce and hysteresis, and what a person says of them.

An alarm is new until a person acknowledges it. A person finds it valid or, with a reason, invalid. It is closed when
its cause is over and a person has seen it, or by a repair; an invalid one is over at once. (New with its cause over is
what ISA-18.2, Management of Alarm Systems for the Process Industries, calls returned to normal, unacknowledged.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from sealscope.diagnosis.verdict.states import state_of
from sealscope.errors import InputError
from sealscope.monitor.stream.estimates import BlockEstimate, WatchedLeak
from sealscope.storage.plain_state import plain_fields, restored

Level = Literal["warning", "error"]
AlarmState = Literal["new", "acknowledged", "valid", "invalid", "closed"]
#: Number that a control or a plant's catalogue of messages knows a level by, and the level's condition of NE 107.
DIAGNOSTIC_NUMBERS: dict[Level, int] = {"warning": 4101, "error": 4102}
_CONDITIONS: dict[Level, str] = {"warning": "leak", "error": "leak over the limit"}
#: Bits of the status word.
WARNING_BIT, ERROR_BIT, NEW_BIT = 1, 2, 4
#: What a person may say of an alarm.
MARKS = ("acknowledged", "comment", "shelved", "valid", "invalid", "repaired")


@dataclass(frozen=True)
class Alarm:
    """An alarm.

    Parameters
    ----------
    id : str
        Actuator and a running number.
    actuator : str
    level : {"warning", "error"}
    state : {"new", "acknowledged", "valid", "invalid", "closed"}
    raised_s, updated_s : float
        Clock of the samples when it was raised, and when it changed last [s].
    onset_s, onset_interval_s : float and pair of floats
        Since when it leaks, and its 95 % interval [s].
    leak_lpm, leak_interval_lpm : float and pair of floats, optional
        Leak and its 95 % interval [L/min].
    cause, evidence, next_check : str
        Where the oil goes, why that is believed, and what to look at.
    baseline : int
        Version of the baseline it is compared with.
    returned_s : float, optional
        Clock when its cause was over [s]; None while it lasts.
    mark, reason : str
        "valid", "invalid" or "repaired" as a person said last, "" before; and why it is invalid.
    shelved_until_s : float
        It is not announced before this clock [s].
    by_chance_per_1000_h : float, optional
        Alarms as strong as this that a healthy actuator raises per 1000 operating hours, at most.
    """

    id: str
    actuator: str
    level: Level
    state: AlarmState
    raised_s: float
    updated_s: float
    onset_s: float
    onset_interval_s: tuple[float, float]
    leak_lpm: float | None
    leak_interval_lpm: tuple[float, float] | None
    cause: str
    evidence: str
    next_check: str
    baseline: int
    returned_s: float | None = None
    mark: str = ""
    reason: str = ""
    shelved_until_s: float = 0.0
    by_chance_per_1000_h: float | None = None

    @property
    def over(self) -> bool:
        """Whether nothing is left to do about it."""
        return self.state in ("invalid", "closed")

    @property
    def active(self) -> bool:
        """Whether its cause lasts."""
        return self.returned_s is None and not self.over

    @property
    def shelved(self) -> bool:
        """Whether it is not to be announced, as of its last change."""
        return self.shelved_until_s > self.updated_s

    @property
    def condition(self) -> str:
        """Condition of the states of NE 107 that it is."""
        return _CONDITIONS[self.level] if self.active else "watched"

    @property
    def status_word(self) -> int:
        """Status bits of its actuator: 1 a warning lasts, 2 an error lasts, 4 it is new."""
        level = 0 if not self.active else ERROR_BIT if self.level == "error" else WARNING_BIT
        return level | (NEW_BIT if self.state == "new" and not self.shelved else 0)

    def plain(self) -> dict[str, Any]:
        """Return it as plain values, with what follows from its fields."""
        values = asdict(self)
        for name in ("onset_interval_s", "leak_interval_lpm"):
            values[name] = None if values[name] is None else list(values[name])
        own = state_of(self.condition, self.cause if self.active else None, since_s=self.onset_s)
        number = DIAGNOSTIC_NUMBERS[self.level]
        return {**values, "diagnostic_number": number, "shelved": self.shelved, "machine_state": own.as_dict()}


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

    def level(self, leak: WatchedLeak | None, lpm: float | None) -> Level | None:
        """Return the level of a leak, None for one below the thresholds; without L/min it is a warning."""
        if leak is None:
            return None
        if lpm is not None and self.error_lpm is not None and lpm >= self.error_lpm:
            return "error"
        return "warning" if lpm is None or lpm >= self.warning_lpm else None


@dataclass
class AlarmJudge:
    """The alarm of one actuator as block follows block: at most one at a time.

    `alarm`: the last one that is not over; `raised`: alarms so far; `above`, `error`, `below`: successive blocks over
    the warning's and the error's threshold, and below what lets it return; `over_s`: clock when the last one was over
    [s].
    """

    actuator: str
    alarm: Alarm | None = None
    raised: int = 0
    above: int = 0
    error: int = 0
    below: int = 0
    over_s: float | None = None

    def take(
        self, estimate: BlockEstimate, leak: WatchedLeak | None, baseline: int, thresholds: Thresholds
    ) -> tuple[Alarm, str] | None:
        """Return the alarm and what happened to it ("raised", "error", "warning", "returned"), None for nothing.

        Blocks that are not judged change nothing.
        """
        if not estimate.judged:
            return None
        lpm = estimate.leak_lpm if leak is not None else 0.0
        level = thresholds.level(leak, lpm)
        self.above = self.above + 1 if level is not None else 0
        self.error = self.error + 1 if level == "error" else 0
        if self.alarm is None or not self.alarm.active:
            return self._begun(estimate, leak, baseline, thresholds)
        limit = thresholds.warning_lpm if self.alarm.level == "warning" else (thresholds.error_lpm or 0.0)
        low = leak is None or (lpm is not None and lpm < thresholds.return_share * limit)
        self.below = self.below + 1 if low else 0
        now, happened = replace(self.alarm, updated_s=estimate.t), ""
        if self.below >= thresholds.debounce:
            self.below = 0
            if now.level == "error" and level == "warning":
                now, happened = replace(now, level="warning"), "warning"
            else:
                over: AlarmState = "new" if now.state == "new" else "closed"
                now, happened = replace(now, state=over, returned_s=estimate.t), "returned"
        elif now.level == "warning" and self.error >= thresholds.debounce:
            # a higher level is a new call: it must be seen again, unless it is known to be a leak
            to_state: AlarmState = "valid" if now.state == "valid" else "new"
            now, happened = replace(now, level="error", state=to_state), "error"
        if leak is not None:
            leak_lpm, interval = estimate.leak_lpm, estimate.leak_interval_lpm
            chance = thresholds.by_chance(leak)
            now = replace(now, leak_lpm=leak_lpm, leak_interval_lpm=interval, by_chance_per_1000_h=chance)
        return self._kept(now), happened

    def _kept(self, alarm: Alarm) -> Alarm:
        if not alarm.active:
            self.over_s = alarm.updated_s
        self.alarm = None if alarm.over else alarm
        return alarm

    def _begun(
        self, estimate: BlockEstimate, leak: WatchedLeak | None, baseline: int, thresholds: Thresholds
    ) -> tuple[Alarm, str] | None:
        if leak is None or self.above < thresholds.debounce:
            return None
        self.raised, self.below = self.raised + 1, 0
        level: Level = "error" if self.error >= thresholds.debounce else "warning"
        self.alarm = Alarm(
            f"{self.actuator}-{self.raised}",
            self.actuator,
            level,
            "new",
            estimate.t,
            estimate.t,
            leak.onset_s,
            leak.onset_interval_s,
            estimate.leak_lpm,
            estimate.leak_interval_lpm,
            leak.cause,
            leak.reason,
            state_of(_CONDITIONS[level], leak.cause).action,
            baseline,
            by_chance_per_1000_h=thresholds.by_chance(leak),
        )
        return self.alarm, "raised"

    def marked(self, mark: str, at: float, *, until: float = 0.0, reason: str = "") -> Alarm:
        """Return the alarm after a person's word, one of `MARKS`, at clock `at` [s].

        `until`: clock until which it is shelved [s]; `reason`: why it is invalid. Raises InputError where there is no
        alarm, it is so marked already, or an invalid one has no reason.
        """
        if mark not in MARKS:
            raise InputError(f"an alarm must be marked {', '.join(MARKS)}, got {mark[:40]!r}")
        alarm = self.alarm
        if alarm is None:
            raise InputError(f"{self.actuator} must have an alarm to be {mark}, got none")
        if mark == "comment":
            return alarm
        if mark == alarm.state or (mark == "acknowledged" and alarm.state == "valid"):
            raise InputError(f"{alarm.id} is {alarm.state} already")
        if mark == "invalid" and not reason.strip():
            raise InputError(f"{alarm.id} must be invalid for a reason, got none: state it as the comment")
        last: AlarmState = "valid" if mark == "valid" else "acknowledged"
        by_mark: dict[str, dict[str, Any]] = {
            "shelved": {"shelved_until_s": until},
            "invalid": {"state": "invalid", "mark": mark, "reason": reason},
            "repaired": {"state": "closed", "mark": mark},
            "valid": {"state": last if alarm.active else "closed", "mark": mark},
            "acknowledged": {"state": last if alarm.active else "closed"},
        }
        self.above = self.error = self.below = 0
        return self._kept(replace(alarm, updated_s=at, **by_mark[mark]))

    def state(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        return {**vars(self), "alarm": None if self.alarm is None else plain_fields(self.alarm)}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> AlarmJudge:
        """Return what `state` was of; raises InputError where it does not fit."""
        return restored(cls, dict(state), "alarm")
