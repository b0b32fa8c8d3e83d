"""Summary of a machine from healthy recordings: terms, sensors, scatter, smallest leak, and problems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sealscope.diagnosis.commissioned.cross_check import BY_OTHERS
from sealscope.diagnosis.diagnose import FALSE_ALARM_PROBABILITY
from sealscope.diagnosis.inference.blocks import Columns, solve
from sealscope.diagnosis.inference.terms import equations
from sealscope.diagnosis.inference.volumes.detector import VolumeBalance
from sealscope.diagnosis.inspection import Inspection
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.machine import unstated
from sealscope.paragraphs import paragraphs
from sealscope.recordings.oil import oil_temperature
from sealscope.recordings.recording import Array, Recording
from sealscope.units import BAR, LITRE_PER_MINUTE, P_ATM, from_si

if TYPE_CHECKING:
    from sealscope.diagnosis.learnt import Learnt
    from sealscope.parameters import Rig

_BALANCE, _ASKED = VolumeBalance.name, priors("commissioned")["smallest"]


class TermEstimate(NamedTuple):
    """A coefficient of the balance: estimate, its standard deviation, its scatter between recordings, unit."""

    value: float
    deviation: float
    scatter: float | None
    unit: str


class Smallest(NamedTuple):
    """The smallest leak that the next recording shows.

    `lpm` [L/min], None where the machine's size is not stated, and `share` of the pump's flow; `halved_by`: how many
    times as many healthy recordings, of as many more days, make it half as large, None where ten times do not.
    """

    lpm: float | None
    share: float
    halved_by: int | None

    def __str__(self) -> str:
        share = f"{100.0 * self.share:.2g} % of the pump's flow"
        return share if self.lpm is None else f"{self.lpm:.2g} L/min, {share}"


@dataclass(frozen=True)
class Summary:
    """Figures of a machine from its healthy recordings.

    `terms` by name; `noise` of each channel in its unit; `smallest` leak, None where no balance states one; `problems`:
    what looks wrong, a line each.
    """

    terms: Mapping[str, TermEstimate]
    noise: Mapping[str, float]
    smallest: Smallest | None
    problems: list[str] = field(default_factory=list)

    def text(self, healthy: Sequence[Learnt], rig: Rig | None) -> str:
        """Format the summary in some ten lines."""
        units = healthy[0].units if healthy else {}
        starts = [recording.start_s for recording in healthy if recording.start_s is not None]
        dates = sorted(datetime.fromtimestamp(start, UTC).date().isoformat() for start in starts)
        span = f", {' to '.join(dict.fromkeys((dates[0], dates[-1])))}" if dates else ""
        noise = []
        for name, value in self.noise.items():
            unit = units.get(name, "")
            display_unit = {"Pa": "bar", "m": "mm"}.get(unit, unit)
            noise.append(f"{name} {from_si(value, display_unit, unit):.2g} {display_unit}")
        rows = [
            (
                "recordings",
                f"{len(healthy)} healthy, {sum(recording.seconds for recording in healthy):.4g} s in all{span}",
            ),
            ("channels", ", ".join(f"{name} [{unit}]" for name, unit in units.items())),
            ("machine", _describe_rig(rig)),
            ("duty", _duty(healthy)),
            ("noise", ", ".join(noise)),
        ]
        if self.smallest is not None:
            share = 100.0 * _ASKED["power"]
            rows.append(("smallest leak", f"the next recording shows {self.smallest} ({share:g} % of the time)"))
            half = "twice the pressure difference at the same flow; more recordings alone do not"
            if (times := self.smallest.halved_by) is not None:
                half = f"{times * len(healthy)} healthy recordings instead of {len(healthy)}"
                half += ", of as many more days" if dates else ""
            rows.append(("half of that", half))
        else:
            needs = "speed or angle of the pump, flow or command, and two recordings"
            rows.append(("smallest leak", f"not known, that needs {needs}; the ringing alone judges"))
        alarms = sum(BY_OTHERS in problem for problem in self.problems)
        promised = (
            f"1 in {len(healthy) + 1} by the ranks of {len(healthy)} healthy recordings alone, whatever their law"
        )
        rows.append(("false alarms", f"{promised}; {alarms or 'none'} of them stand out of the others"))
        rows += [("check", problem) for problem in self.problems]
        return "\n".join(paragraphs(rows, 16))


def _describe_rig(rig: Rig | None) -> str:
    """Describe the stated sizes of the machine in words."""
    rig = rig or unstated()
    if rig.states("cylinder.M_eq"):
        return rig.title or rig.name
    parts = []
    if rig.states("cylinder.A_A", "cylinder.A_B"):
        areas = dict.fromkeys(f"{1e6 * area:.4g}" for area in (rig.cylinder.A_A, rig.cylinder.A_B))
        parts.append(f"piston {' and '.join(areas)} mm^2")
    if rig.states("pump.q_b"):
        parts.append(f"pump {1e6 * rig.pump.q_b:.3g} cm^3/rev")
    return ", ".join(parts) or "size not stated: L/min needs a rig, an area or a displacement"


def _duty(healthy: Sequence[Learnt]) -> str:
    """Return the ranges of the pump's mean flow, where the machine's size is stated, of pressure and temperature."""
    lessons = [recording.lessons.get(_BALANCE, {}) for recording in healthy]
    flows = [lesson.get("flow", 0.0) * lesson.get("scale", 0.0) / LITRE_PER_MINUTE for lesson in lessons]
    ranges = {
        "L/min": [flow for flow in flows if flow > 0.0],
        "bar between the chambers": [
            recording.about["pressure_bar"] for recording in healthy if "pressure_bar" in recording.about
        ],
        "deg C": [recording.about["oil_degC"] for recording in healthy if "oil_degC" in recording.about],
    }
    texts = []
    for unit, values in ranges.items():
        if values:
            ends = dict.fromkeys(f"{end:.3g}" for end in (min(values), max(values)))
            texts.append(f"{' to '.join(ends)} {unit}")
    return ", ".join(texts)


def about_recording(recording: Recording, inspection: Inspection) -> dict[str, Any]:
    """Describe a healthy recording for people, with its problems."""
    part, description = inspection.part, dict[str, Any]()
    if {"p_A", "p_B"} <= set(part.channels) and part.units["p_A"] == "Pa":
        description["pressure_bar"] = _rounded(float(np.mean(np.abs(part["p_A"] - part["p_B"]))) / BAR)
    if (oil := oil_temperature(recording)) is not None:
        description["oil_degC"] = _rounded(oil)
    description["noise"] = {name: noise for name in part.channels if (noise := _noise(part[name])) > 0.0}
    description["wrong"] = [
        *(finding.text for finding in inspection.findings if finding.severity != "note"),
        *(text for name in ("p_A", "p_B") if name in part and (text := _below_vacuum(part, name))),
        *(text for name in ("omega", "u") if name in part and (text := _glitches(part, name))),
    ]
    return description


def summarised(healthy: Sequence[Learnt], rig: Rig | None, left_out: Sequence[str] = ()) -> Summary:
    """Summarise a machine's healthy recordings; `left_out`: the unusable ones with reasons."""
    problems = [*left_out, *_collected(healthy)]
    noises = [recording.about.get("noise", {}) for recording in healthy]
    names = dict.fromkeys(name for noise_of in noises for name in noise_of)
    noise = {name: float(np.median([noise_of[name] for noise_of in noises if name in noise_of])) for name in names}
    with_lessons = [recording for recording in healthy if _BALANCE in recording.lessons]
    comparable = [
        recording
        for recording in with_lessons
        if recording.lessons[_BALANCE]["terms"] == with_lessons[0].lessons[_BALANCE]["terms"]
    ]
    problems += [
        f"{recording.file} has other channels than {with_lessons[0].file}"
        for recording in with_lessons
        if recording not in comparable
    ]
    rig, channels = rig or unstated(), frozenset(comparable[0].units if comparable else ())
    if not (comparable and equations(rig, channels)):
        return Summary({}, noise, None, problems)
    lessons, balance = [recording.lessons[_BALANCE] for recording in comparable], VolumeBalance(rig)
    terms = _terms([np.asarray(lesson["sums"], dtype=float)[0] for lesson in lessons], rig, channels)
    if len(comparable) == 1:
        return Summary(terms, noise, None, problems)
    return Summary(terms, noise, _smallest(balance, lessons, channels), problems)


def _terms(sums: Sequence[Array], rig: Rig, channels: frozenset[str]) -> dict[str, TermEstimate]:
    """Return the estimates of the terms from all recordings together, and how each scatters between them."""
    equation = equations(rig, channels)[0]
    columns, units = Columns(equation), {term.name: term.unit for term in equation.terms}
    chosen = list(columns.nuisance)

    def fitted(gram: Array) -> Array:
        return solve(gram[np.ix_(chosen, chosen)], gram[chosen, columns.left])

    total, single = np.sum(sums, axis=0), np.array([fitted(gram) for gram in sums])
    values = fitted(total)
    variance = np.diag(solve(total[np.ix_(chosen, chosen)], np.eye(len(chosen))))
    scatter = single.std(axis=0, ddof=1).tolist() if len(sums) > 1 else [None] * len(chosen)
    return {
        name: TermEstimate(float(values[i]), float(np.sqrt(max(variance[i], 0.0))), scatter[i], units[name])
        for i, name in enumerate(columns.names[k] for k in chosen)
    }


def _smallest(balance: VolumeBalance, lessons: Sequence[Mapping[str, Any]], channels: frozenset[str]) -> Smallest:
    """Return the smallest leak that a recording of another day shows, of the duties of the healthy ones.

    A rise is found where it passes the threshold of Student's t; half is reached where the days are repeated so often
    that the threshold and the deviation of their mean, and nothing of their scatter, take it there.
    """
    from scipy.special import ndtri

    def findable(repeated: int) -> float:
        rise = balance.next_rise(lessons, channels, repeated)
        return float((rise.threshold(FALSE_ALARM_PROBABILITY) + ndtri(_ASKED["power"])) * rise.deviation)

    pressure, flow = (float(np.median([lesson[name] for lesson in lessons])) for name in ("pressure", "flow"))
    scale, smallest = float(np.median([lesson["scale"] for lesson in lessons])), findable(1)
    halved = next((times for times in _ASKED["repeats"] if findable(times) <= 0.5 * smallest), None)
    share = smallest * pressure / flow if flow > 0.0 else float("nan")
    return Smallest(smallest * pressure * scale / LITRE_PER_MINUTE if scale > 0.0 else None, share, halved)


def _collected(healthy: Sequence[Learnt]) -> list[str]:
    """Return the problems, each kind once, with the file or the number of files."""
    kinds: dict[str, list[tuple[str, str]]] = {}
    for recording in healthy:
        for text in recording.about.get("wrong", ()):
            kinds.setdefault(text.partition(":")[0], []).append((text, recording.file))
    return [
        f"{max(kind)[0]} ({kind[0][1] if len(kind) == 1 else f'in {len(kind)} of {len(healthy)}'})"
        for kind in kinds.values()
    ]


def _noise(values: Array) -> float:
    """Estimate the standard deviation of white noise from second differences, without outliers."""
    second = np.diff(values[np.isfinite(values)], 2)
    return _rounded(float(np.median(np.abs(second))) / 0.6745 / np.sqrt(6.0)) if second.size else 0.0


def _below_vacuum(part: Recording, name: str) -> str:
    if part.units[name] != "Pa" or not (least := float(np.quantile(part[name], 0.01))) < -P_ATM:
        return ""
    off = (-P_ATM - least) / BAR
    return f"{name} reads below vacuum: its zero is at least {off:.1g} bar too low"


def _glitches(part: Recording, name: str) -> str:
    """Report the number of samples that jump away and back by far more than all others."""
    values = part[name]
    if len(values) < 3:
        return ""
    middle = np.median([values[:-2], values[1:-1], values[2:]], axis=0)
    away = np.abs(values[1:-1] - middle)
    span = float(np.subtract(*np.quantile(values, (0.99, 0.01))))
    jumped = int(np.count_nonzero(away > span)) if span > 0.0 else 0
    return f"{name} has glitches: single samples jump beyond its whole range, and are weighted down" if jumped else ""


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
