"""The prediction report: smallest leaks by detector, the bound, commands compared; as plain values and as text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from sealscope.campaigns.prediction.detection import CONFIDENCE, DetectorPrediction
from sealscope.campaigns.prediction.judges import RECORDS, JudgePrediction

#: Size [L/min] whose probability of detection the text shows: the thesis's smallest leak; one of `CURVE_SIZES`.
SHOWN = 0.0042
#: Longest line of text [1].
_WIDEST = 160


@dataclass(frozen=True)
class BoundFigures:
    """The Cramer-Rao bound as mean leaks [L/min] at the rig's own pressure difference.

    `half_s`: length of one half [s]; `known`, `unknown`: standard deviation of the leak of one half, all else known or
    `unknown_parameters` unknown in each; `change_*`: of its change between the halves; `smallest_*`: the change that
    the best one-sided test finds at the target's probabilities.
    """

    half_s: float
    known_lpm: float
    unknown_lpm: float
    change_known_lpm: float
    change_unknown_lpm: float
    smallest_known_lpm: float
    smallest_unknown_lpm: float
    unknown_parameters: tuple[str, ...]


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
        sizes = {name: size for name, size in self.detectors.items() if size is not None}
        return min(sizes, key=lambda name: sizes[name]) if sizes else None

    def as_dict(self) -> dict[str, Any]:
        """Return the row as plain values."""
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
class PredictionReport:
    """The prediction for one rig, command, length and false-alarm probability.

    `pressure_difference` [Pa]: mean |p_A - p_B| that drives a leak; `noise`: channel -> standard deviation of a sample
    [Pa]; `origin`: where the scatter comes from, as text; `records`: leak-free records behind it; `largest` [L/min]:
    the largest leak tried, `largest_compared` [L/min] that of the comparison. The `detectors` compare the two halves
    of a record, so they are given the onset: the leak opens in its middle. The `judges` make the verdict of `diagnose`;
    they look for the onset and are given the rig.
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
    detectors: tuple[DetectorPrediction, ...]
    bound: BoundFigures
    commands: tuple[CommandRow, ...]
    largest_compared: float
    judges: tuple[JudgePrediction, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain JSON values; sizes in L/min, None where no leak up to the largest is found."""
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
            "given_to_detectors": {"onset": True, "channels": list(self.noise), "rig": False},
            "detectors": [_detector(detector) for detector in self.detectors],
            "judges": [
                {
                    "name": judge.detector,
                    "smallest_leak_lpm": judge.smallest,
                    "reason": judge.reason,
                    "given": {"onset": False, "channels": list(judge.channels), "rig": True},
                    "records": RECORDS,
                }
                for judge in self.judges
            ],
            "bound": {**asdict(self.bound), "unknown_parameters": list(self.bound.unknown_parameters)},
            "largest_leak_compared_lpm": self.largest_compared,
            "commands": [row.as_dict() for row in self.commands],
        }

    def text(self) -> str:
        """Return the report as lines of text for a terminal."""
        bound = self.bound
        unknown = ", ".join(name.rpartition(".")[2] for name in bound.unknown_parameters)
        lines = [
            f"{self.rig}: {self.command}, throttles {self.orifices}, {self.duration_s:g} s at {self.sample_rate_hz:g} "
            f"Hz, leak from {self.duration_s / 2:g} s",
            f"{100 * self.false_alarm:g} % false alarms, {100 * self.detection:g} % found; {self.origin} "
            f"({self.records} leak-free records)",
            f"noise {', '.join(f'{name} {value / 1e3:.3g} kPa' for name, value in self.noise.items())}; the leak is "
            f"driven by {self.pressure_difference / 1e6:.3g} MPa",
            "",
            f"{'detector':<20}{'smallest leak [L/min]':>22}{f'{100 * CONFIDENCE:g} % interval':>20}"
            f"{'scatter':>10}{f'found at {SHOWN:g}':>18}",
            *(self._line(detector) for detector in self.detectors),
            f"(true onset given: every detector compares the {self.duration_s / 2:g} s before the leak with those "
            f"after; given {', '.join(self.noise)} and no rig)",
            *self._judges(),
            "",
            f"Cramer-Rao bound [L/min], halves of {bound.half_s:g} s  {'all known':>12}{'unknown':>12}",
            f"  standard deviation, one half{bound.known_lpm:>20.2g}{bound.unknown_lpm:>12.2g}",
            f"  of the change between halves{bound.change_known_lpm:>20.2g}{bound.change_unknown_lpm:>12.2g}",
            f"  smallest found by any test  {bound.smallest_known_lpm:>20.2g}{bound.smallest_unknown_lpm:>12.2g}",
            f"  (pressures and command; unknown in each half: {unknown})",
        ]
        if self.commands:
            title = "commands compared under instrument noise alone, smallest leak [L/min]"
            lines += ["", f"{title} (-: none up to {self.largest_compared:.2g})"]
            lines += _comparison(self.commands)
            lines += ["", self.advice()]
        return "\n".join(lines)

    def _judges(self) -> list[str]:
        if not self.judges:
            return []
        lines = ["", f"{'judging detector':<20}{'smallest leak [L/min]':>22}  sees"]
        for judge in self.judges:
            size = "cannot tell" if judge.smallest is None else f"{judge.smallest:.2g}"
            sees = f"{', '.join(judge.channels)}{': ' if judge.reason else ''}{judge.reason}"
            lines.append(f"{judge.detector:<20}{size:>22}  {sees}"[:_WIDEST])
        return [
            *lines,
            f"(these make the verdict of diagnose; onset not given, rig given; found in all of {RECORDS} records, "
            "instrument noise alone)",
        ]

    def _line(self, detector: DetectorPrediction) -> str:
        if detector.smallest is None:
            known = math.isfinite(detector.largest_detection)
            size = f"> {self.largest:.2g}" if known else "cannot tell"
            reach = f"at most {100 * detector.largest_detection:.0f} %" if known else ""
        else:
            size = f"{detector.smallest:.2g}"
            ends = (detector.low, detector.high)
            reach = " .. ".join(f"{end:.2g}" if end is not None else f"> {self.largest:.2g}" for end in ends)
        again = f"  lost again above {detector.lost_above:.2g}" if detector.lost_above is not None else ""
        probability = dict(detector.curve).get(SHOWN)
        shown = "-" if probability is None else f"{100 * probability:.0f} %"
        scatter = f"{100 * detector.scatter:.2g} %" if math.isfinite(detector.scatter) else "-"
        return f"{detector.detector:<20}{size:>22}{reach:>20}{scatter:>10}{shown:>18}{again}"

    def advice(self) -> str:
        """Return which of the compared commands finds the smallest leak."""
        smallest = [(row.detectors[row.best], row) for row in self.commands if row.best is not None]
        if not smallest:
            return f"no command makes these detectors find a leak up to {self.largest_compared:.2g} L/min"
        size, row = min(smallest, key=lambda pair: pair[0] or math.inf)
        return f"smallest of all: {size:.2g} L/min with {row.command}, throttles {row.orifices}, by {row.best}"


def _detector(detector: DetectorPrediction) -> dict[str, Any]:
    known = math.isfinite(detector.scatter)
    return {
        "name": detector.detector,
        "smallest_leak_lpm": detector.smallest,
        "interval_lpm": [detector.low, detector.high],
        "lost_above_lpm": detector.lost_above,
        "scatter": detector.scatter if known else None,
        "threshold": detector.threshold if known else None,
        "largest_detection_probability": detector.largest_detection if known else None,
        "detection_probability_at": [{"leak_lpm": size, "probability": value} for size, value in detector.curve],
    }


def _comparison(rows: tuple[CommandRow, ...]) -> list[str]:
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
