"""Pictures that show whether the channels of a recording are what they are called.

Each check states in one sentence what its curves show: the force of the chambers over the position, the speed of the
piston over that of the pump, the speed at rest, the misfit of both speeds for other delays, and the volumes that must
close. They compare what is recorded, and decide nothing. Called by the workbench, which draws them.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.assumed_rig import assumed_rig
from sealscope.diagnosis.flow_curves import FlowCurves
from sealscope.diagnosis.inference.equations.terms import Signals
from sealscope.diagnosis.inference.machine_states import find_rests
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.parameters import Rig
from sealscope.recordings.channels import flow_source
from sealscope.recordings.corrections.gaps import order_recording, resample_evenly
from sealscope.recordings.corrections.unsigned import is_one_sided
from sealscope.recordings.quality import Severity
from sealscope.recordings.recording import Array, Recording
from sealscope.units import BAR, LITRE_PER_MINUTE

#: Most points of a cloud, bins of the position, and shifts on each side.
_MAX_POINTS, _BINS, _SHIFTS = 900, 30, 60
#: Longest shift of the position that is drawn [s], and most samples of the comparison.
_MAX_SHIFT, _MAX_SAMPLES = 0.3, 200_000
#: Source of the flow -> its unit in figures, and that unit in SI.
_FLOW_UNITS = {
    "omega": ("rpm", np.pi / 30.0),
    "theta": ("rpm", np.pi / 30.0),
    "u": ("V", 1.0),
    "q_pump": ("L/min", LITRE_PER_MINUTE),
    "q_supply": ("L/min", LITRE_PER_MINUTE),
}
_RPM_OF = {"theta": "pump speed from theta", "omega": "pump speed omega", "u": "command u"}


class CheckCurve(NamedTuple):
    """A curve, or with `is_cloud` a cloud of points, of a check: coordinates x and y (k,) in the check's units."""

    name: str
    x: Array
    y: Array
    is_cloud: bool = False


class ChannelCheck(NamedTuple):
    """Comparison of recorded channels with each other.

    Parameters
    ----------
    name : {"load", "speed", "rest", "delay"}
        Which of the checks it is.
    title : str
        What must be seen if all channels are right.
    text : str
        What is seen, in one sentence.
    severity : {"", "note", "warning"}
        "warning" if a channel is likely not what it is called.
    x, y : str
        Labels of the axes, with units.
    curves : tuple of CheckCurve
        What is drawn; empty if the recording does not show it.
    mark : float, optional
        Place on the axis x that the text names.
    """

    name: str
    title: str
    text: str
    severity: Severity | Literal[""]
    x: str
    y: str
    curves: tuple[CheckCurve, ...]
    mark: float | None = None


def check_channels(
    recording: Recording, rig: Rig | None = None, flows: FlowCurves | None = None
) -> tuple[ChannelCheck, ...]:
    """Compare the channels of a recording with each other: load, speed, zero at rest, and delay.

    `rig` states the machine's sizes, as for `sealscope.diagnose`; `flows`: the balance of volumes, which measures the
    delay, if it is known. A check is missing if the channels that it needs are.
    """
    inspection = inspect_recording(recording)
    part, checks = inspection.part, list[ChannelCheck]()
    unsigned = {finding.channel: finding for finding in inspection.findings if finding.code == "unsigned_speed"}
    with np.errstate(all="ignore"):
        if {"x", "p_A", "p_B"} <= part.channels.keys() and len(part) > 2 * _BINS:
            checks.append(_check_load(part, rig))
        evenly = resample_evenly(order_recording(recording).recording)
        source = flow_source(evenly.channels)
        if source is not None and "x" in evenly and len(evenly) > 2 * _BINS:
            problem = unsigned[source].text if source in unsigned else ""
            checks += [_check_speed(evenly, source, rig, problem), _check_rest(evenly, source)]
            restored = flow_source(part.channels)
            if restored is not None and "x" in part:
                checks.append(_check_delay(part, restored, flows))
    return tuple(checks)


def _flow(recording: Recording, source: str) -> tuple[Array, str]:
    """Compute the channel that tells the flow (n,), in the unit of figures, with the averaging of the piston speed."""
    unit, size = _FLOW_UNITS[source]
    if source == "theta":
        return Signals({"x": recording["theta"]}, recording.rate).speed / size, unit
    values = recording[source]
    return (values if recording.units[source] in ("V", "count") else values / size), unit


def _piston_speed(recording: Recording) -> Array:
    return Signals({"x": recording["x"]}, recording.rate).speed


def _make_cloud(name: str, x: Array, y: Array) -> CheckCurve:
    """Make a cloud of points from columns (n,), thinned evenly, without missing ones."""
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    rows = known[np.unique(np.linspace(0, max(known.size - 1, 0), min(known.size, _MAX_POINTS)).astype(int))]
    return CheckCurve(name, x[rows], y[rows], is_cloud=True)


def _find_rests(recording: Recording) -> NDArray[np.bool_]:
    """Flag the samples (n,) at which the piston rests."""
    steps = np.diff(recording["x"])
    rests = find_rests(steps, recording.rate)
    return np.append(rests, rests[-1:])


def _check_load(recording: Recording, rig: Rig | None) -> ChannelCheck:
    """Compare the force of the chambers while the piston moves out and in, over its position.

    Over closed strokes the cylinder gives work to friction: at each position it must push harder on the way out than on
    the way in. Swapped chambers, or a position with the wrong sign, turn this round; a zero error shifts both curves.
    """
    stated, machine = assumed_rig(rig, recording)
    title = "Load: the force on the way out must lie above that on the way in"
    if machine.area_stated:
        areas, unit, size = (stated.cylinder.A_A, stated.cylinder.A_B), "p_A A_A − p_B A_B [kN]", 1e3
    else:
        areas, unit, size = (1.0, 1.0), "p_A − p_B [bar]", BAR
    force, x = (areas[0] * recording["p_A"] - areas[1] * recording["p_B"]) / size, 1e3 * recording["x"]
    moves, speed = ~_find_rests(recording), _piston_speed(recording)
    edges = np.linspace(np.nanmin(x), np.nanmax(x), _BINS + 1)
    middle, curves, means = 0.5 * (edges[1:] + edges[:-1]), list[CheckCurve](), list[Array]()
    for name, is_direction in (("out", speed > 0.0), ("in", speed < 0.0)):
        rows = np.flatnonzero(moves & is_direction & np.isfinite(force) & np.isfinite(x))
        curves.append(_make_cloud(name, x[rows], force[rows]))
        bins = np.clip(np.searchsorted(edges, x[rows]) - 1, 0, _BINS - 1)
        counts = np.bincount(bins, minlength=_BINS)
        means.append(np.where(counts > 0, np.bincount(bins, force[rows], _BINS) / counts, np.nan))
        curves.append(CheckCurve(f"mean {name}", middle, means[-1]))
    wider = (means[0] - means[1])[np.isfinite(means[0] - means[1])]
    labels = ("position x [mm]", unit, tuple(curves))
    if wider.size < 3:
        return ChannelCheck("load", title, "Load: the piston does not pass one way twice.", "", *labels)
    mean, error = float(wider.mean()), float(wider.std(ddof=1) / np.sqrt(wider.size))
    word = unit.rsplit("[", 1)[1][:-1]
    text = f"Load: the force out is {abs(mean):.2g} {word} {'above' if mean > 0.0 else 'below'} that in"
    if mean < -2.0 * error:
        text += ": p_A and p_B are swapped, or the sign of x is wrong, as friction would drive the piston"
        return ChannelCheck("load", title, f"{text}.", "warning", *labels)
    return ChannelCheck("load", title, f"{text}, twice the friction.", "", *labels)


def _check_speed(recording: Recording, source: str, rig: Rig | None, problem: str) -> ChannelCheck:
    """Compare the piston's speed with that of the pump: a line through zero, a V for a speed without a sign.

    If area and displacement are stated, their ratio gives the slope.
    """
    flow, unit = _flow(recording, source)
    speed = 1e3 * _piston_speed(recording)
    title = "Speed: one line through zero; a V has no sign, a loop is a delay"
    known = np.isfinite(flow) & np.isfinite(speed)
    slope = float(flow[known] @ speed[known]) / max(float(flow[known] @ flow[known]), np.finfo(float).tiny)
    ends = np.array([np.nanmin(flow), 0.0, np.nanmax(flow)])
    curves = [_make_cloud("samples", flow, speed), CheckCurve("proportional", ends, slope * ends)]
    stated, machine = assumed_rig(rig, recording)
    if unit == "rpm" and machine.area_stated and machine.displacement_stated:
        sides = {"A": stated.cylinder.A_A, "B": stated.cylinder.A_B}
        for side in "A" if sides["A"] == sides["B"] else "AB":  # the loaded side of a single rod counts
            expected = np.sign(slope) * 1e3 * stated.pump.q_b / 60.0 / sides[side]
            curves.append(CheckCurve(f"by the stated area {side}", ends, expected * ends))
    labels = (f"{_RPM_OF.get(source, f'flow {source}')} [{unit}]", "piston speed [mm/s]", tuple(curves))
    if problem or (is_one_sided(ends[0], ends[2]) and not is_one_sided(np.nanmin(speed), np.nanmax(speed))):
        text = problem or f"{source}: never changes its sign, and the piston does"
        return ChannelCheck("speed", title, f"Speed without a sign: {text}.", "warning", *labels)
    explained = float(np.corrcoef(flow[known], speed[known])[0, 1])
    # the flow at which the piston stands, by the line of least squares of the flow over the speed
    zero = float(np.polyfit(speed[known], flow[known], 1)[1]) if np.ptp(speed[known]) > 0.0 else float("nan")
    text = f"Speed: {source} and the speed of x have a correlation of {explained:.3f}; x moves "
    text += f"{'out' if slope > 0.0 else 'in'} for positive {source}, which is {zero:.2g} {unit} where x stands."
    return ChannelCheck("speed", title, text, "", *labels)


def _check_rest(recording: Recording, source: str) -> ChannelCheck:
    """Show the pump's speed while the piston rests: a zero error, or the leakage that the pump makes good."""
    flow, unit = _flow(recording, source)
    rests = _find_rests(recording)
    title = "Zero at rest: near zero, but for the leakage that is made good"
    labels = ("time [s]", f"{_RPM_OF.get(source, f'flow {source}')} at rest [{unit}]")
    if not rests.any():
        text = "Zero at rest: the piston never rests, so that no zero is seen."
        return ChannelCheck("rest", title, text, "", *labels, ())
    values = flow[rests]
    mean, usual = float(np.nanmean(values)), float(np.sqrt(np.nanmean(flow**2)))
    curves = (_make_cloud("samples at rest", recording.t[rests], values),)
    share = 100.0 * abs(mean) / max(usual, np.finfo(float).tiny)
    text = f"Zero at rest: the piston rests in {100 * rests.mean():.2g} % of the time, and {source} reads"
    text += (
        f" {mean:.3g} {unit} then, {share:.2g} % of its usual value: leakage that the pump makes good, or a zero error."
    )
    return ChannelCheck("rest", title, text, "", *labels, curves)


def _check_delay(recording: Recording, source: str, flows: FlowCurves | None) -> ChannelCheck:
    """Compare piston and pump speed for shifts of the position: least misfit, 1 - correlation^2, at its delay."""
    cut = recording.samples(slice(0, _MAX_SAMPLES))
    flow, speed = _flow(cut, source)[0], _piston_speed(cut)
    step = max(1, round(_MAX_SHIFT * cut.rate / _SHIFTS))
    largest = min(step * _SHIFTS, len(cut) // 4, max(1, round(_MAX_SHIFT * cut.rate)))
    shifts = np.arange(-largest, largest + 1, step)
    flow, speed = np.nan_to_num(flow - np.nanmean(flow)), np.nan_to_num(speed - np.nanmean(speed))
    inner = slice(largest, len(cut) - largest)
    power = max(float(flow[inner] @ flow[inner]), np.finfo(float).tiny)
    misfit = np.array([
        100.0 * (1.0 - float(flow[inner] @ (late := speed[largest + k : len(cut) - largest + k])) ** 2
        / max(power * float(late @ late), np.finfo(float).tiny)) for k in shifts
    ])  # fmt: skip
    title = "Delay: the misfit of piston and pump speed must be least at 0 ms"
    best = 1e3 * shifts[int(np.argmin(misfit))] / cut.rate
    mark, how = float(best), f"by the speeds of x and {source}"
    if flows is not None and flows.delay is not None:
        mark, how = 1e3 * flows.delay.value, f"± {2e3 * flows.delay.deviation:.2g} ms, by the volumes"
    text = f"Delay: x is {abs(mark):.3g} ms {'late' if mark > 0.0 else 'early'}, {how}"
    curve = CheckCurve("misfit", np.asarray(1e3 * shifts / cut.rate), misfit)
    return ChannelCheck("delay", title, f"{text}.", "", "shift of x [ms]", "misfit [%]", (curve,), mark)
