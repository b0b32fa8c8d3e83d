"""A campaign's result for people: the terminal's table, and one HTML page with the curves that works offline."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from sealscope.campaigns.execution.store import RUN_BY_RUN
from sealscope.campaigns.judging.judge import Judgement, Pod, SizeRoc
from sealscope.campaigns.plans.detectors import DIAGNOSE, plan_detector
from sealscope.campaigns.plans.model import HeldOutPlan, RecordedPlan, SimulatedPlan
from sealscope.campaigns.results import Result, detectors_of
from sealscope.diagnosis.calibration.scorers import SCORERS
from sealscope.diagnosis.registry import detectors
from sealscope.evaluation.table import SummaryRow
from sealscope.recordings.atomic import atomic_write
from sealscope.reporting.campaign.curves import Curve, Drawing, draw
from sealscope.reporting.campaign.tables import cause_tables, flow_lines, onset_lines, percent
from sealscope.reporting.page import _packaged, _version

PAGE = "report.html"
#: More sizes than this are told together: a column for each could not be read.
_MOST_SIZES = 8
_CURVE_POINTS = 120


@dataclass(frozen=True)
class Line:
    """One detector's line of the main table, as text."""

    detector: str
    false_alarm: str
    cells: tuple[str, ...]
    area: str
    a90: str
    a90_95: str
    reference: bool


@dataclass(frozen=True)
class Section:
    """One detector's curves and cells."""

    name: str
    about: str
    drawings: tuple[Drawing, ...]
    areas: tuple[tuple[str, str], ...]
    cells: tuple[tuple[str, ...], ...]
    cell_columns: tuple[str, ...]


def _within(size: float, largest: float) -> str:
    """A size from a curve; what lies beyond the sizes that were tested is told as that and no more."""
    if math.isnan(size):
        return "–"
    return f"{size:.3g}" if size <= largest else f"> {largest:.3g}"


def sizes_of(judgement: Judgement) -> list[float]:
    """Sizes of leak that get a column each; nan for all of them together where they are many or none."""
    found = sorted({row.leak_lpm for row in judgement.table if row.leak_lpm > 0})
    return found if 0 < len(found) <= _MOST_SIZES else [math.nan]


def lines_of(judgement: Judgement) -> list[Line]:
    """The main table: detectors in the plan's order, then the one that always and the one that never fires."""
    sizes = sizes_of(judgement)
    rows = judgement.overall if math.isnan(sizes[0]) else judgement.table
    by_detector: dict[str, list[SummaryRow]] = {}
    for row in rows:
        by_detector.setdefault(row.detector, []).append(row)
    pods = {pod.detector: pod for pod in judgement.pods}
    areas = {one.detector: one.area for one in judgement.rocs if math.isnan(one.leak_lpm)}
    found = []
    for name, own in by_detector.items():
        at = {_key(row.leak_lpm): row for row in own}
        cells = tuple(percent(at[_key(size)].detection) if _key(size) in at else "–" for size in sizes)
        pod = pods.get(name)
        found.append(
            Line(
                name,
                percent(own[0].false_alarm),
                cells,
                f"{areas[name].value:.3f} ({areas[name].low:.3f}–{areas[name].high:.3f})" if name in areas else "–",
                _of_curve(pod, "a90"),
                _of_curve(pod, "a90_95"),
                pod is None,
            )
        )
    return found


def _of_curve(pod: Pod | None, name: Literal["a90", "a90_95"]) -> str:
    if pod is None or pod.curve is None:
        return "–"
    size = pod.curve.a90 if name == "a90" else pod.curve.a90_95
    return _within(size, max(one.size for one in pod.rates))


def _key(size: float) -> str:
    return "any" if math.isnan(size) else repr(size)


def _heads(result: Result) -> list[str]:
    sizes = sizes_of(result.judgement)
    return ["any leak" if math.isnan(size) else f"{size:g} {result.plan.unit}" for size in sizes]


def campaign_text(result: Result) -> str:
    """The main table as plain text."""
    judgement = result.judgement
    heads = ["detector", "false alarms", *_heads(result), "AUC, any leak", "a90", "a90/95"]
    body = [[one.detector, one.false_alarm, *one.cells, one.area, one.a90, one.a90_95] for one in lines_of(judgement)]
    widths = [max(len(row[k]) for row in (heads, *body)) for k in range(len(heads))]
    rows = [
        "  ".join(
            text.ljust(width) if k == 0 else text.rjust(width)
            for k, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in (heads, *body)
    ]
    return "\n".join([result.plan.title, *(row.rstrip() for row in rows), *_notes(result)])


def _notes(result: Result) -> list[str]:
    """What stands under the table, in whole sentences."""
    judgement, plan = result.judgement, result.plan
    notes = [
        f"Rates with their {100 * plan.confidence:g} % intervals; a90, a90/95 in {plan.unit} from the curve through "
        "hits and misses."
    ]
    if isinstance(plan, SimulatedPlan) and judgement.calibration is not None:
        notes.append(
            f"Thresholds for {100 * plan.false_alarm:g} % false alarms from {judgement.calibrated_on} leak-free "
            f"records; judged on {judgement.judged} others, each with seeds of its own."
        )
    elif isinstance(plan, RecordedPlan) and judgement.calibration is not None:
        notes.append(
            f"Thresholds for {100 * plan.false_alarm:g} % false alarms from {judgement.calibrated_on} leak-free "
            f"recordings; judged on {judgement.judged} others."
        )
    elif isinstance(plan, HeldOutPlan):
        notes.append(f"Each {plan.leave_out} was held out whole in turn; an alarm is a probability over 50 %.")
    own = [one for one in detectors_of(plan) if plan_detector(one).own] if not isinstance(plan, HeldOutPlan) else []
    if own and not isinstance(plan, HeldOutPlan):
        notes.append(
            f"By thresholds of their own, set for {100 * plan.false_alarm:g} % false alarms: {', '.join(own)}. What "
            "they state of flow, onset and cause is in estimates.csv, onsets.csv and causes.csv."
        )
    if _batched(result):
        notes.append(
            f"Simulated {result.mode}: of each record only the RMS of the details on both sides of the onset was kept. "
            "Seeds draw the same machines as run by run, and other noise of the same law."
        )
    notes += [one.words() for one in result.checks]
    if plan.note:
        notes.append(plan.note)
    if result.missing:
        notes.append(f"Not complete: {result.missing} records of the plan have no row yet.")
    if judgement.failed:
        notes.append(f"{len(judgement.failed)} records failed; those to judge count as cannot tell for every detector.")
    return notes


def _batched(result: Result) -> bool:
    return result.mode not in ("", RUN_BY_RUN)


def write_campaign_page(result: Result, path: Path, files: Sequence[str] = ()) -> Path:
    """Write the page of a result; `files`: names of the tables beside it. Raises InputError where it cannot be
    written."""
    text = render_campaign_page(result, files)
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def render_campaign_page(result: Result, files: Sequence[str] = ()) -> str:
    """The page as text, with nothing outside it but links to the tables beside it."""
    import jinja2
    from markupsafe import Markup

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sealscope.reporting"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    judgement = result.judgement
    return environment.get_template("campaign.html.j2").render(
        title=result.plan.title,
        name=result.plan.name,
        heads=_heads(result),
        unit=result.plan.unit,
        lines=lines_of(judgement),
        notes=_notes(result),
        facts=_facts(result),
        sections=[
            _section(name, judgement, result.plan.unit)
            for name in dict.fromkeys(pod.detector for pod in judgement.pods)
        ],
        faults=[(one.detector, one.fault, percent(one.alarms), percent(one.cannot_tell)) for one in judgement.faults],
        flows=flow_lines(judgement),
        onsets=onset_lines(judgement),
        causes=cause_tables(judgement),
        failed=[
            (row.id, ", ".join(f"{k} {v}" for k, v in row.levels.items()), row.error) for row in judgement.failed[:200]
        ],
        failed_count=len(judgement.failed),
        files=list(files),
        version=_version(),
        page_css=Markup(_packaged("templates/page.css")),
        campaign_css=Markup(_packaged("templates/campaign.css")),
    )


def _facts(result: Result) -> list[tuple[str, str]]:
    """What was done, for the page's head."""
    plan, judgement = result.plan, result.judgement
    if isinstance(plan, RecordedPlan):
        return [(one.label or one.files, f"{one.use}, size {one.size:g} {plan.unit}") for one in plan.sets]
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
    if any(plan_detector(one).detector for one in plan.detectors):
        facts.append(("assumed by detectors", _assumed(plan)))
    for size, (mean, spread) in judgement.realised.items():
        told = "" if math.isnan(spread) else f" ± {spread:.2g}"
        facts.append(
            (f"leak of {size:g} L/min", f"really {mean:.3g}{told} L/min (mean and standard deviation over the records)")
        )
    return facts


def _assumed(plan: SimulatedPlan) -> str:
    """What the detectors assume of the machine, in words."""
    if plan.assumed is None or plan.assumed == plan.rig:
        return f"the rig {plan.rig.name} as it stands, not the machine that was drawn"
    true = {row.name: row.value for row in plan.rig.table()}
    other = [f"{row.name} {row.value:g}" if isinstance(row.value, float) else f"{row.name} {row.value}"
             for row in plan.assumed.table() if true.get(row.name) != row.value]  # fmt: skip
    more = f" and {len(other) - 6} more" if len(other) > 6 else ""
    return f"{plan.assumed.name}, which differs from the rig: {', '.join(other[:6])}{more}"


def _section(name: str, judgement: Judgement, unit: str) -> Section:
    pod = next(one for one in judgement.pods if one.detector == name)
    rocs = [one for one in judgement.rocs if one.detector == name]
    shown = [one for one in rocs if not math.isnan(one.leak_lpm)]
    shown = shown if 0 < len(shown) <= _MOST_SIZES else [one for one in rocs if math.isnan(one.leak_lpm)]
    cells = [cell for cell in judgement.cells if cell.detector == name]
    factors = tuple(cells[0].levels) if cells else ()
    levels = list(dict.fromkeys(tuple(str(v) for v in cell.levels.values()) for cell in cells))
    sizes = sorted({cell.leak_lpm for cell in cells})
    table = []
    if factors and len(sizes) <= _MOST_SIZES + 1:
        at = {(cell.leak_lpm, tuple(str(v) for v in cell.levels.values())): cell for cell in cells}
        table = [
            (*level, *(percent(at[size, level].alarms) if (size, level) in at else "–" for size in sizes))
            for level in levels
        ]
    drawings = tuple(one for one in (_pod_drawing(pod, unit), _roc_drawing(shown, unit)) if one is not None)
    heads = (*factors, *("no leak" if size == 0 else f"{size:g} {unit}" for size in sizes))
    areas = tuple(
        ("any size" if math.isnan(one.leak_lpm) else f"{one.leak_lpm:g} {unit}",
         f"{one.area.value:.3f} ({one.area.low:.3f}–{one.area.high:.3f})")
        for one in shown
    )  # fmt: skip
    return Section(name, _about(name), drawings, areas, tuple(table), heads)


def _about(name: str) -> str:
    """What a detector's score is, "" for one that is known here by its name alone."""
    one = plan_detector(name)
    through = f", given the channels of {one.view} alone" if one.view else ""
    if one.of in SCORERS and not one.detector:
        return SCORERS[one.of].about + through
    if one.of not in (DIAGNOSE, *detectors()):
        return ""
    how = "by its own threshold" if one.own else "against a threshold from leak-free records"
    what = "score over threshold of the judge" if one.of == DIAGNOSE else f"the score of the detector {one.of!r} {how}"
    return what + through


def _pod_drawing(pod: Pod, unit: str) -> Drawing | None:
    """Detection over the size: the rates with their intervals, the curve with its band, a90 and a90/95."""
    if len(pod.rates) < 2:
        return None
    sizes = np.array([one.size for one in pod.rates])
    curves = []
    marks: list[tuple[float, str]] = []
    if pod.curve is not None:
        grid = np.geomspace(sizes[0] / 1.5, sizes[-1] * 1.5, _CURVE_POINTS)
        low, high = pod.curve.detection_band(grid)
        curves.append(Curve("hits and misses", grid, pod.curve.detection(grid), low, high))
        marks = [
            (value, words)
            for value, words in ((pod.curve.a90, "a90"), (pod.curve.a90_95, "a90/95"))
            if math.isfinite(value) and value <= grid[-1]
        ]
    points = (
        [(one.size, one.rate.rate, one.rate.low, one.rate.high) for one in pod.rates] if len(pod.rates) <= 60 else []
    )
    return draw(
        f"Detection over leak size, {pod.detector}", f"leak [{unit}]", "detected", curves, points, marks, log=True
    )


def _roc_drawing(rocs: Sequence[SizeRoc], unit: str) -> Drawing | None:
    """Detection over false alarms, a line for each size; the band where there is one line alone."""
    if not rocs:
        return None
    alone = len(rocs) == 1
    curves = [
        Curve(
            "any size" if math.isnan(one.leak_lpm) else f"{one.leak_lpm:g} {unit}",
            one.curve.false_alarm,
            one.curve.detection,
            one.curve.low if alone else None,
            one.curve.high if alone else None,
        )
        for one in rocs
    ]
    title = f"Detection over false alarms, {rocs[0].detector}"
    return draw(title, "false alarms", "detected", curves, (), (), log=False)
