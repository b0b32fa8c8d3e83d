"""Alarms: raised when the estimated leakage exceeds a threshold [L/min], with debounce and hysteresis.

An alarm is new until a person acknowledges it. A person marks it as valid or, with a reason, as invalid. It closes when
its cause has ended and a person has seen it, or when a person marks a repair; an invalid alarm ends at once. (A new
alarm whose cause has ended is "returned to normal, unacknowledged" in the standard ISA-18.2.)

Two ways lead to an alarm, both in `AlarmJudge`: `update`, from the blocks of a stream, once their detector (`Watch`)
has found a leak; and `update_from_verdict`, from whole recordings. For a file, a verdict of leak or no leak replaces
the results of its blocks. The recordings of a commissioned machine's stream, or of one without a position, add up their
evidence; they and the blocks have half the rate `false_alarms_per_1000_h` each (`verdicts.STREAM_SHARE`), and other
streams' blocks all of it. Nine
tenths of the blocks' part go to their test for a step, one tenth to that against the baseline
(`diagnosis/live/priors.toml`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from sealscope.diagnosis.commissioned.machine import JUDGEMENTS
from sealscope.diagnosis.live.estimates import BlockEstimate, Interval, WatchedLeak
from sealscope.diagnosis.verdict.evidence import LEAK
from sealscope.diagnosis.verdict.severity import LEAK_OVER_LIMIT, state_of
from sealscope.errors import InputError
from sealscope.monitor.settings import WatchSettings
from sealscope.monitor.verdicts import STREAM_SHARE, RecordingVerdict

Level = Literal["warning", "error"]
AlarmState = Literal["new", "acknowledged", "valid", "invalid", "closed"]
#: Message number of each level in the message catalogue of a control or a plant.
DIAGNOSTIC_NUMBERS: dict[Level, int] = {"warning": 4101, "error": 4102}
#: Condition of the machine at each level, which determines its state by NAMUR NE 107.
_CONDITIONS: dict[Level, str] = {"warning": LEAK, "error": LEAK_OVER_LIMIT}
#: Bits of the status word.
WARNING_BIT, ERROR_BIT, NEW_BIT = 1, 2, 4
#: Largest evidence that is stored, beyond that of any threshold.
_MAX_EVIDENCE = 1e15
#: Marks that a person may give an alarm.
MARKS = ("acknowledged", "comment", "shelved", *JUDGEMENTS)


@dataclass(frozen=True)
class Alarm:
    """An alarm of an actuator; times [s] are those of its samples, intervals have 95 % confidence."""

    id: str  # name of the actuator with a running number
    actuator: str
    level: Level
    state: AlarmState
    raised_s: float
    updated_s: float  # time of the last judged block, verdict or mark
    onset_s: float  # begin of the leak
    onset_interval_s: Interval
    leak_lpm: float | None  # None if unknown
    leak_interval_lpm: Interval | None
    cause: str  # path of the leaking oil
    evidence: str  # reason for the alarm, in one line
    next_check: str  # recommended inspection
    baseline: int  # version of the healthy baseline, 0 while it is being learned
    returned_s: float | None = None  # end of the leak, None while it lasts
    mark: str = ""  # last mark of a person: "valid", "invalid" or "repaired"
    reason: str = ""  # why the alarm is invalid
    shelved_until_s: float = 0.0  # time before which it is not announced
    by_chance_per_1000_h: float | None = None  # most false alarms as strong, of a healthy actuator in 1000 hours

    @property
    def is_over(self) -> bool:
        """True if the alarm is closed or invalid."""
        return self.state in ("invalid", "closed")

    @property
    def active(self) -> bool:
        """True if the cause of the alarm has not ended, and the alarm is neither closed nor invalid."""
        return self.returned_s is None and not self.is_over

    @property
    def shelved(self) -> bool:
        """True if the alarm was shelved at the time `updated_s`; a shelved alarm is not announced."""
        return self.shelved_until_s > self.updated_s

    @property
    def condition(self) -> str:
        """Condition of the machine while the alarm is active ("leak" or "leak over the limit"), else "watched"."""
        return _CONDITIONS[self.level] if self.active else "watched"

    @property
    def status_word(self) -> int:
        """Status as a sum of bits: 1 for an active warning, 2 for an active error, 4 for a new, unshelved alarm."""
        level_bit = ERROR_BIT if self.level == "error" else WARNING_BIT
        new_bit = NEW_BIT if self.state == "new" and not self.shelved else 0
        return (level_bit if self.active else 0) | new_bit

    def with_level(self, level: Level) -> Alarm:
        """Change the level; a person must acknowledge a higher one again, unless the leak is confirmed."""
        is_worse = level == "error" and self.level == "warning"
        return replace(self, level=level, state="new" if is_worse and self.state != "valid" else self.state)

    def with_end(self, t: float) -> Alarm:
        """Store that the leak ended at the time `t` [s]; the alarm is then closed, unless nobody has seen it."""
        return replace(self, state="new" if self.state == "new" else "closed", returned_s=t, updated_s=t)

    def as_dict(self) -> dict[str, Any]:
        """Convert the alarm to plain values, with the code of its level and the machine's state by NAMUR NE 107."""
        machine_state = state_of(self.condition, self.cause if self.active else None, since_s=self.onset_s)
        derived_values = {"diagnostic_number": DIAGNOSTIC_NUMBERS[self.level], "shelved": self.shelved}
        return {**vars(self), **derived_values, "machine_state": machine_state.as_dict()}


@dataclass
class AlarmJudge:
    """Raises, updates and ends the alarm of one actuator from its estimates; at most one alarm is open at a time."""

    actuator: str
    alarm: Alarm | None = None  # the open alarm
    raised: int = 0  # number of alarms so far
    above: int = 0  # number of successive blocks above the threshold of a warning,
    error: int = 0  # ... of an error,
    below: int = 0  # ... and below the threshold at which the alarm ends
    over_s: float | None = None  # time at which the last alarm ended, or was last changed after its end [s]
    evidence: float = 0.0  # of a leak, from the recordings of a stream (`add_evidence`)
    cause: str = ""  # of the leak that the detector has found, "" without one
    announced_lpm: float | None = None  # leak of the open alarm at its last event, None if unknown
    announced_interval_lpm: Interval | None = None

    def update(
        self,
        estimate: BlockEstimate,
        leak: WatchedLeak | None,
        baseline_version: int,
        settings: WatchSettings,
        allowed_rate: float,
    ) -> tuple[Alarm, str] | None:
        """Update the alarm with the estimate of one block of samples; return the alarm and the name of the event.

        `leak`: leak that the detector has found, or None; `allowed_rate`: most false alarms of the detector in 1000 h.
        An alarm is raised if there is a leak and its flow reaches `warning_lpm` or `error_lpm` of the `settings`. It
        ends when the flow is below `return_share` times the threshold of its level; an error whose flow still reaches
        `warning_lpm` then becomes a warning instead. Each change needs `debounce_blocks` successive blocks. A leak
        without a flow in L/min is a warning. A leak that comes back before anybody has acknowledged its alarm raises
        the same alarm again. After a restart of the detector, when `leak` is None, the alarm stays: the leak may last.

        The event is "raised", "error" or "warning" (a change of the level), "returned" (the cause has ended), or "" for
        none of these. Returns None if the block is not judged, or if no alarm was active and none is raised.
        """
        if not estimate.judged:
            return None
        lpm = estimate.leak_lpm
        cause_before, self.cause = self.cause, "" if leak is None else leak.cause
        has_other_cause = cause_before not in ("", self.cause)
        is_warning = leak is not None and (lpm is None or lpm >= settings.warning_lpm)
        is_error = leak is not None and lpm is not None and lpm >= (settings.error_lpm or math.inf)
        self.above = self.above + 1 if is_warning or is_error else 0
        self.error = self.error + 1 if is_error else 0
        if self.alarm is None or not self.alarm.active:
            if leak is None or self.above < settings.debounce_blocks:
                return None
            self.below = 0
            level: Level = "error" if self.error >= settings.debounce_blocks else "warning"
            alarm = self._raise_alarm(
                level=level,
                raised_s=estimate.t,
                updated_s=estimate.t,
                onset_s=leak.onset_s,
                onset_interval_s=leak.onset_interval_s,
                leak_lpm=lpm,
                leak_interval_lpm=estimate.leak_interval_lpm,
                cause=leak.cause,
                evidence=leak.reason,
                next_check=state_of(_CONDITIONS[level], leak.cause).action,
                baseline=baseline_version,
                # rarity: the fraction of the allowed false alarms that score as high as this leak
                by_chance_per_1000_h=allowed_rate * leak.rarity,
            )
            return alarm, "raised"
        limit = settings.warning_lpm if self.alarm.level == "warning" else (settings.error_lpm or math.inf)
        is_below = leak is not None and lpm is not None and lpm < settings.return_share * limit  # hysteresis
        self.below = self.below + 1 if is_below else 0
        clock_jump = min(0.0, estimate.t - self.alarm.updated_s)  # a clock set back moves the end of the shelving too
        shelved_until_s = self.alarm.shelved_until_s + clock_jump
        updated, event = replace(self.alarm, updated_s=estimate.t, shelved_until_s=shelved_until_s), ""
        if self.below >= settings.debounce_blocks:
            self.below = 0
            if updated.level == "error" and is_warning and not is_error:
                updated, event = updated.with_level("warning"), "warning"
            else:
                updated, event = updated.with_end(estimate.t), "returned"
        elif updated.level == "warning" and self.error >= settings.debounce_blocks:
            updated, event = updated.with_level("error"), "error"
        if leak is not None:
            by_chance, interval = allowed_rate * leak.rarity, estimate.leak_interval_lpm
            updated = replace(updated, leak_lpm=lpm, leak_interval_lpm=interval, by_chance_per_1000_h=by_chance)
            if has_other_cause:  # the detector found the cause once more
                action = state_of(_CONDITIONS[updated.level], leak.cause).action
                updated = replace(updated, cause=leak.cause, evidence=leak.reason, next_check=action)
        return self._set_alarm(updated), event

    def restate_leak(
        self, alarm: Alarm, event: str, leak_lpm: float | None, interval_lpm: Interval | None
    ) -> tuple[Alarm, str]:
        """State another leak [L/min] for a changed alarm, None for the same; return the alarm and its event.

        The `event` of the change is "updated" instead of "" if the leak lies outside the 95 % interval of the last
        event, or the leak of that event outside the present interval: all outputs then state the same leak, within its
        interval.
        """
        if not alarm.active:
            return alarm, event
        if leak_lpm is None:
            leak_lpm, interval_lpm = alarm.leak_lpm, alarm.leak_interval_lpm
        alarm = self._set_alarm(replace(alarm, leak_lpm=leak_lpm, leak_interval_lpm=interval_lpm))
        if not event and leak_lpm is not None:
            is_unknown = self.announced_lpm is None
            is_outside = _lies_outside(leak_lpm, self.announced_interval_lpm)
            event = "updated" if is_unknown or is_outside or _lies_outside(self.announced_lpm, interval_lpm) else ""
        if event:
            self.announced_lpm, self.announced_interval_lpm = leak_lpm, interval_lpm
        return alarm, event

    def _raise_alarm(self, **findings: Any) -> Alarm:
        """Raise a new alarm, or raise the open alarm, whose leak has ended, again; return the raised alarm.

        The open alarm keeps its id and shelving. `findings`: the alarm's other fields, by name.
        """
        if self.alarm is None:
            self.raised += 1
        alarm_id = f"{self.actuator}-{self.raised}"
        shelved_until_s = 0.0 if self.alarm is None else self.alarm.shelved_until_s
        self.alarm = Alarm(alarm_id, self.actuator, state="new", shelved_until_s=shelved_until_s, **findings)
        return self.alarm

    def add_evidence(self, verdict: RecordingVerdict) -> None:
        """Add the verdict on a recording of a stream to the `evidence` M of a leak: M <- (1 + M) e.

        e is the e-value of the verdict; a verdict that does not decide is ignored. M is the sum, over all recordings so
        far, of the product of the e-values from that recording on (Shiryaev-Roberts; J. Shin, A. Ramdas, A. Rinaldo,
        arXiv 2203.03532). Without a leak M exceeds 1/alpha at most once in 1/alpha recordings on average.
        """
        if verdict.decides:  # the e-value of another verdict is not known
            self.evidence = min((1.0 + self.evidence) * verdict.e_value, _MAX_EVIDENCE)

    def update_from_verdict(
        self,
        verdict: RecordingVerdict,
        earlier: RecordingVerdict | None,
        baseline_version: int,
        settings: WatchSettings,
        *,
        is_stream: bool = False,
    ) -> tuple[Alarm, str] | None:
        """Update the alarm with the verdict on a whole recording; return the alarm and the name of the event.

        A leak of unknown size, or of at least the warning threshold, raises an alarm. For a file, the verdict on the
        `earlier` recording (None for none) must be `leak`, too, or the verdict must be rare enough by itself
        (`RecordingVerdict.is_rare`). For a stream (`is_stream`), the attribute `evidence`, collected from its
        recordings, must reach 1/alpha, where alpha is the allowed false-alarm probability of one recording. The alarm
        is an error if the leak is over the repair limit, by the state in the verdict. The verdict `no leak`, or a leak
        below the warning threshold, ends an active alarm and resets `evidence`; without such an alarm `evidence` stays.

        The events are those of `update`. Returns None for the verdict `cannot tell`, or if no alarm was active and none
        is raised.
        """
        alarm, lpm = self.alarm, verdict.leak_lpm
        is_active = alarm is not None and alarm.active
        is_above = verdict.leaks and (lpm is None or lpm >= settings.warning_lpm)
        if not is_above:
            if alarm is None or not is_active or not (verdict.excludes_leak or verdict.leaks):
                return None
            self.evidence = 0.0
            return self._set_alarm(alarm.with_end(verdict.end_s)), "returned"
        level: Level = "error" if verdict.state["condition"] == _CONDITIONS["error"] else "warning"
        by_chance = verdict.by_chance_per_1000_h
        if is_stream:
            # the rate at which the evidence just suffices: 1/evidence = alpha = rate x allowed_chance(1)
            by_chance = 1.0 / (verdict.allowed_chance(1.0) * self.evidence)
        findings: dict[str, Any] = {
            "level": level,
            "updated_s": verdict.end_s,
            "leak_lpm": lpm,
            "leak_interval_lpm": verdict.leak_interval_lpm,
            "evidence": f"{verdict.file}: {verdict.reason}",
            "cause": verdict.cause or ("" if alarm is None else alarm.cause),
            "next_check": verdict.state["action"],
            "by_chance_per_1000_h": by_chance,
        }
        if alarm is not None and is_active:
            updated = replace(alarm.with_level(level), **findings)
            return self._set_alarm(updated), "" if level == alarm.level else level
        if is_stream:
            is_enough = self.evidence * verdict.allowed_chance(STREAM_SHARE * settings.false_alarms_per_1000_h) >= 1.0
        else:
            is_repeated = earlier is not None and earlier.leaks
            is_enough = is_repeated or verdict.is_rare(settings.false_alarms_per_1000_h)
        if not is_enough:
            return None
        onset_s = verdict.start_s if verdict.onset_s is None else verdict.onset_s
        min_onset_s = verdict.start_s
        if earlier is not None and earlier.excludes_leak:  # a leak present from the first sample on began after it
            min_onset_s = min(earlier.end_s, min_onset_s)
        interval = verdict.onset_interval_s or (min_onset_s, onset_s)
        findings |= {"raised_s": verdict.end_s, "onset_s": onset_s, "onset_interval_s": interval}
        return self._raise_alarm(baseline=baseline_version, **findings), "raised"

    def _set_alarm(self, alarm: Alarm) -> Alarm:
        """Store a changed alarm as the open alarm, or forget it if it is closed or invalid; return the changed alarm.

        An alarm whose cause has ended stays open until a person has seen it.
        """
        if not alarm.active:  # the cause has ended, or the alarm is closed or invalid
            self.over_s = alarm.updated_s
        self.alarm = None if alarm.is_over else alarm
        return alarm

    def apply_mark(self, mark: str, t: float, *, until: float = 0.0, reason: str = "") -> Alarm:
        """Apply the mark (`MARKS`) that a person gives the open alarm at time `t` [s], and return the changed alarm.

        `until` [s]: end of the shelving, during which the alarm is not announced; `reason`: why the alarm is invalid.
        If its leak has ended, "acknowledged" and "valid" close the alarm. A comment changes nothing. Any other mark
        restarts the debounce: the person has judged the blocks so far, so that a further change needs `debounce_blocks`
        new ones. "invalid" and "repaired" also reset `evidence`, as there was no leak or it is gone.

        Raises InputError for an unknown mark, without an open alarm, for "invalid" without a reason, for the state that
        the alarm has already, and for "acknowledged" if it is valid. A shelved alarm may be shelved again.
        """
        if mark not in MARKS:
            raise InputError(f"the mark of an alarm must be one of {', '.join(MARKS)}, got {mark[:40]!r}")
        alarm = self.alarm
        if alarm is None:
            raise InputError(f"{self.actuator} must have an open alarm for the mark {mark}, got none")
        if mark == "comment":
            return alarm
        if mark == alarm.state or (mark == "acknowledged" and alarm.state == "valid"):
            raise InputError(f"{alarm.id} is {alarm.state} already")
        if mark == "invalid" and not reason.strip():
            raise InputError(f"the mark invalid of {alarm.id} must have a reason, got none: state it as the comment")
        open_state: AlarmState = "valid" if mark == "valid" else "acknowledged"
        changes: dict[str, dict[str, Any]] = {  # by mark
            "shelved": {"shelved_until_s": until},
            "invalid": {"state": "invalid", "mark": mark, "reason": reason},
            "repaired": {"state": "closed", "mark": mark},
            "valid": {"state": open_state if alarm.active else "closed", "mark": mark},
            "acknowledged": {"state": open_state if alarm.active else "closed"},
        }
        self.above = self.error = self.below = 0
        if mark in ("invalid", "repaired"):
            self.evidence = 0.0
        return self._set_alarm(replace(alarm, updated_s=t, **changes[mark]))


def _lies_outside(leak_lpm: float | None, interval_lpm: Interval | None) -> bool:
    """Return True if a leak lies outside an interval; False if one of them is unknown."""
    return leak_lpm is not None and interval_lpm is not None and not interval_lpm[0] <= leak_lpm <= interval_lpm[1]


def latest_alarms(alarms: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Select the latest alarm of each actuator, which is the first of its alarms (`MonitorStore.alarms`)."""
    return {alarm["actuator"]: alarm for alarm in reversed(alarms)}


def rank_actuators(summaries: Mapping[str, Mapping[str, Any]], alarms: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Sort the summaries of actuators by urgency; add to each the `name` and the open `alarm`, None if there is none.

    The order is by severity of the state, then new alarms first, then by rarity of the alarm and size of the leak.
    `summaries`: by name of the actuator; `alarms`: the open alarms, for each actuator the latest first.
    """

    def rank(row: Mapping[str, Any]) -> tuple[Any, ...]:
        low_lpm, _ = row["leak_interval_lpm"] or (0.0, 0.0)
        by_chance = (row["alarm"] or {}).get("by_chance_per_1000_h")
        false_alarm_rate = math.inf if by_chance is None else by_chance  # unknown: after the others
        is_new = row["status_word"] & NEW_BIT
        return -row["state"]["severity"], -is_new, false_alarm_rate, -low_lpm, -(row["leak_lpm"] or 0.0), row["name"]

    by_actuator = latest_alarms(alarms)
    rows = [{"name": name, **summary, "alarm": by_actuator.get(name)} for name, summary in summaries.items()]
    return sorted(rows, key=rank)
