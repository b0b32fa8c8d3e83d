"""Format a diagnosis as text for the page and the terminal, by filling values into the texts of `messages.toml`."""

from __future__ import annotations

import tomllib
from datetime import UTC, datetime
from functools import cache
from importlib import resources
from math import floor, isfinite, isnan, log10
from pathlib import PurePath
from typing import Any

from sealscope.diagnosis.decision.decide import ORDER
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import LEAKS, RMS_CHANGE, TotalLeakage
from sealscope.diagnosis.verdict.machine_sizes import AssumedMachine
from sealscope.diagnosis.verdict.severity import MachineState
from sealscope.errors import printable
from sealscope.paragraphs import format_count, join_names, paragraph, paragraphs
from sealscope.recordings.formats.headings.labels import Label, suggest_map_entry
from sealscope.recordings.quality import MISSING_CHANNEL
from sealscope.units import from_si

ABSENT = "–"


@cache
def _texts() -> dict[str, dict[str, str]]:
    """Load the texts in `messages.toml`, as a mapping of section and key to text."""
    return tomllib.loads((resources.files("sealscope.reporting") / "messages.toml").read_text(encoding="utf-8"))


def say(name: str, /, **values: Any) -> str:
    """Format the text `name` ("section.key") of `messages.toml` with `values` in its placeholders."""
    section, _, key = name.partition(".")
    return _texts()[section][key].format(**values)


def number(value: float | None, digits: int = 3) -> str:
    """Format a number with `digits` significant digits; a dash stands for None or NaN, "∞" for infinity.

    Magnitudes from 1e-6 to 1e9 have no exponent, no zeros at the end of the decimals, and all digits before the point,
    such as 12345 with `digits` 3.
    """
    if value is None or isnan(value):
        return ABSENT
    if not isfinite(value):
        return "∞" if value > 0 else "−∞"
    text = f"{value:.{digits}g}"
    if 1e-6 <= abs(value) < 1e9:
        places = max(0, digits - 1 - floor(log10(abs(value))))  # decimals that give `digits` significant digits
        text = f"{value:.{places}f}"
        text = text.rstrip("0").rstrip(".") if "." in text else text
    return text.replace("-", "−")


def clock(seconds: float | None) -> str:
    """Format a time in seconds, such as "3.25 s", "75.5 s" or "3725.0 s (1:02:05)"; a dash if it is not known."""
    if seconds is None or not isfinite(seconds):
        return ABSENT
    text = f"{seconds:.1f} s" if abs(seconds) >= 10 else f"{seconds:.3g} s"
    if abs(seconds) >= 3600:
        minutes, whole_seconds = divmod(int(abs(seconds)), 60)
        text += f" ({'-' * (seconds < 0)}{minutes // 60}:{minutes % 60:02d}:{whole_seconds:02d})"
    return text.replace("-", "−")


def headline(diagnosis: Diagnosis) -> str:
    """Format the verdict as a heading: the text of `messages.toml` for it or for its cause, else its summary."""
    texts = _texts()["headline"]
    key = diagnosis.summary
    if diagnosis.verdict == "leak" and diagnosis.cause in texts:
        key = diagnosis.cause
    elif key == "no leak" and not diagnosis.known_healthy:  # a leak from the start cannot be excluded
        key = "none began"
    return texts.get(key, key[0].upper() + key[1:])  # `capitalize` would change other letters


def cause(diagnosis: Diagnosis) -> str | None:
    """Return the cause that texts may name, or None; a cause of `LEAKS` is named only with the verdict "leak"."""
    return None if diagnosis.cause in LEAKS and diagnosis.verdict != "leak" else diagnosis.cause


def shows_reason(diagnosis: Diagnosis) -> bool:
    """Return True if short texts show the reason: for `cannot tell`, or for a named cause other than a leak."""
    return diagnosis.verdict == "cannot tell" or (diagnosis.verdict != "leak" and cause(diagnosis) is not None)


def state_text(machine_state: MachineState) -> str:
    """Format a machine's state by NAMUR NE 107: its name, its symbol and, if it is not 0, its severity."""
    severity = f", severity {machine_state.severity} of 1000" if machine_state.severity else ""
    return f"{machine_state.name} ({machine_state.symbol} of NE 107{severity})"


def since(diagnosis: Diagnosis) -> str | None:
    """Format the onset of the leak with its interval, or the reason why there is none; None for other verdicts."""
    if diagnosis.verdict != "leak":
        return None
    if diagnosis.onset_s is None or diagnosis.onset_interval_s is None:
        return say("since.unsettled" if diagnosis.rises_within else "since.whole")
    low, high = map(clock, diagnosis.onset_interval_s)
    return say("since.interval", onset=clock(diagnosis.onset_s), low=low, high=high)


def how_much(diagnosis: Diagnosis) -> str | None:
    """Format the leak flow [L/min] with its interval, or its fraction of the pump's flow and why no flow is stated.

    For verdicts other than "leak", the text is the upper bound of a leak, or None if it is not known.
    """
    if diagnosis.verdict != "leak":
        bound = diagnosis.bound_lpm
        return None if bound is None else say("how_much.bound", bound=number(bound, 2))
    if diagnosis.leak_lpm is None or diagnosis.leak_interval_lpm is None:
        fraction = _pump_fraction(diagnosis)
        return _why_no_flow(diagnosis) if fraction is None else f"{fraction}; {_why_no_flow(diagnosis)}"
    low, high = map(number, diagnosis.leak_interval_lpm)
    return say("how_much.interval", leak=number(diagnosis.leak_lpm), low=low, high=high)


def _pump_fraction(diagnosis: Diagnosis) -> str | None:
    """Format the leak as a fraction, such as "5 % of the pump's flow in this duty"; None if it is not known."""
    severity = diagnosis.severity
    if severity is None or severity.pump_share is None:
        return None
    return f"{_format_percent(severity.pump_share[0])} of the pump's flow in this duty"  # [0]: without the interval


def _why_no_flow(diagnosis: Diagnosis) -> str:
    """Format the reason why the leak is not stated in L/min, with the remedy if there is one."""
    if "leak_lpm" not in diagnosis.refuses:  # not withheld, but cannot be computed
        # the channels allow L/min if the total leakage has them
        is_too_small = diagnosis.total_leakage is not None and diagnosis.total_leakage.lpm is not None
        return say(f"how_much.{'too_small' if is_too_small else 'channels'}")
    if raw_counts(diagnosis):
        return say("how_much.counts")
    if diagnosis.machine is None or diagnosis.machine.has_stated_sizes:  # withheld for another reason than sizes
        return say("how_much.reason")
    # with a measured ratio of displacement to area, the area alone is enough
    return say(f"how_much.{'machine' if diagnosis.measured_ratio is None else 'machine_or_area'}")


def machine_text(machine: AssumedMachine | None) -> str | None:
    """Format the piston area and pump displacement on which flows are based, or the flow meter; None if unknown."""
    if machine is None:
        return None
    if machine.flow_meter:
        key = "meter"  # of `messages.toml`
    elif machine.stated_by == "recording":
        key = "recording"
    elif machine.has_stated_sizes:
        key = "call" if machine.stated_by == "call" else "stated"
    else:
        key = "area" if machine.area_stated else "displacement" if machine.displacement_stated else "assumed"
    sides = [f"{number(1e6 * area, 4)} mm²" for area in machine.areas or (machine.area,)]
    area = sides[0] if sides[0] == sides[-1] else f"{sides[0]} at A and {sides[1]} at B"
    displacement = f"{number(1e6 * machine.displacement)} cm³/rev"
    return say(f"machine.{key}", area=area, displacement=displacement, rig=machine.rig)


def how_bad(diagnosis: Diagnosis) -> str | None:
    """Format the severity of the leak: its ratio to the repair limit in percent, or as a multiple if it may reach 10.

    If this ratio is not known, the text asks for the piston area if a limit was stated, else it is the fraction of the
    pump's flow, unless `how_much` states it. None if there is no leak or its size is not known.
    """
    severity, limit = diagnosis.severity, diagnosis.limit
    if severity is None:
        return None
    if severity.level is not None and severity.of_limit is not None:
        _, low, high = severity.of_limit  # multiples of the limit
        percent = _format_range(100.0 * low, 100.0 * high)
        share = f"{_format_range(low, high)} times" if high >= 10.0 else f"{percent} % of"
        return say(f"how_bad.{severity.level}", share=share, limit=f"{limit}{'' if limit.stated else ', the default'}")
    if limit.stated:
        return say("how_bad.no_area", limit=limit)
    return None if diagnosis.leak_lpm is None else _pump_fraction(diagnosis)


def _format_range(low: float, high: float) -> str:
    """Format a range with two significant digits, or as one number if both ends are then equal."""
    return " to ".join(dict.fromkeys((number(low, 2), number(high, 2))))


def other_sizes(diagnosis: Diagnosis) -> str | None:
    """Format the leak in mL/min, as a fraction of the pump's flow and as a creep speed, if known; None if none is."""
    severity = diagnosis.severity
    if severity is None:
        return None
    creep = severity.creep_mm_per_min
    # [0]: each quantity is (value, low, high), of which only the value is stated
    parts = [
        None if severity.mL_per_min is None else f"{number(severity.mL_per_min[0], 2)} mL/min",
        None if diagnosis.leak_lpm is None else _pump_fraction(diagnosis),  # without L/min `how_much` states it
        None if creep is None else f"as much as a piston that creeps by {number(creep[0], 2)} mm/min",
    ]
    return "; ".join(part for part in parts if part) or None


def total_leakage(diagnosis: Diagnosis, *, basis: bool = True) -> str | None:
    """Format the total leakage past pump and piston, with its smallest change that could have been detected.

    It is stated in L/min or else as a fraction of the pump's flow; None if no detector measured it. `basis`: True to
    add `machine_text`, unless the verdict is "leak", for which it stands beside the leak (`_figure_rows`).
    """
    leakage = diagnosis.total_leakage
    if leakage is None:
        return None
    pressure = f"{number(from_si(leakage.pressure, diagnosis.pressure_unit, 'Pa'), 2)} {diagnosis.pressure_unit}"
    if leakage.lpm is None or leakage.interval_lpm is None:
        return _leakage_fraction(leakage, pressure)
    low, high = leakage.interval_lpm
    # `not end > 0.0` is also true for NaN
    key = "none" if not high > 0.0 else "at_most" if not low > 0.0 else "interval"
    figures = {"lpm": number(leakage.lpm, 2), "low": number(low, 2), "high": number(high, 2)}
    text = say(f"leakage.{key}", pressure=pressure, **figures)
    if basis and diagnosis.verdict != "leak" and diagnosis.machine is not None:
        text += f" ({machine_text(diagnosis.machine)})"
    text += "" if leakage.healthy_lpm is None else say("leakage.healthy", lpm=number(leakage.healthy_lpm, 2))
    findable = leakage.findable_lpm
    return text + ("" if findable is None else say("leakage.findable", size=f"{number(findable, 2)} L/min"))


def _leakage_fraction(leakage: TotalLeakage, pressure: str) -> str:
    """Format a total leakage as a fraction of the pump's flow, or "not measured", with its smallest detectable step.

    `pressure`: text of the pressure at which it was measured.
    """
    is_known = leakage.pump_share is not None
    key = "share" if is_known else "not_measured"
    text = say(f"leakage.{key}", share=_format_percent(leakage.pump_share), pressure=pressure)
    if leakage.findable_share is None:
        return text
    change = _format_percent(leakage.findable_share) + ("" if is_known else " of the pump's flow")
    change += "" if leakage.findable_lpm is None else f", {number(leakage.findable_lpm, 2)} L/min"
    return text + say("leakage.findable", size=change)


def leakage_in_short(diagnosis: Diagnosis) -> str | None:
    """Format the total leakage past pump and piston in short; None if it is not known or the verdict is "leak"."""
    leakage = diagnosis.total_leakage
    if leakage is None or diagnosis.verdict == "leak":
        return None
    if leakage.lpm is None or leakage.interval_lpm is None:
        if leakage.pump_share is None:
            return None
        return f"in all {_format_percent(leakage.pump_share)} of the pump's flow"
    low, high = leakage.interval_lpm
    return f"in all {number(leakage.lpm, 2)} L/min" if low > 0.0 else f"in all at most {number(high, 2)} L/min"


def states_flow(diagnosis: Diagnosis) -> bool:
    """Return True if the diagnosis states a flow in L/min."""
    leakage = diagnosis.total_leakage
    return diagnosis.leak_lpm is not None or (leakage is not None and leakage.lpm is not None)


def _format_percent(fraction: float | None) -> str:
    """Format a fraction in percent with two significant digits; a dash for None."""
    return ABSENT if fraction is None else f"{number(100.0 * fraction, 2)} %"


def how_sure(diagnosis: Diagnosis) -> str:
    """Format the evidence: odds that a healthy recording looks like this one, score, threshold, false-alarm rate.

    If an alarm has another cause than a leak, the text names the cause to which odds and score refer.
    """
    if diagnosis.score is None or diagnosis.threshold is None:
        return say("how_sure.no_score")
    odds, found_cause = diagnosis.odds, cause(diagnosis)
    odds = "" if odds is None else f"{odds}; "
    relation = "over" if diagnosis.score > diagnosis.threshold else "not over"
    if diagnosis.verdict != "leak" and found_cause is not None and diagnosis.alarmed:
        # the alarm has another cause than a leak
        odds, relation = f"that something changed: {odds}", f"for {found_cause}, over"
    detector = diagnosis.methods[0].detector if diagnosis.methods else ""  # the deciding method is first
    return say(
        "how_sure.score", odds=odds, score=number(diagnosis.score), relation=relation,
        threshold=number(diagnosis.threshold), judge=f" of {detector}" if detector else "",
        false_alarms=false_alarms(diagnosis),
    )  # fmt: skip


def odds_or_false_alarms(diagnosis: Diagnosis) -> str:
    """Format the odds that a healthy recording looks like this recording; if unknown, the false-alarm probability."""
    return diagnosis.odds or false_alarms(diagnosis)


def false_alarms(diagnosis: Diagnosis) -> str:
    """Format the false-alarm probability of all tests together in % and as "1 in n", or as a number if it is 0 or 1."""
    p = diagnosis.false_alarm_probability
    if not 0 < p < 1:
        return say("how_sure.probability", probability=number(p))
    every = f"{round(1 / p)}" if 1 / p >= 10 else number(1 / p)
    return say("how_sure.share", share=f"{number(100 * p)} % (1 in {every})")


def next_steps(diagnosis: Diagnosis) -> tuple[str, ...]:
    """List the recommended next steps as sentences, most useful first; one names faults of the data, if any."""
    severity_level = None if diagnosis.severity is None else diagnosis.severity.level
    deciding_detector = diagnosis.methods[0].detector if diagnosis.methods else ""  # the deciding method is first
    # an unknown level is treated as the middle one, `plan`
    step_once_confirmed = say(f"once_confirmed.{severity_level or 'plan'}", limit=diagnosis.limit)
    has_named_cause = diagnosis.named_cause is not None
    if diagnosis.holds:
        return (diagnosis.next_check,)
    if diagnosis.verdict == "leak":
        # `next_check` tests a named cause by the piston's creep, else it repeats the recording: the other comes second
        steps = [diagnosis.next_check, say("next.repeat" if has_named_cause else "next.creep"), step_once_confirmed]
    elif has_named_cause:
        steps = [diagnosis.next_check, say("next.resolved")]
    elif diagnosis.verdict == "no leak":
        steps = [say("next.ringing") if deciding_detector == RMS_CHANGE else diagnosis.next_check, say("next.longer")]
    else:
        # the detectors in `ORDER` measure the leak flow
        estimates_flow = any(method.usable for method in diagnosis.methods if method.detector in ORDER)
        steps = [say("next.cause"), say("next.record")]
        if not estimates_flow and any(method.usable for method in diagnosis.methods):
            # samples that serve a method with fewer needs most likely lack a channel, which must be recorded first
            steps.reverse()
        if diagnosis.unused and not estimates_flow:
            steps.insert(0, say("next.map"))
    # a baseline that was left out, such as the recording itself, is no defect of the data
    # and a missing channel has a line of its own
    no_defects = ("baseline_left_out", MISSING_CHANNEL)
    findings = (finding for finding in diagnosis.quality if finding.code not in no_defects)
    defects = [finding for finding in findings if finding.severity != "note"]
    if defects:
        names = [f"{entry.code.replace('_', ' ')}{f' ({entry.channel})' if entry.channel else ''}" for entry in defects]
        faults = ", ".join(dict.fromkeys(names))
        if has_named_cause or diagnosis.verdict == "leak":
            steps.insert(0, say("next.rule_out", faults=faults))
        elif diagnosis.verdict == "cannot tell":
            # the first step, the only one in the short text, can settle the verdict; a finding may not be its reason
            steps.insert(1, say("next.findings", faults=faults))
        else:
            steps.insert(0, say("next.care", faults=faults))
    return tuple(steps)


def quality_summary(diagnosis: Diagnosis) -> str:
    """Format the number of findings on the quality of the data, and the worst severity, unless it is "note"."""
    severities = {finding.severity for finding in diagnosis.quality}
    worst = next((f" ({severity})" for severity in ("fatal", "warning") if severity in severities), "")
    return f"{format_count(len(diagnosis.quality), 'finding')}{worst}"


def raw_counts(diagnosis: Diagnosis) -> str | None:
    """Format a note on channels recorded in raw counts (numbers of a converter), with the remedy; None if none are."""
    names = [finding.channel for finding in diagnosis.quality if finding.code == "raw_counts" and finding.channel]
    return f"{' and '.join(names)} in raw counts: state the unit, or a leak's size stays relative" if names else None


def format_unused_columns(diagnosis: Diagnosis) -> str | None:
    """Format a note on unused columns, with options --map to use the first four as channels; None if there are none."""
    if not diagnosis.unused:
        return None
    lines = " ".join(f"--map '{suggest_map_entry(Label.parse(name))}'" for name in diagnosis.unused[:4])
    return f"{join_names(diagnosis.unused)}: recorded, and used for no channel; if they are channels: {lines}"


def _unsigned_channels(diagnosis: Diagnosis) -> list[str]:
    """List the findings on speeds without a sign; beside healthy recordings only those whose sign cannot be restored.

    That a sign is restored in each recording of a machine is said once, by `commission`.
    """
    findings = [finding for finding in diagnosis.quality if finding.code == "unsigned_speed"]
    return [finding.text for finding in findings if finding.severity != "note" or not diagnosis.baselines]


def short_text(diagnosis: Diagnosis) -> str:
    """Format a short text of a diagnosis: the verdict, its numbers and the next step."""
    odds = odds_or_false_alarms(diagnosis) if diagnosis.odds or diagnosis.score is not None else None
    rows = [
        ("state", state_text(diagnosis.state)),
        *_figure_rows(diagnosis),
        ("leakage", total_leakage(diagnosis) if diagnosis.verdict == "no leak" else None),
        ("cause", cause(diagnosis)),
        ("reason", diagnosis.reason) if shows_reason(diagnosis) else ("how sure", odds),
        ("data", quality_summary(diagnosis) if diagnosis.quality else None),
        ("units", raw_counts(diagnosis)),
        ("not used", format_unused_columns(diagnosis)),
        *(("missing", finding.text) for finding in diagnosis.missing_channels),
        *(("check", text) for text in _unsigned_channels(diagnosis)),
        ("next", next_steps(diagnosis)[0]),
    ]
    return _format_lines(diagnosis, rows)


def diagnosis_text(diagnosis: Diagnosis) -> str:
    """Format a whole diagnosis as text: verdict, numbers, all methods and all findings."""
    rows: list[tuple[str, str | None]] = [
        ("state", state_text(diagnosis.state)),
        *_figure_rows(diagnosis),
        ("which is", other_sizes(diagnosis)),
        ("leakage", total_leakage(diagnosis)),
        ("cause", cause(diagnosis)),
        ("how sure", how_sure(diagnosis)),
        ("reason", diagnosis.reason),
        ("not used", format_unused_columns(diagnosis)),
    ]
    for method in diagnosis.methods:
        odds = "" if method.odds is None else f"{method.odds}; "
        figures = f"{odds}score {number(method.score)}, threshold {number(method.threshold)}"
        figures = method.reason if method.score is None and method.reason else figures
        rows.append(("method", f"{method.detector}: {method.summary} ({figures})"))
    rows += [(finding.severity, finding.text) for finding in diagnosis.quality]
    # only the first of the steps has a label
    rows += [("" if k else "next", step) for k, step in enumerate(next_steps(diagnosis)[:2])]
    return _format_lines(diagnosis, rows)


def _figure_rows(diagnosis: Diagnosis) -> list[tuple[str, str | None]]:
    """Build the rows (label, text) on the onset, the size and the severity of the leak; a text is None if unknown."""
    size = how_much(diagnosis)
    if size is not None and diagnosis.machine is not None and diagnosis.leak_lpm is not None:
        size = f"{size}; {machine_text(diagnosis.machine)}"
    return [("since", since(diagnosis)), ("how much", size), ("how bad", how_bad(diagnosis))]


def _format_lines(diagnosis: Diagnosis, rows: list[tuple[str, str | None]]) -> str:
    """Format file and verdict, then a paragraph for each row (label, text) that has a text."""
    first = say("terminal.diagnosis", file=printable(diagnosis.file), summary=diagnosis.summary)
    return "\n".join((first, *paragraphs(rows, columns=12)))


def format_leak_flow(diagnosis: Diagnosis) -> str:
    """Format the leak flow [L/min] with its interval, or its bound for verdicts other than "leak", for a table."""
    if diagnosis.leak_lpm is not None and diagnosis.leak_interval_lpm is not None:
        low, high = diagnosis.leak_interval_lpm
        return f"{number(diagnosis.leak_lpm, 2)} L/min ({number(low, 2)} to {number(high, 2)})"
    if diagnosis.bound_lpm is not None:
        return f"none above {number(diagnosis.bound_lpm, 2)} L/min"
    return "L/min not stated"


def what_to_do(diagnosis: Diagnosis) -> str:
    """Return the first recommended step or, for the verdict "cannot tell", the reason of this verdict."""
    return diagnosis.reason if diagnosis.verdict == "cannot tell" else next_steps(diagnosis)[0]


#: Width of the file's name in a table; a longer name is written on a separate line.
_FILE_COLUMNS = 22


def table_line(diagnosis: Diagnosis, start_s: float | None = None) -> str:
    """Format a diagnosis as a line of a table with file, date, verdict and leak flow [L/min], then what to do.

    For a plain `no leak`, there is nothing to do. `start_s` [s since 1970]: start of the recording, None for a blank
    date.
    """
    file = printable(PurePath(diagnosis.file).name)
    date = "" if start_s is None else datetime.fromtimestamp(start_s, UTC).date().isoformat()
    file = file if len(file) <= _FILE_COLUMNS else f"{file}\n{' ' * _FILE_COLUMNS}"
    line = f"{file:<{_FILE_COLUMNS}} {date:<10} {diagnosis.verdict:<11} {format_leak_flow(diagnosis)}"
    found_cause = cause(diagnosis)
    if diagnosis.verdict == "no leak" and found_cause is None:
        return line
    prefix = "" if found_cause is None or diagnosis.verdict == "leak" else f"{found_cause}: "
    return f"{line}\n{paragraph(prefix + what_to_do(diagnosis), '    ')}"
