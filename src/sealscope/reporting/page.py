"""The page of a diagnosis: one HTML file that works offline, for the screen and on paper."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.machine import states_rig
from sealscope.errors import InputError
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Recording
from sealscope.reporting import charts, features, messages, printing, template
from sealscope.reporting.charts import Mark
from sealscope.reporting.particulars import particulars_of
from sealscope.reporting.schematic import circuit_of, columns_of, schematic
from sealscope.signals.windows import WINDOW_SIZE, WINDOW_STEP

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Size of a card, and height of the curve on it, in pixels.
WIDTH, HEIGHT, _CURVE_HEIGHT = 1200, 630, 190


@checked_call
def report(
    recording: Recording,
    path: str | os.PathLike[str],
    diagnosis: Diagnosis | None = None,
    *,
    rig: Rig | str | os.PathLike[str] | None = None,
    marks: Sequence[Mark] = (),
    truth_onset_s: float | None = None,
    truth_leak_lpm: float | None = None,
    title: str | None = None,
    pressure_unit: str | None = None,
) -> Path:
    """Write the page of a diagnosis: one HTML file with charts, figures and findings, and nothing outside it.

    Parameters
    ----------
    recording : Recording
        The recording that was judged.
    path : str or path-like
        The page, ending in .html, .htm or .pdf, or its card, ending in .png. It is complete under its name or not there
        at all. A PDF is printed by a browser of Chromium's family or by WeasyPrint, whichever is on the machine. The
        card is a picture of 1200 x 630 pixels with machine, date, verdict, L/min and its curve; a browser draws it.
    diagnosis : Diagnosis, optional
        Its diagnosis; by default that of `sealscope.diagnose` with the `rig`.
    rig : Rig, str or path-like, optional
        A Rig, the name of a packaged rig or the path of a TOML file; its values label the schematic.
    marks : sequence of Mark, optional
        Further moments on every chart.
    truth_onset_s, truth_leak_lpm : float, optional
        What is known to be true, shown beside the verdict [s], [L/min].
    title : str, optional
        Title of the page; by default the name of the recording.
    pressure_unit : {"bar", "MPa", "kPa", "psi"}, optional
        Unit in which pressures are shown, by default that of the log, else bar.

    Returns
    -------
    pathlib.Path
        The page.

    Raises
    ------
    InputError
        The recording is empty, the path is no page's or cannot be written, or a unit or rig is not known.
    MissingExtra
        A PDF or a picture is asked for, and nothing on the machine makes it.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(duration="20 s")
    >>> page = ss.report(recording, "report.html", ss.diagnose(recording))
    >>> page.read_text(encoding="utf-8")[:15]
    '<!DOCTYPE html>'
    """
    target = template.check_page(path)
    if diagnosis is None:
        from sealscope.diagnosis.diagnose import diagnose

        diagnosis = diagnose(recording, rig=rig)
    options: dict[str, Any] = {"rig": rig, "marks": marks, "truth_onset_s": truth_onset_s, "title": title}
    if target.suffix.lower() == ".png":
        printing.draw_page(render_card(recording, diagnosis, **options), target, WIDTH, HEIGHT)
        return target
    page = render_page(recording, diagnosis, truth_leak_lpm=truth_leak_lpm, pressure_unit=pressure_unit, **options)
    return template.write(target, page)


def write_page(path: str | os.PathLike[str], recording: Recording, diagnosis: Diagnosis, **options: Any) -> Path:
    """Write the page of a diagnosis as `report` does; deprecated, as is its order of arguments."""
    return report(recording, path, diagnosis, **options)


def _rig_of(diagnosis: Diagnosis, rig: Rig | str | os.PathLike[str] | None) -> Rig | None:
    """Return the rig of the call, else that of the diagnosis, else None."""
    from sealscope.parameters import load_rig, rig_names

    if rig is not None:
        loaded = load_rig(rig)
        return loaded if states_rig(loaded) else None
    machine = diagnosis.machine
    known = machine is not None and machine.stated_by != "nobody" and machine.rig in rig_names()
    return load_rig(machine.rig) if known and machine is not None else None


def _all_marks(recording: Recording, marks: Sequence[Mark], truth_onset_s: float | None) -> list[Mark]:
    """Return the marks of a page; raise InputError where there is nothing to report."""
    if len(recording) == 0:
        raise InputError("recording must have at least 1 sample to be reported, got 0")
    return [*marks, *([] if truth_onset_s is None else [Mark(float(truth_onset_s), "true onset", known=True)])]


def render_card(
    recording: Recording,
    diagnosis: Diagnosis,
    *,
    rig: Rig | str | os.PathLike[str] | None = None,
    marks: Sequence[Mark] = (),
    truth_onset_s: float | None = None,
    title: str | None = None,
) -> str:
    """Return the card as HTML of `WIDTH` x `HEIGHT` pixels; arguments as for `report`."""
    shown = charts.course_charts(diagnosis, height=_CURVE_HEIGHT)
    all_marks = _all_marks(recording, marks, truth_onset_s)
    particulars = particulars_of(recording, _rig_of(diagnosis, rig))
    name = Path(diagnosis.file).name
    subtitle = (name, particulars.get("Operator"), particulars.get("Oil temperature"))
    return template.render(
        "card.html.j2",
        d=diagnosis,
        messages=messages,
        title=title or particulars.get("Machine", name),
        date=particulars.get("Date", ""),
        subtitle=" · ".join(text for text in subtitle if text),
        charts=shown,
        drawn=charts.draw(recording, [], shown, diagnosis, all_marks),
        width=WIDTH,
        height=HEIGHT,
    )


@np.errstate(all="ignore")  # what overflows is not drawn
def render_page(
    recording: Recording,
    diagnosis: Diagnosis,
    *,
    rig: Rig | str | os.PathLike[str] | None = None,
    marks: Sequence[Mark] = (),
    truth_onset_s: float | None = None,
    truth_leak_lpm: float | None = None,
    title: str | None = None,
    pressure_unit: str | None = None,
) -> str:
    """Return the page as a string of HTML; arguments and errors as for `report`."""
    from markupsafe import Markup

    pressure_unit = pressure_unit or recording.pressure_unit
    diagnosis = replace(diagnosis, pressure_unit=pressure_unit)
    known_rig, all_marks = _rig_of(diagnosis, rig), _all_marks(recording, marks, truth_onset_s)
    details = [features.chamber_details(recording, name) for name in CHAMBERS]
    chambers = [chamber for chamber, _ in details if chamber is not None]
    shown = [
        *charts.course_charts(diagnosis),
        *charts.rms_charts(chambers, pressure_unit),
        *charts.channel_charts(recording, pressure_unit),
        *charts.detail_charts(chambers, pressure_unit),
    ]
    drawn = charts.draw(recording, chambers, shown, diagnosis, all_marks)
    circuit = circuit_of(known_rig, recording, diagnosis.machine)
    facts = f"{len(recording)} samples at {recording.rate:g} Hz, {messages.clock(recording.duration)}"
    return template.render(
        "page.html.j2",
        d=diagnosis,
        messages=messages,
        title=title or Path(diagnosis.file).name,
        subtitle=f"{diagnosis.file} · {facts}",
        particulars=particulars_of(recording, known_rig),
        truth=(truth_onset_s, truth_leak_lpm),
        marks=all_marks,
        groups={group: [chart for chart in shown if chart.group == group] for group in charts.GROUPS},
        drawn=drawn,
        window=WINDOW_SIZE,
        step=WINDOW_STEP,
        notes=[note for _, note in details if note],
        schematic=Markup(schematic(recording, diagnosis, circuit)),
        rig=known_rig,
        circuit=circuit,
        columns=columns_of(recording),
        recording=recording,
        channels=[_summary(recording, name, pressure_unit) for name in recording.channels],
        provenance=list(_flat(recording.provenance)),
        chart_data=drawn.data if shown else None,
        **_changes(recording, diagnosis, chambers, pressure_unit),
    )


def _changes(
    recording: Recording, diagnosis: Diagnosis, chambers: list[features.ChamberDetails], pressure_unit: str
) -> dict[str, Any]:
    """Return the RMS of each detail in both parts in the unit shown, and the end of the scale of their changes [%]."""
    parts = features.parts_to_compare(diagnosis, recording)
    rows = []
    for change in features.changes(recording, chambers, parts):
        unit, size = charts.detail_unit(recording.units[change.channel], change.name, pressure_unit)
        before, after = (None if value is None else value / size for value in (change.before, change.after))
        label = charts.label_of(change.name)
        rows.append((change.channel, label, unit, before, after, change.percent))
    largest = max([10.0, *(abs(row[-1]) for row in rows if row[-1] is not None)])
    return {"changes": rows, "bar_limit": min(100.0, 10.0 * ceil(largest / 10.0)), "parts": parts}


def _summary(recording: Recording, name: str, pressure_unit: str) -> dict[str, Any]:
    unit, values = charts.shown_values(recording, name, pressure_unit)
    finite = values[np.isfinite(values)]
    low, mean, high = (float(f(finite)) if finite.size else None for f in (np.min, np.mean, np.max))
    return {"name": name, "unit": unit, "low": low, "mean": mean, "high": high, "missing": values.size - finite.size}


def _flat(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, inner in value.items():
        if isinstance(inner, Mapping):
            yield from _flat(inner, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", inner if isinstance(inner, str) else json.dumps(inner, default=str)
