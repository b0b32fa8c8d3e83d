"""A campaign's result for people: the terminal's table, and one HTML page with the curves that works offline."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.campaigns.execution.store import RUN_BY_RUN
from sealscope.campaigns.judging.alarms import AlarmShares
from sealscope.campaigns.judging.curves import DetectorPod, SizeRoc
from sealscope.campaigns.judging.judge import Judgement
from sealscope.campaigns.judging.tables import PriorKnowledge
from sealscope.campaigns.plans.detectors import DIAGNOSE, plan_detector
from sealscope.campaigns.plans.model import RecordedPlan, SimulatedPlan
from sealscope.campaigns.results import CampaignResult
from sealscope.diagnosis.detectors.registry import detectors
from sealscope.evaluation.roc import Area
from sealscope.paragraphs import paragraph
from sealscope.recordings.channels import Array
from sealscope.reporting import template
from sealscope.reporting.campaign.page_tables import cause_tables, page_tables, percent
from sealscope.reporting.messages import say
from sealscope.reporting.picture import Picture, SvgText, log_ticks, ticks

PAGE = "report.html"
#: More sizes than this are shown together: a column for each could not be read.
_MOST_SIZES = 8
#: Size of a picture; points of a fitted curve, of any curve at most, and of fractions at most.
WIDTH, HEIGHT = 460.0, 300.0
_CURVE_POINTS, _MOST_DRAWN, _MOST_POINTS = 120, 400, 60
#: Detectors that the result names in words, the best of them.
_MOST_SAID = 3


def _area(area: Area) -> str:
    return f"{area.value:.3f} ({area.low:.3f}–{area.high:.3f})"


def sizes_of(judgement: Judgement) -> list[float]:
    """Return the leak sizes with a column each; nan stands for all sizes together if they are many or none."""
    sizes = sorted({row.leak_lpm for row in judgement.table if row.leak_lpm > 0})
    return sizes if 0 < len(sizes) <= _MOST_SIZES else [math.nan]


def main_table(result: CampaignResult) -> tuple[list[str], list[list[str]]]:
    """Return heads and rows: detectors in the plan's order, then the one that always and the one that never fires."""
    judgement = result.judgement
    sizes = sizes_of(judgement)
    rows = judgement.overall if math.isnan(sizes[0]) else judgement.table
    by_detector: dict[str, dict[str, AlarmShares]] = defaultdict(dict)
    for row in rows:
        by_detector[row.detector][f"{row.leak_lpm}"] = row
    pods = {pod.detector: pod for pod in judgement.pods}
    areas = {roc.detector: _area(roc.area) for roc in judgement.rocs if math.isnan(roc.leak_lpm)}
    table = []
    for name, results in by_detector.items():
        cells = [percent(results[f"{size}"].alarms) if f"{size}" in results else "–" for size in sizes]
        knowledge = [_name_knowledge(result.known.get(name))] if result.known else []
        alarms = percent(next(iter(results.values())).false_alarm)
        table.append([name, *knowledge, alarms, *cells, areas.get(name, "–"), *_smallest(pods.get(name))])
    of_sizes = ["any leak" if math.isnan(size) else f"{size:g} {result.plan.unit}" for size in sizes]
    knowledge = ["given"] if result.known else []
    return ["detector", *knowledge, "false alarms", *of_sizes, "AUC, any leak", "a90", "a90/95"], table


def _name_knowledge(known: PriorKnowledge | None) -> str:
    """Name the prior knowledge of a detector in a word or two."""
    if known is None:
        return "–"
    return ", ".join(word for word, is_known in (("true onset", known.onset), ("rig", known.rig)) if is_known) or "–"


def _smallest(pod: DetectorPod | None) -> tuple[str, str]:
    """Format a90 and a90/95, or only that they lie beyond the tested sizes."""
    if pod is None or pod.curve is None:
        return "–", "–"
    largest = max(tested.size for tested in pod.sizes)
    a90, a90_95 = (
        "–" if math.isnan(size) else f"{size:.3g}" if size <= largest else f"> {largest:.3g}"
        for size in (pod.curve.a90, pod.curve.a90_95)
    )
    return a90, a90_95


def result_text(result: CampaignResult) -> str:
    """Summarize in a few sentences the leaks found by the best detectors and their rates of false alarms."""
    judgement, unit = result.judgement, result.plan.unit
    ranked: list[tuple[float, float, str]] = []
    for pod in judgement.pods:
        rows = [row for row in judgement.table if row.detector == pod.detector and row.leak_lpm > 0]
        if not rows:
            continue
        largest = max(rows, key=lambda row: row.leak_lpm)
        finding = f"finds {percent(largest.alarms)} of leaks of {largest.leak_lpm:g} {unit}"
        a90 = math.inf
        if pod.curve is not None and pod.curve.a90 <= largest.leak_lpm:
            a90 = pod.curve.a90
            finding = f"finds 9 in 10 leaks of {a90:.2g} {unit}"
        text = f"{pod.detector} {finding} at {percent(largest.false_alarm)} false alarms."
        ranked.append((a90, -largest.alarms.value, text))
    ranked.sort(key=lambda item: item[:2])
    shown = [text for _, _, text in ranked[:_MOST_SAID]]
    more = len(ranked) - len(shown)
    rest = f" {more} more detectors are in the table." if more > 1 else " Another detector is in the table."
    records = f"{judgement.judged} records were judged."
    return " ".join([*shown, records]) + (rest if more else "")


def campaign_text(result: CampaignResult) -> str:
    """Return the main table as plain text."""
    heads, rows = main_table(result)
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = []
    for first, *cells in (heads, *rows):
        right = (text.rjust(width) for text, width in zip(cells, widths[1:], strict=True))
        lines.append("  ".join([first.ljust(widths[0]), *right]).rstrip())
    return "\n".join([result.plan.title, *lines, *(paragraph(note) for note in _notes(result))])


def _notes(result: CampaignResult) -> list[str]:
    """Write the notes under the table, in whole sentences."""
    judgement, plan = result.judgement, result.plan
    simulated = isinstance(plan, SimulatedPlan)
    notes = [_say("intervals", share=100 * plan.confidence, unit=plan.unit)]
    share = 100 * plan.false_alarm
    if judgement.thresholds:
        key = "thresholds_of_records" if simulated else "thresholds_of_recordings"
        notes.append(_say(key, share=share, leak_free=judgement.leak_free, judged=judgement.judged))
    stating = [name for name in plan.detectors if plan_detector(name).scorer is None]
    notes += [_say("own_verdict", share=share, detectors=", ".join(stating))] if stating else []
    with_onset = [name for name, known in result.known.items() if known.onset]
    notes += [_say("true_onset", detectors=", ".join(with_onset))] if with_onset else []
    notes += _known_notes(result)
    notes += [_say("batched", mode=result.mode)] if _is_batched(result) else []
    notes += [plan.note] if plan.note else []
    notes += [_say("missing", count=result.missing)] if result.missing else []
    notes += [_say("failed", count=len(judgement.failed))] if judgement.failed else []
    return notes


def _say(name: str, **values: Any) -> str:
    return say(f"campaign.{name}", **values)


def _known_notes(result: CampaignResult) -> list[str]:
    """Write the notes on the channels and the assumed rig of the detectors."""
    by_channels: dict[str, list[str]] = defaultdict(list)
    by_rig: dict[str, list[str]] = defaultdict(list)
    for name, known in result.known.items():
        by_channels[", ".join(known.channels)].append(name)
        by_rig[known.rig].append(name)
    key = "channels" if len(by_channels) == 1 else "channels_of"
    notes = [_say(key, channels=channels, detectors=", ".join(names)) for channels, names in by_channels.items()]
    return notes + [_say("rig", rig=rig, detectors=", ".join(names)) for rig, names in by_rig.items() if rig]


def _is_batched(result: CampaignResult) -> bool:
    return result.mode not in ("", RUN_BY_RUN)


def write_campaign_page(result: CampaignResult, path: Path, files: Sequence[str] = ()) -> Path:
    """Write the page of a result; `files`: names of the tables beside it.

    Raises InputError where it cannot be written.
    """
    return template.write(path, render_campaign_page(result, files))


def render_campaign_page(result: CampaignResult, files: Sequence[str] = ()) -> str:
    """Return the page as text, with nothing outside it but links to the tables beside it."""
    judgement, plan = result.judgement, result.plan
    heads, rows = main_table(result)
    failed = [
        (row.id, ", ".join(f"{name} {level}" for name, level in row.levels.items()), row.error)
        for row in judgement.failed[:200]
    ]
    return template.render(
        "campaign.html.j2",
        title=plan.title,
        name=plan.name,
        unit=plan.unit,
        heads=heads,
        rows=rows,
        measured=[pod.detector for pod in judgement.pods],
        result=result_text(result),
        notes=_notes(result),
        facts=_facts(result),
        sections=[_section(pod, judgement, plan.unit) for pod in judgement.pods],
        tables=page_tables(judgement, plan.unit, getattr(plan, "part", "")),
        causes=cause_tables(judgement),
        failed=failed,
        failed_count=len(judgement.failed),
        files=files,
    )


def _facts(result: CampaignResult) -> list[tuple[str, str]]:
    """List the facts of the campaign for the page's head."""
    plan, judgement = result.plan, result.judgement
    if isinstance(plan, RecordedPlan):
        return [(group.label or group.files, f"{group.use}, size {group.size:g} {plan.unit}") for group in plan.sets]
    machines = f"machines drawn from profile {plan.profile}" if plan.profile else "no drift, every machine alike"
    facts = [
        ("rig", f"{plan.rig.name}; {machines}"),
        ("records", f"{plan.duration_s:g} s at {plan.rig.daq.sample_rate:g} Hz, leaks open at {plan.onset_s:g} s"),
        *((name, ", ".join(str(level) for level in levels)) for name, levels in plan.factors.items()),
        ("base seed", str(plan.seed)),
        *([("simulated", result.mode)] if _is_batched(result) else []),
        *((f"seen by @ {name}" if name else "seen", ", ".join(channels)) for name, channels in plan.views.items()),
    ]
    if any(plan_detector(name).scorer is None for name in plan.detectors):
        facts.append(("assumed by detectors", _describe_assumed_machine(plan)))
    for size, (mean, spread) in judgement.realised.items():
        deviation = "" if math.isnan(spread) else f" ± {spread:.2g}"
        facts.append(
            (
                f"leak of {size:g} L/min",
                f"really {mean:.3g}{deviation} L/min (mean and standard deviation over the records)",
            )
        )
    return facts


def _describe_assumed_machine(plan: SimulatedPlan) -> str:
    """Describe the machine assumed by the detectors."""
    if plan.assumed == plan.rig:
        return f"the rig {plan.rig.name} as it stands, not the machine that was drawn"
    true = {row.name: row.value for row in plan.rig.table()}
    other = [f"{row.name} {row.value:g}" if isinstance(row.value, float) else f"{row.name} {row.value}"
             for row in plan.assumed.table() if true.get(row.name) != row.value]  # fmt: skip
    more = f" and {len(other) - 6} more" if len(other) > 6 else ""
    return f"{plan.assumed.name}, which differs from the rig: {', '.join(other[:6])}{more}"


def _section(pod: DetectorPod, judgement: Judgement, unit: str) -> dict[str, Any]:
    """Return one detector's curves, areas and the table of its cells."""
    name = pod.detector
    rocs = [roc for roc in judgement.rocs if roc.detector == name]
    shown = [roc for roc in rocs if not math.isnan(roc.leak_lpm)]
    shown = shown if 0 < len(shown) <= _MOST_SIZES else [roc for roc in rocs if math.isnan(roc.leak_lpm)]
    cells = [cell for cell in judgement.cells if cell.detector == name]
    factors = list(cells[0].levels) if cells else []
    sizes = sorted({cell.leak_lpm for cell in cells})
    by_levels: dict[tuple[str, ...], dict[float, str]] = defaultdict(dict)
    if factors and len(sizes) <= _MOST_SIZES + 1:
        for cell in cells:
            by_levels[tuple(map(str, cell.levels.values()))][cell.leak_lpm] = percent(cell.alarms)
    return {
        "name": name,
        "about": _describe_score(name),
        "plots": [plot for plot in (_pod_plot(pod, unit), _roc_plot(shown, unit)) if plot is not None],
        "areas": [(_size_text(roc, unit), _area(roc.area)) for roc in shown],
        "cell_columns": [*factors, *("no leak" if size == 0 else f"{size:g} {unit}" for size in sizes)],
        "cells": [
            (*levels, *(cells_by_size.get(size, "–") for size in sizes)) for levels, cells_by_size in by_levels.items()
        ],
    }


def _size_text(roc: SizeRoc, unit: str) -> str:
    return "any size" if math.isnan(roc.leak_lpm) else f"{roc.leak_lpm:g} {unit}"


def _describe_score(name: str) -> str:
    """Describe the score of a detector; "" if only its name is known."""
    detector = plan_detector(name)
    through = f", given the channels of {detector.view} alone" if detector.view else ""
    if detector.scorer is not None:
        return detector.scorer.description + through
    if detector.base == DIAGNOSE:
        return f"score over threshold of the detector that judged{through}"
    return f"the score of the detector {detector.base!r}{through}" if detector.base in detectors() else ""


def _pod_plot(pod: DetectorPod, unit: str) -> dict[str, Any] | None:
    """Draw detection over the size: the fractions with their intervals, the curve with its band, a90 and a90/95."""
    if len(pod.sizes) < 2:
        return None
    first, last = pod.sizes[0].size, pod.sizes[-1].size
    ends, curves, marks = (first, last), [], []
    if pod.curve is not None:
        ends = first / 1.5, last * 1.5
        grid = np.geomspace(*ends, _CURVE_POINTS)
        curves = [("hits and misses", grid, pod.curve.detection(grid), pod.curve.detection_band(grid))]
        known = ((pod.curve.a90, "a90"), (pod.curve.a90_95, "a90/95"))
        marks = [(size, label) for size, label in known if math.isfinite(size) and size <= grid[-1]]
    x_ends = (math.log10(ends[0]) - 0.02, math.log10(ends[1]) + 0.02)
    picture = Picture(WIDTH, HEIGHT, x_ends, (0.0, 1.0), log=True)
    _draw_curves(picture, f"leak [{unit}]", curves)
    for point in pod.sizes if len(pod.sizes) <= _MOST_POINTS else ():
        detection = point.proportion
        picture.point("point", point.size, detection.value, (detection.high, detection.low))
    for k, (size, label) in enumerate(marks, 1):
        picture.mark("mark", size)
        picture.labels.append(SvgText(float(picture.x(size)) - 4.0, 14.0 * k, label, "end"))
    return {"title": f"Detection over leak size, {pod.detector}", "picture": picture}


def _roc_plot(rocs: Sequence[SizeRoc], unit: str) -> dict[str, Any] | None:
    """Draw detection over false alarms, a line for each size; the band where there is one line alone."""
    if not rocs:
        return None
    curves = [
        (_size_text(roc, unit), curve.false_alarm, curve.detection, (curve.low, curve.high) if len(rocs) == 1 else None)
        for roc in rocs
        for curve in [roc.curve]
    ]
    picture = Picture(WIDTH, HEIGHT, (0.0, 1.0), (0.0, 1.0))
    _draw_curves(picture, "false alarms", curves)
    return {"title": f"Detection over false alarms, {rocs[0].detector}", "picture": picture}


def _draw_curves(
    picture: Picture, x_label: str, curves: Sequence[tuple[str, Array, Array, tuple[Array, Array] | None]]
) -> None:
    """Draw curves (label, x, y, ends of the band), of long ones some points, with the frame and its axes."""
    thinned = []
    for label, x, y, ends in curves:
        kept = np.unique(np.linspace(0, x.size - 1, min(x.size, _MOST_DRAWN)).round().astype(np.int64))
        thinned.append((label, x[kept], y[kept]))
        if ends is not None:
            picture.area("band", x[kept], ends[0][kept], ends[1][kept])
    for value in log_ticks(*picture.x_ends) if picture.log else ticks(*picture.x_ends, 5):
        picture.mark("grid", value)
        picture.below(value, f"{value:g}")
    picture.frame(5)
    for k, (label, x, y) in enumerate(thinned):
        picture.line(f"path s{k % 6}", x, y, label, digits=2)
    picture.labels.append(SvgText(WIDTH / 2, HEIGHT + 32.0, x_label))
    picture.labels.append(SvgText(-34.0, HEIGHT / 2, "detected", turned=True))
