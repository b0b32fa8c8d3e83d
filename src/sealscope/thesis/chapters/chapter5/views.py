"""How each view of a test of chapter 5 is drawn from its simulated recording."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.appendix_c.simulated_sheet import PSI, QUANTITIES, SETTLING, data_rig, detail_rms
from sealscope.thesis.chapters.chapter5.tests import ShownTest, test_of
from sealscope.thesis.conditions import experiment_values
from sealscope.thesis.engine.context import Context, RunSpec, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Curve, Figure, Number, Panel, thinned

if TYPE_CHECKING:
    from sealscope.recordings.recording import Recording

Mask = NDArray[np.bool_]
_LITRE_PER_MINUTE = 1e-3 / 60.0
_RPM = 2.0 * math.pi / 60.0
_UNITS = {name: "psi^2" if name == "d3d4" else "psi" for name in QUANTITIES}


def spec_of(test: ShownTest) -> RunSpec:
    """The run of a test: its command and throttles on the rig fitted to the bench, its own mean leak from half time."""
    condition = test.condition
    return RunSpec(
        command=condition.command,
        duration=2 * test.half,
        leaks=(f"{condition.mean_leak_lpm:g} L/min from {test.half:g} s",),
        rig=data_rig(),
        values=tuple(experiment_values(condition).items()),
        seed=condition.number,
        prove=True,
    )


def recording_of(run: SimulatedRun, test: ShownTest) -> Recording:
    """The run's recording; raises SimulationFailed with the run's own reason where it has none."""
    from sealscope.errors import SimulationFailed

    if run.recording is None:
        raise SimulationFailed(f"test {test.section}: {run.diverged}")
    return run.recording


def figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """One of Figs. 5.1 to 5.89, by the item's test, view, chamber and stretch of time."""
    test = test_of(str(item.input("test")))
    run = context.run(spec_of(test))
    recording = recording_of(run, test)
    start, stop = (float(item.input(name)) for name in ("from_s", "to_s"))  # type: ignore[arg-type]
    view, chamber = str(item.input("view")), str(item.input("chamber"))
    panels, numbers = {
        "input": lambda: _input(recording, test, (start, stop)),
        "leak": lambda: _leak(recording, run, test, (start, stop)),
        "details": lambda: _details(recording, test, chamber, (start, stop)),
        "rms": lambda: _rms(recording, test, chamber),
    }[view]()
    return (Figure(item.id, item.title, panels, numbers, resolved=run.resolved, notes=_notes(test, run)),)


def _notes(test: ShownTest, run: SimulatedRun) -> str:
    condition = test.condition
    others = ", ".join(str(row.number) for row in test.candidates if row is not condition)
    chosen = (
        f"; the thesis does not say which row of Appendix C this is: of rows {condition.number}, {others} the one with "
        f"the mean leak nearest to the level's nominal one is taken"
        if others
        else ""
    )
    return (
        f"Simulated on rig {data_rig()}: row {condition.number} of Appendix C, throttles {condition.closed_pct:g} % "
        f"closed, mean leak {run.mean_leak_lpm:.4f} L/min from {test.half:g} s{chosen}."
    )


def _curve(t: Array, y: Array, span: tuple[float, float], label: str, role: str) -> Curve:
    part = (t >= span[0]) & (t <= span[1])
    return Curve(*thinned(t[part], y[part]), label, role)  # type: ignore[arg-type]


def _panel(label: str, curves: list[Curve], test: ShownTest, span: tuple[float, float], title: str = "") -> Panel:
    return Panel("t [s]", label, tuple(curves), title, marks=((test.half, "leak opens"),), x_range=span)


def _split(t: Array, y: Array, test: ShownTest, span: tuple[float, float]) -> list[Curve]:
    """A series as two curves, without and with the leak."""
    parts = ((span[0], min(span[1], test.half), "no leak"), (max(span[0], test.half), span[1], "leak"))
    return [_curve(t, y, (start, stop), role, role) for start, stop, role in parts if stop > start]


def _halves(t: Array, test: ShownTest) -> tuple[Mask, Mask]:
    """Which samples belong to the part without and to the part with the leak, the start left out."""
    return (t >= SETTLING) & (t < test.half), t >= test.half


def mean_slope(t: Array, y: Array, omega: float) -> float:
    """Slope of `y` over `t` beside a sine of `omega` [rad/s], by least squares on 1, t, sin and cos."""
    t_0 = t - t.mean()
    basis = np.column_stack([np.ones_like(t), t_0, np.sin(omega * t), np.cos(omega * t)])
    return float(np.linalg.lstsq(basis, y, rcond=None)[0][1])


def omega_of(command: str) -> float:
    """Angular frequency [rad/s] of a command such as `3 sin(4t)`."""
    inner = command.split("(")[1].rstrip(")").removesuffix("t").strip()
    return float(inner or 1.0)


def _input(
    recording: Recording, test: ShownTest, span: tuple[float, float]
) -> tuple[tuple[Panel, ...], tuple[Number, ...]]:
    t = recording.t
    rpm, x = recording["omega"] / _RPM, recording["x"] * 1e3
    panels = (
        _panel("u [V]", [_curve(t, recording["u"], span, "command", "command")], test, span),
        _panel("motor speed [rpm]", [_curve(t, rpm, span, "speed", "other")], test, span),
        _panel("x [mm]", [_curve(t, x, span, "displacement", "other")], test, span),
    )
    omega = omega_of(test.command)
    numbers = []
    for part, when in zip(_halves(t, test), ("without leak", "with leak"), strict=True):
        numbers += [
            Number(f"RMS of speed {when}", float(np.sqrt(np.mean(rpm[part] ** 2))), "rpm"),
            Number(f"drift of x {when}", mean_slope(t[part], x[part], omega), "mm/s"),
        ]
    return panels, tuple(numbers)


def _leak(
    recording: Recording, run: SimulatedRun, test: ShownTest, span: tuple[float, float]
) -> tuple[tuple[Panel, ...], tuple[Number, ...]]:
    t = recording.t
    flow = recording["q_leak"] / _LITRE_PER_MINUTE
    panels = (
        _panel("leak [L/min]", [_curve(t, flow, span, "flow meter, A to B positive", "leak")], test, span),
        _panel("p_A [MPa]", [_curve(t, recording["p_A"] / 1e6, span, "p_A", "A")], test, span),
        _panel("p_B [MPa]", [_curve(t, recording["p_B"] / 1e6, span, "p_B", "B")], test, span),
    )
    numbers = [
        Number("mean leak while open (true)", run.mean_leak_lpm, "L/min"),
        Number("mean leak of the thesis's sheet", test.condition.mean_leak_lpm, "L/min"),
    ]
    for part, when in zip(_halves(t, test), ("without leak", "with leak"), strict=True):
        for chamber in CHAMBERS:
            low, high = np.percentile(recording[chamber][part], [5.0, 95.0]) / 1e6
            numbers.append(Number(f"5 to 95 % range of {chamber} {when}", float(high - low), "MPa"))
    return panels, tuple(numbers)


def changes(recording: Recording, test: ShownTest) -> dict[str, dict[str, tuple[float, float]]]:
    """RMS of d1..d4 [psi] and d3d4 [psi^2] of both chambers without and with the leak, as Appendix C has them."""
    found = detail_rms(recording, ((SETTLING, test.half), (test.half, 2 * test.half)))
    return {chamber: {name: (pair[0], pair[1]) for name, pair in of.items()} for chamber, of in found.items()}


def _numbers(recording: Recording, test: ShownTest, chamber: str, names: tuple[str, ...]) -> tuple[Number, ...]:
    rms = changes(recording, test)[chamber]
    found = []
    for name in names:
        before, after = rms[name]
        found += [
            Number(f"RMS of {name} without leak", before, _UNITS[name]),
            Number(f"RMS of {name} with leak", after, _UNITS[name]),
            Number(f"change of {name}", 100.0 * (after - before) / before, "%"),
        ]
    return tuple(found)


def _series(recording: Recording, chamber: str) -> dict[str, Array]:
    """d1..d4 [psi] and d3d4 [psi^2] of a chamber's pressure."""
    from sealscope.signals.details import details

    d = details(recording[chamber] / PSI)
    return {**{f"d{level}": d[level] for level in range(1, 5)}, "d3d4": d.product()}


def _details(
    recording: Recording, test: ShownTest, chamber: str, span: tuple[float, float]
) -> tuple[tuple[Panel, ...], tuple[Number, ...]]:
    panels = tuple(
        _panel(f"{name} [{_UNITS[name]}]", _split(recording.t, values, test, span), test, span)
        for name, values in _series(recording, chamber).items()
    )
    return panels, _numbers(recording, test, chamber, QUANTITIES)


def windowed(recording: Recording, chamber: str) -> tuple[Array, dict[str, Array]]:
    """Centres [s] of the windows of 1000 samples, 500 apart, and the RMS of d3, d4, d3d4 in each."""
    from sealscope.signals.filters import reach
    from sealscope.signals.windows import WINDOW_SIZE, windowed_rms

    before, after = (int(samples) for samples in reach("db8", 4)[-1])
    series = _series(recording, chamber)
    inside = slice(before, len(recording) - after)
    made = {name: windowed_rms(series[name][inside], first=before) for name in ("d3", "d4", "d3d4")}
    centres = (made["d3"].ends - WINDOW_SIZE / 2) / recording.rate
    return np.asarray(centres, dtype=np.float64), {name: one.rms for name, one in made.items()}


def _rms(recording: Recording, test: ShownTest, chamber: str) -> tuple[tuple[Panel, ...], tuple[Number, ...]]:
    span = (0.0, 2 * test.half)
    t, curves = windowed(recording, chamber)
    means = changes(recording, test)[chamber]
    panels = []
    for name, values in curves.items():
        before, after = means[name]
        levels = Curve(
            np.array([SETTLING, test.half, test.half, 2 * test.half]),
            np.array([before, before, after, after]),
            "RMS of each part",
            "reference",
        )
        panels.append(_panel(f"RMS of {name} [{_UNITS[name]}]", [*_split(t, values, test, span), levels], test, span))
    return tuple(panels), _numbers(recording, test, chamber, ("d3", "d4", "d3d4"))
