"""Sentences on a diagnosis for page and terminal: `messages.toml` holds the words, this file chooses and fills in."""

from __future__ import annotations

import tomllib
from datetime import UTC, datetime
from functools import cache
from importlib import resources
from math import floor, isfinite, isnan, log10
from pathlib import PurePath
from typing import Any

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import LEAKS, RMS_CHANGE
from sealscope.diagnosis.verdict.machine import AssumedMachine
from sealscope.diagnosis.verdict.states import MachineState
from sealscope.errors import printable
from sealscope.paragraphs import WIDTH, paragraph, paragraphs
from sealscope.recordings.formats.columns import counted, listed
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.proposal import suggested_map
from sealscope.units import from_si

ABSENT = "–"


@cache
def _texts() -> dict[str, dict[str, str]]:
    return tomllib.loads((resources.files("sealscope.reporting") / "messages.toml").read_text(encoding="utf-8"))


def say(name: str, /, **values: Any) -> str:
    """Return the text `section.key` with its values."""
    section, _, key = name.partition(".")
    return _texts()[section][key].format(**values)


def number(value: float | None, digits: int = 3) -> str:
    """Return `value` with `digits` significant digits, a dash for None or NaN; no exponent where that is short."""
    if value is None or isnan(value):
        return ABSENT
    if not isfinite(value):
        return "∞" if value > 0 else "−∞"
    text = f"{value:.{digits}g}"
    if 1e-6 <= abs(value) < 1e9:
        places = max(0, digits - 1 - floor(log10(abs(value))))
        text = f"{value:.{places}f}"
        text = text.rstrip("0").rstrip(".") if "." in text else text
    return text.replace("-", "−")


def clock(seconds: float | None) -> str:
    """Return a time in seconds (one decimal, more below 10 s), from an hour on as h:mm:ss as well."""
    if seconds is None or not isfinite(seconds):
        return ABSENT
    text = f"{seconds:.1f} s" if abs(seconds) >= 10 else f"{seconds:.3g} s"
    if abs(seconds) >= 3600:
        whole = int(abs(seconds))
        text += f" ({'-' * (seconds < 0)}{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d})"
    return text.replace("-", "−")


def headline(diagnosis: Diagnosis) -> str:
    """Return the verdict as the heading of page and card: the summary of the terminal and of JSON, as a sentence."""
    key = diagnosis.summary
    if diagnosis.verdict == "leak" and diagnosis.cause == "piston or pump leak":
        key = diagnosis.cause
    elif key == "no leak" and not diagnosis.known_healthy:  # one from the start would be hidden
        key = "none began"
    return _texts()["headline"].get(key, key[0].upper() + key[1:])


def cause(diagnosis: Diagnosis) -> str | None:
    """Return the cause of the change, None if there is none or it is not certain."""
    if diagnosis.cause in LEAKS and diagnosis.verdict != "leak":
        return None
    return diagnosis.cause


def shows_reason(diagnosis: Diagnosis) -> bool:
    """Test whether the verdict needs its reason: nothing can be told, or something other than a leak changed."""
    return diagnosis.verdict == "cannot tell" or (diagnosis.verdict != "leak" and cause(diagnosis) is not None)


def state(diagnosis: Diagnosis) -> str:
    """Return the state of the machine as NAMUR NE 107 names it, with its letter and its severity."""
    return state_text(diagnosis.state)


def state_text(machine_state: MachineState) -> str:
    """Return a state of NE 107 in words."""
    severity = f", severity {machine_state.severity} of 1000" if machine_state.severity else ""
    return f"{machine_state.name} ({machine_state.symbol} of NE 107{severity})"


def since(diagnosis: Diagnosis) -> str | None:
    """Return since when oil leaks; None where there is no leak to date."""
    if diagnosis.verdict != "leak":
        return None
    if diagnosis.onset_s is None:
        return say("since.unsettled" if diagnosis.rises_within else "since.whole")
    if diagnosis.onset_interval_s is None:
        return clock(diagnosis.onset_s)
    low, high = map(clock, diagnosis.onset_interval_s)
    return say("since.interval", onset=clock(diagnosis.onset_s), low=low, high=high)


def how_much(diagnosis: Diagnosis) -> str | None:
    """Format the leak flow [L/min], or its upper bound if no leak was found; None if nothing is known."""
    interval, leak = diagnosis.leak_interval_lpm, diagnosis.leak_lpm
    if diagnosis.verdict != "leak":
        if diagnosis.bound_lpm is not None:
            return say("how_much.bound", bound=number(diagnosis.bound_lpm, 2))
        if diagnosis.verdict == "no leak" and leak is not None and interval is not None and interval[1] > 0:
            return say("how_much.at_most", high=number(interval[1], 2))
        return None
    if leak is None:
        share = _pump_share(diagnosis)
        return _why_no_flow(diagnosis) if share is None else f"{share}; {_why_no_flow(diagnosis)}"
    if interval is None:
        return f"{number(leak)} L/min"
    return say("how_much.interval", leak=number(leak), low=number(interval[0]), high=number(interval[1]))


def _pump_share(diagnosis: Diagnosis) -> str | None:
    severity = diagnosis.severity
    known = severity is not None and severity.pump_share is not None
    return f"{_percent(severity.pump_share[0])} of the pump's flow in this duty" if known else None  # type: ignore[union-attr, index]


def _why_no_flow(diagnosis: Diagnosis) -> str:
    """Give the reason for a leak without L/min, and the remedy."""
    if "leak_lpm" not in diagnosis.refuses:
        small = diagnosis.total_leakage is not None and diagnosis.total_leakage.lpm is not None
        return say(f"how_much.{'too_small' if small else 'channels'}")
    if raw_counts(diagnosis):
        return say("how_much.counts")
    if diagnosis.machine is None or diagnosis.machine.stated:
        return say("how_much.reason")
    return say(f"how_much.{'machine' if diagnosis.measured_ratio is None else 'machine_or_area'}")


def rests_on(diagnosis: Diagnosis) -> str | None:
    """Describe the machine behind every L/min of the diagnosis, None if it is not known."""
    return None if diagnosis.machine is None else machine_text(diagnosis.machine)


def machine_text(machine: AssumedMachine) -> str:
    """Format the area and displacement behind a flow, and their origin."""
    if machine.flow_meter:
        key = "meter"
    elif machine.stated_by == "recording":
        key = "recording"
    elif machine.stated:
        key = "call" if machine.stated_by == "call" else "stated"
    else:
        key = "area" if machine.area_stated else "displacement" if machine.displacement_stated else "assumed"
    sides = [f"{number(1e6 * area, 4)} mm²" for area in machine.areas or (machine.area,)]
    area = sides[0] if sides[0] == sides[-1] else f"{sides[0]} at A and {sides[1]} at B"
    displacement = f"{number(1e6 * machine.displacement)} cm³/rev"
    return say(f"machine.{key}", area=area, displacement=displacement, rig=machine.rig)


def how_bad(diagnosis: Diagnosis) -> str | None:
    """Return the leak against the repair limit, else beside the pump's flow; None where neither is known."""
    severity, limit = diagnosis.severity, diagnosis.limit
    if severity is None:
        return None
    if severity.level is not None and severity.of_limit is not None:
        low, high = severity.of_limit[1:]
        share = f"{_span(low, high)} times" if high >= 10.0 else f"{_span(100.0 * low, 100.0 * high)} % of"
        return say(f"how_bad.{severity.level}", share=share, limit=f"{limit}{'' if limit.stated else ', the default'}")
    if limit.stated:
        return say("how_bad.no_area", limit=limit)
    return None if diagnosis.leak_lpm is None else _pump_share(diagnosis)


def _span(low: float, high: float) -> str:
    """Return a range with two digits; a single number where its ends are the same."""
    ends = number(low, 2), number(high, 2)
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


def other_sizes(diagnosis: Diagnosis) -> str | None:
    """Format the leak in mL/min, as a share of the pump's flow and as a creep; None if none is known."""
    severity = diagnosis.severity
    if severity is None:
        return None
    creep = severity.creep_mm_per_min
    parts = [
        None if severity.mL_per_min is None else f"{number(severity.mL_per_min[0], 2)} mL/min",
        None if diagnosis.leak_lpm is None else _pump_share(diagnosis),
        None if creep is None else f"as much as a piston that creeps by {number(creep[0], 2)} mm/min",
    ]
    return "; ".join(part for part in parts if part) or None


def total_leakage(diagnosis: Diagnosis, *, basis: bool = True) -> str | None:
    """Format the leakage of pump and piston together and the smallest detectable step, None if not known.

    `basis`: with what L/min rests on.
    """
    leakage = diagnosis.total_leakage
    if leakage is None:
        return None
    pressure = f"{number(from_si(leakage.pressure, diagnosis.pressure_unit, 'Pa'), 2)} {diagnosis.pressure_unit}"
    findable = f"{number(leakage.findable_lpm, 2)} L/min"
    if leakage.lpm is None or leakage.interval_lpm is None:
        known = leakage.pump_share is not None
        key = "share" if known else "not_measured"
        text = say(f"leakage.{key}", share=_percent(leakage.pump_share), pressure=pressure)
        if leakage.findable_share is None:
            return text
        size = _percent(leakage.findable_share) + ("" if known else " of the pump's flow")
        return text + say("leakage.findable", size=size if leakage.findable_lpm is None else f"{size}, {findable}")
    low, high = leakage.interval_lpm
    key = "none" if not high > 0.0 else "at_most" if not low > 0.0 else "interval"
    figures = {"lpm": number(leakage.lpm, 2), "low": number(low, 2), "high": number(high, 2)}
    text = say(f"leakage.{key}", pressure=pressure, **figures)
    if basis and diagnosis.verdict != "leak" and (machine := rests_on(diagnosis)) is not None:
        text += f" ({machine})"
    text += "" if leakage.healthy_lpm is None else say("leakage.healthy", lpm=number(leakage.healthy_lpm, 2))
    return text + ("" if leakage.findable_lpm is None else say("leakage.findable", size=findable))


def leakage_in_short(diagnosis: Diagnosis) -> str | None:
    """Format the leakage of pump and piston in a few words, None if it is not known or there is a leak."""
    leakage = diagnosis.total_leakage
    if leakage is None or diagnosis.verdict == "leak":
        return None
    if leakage.lpm is None or leakage.interval_lpm is None:
        return None if leakage.pump_share is None else f"in all {_percent(leakage.pump_share)} of the pump's flow"
    low, high = leakage.interval_lpm
    return f"in all {number(leakage.lpm, 2)} L/min" if low > 0.0 else f"in all at most {number(high, 2)} L/min"


def states_flow(diagnosis: Diagnosis) -> bool:
    """Test whether the diagnosis states any L/min."""
    return diagnosis.leak_lpm is not None or (
        diagnosis.total_leakage is not None and diagnosis.total_leakage.lpm is not None
    )


def _percent(share: float | None) -> str:
    return ABSENT if share is None else f"{number(100.0 * share, 2)} %"


def how_sure(diagnosis: Diagnosis) -> str:
    """Format the share of healthy recordings like this one, the score against its threshold, and its meaning."""
    if diagnosis.score is None or diagnosis.threshold is None:
        return say("how_sure.no_score")
    odds, other = _odds(diagnosis), cause(diagnosis)
    odds = "" if odds is None else f"{odds}; "
    relation = "over" if diagnosis.score > diagnosis.threshold else "not over"
    if diagnosis.verdict != "leak" and other is not None and diagnosis.alarmed:
        odds, relation = f"that something changed: {odds}", f"for {other}, over"
    judge = diagnosis.methods[0].detector if diagnosis.methods else ""
    return say(
        "how_sure.score", odds=odds, score=number(diagnosis.score), relation=relation,
        threshold=number(diagnosis.threshold), judge=f" of {judge}" if judge else "",
        false_alarms=false_alarms(diagnosis),
    )  # fmt: skip


def in_short(diagnosis: Diagnosis) -> str:
    """Format the share of healthy recordings like this one, or the false alarms allowed if it is not stated."""
    return _odds(diagnosis) or false_alarms(diagnosis)


def _odds(diagnosis: Diagnosis) -> str | None:
    """Format the share of healthy recordings like this one, or with as much change if nothing changed."""
    odds = diagnosis.odds
    if odds is None or diagnosis.verdict != "no leak" or diagnosis.alarmed:
        return odds
    return odds.replace("looks like this", "shows as much change").replace("look like this", "show as much change")


def false_alarms(diagnosis: Diagnosis) -> str:
    """Format the false-alarm probability of the threshold."""
    p = diagnosis.false_alarm_probability
    if not 0 < p < 1:
        return say("how_sure.probability", probability=number(p))
    every = f"{round(1 / p)}" if 1 / p >= 10 else number(1 / p)
    return say("how_sure.share", share=f"{number(100 * p)} % (1 in {every})")


def next_steps(diagnosis: Diagnosis) -> tuple[str, ...]:
    """List the next checks, most useful first."""
    level = None if diagnosis.severity is None else diagnosis.severity.level
    judge = diagnosis.methods[0].detector if diagnosis.methods else ""
    confirmed = say(f"once_confirmed.{level or 'plan'}", limit=diagnosis.limit)
    named = diagnosis.named_cause is not None
    if named and diagnosis.verdict == "leak":
        steps = [diagnosis.next_check, say("next.repeat"), confirmed]
    elif named:
        steps = [diagnosis.next_check, say("next.resolved")]
    elif diagnosis.verdict == "leak":
        steps = [diagnosis.next_check, say("next.creep"), confirmed]
    elif diagnosis.verdict == "no leak" and judge == RMS_CHANGE:
        steps = [say("next.ringing"), say("next.longer")]
    elif diagnosis.verdict == "no leak":
        steps = [diagnosis.next_check, say("next.longer")]
    else:
        steps = [say("next.cause"), say("next.record")]
    # a baseline that was left out, such as the recording itself, is no fault of its data
    findings = (finding for finding in diagnosis.quality if finding.code != "baseline_left_out")
    trouble = [finding for finding in findings if finding.severity != "note"]
    if trouble:
        names = [f"{entry.code.replace('_', ' ')}{f' ({entry.channel})' if entry.channel else ''}" for entry in trouble]
        key = "rule_out" if named or diagnosis.verdict == "leak" else "care"
        key, place = ("findings", 1) if not named and diagnosis.verdict == "cannot tell" else (key, 0)
        steps.insert(place, say(f"next.{key}", faults=", ".join(dict.fromkeys(names))))
    return tuple(steps)


def quality_summary(diagnosis: Diagnosis) -> str:
    """Count the findings, and name the worst severity among them."""
    severities = {finding.severity for finding in diagnosis.quality}
    worst = next((f" ({severity})" for severity in ("fatal", "warning") if severity in severities), "")
    return f"{counted(len(diagnosis.quality), 'finding')}{worst}"


def raw_counts(diagnosis: Diagnosis) -> str | None:
    """Name the pressures in raw counts and the remedy; None if there are none."""
    names = [finding.channel for finding in diagnosis.quality if finding.code == "raw_counts" and finding.channel]
    return f"{' and '.join(names)} in raw counts: state the unit, or a leak's size stays relative" if names else None


def not_used(diagnosis: Diagnosis) -> str | None:
    """Name the recorded pressures, positions, speeds and flows without a channel; None if there are none."""
    if not diagnosis.unused:
        return None
    lines = " ".join(f"--map '{suggested_map(Label.parse(name))}'" for name in diagnosis.unused[:4])
    return f"{listed(diagnosis.unused)}: recorded, and used for no channel; if they are: {lines}"


def short_text(diagnosis: Diagnosis, *, width: int = WIDTH) -> str:
    """Return the verdict, its figures and the next step as plain text of about five lines; `width`: columns [1]."""
    sure = in_short(diagnosis) if diagnosis.odds or diagnosis.score is not None else None
    rows = [
        ("state", state(diagnosis)),
        *_figures(diagnosis),
        ("leakage", total_leakage(diagnosis) if diagnosis.verdict == "no leak" else None),
        ("cause", cause(diagnosis)),
        ("reason", diagnosis.reason) if shows_reason(diagnosis) else ("how sure", sure),
        ("data", quality_summary(diagnosis) if diagnosis.quality else None),
        ("units", raw_counts(diagnosis)),
        ("not used", not_used(diagnosis)),
        ("next", next_steps(diagnosis)[0]),
    ]
    return _lines(diagnosis, rows, width)


def diagnosis_text(diagnosis: Diagnosis, *, width: int = WIDTH) -> str:
    """Return the verdict and its figures as plain text, with every method and finding.

    `width`: columns [1]. Without colours, and without control characters that a file name or header could bring.
    """
    rows: list[tuple[str, str | None]] = [
        ("state", state(diagnosis)),
        *_figures(diagnosis),
        ("which is", other_sizes(diagnosis)),
        ("leakage", total_leakage(diagnosis)),
        ("cause", cause(diagnosis)),
        ("how sure", how_sure(diagnosis)),
        ("reason", diagnosis.reason),
        ("not used", not_used(diagnosis)),
    ]
    for method in diagnosis.methods:
        odds = "" if method.odds is None else f"{method.odds}; "
        figures = f"{odds}score {number(method.score)}, threshold {number(method.threshold)}"
        figures = method.reason if method.score is None and method.reason else figures
        rows.append(("method", f"{method.detector}: {method.summary} ({figures})"))
    rows += [(finding.severity, finding.text) for finding in diagnosis.quality]
    rows += [("" if k else "next", step) for k, step in enumerate(next_steps(diagnosis)[:2])]
    return _lines(diagnosis, rows, width)


def _figures(diagnosis: Diagnosis) -> list[tuple[str, str | None]]:
    size, basis = how_much(diagnosis), rests_on(diagnosis)
    if size is not None and basis is not None and diagnosis.leak_lpm is not None:
        size = f"{size}; {basis}"
    return [("since", since(diagnosis)), ("how much", size), ("how bad", how_bad(diagnosis))]


def _lines(diagnosis: Diagnosis, rows: list[tuple[str, str | None]], width: int) -> str:
    """Return a line with the verdict, and a paragraph for each row that has a text."""
    first = say("terminal.diagnosis", file=printable(diagnosis.file), summary=diagnosis.summary)
    return "\n".join((first, *paragraphs(rows, 12, width)))


def flow(diagnosis: Diagnosis) -> str:
    """Return the leak with its interval, or its bound, in a few words."""
    if diagnosis.verdict == "leak" and diagnosis.leak_lpm is not None:
        low, high = diagnosis.leak_interval_lpm or (diagnosis.leak_lpm,) * 2
        return f"{number(diagnosis.leak_lpm, 2)} L/min ({number(low, 2)} to {number(high, 2)})"
    if diagnosis.verdict != "leak" and diagnosis.bound_lpm is not None:
        return f"none above {number(diagnosis.bound_lpm, 2)} L/min"
    return "L/min not stated"


def what_to_do(diagnosis: Diagnosis) -> str:
    """Return the first thing to do; the reason where there is no verdict."""
    return diagnosis.reason if diagnosis.verdict == "cannot tell" else next_steps(diagnosis)[0]


#: Columns of a file's name in a table; a longer name has a line of its own.
_FILE = 22


def table_line(diagnosis: Diagnosis, start_s: float | None = None) -> str:
    """Format a diagnosis as one line of a table: file, date, verdict, L/min, and the remedy of a change.

    `start_s`: when the recording began [s since 1970].
    """
    file = PurePath(diagnosis.file).name
    date = "" if start_s is None else datetime.fromtimestamp(start_s, UTC).date().isoformat()
    file = file if len(file) <= _FILE else f"{file}\n{'':{_FILE}}"
    line = f"{file:<{_FILE}} {date:<10} {diagnosis.verdict:<11} {flow(diagnosis)}"
    named = cause(diagnosis)
    if diagnosis.verdict == "no leak" and named is None:
        return line
    before = "" if named is None or diagnosis.verdict == "leak" else f"{named}: "
    return f"{line}\n{paragraph(before + what_to_do(diagnosis), '    ')}"
