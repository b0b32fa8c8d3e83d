"""What a plan says: smallest leaks by detector, the bound, commands side by side; as plain values and as text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sealscope.campaigns.prediction.detection import CONFIDENCE, Prediction

#: Size [L/min] whose probability of detection the text shows: the thesis's smallest leak; one of `CURVE_SIZES`.
SHOWN = 0.0042


@dataclass(frozen=True)
class BoundFigures:
    """The Cramer-Rao bound as mean leaks [L/min] at the rig's own pressure difference.

    `half_s`: length of one half [s]; `known`, `unknown`: standard deviation of the leak of one half, all else known or
    `unknown_parameters` unknown in each; `change_*`: of its change between the halves; `smallest_*`: the change that
    the best one-sided test finds at the plan's probabilities.
    """

    half_s: float
    known: float
    unknown: float
    change_known: float
    change_unknown: float
    smallest_known: float
    smallest_unknown: float
    unknown_parameters: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """The figures as plain values, the unit in each name."""
        figures = ("known", "unknown", "change_known", "change_unknown", "smallest_known", "smallest_unknown")
        return {
            "half_s": self.half_s,
            **{f"{name}_lpm": getattr(self, name) for name in figures},
            "unknown_parameters": list(self.unknown_parameters),
        }


@dataclass(frozen=True)
class CommandRow:
    """One line of the comparison: a command and a closing of the throttles; `note` says why where there is no figure.

    `detectors`: name -> smallest leak [L/min], None where none is found; `smallest_known` [L/min]: the bound's.
    """

    command: str
    orifices: str
    detectors: Mapping[str, float | None]
    smallest_known: float | None
    note: str = ""

    @property
    def best(self) -> str | None:
        """The detector that finds the smallest leak, None where none finds any."""
        found = {name: size for name, size in self.detectors.items() if size is not None}
        return min(found, key=lambda name: found[name]) if found else None

    def as_dict(self) -> dict[str, Any]:
        """The row as plain values."""
        best = self.best
        return {
            "command": self.command,
            "orifices": self.orifices,
            "best_detector": best,
            "smallest_leak_lpm": None if best is None else self.detectors[best],
            "detectors_lpm": dict(self.detectors),
            "bound_smallest_known_lpm": self.smallest_known,
            "note": self.note,
        }


@dataclass(frozen=True)
class Outlook:
    """The whole plan for one rig, command, length and false-alarm rate.

    `pressure_difference` [Pa]: mean |p_A - p_B| that drives a leak; `noise`: channel -> standard deviation of a sample
    [Pa]; `origin`: where the scatter comes from, in words; `records`: leak-free records behind it; `largest` [L/min]:
    the largest leak tried, `largest_compared` [L/min] that of the comparison.
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
    noise: Mapping[str, float]
    origin: str
    records: int
    largest: float
    detectors: tuple[Prediction, ...]
    bound: BoundFigures
    commands: tuple[CommandRow, ...]
    largest_compared: float

    def as_dict(self) -> dict[str, Any]:
        """The plan as plain JSON values; sizes in L/min, None where no leak up to the largest is found."""
        return {
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
            "noise_pa": dict(self.noise),
            "scatter_from": self.origin,
            "records": self.records,
            "largest_leak_lpm": self.largest,
            "interval_confidence": CONFIDENCE,
            "detectors": [_detector(one) for one in self.detectors],
            "bound": self.bound.as_dict(),
            "largest_leak_compared_lpm": self.largest_compared,
            "commands": [row.as_dict() for row in self.commands],
        }

    def text(self) -> str:
        """The plan as lines of text for a terminal."""
        percent = f"{100 * self.false_alarm:g} % false alarms"
        lines = [
            f"{self.rig}: {self.command}, throttles {self.orifices}, {self.duration_s:g} s at {self.sample_rate_hz:g} "
            f"Hz, leak from {self.duration_s / 2:g} s",
            f"{percent}, {100 * self.detection:g} % found; {self.origin} ({self.records} leak-free records)",
            f"noise {', '.join(f'{name} {value / 1e3:.3g} kPa' for name, value in self.noise.items())}; the leak is "
            f"driven by {self.pressure_difference / 1e6:.3g} MPa",
            "",
            f"{'detector':<20}{'smallest leak [L/min]':>22}{f'{100 * CONFIDENCE:g} % interval':>20}"
            f"{'scatter':>10}{f'found at {SHOWN:g}':>18}",
        ]
        lines += [self._line(one) for one in self.detectors]
        bound = self.bound
        unknown = ", ".join(name.rpartition(".")[2] for name in bound.unknown_parameters)
        lines += [
            "",
            f"Cramer-Rao bound [L/min], halves of {bound.half_s:g} s  {'all known':>12}{'unknown':>12}",
            f"  standard deviation, one half{bound.known:>20.2g}{bound.unknown:>12.2g}",
            f"  of the change between halves{bound.change_known:>20.2g}{bound.change_unknown:>12.2g}",
            f"  smallest found by any test  {bound.smallest_known:>20.2g}{bound.smallest_unknown:>12.2g}",
            f"  (pressures and command; unknown in each half: {unknown})",
        ]
        if self.commands:
            title = "commands compared under instrument noise alone, smallest leak [L/min]"
            lines += ["", f"{title} (-: none up to {self.largest_compared:.2g})"]
            lines += _table(self.commands)
            lines += ["", self.advice()]
        return "\n".join(lines)

    def _line(self, one: Prediction) -> str:
        if one.smallest is None:
            size = f"> {self.largest:.2g}" if math.isfinite(one.rate) else "cannot tell"
            reach = f"at most {100 * one.rate:.0f} %" if math.isfinite(one.rate) else ""
        else:
            size = f"{one.smallest:.2g}"
            ends = [f"{end:.2g}" if end is not None else f"> {self.largest:.2g}" for end in (one.low, one.high)]
            reach = " .. ".join(ends)
        again = f"  lost again above {one.lost_above:.2g}" if one.lost_above is not None else ""
        there = dict(one.curve).get(SHOWN)
        shown = "-" if there is None else f"{100 * there:.0f} %"
        scatter = f"{100 * one.scatter:.2g} %" if math.isfinite(one.scatter) else "-"
        return f"{one.detector:<20}{size:>22}{reach:>20}{scatter:>10}{shown:>18}{again}"

    def advice(self) -> str:
        """Which of the compared commands finds the smallest leak."""
        found = [(row.detectors[row.best], row) for row in self.commands if row.best is not None]
        if not found:
            return f"no command makes these detectors find a leak up to {self.largest_compared:.2g} L/min"
        size, row = min(found, key=lambda pair: pair[0] or math.inf)
        return f"smallest of all: {size:.2g} L/min with {row.command}, throttles {row.orifices}, by {row.best}"


def _detector(one: Prediction) -> dict[str, Any]:
    known = math.isfinite(one.scatter)
    return {
        "name": one.detector,
        "smallest_leak_lpm": one.smallest,
        "interval_lpm": [one.low, one.high],
        "lost_above_lpm": one.lost_above,
        "scatter": one.scatter if known else None,
        "threshold": one.threshold if known else None,
        "largest_detection_probability": one.rate if known else None,
        "detection_probability_at": [{"leak_lpm": size, "probability": rate} for size, rate in one.curve],
    }


def _table(rows: tuple[CommandRow, ...]) -> list[str]:
    first = "d3 of p_A fell"
    lines = [f"{'command':<14}{'throttles':<12}{first:>16}{'best':>10}  {'by':<20}{'bound, all known':>16}"]
    for row in rows:
        if row.note:
            lines.append(f"{row.command:<14}{row.orifices:<12}{row.note}")
            continue
        best = row.best
        named, smallest = (_size(row.detectors.get(name)) if name else "-" for name in (first, best))
        bound = _size(row.smallest_known)
        lines.append(f"{row.command:<14}{row.orifices:<12}{named:>16}{smallest:>10}  {best or '-':<20}{bound:>16}")
    return lines


def _size(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}"
