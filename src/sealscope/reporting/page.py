"""The page of a diagnosis: one HTML file that works offline, for the screen and on paper."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.machine_sizes import states_rig
from sealscope.errors import InputError
from sealscope.parameters import Rig, load_rig, rig_names
from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Recording
from sealscope.reporting import charts, features, messages, printing, template
from sealscope.reporting.charts import Mark
from sealscope.reporting.particulars import collect_particulars
from sealscope.reporting.schematic import build_circuit, channel_columns, schematic
from sealscope.signals.windows import WINDOW_SIZE, WINDOW_STEP

#: Width and height of a card (a picture that sums up a diagnosis), and height of the curve on it, in pixels.
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
    """Write the page of a diagnosis as one self-contained HTML file with charts, figures and findings.

    Parameters
    ----------
    recording : Recording
        The recording that was judged.
    path : str or path-like
        The page (.html, .htm, or .pdf, which a browser of Chromium's family or WeasyPrint prints), or its card (.png),
        a picture of 1200 x 630 pixels that a browser draws. The file is written atomically.
    diagnosis : Diagnosis, optional
        By default the result of `sealscope.diagnose` with the `rig`.
    rig : Rig, str or path-like, optional
        A Rig, the name of a packaged rig or the path of a TOML file; its values label the schematic.
    marks : sequence of Mark, optional
        Further moments that are marked on every chart.
    truth_onset_s, truth_leak_lpm : float, optional
        True onset [s] and leak [L/min], shown next to the verdict; a card has a mark at the onset alone.
    title : str, optional
        By default the name of the recording or, on a card, of its machine if that is known.
    pressure_unit : {"bar", "MPa", "kPa", "psi"}, optional
        By default the unit of the log, or bar if the log states none.

    Returns
    -------
    pathlib.Path
        The page.

    Raises
    ------
    InputError
        The recording is empty, the path has another suffix or cannot be written, or a unit or rig is not known.
    MissingExtra
        No program for making a PDF or a picture is installed.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(duration="20 s")
    >>> page = ss.report(recording, "report.html", ss.diagnose(recording))
    >>> page.read_text(encoding="utf-8")[:15]
    '<!DOCTYPE html>'
    """
    target = template.parse_page_path(path)
    if diagnosis is None:
        from sealscope.diagnosis.diagnose import diagnose

        diagnosis = diagnose(recording, rig=rig)
    options: dict[str, Any] = {"rig": rig, "marks": marks, "truth_onset_s": truth_onset_s, "title": title}
    if target.suffix.lower() == ".png":
        printing.draw_page(render_card(recording, diagnosis, **options), target, WIDTH, HEIGHT)
        return target
    page = render_page(recording, diagnosis, truth_leak_lpm=truth_leak_lpm, pressure_unit=pressure_unit, **options)
    return template.write(target, page)


def _choose_rig(diagnosis: Diagnosis, rig: Rig | str | os.PathLike[str] | None) -> Rig | None:
    """Choose the rig whose values the page shows: `rig`, else the packaged rig that the diagnosis names.

    The result is None if the rig is only assumed, or if the diagnosis names no packaged one.
    """
    if rig is not None:
        loaded_rig = load_rig(rig)
        return loaded_rig if states_rig(loaded_rig) else None
    machine = diagnosis.machine
    if machine is None or machine.stated_by == "nobody" or machine.rig not in rig_names():
        return None
    return load_rig(machine.rig)


def _all_marks(recording: Recording, marks: Sequence[Mark], truth_onset_s: float | None) -> list[Mark]:
    """Collect `marks` and the true onset [s], if stated; raise InputError if the recording is empty."""
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
    """Render the card, a picture of the diagnosis, as HTML of `WIDTH` x `HEIGHT` pixels, by arguments of `report`.

    `rig`: names the machine if the recording does not. Raises InputError if the recording is empty.
    """
    card_charts = charts.course_charts(diagnosis, height=_CURVE_HEIGHT)
    all_marks = _all_marks(recording, marks, truth_onset_s)
    particulars = collect_particulars(recording, _choose_rig(diagnosis, rig))
    name = Path(diagnosis.file).name
    subtitle = (name, particulars.get("Operator"), particulars.get("Oil temperature"))
    return template.render(
        "card.html.j2",
        d=diagnosis,
        messages=messages,
        title=title or particulars.get("Machine", name),
        date=particulars.get("Date", ""),
        subtitle=" · ".join(text for text in subtitle if text),
        charts=card_charts,
        drawn=charts.draw(recording, chambers=[], charts=card_charts, diagnosis=diagnosis, marks=all_marks),
        width=WIDTH,
        height=HEIGHT,
    )


@np.errstate(all="ignore")  # values that overflow are not drawn
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
    """Render the page of a diagnosis as HTML, with the arguments of `report`.

    Raises InputError if the recording is empty, or if the unit or the rig is not known.
    """
    from markupsafe import Markup

    pressure_unit = pressure_unit or recording.pressure_unit
    diagnosis = replace(diagnosis, pressure_unit=pressure_unit)
    known_rig, all_marks = _choose_rig(diagnosis, rig), _all_marks(recording, marks, truth_onset_s)
    details_and_notes = [features.chamber_details(recording, name) for name in CHAMBERS]
    chambers = [chamber for chamber, _ in details_and_notes if chamber is not None]
    page_charts = [
        *charts.course_charts(diagnosis),
        *charts.rms_charts(chambers, pressure_unit),
        *charts.channel_charts(recording, pressure_unit),
        *charts.detail_charts(chambers, pressure_unit),
    ]
    drawn = charts.draw(recording, chambers, page_charts, diagnosis, all_marks)
    circuit = build_circuit(known_rig, recording, diagnosis.machine)
    facts = f"{len(recording)} samples at {recording.rate:g} Hz, {messages.clock(recording.duration)}"
    return template.render(
        "page.html.j2",
        d=diagnosis,
        messages=messages,
        title=title or Path(diagnosis.file).name,
        subtitle=f"{diagnosis.file} · {facts}",
        particulars=collect_particulars(recording, known_rig),
        truth=(truth_onset_s, truth_leak_lpm),
        marks=all_marks,
        groups={group: [chart for chart in page_charts if chart.group == group] for group in charts.GROUPS},
        drawn=drawn,
        window=WINDOW_SIZE,
        step=WINDOW_STEP,
        notes=[note for _, note in details_and_notes if note],
        schematic=Markup(schematic(recording, diagnosis, circuit)),
        rig=known_rig,
        circuit=circuit,
        columns=channel_columns(recording),
        recording=recording,
        channels=[_summarise_channel(recording, name, pressure_unit) for name in recording.channels],
        provenance=list(_flatten(recording.provenance)),
        chart_data=drawn.data if page_charts else None,
        **_change_rows(recording, diagnosis, chambers, pressure_unit),
    )


def _change_rows(
    recording: Recording, diagnosis: Diagnosis, chambers: list[features.ChamberDetails], pressure_unit: str
) -> dict[str, Any]:
    """Build the template's values for the table that compares the RMS of wavelet details in two parts of the recording.

    They are `changes`, rows (channel, detail, unit, RMS in the first part, in the second, change [%]), with None for
    unknown numbers; `bar_limit`, the largest change [%] that the table's bars show; and the two `parts`.
    """
    parts = features.parts_to_compare(diagnosis, recording)
    rows: list[tuple[str, str, str, float | None, float | None, float | None]] = []
    for channel, name, *both_rms in features.changes(recording, chambers, parts):
        unit, scale = charts.detail_unit(recording.units[channel], name, pressure_unit)
        before, after = (None if rms is None else rms / scale for rms in both_rms)
        percent = 100 * (after - before) / before if before and after is not None else None  # None for a `before` of 0
        rows.append((channel, charts.detail_label(name), unit, before, after, percent))
    max_change = max([10.0, *(abs(percent) for *_, percent in rows if percent is not None)])  # at least 10 %
    bar_limit = min(100.0, 10.0 * ceil(max_change / 10.0))  # rounded up to tens of percent, at most 100 %
    return {"changes": rows, "bar_limit": bar_limit, "parts": parts}


def _summarise_channel(recording: Recording, name: str, pressure_unit: str) -> dict[str, Any]:
    """Compute minimum, mean and maximum (None without samples) of a channel for the page, and count missing samples."""
    unit, values = charts.display_values(recording, name, pressure_unit)
    finite = values[np.isfinite(values)]
    statistics = (np.min, np.mean, np.max)
    low, mean, high = (float(statistic(finite)) if finite.size else None for statistic in statistics)
    return {"name": name, "unit": unit, "low": low, "mean": mean, "high": high, "missing": values.size - finite.size}


def _flatten(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the entries of nested mappings as pairs (`prefix` + dotted name, text or JSON)."""
    for key, inner in value.items():
        if isinstance(inner, Mapping):
            yield from _flatten(inner, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", inner if isinstance(inner, str) else json.dumps(inner, default=str)
