"""The result of a hold test as text, and the page that a workshop files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sealscope.diagnosis.hold.judgement import COOLING, format_estimate
from sealscope.diagnosis.hold.result import HoldCurve, HoldResult
from sealscope.reporting import template
from sealscope.reporting.picture import Picture, ticks

#: Sign of NE 107 by the result, whose colour and shape the page shows.
STATES = {"pass": "N", "fail": "F", "undecided": "S", None: "C"}
#: Size of the picture, and its margins left of the frame, above, right and below.
SIZE, _MARGINS = (900.0, 300.0), (72.0, 14.0, 14.0, 30.0)
#: Spans in minutes for which limits of creep are stated.
SPANS = (3.0, 5.0, 10.0)


def hold_text(result: HoldResult) -> str:
    """Format a result for the terminal: the result first, then the figures, the causes and what to do."""
    span = "" if result.start_s is None or result.end_s is None else f", {result.start_s:.4g} to {result.end_s:.4g} s"
    lines = [f"{result.file}{span}: {name_result(result)}" + ("" if result.limit is None else f" ({result.limit})")]
    lines += [f"  {name:<12} {value}" for name, value in list_figures(result) if value]
    return "\n".join(lines)


def name_result(result: HoldResult) -> str:
    """Name a result: pass, fail or undecided or, without a limit, whether a leak is shown."""
    return result.result or ("leak" if set(result.causes) - {COOLING} else "no leak shown")


def list_figures(result: HoldResult) -> list[tuple[str, str]]:
    """List the figures of a result as pairs of name and text; a text is "" where nothing is known."""
    creep, creep_ends = result.creep_mm_per_min, result.creep_interval_mm_per_min
    leak, leak_ends = result.leak_lpm, result.leak_interval_lpm
    converted, converted_ends = result.leak_at_lpm, result.leak_at_interval_lpm
    spans = list[str]()
    if creep is not None and creep_ends is not None:
        for minutes in SPANS:
            travel = format_estimate(*(number * minutes for number in (creep, *creep_ends))).partition(" ")[0]
            spans.append(f"{travel} mm in {minutes:g} min")
    possible = [" or ".join(result.causes)] if len(result.causes) > 1 else []
    is_known = result.oil.startswith("logged") or result.oil.endswith("steady (stated)")
    if not is_known and result.curve is not None:
        possible.append("cooling or warming of the oil, which the interval of the leak includes")
    areas = " and ".join(f"{area:.5g}" for area in result.areas_mm2)
    quality = "; ".join(finding.text for finding in result.quality if finding.severity != "note")
    return [
        ("creep", "" if creep is None or creep_ends is None else f"{format_estimate(creep, *creep_ends)} mm/min"),
        ("", ", ".join(spans)),
        ("leak", _format_flow(leak, leak_ends)),
        ("", "" if converted is None else f"{_format_flow(converted, converted_ends)} at {result.at_bar:.4g} bar"),
        ("pressure", "" if result.pressure_bar is None else f"{result.pressure_bar:.4g} bar"),
        ("area", f"{areas} mm^2" if areas else ""),
        ("oil", result.oil),
        ("reason", result.reason),
        ("cause", result.causes[0] if len(result.causes) == 1 else ""),
        ("not excluded", "; ".join(possible)),
        ("next", result.second_test),
        ("data", quality),
    ]


def _format_flow(lpm: float | None, ends: tuple[float, float] | None) -> str:
    """Format a flow [L/min] with its interval in mL/min; "" if it is not known."""
    return "" if lpm is None or ends is None else f"{format_estimate(*(1e3 * v for v in (lpm, *ends)))} mL/min"


def write_hold_page(results: Sequence[HoldResult], path: str | os.PathLike[str]) -> Path:
    """Write the page of hold tests as .html, .htm or .pdf, and return its path; raise InputError if that fails."""
    return template.write(template.parse_page_path(path, card=False), render_hold_page(results))


def render_hold_page(results: Sequence[HoldResult]) -> str:
    """Render the page of hold tests as HTML."""
    holds = [
        (
            result,
            STATES[result.result],
            name_result(result),
            list_figures(result),
            result.curve and draw_curve(result.curve),
        )
        for result in results
    ]
    return template.render("hold.html.j2", holds=holds, title="Hold test")


def draw_curve(curve: HoldCurve) -> Picture:
    """Draw readings of a hold over minutes, with fit and interval."""
    minutes = curve.t / 60.0
    ends = np.concatenate([curve.values, curve.low, curve.high])
    low, high = float(ends.min()), float(ends.max())
    margin = 0.06 * (high - low) or 0.01
    (width, height), (left, top, right, bottom) = SIZE, _MARGINS
    x_ends = float(minutes[0]), float(max(minutes[-1], minutes[0] + 1e-6))
    picture = Picture(
        width - left - right, height - top - bottom, x_ends, (low - margin, high + margin), margins=_MARGINS
    )
    picture.frame(count=5)
    for minute in ticks(*x_ends, 8):
        picture.below(minute, f"{minute:g} min")
    picture.area("healthy", minutes, curve.low, curve.high)
    for minute, value in zip(minutes.tolist(), curve.values.tolist(), strict=True):
        picture.symbol("point other", minute, float(picture.y(value)))
    picture.line("course", minutes, curve.fit)
    return picture
