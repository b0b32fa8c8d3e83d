"""Verdicts of whole recordings: a watched folder's files are judged against their machine's healthy recordings.

The verdict is that of `sealscope diagnose --machine`. It is the actuator's headline on every surface; blocks stay in
the chart. A recording against healthy ones shows a leak that is there from its first sample, which a watch that begins
with it cannot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.diagnosis.live.estimates import BlockEstimate, Interval
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import CANNOT_TELL, LEAK, NO_LEAK
from sealscope.diagnosis.verdict.states import state_of
from sealscope.reporting.messages import how_much

if TYPE_CHECKING:
    from sealscope.diagnosis.commissioned.machine import CommissionedMachine
    from sealscope.diagnosis.verdict.diagnosis import Diagnosis
    from sealscope.recordings.recording import Recording

_FALSE_ALARM = priors("verdict")["false_alarm"]


@dataclass(frozen=True)
class RecordingVerdict:
    """The verdict on one recording, on the clock of the monitor, as plain values that a database holds.

    `file`: its name; `summary`, `size`, `odds`: the verdict, the leak's size or bound, and the share of healthy
    recordings that look like this, in the words of `diagnose`; `reason`, `cause`: as in a Diagnosis; `state`: of NE
    107; `start_s`, `end_s`: of its samples, `onset_s`, `onset_interval_s`: None where it leaks from the first sample,
    or not at all [s]; `leak_lpm`, `total_lpm` and their 95 % intervals, `bound_lpm`: None where not stated [L/min];
    `chance`: probability that a leak-free recording scores as high; `mark`: of a person who ended its alarm.
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
        """Return the verdict of a diagnosis, its times moved by `shift` [s]; `start_s`, `end_s`: after the move."""
        plain = diagnosis.as_dict()  # numbers that are not finite are None
        onset, ends, leaks = plain["onset_s"], _interval(plain["onset_interval_s"]), diagnosis.verdict == LEAK
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
            onset_interval_s=None if ends is None else (ends[0] + shift, ends[1] + shift),
            leak_lpm=plain["leak_lpm"] if leaks else None,
            leak_interval_lpm=_interval(plain["leak_interval_lpm"]) if leaks else None,
            total_lpm=total.get("lpm"),
            total_interval_lpm=_interval(total.get("interval_lpm")),
            bound_lpm=plain["bound_lpm"],
            chance=plain["chance"],
        )

    @property
    def leaks(self) -> bool:
        """Test whether the verdict is a leak."""
        return bool(self.verdict == LEAK)

    @property
    def clears(self) -> bool:
        """Test whether the verdict is that nothing leaks."""
        return bool(self.verdict == NO_LEAK)

    @property
    def decides(self) -> bool:
        """Test whether the verdict or a person's mark says how the machine is; else its blocks do."""
        return self.leaks or self.clears or self.mark != ""

    def is_rare(self, false_alarms_per_1000_h: float) -> bool:
        """Test whether a healthy machine looks like this no more often than its share of a rate of false alarms.

        No chance is known below the rarest one of `priors.toml`.
        """
        share = false_alarms_per_1000_h * (self.end_s - self.start_s) / 3.6e6
        return self.chance is None or self.chance <= max(_FALSE_ALARM["rarest"], share)

    @property
    def by_chance_per_1000_h(self) -> float | None:
        """Return the number of healthy recordings in 1000 h that look like this, None where no chance is known."""
        hours = (self.end_s - self.start_s) / 3600.0
        return None if self.chance is None or hours <= 0.0 else 1000.0 * self.chance / hours

    def mark_over(self, mark: str) -> RecordingVerdict:
        """Return the verdict after a person's mark that ends its alarm: the next recording tells how the machine is."""
        return RecordingVerdict(
            file=self.file,
            verdict=CANNOT_TELL,
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
        """Return a block's estimate with the leak of the recording that it is part of, from its onset on."""
        lpm, interval = self.leak_lpm, self.leak_interval_lpm
        if not self.leaks or (self.onset_s is not None and block.t < self.onset_s):
            lpm, interval = None, None if self.bound_lpm is None else (0.0, self.bound_lpm)
        return replace(block, leak_lpm=lpm, leak_interval_lpm=interval)


def _interval(ends: Any) -> Interval | None:
    """Return an interval's ends as a pair, None where one of them is not known."""
    return None if ends is None or None in ends else (float(ends[0]), float(ends[1]))


def judge_recording(
    machine: CommissionedMachine, recording: Recording, file: str, shift: float, *, limit_lpm: float | None = None
) -> RecordingVerdict:
    """Judge a recording as `sealscope diagnose --machine` does.

    `shift`: from its time axis to the monitor's clock [s]; `limit_lpm`: leak from which the actuator is to be repaired
    [L/min], None for the machine's own limit.
    """
    if limit_lpm is not None:
        machine = replace(machine, limit=f"{limit_lpm:.12g} L/min")
    diagnosis = replace(machine.diagnose(recording), file=file)
    known = recording.t[np.isfinite(recording.t)]
    start_s, end_s = (float(known[0]), float(known[-1])) if known.size else (0.0, 0.0)
    return RecordingVerdict.from_diagnosis(diagnosis, start_s + shift, end_s + shift, shift)
