"""What is stated of many records, counted: the columns that the tables of several benchmarks share."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from sealscope.diagnosis.diagnose import FALSE_ALARM_PROBABILITY, Examination
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.evaluation.binomial import clopper_pearson
from sealscope.parameters import Rig
from sealscope.recordings.recording import Recording


def judge(
    recording: Recording,
    detector: str = "diagnose",
    *,
    rig: Rig | str = "thesis",
    channels: str = "",
    false_alarm: float = FALSE_ALARM_PROBABILITY,
) -> Evidence:
    """Judge a recording by a detector, or by all of them together; `channels`: those to judge by, by commas."""
    viewed = recording.only(channels.split(",")) if channels else recording
    examination = Examination(viewed, rig=rig, false_alarm_probability=false_alarm)
    return examination.decide_by_all() if detector == "diagnose" else examination.evidence(detector)


class Statement(Protocol):
    """What a diagnosis and a detector's evidence have in common."""

    verdict: str
    leak_lpm: float | None
    leak_interval_lpm: tuple[float, float] | None
    bound_lpm: float | None
    onset_s: float | None


@dataclass
class Tally:
    """Verdicts on the records of one row; of leaks the stated sizes over the true ones, intervals and onsets."""

    verdicts: Counter[str] = field(default_factory=Counter)
    ratios: list[float] = field(default_factory=list)
    holds: list[bool] = field(default_factory=list)
    onset_errors: list[float] = field(default_factory=list)
    bounds: list[float] = field(default_factory=list)

    def add(self, statement: Statement, true_lpm: float | None = None, onset_s: float | None = None) -> None:
        """Count a statement; `true_lpm`, `onset_s`: of the leak that the record has, where it is known."""
        self.verdicts[statement.verdict] += 1
        if statement.bound_lpm is not None:
            self.bounds.append(statement.bound_lpm)
        if statement.verdict != "leak":
            return
        if true_lpm and statement.leak_lpm is not None and statement.leak_interval_lpm is not None:
            low, high = statement.leak_interval_lpm
            self.ratios.append(statement.leak_lpm / true_lpm)
            self.holds.append(low <= true_lpm <= high)
        if onset_s is not None and statement.onset_s is not None:
            self.onset_errors.append(abs(statement.onset_s - onset_s))

    @property
    def records(self) -> int:
        return sum(self.verdicts.values())

    def leaks(self) -> str:
        """Format how many records are called a leak, with Clopper and Pearson's interval."""
        low, high = clopper_pearson(self.verdicts["leak"], self.records)
        return f"{self.verdicts['leak']} of {self.records} ({100.0 * low:.1f} to {100.0 * high:.1f} %)"

    def intervals(self) -> str:
        return f"{sum(self.holds)} of {len(self.holds)}" if self.holds else ""

    def sizes(self) -> str:
        """Format stated over true size: median and range."""
        if not self.ratios:
            return ""
        return f"{np.median(self.ratios):.2f} ({min(self.ratios):.2f} to {max(self.ratios):.2f})"

    def onsets(self) -> str:
        """Format the error of the onset: median and worst."""
        errors = self.onset_errors
        return f"{np.median(errors):.2f} s, {max(errors):.2f} s" if errors else ""

    def bound(self) -> str:
        return f"{np.median(self.bounds):.2g}" if self.bounds else ""

    def cells(self) -> tuple[str, ...]:
        """Return the cells under `HEADS`."""
        unsure = str(self.verdicts["cannot tell"])
        return self.leaks(), unsure, self.intervals(), self.sizes(), self.onsets(), self.bound()


#: Heads of `Tally.cells`.
HEADS = (
    "`leak`",
    "`cannot tell`",
    "intervals hold",
    "size over truth",
    "onset: median, worst",
    "bound [L/min]",
)


def print_heads(*names: str) -> None:
    """Print the heads of a table whose rows begin with `names`."""
    print_row(*names, *HEADS)
    print_row(*("---" for _ in (*names, *HEADS)))


def print_row(*cells: object) -> None:
    print("| " + " | ".join(str(cell) for cell in cells) + " |", flush=True)
