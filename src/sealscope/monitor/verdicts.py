"""Verdicts on whole recordings of a watched folder or stream, compared with their machine's healthy recordings.

The verdict is the one that `sealscope diagnose --machine` gives. The page, metrics and messages state it as the
result of the actuator; the chart shows the single blocks. The comparison with healthy recordings finds leaks that are
present from the first sample on, which a watch that learns from the same samples cannot find.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sealscope.diagnosis.commissioned.watched import WatchedMachine
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.hold.recorded_holds import date_hold
from sealscope.diagnosis.hold.result import HoldResult
from sealscope.diagnosis.live.estimates import BlockEstimate, Interval
from sealscope.diagnosis.live.joining import find_way
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.priors.live import LIVE
from sealscope.diagnosis.trend.machine_trend import Trend, trend
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import CANNOT_TELL, LEAK, NO_LEAK
from sealscope.diagnosis.verdict.severity import state_of
from sealscope.recordings.formats.times.timebase import clock_text
from sealscope.recordings.recording import Recording
from sealscope.reporting.messages import how_much
from sealscope.reporting.trend.text import figures
from sealscope.units import DAY

_FALSE_ALARM = DECISION.false_alarm
#: Fraction of an actuator's allowed false alarms that the recordings of its stream get; its blocks get the others.
STREAM_SHARE: float = LIVE.recording.share


@dataclass(frozen=True)
class RecordingVerdict:
    """The verdict on one recording, as plain values for the database; times are in seconds since 1970."""

    file: str
    verdict: str  # "leak", "no leak" or "cannot tell"
    summary: str  # the verdict in words
    size: str  # size or bound of the leak in words
    reason: str
    cause: str  # of the leak or of another event, "" if not named
    state: dict[str, Any]  # state of the machine by NAMUR NE 107 (`MachineState.as_dict`)
    start_s: float  # time of the first sample
    end_s: float
    onset_s: float | None = None  # start of the leak, None if it leaks from the first sample on or not at all
    onset_interval_s: Interval | None = None
    leak_lpm: float | None = None
    leak_interval_lpm: Interval | None = None
    total_lpm: float | None = None  # all leakage
    total_interval_lpm: Interval | None = None
    bound_lpm: float | None = None  # upper bound of a leak that is not found
    chance: float | None = None  # probability that a leak-free recording scores as high, None if not known
    odds: str = ""  # fraction of healthy recordings that look like this one, in words
    mark: str = ""  # mark of a person that ended the alarm

    @classmethod
    def from_diagnosis(cls, diagnosis: Diagnosis, start_s: float, end_s: float, shift: float) -> RecordingVerdict:
        """Convert a diagnosis to a verdict on the recording from `start_s` to `end_s`, in seconds since 1970.

        `shift` [s]: added to times in the diagnosis to give seconds since 1970.
        """
        plain = diagnosis.as_dict()  # has None for numbers that are not finite
        onset, onset_ends = plain["onset_s"], _parse_interval(plain["onset_interval_s"])
        leaks = diagnosis.verdict == LEAK
        total = plain["total_leakage"] or {}
        onset_s = None if onset is None else onset + shift
        leak_since_s = start_s if onset_s is None else onset_s
        return cls(
            file=diagnosis.file,
            verdict=diagnosis.verdict,
            summary=diagnosis.summary,
            size=how_much(diagnosis) or "",
            odds=diagnosis.odds or "",
            reason=diagnosis.reason,
            cause=diagnosis.named_cause or "",
            state={**plain["state"], "since_s": leak_since_s if leaks else None},
            start_s=start_s,
            end_s=end_s,
            onset_s=onset_s,
            onset_interval_s=None if onset_ends is None else (onset_ends[0] + shift, onset_ends[1] + shift),
            leak_lpm=plain["leak_lpm"] if leaks else None,
            leak_interval_lpm=_parse_interval(plain["leak_interval_lpm"]) if leaks else None,
            total_lpm=total.get("lpm"),
            total_interval_lpm=_parse_interval(total.get("interval_lpm")),
            bound_lpm=plain["bound_lpm"],
            chance=plain["chance"],
        )

    @classmethod
    def from_trend(cls, trend: Trend, file: str) -> RecordingVerdict:
        """Convert the trend of dated recordings to the verdict on the last one, with growth and date of the limit."""
        plain, texts, leaks = trend.as_dict(), figures(trend), trend.verdict == LEAK
        first, last, wear = trend.points[0], trend.points[-1], trend.wear
        onsets = None if wear is None or wear.onset is None else [first.start + day * DAY for day in wear.onset]
        total = trend.total
        outlook = [f"{name} {texts[name]}" for name in ("growth", "limit") if texts[name]]
        return cls(
            file=file,
            verdict=trend.verdict,
            summary=trend.decision.summary,
            size=texts["total"],
            reason="; ".join([trend.reason, *outlook]),
            cause=trend.decision.cause or "",
            state={**trend.state.as_dict(), "since_s": onsets[0] if leaks and onsets else None},
            start_s=last.start,
            end_s=last.start + last.duration,
            onset_s=onsets[0] if leaks and onsets else None,
            onset_interval_s=(onsets[1], onsets[2]) if leaks and onsets else None,
            leak_lpm=plain["leak_lpm"] if leaks else None,
            leak_interval_lpm=_parse_interval(plain["leak_interval_lpm"]) if leaks else None,
            total_lpm=None if total is None else total.value,
            total_interval_lpm=None if total is None else (total.low, total.high),
            bound_lpm=plain["bound_lpm"],
            chance=plain["chance"],
        )

    @property
    def leaks(self) -> bool:
        """True if the verdict is "leak"."""
        return bool(self.verdict == LEAK)

    @property
    def excludes_leak(self) -> bool:
        """True if the verdict is "no leak"."""
        return bool(self.verdict == NO_LEAK)

    def excludes(self, leak_lpm: float | None) -> bool:
        """Return True unless a leak of this flow [L/min] is at most `bound_lpm`, and so possible beside `no leak`.

        If the flow or the bound is unknown, nothing contradicts the verdict `no leak`: the result is True.
        """
        return self.bound_lpm is None or leak_lpm is None or self.bound_lpm < leak_lpm

    @property
    def decides(self) -> bool:
        """True if the machine's condition follows from this verdict, not from the estimates of single blocks."""
        # "cannot tell" decides after a person has marked the alarm
        return self.leaks or self.excludes_leak or self.mark != ""

    def allowed_chance(self, false_alarms_per_1000_h: float) -> float:
        """Compute the false-alarm probability of one recording of this length at the allowed rate of false alarms."""
        return false_alarms_per_1000_h * (self.end_s - self.start_s) / 3.6e6  # 3.6e6 s are 1000 h

    def is_rare(self, false_alarms_per_1000_h: float) -> bool:
        """Return True if so few leak-free recordings get such a verdict that it may raise an alarm by itself.

        An unknown `chance` counts as rare, so that no leak is missed.
        """
        # `rarest`, the smallest chance that a diagnosis states: a short recording, too, must be able to raise an alarm
        max_chance = max(_FALSE_ALARM.rarest, self.allowed_chance(false_alarms_per_1000_h))
        return self.chance is None or self.chance <= max_chance

    @property
    def e_value(self) -> float:
        """E-value of this verdict: evidence of a leak, whose mean over leak-free recordings is at most 1.

        With p = `chance`, at least `rarest` of `priors.toml`, the e-value is (1 - p + p ln p)/(p (ln p)^2), the mean of
        kappa p^(kappa - 1) over kappa from 0 to 1 (V. Vovk, R. Wang, Ann. Statist. 49 (2021) 1736). Without a leak p is
        1, which gives 1/2; for an unknown p the e-value is 1. The e-values of successive recordings are multiplied.
        """
        if not self.leaks:
            return 0.5
        if self.chance is None:
            return 1.0
        p = min(max(_FALSE_ALARM.rarest, self.chance), 0.99)  # at 1 the fraction is 0/0
        return (1.0 - p + p * math.log(p)) / (p * math.log(p) ** 2)

    @property
    def by_chance_per_1000_h(self) -> float | None:
        """Expected number of scores as high as this in 1000 h of healthy recordings, None if it is not known."""
        hours = (self.end_s - self.start_s) / 3600.0
        return None if self.chance is None or hours <= 0.0 else 1000.0 * self.chance / hours

    def neutral_after_mark(self, mark: str) -> RecordingVerdict:
        """Build the verdict `cannot tell`, shown after the `mark` "invalid" or "repaired" until the next recording."""
        return RecordingVerdict(
            self.file,
            CANNOT_TELL,
            summary=f"marked {mark}",
            size="",
            reason="the next recording is judged anew",
            cause="",
            state=state_of("watched").as_dict(),
            start_s=self.start_s,
            end_s=self.end_s,
            mark=mark,
        )

    def restate_block(self, block: BlockEstimate) -> BlockEstimate:
        """Replace the leak in the estimate of a block by the leak of the whole recording, none before its onset.

        Without a leak, the interval is 0 to `bound_lpm` if this is known.
        """
        is_before_onset = self.onset_s is not None and block.t < self.onset_s
        if self.leaks and not is_before_onset:
            return replace(block, leak_lpm=self.leak_lpm, leak_interval_lpm=self.leak_interval_lpm)
        interval = None if self.bound_lpm is None else (0.0, self.bound_lpm)
        return replace(block, leak_lpm=None, leak_interval_lpm=interval)


def _parse_interval(ends: Any) -> Interval | None:
    """Convert the ends of an interval to floats; return None if it or one of its ends is unknown."""
    return None if ends is None or None in ends else (float(ends[0]), float(ends[1]))


def judge_recording(
    watched: WatchedMachine, recording: Recording, file: str, shift: float, *, limit_lpm: float | None = None
) -> RecordingVerdict | None:
    """Judge a recording by comparison with its machine's healthy recordings, like `sealscope diagnose --machine`.

    `file`: name of its file; `shift` [s]: added to its times to give seconds since 1970; `limit_lpm` [L/min]: leak that
    calls for a repair, None for the limit in the machine's file. Without healthy recordings, a recording with a
    position is not judged, as its blocks are: the result is None. One without a position is judged like `sealscope
    diagnose`.
    """
    machine, limit = watched.machine, _state_limit(watched, limit_lpm)
    if machine is not None:
        diagnosis = replace(machine, limit=limit).diagnose(recording)
    elif find_way(watched.rig.circuit.watched_by, recording.channels):
        return None
    else:
        diagnosis = diagnose(recording, rig=watched.rig, limit=limit)
    diagnosis = replace(diagnosis, file=file)
    times = recording.t[np.isfinite(recording.t)]
    start_s, end_s = (float(times[0]), float(times[-1])) if times.size else (0.0, 0.0)
    return RecordingVerdict.from_diagnosis(diagnosis, start_s + shift, end_s + shift, shift)


def _state_limit(watched: WatchedMachine, limit_lpm: float | None) -> str | None:
    """State the repair limit: `limit_lpm` [L/min] or, if that is None or the same, the machine's in its own unit."""
    if watched.machine is not None and limit_lpm in (None, watched.limit_lpm):
        return watched.machine.limit  # a limit of creep is compared with the creep
    return None if limit_lpm is None else f"{limit_lpm:.12g} L/min"


def judge_hold_results(
    watched: WatchedMachine, results: Sequence[HoldResult], file: str, *, limit_lpm: float | None = None
) -> RecordingVerdict:
    """Judge dated results of hold tests by their trend.

    `file`, `limit_lpm`: as of `judge_recording`. The first test is taken as healthy, and those after it that the
    machine's file lists. Raises InputError for a result without a date.
    """
    known = set() if watched.machine is None else {entry.start_s for entry in watched.machine.healthy}
    dates = sorted({date_hold(result) or 0.0 for result in results})
    n_known = next((k for k, date in enumerate(dates) if date not in known), len(dates))
    judged = trend(results, healthy=max(1, n_known), limit=_state_limit(watched, limit_lpm))
    return RecordingVerdict.from_trend(judged, file)


def judge_stream(
    watched: WatchedMachine, recording: Recording, *, limit_lpm: float | None = None
) -> RecordingVerdict | None:
    """Judge a recording of an actuator's stream by `judge_recording`."""
    start, end = (float(recording.t[k]) for k in (0, -1))
    name = f"stream from {clock_text(start)} to {clock_text(end)}"
    return judge_recording(watched, replace(recording, t=recording.t - start), name, start, limit_lpm=limit_lpm)
