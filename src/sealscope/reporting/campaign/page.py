"""A campaign's result for people: the terminal's table, and one HTML page with the curves that works offline."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from sealscope.campaigns.execution.store import RUN_BY_RUN
from sealscope.campaigns.judging.judge import DetectorPod, Judgement, SizeRoc
from sealscope.campaigns.judging.tables import PriorKnowledge
from sealscope.campaigns.plans.detectors import DIAGNOSE, plan_detector
from sealscope.campaigns.plans.model import HeldOutPlan, RecordedPlan, SimulatedPlan
from sealscope.campaigns.results import CampaignResult
from sealscope.diagnosis.registry import detectors
from sealscope.evaluation.roc import Area
from sealscope.evaluation.table import SummaryRow
from sealscope.reporting import template
from sealscope.reporting.campaign.curves import CurvePlot, PlotCurve, draw
from sealscope.reporting.campaign.tables import cause_tables, page_tables, percent

PAGE = "report.html"
#: More sizes than this are shown together: a column for each could not be read.
_MOST_SIZES = 8
_CURVE_POINTS = 120
#: Detectors that the result names in words, the best of them.
_MOST_SAID = 3


@dataclass(frozen=True)
class DetectorLine:
    """One detector's line of the main table, as text; `given`: what it knew beside the record."""

    detector: str
    given: str
    false_alarm: str
    cells: tuple[str, ...]
    area: str
    a90: str
    a90_95: str
    reference: bool


@dataclass(frozen=True)
class DetectorSection:
    """One detector's curves and cells."""

    name: str
    about: str
    plots: tuple[CurvePlot, ...]
    areas: tuple[tuple[str, str], ...]
    cells: tuple[tuple[str, ...], ...]
    cell_columns: tuple[str, ...]


def _within(size: float, largest: float) -> str:
    """Return a size from a curve as text; beyond the sizes that were tested only that it lies there."""
    if math.isnan(size):
        return "–"
    return f"{size:.3g}" if size <= largest else f"> {largest:.3g}"


def _area(area: Area) -> str:
    return f"{area.value:.3f} ({area.low:.3f}–{area.high:.3f})"


def sizes_of(judgement: Judgement) -> list[float]:
    """Return the sizes of leak that get a column each; nan for all of them together where they are many or none."""
    sizes = sorted({row.leak_lpm for row in judgement.table if row.leak_lpm > 0})
    return sizes if 0 < len(sizes) <= _MOST_SIZES else [math.nan]


def lines_of(result: CampaignResult) -> list[DetectorLine]:
    """Return the main table: detectors in the plan's order, then the one that always and the one that never fires."""
    judgement = result.judgement
    sizes = sizes_of(judgement)
    rows = judgement.overall if math.isnan(sizes[0]) else judgement.table
    by_detector: dict[str, list[SummaryRow]] = {}
    for row in rows:
        by_detector.setdefault(row.detector, []).append(row)
    pods = {pod.detector: pod for pod in judgement.pods}
    areas = {roc.detector: roc.area for roc in judgement.rocs if math.isnan(roc.leak_lpm)}
    lines = []
    for name, own in by_detector.items():
        by_size = {_key(row.leak_lpm): row for row in own}
        pod = pods.get(name)
        lines.append(
            DetectorLine(
                name,
                _given(result.known.get(name)),
                percent(own[0].false_alarm),
                tuple(percent(by_size[_key(size)].detection) if _key(size) in by_size else "–" for size in sizes),
                _area(areas[name]) if name in areas else "–",
                _of_curve(pod, "a90"),
                _of_curve(pod, "a90_95"),
                pod is None,
            )
        )
    return lines


def _given(known: PriorKnowledge | None) -> str:
    """Return what a detector was given, in a word or two."""
    if known is None:
        return "–"
    return ", ".join(word for word, given in (("true onset", known.onset), ("rig", known.rig)) if given) or "–"


def _of_curve(pod: DetectorPod | None, name: Literal["a90", "a90_95"]) -> str:
    if pod is None or pod.curve is None:
        return "–"
    size = pod.curve.a90 if name == "a90" else pod.curve.a90_95
    return _within(size, max(tested.size for tested in pod.sizes))


def _key(size: float) -> str:
    return "any" if math.isnan(size) else repr(size)


def _heads(result: CampaignResult) -> list[str]:
    sizes = sizes_of(result.judgement)
    return ["any leak" if math.isnan(size) else f"{size:g} {result.plan.unit}" for size in sizes]


def result_text(result: CampaignResult) -> str:
    """Return what came out in a few sentences: what the best detectors find, at which rate of false alarms."""
    judgement, unit = result.judgement, result.plan.unit
    said: list[tuple[float, float, str]] = []
    for pod in judgement.pods:
        rows = [row for row in judgement.table if row.detector == pod.detector and row.leak_lpm > 0]
        if not rows:
            continue
        largest = max(rows, key=lambda row: row.leak_lpm)
        finding = f"finds {percent(largest.detection)} of leaks of {largest.leak_lpm:g} {unit}"
        a90 = math.inf
        if pod.curve is not None and pod.curve.a90 <= largest.leak_lpm:
            a90 = pod.curve.a90
            finding = f"finds 9 in 10 leaks of {a90:.2g} {unit}"
        text = f"{pod.detector} {finding} at {percent(largest.false_alarm)} false alarms."
        said.append((a90, -largest.detection.value, text))
    said.sort(key=lambda item: item[:2])
    shown = [text for _, _, text in said[:_MOST_SAID]]
    more = len(said) - len(shown)
    rest = f" {more} more detectors are in the table." if more > 1 else " Another detector is in the table."
    records = f"{judgement.judged} records were judged."
    return " ".join([*shown, records]) + (rest if more else "")


def campaign_text(result: CampaignResult) -> str:
    """Return the main table as plain text."""
    lines = lines_of(result)
    given = [] if not result.known else ["given"]
    heads = ["detector", *given, "false alarms", *_heads(result), "AUC, any leak", "a90", "a90/95"]
    body = [
        [line.detector, *([line.given] if given else []), line.false_alarm, *line.cells, line.area, line.a90,
         line.a90_95]
        for line in lines
    ]  # fmt: skip
    widths = [max(len(row[k]) for row in (heads, *body)) for k in range(len(heads))]
    rows = [
        "  ".join(
            text.ljust(width) if k == 0 else text.rjust(width)
            for k, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in (heads, *body)
    ]
    return "\n".join([result.plan.title, *(row.rstrip() for row in rows), *_notes(result)])


def _notes(result: CampaignResult) -> list[str]:
    """Return what stands under the table, in whole sentences."""
    judgement, plan = result.judgement, result.plan
    notes = [
        f"Fractions with their {100 * plan.confidence:g} % intervals; a90, a90/95 in {plan.unit} from the curve "
        "through hits and misses."
    ]
    if isinstance(plan, HeldOutPlan):
        notes.append(f"Each {plan.leave_out} was held out whole in turn; an alarm is a probability over 50 %.")
    else:
        if judgement.thresholds:
            records, others = "recordings", "others"
            if isinstance(plan, SimulatedPlan):
                records, others = "records", "others, each with seeds of its own"
            notes.append(
                f"Thresholds for {100 * plan.false_alarm:g} % false alarms from {judgement.leak_free} leak-free "
                f"{records}; judged on {judgement.judged} {others}."
            )
        own = [name for name in plan.detectors if plan_detector(name).scorer is None]
        if own:
            notes.append(
                f"By their own verdict at {100 * plan.false_alarm:g} % false alarms: {', '.join(own)}. "
                "What they state of flow, onset and cause is in estimates.csv, onsets.csv and causes.csv."
            )
    notes += _known_notes(result)
    if _batched(result):
        notes.append(
            f"Simulated {result.mode}: of each record only the RMS of the details on both sides of the onset was "
            "stored. Seeds draw the same machines as run by run, and other noise of the same law."
        )
    notes += [check.sentence() for check in result.checks]
    if plan.note:
        notes.append(plan.note)
    if result.missing:
        notes.append(f"Not complete: {result.missing} records of the plan have no row yet.")
    if judgement.failed:
        notes.append(f"{len(judgement.failed)} records failed; those to judge count as cannot tell for every detector.")
    return notes


def _known_notes(result: CampaignResult) -> list[str]:
    """Return which detectors knew the true onset, which channels they saw and which rig they assume."""
    notes = []
    with_onset = [name for name, known in result.known.items() if known.onset]
    if with_onset:
        notes.append(
            "Given the true onset, which no machine in service gives, a scorer splits the record where the leak opens: "
            f"{', '.join(with_onset)}."
        )
    by_channels: dict[tuple[str, ...], list[str]] = {}
    by_rig: dict[str, list[str]] = {}
    for name, known in result.known.items():
        by_channels.setdefault(known.channels, []).append(name)
        by_rig.setdefault(known.rig, []).append(name)
    if len(by_channels) == 1:
        notes.append(f"Channels given: {', '.join(next(iter(by_channels)))}.")
    else:
        notes += [
            f"Channels given: {', '.join(channels)} to {', '.join(names)}." for channels, names in by_channels.items()
        ]
    notes += [f"Rig {rig} assumed by {', '.join(names)}." for rig, names in by_rig.items() if rig]
    return notes


def _batched(result: CampaignResult) -> bool:
    return result.mode not in ("", RUN_BY_RUN)


def write_campaign_page(result: CampaignResult, path: Path, files: Sequence[str] = ()) -> Path:
    """Write the page of a result; `files`: names of the tables beside it.

    Raises InputError where it cannot be written.
    """
    return template.write(path, render_campaign_page(result, files))


def render_campaign_page(result: CampaignResult, files: Sequence[str] = ()) -> str:
    """Return the page as text, with nothing outside it but links to the tables beside it."""
    judgement = result.judgement
    return template.render(
        "campaign.html.j2",
        title=result.plan.title,
        name=result.plan.name,
        heads=_heads(result),
        unit=result.plan.unit,
        lines=lines_of(result),
        given=bool(result.known),
        result=result_text(result),
        notes=_notes(result),
        facts=_facts(result),
        sections=[_section(pod, judgement, result.plan.unit) for pod in judgement.pods],
        tables=page_tables(judgement, result.plan.unit, getattr(result.plan, "part", "")),
        causes=cause_tables(judgement),
        failed=[
            (row.id, ", ".join(f"{k} {v}" for k, v in row.levels.items()), row.error) for row in judgement.failed[:200]
        ],
        failed_count=len(judgement.failed),
        files=list(files),
        campaign_css=template.packaged("templates/campaign.css"),
    )


def _facts(result: CampaignResult) -> list[tuple[str, str]]:
    """Return what was done, for the page's head."""
    plan, judgement = result.plan, result.judgement
    if isinstance(plan, RecordedPlan):
        return [(group.label or group.files, f"{group.use}, size {group.size:g} {plan.unit}") for group in plan.sets]
    if isinstance(plan, HeldOutPlan):
        return [
            ("data", plan.data),
            ("held out", f"one {plan.leave_out} at a time"),
            ("samples", str(judgement.judged)),
        ]
    machines = f"machines drawn from profile {plan.profile}" if plan.profile else "no drift, every machine alike"
    facts = [
        ("rig", f"{plan.rig.name}; {machines}"),
        ("records", f"{plan.duration_s:g} s at {plan.rig.daq.sample_rate:g} Hz, leaks open at {plan.onset_s:g} s"),
        *((name, ", ".join(str(level) for level in levels)) for name, levels in plan.factors.items()),
        ("base seed", str(plan.seed)),
        *([("simulated", result.mode)] if _batched(result) else []),
        *((f"seen by @ {name}" if name else "seen", ", ".join(channels)) for name, channels in plan.views.items()),
    ]
    if any(plan_detector(name).scorer is None for name in plan.detectors):
        facts.append(("assumed by detectors", _assumed(plan)))
    for size, (mean, spread) in judgement.realised.items():
        about = "" if math.isnan(spread) else f" ± {spread:.2g}"
        facts.append(
            (
                f"leak of {size:g} L/min",
                f"really {mean:.3g}{about} L/min (mean and standard deviation over the records)",
            )
        )
    return facts


def _assumed(plan: SimulatedPlan) -> str:
    """Return what the detectors assume of the machine, as text."""
    if plan.assumed is None or plan.assumed == plan.rig:
        return f"the rig {plan.rig.name} as it stands, not the machine that was drawn"
    true = {row.name: row.value for row in plan.rig.table()}
    other = [f"{row.name} {row.value:g}" if isinstance(row.value, float) else f"{row.name} {row.value}"
             for row in plan.assumed.table() if true.get(row.name) != row.value]  # fmt: skip
    more = f" and {len(other) - 6} more" if len(other) > 6 else ""
    return f"{plan.assumed.name}, which differs from the rig: {', '.join(other[:6])}{more}"


def _section(pod: DetectorPod, judgement: Judgement, unit: str) -> DetectorSection:
    name = pod.detector
    rocs = [roc for roc in judgement.rocs if roc.detector == name]
    shown = [roc for roc in rocs if not math.isnan(roc.leak_lpm)]
    shown = shown if 0 < len(shown) <= _MOST_SIZES else [roc for roc in rocs if math.isnan(roc.leak_lpm)]
    cells = [cell for cell in judgement.cells if cell.detector == name]
    factors = tuple(cells[0].levels) if cells else ()
    by_cell = {(cell.leak_lpm, tuple(str(level) for level in cell.levels.values())): cell for cell in cells}
    sizes = sorted({cell.leak_lpm for cell in cells})
    table = []
    if factors and len(sizes) <= _MOST_SIZES + 1:
        table = [
            (*levels, *(percent(by_cell[size, levels].alarms) if (size, levels) in by_cell else "–" for size in sizes))
            for levels in dict.fromkeys(levels for _, levels in by_cell)
        ]
    plots = tuple(plot for plot in (_pod_plot(pod, unit), _roc_plot(shown, unit)) if plot is not None)
    heads = (*factors, *("no leak" if size == 0 else f"{size:g} {unit}" for size in sizes))
    areas = tuple((_size_text(roc, unit), _area(roc.area)) for roc in shown)
    return DetectorSection(name, _about(name), plots, areas, tuple(table), heads)


def _size_text(roc: SizeRoc, unit: str) -> str:
    return "any size" if math.isnan(roc.leak_lpm) else f"{roc.leak_lpm:g} {unit}"


def _about(name: str) -> str:
    """Return what a detector's score is, "" for one that is known here by its name alone."""
    detector = plan_detector(name)
    through = f", given the channels of {detector.view} alone" if detector.view else ""
    if detector.scorer is not None:
        return detector.scorer.about + through
    if detector.of == DIAGNOSE:
        return f"score over threshold of the detector that judged{through}"
    if detector.of not in detectors():
        return ""
    return f"the score of the detector {detector.of!r}{through}"


def _pod_plot(pod: DetectorPod, unit: str) -> CurvePlot | None:
    """Draw detection over the size: the fractions with their intervals, the curve with its band, a90 and a90/95."""
    if len(pod.sizes) < 2:
        return None
    curves = []
    marks: list[tuple[float, str]] = []
    if pod.curve is not None:
        grid = np.geomspace(pod.sizes[0].size / 1.5, pod.sizes[-1].size * 1.5, _CURVE_POINTS)
        low, high = pod.curve.detection_band(grid)
        curves.append(PlotCurve("hits and misses", grid, pod.curve.detection(grid), low, high))
        marks = [
            (size, label)
            for size, label in ((pod.curve.a90, "a90"), (pod.curve.a90_95, "a90/95"))
            if math.isfinite(size) and size <= grid[-1]
        ]
    points = [(at.size, at.proportion.value, at.proportion.low, at.proportion.high) for at in pod.sizes]
    title = f"Detection over leak size, {pod.detector}"
    return draw(title, f"leak [{unit}]", "detected", curves, points if len(points) <= 60 else [], marks, log=True)


def _roc_plot(rocs: Sequence[SizeRoc], unit: str) -> CurvePlot | None:
    """Draw detection over false alarms, a line for each size; the band where there is one line alone."""
    if not rocs:
        return None
    alone = len(rocs) == 1
    curves = [
        PlotCurve(
            _size_text(roc, unit),
            roc.curve.false_alarm,
            roc.curve.detection,
            roc.curve.low if alone else None,
            roc.curve.high if alone else None,
        )
        for roc in rocs
    ]
    title = f"Detection over false alarms, {rocs[0].detector}"
    return draw(title, "false alarms", "detected", curves, (), (), log=False)
