"""Summarise a machine from its healthy recordings: noise of its sensors, smallest detectable leak, and problems.

Each healthy recording is judged against all others by the same decision as later recordings (`cross_check`, called by
`commission`): if one is judged leaking, either it or the others are not healthy.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sealscope.diagnosis.diagnose import FALSE_ALARM_PROBABILITY
from sealscope.diagnosis.healthy import SummarisedRecording
from sealscope.diagnosis.hold.recorded_holds import HoldSummary
from sealscope.diagnosis.inference.comparison import BalanceSummary
from sealscope.diagnosis.inference.equations.balances import circulation, equations
from sealscope.diagnosis.inference.equations.terms import Signals
from sealscope.diagnosis.inference.machine_states import find_rests
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.inspection import Inspection
from sealscope.diagnosis.priors.commissioned import COMMISSIONED
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import LEAK
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.paragraphs import paragraphs
from sealscope.recordings.channels import estimate_quantum
from sealscope.recordings.header import oil_temperature
from sealscope.recordings.recording import Array, Recording
from sealscope.units import BAR, LITRE_PER_MINUTE, P_ATM, from_si

if TYPE_CHECKING:
    from sealscope.diagnosis.healthy import SummarisedRecording
    from sealscope.parameters import Rig

#: Fewest recordings that are compared with each other, as the scatter of fewer recordings is not known.
MIN_RECORDINGS = 4
#: Words in the problem of a recording that differs from the other healthy recordings; `summary` counts them.
BY_OTHERS = "by the others"


def cross_check(
    healthy: Sequence[SummarisedRecording],
    judge: Callable[[SummarisedRecording, tuple[SummarisedRecording, ...]], Diagnosis],
    keep: bool = False,
) -> tuple[tuple[SummarisedRecording, ...], tuple[str, ...]]:
    """Diagnose each healthy recording against all others, and leave out those that seem to leak.

    `judge(recording, reference)` diagnoses a recording against the healthy recordings `reference`. No recording is left
    out if `keep` is True, or if at least half of the recordings seem to leak, as there is then no healthy majority.
    Fewer than `MIN_RECORDINGS` recordings are not judged. Returns the remaining recordings, and the reason for each one
    left out. If a remaining recording shows a leak or another event, its problems (`about["wrong"]`) state it.
    """
    problems, leaking = dict[str, str](), dict[str, str]()  # texts by the name of the recording's file
    begins_within = set[str]()  # names of the files in which a leak seems to begin
    for recording in healthy if len(healthy) >= MIN_RECORDINGS else ():
        diagnosis = judge(recording, tuple(other for other in healthy if other is not recording))
        if diagnosis.verdict == LEAK or diagnosis.cause is not None:
            problems[recording.file] = f"{diagnosis.summary} {BY_OTHERS}: {diagnosis.reason}"
        if diagnosis.verdict == LEAK:
            leaking[recording.file] = f"{recording.file}: {problems[recording.file]}"
            if diagnosis.onset_s is not None:
                begins_within.add(recording.file)
    healed = [file for file in begins_within if _has_healed(file, healthy, leaking)]
    leaking = {file: text for file, text in leaking.items() if file not in healed}
    if keep or 2 * len(leaking) >= len(healthy):
        leaking = {}
    remaining = [recording for recording in healthy if recording.file not in leaking]
    for k, recording in enumerate(remaining):
        if recording.file in problems:
            wrong = [*recording.about.get("wrong", ()), problems[recording.file]]
            remaining[k] = replace(recording, about={**recording.about, "wrong": wrong})
    return tuple(remaining), tuple(leaking.values())


def _has_healed(file: str, healthy: Sequence[SummarisedRecording], leaking: Collection[str]) -> bool:
    """Return True if recordings were made after that of the `file`, and none of them is among the `leaking` files.

    As a worn seal does not heal, the leak that seemed to begin in the recording is then no leak.
    """
    start_s = next(recording.start_s for recording in healthy if recording.file == file)
    if start_s is None:
        return False
    later = [recording.file for recording in healthy if recording.start_s is not None and recording.start_s > start_s]
    return bool(later) and not any(name in leaking for name in later)


#: Codes of findings of the severity "note" that are listed as problems of the machine: its logger causes them always.
_LOGGER_HABITS = ("unsigned_speed",)
_PRIORS = COMMISSIONED.smallest
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


class SmallestLeak(NamedTuple):
    """The smallest leak that the next recording shows with a stated probability (`power` of `priors.toml`)."""

    lpm: float | None  # flow of the leak [L/min], None if flows are not known in this unit
    share: float  # flow of the leak as a fraction of the pump's mean flow; nan if the pump does not move
    # factor on the number of healthy recordings, and of their days, that halves this leak; None if no tried one does
    halved_by: int | None

    def __str__(self) -> str:
        share = f"{100.0 * self.share:.2g} % of the pump's flow"
        return share if self.lpm is None else f"{self.lpm:.2g} L/min, {share}"


@dataclass(frozen=True)
class MachineSummary:
    """Figures of a machine, estimated from its healthy recordings."""

    noise: Mapping[str, float]  # standard deviation of the noise of each channel, in the channel's unit
    smallest: SmallestLeak | None  # smallest detectable leak, None if no volume balance can state one
    problems: list[str] = field(default_factory=list)  # problems of the recordings, one line each

    def text(self, healthy: Sequence[SummarisedRecording], rig: Rig | None, limit: str | None = None) -> str:
        """Format the summary as a table of about ten lines.

        `healthy` are the recordings from which it was made, and `rig` states the machine's sizes, if any are stated;
        `limit` is the stated repair limit, None for the default.
        """
        units = dict(healthy[0].units) if healthy else {}
        # units in the log of the first recording, or else the usual ones
        log_units = healthy[0].about.get("log_units", {}) if healthy else {}
        usual_units = {"Pa": "bar", "m": "mm"}
        display_units = {name: str(log_units.get(name) or usual_units.get(unit, unit)) for name, unit in units.items()}
        starts = [recording.start_s for recording in healthy if recording.start_s is not None]
        dates = sorted(datetime.fromtimestamp(start, UTC).date().isoformat() for start in starts)
        span = f", {' to '.join(dict.fromkeys((dates[0], dates[-1])))}" if dates else ""  # equal dates once
        noise = []
        for name, value in self.noise.items():
            unit, display_unit = units.get(name, ""), display_units.get(name, "")
            # a deviation has no offset: subtract the converted 0, which is not 0 for units such as deg C
            deviation = from_si(value, display_unit, unit) - from_si(0.0, display_unit, unit) if unit else value
            noise.append(f"{name} {deviation:.2g} {display_unit}")
        seconds = sum(recording.seconds for recording in healthy)
        n_alarms = sum(BY_OTHERS in problem for problem in self.problems)  # recordings unlike the others
        # by ranks, each of n + 1 healthy recordings is equally likely to have the highest score
        rate = (
            f"{100.0 * FALSE_ALARM_PROBABILITY:g} % of healthy recordings, by the law that their scatter is assumed to "
        )
        rate += f"follow; ranks of {len(healthy)} alone could not show fewer than 1 in {len(healthy) + 1}"
        needed = _describe_needs(rig or unstated_rig(), frozenset(units))
        rows = [
            ("recordings", f"{len(healthy)} healthy, {seconds:.4g} s in all{span}"),
            ("channels", ", ".join(f"{name} [{unit}]" for name, unit in display_units.items())),
            ("machine", _describe_rig(rig)),
            ("duty", _format_duty(healthy, display_units.get("p_A", "bar"))),
            ("holds", _format_holds(healthy)),
            ("noise", ", ".join(noise)),
            *self._smallest_leak_rows(len(healthy), are_dated=bool(dates), needed=needed),
            ("limit", _describe_limit(healthy, limit)),
            ("false alarms", f"{rate}; {n_alarms or 'none'} of them stand out of the others"),
            *(("check", problem) for problem in self.problems),
        ]
        return "\n".join(paragraphs(rows, columns=16))

    def _smallest_leak_rows(self, n_healthy: int, are_dated: bool, needed: str) -> list[tuple[str, str]]:
        """Build the rows (heading, text) on the smallest detectable leak and on the recordings needed to halve it.

        `needed` describes what a volume balance lacks.
        """
        if self.smallest is None:
            text = f"not known, that needs {needed}, in two recordings; the ringing alone judges"
            return [("smallest leak", text)]
        half = "twice the pressure difference at the same flow; more recordings alone do not"
        if (factor := self.smallest.halved_by) is not None:
            half = f"{factor * n_healthy} healthy recordings instead of {n_healthy}"
            half += ", of as many more days" if are_dated else ""
        power = f"{100.0 * _PRIORS.power:g} % of the time"
        smallest = f"the next recording with such oil, loads and speeds shows {self.smallest} ({power})"
        return [("smallest leak", smallest), ("half of that", half)]


def _describe_needs(rig: Rig, channels: frozenset[str]) -> str:
    """Describe what a volume balance needs that the healthy recordings, with these `channels`, may lack."""
    if equations(rig, channels):
        return "more motion"
    if circulation(rig, channels):
        return "the position x, or strokes that bring the piston back to where it was, or hold it under a load"
    return rig.circuit.needed_channels


def _describe_rig(rig: Rig | None) -> str:
    """Describe a stated rig in one line: its title or, if only sizes are stated, piston areas and pump displacement."""
    rig = rig or unstated_rig()
    if rig.states("cylinder.M_eq"):  # a whole rig is stated, not sizes alone
        return rig.title or rig.name
    parts = []
    if rig.states("cylinder.A_A", "cylinder.A_B"):
        # equal areas are named once
        areas = dict.fromkeys(f"{1e6 * area:.4g}" for area in (rig.cylinder.A_A, rig.cylinder.A_B))
        parts.append(f"piston {' and '.join(areas)} mm^2")
    if rig.states("pump.q_b"):
        parts.append(f"pump {1e6 * rig.pump.q_b:.3g} cm^3/rev")
    if rig.circuit.feeds_one_chamber:
        parts.append("pump in an open circuit, as a recording shows")
    if rig.circuit.has_asymmetric_pump:
        parts.append("asymmetric pump, as a recording shows")
    return ", ".join(parts) or "size not stated: L/min needs a rig, an area or a displacement"


def _describe_limit(healthy: Sequence[SummarisedRecording], limit: str | None) -> str:
    """Describe the repair limit: a stated one, or else the default beside one by the pump's flow, which is proposed.

    The proposal is the fraction `limit.share` of `priors.toml` of the largest flow that the pump has in motion in a
    healthy recording; there is none where flows have no unit.
    """
    if limit is not None:
        return f"{RepairLimit.parse(limit)}, as stated"
    text = f"none is stated: {RepairLimit.parse(None)} counts, which a maker allows a boom"
    flow = max((summary.delivered * summary.scale for summary in _balance_summaries(healthy)), default=0.0)
    if not flow > 0.0:
        return text
    proposal = RepairLimit(COMMISSIONED.limit.share * flow, "flow", stated=False)
    share = f"{100.0 * COMMISSIONED.limit.share:g} % of the {flow / LITRE_PER_MINUTE:.3g} L/min that the pump delivers"
    return f"{text}; {share} in motion would be --limit '{proposal}'"


def _format_duty(healthy: Sequence[SummarisedRecording], pressure_unit: str) -> str:
    """Format the ranges of pump flow, pressure difference and oil temperature, as far as they are known."""
    flows = [summary.flow * summary.scale / LITRE_PER_MINUTE for summary in _balance_summaries(healthy)]
    ranges = {
        "L/min": [flow for flow in flows if flow > 0.0],
        f"{pressure_unit} between the chambers": [
            from_si(BAR * recording.about["pressure_bar"], pressure_unit, "Pa")
            for recording in healthy
            if "pressure_bar" in recording.about
        ],
        "deg C": [recording.about["oil_degC"] for recording in healthy if "oil_degC" in recording.about],
    }
    texts = []
    for unit, values in ranges.items():
        if values:
            ends = dict.fromkeys(f"{end:.3g}" for end in (min(values), max(values)))  # equal ends once
            texts.append(f"{' to '.join(ends)} {unit}")
    return ", ".join(texts)


def _balance_summaries(healthy: Sequence[SummarisedRecording]) -> list[BalanceSummary]:
    """Collect the summaries by the volume balance."""
    return [summary for recording in healthy if (summary := recording.summary(BalanceSummary)) is not None]


def _format_holds(healthy: Sequence[SummarisedRecording]) -> str:
    """Format number, leaks and pressures of the healthy hold tests; "" without any."""
    holds = [hold for recording in healthy if (hold := recording.summary(HoldSummary)) is not None]
    figures = ([1e3 * hold.lpm for hold in holds], [hold.bar for hold in holds])
    ranges = [
        " to ".join(dict.fromkeys(f"{end:.3g}" for end in (min(values), max(values)))) for values in figures if holds
    ]
    return f"{len(holds)}, leak {ranges[0]} mL/min at {ranges[1]} bar" if holds else ""


def describe_recording(recording: Recording, inspection: Inspection) -> dict[str, Any]:
    """Collect figures of a healthy recording for display, by name; unknown figures are left out.

    - `pressure_bar`: mean of abs(p_A - p_B) [bar].
    - `oil_degC`: oil temperature [deg C].
    - `noise`: standard deviation of the noise of each channel, in the channel's unit.
    - `log_units`: unit of each channel in the log.
    - `wrong`: list of problems as texts; `defects`: share of the samples with each defect, by its name.
    """
    part, description = inspection.part, dict[str, Any]()
    if {"p_A", "p_B"} <= set(part.channels) and part.units["p_A"] == "Pa":
        description["pressure_bar"] = _round_to_4_digits(float(np.mean(np.abs(part["p_A"] - part["p_B"]))) / BAR)
    if (oil := oil_temperature(recording)) is not None:
        description["oil_degC"] = _round_to_4_digits(oil)
    # name in the log of each channel; q_supply may stand for a q_pump without a sign
    logged = {name: name if name in recording else "q_pump" for name in part.channels}
    noises = {name: _estimate_noise(recording[log_name]) for name, log_name in logged.items()}
    description["noise"] = {name: noise for name, noise in noises.items() if noise > 0.0}
    log_units = {name: unit for name, log_name in logged.items() if (unit := recording.unit_in_log(log_name))}
    if log_units:
        description["log_units"] = log_units
    findings, description["defects"] = inspection.findings, inspection.defect_shares
    problems = [finding.text for finding in findings if finding.severity != "note" or finding.code in _LOGGER_HABITS]
    problems += [
        f"{name} is not read: if it is the oil's temperature, then --map 'T_oil={name}', as warm oil leaks more"
        for name in recording.unused_temperatures[:1]  # only one column can be T_oil
    ]
    problems += [_describe_vacuum(part, name) for name in ("p_A", "p_B") if name in part]
    problems += [_describe_glitches(part, name) for name in ("omega", "u") if name in part]
    description["wrong"] = [text for text in problems if text]
    return description


def summarise_machine(
    healthy: Sequence[SummarisedRecording], rig: Rig | None, left_out: Sequence[str] = ()
) -> MachineSummary:
    """Estimate the figures of a machine from the summaries of its `healthy` recordings.

    The smallest detectable leak is that of the recordings whose volume balance has the same terms as the first one;
    others are listed as problems, and so is each text in `left_out`.
    """
    problems = [*left_out, *_collect_problems(healthy)]
    noises = defaultdict[str, list[float]](list)
    for recording in healthy:
        for name, value in recording.about.get("noise", {}).items():
            noises[name].append(value)
    noise = {name: float(np.median(values)) for name, values in noises.items()}
    with_balance = [recording for recording in healthy if BalanceSummary.method in recording.summaries]
    summaries: list[BalanceSummary] = []
    for recording, summary in zip(with_balance, _balance_summaries(with_balance), strict=True):
        if not summaries or summary.terms == summaries[0].terms:
            summaries.append(summary)
        else:
            problems.append(f"{recording.file} has other channels than {with_balance[0].file}")
    rig = rig or unstated_rig()
    channels = frozenset(with_balance[0].units if with_balance else ())
    has_scatter = len(summaries) > 1 and bool(equations(rig, channels))
    smallest = _smallest_leak(VolumeBalance(rig), summaries, channels) if has_scatter else None
    return MachineSummary(noise, smallest, problems)


def _smallest_leak(
    balance: VolumeBalance, summaries: Sequence[BalanceSummary], channels: frozenset[str]
) -> SmallestLeak:
    """Estimate the smallest leak that a recording of a later day will show if the machine moves and is loaded as usual.

    `balance` is the detector that made the `summaries` of the healthy recordings. Over these, a leak that is detected
    with the probability `power` (`priors.toml`) raises the leakage (`predict_rise`) by

        rise = (threshold of the test + normal quantile of `power`) * deviation,

    where `deviation` is the standard deviation of a healthy recording's leakage from its prediction. More healthy days
    lower the threshold and the error of the prediction, but not the scatter between recordings.
    """
    from scipy.special import ndtri

    def smallest_rise(n_repeats: int) -> float:
        """Compute the rise of the conductance [m^3/(s Pa)] for `n_repeats` times as many healthy days."""
        rise = balance.predict_rise(summaries, channels, n_repeats)
        return float((rise.threshold(FALSE_ALARM_PROBABILITY) + ndtri(_PRIORS.power)) * rise.deviation)

    pressure = float(np.median([summary.pressure for summary in summaries]))
    flow = float(np.median([summary.flow for summary in summaries]))
    scale = float(np.median([summary.scale for summary in summaries]))
    smallest = smallest_rise(n_repeats=1)
    halved_by = next((n for n in _PRIORS.repeats if smallest_rise(n) <= 0.5 * smallest), None)
    share = smallest * pressure / flow if flow > 0.0 else float("nan")
    lpm = smallest * pressure * scale / LITRE_PER_MINUTE if scale > 0.0 else None
    return SmallestLeak(lpm, share, halved_by)


def _collect_problems(healthy: Sequence[SummarisedRecording]) -> list[str]:
    """List the problems of all healthy recordings, one line for each kind: the text before a colon, without numbers.

    A line shows the alphabetically last of the texts, and the recording's name or the number of recordings.
    """
    by_kind = defaultdict[str, list[tuple[str, str]]](list)
    for recording in healthy:
        for text in recording.about.get("wrong", ()):
            by_kind[_NUMBER.sub("", text.partition(":")[0])].append((text, recording.file))
    lines = []
    for problems in by_kind.values():
        text, file = max(problems)
        files = {file for _, file in problems}
        lines.append(f"{text} ({file if len(files) == 1 else f'in {len(files)} of {len(healthy)}'})")
    return lines


def _estimate_noise(values: Array) -> float:
    """Estimate the standard deviation of white noise in a channel from second differences of its samples.

    These have sqrt(6) times the standard deviation of the noise; the median absolute value of a standard normal number
    is 0.6745. The estimate is at least the standard deviation of a rounding error, and 0 for fewer than three finite
    values.
    """
    known = values[np.isfinite(values)]
    if known.size < 3:
        return 0.0
    deviation = float(np.median(np.abs(np.diff(known, n=2)))) / 0.6745 / np.sqrt(6.0)
    return _round_to_4_digits(max(deviation, estimate_quantum(known) / np.sqrt(12.0)))


def _describe_vacuum(part: Recording, name: str) -> str:
    """Describe the zero error of a gauge pressure that reads below vacuum in 1 % of its samples; else return ""."""
    if part.units[name] != "Pa" or not (low_pressure := float(np.quantile(part[name], 0.01))) < -P_ATM:
        return ""
    offset = (-P_ATM - low_pressure) / BAR
    return f"{name} reads below vacuum: its zero is at least {offset:.1g} bar too low"


def _describe_glitches(part: Recording, name: str) -> str:
    """Describe a channel with single samples that jump by more than its range (1 to 99 % quantile); else return ""."""
    values = part[name]
    if len(values) < 3:
        return ""
    # median of each sample and its two neighbours; the first and the last sample have only one
    medians = np.median([values[:-2], values[1:-1], values[2:]], axis=0)
    high, low = np.quantile(values, (0.99, 0.01))
    value_range = float(high - low)
    if not (value_range > 0.0 and np.any(np.abs(values[1:-1] - medians) > value_range)):
        return ""
    return f"{name} has glitches: single samples jump beyond its whole range, and are weighted down"


def _round_to_4_digits(value: float) -> float:
    """Round a number to 4 significant digits."""
    return float(f"{value:.4g}")


class MachineDuty(NamedTuple):
    """Figures of a recording's duty, None where they are not known.

    `oil_degC`: oil temperature; `load_bar`: mean of abs(p_A - p_B); `speed`: root mean square speed of the piston
    [mm/s] or, without a position, of the motor [rpm], by `speed_unit`; `moving`: fraction of the time in which it
    moves; `minutes`: duration.
    """

    oil_degC: float | None
    load_bar: float | None
    speed: float | None
    speed_unit: str
    moving: float | None
    minutes: float


def measure_duty(recording: Recording) -> MachineDuty:
    """Measure the duty of a machine in a recording."""
    load = speed = moving = None
    unit = "mm/s"
    with np.errstate(all="ignore"):
        if {"p_A", "p_B"} <= recording.channels.keys() and recording.units["p_A"] == recording.units["p_B"] == "Pa":
            load = _mean(np.abs(recording["p_A"] - recording["p_B"]))
            load = None if load is None else load / BAR
        increments: Array | None = None
        if "x" in recording and recording.units["x"] == "m":
            increments, scale = np.diff(recording["x"]), 1e3
            values: Array | None = Signals({"x": recording["x"]}, recording.rate).speed
        elif "omega" in recording and recording.units["omega"] == "rad/s":
            values, scale, unit = recording["omega"], 30.0 / np.pi, "rpm"
            increments = values[1:] / recording.rate
        else:
            values = None
        if values is not None and increments is not None and len(values) > 2:
            mean_square = _mean(values**2)
            speed = None if mean_square is None else scale * float(np.sqrt(mean_square))
            rests = find_rests(increments, recording.rate)
            moving = float(1.0 - rests.mean())
    return MachineDuty(oil_temperature(recording), load, speed, unit, moving, recording.duration / 60.0)


def _mean(values: Array) -> float | None:
    """Compute the mean of the finite values, None if there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else None
