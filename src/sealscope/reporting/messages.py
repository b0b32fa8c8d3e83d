"""Sentences on a diagnosis for page and terminal, and the terminal text."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from math import floor, isfinite, isnan, log10
from pathlib import PurePath
from textwrap import fill, shorten

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import LEAKS
from sealscope.diagnosis.verdict.machine import AssumedMachine
from sealscope.diagnosis.verdict.severity import Level
from sealscope.recordings.formats.columns import listed
from sealscope.recordings.quality import Finding

ABSENT = "–"


def number(value: float | None, digits: int = 3) -> str:
    """Return `value` with `digits` significant digits, a dash for None or NaN; no exponent where that is short."""
    if value is None or isnan(value):
        return ABSENT
    if not isfinite(value):
        return "∞" if value > 0 else "−∞"
    if value == 0 or 1e-6 <= abs(value) < 1e9:
        places = max(0, digits - 1 - floor(log10(abs(value)))) if value else 0
        text = f"{value:.{places}f}"
        text = text.rstrip("0").rstrip(".") if "." in text else text
    else:
        text = f"{value:.{digits}g}"
    return text.replace("-", "−")


def clock(seconds: float | None) -> str:
    """Return a time in seconds (one decimal, more below 10 s), from an hour on as h:mm:ss as well."""
    if seconds is None or not isfinite(seconds):
        return ABSENT
    text = (f"{seconds:.1f} s" if abs(seconds) >= 10 else f"{seconds:.3g} s").replace("-", "−")
    if abs(seconds) < 3600:
        return text
    whole = int(abs(seconds))
    sign = "−" if seconds < 0 else ""
    return f"{text} ({sign}{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d})"


#: A summary as a sentence; that of another cause is one.
_SENTENCES: Mapping[str, str] = {
    "leak": "Leak: oil bypasses the piston",
    "no leak": "No leak found across the piston",
    "cannot tell": "Cannot tell whether oil bypasses the piston",
}


def headline(diagnosis: Diagnosis) -> str:
    """Return the verdict as the heading of page and card: the summary of the terminal and of JSON, as a sentence."""
    summary = diagnosis.summary
    if diagnosis.verdict == "leak" and diagnosis.cause == "piston or pump leak":
        return "Leak: oil bypasses the piston, or the pump"
    if summary == "no leak" and not diagnosis.known_healthy:  # one from the start would be hidden
        return "No leak began within this recording"
    return _SENTENCES.get(summary, summary[0].upper() + summary[1:])


def cause(diagnosis: Diagnosis) -> str | None:
    """Return what the change is attributed to; None where there is none, or it cannot be told."""
    if diagnosis.cause in LEAKS and diagnosis.verdict != "leak":
        return None
    return diagnosis.cause


def state(diagnosis: Diagnosis) -> str:
    """Return the state of the machine as NAMUR NE 107 names it, with its letter and its severity."""
    own = diagnosis.state
    return f"{own.name} ({own.symbol} of NE 107{f', severity {own.severity} of 1000' if own.severity else ''})"


def since(diagnosis: Diagnosis) -> str | None:
    """Return since when oil leaks; None where there is no leak to date."""
    if diagnosis.verdict != "leak":
        return None
    if diagnosis.onset_s is None:
        return "not within this recording: as a whole it was compared with leak-free ones"
    text = clock(diagnosis.onset_s)
    if diagnosis.onset_interval_s is not None:
        low, high = diagnosis.onset_interval_s
        text += f", between {clock(low)} and {clock(high)}"
    return text


def how_much(diagnosis: Diagnosis) -> str | None:
    """Return how much oil leaks [L/min], or at most could where no leak was found; None where nothing is known."""
    interval = diagnosis.leak_interval_lpm
    if diagnosis.verdict != "leak" and diagnosis.bound_lpm is not None:
        return f"none above {number(diagnosis.bound_lpm, 2)} L/min (95 % bound)"
    if diagnosis.verdict == "no leak" and diagnosis.leak_lpm is not None and interval is not None and interval[1] > 0:
        return f"none found; at most {number(interval[1], 2)} L/min (95 % interval)"
    if diagnosis.verdict != "leak":
        return None
    if diagnosis.leak_lpm is None:
        own = diagnosis.severity
        share = "" if own is None or own.pump_share is None else f"{_of_the_pump(own.pump_share[0])}; "
        return share + _why_no_flow(diagnosis)
    text = f"{number(diagnosis.leak_lpm)} L/min"
    if interval is not None:
        text += f", between {number(interval[0])} and {number(interval[1])} L/min"
    return text


def _of_the_pump(share: float) -> str:
    return f"{number(100.0 * share, 2)} % of the pump's flow in this duty"


def _why_no_flow(diagnosis: Diagnosis) -> str:
    """Return why a leak has no L/min, and what would state it."""
    ratio = diagnosis.measured_ratio
    if "leak_lpm" not in diagnosis.refuses:
        small = diagnosis.passage is not None and diagnosis.passage.lpm is not None
        return f"L/min not stated: {'it is too small for that' if small else 'the channels do not allow it'}"
    if diagnosis.machine is not None and not diagnosis.machine.stated:
        ask = "state --rig, or the piston's --area" if ratio is not None else "state --rig"
        return f"L/min not stated: the size of the machine is not known; {ask}"
    if diagnosis.machine is None or ratio is None:
        return "not stated: see the reason"
    return (
        f"L/min not stated: displacement over area measures {number(ratio[0])} times that of rig "
        f"{diagnosis.machine.rig}: check the rig and the units of x and theta"
    )


def _how_much_by_what(diagnosis: Diagnosis) -> str | None:
    """Return how much oil leaks, with what the figure rests on."""
    text, basis = how_much(diagnosis), rests_on(diagnosis)
    return text if text is None or basis is None or diagnosis.leak_lpm is None else f"{text}; {basis}"


def rests_on(diagnosis: Diagnosis) -> str | None:
    """Return what every L/min of the diagnosis rests on; None where that is not known."""
    return None if diagnosis.machine is None else machine_text(diagnosis.machine)


def machine_text(machine: AssumedMachine) -> str:
    """Return area and displacement that a flow rests on, and who stated them."""
    area = f"{number(1e6 * machine.area)} mm²"
    displacement = f"{number(1e6 * machine.displacement)} cm³/rev"
    if machine.stated_by == "recording":
        return f"piston {area} and pump {displacement} by the recording's own rig, {machine.rig}"
    if machine.stated:
        by = f"by rig {machine.rig}, as stated" if machine.stated_by == "call" else "as stated"
        return f"piston {area} and pump {displacement} {by}"
    if machine.area_stated:
        return f"piston {area} as stated"
    if machine.displacement_stated:
        return f"pump {displacement} as stated"
    return f"assumed, for no rig was stated: piston {area} and pump {displacement} of rig {machine.rig}"


#: What a level of severity means.
_LEVELS: Mapping[Level, str] = {"repair": "over the limit: ", "plan": "", "follow": "well within: "}


def _between_shares(low: float, high: float) -> str:
    """Return a range of shares in per cent, from ten on as multiples."""
    if high >= 10.0:
        return f"{number(low, 2)} to {number(high, 2)} times"
    return f"{number(100.0 * low, 2)} to {number(100.0 * high, 2)} % of"


def how_bad(diagnosis: Diagnosis) -> str | None:
    """Return the leak against the repair limit, else beside the pump's flow; None where neither is known."""
    own = diagnosis.severity
    if own is None:
        return None
    if own.level is not None and own.of_limit is not None:
        by = "" if diagnosis.limit.stated else ", the default"
        against = _between_shares(*own.of_limit[1:])
        return f"{_LEVELS[own.level]}{against} the repair limit ({diagnosis.limit}{by})"
    share = _pump_share(diagnosis)
    if diagnosis.limit.stated:
        return f"not compared with the limit of {diagnosis.limit}, which needs the machine's area (--area)"
    return share


def other_sizes(diagnosis: Diagnosis) -> str | None:
    """Return the other sizes of the leak: beside the pump's flow, and as a creep; None where none is known."""
    own = diagnosis.severity
    if own is None:
        return None
    creep = own.creep_mm_per_min
    parts = [
        None if own.mL_per_min is None else f"{number(own.mL_per_min[0], 2)} mL/min",
        _pump_share(diagnosis),
        None if creep is None else f"as much as a piston that creeps by {number(creep[0], 2)} mm/min",
    ]
    return "; ".join(part for part in parts if part) or None


def _pump_share(diagnosis: Diagnosis) -> str | None:
    own = diagnosis.severity
    known = own is not None and own.pump_share is not None and diagnosis.leak_lpm is not None
    return _of_the_pump(own.pump_share[0]) if known else None  # type: ignore[union-attr, index]


def passes(diagnosis: Diagnosis, *, basis: bool = True) -> str | None:
    """Return what pump and piston together pass, and what of it would have shown; None where it is not known.

    `basis`: with what L/min rests on.
    """
    own = diagnosis.passage
    if own is None:
        return None
    pressure = f"at {number(own.pressure / 1e6, 2)} MPa"
    if own.lpm is None or own.interval_lpm is None:
        text = "not measured"
        if own.pump_share is not None:
            text = f"pump and piston together {_percent(own.pump_share)} of the pump's flow {pressure}"
        if own.findable_share is not None:
            text += f"; the smallest step that would have been found is {_percent(own.findable_share)}"
            text += "" if own.pump_share is not None else " of the pump's flow"
            text += "" if own.findable_lpm is None else f", {number(own.findable_lpm, 2)} L/min"
        return text
    low, high = own.interval_lpm
    if not high > 0.0:
        text = f"pump and piston together less than this recording measures, {pressure}"
    elif not low > 0.0:
        text = f"pump and piston together at most {number(high, 2)} L/min {pressure}"
    else:
        text = f"pump and piston together {number(own.lpm, 2)} L/min, between {number(low, 2)} and {number(high, 2)}, "
        text += pressure
    if basis and diagnosis.verdict != "leak" and (machine := rests_on(diagnosis)) is not None:
        text += f" ({machine})"
    if own.healthy_lpm is not None:
        text += f"; a healthy machine at most {number(own.healthy_lpm, 2)} L/min"
    if own.findable_lpm is not None:
        text += f"; the smallest step that would have been found is {number(own.findable_lpm, 2)} L/min"
    return text


def passes_in_short(diagnosis: Diagnosis) -> str | None:
    """Return what pump and piston together pass, in a few words; None where it is not known or there is a leak."""
    own = diagnosis.passage
    if own is None or diagnosis.verdict == "leak":
        return None
    if own.lpm is None or own.interval_lpm is None:
        return None if own.pump_share is None else f"passes {_percent(own.pump_share)} of the pump's flow"
    low, high = own.interval_lpm
    return f"passes {number(own.lpm, 2)} L/min" if low > 0.0 else f"passes at most {number(high, 2)} L/min"


def states_flow(diagnosis: Diagnosis) -> bool:
    """Return whether the diagnosis states any L/min."""
    return diagnosis.leak_lpm is not None or (diagnosis.passage is not None and diagnosis.passage.lpm is not None)


def _percent(share: float | None) -> str:
    return ABSENT if share is None else f"{number(100.0 * share, 2)} %"


def how_sure(diagnosis: Diagnosis) -> str:
    """Return how many healthy recordings look like this, the score against its threshold, and what that means."""
    if diagnosis.score is None or diagnosis.threshold is None:
        return "no score was formed"
    said = _odds(diagnosis)
    odds = "" if said is None else f"{said}; "
    relation = "over" if diagnosis.score > diagnosis.threshold else "not over"
    other = cause(diagnosis)
    if diagnosis.verdict != "leak" and other is not None and diagnosis.alarmed:
        odds = f"that something changed: {odds}"
        relation = f"for {other}, over"
    text = f"score {number(diagnosis.score)}, {relation} the threshold of {number(diagnosis.threshold)}"
    judge = diagnosis.methods[0].detector if diagnosis.methods else ""
    by = f" of {judge}" if judge else ""
    return f"{odds}{text}{by}; {false_alarms(diagnosis)}"


def in_short(diagnosis: Diagnosis) -> str:
    """Return how many healthy recordings look like this; where that is not stated, what the threshold was set for."""
    return _odds(diagnosis) or false_alarms(diagnosis)


def _odds(diagnosis: Diagnosis) -> str | None:
    """Return how many healthy recordings look like this; without a change, how many show as much of one."""
    odds = diagnosis.odds
    if odds is None or diagnosis.verdict != "no leak" or diagnosis.alarmed:
        return odds
    return odds.replace("looks like this", "shows as much change").replace("look like this", "show as much change")


def false_alarms(diagnosis: Diagnosis) -> str:
    """Return what the threshold was set for."""
    p = diagnosis.false_alarm_probability
    if 0 < p < 1:
        every = 1 / p
        shown = f"{round(every)}" if every >= 10 else number(every)
        share = f"{number(100 * p)} % (1 in {shown})"
        return f"the threshold is set so that {share} of leak-free recordings raise a false alarm"
    return f"the threshold is set for a false-alarm probability of {number(p)}"


def _fault(finding: Finding) -> str:
    name = finding.code.replace("_", " ")
    return f"{name} ({finding.channel})" if finding.channel else name


def _after_that(diagnosis: Diagnosis) -> str:
    """Return what to do about a leak that is confirmed, by its severity."""
    own = diagnosis.severity
    level = None if own is None else own.level
    if level == "repair":
        return (
            f"If it is confirmed, change the seal, or the pump, now: the leak is over the repair limit of "
            f"{diagnosis.limit}."
        )
    if level == "follow":
        return (
            f"If it is confirmed, follow it in every recording; it is under half of the repair limit of "
            f"{diagnosis.limit}, and nothing is urgent."
        )
    return "If it is confirmed, plan the change of the piston seal and follow the leak in every recording until then."


def next_steps(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return what to check next, most useful first."""
    trouble = [finding for finding in diagnosis.quality if finding.severity != "note"]
    faults = ", ".join(dict.fromkeys(_fault(finding) for finding in trouble))
    repeat = "Repeat the recording with the same command and oil temperature: a worn seal shows again."
    plan = _after_that(diagnosis)
    if diagnosis.cause is not None and (diagnosis.verdict == "leak") == (diagnosis.cause in LEAKS):
        steps = [diagnosis.next_check, repeat, plan]
        if diagnosis.verdict != "leak":
            steps[1:] = ["Record again under the same command when that is settled: a leak may hide behind it."]
        if trouble:
            steps.insert(0, f"Rule out a fault of the data first: {faults}.")
    elif diagnosis.verdict == "leak":
        steps = [
            repeat,
            "Make sure that the bypass needle valve is shut. The pressures cannot tell it from the piston seal.",
            "Hold the piston against a load with the motor at rest and watch x: creep confirms the leak.",
            plan,
        ]
        if trouble:
            steps.insert(0, f"Rule out a fault of the data first: {faults}.")
    elif diagnosis.verdict == "no leak":
        steps = [
            diagnosis.next_check,
            "A leak too small to lift the score over its threshold stays unseen; a longer recording sees smaller ones.",
        ]
        if trouble:
            steps.insert(0, f"Judge with care, the data have faults: {faults}.")
    else:
        steps = ["Remove the cause named above and record again; a verdict was not forced out of these data."]
        if trouble:
            steps.append(f"Findings on the data: {faults}.")
        steps.append("Record p_A and p_B at 500 Hz or more for some minutes under one command, or give a baseline.")
    return tuple(steps)


def quality_summary(diagnosis: Diagnosis) -> str:
    """Return how many findings there are, and the worst severity among them."""
    count = len(diagnosis.quality)
    severities = {finding.severity for finding in diagnosis.quality}
    worst = next((f" ({severity})" for severity in ("fatal", "warning") if severity in severities), "")
    return f"{count} finding{'s' if count != 1 else ''}{worst},"


def raw_counts(diagnosis: Diagnosis) -> str | None:
    """Return which pressures are in raw counts, and what to do; None where none is."""
    names = [finding.channel for finding in diagnosis.quality if finding.code == "raw_counts" and finding.channel]
    return f"{' and '.join(names)} in raw counts: state the unit, or a leak's size stays relative" if names else None


def not_used(diagnosis: Diagnosis) -> str | None:
    """Return which recorded pressures, positions and speeds no channel is made of; None where all are."""
    return f"{listed(diagnosis.unused)}: recorded, and taken for no channel" if diagnosis.unused else None


def short_text(diagnosis: Diagnosis, *, width: int = 80) -> str:
    """Return the verdict, its figures and the next step as plain text of about five lines; `width`: columns [1]."""
    sure = in_short(diagnosis) if diagnosis.odds or diagnosis.score is not None else None
    rows = [
        ("since", since(diagnosis)),
        ("how much", _how_much_by_what(diagnosis)),
        ("how bad", how_bad(diagnosis)),
        ("passes", passes(diagnosis) if diagnosis.verdict == "no leak" else None),
        ("cause", cause(diagnosis)),
        ("how sure", sure if diagnosis.verdict != "cannot tell" else None),
        ("reason", diagnosis.reason if diagnosis.verdict == "cannot tell" else None),
        ("data", quality_summary(diagnosis).rstrip(",") if diagnosis.quality else None),
        ("units", raw_counts(diagnosis)),
        ("not used", not_used(diagnosis)),
        ("next", next_steps(diagnosis)[0]),
    ]
    lines = [_row(label, text, width) for label, text in rows if text]
    return "\n".join((f"{_printable(diagnosis.file)}: {diagnosis.summary}", *lines))


def diagnosis_text(diagnosis: Diagnosis, *, width: int = 80) -> str:
    """Return the verdict and its figures as plain text, with every method and finding.

    `width`: columns [1]. Without colours, and without control characters that a file name or header could bring.
    """
    lines = [f"{_printable(diagnosis.file)}: {diagnosis.summary}"]
    rows = [
        ("state", state(diagnosis)),
        ("since", since(diagnosis)),
        ("how much", _how_much_by_what(diagnosis)),
        ("how bad", how_bad(diagnosis)),
        ("which is", other_sizes(diagnosis)),
        ("passes", passes(diagnosis)),
        ("cause", cause(diagnosis)),
        ("how sure", how_sure(diagnosis)),
        ("reason", diagnosis.reason or None),
        ("not used", not_used(diagnosis)),
    ]
    lines += [_row(label, text, width) for label, text in rows if text]
    for method in diagnosis.methods:
        odds = "" if method.odds is None else f"{method.odds}; "
        figures = f"{method.summary} ({odds}score {number(method.score)}, threshold {number(method.threshold)})"
        if method.score is None and method.reason:
            figures = f"{method.summary} ({method.reason})"
        lines.append(_row("method", f"{method.detector}: {figures}", width))
    lines += [_row(finding.severity, finding.text, width) for finding in diagnosis.quality]
    lines += [_row("next" if i == 0 else "", step, width) for i, step in enumerate(next_steps(diagnosis)[:2])]
    return "\n".join(lines)


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def _row(label: str, text: str, width: int) -> str:
    return fill(
        _printable(text), width, initial_indent=f"  {label:<10}", subsequent_indent=" " * 12, break_on_hyphens=False
    )


#: Width of a line of a table in a terminal.
WIDTH = 80


def flow(diagnosis: Diagnosis) -> str:
    """Return the leak with its interval, or its bound, in a few words."""
    if diagnosis.verdict == "leak" and diagnosis.leak_lpm is not None:
        low, high = diagnosis.leak_interval_lpm or (diagnosis.leak_lpm,) * 2
        return f"{number(diagnosis.leak_lpm, 2)} L/min ({number(low, 2)} to {number(high, 2)})"
    if diagnosis.verdict != "leak" and diagnosis.bound_lpm is not None:
        return f"none above {number(diagnosis.bound_lpm, 2)} L/min"
    return "L/min not stated"


def what_to_do(diagnosis: Diagnosis) -> str:
    """Return the first thing to do, where nothing can be told its reason."""
    return diagnosis.reason if diagnosis.verdict == "cannot tell" else next_steps(diagnosis)[0]


def table_line(diagnosis: Diagnosis, start_s: float | None = None) -> str:
    """Return a diagnosis as a line of a table: file, date, verdict, L/min, and where it is no `no leak` what to do.

    `start_s`: when the recording began [s since 1970].
    """
    file = PurePath(diagnosis.file).name
    file = file if len(file) <= 28 else f"{file[:13]}..{file[-13:]}"
    date = "" if start_s is None else datetime.fromtimestamp(start_s, UTC).date().isoformat()
    line = f"{file:<28}  {date:<10}  {diagnosis.verdict:<11}  {flow(diagnosis)}"
    if diagnosis.verdict == "no leak":
        return line
    return f"{line}\n    {shorten(what_to_do(diagnosis), WIDTH - 4)}"
