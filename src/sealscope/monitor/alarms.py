"""Alarms: from estimates to alarms by thresholds in L/min, debounce and hysteresis, and what a person says of them.

An alarm is new until a person acknowledges it. A person finds it valid or, with a reason, invalid. It is closed when
its cause is over and a person has seen it, or by a repair; an invalid one is over at once. (New with its cause over is
what ISA-18.2, Management of Alarm Systems for the Process Industries, calls returned to normal, unacknowledged.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from sealscope.diagnosis.commissioned.machine import JUDGEMENTS
from sealscope.diagnosis.live.estimates import BlockEstimate, Interval, WatchedLeak
from sealscope.diagnosis.verdict.states import state_of
from sealscope.errors import InputError
from sealscope.monitor.settings import WatchSettings
from sealscope.monitor.verdicts import RecordingVerdict
from sealscope.storage.plain_state import saved

Level = Literal["warning", "error"]
AlarmState = Literal["new", "acknowledged", "valid", "invalid", "closed"]
#: Number that a control or a plant's catalogue of messages knows a level by, and the level's condition of NE 107.
DIAGNOSTIC_NUMBERS: dict[Level, int] = {"warning": 4101, "error": 4102}
_CONDITIONS: dict[Level, str] = {"warning": "leak", "error": "leak over the limit"}
#: Bits of the status word.
WARNING_BIT, ERROR_BIT, NEW_BIT = 1, 2, 4
#: What a person may say of an alarm.
MARKS = ("acknowledged", "comment", "shelved", *JUDGEMENTS)


@dataclass(frozen=True)
class Alarm:
    """An alarm of an actuator; clocks are those of the samples [s], intervals of 95 %.

    `id`: actuator and a running number; `raised_s`, `updated_s`: when it was raised, and changed last; `onset_s`: since
    when it leaks; `cause`, `evidence`, `next_check`: where the oil goes, why that is believed, and what to look at;
    `baseline`: version of what it is compared with; `returned_s`: when its cause was over, None while it lasts; `mark`,
    `reason`: "valid", "invalid" or "repaired" as a person said last, and why it is invalid; `shelved_until_s`: it is
    not announced before; `by_chance_per_1000_h`: alarms as strong as this that a healthy actuator raises per 1000
    operating hours, at most.
    """

    id: str
    actuator: str
    level: Level
    state: AlarmState
    raised_s: float
    updated_s: float
    onset_s: float
    onset_interval_s: Interval
    leak_lpm: float | None
    leak_interval_lpm: Interval | None
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
        """Test whether the alarm is closed or invalid, with nothing left to do."""
        return self.state in ("invalid", "closed")

    @property
    def active(self) -> bool:
        """Test whether the cause of the alarm lasts."""
        return self.returned_s is None and not self.over

    @property
    def shelved(self) -> bool:
        """Test whether the alarm was shelved at its last change, and so not to be announced."""
        return self.shelved_until_s > self.updated_s

    @property
    def condition(self) -> str:
        """The condition of the alarm in the states of NE 107."""
        return _CONDITIONS[self.level] if self.active else "watched"

    @property
    def status_word(self) -> int:
        """Status bits of its actuator: 1 a warning lasts, 2 an error lasts, 4 it is new."""
        level = 0 if not self.active else ERROR_BIT if self.level == "error" else WARNING_BIT
        return level | (NEW_BIT if self.state == "new" and not self.shelved else 0)

    def plain(self) -> dict[str, Any]:
        """Return the fields as plain values, with the machine state and diagnostic number derived from them."""
        machine_state = state_of(self.condition, self.cause if self.active else None, since_s=self.onset_s)
        number = DIAGNOSTIC_NUMBERS[self.level]
        return {
            **vars(self),
            "diagnostic_number": number,
            "shelved": self.shelved,
            "machine_state": machine_state.as_dict(),
        }


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
        self, estimate: BlockEstimate, leak: WatchedLeak | None, baseline: int, settings: WatchSettings
    ) -> tuple[Alarm, str] | None:
        """Return the alarm and what happened to it ("raised", "error", "warning", "returned"), None for nothing.

        A leak without L/min is a warning; blocks that are not judged change nothing. One that rises again before
        anybody saw it is the same alarm. No leak while an alarm lasts: the detector began anew, the leak may last.
        """
        if not estimate.judged:
            return None
        lpm = estimate.leak_lpm
        above = leak is not None and (lpm is None or lpm >= settings.warning_lpm)
        error = leak is not None and lpm is not None and lpm >= (settings.error_lpm or math.inf)
        self.above = self.above + 1 if above or error else 0
        self.error = self.error + 1 if error else 0
        by_chance = None if leak is None else settings.false_alarms_per_1000_h * leak.rarity
        if self.alarm is None or not self.alarm.active:
            if leak is None or self.above < settings.debounce_blocks:
                return None
            self.raised, self.below = self.raised + (self.alarm is None), 0
            level: Level = "error" if self.error >= settings.debounce_blocks else "warning"
            self.alarm = Alarm(
                id=f"{self.actuator}-{self.raised}",
                actuator=self.actuator,
                level=level,
                state="new",
                raised_s=estimate.t,
                updated_s=estimate.t,
                onset_s=leak.onset_s,
                onset_interval_s=leak.onset_interval_s,
                leak_lpm=estimate.leak_lpm,
                leak_interval_lpm=estimate.leak_interval_lpm,
                cause=leak.cause,
                evidence=leak.reason,
                next_check=state_of(_CONDITIONS[level], leak.cause).action,
                baseline=baseline,
                shelved_until_s=0.0 if self.alarm is None else self.alarm.shelved_until_s,
                by_chance_per_1000_h=by_chance,
            )
            return self.alarm, "raised"
        limit = settings.warning_lpm if self.alarm.level == "warning" else (settings.error_lpm or math.inf)
        low = leak is not None and lpm is not None and lpm < settings.return_share * limit
        self.below = self.below + 1 if low else 0
        back = min(0.0, estimate.t - self.alarm.updated_s)  # where the clock was set back, so is the end of the shelf
        until = self.alarm.shelved_until_s + back
        now, happened = replace(self.alarm, updated_s=estimate.t, shelved_until_s=until), ""
        if self.below >= settings.debounce_blocks:
            self.below = 0
            if now.level == "error" and above and not error:
                now, happened = replace(now, level="warning"), "warning"
            else:
                over: AlarmState = "new" if now.state == "new" else "closed"
                now, happened = replace(now, state=over, returned_s=estimate.t), "returned"
        elif now.level == "warning" and self.error >= settings.debounce_blocks:
            # a higher level is a new call: it must be seen again, unless it is known to be a leak
            to_state: AlarmState = "valid" if now.state == "valid" else "new"
            now, happened = replace(now, level="error", state=to_state), "error"
        if leak is not None:
            leak_lpm, interval = estimate.leak_lpm, estimate.leak_interval_lpm
            now = replace(now, leak_lpm=leak_lpm, leak_interval_lpm=interval, by_chance_per_1000_h=by_chance)
        return self._keep(now), happened

    def take_verdict(
        self, verdict: RecordingVerdict, earlier: RecordingVerdict | None, baseline: int, settings: WatchSettings
    ) -> tuple[Alarm, str] | None:
        """Return the alarm and what happened to it, as `take` does, by the verdict on a whole recording.

        A leak is an alarm where a healthy machine looks like this as seldom as stated, or the recording before, whose
        verdict is `earlier`, leaks as well. It is over with the first recording without a leak.
        """
        alarm, lpm = self.alarm, verdict.leak_lpm
        lasts = alarm is not None and alarm.active
        above = verdict.leaks and (lpm is None or lpm >= settings.warning_lpm)
        if not above:
            if alarm is None or not lasts or not (verdict.clears or verdict.leaks):
                return None
            over: AlarmState = "new" if alarm.state == "new" else "closed"
            end_s = verdict.end_s
            return self._keep(replace(alarm, state=over, returned_s=end_s, updated_s=end_s)), "returned"
        level: Level = "error" if verdict.state["condition"] == _CONDITIONS["error"] else "warning"
        found: dict[str, Any] = {
            "level": level,
            "updated_s": verdict.end_s,
            "leak_lpm": lpm,
            "leak_interval_lpm": verdict.leak_interval_lpm,
            "evidence": f"{verdict.file}: {verdict.reason}",
            "next_check": verdict.state["action"],
            "by_chance_per_1000_h": verdict.by_chance_per_1000_h,
        }
        if alarm is not None and lasts:
            is_worse = level == "error" and alarm.level == "warning"
            state: AlarmState = "new" if is_worse and alarm.state != "valid" else alarm.state
            return self._keep(replace(alarm, **found, state=state)), "" if level == alarm.level else level
        is_repeated = earlier is not None and earlier.leaks
        if not (is_repeated or verdict.is_rare(settings.false_alarms_per_1000_h)):
            return None
        self.raised += alarm is None
        since = verdict.start_s if verdict.onset_s is None else verdict.onset_s
        # what leaks from the first sample on began after the last recording that did not
        before = verdict.start_s if earlier is None or not earlier.clears else min(earlier.end_s, verdict.start_s)
        self.alarm = Alarm(
            id=f"{self.actuator}-{self.raised}",
            actuator=self.actuator,
            state="new",
            raised_s=verdict.end_s,
            onset_s=since,
            onset_interval_s=verdict.onset_interval_s or (before, since),
            cause=verdict.cause,
            baseline=baseline,
            shelved_until_s=0.0 if alarm is None else alarm.shelved_until_s,
            **found,
        )
        return self.alarm, "raised"

    def _keep(self, alarm: Alarm) -> Alarm:
        if not alarm.active:
            self.over_s = alarm.updated_s
        self.alarm = None if alarm.over else alarm
        return alarm

    def marked(self, mark: str, t: float, *, until: float = 0.0, reason: str = "") -> Alarm:
        """Return the alarm after a person's word, one of `MARKS`, at clock `t` [s].

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
        return self._keep(replace(alarm, updated_s=t, **by_mark[mark]))

    def state(self) -> dict[str, Any]:
        """Return the fields as plain values for `restored`."""
        return saved(self, vars(self))


def ranked(summaries: Mapping[str, Mapping[str, Any]], alarms: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the actuators with their open alarm: by severity of their state, new alarms first, then by evidence.

    The alarm that healthy actuators raise least often comes first, so that all compete for one budget of false alarms;
    among equals the one whose leak is larger for sure (the lower end of its interval), then the larger leak, then the
    name. `alarms`: those that are not over.
    """

    def order(row: Mapping[str, Any]) -> tuple[Any, ...]:
        low, chance = (row["leak_interval_lpm"] or (0.0,))[0], (row["alarm"] or {}).get("by_chance_per_1000_h")
        evidence = math.inf if chance is None else chance, -low, -(row["leak_lpm"] or 0.0)
        return -row["state"]["severity"], -(row["status_word"] & NEW_BIT), *evidence, row["name"]

    by_actuator = {alarm["actuator"]: alarm for alarm in reversed(alarms)}  # of several the latest
    rows = [{"name": name, **summary, "alarm": by_actuator.get(name)} for name, summary in summaries.items()]
    return sorted(rows, key=order)
