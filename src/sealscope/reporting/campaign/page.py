"""Write a campaign's result as a table for the terminal, and as one HTML page with curves that works offline."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.campaigns.judging.alarms import AlarmFractions
from sealscope.campaigns.judging.curves import DetectorPod, SizeRoc
from sealscope.campaigns.judging.judge import Judgement
from sealscope.campaigns.judging.tables import PriorKnowledge
from sealscope.campaigns.plans.detectors import DIAGNOSE, WATCH, parse_detector_name
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
#: If there are more sizes of leaks than this, one column shows all of them together.
_MAX_SIZES = 8
#: Size of a picture in pixels, and number of the styles s0, s1, ... of lines in the style sheet.
WIDTH, HEIGHT, _N_STYLES = 460.0, 300.0, 6
#: Number of points of a fitted curve; largest number of points of any curve, and of measured fractions in a picture.
_CURVE_POINTS, _MAX_CURVE_POINTS, _MAX_FRACTIONS = 120, 400, 60
#: Largest numbers of detectors in the summary, and of parameters in the description of the assumed rig.
_MAX_NAMED, _MAX_PARAMETERS = 3, 6


def _format_area(area: Area) -> str:
    """Format the area under an ROC curve with its confidence interval, such as "0.912 (0.880–0.941)"."""
    return f"{area.value:.3f} ({area.low:.3f}–{area.high:.3f})"


def main_table(result: CampaignResult) -> tuple[list[str], list[list[str]]]:
    """Build the main table of a campaign as text: the headings of its columns, and a row of cells for each detector.

    AUC is the area under the ROC curve, a90 the leak size detected with a probability of 90 %, a90/95 its upper 95 %
    confidence bound. Two detectors for comparison, which always or never raise an alarm, come last.
    """
    judgement = result.judgement
    sizes = sorted({row.leak_lpm for row in judgement.table if row.leak_lpm > 0})
    rows = judgement.table
    if not 0 < len(sizes) <= _MAX_SIZES:
        sizes, rows = [math.nan], judgement.overall  # nan: one column of all sizes together
    by_detector: dict[str, dict[str, AlarmFractions]] = defaultdict(dict)
    for row in rows:
        by_detector[row.detector][str(row.leak_lpm)] = row  # sizes as text, since nan (all sizes) does not equal itself
    pods = {pod.detector: pod for pod in judgement.pods}
    areas = {roc.detector: _format_area(roc.area) for roc in judgement.rocs if math.isnan(roc.leak_lpm)}
    table = []
    for name, by_size in by_detector.items():
        knowledge = [_format_knowledge(result.known.get(name))] if result.known else []
        any_row, *_ = by_size.values()
        false_alarms = percent(any_row.false_alarm)  # the same for all sizes
        detections = [percent(by_size[str(size)].alarms) if str(size) in by_size else "–" for size in sizes]
        area = areas.get(name, "–")
        a90, a90_95 = _format_a90(pods.get(name))
        table.append([name, *knowledge, false_alarms, *detections, area, a90, a90_95])
    knowledge_head = ["given"] if result.known else []
    size_heads = ["any leak" if math.isnan(size) else f"{size:g} {result.plan.unit}" for size in sizes]
    return ["detector", *knowledge_head, "false alarms", *size_heads, "AUC, any leak", "a90", "a90/95"], table


def _format_knowledge(known: PriorKnowledge | None) -> str:
    """Format the information that a detector was given as "true onset", "rig" or both; a dash if there is none."""
    if known is None:
        return "–"
    facts = [*(["true onset"] if known.onset else []), *(["rig"] if known.rig else [])]
    return ", ".join(facts) or "–"


def _format_a90(pod: DetectorPod | None) -> tuple[str, str]:
    """Format a90 and a90/95: "> 2" above the largest tested size (here 2), a dash if unknown."""
    if pod is None or pod.curve is None:
        return "–", "–"
    largest = max(tested.size for tested in pod.sizes)
    a90, a90_95 = (
        "–" if math.isnan(size) else f"{size:.3g}" if size <= largest else f"> {largest:.3g}"
        for size in (pod.curve.a90, pod.curve.a90_95)
    )
    return a90, a90_95


def result_text(result: CampaignResult) -> str:
    """Summarise in a few sentences the leaks that the best detectors of a campaign find, and their false alarms.

    At most `_MAX_NAMED` detectors are described, in the order of a90; those without an a90 within the tested sizes
    come last, by falling fraction of the largest leaks that they find.
    """
    judgement, unit = result.judgement, result.plan.unit
    ranked_findings: list[tuple[float, float, str]] = []
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
        ranked_findings.append((a90, -largest.alarms.value, text))
    ranked_findings.sort(key=lambda item: item[:2])  # by a90, then by the negative fraction of the largest leaks
    sentences = [text for *_, text in ranked_findings[:_MAX_NAMED]]
    n_more = len(ranked_findings) - len(sentences)
    rest = f" {n_more} more detectors are in the table." if n_more > 1 else " Another detector is in the table."
    records = f"{judgement.judged} records were judged."
    return " ".join([*sentences, records]) + (rest if n_more else "")


def campaign_text(result: CampaignResult) -> str:
    """Format the title, the main table and the notes of a campaign as text for the terminal."""
    heads, rows = main_table(result)
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = []
    for name, *cells in (heads, *rows):  # the detector's name is aligned left, the other cells right
        right = (text.rjust(width) for text, width in zip(cells, widths[1:], strict=True))
        lines.append("  ".join([name.ljust(widths[0]), *right]).rstrip())
    return "\n".join([result.plan.title, *lines, *(paragraph(note) for note in _notes(result))])


def _notes(result: CampaignResult) -> list[str]:
    """List the notes under a campaign's main table as sentences, such as those on thresholds or missing records."""
    judgement, plan = result.judgement, result.plan
    notes = [_say("intervals", share=100 * plan.confidence, unit=plan.unit)]
    percentage = 100 * plan.false_alarm
    if judgement.thresholds:
        key = "thresholds_of_records" if isinstance(plan, SimulatedPlan) else "thresholds_of_recordings"
        notes.append(_say(key, share=percentage, leak_free=judgement.leak_free, judged=judgement.judged))
    # without a scorer, a detector states verdicts itself
    judges = [name for name in plan.detectors if parse_detector_name(name).scorer is None]
    notes += [_say("own_verdict", share=percentage, detectors=", ".join(judges))] if judges else []
    with_onset = [name for name, known in result.known.items() if known.onset]
    notes += [_say("true_onset", detectors=", ".join(with_onset))] if with_onset else []
    notes += _prior_knowledge_notes(result)
    notes += [plan.note] if plan.note else []
    notes += [_say("missing", count=result.missing)] if result.missing else []
    notes += [_say("failed", count=len(judgement.failed))] if judgement.failed else []
    return notes


def _say(name: str, **values: Any) -> str:
    """Format a text of the section `campaign` of `messages.toml` with `values` in its placeholders."""
    return say(f"campaign.{name}", **values)


def _prior_knowledge_notes(result: CampaignResult) -> list[str]:
    """Format a note for each set of channels and each rig that detectors were given."""
    by_channels: dict[str, list[str]] = defaultdict(list)
    by_rig: dict[str, list[str]] = defaultdict(list)
    for name, known in result.known.items():
        by_channels[", ".join(known.channels)].append(name)
        by_rig[known.rig].append(name)
    key = "channels" if len(by_channels) == 1 else "channels_of"
    notes = [_say(key, channels=channels, detectors=", ".join(names)) for channels, names in by_channels.items()]
    return notes + [_say("rig", rig=rig, detectors=", ".join(names)) for rig, names in by_rig.items() if rig]


def write_campaign_page(result: CampaignResult, path: Path, files: Sequence[str] = ()) -> Path:
    """Write the page of a campaign's result as HTML, with links to `files` in its folder; return its path."""
    return template.write(path, render_campaign_page(result, files))


def render_campaign_page(result: CampaignResult, files: Sequence[str] = ()) -> str:
    """Render the page of a campaign's result as HTML, with links to `files` and at most 200 failed records."""
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
        sections=[_detector_section(pod, judgement, plan.unit) for pod in judgement.pods],
        tables=page_tables(judgement, plan.unit, getattr(plan, "part", "")),  # plans over recordings have no `part`
        causes=cause_tables(judgement),
        failed=failed,
        failed_count=len(judgement.failed),
        files=files,
    )


def _facts(result: CampaignResult) -> list[tuple[str, str]]:
    """List the conditions of a campaign for its page, as pairs of label and text."""
    plan, judgement = result.plan, result.judgement
    if isinstance(plan, RecordedPlan):
        return [(group.label or group.files, f"{group.use}, size {group.size:g} {plan.unit}") for group in plan.sets]
    machines = f"machines drawn from profile {plan.profile}" if plan.profile else "no drift, every machine alike"
    facts = [
        ("rig", f"{plan.rig.name}; {machines}"),
        ("records", f"{plan.duration_s:g} s at {plan.rig.daq.sample_rate:g} Hz, leaks open at {plan.onset_s:g} s"),
        *((name, ", ".join(str(level) for level in levels)) for name, levels in plan.factors.items()),
        ("base seed", str(plan.seed)),
        *((f"channels of view @ {view}" if view else "channels", ", ".join(plan.views[view])) for view in plan.views),
    ]
    if any(parse_detector_name(name).scorer is None for name in plan.detectors):
        facts.append(("assumed by detectors", _describe_assumed_machine(plan)))
    for size, (mean, deviation) in judgement.achieved_flows.items():
        margin = "" if math.isnan(deviation) else f" ± {deviation:.2g}"
        text = f"achieved {mean:.3g}{margin} L/min (mean and standard deviation over the records)"
        facts.append((f"leak of {size:g} L/min", text))
    return facts


def _describe_assumed_machine(plan: SimulatedPlan) -> str:
    """Describe the rig that detectors assume, with the parameters that differ from the simulated rig's.

    At most `_MAX_PARAMETERS` of them are named, and the others counted. If no parameter differs, the text says so.
    """
    if plan.assumed == plan.rig:
        return f"the rig {plan.rig.name} as it stands, not the machine that was drawn"
    simulated_values = {row.name: row.value for row in plan.rig.table()}
    different_values = [f"{row.name} {row.value:g}" if isinstance(row.value, float) else f"{row.name} {row.value}"
                        for row in plan.assumed.table() if simulated_values.get(row.name) != row.value]  # fmt: skip
    n_more = len(different_values) - _MAX_PARAMETERS
    more = f" and {n_more} more" if n_more > 0 else ""
    return f"{plan.assumed.name}, which differs from the rig: {', '.join(different_values[:_MAX_PARAMETERS])}{more}"


def _detector_section(pod: DetectorPod, judgement: Judgement, unit: str) -> dict[str, Any]:
    """Build the template's values for the section of one detector on a campaign's page.

    `cells` are fractions of alarms by leak size and by the levels of the campaign's factors, left out if there are no
    factors or more than `_MAX_SIZES` leak sizes. `pod`: the detector's probability of detection over the size.
    """
    name = pod.detector
    rocs = [roc for roc in judgement.rocs if roc.detector == name]
    drawn_rocs = [roc for roc in rocs if not math.isnan(roc.leak_lpm)]
    if not 0 < len(drawn_rocs) <= _MAX_SIZES:  # draw the curve of all sizes together, which has the size nan
        drawn_rocs = [roc for roc in rocs if math.isnan(roc.leak_lpm)]
    cells = [cell for cell in judgement.cells if cell.detector == name]
    factors = list(cells[0].levels) if cells else []
    sizes = sorted({cell.leak_lpm for cell in cells})
    by_levels: dict[tuple[str, ...], dict[float, str]] = defaultdict(dict)
    if factors and len(sizes) <= _MAX_SIZES + 1:  # one more for the size 0 of leak-free records
        for cell in cells:
            by_levels[tuple(map(str, cell.levels.values()))][cell.leak_lpm] = percent(cell.alarms)
    return {
        "name": name,
        "about": _describe_score(name),
        "plots": [plot for plot in (_pod_plot(pod, unit), _roc_plot(drawn_rocs, unit)) if plot is not None],
        "areas": [(_size_text(roc, unit), _format_area(roc.area)) for roc in drawn_rocs],
        "cell_columns": [*factors, *("no leak" if size == 0 else f"{size:g} {unit}" for size in sizes)],
        "cells": [
            (*levels, *(cells_by_size.get(size, "–") for size in sizes)) for levels, cells_by_size in by_levels.items()
        ],
    }


def _size_text(roc: SizeRoc, unit: str) -> str:
    """Format the leak size of an ROC curve in `unit`; "any size" for a curve of leaks of all sizes."""
    return "any size" if math.isnan(roc.leak_lpm) else f"{roc.leak_lpm:g} {unit}"


def _describe_score(name: str) -> str:
    """Describe the score from which the ROC curve of a detector is computed; "" if the detector is not installed.

    The word after the "@" in a `name` such as "diagnose @ pressures" is the view, i.e. the set of channels it is given.
    """
    detector = parse_detector_name(name)
    view_text = f", given the channels of {detector.view} alone" if detector.view else ""
    if detector.scorer is not None:
        return detector.scorer.description + view_text
    if detector.base == DIAGNOSE:
        return f"score over threshold of the detector that judged{view_text}"
    is_known = detector.base == WATCH or detector.base in detectors()
    return f"the score of the detector {detector.base!r}{view_text}" if is_known else ""


#: A curve of a plot: label, x, y, and lower and upper end of its confidence band, None for none.
_Curve = tuple[str, Array, Array, tuple[Array, Array] | None]


def _pod_plot(pod: DetectorPod, unit: str) -> dict[str, Any] | None:
    """Draw the fraction of leaks that a detector finds over the leak size, with the fitted curve, a90 and a90/95.

    The fractions are left out if there are more than `_MAX_FRACTIONS`. Returns title and picture by name for the page's
    template, or None for fewer than two sizes.
    """
    if len(pod.sizes) < 2:
        return None
    first, last = pod.sizes[0].size, pod.sizes[-1].size
    ends, marks = (first, last), []
    curves: list[_Curve] = []
    if pod.curve is not None:
        ends = first / 1.5, last * 1.5  # so that the curve extends beyond the tested sizes
        grid = np.geomspace(*ends, _CURVE_POINTS)
        band = pod.curve.detection_band(grid)
        curves = [("hits and misses", grid, pod.curve.detection(grid), band)]
        sizes = ((pod.curve.a90, "a90"), (pod.curve.a90_95, "a90/95"))
        marks = [(size, label) for size, label in sizes if math.isfinite(size) and size <= grid[-1]]
    x_ends = (math.log10(ends[0]) - 0.02, math.log10(ends[1]) + 0.02)  # decimal logarithms, with a small margin
    picture = Picture(WIDTH, HEIGHT, x_ends, (0.0, 1.0), log=True)
    _draw_detection_curves(picture, f"leak [{unit}]", curves)
    for point in pod.sizes if len(pod.sizes) <= _MAX_FRACTIONS else ():
        detection = point.proportion
        picture.point("point", point.size, detection.value, (detection.high, detection.low))
    for k, (size, label) in enumerate(marks, 1):
        picture.mark("mark", size)
        # left of the mark, each label below the previous one
        picture.labels.append(SvgText(float(picture.x(size)) - 4.0, 14.0 * k, label, anchor="end"))
    return {"title": f"Detection over leak size, {pod.detector}", "picture": picture}


def _roc_plot(rocs: Sequence[SizeRoc], unit: str) -> dict[str, Any] | None:
    """Draw the ROC curves of a detector, one for each leak size, a single one with its band; None without curves."""
    if not rocs:
        return None
    curves: list[_Curve] = []
    for roc in rocs:
        band = (roc.curve.low, roc.curve.high) if len(rocs) == 1 else None
        curves.append((_size_text(roc, unit), roc.curve.false_alarm, roc.curve.detection, band))
    picture = Picture(WIDTH, HEIGHT, (0.0, 1.0), (0.0, 1.0))
    _draw_detection_curves(picture, "false alarms", curves)
    return {"title": f"Detection over false alarms, {rocs[0].detector}", "picture": picture}


def _draw_detection_curves(picture: Picture, x_label: str, curves: Sequence[_Curve]) -> None:
    """Draw curves of the detected fraction, of at most `_MAX_CURVE_POINTS` points each, with grid, frame and labels."""
    thinned_curves = []
    for label, x, y, band in curves:
        indices = np.unique(np.linspace(0, x.size - 1, min(x.size, _MAX_CURVE_POINTS)).round().astype(np.int64))
        thinned_curves.append((label, x[indices], y[indices]))
        if band is not None:
            low, high = band
            picture.area("band", x[indices], low[indices], high[indices])
    for value in log_ticks(*picture.x_ends) if picture.log else ticks(*picture.x_ends, count=5):
        picture.mark("grid", value)
        picture.below(value, f"{value:g}")
    picture.frame(count=5)
    for k, (label, x, y) in enumerate(thinned_curves):
        picture.line(f"path s{k % _N_STYLES}", x, y, label, digits=2)
    # below the values of the x axis, and left of those of the y axis
    picture.labels.append(SvgText(WIDTH / 2, HEIGHT + 32.0, x_label))
    picture.labels.append(SvgText(-34.0, HEIGHT / 2, "detected", turned=True))
