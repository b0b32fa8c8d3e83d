"""Chapter 5: the ten leakage tests the thesis shows, Figs. 5.1 to 5.89, and the measures of the simulated tests."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import SimulationFailed
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array, Recording
from sealscope.thesis.chapters.appendix_c.simulation import SETTLING, detail_rms, detail_series, pressure_range
from sealscope.thesis.engine.context import Context, RunSpec, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Figure, FigureCurve, Number, Panel, thinned
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG, QUANTITIES, UNITS, Condition, Level, experiment_values
from sealscope.units import LITRE_PER_MINUTE

View = Literal["input", "leak", "details", "rms"]
Mask = NDArray[np.bool_]
Span = tuple[float, float]
_RPM = 2.0 * math.pi / 60.0
_WINDOWED = ("d3", "d4", "d3d4")
_WHEN = ("without leak", "with leak")


@dataclass(frozen=True)
class ShownTest:
    """One of the ten tests: its section, command and level, when the leak opened [s], and which figures show it.

    `first` is the number of its first figure; `inputs`: how many figures show command, speed and displacement (two:
    whole and close-up).
    """

    section: str
    command: str
    level: Level
    first: int
    inputs: int = 0
    half: float = 90.0

    @property
    def closeup(self) -> Span:
        """The thesis's close-up [s]: ten seconds to both sides of the onset."""
        return self.half - 10.0, self.half + 10.0

    @property
    def candidates(self) -> tuple[Condition, ...]:
        """The rows of Appendix C with this command and level."""
        return tuple(row for row in APPENDIX_C if (row.command, row.level) == (self.command, self.level))

    @property
    def condition(self) -> Condition:
        """The row of Appendix C taken for this test.

        Of the candidates the one whose mean leak is nearest to the level's nominal one (section 5.1). The thesis does
        not say which row each test is.
        """
        return min(self.candidates, key=lambda row: abs(row.mean_leak_lpm - NOMINAL_LPM[self.level]))

    @property
    def omega(self) -> float:
        """Angular frequency [rad/s] of the command, such as 4 for `3 sin(4t)`."""
        return float(self.command.split("(")[1].rstrip(")").removesuffix("t").strip() or 1.0)


#: Nominal leak of each level [L/min], section 5.1.
NOMINAL_LPM: dict[Level, float] = {"large": 0.0150, "medium": 0.0100, "small": 0.0075, "extra-small": 0.0042}

#: The ten tests by section.
TESTS: dict[str, ShownTest] = {
    test.section: test
    for test in (
        ShownTest("5.2a", "3 sin(4t)", "large", 1, inputs=2, half=60.0),
        ShownTest("5.2b", "5 sin(2t)", "large", 11, inputs=2),
        ShownTest("5.3a", "3 sin(4t)", "medium", 21, inputs=2),
        ShownTest("5.3b", "8 sin(t)", "medium", 31, inputs=1),
        ShownTest("5.4a", "3 sin(4t)", "small", 40),
        ShownTest("5.4b", "8 sin(t)", "small", 48),
        ShownTest("5.5a", "3 sin(4t)", "extra-small", 56),
        ShownTest("5.5b", "7 sin(4t)", "extra-small", 64, inputs=2),
        ShownTest("5.5c", "5 sin(2t)", "extra-small", 74),
        ShownTest("5.5d", "8 sin(t)", "extra-small", 82),
    )
}


def spec_of(test: ShownTest) -> RunSpec:
    """Return the run of a test: its command and throttles on the identified rig, its mean leak from half time."""
    condition = test.condition
    return RunSpec(
        command=condition.command,
        duration=2 * test.half,
        leaks=(f"{condition.mean_leak_lpm:g} L/min from {test.half:g} s",),
        rig=BENCH_RIG,
        values=tuple(experiment_values(condition).items()),
        seed=condition.number,
        prove=True,
    )


def recording_of(run: SimulatedRun, test: ShownTest) -> Recording:
    """Return the run's recording; raise SimulationFailed with the run's own reason where it has none."""
    if run.recording is None:
        raise SimulationFailed(f"test {test.section}: {run.diverged}")
    return run.recording


def figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw one of Figs. 5.1 to 5.89, by the item's test, view, chamber and stretch of time."""
    test = TESTS[str(item.inputs["test"])]
    run = context.run(spec_of(test))
    view = FigureView(run, recording_of(run, test), test, (_number(item, "from_s"), _number(item, "to_s")))
    chamber = str(item.inputs["chamber"])
    draw: dict[str, Callable[[], tuple[tuple[Panel, ...], tuple[Number, ...]]]] = {
        "input": view.inputs,
        "leak": view.leak,
        "details": lambda: view.details(chamber),
        "rms": lambda: view.windowed_rms(chamber),
    }
    panels, numbers = draw[str(item.inputs["view"])]()
    return (Figure(item.id, item.title, panels, numbers, resolved=run.resolved, notes=view.notes()),)


def _number(item: Item, name: str) -> float:
    return float(item.inputs[name])


@dataclass(frozen=True, eq=False)
class FigureView:
    """The panels and numbers of one view of a test, from its run over a stretch of time [s]."""

    run: SimulatedRun
    recording: Recording
    test: ShownTest
    span: Span

    def notes(self) -> str:
        """Return which row of Appendix C was simulated, and how it was chosen."""
        condition = self.test.condition
        others = ", ".join(str(row.number) for row in self.test.candidates if row is not condition)
        chosen = (
            f"; the thesis does not say which row of Appendix C this is: of rows {condition.number}, {others} the one "
            "with the mean leak nearest to the level's nominal one is taken"
            if others
            else ""
        )
        return (
            f"Simulated on rig {BENCH_RIG}: row {condition.number} of Appendix C, throttles {condition.closed_pct:g} % "
            f"closed, mean leak {self.run.mean_leak_lpm:.4f} L/min from {self.test.half:g} s{chosen}."
        )

    def _panel(self, label: str, *curves: FigureCurve) -> Panel:
        return Panel("t [s]", label, curves, marks=((self.test.half, "leak opens"),), x_range=self.span)

    def _curve(self, y: Array, label: str, role: str, span: Span | None = None, t: Array | None = None) -> FigureCurve:
        t = self.recording.t if t is None else t
        start, stop = span or self.span
        part = (t >= start) & (t <= stop)
        return FigureCurve(*thinned(t[part], y[part]), label, role)  # type: ignore[arg-type]

    def _split(self, y: Array, t: Array | None = None) -> list[FigureCurve]:
        """Split a series into two curves, without and with the leak."""
        (start, stop), half = self.span, self.test.half
        parts = (((start, min(stop, half)), "no leak"), ((max(start, half), stop), "leak"))
        return [self._curve(y, role, role, part, t) for part, role in parts if part[1] > part[0]]

    def _halves(self) -> tuple[tuple[Mask, str], ...]:
        """Which samples belong to the part without and to the part with the leak, the start left out."""
        t, half = self.recording.t, self.test.half
        return ((t >= SETTLING) & (t < half), _WHEN[0]), (t >= half, _WHEN[1])

    def inputs(self) -> tuple[tuple[Panel, ...], tuple[Number, ...]]:
        """Draw command, motor speed and displacement."""
        recording = self.recording
        rpm, x = recording["omega"] / _RPM, recording["x"] * 1e3
        panels = (
            self._panel("u [V]", self._curve(recording["u"], "command", "command")),
            self._panel("motor speed [rpm]", self._curve(rpm, "speed", "other")),
            self._panel("x [mm]", self._curve(x, "displacement", "other")),
        )
        numbers = []
        for part, when in self._halves():
            numbers += [
                Number(f"RMS of speed {when}", float(np.sqrt(np.mean(rpm[part] ** 2))), "rpm"),
                Number(f"drift of x {when}", mean_slope(recording.t[part], x[part], self.test.omega), "mm/s"),
            ]
        return panels, tuple(numbers)

    def leak(self) -> tuple[tuple[Panel, ...], tuple[Number, ...]]:
        """Draw leak flow and chamber pressures."""
        recording = self.recording
        flow = recording["q_leak"] / LITRE_PER_MINUTE
        panels = (
            self._panel("leak [L/min]", self._curve(flow, "flow meter, A to B positive", "leak")),
            *(self._panel(f"{c} [MPa]", self._curve(recording[c] / 1e6, c, c.removeprefix("p_"))) for c in CHAMBERS),
        )
        numbers = [
            Number("mean leak while open (true)", self.run.mean_leak_lpm, "L/min"),
            Number("mean leak of the thesis's sheet", self.test.condition.mean_leak_lpm, "L/min"),
        ]
        for part, when in self._halves():
            for chamber in CHAMBERS:
                low, high = np.percentile(recording[chamber][part], [5.0, 95.0]) / 1e6
                numbers.append(Number(f"5 to 95 % range of {chamber} {when}", float(high - low), "MPa"))
        return panels, tuple(numbers)

    def details(self, chamber: str) -> tuple[tuple[Panel, ...], tuple[Number, ...]]:
        """Draw d1 to d4 and d3d4 of a chamber's pressure."""
        panels = tuple(
            self._panel(f"{name} [{UNITS[name]}]", *self._split(values))
            for name, values in detail_series(self.recording, chamber).items()
        )
        return panels, self._changes(chamber, QUANTITIES)

    def windowed_rms(self, chamber: str) -> tuple[tuple[Panel, ...], tuple[Number, ...]]:
        """Draw the windowed RMS of d3, d4 and d3d4 of a chamber's pressure, and the RMS of each part."""
        t, curves = windowed(self.recording, chamber)
        half = self.test.half
        parts = np.array([SETTLING, half, half, 2 * half])
        panels = []
        for name, values in curves.items():
            before, after = half_rms(self.recording, self.test)[chamber][name]
            levels = FigureCurve(parts, np.array([before, before, after, after]), "RMS of each part", "reference")
            panels.append(self._panel(f"RMS of {name} [{UNITS[name]}]", *self._split(values, t), levels))
        return tuple(panels), self._changes(chamber, _WINDOWED)

    def _changes(self, chamber: str, names: tuple[str, ...]) -> tuple[Number, ...]:
        rms = half_rms(self.recording, self.test)[chamber]
        numbers = []
        for name in names:
            before, after = rms[name]
            numbers += [
                Number(f"RMS of {name} without leak", before, UNITS[name]),
                Number(f"RMS of {name} with leak", after, UNITS[name]),
                Number(f"change of {name}", 100.0 * (after - before) / before, "%"),
            ]
        return tuple(numbers)


def mean_slope(t: Array, y: Array, omega: float) -> float:
    """Return the slope of `y` over `t` beside a sine of `omega` [rad/s], by least squares on 1, t, sin and cos."""
    t_0 = t - t.mean()
    basis = np.column_stack([np.ones_like(t), t_0, np.sin(omega * t), np.cos(omega * t)])
    return float(np.linalg.lstsq(basis, y, rcond=None)[0][1])


def half_rms(recording: Recording, test: ShownTest) -> dict[str, dict[str, tuple[float, ...]]]:
    """Return the RMS of d1..d4 [psi] and d3d4 [psi^2] of both chambers without and with the leak, as in Appendix C."""
    return detail_rms(recording, ((SETTLING, test.half), (test.half, 2 * test.half)))


def windowed(recording: Recording, chamber: str) -> tuple[Array, dict[str, Array]]:
    """Return the centres [s] of the windows of 1000 samples, 500 apart, and the RMS of d3, d4, d3d4 in each."""
    from sealscope.signals.filters import reach
    from sealscope.signals.windows import WINDOW_SIZE, windowed_rms

    before, after = (int(samples) for samples in reach("db8", 4)[-1])
    series = detail_series(recording, chamber)
    inside = slice(before, len(recording) - after)
    windows_of = {name: windowed_rms(series[name][inside], first=before) for name in _WINDOWED}
    centres = (windows_of["d3"].ends - WINDOW_SIZE / 2) / recording.rate
    return np.asarray(centres, dtype=np.float64), {name: windows.rms for name, windows in windows_of.items()}


@dataclass(frozen=True)
class ShownMeasures:
    """What one simulated test shows, each pair without and with the leak.

    `rms`: as Appendix C; `speed`: RMS of the motor's speed [rad/s]; `drift`: of the piston's mean [mm/s]; `velocity`:
    RMS of the piston's [mm/s]; `range_MPa`: 5 to 95 % range of each chamber's true pressure; `step_s`: where a single
    step fits the windowed RMS of d3 of each chamber best [s]; `onset_s`: the true onset [s].
    """

    test: ShownTest
    rms: dict[str, dict[str, tuple[float, ...]]]
    speed: tuple[float, float]
    drift: tuple[float, float]
    velocity: tuple[float, float]
    range_MPa: dict[str, tuple[float, float]]
    step_s: dict[str, float]
    onset_s: float


def best_step(t: Array, y: Array, least: int = 5) -> float:
    """Return the time at which a single step fits a series best by least squares, halfway between two points.

    At least `least` points stay on each side.
    """
    n = y.size
    places = np.arange(least, n - least + 1)
    total, squares = np.cumsum(y), float(np.sum(y**2))
    left, right = total[places - 1], total[-1] - total[places - 1]
    misfit = squares - left**2 / places - right**2 / (n - places)
    k = int(places[np.argmin(misfit)])
    return float((t[k - 1] + t[k]) / 2.0)


def _whole_cycles(t: Array, start: float, stop: float, omega: float) -> Mask:
    """Return the samples of the last whole periods of the command before `stop`, none before `start` [s]."""
    period = 2.0 * np.pi / omega
    cycles = np.floor((stop - start) / period)
    return np.asarray((t >= stop - cycles * period) & (t < stop))


def measure_test(context: Context, test: ShownTest, leak: bool = True) -> ShownMeasures:
    """Measure one of the ten tests, or the same run with its leak left out."""
    from sealscope.signals.windows import rms

    spec = spec_of(test)
    run = context.run(spec if leak else replace(spec, leaks=(), prove=False))
    recording = recording_of(run, test)
    t, x, omega, half = recording.t, run.outputs["x"], test.omega, test.half
    parts = [_whole_cycles(t, *ends, omega) for ends in ((SETTLING, half), (half, 2 * half))]

    def pair(values: Array, of: Callable[[Array], float]) -> tuple[float, float]:
        return of(values[parts[0]]), of(values[parts[1]])

    steps = {}
    for chamber in CHAMBERS:
        centres, curves = windowed(recording, chamber)
        settled = centres >= SETTLING
        steps[chamber] = best_step(centres[settled], curves["d3"][settled])
    return ShownMeasures(
        test=test,
        rms=half_rms(recording, test),
        speed=pair(run.outputs["omega"], rms),
        drift=(mean_slope(t[parts[0]], x[parts[0]], omega) * 1e3, mean_slope(t[parts[1]], x[parts[1]], omega) * 1e3),
        velocity=pair(run.outputs["v"] * 1e3, rms),
        range_MPa={chamber: pair(run.outputs[chamber] / 1e6, pressure_range) for chamber in CHAMBERS},
        step_s=steps,
        onset_s=test.half,
    )


_CONTENT: dict[View, str] = {
    "input": "command, motor speed and piston displacement",
    "leak": "leak flow and chamber pressures",
    "details": "wavelet details d1 to d4 and d3d4",
    "rms": "windowed RMS of d3, d4 and d3d4",
}


def _views(test: ShownTest) -> list[tuple[View, str, bool]]:
    """View, chamber and whether a close-up, in the order of the test's figures."""
    views: list[tuple[View, str, bool]] = [("input", "", closeup) for closeup in (False, True)[: test.inputs]]
    views += [("leak", "", False), ("leak", "", True)]
    for chamber in CHAMBERS:
        views += [("details", chamber, False), ("details", chamber, True), ("rms", chamber, False)]
    return views


def _item(test: ShownTest, number: int, view: View, chamber: str, closeup: bool) -> Item:
    start, stop = test.closeup if closeup else (0.0, 2 * test.half)
    when = f"close-up {start:g} to {stop:g} s" if closeup else f"{stop:g} s"
    content = _CONTENT[view] + (f" of {chamber}" if chamber else "")
    return Item(
        f"fig-5.{number}",
        5,
        "figure",
        f"Test {test.section}, {test.command}, {test.level} leak: {content}, {when}",
        figure,
        {"test": test.section, "view": view, "chamber": chamber, "from_s": start, "to_s": stop},
    )


#: Figs. 5.1 to 5.89 in their order.
ITEMS: tuple[Item, ...] = tuple(
    _item(test, test.first + k, *view) for test in TESTS.values() for k, view in enumerate(_views(test))
)
