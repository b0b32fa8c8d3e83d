"""Charts of the page: what each shows, in which unit, as data for the script and as a still picture."""

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
from sealscope.reporting.series import DrawnTimes, coded, coded_times, ordered_time, time_base
from sealscope.signals.details import QUANTITIES
from sealscope.units import from_si, to_si

PRODUCT = QUANTITIES[-1]
SAMPLES = "samples"
#: points of a series drawn by the script, and in the still picture
POINTS, STILL_POINTS = 16_000, 800
#: samples drawn one by one round the onset, so that the ringing itself can be looked at
NEAR_SAMPLES = 6_000

#: largest value drawn; least extent of an axis, and over the size of its values: what is less is a constant
_LARGEST, _LEAST, _LEAST_SHARE = 1e100, 1e-100, 1e-12
#: unit of pressures -> unit of their details
_DETAIL_UNITS = {"bar": "kPa", "MPa": "kPa", "kPa": "kPa", "psi": "psi"}
#: SI unit of other channels -> unit shown
_SHOWN = {"m": "mm", "rad/s": "rpm", "m^3/s": "L/min"}


@dataclass(frozen=True)
class Mark:
    """A moment to see on every chart: `t` [s] on the recording's own time axis, and its label.

    `known=True` says that the moment is known from elsewhere (the leak was put in on purpose); it is drawn apart from
    the onset of the diagnosis. Raises InputError when `t` is not finite.
    """

    t: float
    label: str
    known: bool = False

    def __post_init__(self) -> None:
        if not isfinite(self.t):
            raise InputError(f"time of the mark {self.label!r} must be finite, got {self.t}")


class ChartLine(NamedTuple):
    """One line of a chart: its label, the style's name in the style sheet, and its values in the chart's unit."""

    label: str
    style: str
    values: Array


class Chart(NamedTuple):
    """One chart.

    `base`: the time axis of its lines (all samples, the centres of the RMS windows, or the instants of the leak's
    course); `band`: whether the second and third lines are the ends of the first one's interval; `limits`: the least
    and greatest value shown, None where every value is.
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
        """The level in the key of the chart, with a remark if it lies above the frame."""
        above = self.level is not None and self.limits is not None and self.level > self.limits[1]
        return f"repair limit, {self.level:.2g} {self.unit}" + (", above the frame" if above else "")

    @property
    def is_cut(self) -> bool:
        """Test whether any values lie beyond the limits."""
        low, high = self.limits or (-np.inf, np.inf)
        return any(bool(np.any((line.values < low) | (line.values > high))) for line in self.lines)


def shown_values(recording: Recording, name: str, pressure_unit: str) -> tuple[str, Array]:
    """Return the display unit of a channel and its values (n,) in it; all but pressures keep the unit of their log."""
    si_unit = recording.units[name]
    unit = None if si_unit in ("Pa", COUNTS) else recording.unit_in_log(name)
    if unit is not None or si_unit == "K":
        unit = unit or "degC"
        return unit, from_si(recording[name], unit, si_unit)
    shown, size = shown_unit(si_unit, pressure_unit)
    return shown, recording[name] / size


def shown_unit(unit: str, pressure_unit: str, *, detail: bool = False) -> tuple[str, float]:
    """Return the display unit of a channel and its size in the channel's own unit.

    Raises InputError for an unknown pressure unit.
    """
    if pressure_unit not in _DETAIL_UNITS:
        raise InputError(f"pressure unit must be one of {', '.join(_DETAIL_UNITS)}, got {pressure_unit!r}")
    if unit == COUNTS:
        return "counts", 1.0
    pressure = _DETAIL_UNITS[pressure_unit] if detail else pressure_unit
    shown = pressure if unit == "Pa" else _SHOWN.get(unit, unit)
    return shown, to_si(1.0, shown, unit)


def detail_unit(unit: str, name: str, pressure_unit: str) -> tuple[str, float]:
    """Return the unit in which a detail of a channel is shown (squared for d3d4), and its size in the channel's own."""
    shown, size = shown_unit(unit, pressure_unit, detail=True)
    return (f"{shown}²", size**2) if name == PRODUCT else (shown, size)


def label_of(name: str) -> str:
    """Return the displayed name of a detail."""
    return "d3·d4" if name == PRODUCT else name


def channel_charts(recording: Recording, pressure_unit: str) -> list[Chart]:
    """Return the charts of the channels that have samples, those of one kind and unit together."""
    charts = []
    for key, title, height, members in _CHANNELS:
        units: dict[str, list[ChartLine]] = {}
        for name, style in zip(members, "ab", strict=False):
            if name in recording and np.isfinite(recording[name]).any():
                unit, values = shown_values(recording, name, pressure_unit)
                units.setdefault(unit, []).append(ChartLine(name, style, values))
        for i, (unit, lines) in enumerate(units.items()):
            charts.append(Chart(f"{key}-{i}", "channels", title, unit, tuple(lines), height=height))
    return charts


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
    """Return the charts of the windowed RMS: d1..d4 of each chamber, then d3d4 of each."""
    charts = []
    for names, quantity, key, height in (
        (QUANTITIES[:-1], "the details", "", 230),
        ((PRODUCT,), label_of(PRODUCT), "-d3d4", 150),
    ):
        for chamber in chambers:
            if not chamber.window_t.size:
                continue
            channel = chamber.channel
            unit, size = detail_unit(chamber.unit, names[0], pressure_unit)
            lines = tuple(ChartLine(label_of(name), name, chamber.window_rms[name] / size) for name in names)
            title = f"RMS of {quantity} of {channel}"
            charts.append(Chart(f"rms-{channel}{key}", "rms", title, unit, lines, f"windows-{channel}", height))
    return charts


#: The leak over the recording, and the groups of charts in their order on the page.
COURSE = "course"
GROUPS = (COURSE, "rms", "channels", "details")
#: The repair limit is drawn inside the frame up to this many times what else is shown.
_LEVEL_SHOWN = 4.0


def course_charts(diagnosis: Diagnosis, *, height: int = 190) -> list[Chart]:
    """Return the chart of the leak over the recording with its interval and the repair limit, where it is known."""
    course = diagnosis.course
    if course is None or not np.isfinite(course.lpm).any():
        return []
    low, high = (np.where(np.isfinite(end), end, np.nan) for end in (course.low, course.high))
    lines = (ChartLine("leak", "a", course.lpm), ChartLine("low", "d1", low), ChartLine("high", "d1", high))
    bottom, top = _limits(course.lpm, low, high)
    level = diagnosis.repair_lpm
    if level is not None and top < level < _LEVEL_SHOWN * top:
        top = 1.06 * level
    title = "Passed by pump and piston together" if course.whole else "Leak past the piston"
    return [Chart(COURSE, COURSE, title, "L/min", lines, COURSE, height, True, (bottom, top), level)]


def _limits(values: Array, low: Array, high: Array) -> tuple[float, float]:
    """Return the least and greatest value to show: zero, every estimate and every interval.

    Where that is more than twice as far as zero, the estimates and 9 in 10 ends of the intervals, it is those: a single
    wide interval would press the curve flat.
    """
    always = [0.0, float(np.nanmin(values)), float(np.nanmax(values))]
    ends = [(end[np.isfinite(end)], least) for end, least in ((low, True), (high, False)) if np.any(np.isfinite(end))]
    whole = [*always, *(float(end.min() if least else end.max()) for end, least in ends)]
    most = [*always, *(float(np.quantile(end, 0.1 if least else 0.9)) for end, least in ends)]
    shown = whole if max(whole) - min(whole) <= 2.0 * (max(most) - min(most)) else most
    margin = 0.06 * (max(shown) - min(shown)) or 0.5
    return min(shown) - margin, max(shown) + margin


def detail_charts(chambers: list[ChamberDetails], pressure_unit: str) -> list[Chart]:
    """Return the charts of the details themselves, one each, the chambers side by side."""
    charts = []
    for d in QUANTITIES:
        for chamber in chambers:
            unit, size = detail_unit(chamber.unit, d, pressure_unit)
            style = "b" if chamber.channel == "p_B" else "a"
            line = ChartLine(label_of(d), style, chamber.values[d] / size)
            title = f"{label_of(d)} of {chamber.channel}"
            charts.append(Chart(f"{d}-{chamber.channel}", "details", title, unit, (line,), height=130))
    return charts


#: What stands on every chart: its style, when it begins and when it ends [s], None for an instant.
Moment = tuple[str, float, float | None]


class DrawnCharts(NamedTuple):
    """All charts as a page shows them.

    `data`: for the script (plain JSON values); `still`: by chart key, for the template; `base`: times at which the
    channels are drawn; `span`: their ends [s]; `fine`: ends of the stretch whose samples are drawn one by one [s].
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
    """Decimate and code every chart's lines, and lay out the still picture of each.

    Peaks are kept: each bucket contributes its least and its greatest sample.
    """
    middle = float(recording.t[len(recording) // 2])
    near = diagnosis.onset_s if diagnosis.onset_s is not None and isfinite(diagnosis.onset_s) else middle
    base = time_base(recording.t, recording.rate, POINTS, near=near, near_samples=NEAR_SAMPLES)
    few = time_base(recording.t, recording.rate, STILL_POINTS)
    span = (float(base.t[0]), float(base.t[-1]))
    axes: dict[str, Array] = {SAMPLES: base.t} | {f"windows-{c.channel}": c.window_t for c in chambers}
    if diagnosis.course is not None:
        axes[COURSE] = diagnosis.course.t
    onset, interval = _onset_within(diagnosis, span)
    low, high = interval or (None, None)
    moments: list[Moment] = [] if interval is None else [("band", *interval)]
    moments += [] if onset is None else [("mark", onset, None)]
    moments += [(f"mark {'known' if mark.known else 'other'}", mark.t, None) for mark in marks]
    coded_charts, still = [], {}
    for chart in charts:
        lines = [_drawable(line.values) for line in chart.lines]
        t, points = axes[chart.base], lines
        if chart.base == SAMPLES:
            t, points, lines = few.t, [few.reduce(line) for line in lines], [base.reduce(line) for line in lines]
        named = zip(chart.lines, lines, strict=True)
        series = [{"label": line.label, "style": line.style, **coded(values)} for line, values in named]
        shown = {name: getattr(chart, name) for name in ("key", "title", "unit", "height", "band", "limits", "level")}
        coded_charts.append({**shown, "axis": chart.base, "series": series})
        still[chart.key] = still_chart(chart, t, points, span, moments)
    data = {
        "span": span,
        "axes": {name: coded_times(t) for name, t in axes.items() if any(chart.base == name for chart in charts)},
        "onset": {"t": onset, "low": low, "high": high},
        "marks": [{"t": mark.t, "label": mark.label, "known": mark.known} for mark in marks],
        "charts": coded_charts,
    }
    t = ordered_time(recording.t, recording.rate)[0]
    return DrawnCharts(data, still, base, span, (float(t[base.fine.start]), float(t[base.fine.stop - 1])))


def _drawable(values: Array) -> Array:
    """Clip values to +-1e100, so that no scale overflows."""
    return np.where(np.isfinite(values), np.clip(values, -_LARGEST, _LARGEST), values)


def _onset_within(diagnosis: Diagnosis, span: tuple[float, float]) -> tuple[float | None, tuple[float, float] | None]:
    """Return the onset and its interval [s] as drawn: an end outside the recording, or unbounded, is cut."""
    onset, interval = diagnosis.onset_s, diagnosis.onset_interval_s
    if onset is None or not isfinite(onset):
        return None, None
    if interval is None or np.isnan(interval).any():
        return float(onset), None
    low, high = (float(np.clip(end, *span)) for end in interval)
    return float(onset), (low, high)


def still_chart(
    chart: Chart, t: Array, lines: list[Array], span: tuple[float, float], moments: Sequence[Moment] = ()
) -> Picture:
    """Return the still picture of a chart, in a frame 860 wide and `chart.height` high."""
    lines = [_drawable(line) for line in lines]
    stacked = np.concatenate(lines)
    finite = stacked[np.isfinite(stacked)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    size = max(abs(low), abs(high))
    if high - low <= max(_LEAST, _LEAST_SHARE * size):
        pad = max(0.5, 1e-6 * size)
        low, high = low - pad, high + pad
    margin = 0.04 * (high - low)
    low, high = chart.limits or (low - margin, high + margin)
    lines = [np.clip(line, low, high) for line in lines]
    ends = (span[0], span[1] if span[1] > span[0] else span[0] + 1)
    picture = Picture(860.0, float(chart.height), ends, (low, high), margins=(0.0, 0.0, 0.0, 20.0))
    picture.frame(4)
    for value in ticks(*ends, 8):
        picture.below(value, f"{value:g} s")
    for style, begin, end in moments:
        if end is None:
            picture.mark(style, begin)
        else:
            picture.box(style, begin, end)
    if chart.band:
        picture.area("interval", t, *lines[1:3])
    if chart.level is not None and chart.level <= high:
        picture.level("level", chart.level)
    for line_style, line in zip(chart.lines[: 1 if chart.band else None], lines, strict=False):
        picture.line(f"line {line_style.style}", t, line, line_style.label, digits=0)
    return picture
