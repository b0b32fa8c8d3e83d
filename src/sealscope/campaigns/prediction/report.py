"""The prediction report: the smallest leak that is found, by what, and with which command; as values and as text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

import numpy as np

from sealscope.campaigns.prediction.rules import STATED, RulePrediction


@dataclass(frozen=True)
class FindableLeak:
    """The smallest step of the leak [L/min] that a judging detector finds, given `channels`.

    `smallest`: None where it finds none, for the `reason`.
    """

    detector: str
    channels: tuple[str, ...]
    smallest: float | None
    reason: str = ""


@dataclass(frozen=True)
class BoundFigures:
    """The leak [L/min] that the best test of all finds from pressures and command, by the Cramer-Rao bound.

    All else known, or `unknown_parameters` unknown before the leak and after it.
    """

    smallest_known_lpm: float
    smallest_unknown_lpm: float
    unknown_parameters: tuple[str, ...]


@dataclass(frozen=True)
class DutyRow:
    """One line of the comparison: a command and a closing of the throttles; `note`: why there are no figures."""

    command: str
    orifices: str
    leaks: tuple[FindableLeak, ...]
    note: str = ""


@dataclass(frozen=True)
class PredictionReport:
    """The prediction for one rig, command, length and false-alarm probability.

    `pressure_difference` [Pa]: mean |p_A - p_B| that drives a leak; `origin`: where the scatter comes from, as text;
    `records`: leak-free records that the detectors were asked about; `largest` [L/min]: largest leak that the thesis's
    rules were tried on. The detectors of `leaks` make the verdict of `diagnose`: they look for the onset, and know the
    rig. The `rules` of the thesis compare the two halves of a record: they are given the onset, its middle.
    """

    rig: str
    overrides: Mapping[str, str]
    command: str
    orifices: str
    duration_s: float
    sample_rate_hz: float
    start_position_m: float
    false_alarm: float
    detection: float
    pressure_difference: float
    origin: str
    records: int
    largest: float
    leaks: tuple[FindableLeak, ...]
    rules: tuple[RulePrediction, ...]
    bound: BoundFigures
    duties: tuple[DutyRow, ...]

    @property
    def best(self) -> FindableLeak | None:
        """What finds the smallest leak; None where nothing finds any."""
        return min((own for own in self.leaks if own.smallest is not None), key=_size_of, default=None)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain JSON values; sizes in L/min, None where no leak is found."""
        best = self.best
        return {
            "smallest_leak_lpm": None if best is None else best.smallest,
            "rig": self.rig,
            "overrides": dict(self.overrides),
            "command": self.command,
            "orifices": self.orifices,
            "duration_s": self.duration_s,
            "onset_s": self.duration_s / 2.0,
            "sample_rate_hz": self.sample_rate_hz,
            "start_position_m": self.start_position_m,
            "false_alarm_probability": self.false_alarm,
            "detection_probability": self.detection,
            "pressure_difference_pa": self.pressure_difference,
            "scatter_from": self.origin,
            "records": self.records,
            "detectors": [_plain(own) for own in self.leaks],
            "largest_leak_of_rules_lpm": self.largest,
            "rules": [
                {
                    "name": own.rule,
                    "smallest_leak_lpm": own.smallest,
                    "scatter": own.scatter,
                    "detection_probability_at": {"leak_lpm": STATED, "probability": own.found},
                    "given": {"onset": True, "rig": False},
                }
                for own in self.rules
            ],
            "bound": {**asdict(self.bound), "unknown_parameters": list(self.bound.unknown_parameters)},
            "commands": [
                {"command": row.command, "orifices": row.orifices, "detectors": list(map(_plain, row.leaks)),
                 "note": row.note}
                for row in self.duties
            ],
        }  # fmt: skip

    def text(self) -> str:
        """Return the report as lines of text for a terminal, the answer first."""
        best = self.best
        answer = "no leak" if best is None else f"{_size(best.smallest)} L/min"
        lines = [
            f"{answer} is found in {100 * self.detection:g} % of records, at {100 * self.false_alarm:g} % false alarms",
            *(
                f"  {own.detector:<18}{_size(own.smallest):>8} L/min  from {', '.join(own.channels)}"
                if own.smallest is not None
                else f"  {own.detector:<18}{'-':>8}        {own.reason}"
                for own in self.leaks
            ),
            f"  bound             {_size(self.bound.smallest_known_lpm):>8} L/min  from u, p_A, p_B (known machine); "
            f"{_size(self.bound.smallest_unknown_lpm)} unknown",
            f"{self.rig}: {self.command}, throttles {self.orifices}, {self.duration_s:g} s, "
            f"{self.pressure_difference / 1e6:.3g} MPa; {self.records} records, {self.origin}",
        ]
        if self.rules:
            lines.append(f"rules of the thesis, given the onset [L/min] ({STATED:g} L/min found):")
            for change, own in groupby(self.rules, lambda rule: rule.rule.partition(" of ")[2]):
                lines.append(f"  {change:<12} " + ", ".join(map(self._rule, own)))
        if self.duties:
            names = [own.detector for own in self.leaks]
            lines.append(f"{'other duties, a record each [L/min]':<36}" + "".join(f"{name:>19}" for name in names))
            for row in self.duties:
                sizes = "".join(f"{_size(own.smallest):>19}" for own in row.leaks)
                lines.append(f"  {f'{row.command}, throttles {row.orifices}':<34}{sizes or f'  {row.note}'}")
        return "\n".join(lines)

    def _rule(self, own: RulePrediction) -> str:
        size = _size(own.smallest) if own.smallest is not None else f"> {_size(self.largest)}"
        found = "cannot tell" if own.found is None else f"{size} ({100 * own.found:.0f} %)"
        return f"{own.rule.partition(' of ')[0]} {found}"


def _plain(own: FindableLeak) -> dict[str, Any]:
    return {
        "name": own.detector,
        "smallest_leak_lpm": own.smallest,
        "reason": own.reason,
        "given": {"onset": False, "channels": list(own.channels), "rig": True},
    }


def _size_of(own: FindableLeak) -> float:
    return math.inf if own.smallest is None else own.smallest


def _size(value: float | None) -> str:
    return "-" if value is None else np.format_float_positional(value, 2, fractional=False, trim="-")
