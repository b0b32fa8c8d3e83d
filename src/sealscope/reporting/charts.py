"""Build the charts of the page: lines in display units, data for the page's script, and still pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.errors import InputError
from sealscope.recordings.recording import COUNTS, Array, Recording
from sealscope.reporting.features import ChamberDetails
from sealscope.reporting.picture import Picture, ticks
from sealscope.reporting.series import DrawnTimes, choose_drawn_times, encode_times, encode_values, ordered_time
from sealscope.signals.details import QUANTITIES
from sealscope.units import from_si, to_si

PRODUCT = QUANTITIES[-1]
SAMPLES = "samples"
#: Points of a series drawn by the script, and in the still picture.
POINTS, STILL_POINTS = 16_000, 800
#: Samples around the onset that are all drawn, so that the ringing is visible.
NEAR_SAMPLES = 6_000
#: Largest magnitude that is drawn; largest range of values that count as constant, absolute and over their magnitude.
_MAX_DRAWN, _MIN_EXTENT, _MIN_RELATIVE_EXTENT = 1e100, 1e-100, 1e-12
#: Unit of wavelet details, by the unit of the pressures.
_DETAIL_UNITS = {"bar": "kPa", "MPa": "kPa", "kPa": "kPa", "psi": "psi"}
#: Display unit of other channels, by their SI unit.
_DISPLAY_UNITS = {"m": "mm", "rad/s": "rpm", "m^3/s": "L/min"}


@dataclass(frozen=True)
class Mark:
    """A moment marked on every chart: `t` [s] on the recording's time axis, and its label.

    `known=True` marks a moment that is known independently of the diagnosis, such as the onset of a leak that was
    made on purpose; it is drawn in another style.
    """

    t: float
    label: str
    known: bool = False

    def __post_init__(self) -> None:
        """Raise InputError if the time of the mark is not finite."""
        if not isfinite(self.t):
            raise InputError(f"time of the mark {self.label!r} must be finite, got {self.t}")


class ChartLine(NamedTuple):
    """One line of a chart: label, name of the style in the style sheet, and values in the chart's unit."""

    label: str
    style: str
    values: Array


class Chart(NamedTuple):
    """One chart of the page.

    `group`: section of the page, one of `GROUPS`; `base`: name of the time axis: `SAMPLES` for the recording's samples,
    "windows-CHANNEL" for the centres of the RMS windows, or `COURSE` for the times of the leak's estimates; `height`:
    in pixels; `band`: True if the second and third line are the interval of the first; `limits`: ends of the y axis,
    None to show all values; `level`: repair limit in `unit`, None if there is none.
    """

    key: str
    group: str
    title: str
    unit: str
    lines: tuple[ChartLine, ...]
    base: str = SAMPLES
    height: int = 150
    band: bool = False
    limits: tuple[float, float] | None = None
    level: float | None = None

    @property
    def level_text(self) -> str:
        """Text of the repair limit (`level`) in the chart's legend, with a remark if it lies above the frame."""
        is_above = self.level is not None and self.limits is not None and self.level > self.limits[1]
        return f"repair limit, {self.level:.2g} {self.unit}" + (", above the frame" if is_above else "")

    @property
    def is_cut(self) -> bool:
        """True if some values lie outside the limits of the y axis."""
        low, high = self.limits or (-np.inf, np.inf)
        return any(bool(np.any((line.values < low) | (line.values > high))) for line in self.lines)


def display_values(
    recording: Recording, name: str, pressure_unit: str, values: Array | None = None
) -> tuple[str, Array]:
    """Convert a channel of a recording, or other `values` (n,) of it, to its display unit; return the unit and these.

    Pressures are shown in `pressure_unit`, other channels in the unit of the log or, if it has none, temperatures in
    degC and the others as `display_unit`.
    """
    si_unit, values = recording.units[name], recording[name] if values is None else values
    unit = None if si_unit in ("Pa", COUNTS) else recording.unit_in_log(name)
    if unit is not None or si_unit == "K":
        unit = unit or "degC"
        return unit, from_si(values, unit, si_unit)
    unit, scale = display_unit(si_unit, pressure_unit)
    return unit, values / scale


def display_unit(unit: str, pressure_unit: str) -> tuple[str, float]:
    """Choose the unit in which values in the SI unit `unit` are displayed; return this unit and its size in SI.

    Raises InputError for an unknown `pressure_unit`, the display unit of pressures.
    """
    if pressure_unit not in _DETAIL_UNITS:
        raise InputError(f"pressure unit must be one of {', '.join(_DETAIL_UNITS)}, got {pressure_unit!r}")
    if unit == COUNTS:
        return "counts", 1.0
    display = pressure_unit if unit == "Pa" else _DISPLAY_UNITS.get(unit, unit)
    return display, to_si(1.0, display, unit)


def detail_unit(unit: str, name: str, pressure_unit: str) -> tuple[str, float]:
    """Choose the display unit of the wavelet detail `name` of a channel in the SI unit `unit`, and its size in SI.

    For the product d3d4, both are squared.
    """
    # an unknown `pressure_unit` is passed on, since `display_unit` refuses it
    display, scale = display_unit(unit, _DETAIL_UNITS.get(pressure_unit, pressure_unit))
    return (f"{display}²", scale**2) if name == PRODUCT else (display, scale)


def detail_label(name: str) -> str:
    """Return the name by which a wavelet detail is displayed, such as "d3·d4" for "d3d4"."""
    return "d3·d4" if name == PRODUCT else name


def channel_charts(recording: Recording, pressure_unit: str) -> list[Chart]:
    """Build the charts of the channels in `_CHANNELS` that have finite values, one for each display unit of a row."""
    charts = []
    for key, title, height, members in _CHANNELS:
        lines_by_unit: dict[str, list[ChartLine]] = {}
        for name, style in zip(members, "ab", strict=False):  # "a", "b": styles of the first and second line
            if name in recording and np.isfinite(recording[name]).any():
                unit, values = display_values(recording, name, pressure_unit)
                lines_by_unit.setdefault(unit, []).append(ChartLine(name, style, values))
        for i, (unit, lines) in enumerate(lines_by_unit.items()):
            charts.append(Chart(f"{key}-{i}", "channels", title, unit, tuple(lines), height=height))
    return charts


#: Charts of channels: key, title, height [pixels] and the channels that share the chart.
_CHANNELS = (
    ("u", "Command", 140, ("u",)),
    ("x", "Piston position", 140, ("x",)),
    ("omega", "Motor speed", 140, ("omega",)),
    ("p_AB", "Chamber pressures", 210, ("p_A", "p_B")),
    ("p_12", "Pump port pressures", 140, ("p_1", "p_2")),
    ("q_leak", "Flow meter in the bypass", 140, ("q_leak",)),
    ("q_comp", "Leakage that the controller makes good", 140, ("q_comp",)),
)


def rms_charts(chambers: list[ChamberDetails], pressure_unit: str) -> list[Chart]:
    """Build the charts of the windowed RMS of wavelet details: d1 to d4 of each chamber, then d3d4 (d3 times d4)."""
    charts = []
    for names, quantity, suffix, height in (
        (QUANTITIES[:-1], "the details", "", 230),
        ((PRODUCT,), detail_label(PRODUCT), "-d3d4", 150),
    ):
        for chamber in chambers:
            if not chamber.window_t.size:
                continue
            channel = chamber.channel
            unit, scale = detail_unit(chamber.unit, names[0], pressure_unit)  # the same for all names of a chart
            lines = tuple(ChartLine(detail_label(name), name, chamber.window_rms[name] / scale) for name in names)
            title, base = f"RMS of {quantity} of {channel}", f"windows-{channel}"
            charts.append(Chart(f"rms-{channel}{suffix}", "rms", title, unit, lines, base=base, height=height))
    return charts


#: The leak over the recording, and the groups of charts in their order on the page.
COURSE = "course"
GROUPS = (COURSE, "rms", "channels", "details")
#: The axis is extended to the repair limit up to this multiple of its other upper end.
_MAX_LIMIT_RATIO = 4.0


def course_charts(diagnosis: Diagnosis, *, height: int = 190) -> list[Chart]:
    """Build the chart of the leak flow [L/min], or else of the total leakage, over time; [] if neither is known."""
    course = diagnosis.course
    if course is None or not np.isfinite(course.lpm).any():
        return []
    low, high = (np.where(np.isfinite(end), end, np.nan) for end in (course.low, course.high))
    # the interval is drawn as a band between its ends, whatever their style
    lines = (ChartLine("leak", "a", course.lpm), ChartLine("low", "d1", low), ChartLine("high", "d1", high))
    bottom, top = _y_limits(course.lpm, low, high)
    level = diagnosis.repair_lpm
    if level is not None and top < level < _MAX_LIMIT_RATIO * top:
        top = 1.06 * level  # 6 % margin above the limit
    title = "Passed by pump and piston together" if course.whole else "Leak past the piston"
    return [Chart(COURSE, COURSE, title, "L/min", lines, COURSE, height, band=True, limits=(bottom, top), level=level)]


def _y_limits(values: Array, low: Array, high: Array) -> tuple[float, float]:
    """Compute the limits of the y axis, which include zero, all estimates `values` and their intervals, with a margin.

    `low`, `high`: ends of the intervals, not finite if unknown. The lowest 10 % of the lower ends and the highest 10 %
    of the upper ends are ignored if they more than double the range, as they would flatten the curve.
    """
    required_values = [0.0, float(np.nanmin(values)), float(np.nanmax(values))]
    low_ends, high_ends = low[np.isfinite(low)], high[np.isfinite(high)]
    with_all = [*required_values, *low_ends, *high_ends]
    with_most = [*required_values]
    with_most += [np.quantile(low_ends, 0.1)] if low_ends.size else []
    with_most += [np.quantile(high_ends, 0.9)] if high_ends.size else []
    is_little_wider = max(with_all) - min(with_all) <= 2.0 * (max(with_most) - min(with_most))
    included_values = with_all if is_little_wider else with_most
    bottom, top = min(included_values), max(included_values)
    margin = 0.06 * (top - bottom) or 0.5  # 0.5 if all values are equal
    return float(bottom - margin), float(top + margin)


def detail_charts(chambers: list[ChamberDetails], pressure_unit: str) -> list[Chart]:
    """Build a chart for each wavelet detail of each chamber, ordered by detail."""
    charts = []
    for name in QUANTITIES:
        for chamber in chambers:
            unit, scale = detail_unit(chamber.unit, name, pressure_unit)
            style = "b" if chamber.channel == "p_B" else "a"
            line = ChartLine(detail_label(name), style, chamber.values[name] / scale)
            title = f"{detail_label(name)} of {chamber.channel}"
            charts.append(Chart(f"{name}-{chamber.channel}", "details", title, unit, (line,), height=130))
    return charts


#: A mark or interval on every chart: style, begin and end [s], None for a single moment.
Moment = tuple[str, float, float | None]


class DrawnCharts(NamedTuple):
    """All charts in the form that a page needs.

    `data`: plain JSON values for the script that draws the charts; `still`: by key of the chart, a still picture for
    readers without scripts; `base`: times [s] at which the channels are drawn; `span`: the first and the last of them;
    `fine` [s]: ends of the interval in which all samples are drawn.
    """

    data: dict[str, Any]
    still: dict[str, Picture]
    base: DrawnTimes
    span: tuple[float, float]
    fine: tuple[float, float]


def draw(
    recording: Recording,
    chambers: list[ChamberDetails],
    charts: list[Chart],
    diagnosis: Diagnosis,
    marks: Sequence[Mark],
) -> DrawnCharts:
    """Encode the lines of all charts for the script of the page, and draw a still picture of each chart.

    Long channels are reduced (`choose_drawn_times`), but not around the onset or, without one, around the recording's
    middle. `chambers`: for the times of their RMS windows; `marks`: moments to mark besides the onset.
    """
    t, _ = ordered_time(recording.t, recording.rate)  # the time axis of the charts
    middle = float(t[t.size // 2])
    near = diagnosis.onset_s if diagnosis.onset_s is not None and isfinite(diagnosis.onset_s) else middle
    base = choose_drawn_times(recording.t, recording.rate, POINTS, near=near, near_samples=NEAR_SAMPLES)
    still_base = choose_drawn_times(recording.t, recording.rate, STILL_POINTS)
    span = (float(base.t[0]), float(base.t[-1]))
    axes: dict[str, Array] = {SAMPLES: base.t}
    axes |= {f"windows-{chamber.channel}": chamber.window_t for chamber in chambers}
    if diagnosis.course is not None:
        axes[COURSE] = diagnosis.course.t
    onset, interval = _clip_onset(diagnosis, span)
    low, high = interval or (None, None)
    moments: list[Moment] = [] if interval is None else [("band", *interval)]
    moments += [] if onset is None else [("mark", onset, None)]
    moments += [(f"mark {'known' if mark.known else 'other'}", mark.t, None) for mark in marks]
    encoded_charts, still = [], {}
    for chart in charts:
        # larger finite values would make the scale of a chart overflow
        values_of_lines = [
            np.where(np.isfinite(line.values), np.clip(line.values, -_MAX_DRAWN, _MAX_DRAWN), line.values)
            for line in chart.lines
        ]
        still_t, still_values = axes[chart.base], values_of_lines
        if chart.base == SAMPLES:
            still_t, still_values = still_base.t, [still_base.reduce(values) for values in values_of_lines]
            values_of_lines = [base.reduce(values) for values in values_of_lines]
        pairs = zip(chart.lines, values_of_lines, strict=True)
        series = [{"label": line.label, "style": line.style, **encode_values(values)} for line, values in pairs]
        entries = {name: getattr(chart, name) for name in ("key", "title", "unit", "height", "band", "limits", "level")}
        encoded_charts.append({**entries, "axis": chart.base, "series": series})
        still[chart.key] = _render_still(chart, still_t, still_values, span, moments)
    data = {
        "span": span,
        "axes": {name: encode_times(t) for name, t in axes.items() if any(chart.base == name for chart in charts)},
        "onset": {"t": onset, "low": low, "high": high},
        "marks": [{"t": mark.t, "label": mark.label, "known": mark.known} for mark in marks],
        "charts": encoded_charts,
    }
    fine = (float(t[base.fine.start]), float(t[base.fine.stop - 1]))
    return DrawnCharts(data, still, base, span, fine)


def _clip_onset(diagnosis: Diagnosis, span: tuple[float, float]) -> tuple[float | None, tuple[float, float] | None]:
    """Return the finite onset of the leak [s], and its interval limited to the times `span` [s]; None if unknown."""
    onset, interval = diagnosis.onset_s, diagnosis.onset_interval_s
    if onset is None or not isfinite(onset):
        return None, None
    if interval is None or np.isnan(interval).any():
        return float(onset), None
    low, high = (float(np.clip(end, *span)) for end in interval)
    return float(onset), (low, high)


def _render_still(
    chart: Chart, t: Array, lines: list[Array], span: tuple[float, float], moments: Sequence[Moment]
) -> Picture:
    """Draw the still picture of a chart, 860 pixels wide and `chart.height` pixels high, shown where no script runs.

    `lines`: the values (n,) of `chart.lines` to draw at the times `t` (n,) [s]; `span` [s]: ends of the time axis.
    """
    all_values = np.concatenate(lines)
    finite = all_values[np.isfinite(all_values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    max_magnitude = max(abs(low), abs(high))
    if high - low <= max(_MIN_EXTENT, _MIN_RELATIVE_EXTENT * max_magnitude):  # all values are equal
        pad = max(0.5, 1e-6 * max_magnitude)
        low, high = low - pad, high + pad  # the axis needs a length
    margin = 0.04 * (high - low)
    low, high = chart.limits or (low - margin, high + margin)
    lines = [np.clip(line, low, high) for line in lines]  # values beyond the limits are drawn at the frame
    ends = (span[0], span[1] if span[1] > span[0] else span[0] + 1)  # [s], 1 s if the axis has no length
    # the margin below has room for the labels of the time axis
    picture = Picture(860.0, float(chart.height), ends, (low, high), margins=(0.0, 0.0, 0.0, 20.0))
    picture.frame(count=4)
    for value in ticks(*ends, count=8):
        picture.below(value, f"{value:g} s")
    for style, begin, end in moments:
        if end is None:
            picture.mark(style, begin)
        else:
            picture.box(style, begin, end)
    if chart.band:
        _value, low_end, high_end, *_ = lines  # the estimate, and the ends of its interval
        picture.area("interval", t, low_end, high_end)
    if chart.level is not None and chart.level <= high:
        picture.level("level", chart.level)
    drawn_lines = chart.lines[:1] if chart.band else chart.lines
    for chart_line, values in zip(drawn_lines, lines, strict=False):
        picture.line(f"line {chart_line.style}", t, values, chart_line.label, digits=0)
    return picture
