"""Verdicts on whole recordings: a watched folder's files are judged against their machine's healthy recordings.

The verdict is that of `sealscope diagnose --machine`. Page, metrics and messages state it as the actuator's result; the
chart shows the blocks. The comparison with healthy recordings finds leaks that are present from the first sample on; a
watch that learns from the same samples cannot find them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.diagnosis.live.estimates import BlockEstimate, Interval
from sealscope.diagnosis.priors.verdict import VERDICT
from sealscope.diagnosis.verdict.evidence import CANNOT_TELL, LEAK, NO_LEAK
from sealscope.diagnosis.verdict.states import state_of
from sealscope.reporting.messages import how_much

if TYPE_CHECKING:
    from sealscope.diagnosis.commissioned.machine import CommissionedMachine
    from sealscope.diagnosis.verdict.diagnosis import Diagnosis
    from sealscope.recordings.recording import Recording

_FALSE_ALARM = VERDICT.false_alarm


@dataclass(frozen=True)
class RecordingVerdict:
    """The verdict on one recording, on the clock of the monitor, as plain values for the database.

    `file`: name of the file; `summary`, `size`, `odds`: texts of `diagnose` for the verdict, the size or bound of the
    leak, and the fraction of healthy recordings that look like it; `reason`, `cause`: as in a Diagnosis;
    `state`: of NE 107; `start_s`, `end_s`: times of the first and last sample [s]; `onset_s`, `onset_interval_s`: start
    of the leak [s], None if it leaks from the first sample, or not at all; `leak_lpm`, `total_lpm` with their 95 %
    intervals, `bound_lpm` [L/min]: None if not stated; `chance`: probability that a leak-free recording scores as high;
    `mark`: a person's mark that ended the alarm.
    """

    file: str
    verdict: str
    summary: str
    size: str
    reason: str
    cause: str
    state: dict[str, Any]
    start_s: float
    end_s: float
    onset_s: float | None = None
    onset_interval_s: Interval | None = None
    leak_lpm: float | None = None
    leak_interval_lpm: Interval | None = None
    total_lpm: float | None = None
    total_interval_lpm: Interval | None = None
    bound_lpm: float | None = None
    chance: float | None = None
    odds: str = ""
    mark: str = ""

    @classmethod
    def from_diagnosis(cls, diagnosis: Diagnosis, start_s: float, end_s: float, shift: float) -> RecordingVerdict:
        """Convert a diagnosis, adding `shift` [s] to its times; `start_s` and `end_s` include the shift already."""
        plain = diagnosis.as_dict()  # has None for numbers that are not finite
        onset, onset_ends = plain["onset_s"], _parse_interval(plain["onset_interval_s"])
        leaks = diagnosis.verdict == LEAK
        total = plain["total_leakage"] or {}
        since = None if not leaks else start_s if onset is None else onset + shift
        return cls(
            file=diagnosis.file,
            verdict=diagnosis.verdict,
            summary=diagnosis.summary,
            size=how_much(diagnosis) or "",
            odds=diagnosis.odds or "",
            reason=diagnosis.reason,
            cause=diagnosis.named_cause or "",
            state={**plain["state"], "since_s": since},
            start_s=start_s,
            end_s=end_s,
            onset_s=None if onset is None else onset + shift,
            onset_interval_s=None if onset_ends is None else (onset_ends[0] + shift, onset_ends[1] + shift),
            leak_lpm=plain["leak_lpm"] if leaks else None,
            leak_interval_lpm=_parse_interval(plain["leak_interval_lpm"]) if leaks else None,
            total_lpm=total.get("lpm"),
            total_interval_lpm=_parse_interval(total.get("interval_lpm")),
            bound_lpm=plain["bound_lpm"],
            chance=plain["chance"],
        )

    @property
    def leaks(self) -> bool:
        """True if the verdict is a leak."""
        return bool(self.verdict == LEAK)

    @property
    def clears(self) -> bool:
        """True if the verdict is "no leak"."""
        return bool(self.verdict == NO_LEAK)

    @property
    def decides(self) -> bool:
        """True if the verdict or a person's mark states the condition of the machine, False if its blocks do."""
        return self.leaks or self.clears or self.mark != ""

    def is_rare(self, false_alarms_per_1000_h: float) -> bool:
        """Return True if the verdict is within the allowed rate of false alarms.

        `chance`, the probability that a leak-free recording reaches this score, must not exceed a limit. The limit of
        `chance` is the rate times the length of the recording, but at least `rarest` of `priors.toml`, the smallest
        chance that can be known. True if `chance` is None.
        """
        allowed_chance = false_alarms_per_1000_h * (self.end_s - self.start_s) / 3.6e6  # [s] in 1000 h
        return self.chance is None or self.chance <= max(_FALSE_ALARM.rarest, allowed_chance)

    @property
    def by_chance_per_1000_h(self) -> float | None:
        """Expected number of equally high scores in 1000 h of healthy recordings, None if not known."""
        hours = (self.end_s - self.start_s) / 3600.0
        return None if self.chance is None or hours <= 0.0 else 1000.0 * self.chance / hours

    def neutral_after_mark(self, mark: str) -> RecordingVerdict:
        """Build the neutral verdict that is shown after a person marks this one, until the next recording.

        `mark`: the person's mark, which the new verdict quotes. The file and its times stay.
        """
        state, start_s, end_s = state_of("watched").as_dict(), self.start_s, self.end_s
        texts: dict[str, Any] = {"summary": f"marked {mark}", "reason": "the next recording is judged anew"}
        texts |= {"size": "", "cause": "", "mark": mark}
        return RecordingVerdict(self.file, CANNOT_TELL, state=state, start_s=start_s, end_s=end_s, **texts)

    def restate_block(self, block: BlockEstimate) -> BlockEstimate:
        """Replace the leak of a block by that of the recording.

        Before the onset, and without a leak, the block gets no leak, and as interval 0 to the recording's bound.
        """
        lpm, interval = self.leak_lpm, self.leak_interval_lpm
        if not self.leaks or (self.onset_s is not None and block.t < self.onset_s):
            lpm, interval = None, None if self.bound_lpm is None else (0.0, self.bound_lpm)
        return replace(block, leak_lpm=lpm, leak_interval_lpm=interval)


def _parse_interval(ends: Any) -> Interval | None:
    """Return the ends of an interval as a pair, None if one of them is unknown."""
    return None if ends is None or None in ends else (float(ends[0]), float(ends[1]))


def judge_recording(
    machine: CommissionedMachine, recording: Recording, file: str, shift: float, *, limit_lpm: float | None = None
) -> RecordingVerdict:
    """Judge a recording by the healthy ones of its machine, like `sealscope diagnose --machine`.

    `shift`: added to the recording's times to give the monitor's clock [s]; `limit_lpm`: leak that calls for a repair
    [L/min], None for the limit in the machine's file.
    """
    if limit_lpm is not None:
        machine = replace(machine, limit=f"{limit_lpm:.12g} L/min")
    diagnosis = replace(machine.diagnose(recording), file=file)
    times = recording.t[np.isfinite(recording.t)]
    start_s, end_s = (float(times[0]), float(times[-1])) if times.size else (0.0, 0.0)
    return RecordingVerdict.from_diagnosis(diagnosis, start_s + shift, end_s + shift, shift)
