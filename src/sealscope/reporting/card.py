"""The card of a diagnosis: verdict, flow and curve at a glance, for a mail or a message."""

from __future__ import annotations

from pathlib import Path

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.parameters import Rig
from sealscope.recordings.recording import Recording
from sealscope.reporting import charts, messages, template
from sealscope.reporting.particulars import particulars_of

#: Size of a card in pixels.
WIDTH, HEIGHT = 1200, 630
_CURVE_HEIGHT = 190


def render_card(
    recording: Recording,
    diagnosis: Diagnosis,
    *,
    rig: Rig | None = None,
    marks: tuple[charts.Mark, ...] = (),
    title: str | None = None,
) -> str:
    """Return the card as HTML of `WIDTH` x `HEIGHT` pixels: machine, date, verdict, L/min, its curve."""
    particulars = particulars_of(recording, rig)
    name = Path(diagnosis.file).name
    chart = next(iter(charts.course_charts(diagnosis, height=_CURVE_HEIGHT)), None)
    still = None
    span = (float(recording.t[0]), float(recording.t[-1]))
    if chart is not None and diagnosis.course is not None:
        still = charts.still_chart(chart, diagnosis.course.t, [line.values for line in chart.lines], span)
    machine = particulars.get("Machine")
    subtitle = (name, particulars.get("Operator"), particulars.get("Oil temperature"))
    return template.render(
        "card.html.j2",
        d=diagnosis,
        messages=messages,
        title=title or machine or name,
        date=particulars.get("Date") or "",
        subtitle=" · ".join(text for text in subtitle if text),
        chart=chart,
        still=still,
        events=charts.events(diagnosis, span, marks),
        width=WIDTH,
        height=HEIGHT,
    )
