"""Chapter 5: the ten leakage tests the thesis shows, Figs. 5.1 to 5.89, and the measures of the simulated tests."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import QUANTITIES, details
from sealscope.signals.windows import WINDOW_SIZE, rms, windowed_rms
from sealscope.simulation.experiment import Experiment
from sealscope.thesis.chapters.appendix_c_runs import (
    SETTLING,
    detail_rms,
    leak_test,
    pressure_range,
)
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Figure, FigureCurve, Number, Panel, Role
from sealscope.thesis.engine.texts import note, texts_of
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG, UNITS, Condition
from sealscope.thesis.sines import sine_fit
from sealscope.units import LITRE_PER_MINUTE, PSI

Mask = NDArray[np.bool_]
Drawn = tuple[list[Panel], list[Number]]
_RPM = 2.0 * math.pi / 60.0
_WINDOWED = ("d3", "d4", "d3d4")
_WHEN = ("without leak", "with leak")
#: Nominal leak of each level [L/min], section 5.1.
NOMINAL_LPM: dict[str, float] = {"large": 0.0150, "medium": 0.0100, "small": 0.0075, "extra-small": 0.0042}


@dataclass(frozen=True)
class ShownTest:
    """One of the ten tests: its section, command and level, when the leak opened [s], and its figures.

    `first` is the number of its first figure; `inputs`: how many figures show command, speed and displacement (two:
    whole and close-up).
    """

    section: str
    command: str
    level: str
    first: int
    inputs: int
    half: float

    @property
    def parts(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Begin and end [s] of the settled part without and the part with the leak."""
        return (SETTLING, self.half), (self.half, 2 * self.half)

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


#: The ten tests by section.
TESTS: dict[str, ShownTest] = {row[0]: ShownTest(*row) for row in texts_of("cases.toml")["shown"]}


def spec_of(test: ShownTest) -> Experiment:
    """Build the run of a test: its command and throttles on the identified rig, its mean leak from half time."""
    return leak_test(test.condition, test.half, test.condition.number)


@dataclass(frozen=True, eq=False)
class FigureView:
    """The panels and numbers of a test over a stretch of time [s], those of details of one chamber."""

    run: SimulatedRun
    test: ShownTest
    span: tuple[float, float]
    chamber: str

    @property
    def recording(self) -> Recording:
        """The run's recording."""
        return self.run.recorded

    def notes(self) -> str:
        """Name the simulated row of Appendix C, and the reason for its choice."""
        row = self.test.condition
        other_rows = ", ".join(str(candidate.number) for candidate in self.test.candidates if candidate is not row)
        chosen = note("chosen-row", row=row.number, others=other_rows) if other_rows else ""
        leak, half = self.run.mean_leak_lpm, self.test.half
        values = {"rig": BENCH_RIG, "row": row.number, "closed": row.closed_pct, "leak": leak, "half": half}
        return note("shown-test", chosen=chosen, **values)

    def _panel(self, label: str, *curves: FigureCurve) -> Panel:
        return Panel("t [s]", label, curves, marks=((self.test.half, "leak opens"),), x_range=self.span)

    def _curve(self, y: Array, label: str, role: Role, t: Array | None = None, low: float = 0.0) -> FigureCurve:
        t = self.recording.t if t is None else t
        part = (t >= max(low, self.span[0])) & (t <= self.span[1])
        return FigureCurve(t[part], y[part], label, role)

    def _split(self, y: Array, t: Array | None = None) -> list[FigureCurve]:
        """Split a series into two curves, without and with the leak."""
        half, (start, stop) = self.test.half, self.span
        before = replace(self, span=(start, min(stop, half)))._curve(y, "no leak", "no leak", t)
        return [before, self._curve(y, "leak", "leak", t, low=half)]

    def _halves(self) -> tuple[tuple[Mask, str], ...]:
        """Select the samples of the part without and of the part with the leak, the start left out."""
        t, half = self.recording.t, self.test.half
        return ((t >= SETTLING) & (t < half), _WHEN[0]), (t >= half, _WHEN[1])

    def inputs(self) -> Drawn:
        """Draw command, motor speed and displacement."""
        recording = self.recording
        rpm, x = recording["omega"] / _RPM, recording["x"] * 1e3
        panels = [
            self._panel("u [V]", self._curve(recording["u"], "command", "command")),
            self._panel("motor speed [rpm]", self._curve(rpm, "speed", "other")),
            self._panel("x [mm]", self._curve(x, "displacement", "other")),
        ]
        numbers = []
        for part, when in self._halves():
            speed = float(np.sqrt(np.mean(rpm[part] ** 2)))
            drift = sine_fit(recording.t[part], x[part], self.test.omega).slope
            numbers += [Number(f"RMS of speed {when}", speed, "rpm"), Number(f"drift of x {when}", drift, "mm/s")]
        return panels, numbers

    def leak(self) -> Drawn:
        """Draw leak flow and chamber pressures."""
        recording = self.recording
        flow = self._curve(recording["q_leak"] / LITRE_PER_MINUTE, "flow meter, A to B positive", "leak")
        roles: dict[str, Role] = {"p_A": "A", "p_B": "B"}
        panels = [self._panel("leak [L/min]", flow)]
        panels += [self._panel(f"{c} [MPa]", self._curve(recording[c] / 1e6, c, roles[c])) for c in CHAMBERS]
        numbers = [
            Number("mean leak while open (true)", self.run.mean_leak_lpm, "L/min"),
            Number("mean leak of the thesis's sheet", self.test.condition.mean_leak_lpm, "L/min"),
        ]
        for part, when in self._halves():
            for c in CHAMBERS:
                low, high = np.percentile(recording[c][part], [5.0, 95.0]) / 1e6
                numbers.append(Number(f"5 to 95 % range of {c} {when}", float(high - low), "MPa"))
        return panels, numbers

    def details(self) -> Drawn:
        """Draw d1 to d4 and d3d4 of the chamber's pressure."""
        series = zip(QUANTITIES, details(self.recording[self.chamber] / PSI).quantities(), strict=True)
        panels = [self._panel(f"{name} [{UNITS[name]}]", *self._split(values)) for name, values in series]
        return panels, self._changes(QUANTITIES)

    def windowed_rms(self) -> Drawn:
        """Draw the windowed RMS of d3, d4 and d3d4 of a chamber's pressure, and the RMS of each part."""
        t, curves = windowed(self.recording, self.chamber)
        rms = detail_rms(self.recording, self.test.parts)[self.chamber]
        panels = []
        for name in _WINDOWED:
            levels = FigureCurve(np.ravel(self.test.parts), np.repeat(rms[name], 2), "RMS of each part", "reference")
            panels.append(self._panel(f"RMS of {name} [{UNITS[name]}]", *self._split(curves[name], t), levels))
        return panels, self._changes(_WINDOWED)

    def _changes(self, names: tuple[str, ...]) -> list[Number]:
        numbers = []
        for name, (before, after) in detail_rms(self.recording, self.test.parts)[self.chamber].items():
            if name in names:
                rms = zip(_WHEN, (before, after), strict=True)
                numbers += [Number(f"RMS of {name} {when}", value, UNITS[name]) for when, value in rms]
                numbers.append(Number(f"change of {name}", 100.0 * (after - before) / before, "%"))
        return numbers


#: View -> what it shows, and what draws it.
_VIEWS: dict[str, tuple[str, Callable[[FigureView], Drawn]]] = {
    "input": ("command, motor speed and piston displacement", FigureView.inputs),
    "leak": ("leak flow and chamber pressures", FigureView.leak),
    "details": ("wavelet details d1 to d4 and d3d4", FigureView.details),
    "rms": ("windowed RMS of d3, d4 and d3d4", FigureView.windowed_rms),
}


def views() -> Iterator[tuple[str, str, dict[str, object]]]:
    """Yield number, title and inputs of Figs. 5.1 to 5.89: of each test every view, whole and in close-up."""
    for test in TESTS.values():
        views_of_test = [
            *[("input", "", False), ("input", "", True)][: test.inputs],
            ("leak", "", False),
            ("leak", "", True),
        ]
        for chamber in CHAMBERS:
            views_of_test += [("details", chamber, False), ("details", chamber, True), ("rms", chamber, False)]
        for number, (view, chamber, closeup) in enumerate(views_of_test, test.first):
            start, stop = (test.half - 10.0, test.half + 10.0) if closeup else (0.0, 2 * test.half)
            when = f"close-up {start:g} to {stop:g} s" if closeup else f"{stop:g} s"
            content = _VIEWS[view][0] + (f" of {chamber}" if chamber else "")
            title = f"Test {test.section}, {test.command}, {test.level} leak: {content}, {when}"
            inputs = {"test": test.section, "view": view, "chamber": chamber, "from_s": start, "to_s": stop}
            yield f"fig-5.{number}", title, inputs


def figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw one of Figs. 5.1 to 5.89, by the item's test, view, chamber and stretch of time."""
    test, span = TESTS[item.inputs["test"]], (item.inputs["from_s"], item.inputs["to_s"])
    view = FigureView(context.run(spec_of(test)), test, span, item.inputs["chamber"])
    panels, numbers = _VIEWS[item.inputs["view"]][1](view)
    return (item.figure(panels, numbers, view.run.resolved, view.notes()),)


def windowed(recording: Recording, chamber: str) -> tuple[Array, dict[str, Array]]:
    """Compute the centres [s] of the windows of 1000 samples, 500 apart, and the RMS of d1..d4, d3d4 in each."""
    transformed = details(recording[chamber] / PSI)
    inside = transformed.inside()
    ends, rows = windowed_rms(transformed.quantities()[:, inside], first=inside.start)
    centres = np.asarray((ends - WINDOW_SIZE / 2) / recording.rate, dtype=np.float64)
    return centres, dict(zip(QUANTITIES, rows, strict=True))


@dataclass(frozen=True)
class ShownMeasures:
    """Measures of one simulated test, each pair without and with the leak.

    `rms`: as Appendix C; `speed`: RMS of the motor's speed [rad/s]; `drift`: of the piston's mean [mm/s]; `velocity`:
    RMS of the piston's [mm/s]; `range_MPa`: 5 to 95 % range of each chamber's true pressure; `step_s`: where a single
    step fits the windowed RMS of d3 of each chamber best [s].
    """

    test: ShownTest
    rms: dict[str, dict[str, tuple[float, ...]]]
    speed: tuple[float, float]
    drift: tuple[float, float]
    velocity: tuple[float, float]
    range_MPa: dict[str, tuple[float, float]]
    step_s: dict[str, float]


def best_step(t: Array, y: Array, least: int = 5) -> float:
    """Find the time at which a single step fits a series best by least squares, halfway between two points.

    At least `least` points stay on each side.
    """
    n = y.size
    places = np.arange(least, n - least + 1)
    total, squares = np.cumsum(y), float(np.sum(y**2))
    left, right = total[places - 1], total[-1] - total[places - 1]
    misfit = squares - left**2 / places - right**2 / (n - places)
    k = int(places[np.argmin(misfit)])
    return float((t[k - 1] + t[k]) / 2.0)


def measure_test(context: Context, test: ShownTest, leak: bool = True) -> ShownMeasures:
    """Measure one of the ten tests, or the same run with its leak left out."""
    spec = spec_of(test)
    run = context.run(spec) if leak else context.run(replace(spec, leaks=()), prove=False)
    recording = run.recorded
    t, period = recording.t, 2.0 * np.pi / test.omega
    # the last whole periods of the command in each half
    starts = [stop - np.floor((stop - start) / period) * period for start, stop in test.parts]
    parts = [(t >= start) & (t < stop) for start, (_, stop) in zip(starts, test.parts, strict=True)]

    def pair(values: Array, statistic: Callable[[Array], float] = rms) -> tuple[float, float]:
        return statistic(values[parts[0]]), statistic(values[parts[1]])

    steps = {}
    for chamber in CHAMBERS:
        centres, curves = windowed(recording, chamber)
        late = centres >= SETTLING
        steps[chamber] = best_step(centres[late], curves["d3"][late])
    before, after = (sine_fit(t[part], run.outputs["x"][part], test.omega).slope * 1e3 for part in parts)
    return ShownMeasures(
        test=test,
        rms=detail_rms(recording, test.parts),
        speed=pair(run.outputs["omega"]),
        drift=(before, after),
        velocity=pair(run.outputs["v"] * 1e3),
        range_MPa={chamber: pair(run.outputs[chamber] / 1e6, pressure_range) for chamber in CHAMBERS},
        step_s=steps,
    )
