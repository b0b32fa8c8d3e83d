"""The page of one diagnosis: one HTML file that works offline, for the screen and on paper."""

from __future__ import annotations

import json
import os
import tempfile
from base64 import b64encode
from collections.abc import Mapping, Sequence
from hashlib import sha256
from importlib import metadata, resources
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.errors import InputError
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Recording
from sealscope.reporting import charts, features, messages
from sealscope.reporting.contract import Mark
from sealscope.reporting.schematic import schematic_context

__all__ = ["Mark", "render_page", "write_page"]


def render_page(
    recording: Recording,
    diagnosis: Diagnosis,
    *,
    rig: Any | None = None,
    marks: Sequence[Mark] = (),
    truth_onset_s: float | None = None,
    truth_leak_lpm: float | None = None,
    title: str | None = None,
    pressure_unit: str = "bar",
) -> str:
    """The page as a string of HTML with nothing outside it.

    `rig`: parameters whose key values label the schematic (attributes as a Rig has them); `marks`: further moments on
    every chart; `truth_onset_s` [s], `truth_leak_lpm` [L/min]: what the caller knows to be true, shown beside the
    finding; `pressure_unit`: "bar", "MPa", "kPa" or "psi".

    Raises InputError for an empty recording, an unknown pressure unit or a mark that is not a finite time.
    """
    if len(recording) == 0:
        raise InputError("recording must have at least 1 sample to be reported, got 0")
    import jinja2
    from markupsafe import Markup

    all_marks = list(marks)
    if truth_onset_s is not None:
        all_marks.append(Mark(float(truth_onset_s), "true onset", known=True))
    found = [features.chamber_details(recording, name) for name in CHAMBERS]
    chambers = [chamber for chamber, _ in found if chamber is not None]
    shown = [
        *charts.course_charts(diagnosis.course),
        *charts.rms_charts(chambers, pressure_unit),
        *charts.channel_charts(recording, pressure_unit),
        *charts.detail_charts(chambers, pressure_unit),
    ]
    drawing = charts.draw(recording, chambers, shown, diagnosis, all_marks)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sealscope.reporting"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=False,
    )
    uplot_js, charts_js = _packaged("vendor/uPlot.iife.min.js"), _packaged("templates/charts.js")
    schematic = environment.get_template("schematic.svg.j2").render(schematic_context(recording, diagnosis, rig))
    return environment.get_template("page.html.j2").render(
        **_verdict(diagnosis, all_marks, truth_onset_s, truth_leak_lpm),
        **_evidence(recording, diagnosis, drawing, shown, all_marks),
        **_numbers(recording, diagnosis, chambers, pressure_unit),
        title=title or Path(diagnosis.file).name,
        subtitle=_subtitle(recording, diagnosis),
        notes=[note for _, note in found if note],
        schematic=Markup(schematic),
        schematic_note=_schematic_note(rig),
        recording=recording,
        version=_version(),
        uplot_license=_packaged("vendor/uPlot.LICENSE"),
        uplot_css=Markup(_packaged("vendor/uPlot.min.css")),
        page_css=Markup(_packaged("templates/page.css")),
        uplot_js=Markup(uplot_js),
        charts_js=Markup(charts_js),
        script_hashes=Markup(" ".join(_hash(code) for code in (uplot_js, charts_js))),
        chart_data=Markup(_script_json(drawing.data)),
    )


def write_page(path: str | os.PathLike[str], recording: Recording, diagnosis: Diagnosis, **options: Any) -> Path:
    """Write `render_page(recording, diagnosis, **options)` to `path` (UTF-8) and return it.

    The page is complete under its name or not there at all. Raises InputError where the folder cannot be written.
    """
    target = Path(path)
    text = render_page(recording, diagnosis, **options)
    temporary: Path | None = None
    try:
        with tempfile.NamedTemporaryFile(
            "w",
            encoding="utf-8",
            newline="\n",
            dir=target.parent,
            prefix=".page-",
            suffix=".part",
            delete=False,
        ) as file:
            temporary = Path(file.name)
            file.write(text)
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(target)
    except OSError as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        raise InputError(f"page must go to a folder that can be written, got: {error.strerror} ({target})") from None
    except BaseException:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        raise
    return target


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _packaged(name: str) -> str:
    return (resources.files("sealscope.reporting") / name).read_text(encoding="utf-8")


def _hash(code: str) -> str:
    return f"'sha256-{b64encode(sha256(code.encode()).digest()).decode()}'"


def _script_json(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _version() -> str:
    try:
        return metadata.version("sealscope")
    except metadata.PackageNotFoundError:
        return "(not installed)"


def _subtitle(recording: Recording, diagnosis: Diagnosis) -> str:
    facts = f"{len(recording)} samples at {recording.rate:g} Hz, {messages.clock(recording.duration)}"
    return f"{diagnosis.file} · {facts}"


def _schematic_note(rig: Any | None) -> str:
    if rig is None:
        return (
            "The reference circuit of a pump-controlled actuator. The parameters of this machine were not given, "
            "and its circuit may differ."
        )
    name = getattr(rig, "title", None) or getattr(rig, "name", None)
    return f"Values: {name}." if name else "Values of the rig whose parameters were given."


def _verdict(
    diagnosis: Diagnosis, marks: list[Mark], truth_onset_s: float | None, truth_leak_lpm: float | None
) -> dict[str, Any]:
    known = []
    if truth_onset_s is not None:
        known.append(f"the leak begins at {messages.clock(truth_onset_s)}")
        if diagnosis.onset_s is not None:
            late = diagnosis.onset_s - truth_onset_s
            known.append(f"the onset found is {abs(late):.1f} s {'late' if late >= 0 else 'early'}")
    if truth_leak_lpm is not None:
        known.append(f"the leak is {messages.number(truth_leak_lpm)} L/min on average")
    count = len(diagnosis.quality)
    worst = [s for s in ("fatal", "warning") if any(f.severity == s for f in diagnosis.quality)]
    return {
        "d": diagnosis,
        "headline": messages.headline(diagnosis),
        "since": messages.since(diagnosis),
        "how_much": messages.how_much(diagnosis),
        "cause": messages.cause(diagnosis),
        "how_sure": messages.how_sure(diagnosis),
        "threshold_note": messages.false_alarms(diagnosis),
        "quality_summary": f"{count} finding{'s' if count != 1 else ''}{f' ({worst[0]})' if worst else ''},",
        "known": "; ".join(known),
        "steps": messages.next_steps(diagnosis),
        "marks": marks,
        "clock": messages.clock,
        "n": messages.number,
    }


def _evidence(
    recording: Recording,
    diagnosis: Diagnosis,
    drawing: charts.Drawing,
    shown: list[charts.Chart],
    marks: list[Mark],
) -> dict[str, Any]:
    base, span = drawing.base, drawing.data["span"]
    onset, interval = charts.onset_within(diagnosis, span)
    fine = base.fine

    def base_t(sample: int) -> float:
        return float(sample / recording.rate if base.by_sample else recording.t[sample])

    if base.width == 1:
        decimation = "Every sample is drawn."
    else:
        first, last = base_t(fine.start), base_t(fine.stop - 1)
        decimation = (
            f"Of each {base.width} samples in turn ({1000 * base.width / recording.rate:.3g} ms) the least and the "
            f"greatest are drawn, so every peak is kept; from {first:.1f} s to {last:.1f} s every sample is drawn. "
            "Values are rounded to 1/65 534 of their range. The verdict and all numbers rest on every sample."
        )
    if base.by_sample:
        decimation += " The time stamps are out of order: time is drawn as the sample's number over the rate."
    events: list[dict[str, Any]] = []
    if interval is not None:
        events.append({"t": interval[0], "width": interval[1] - interval[0], "kind": ""})
    if onset is not None:
        events.append({"t": onset, "width": None, "kind": ""})
    events += [{"t": mark.t, "width": None, "kind": "known" if mark.known else "other"} for mark in marks]

    def around(seconds: float) -> tuple[float, float] | None:
        return None if onset is None else (max(span[0], onset - seconds), min(span[1], onset + seconds))

    close = (base_t(fine.start), base_t(fine.stop - 1)) if base.width > 1 else around(2.0)

    groups = {group: [c for c in shown if c.group == group] for group in (charts.COURSE, "rms", "channels", "details")}
    line_key = ["p_A, p_1 dark and p_B, p_2 light"] if any(len(c.series) == 2 for c in shown) else []
    if groups["rms"]:
        line_key.append("d1 thin light, d2 dashed, d3 thick, d4 dotted")
    return {
        "charts": shown,
        "groups": groups,
        "still": drawing.still,
        "events": events,
        "span": span,
        "around": around(20.0),
        "close": close,
        "decimation": decimation,
        "line_key": line_key,
        "window": features.WINDOW,
        "step": features.STEP,
    }


def _numbers(
    recording: Recording, diagnosis: Diagnosis, chambers: list[features.ChamberDetails], pressure_unit: str
) -> dict[str, Any]:
    parts = features.parts_to_compare(diagnosis, recording)
    rows: list[dict[str, Any]] = []
    for change in features.changes(recording, chambers, parts):
        unit, size = charts.shown_unit(recording.units[change.channel], pressure_unit, detail=True)
        product = change.name == features.PRODUCT
        size = size**2 if product else size
        percent = change.percent
        rows.append(
            {
                "channel": change.channel,
                "label": "d3·d4" if product else change.name,
                "unit": f"{unit}²" if product else unit,
                "before": None if change.before is None else change.before / size,
                "after": None if change.after is None else change.after / size,
                "percent": percent,
                "percent_text": _signed_percent(percent),
            }
        )
    limit = max([10.0, *(abs(row["percent"]) for row in rows if row["percent"] is not None)])
    limit = min(100.0, float(np.ceil(limit / 10) * 10))
    for row in rows:
        row["bar"] = _bar(row["percent"], limit)
    return {
        "changes": rows,
        "bar_limit": f"{limit:g}",
        "parts": parts,
        "recording_note": f"{_subtitle(recording, diagnosis)}. Units as shown on this page.",
        "channels": [_summary(recording, name, pressure_unit) for name in recording.channels],
        "provenance": list(_flat(recording.provenance)),
    }


def _signed_percent(percent: float | None) -> str:
    return messages.ABSENT if percent is None else f"{round(percent, 1) + 0.0:+.1f} %".replace("-", "−")


def _bar(percent: float | None, limit: float) -> dict[str, Any] | None:
    if percent is None:
        return None
    half = 50 * min(1.0, abs(percent) / limit)
    down = percent < 0
    return {"way": "down" if down else "up", "left": f"{50 - half if down else 50:.1f}", "width": f"{half:.1f}"}


def _summary(recording: Recording, name: str, pressure_unit: str) -> dict[str, Any]:
    values = recording[name]
    finite = values[np.isfinite(values)]
    unit, size = charts.shown_unit(recording.units[name], pressure_unit)
    low, mean, high = (float(f(finite)) / size if finite.size else None for f in (np.min, np.mean, np.max))
    return {"name": name, "unit": unit, "low": low, "mean": mean, "high": high, "missing": values.size - finite.size}


def _flat(value: Mapping[str, Any], prefix: str = "") -> Any:
    for key, inner in value.items():
        if isinstance(inner, Mapping):
            yield from _flat(inner, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", inner if isinstance(inner, str) else json.dumps(inner, default=str)
