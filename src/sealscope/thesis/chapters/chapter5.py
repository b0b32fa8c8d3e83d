"""Simulate the ten leakage tests of chapter 5, draw Figs. 5.1 to 5.89, and measure the simulated tests."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import QUANTITIES, details
from sealscope.signals.windows import WINDOW_SIZE, rms, windowed_rms
from sealscope.simulation.experiment import Experiment
from sealscope.thesis.chapters.appendix_c_runs import SETTLING, RmsPairs, leak_test, part_detail_rms, pressure_range
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Figure, FigureCurve, Number, Panel, Role
from sealscope.thesis.engine.texts import format_note, load_texts
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG, UNITS, Condition
from sealscope.thesis.sines import sine_fit
from sealscope.units import LITRE_PER_MINUTE, PSI

Mask = NDArray[np.bool_]
PanelsAndNumbers = tuple[list[Panel], list[Number]]
_RPM = 2.0 * math.pi / 60.0  # [rad/s]
_WINDOWED = ("d3", "d4", "d3d4")
_PART_LABELS = ("without leak", "with leak")
#: Nominal leak of each level [L/min], section 5.1.
NOMINAL_LPM: dict[str, float] = {"large": 0.0150, "medium": 0.0100, "small": 0.0075, "extra-small": 0.0042}


@dataclass(frozen=True)
class PrintedTest:
    """One of the ten leakage tests whose figures chapter 5 prints.

    `section` of the thesis, such as "5.2a"; `level` of the leak, such as "large"; `first_figure`: n of its first figure
    5.n; `n_input_figures`: number of its figures of command, speed and displacement (2: whole test and close-up);
    `half`: time [s] at which the leak opened, half the duration.
    """

    section: str
    command: str
    level: str
    first_figure: int
    n_input_figures: int
    half: float

    @property
    def parts(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Begin and end [s] of the part without the leak, after the start-up, and of the part with the leak."""
        return (SETTLING, self.half), (self.half, 2 * self.half)

    @property
    def candidates(self) -> tuple[Condition, ...]:
        """The tests of Appendix C that have the command and leak level of this test."""
        return tuple(row for row in APPENDIX_C if (row.command, row.level) == (self.command, self.level))

    @property
    def condition(self) -> Condition:
        """The test of Appendix C that this test probably is: the candidate with the leak nearest to nominal."""
        return min(self.candidates, key=lambda row: abs(row.mean_leak_lpm - NOMINAL_LPM[self.level]))

    @property
    def omega(self) -> float:
        """Angular frequency [rad/s] of the test's command, such as 4 for `3 sin(4t)`."""
        return float(self.command.split("(")[1].rstrip(")").removesuffix("t").strip() or 1.0)  # 1.0 for "sin(t)"


TESTS: dict[str, PrintedTest] = {row[0]: PrintedTest(*row) for row in load_texts("cases.toml")["shown"]}


def make_test_experiment(test: PrintedTest) -> Experiment:
    """Build the experiment of one of the ten tests, with the leak open in the second half."""
    return leak_test(test.condition, test.half, seed=test.condition.number)


@dataclass(frozen=True, eq=False)
class FigureView:
    """A simulated test over the interval `span` [s], from which the panels of a figure are drawn.

    `chamber`: the pressure, p_A or p_B, whose wavelet details are drawn; "" if none are.
    """

    run: SimulatedRun
    test: PrintedTest
    span: tuple[float, float]
    chamber: str

    def notes(self) -> str:
        """Format the note that names the simulated test of Appendix C and the reason for its choice."""
        row = self.test.condition
        other_rows = ", ".join(str(candidate.number) for candidate in self.test.candidates if candidate is not row)
        choice = format_note("chosen-row", row=row.number, others=other_rows) if other_rows else ""
        leak, half = self.run.mean_leak_lpm, self.test.half
        values = {"rig": BENCH_RIG, "row": row.number, "closed": row.closed_pct, "leak": leak, "half": half}
        return format_note("shown-test", chosen=choice, **values)

    def _panel(self, label: str, *curves: FigureCurve) -> Panel:
        """Build a panel over time [s] with a mark where the leak opens; `label`: label of the y axis."""
        return Panel("t [s]", label, curves, marks=((self.test.half, "leak opens"),), x_range=self.span)

    def _curve(
        self, y: Array, label: str, role: Role, t: Array | None = None, start: float = 0.0, stop: float = math.inf
    ) -> FigureCurve:
        """Build the curve of `y` over `t` [s], by default the recording's times, in `span` from `start` to `stop`."""
        t = self.run.recorded.t if t is None else t
        is_drawn = (t >= max(start, self.span[0])) & (t <= min(stop, self.span[1]))
        return FigureCurve(t[is_drawn], y[is_drawn], label, role)

    def _curve_pair(self, y: Array, t: Array | None = None) -> list[FigureCurve]:
        """Build the curves of `y` over `t` [s], by default the recording's times, before and after the leak opens."""
        half = self.test.half
        return [self._curve(y, "no leak", "no leak", t, stop=half), self._curve(y, "leak", "leak", t, start=half)]

    def _part_masks(self) -> Iterator[tuple[Mask, str]]:
        """Yield (mask, label) of the samples without the leak, after the start-up, and of those with the leak."""
        t = self.run.recorded.t
        for (start, stop), label in zip(self.test.parts, _PART_LABELS, strict=True):
            yield (t >= start) & (t < stop), label

    def draw_inputs(self) -> PanelsAndNumbers:
        """Draw command, motor speed and displacement; list RMS of the speed and trend of the displacement by part."""
        recording = self.run.recorded
        rpm, x = recording["omega"] / _RPM, recording["x"] * 1e3
        panels = [
            self._panel("u [V]", self._curve(recording["u"], "command", "command")),
            self._panel("motor speed [rpm]", self._curve(rpm, "speed", "other")),
            self._panel("x [mm]", self._curve(x, "displacement", "other")),
        ]
        numbers = []
        for mask, label in self._part_masks():
            speed = float(np.sqrt(np.mean(rpm[mask] ** 2)))
            drift = sine_fit(recording.t[mask], x[mask], self.test.omega).slope
            numbers += [Number(f"RMS of speed {label}", speed, "rpm"), Number(f"drift of x {label}", drift, "mm/s")]
        return panels, numbers

    def draw_leak(self) -> PanelsAndNumbers:
        """Draw the leak flow and both chamber pressures; list the mean leak, and the pressures' ranges by part."""
        recording = self.run.recorded
        flow = self._curve(recording["q_leak"] / LITRE_PER_MINUTE, "flow meter, A to B positive", "leak")
        roles: dict[str, Role] = {"p_A": "A", "p_B": "B"}
        panels = [self._panel("leak [L/min]", flow)]
        panels += [self._panel(f"{c} [MPa]", self._curve(recording[c] / 1e6, c, roles[c])) for c in CHAMBERS]
        numbers = [
            Number("mean leak while open (true)", self.run.mean_leak_lpm, "L/min"),
            Number("mean leak of the thesis's sheet", self.test.condition.mean_leak_lpm, "L/min"),
        ]
        for mask, label in self._part_masks():
            for c in CHAMBERS:
                pressure_MPa = recording[c][mask] / 1e6
                numbers.append(Number(f"5 to 95 % range of {c} {label}", pressure_range(pressure_MPa), "MPa"))
        return panels, numbers

    def draw_details(self) -> PanelsAndNumbers:
        """Draw the wavelet details d1 to d4 and d3d4 of one chamber's pressure; list their RMS and its changes."""
        series = zip(QUANTITIES, details(self.run.recorded[self.chamber] / PSI).quantities(), strict=True)
        panels = [self._panel(f"{name} [{UNITS[name]}]", *self._curve_pair(values)) for name, values in series]
        return panels, self._rms_changes(QUANTITIES)

    def draw_windowed_rms(self) -> PanelsAndNumbers:
        """Draw the windowed RMS of d3, d4 and d3d4 of one chamber's pressure, and the RMS of each part as a line."""
        t, curves = windowed_detail_rms(self.run.recorded, self.chamber)
        rms = part_detail_rms(self.run.recorded, self.test.parts)[self.chamber]
        panels = []
        for name in _WINDOWED:
            part_rms = FigureCurve(np.ravel(self.test.parts), np.repeat(rms[name], 2), "RMS of each part", "reference")
            panels.append(self._panel(f"RMS of {name} [{UNITS[name]}]", *self._curve_pair(curves[name], t), part_rms))
        return panels, self._rms_changes(_WINDOWED)

    def _rms_changes(self, names: tuple[str, ...]) -> list[Number]:
        """Compute the RMS of the wavelet details `names` without and with the leak, and the change [%] of each."""
        numbers = []
        for name, (before, after) in part_detail_rms(self.run.recorded, self.test.parts)[self.chamber].items():
            if name in names:
                rms = zip(_PART_LABELS, (before, after), strict=True)
                numbers += [Number(f"RMS of {name} {label}", value, UNITS[name]) for label, value in rms]
                numbers.append(Number(f"change of {name}", 100.0 * (after - before) / before, "%"))
        return numbers


#: View -> its content in titles, and the method that draws it.
_VIEWS: dict[str, tuple[str, Callable[[FigureView], PanelsAndNumbers]]] = {
    "input": ("command, motor speed and piston displacement", FigureView.draw_inputs),
    "leak": ("leak flow and chamber pressures", FigureView.draw_leak),
    "details": ("wavelet details d1 to d4 and d3d4", FigureView.draw_details),
    "rms": ("windowed RMS of d3, d4 and d3d4", FigureView.draw_windowed_rms),
}


def iter_views() -> Iterator[tuple[str, str, dict[str, object]]]:
    """Yield (id, title, inputs) of Figs. 5.1 to 5.89: views of the tests, whole or 10 s to either side of the onset."""
    for test in TESTS.values():
        input_views = [("input", "", False), ("input", "", True)]  # (view, chamber, is_closeup)
        test_views = [*input_views[: test.n_input_figures], ("leak", "", False), ("leak", "", True)]
        for chamber in CHAMBERS:
            test_views += [("details", chamber, False), ("details", chamber, True), ("rms", chamber, False)]
        for number, (view, chamber, is_closeup) in enumerate(test_views, test.first_figure):
            start, stop = (test.half - 10.0, test.half + 10.0) if is_closeup else (0.0, 2 * test.half)
            interval = f"close-up {start:g} to {stop:g} s" if is_closeup else f"{stop:g} s"
            content, _ = _VIEWS[view]
            content += f" of {chamber}" if chamber else ""
            title = f"Test {test.section}, {test.command}, {test.level} leak: {content}, {interval}"
            inputs = {"test": test.section, "view": view, "chamber": chamber, "from_s": start, "to_s": stop}
            yield f"fig-5.{number}", title, inputs


def leak_test_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw one of Figs. 5.1 to 5.89: the view, test, chamber and interval that `item.inputs` names."""
    test = TESTS[item.inputs["test"]]
    span = (item.inputs["from_s"], item.inputs["to_s"])
    view = FigureView(context.run(make_test_experiment(test)), test, span, item.inputs["chamber"])
    _, draw = _VIEWS[item.inputs["view"]]
    panels, numbers = draw(view)
    return (item.figure(panels, numbers, view.run.resolved, view.notes()),)


def windowed_detail_rms(recording: Recording, chamber: str) -> tuple[Array, dict[str, Array]]:
    """Compute the RMS of a chamber pressure's wavelet details in windows of 1000 samples that begin every 500 samples.

    Windows whose details depend on padding at the record's ends are left out. Returns the centres of the windows [s],
    and the RMS of d1..d4 [psi] and d3d4 [psi^2] by the detail's name.
    """
    transformed = details(recording[chamber] / PSI)
    inside = transformed.inside()
    ends, rows = windowed_rms(transformed.quantities()[:, inside], first=inside.start)
    centres = np.asarray((ends - WINDOW_SIZE / 2) / recording.rate, dtype=np.float64)
    return centres, dict(zip(QUANTITIES, rows, strict=True))


@dataclass(frozen=True)
class LeakTestMeasures:
    """Measures of one simulated test of chapter 5; each pair is (without leak, with leak).

    `rms`: of the wavelet details by chamber and detail; `speed`: RMS of the motor's speed [rad/s]; `drift`: linear
    trend of the piston's position [mm/s]; `velocity`: RMS of the piston's velocity [mm/s]; `range_MPa`: of each
    chamber's noise-free pressure (`pressure_range`); `step_s`: by chamber, the onset estimated from the windowed RMS of
    d3 (`fit_step_time`).
    """

    rms: RmsPairs
    speed: tuple[float, float]
    drift: tuple[float, float]
    velocity: tuple[float, float]
    range_MPa: dict[str, tuple[float, float]]
    step_s: dict[str, float]


def fit_step_time(t: Array, y: Array, min_points: int = 5) -> float:
    """Estimate the time [s] at which a series `y` (n,) over `t` (n,) [s] changes its mean, by least squares.

    The time is halfway between two points, with at least `min_points` points on each side; n >= 2 `min_points`.
    """
    n = y.size
    n_before = np.arange(min_points, n - min_points + 1)
    cumulative = np.cumsum(y)
    sum_before, sum_after = cumulative[n_before - 1], cumulative[-1] - cumulative[n_before - 1]
    # residual sum of squares about the means of both sides
    residual_squares = float(np.sum(y**2)) - sum_before**2 / n_before - sum_after**2 / (n - n_before)
    first_after = int(n_before[np.argmin(residual_squares)])
    return float((t[first_after - 1] + t[first_after]) / 2.0)


def measure_test(context: Context, test: PrintedTest, *, leak: bool = True) -> LeakTestMeasures:
    """Simulate one of the ten tests, with or without its `leak`, and measure its parts before and after half time."""
    experiment = make_test_experiment(test)
    # no figure shows the run without the leak, so it is not proved by a smaller step
    run = context.run(experiment) if leak else context.run(replace(experiment, leaks=()), prove=False)
    recording = run.recorded
    t, period = recording.t, 2.0 * np.pi / test.omega
    # whole periods of the command at the end of each part
    starts = [stop - np.floor((stop - start) / period) * period for start, stop in test.parts]
    masks = [(t >= start) & (t < stop) for start, (_, stop) in zip(starts, test.parts, strict=True)]

    def compute_pair(values: Array, statistic: Callable[[Array], float] = rms) -> tuple[float, float]:
        """Compute a statistic of `values` (n,) over whole periods in each part."""
        return statistic(values[masks[0]]), statistic(values[masks[1]])

    step_times = {}
    for chamber in CHAMBERS:
        centres, curves = windowed_detail_rms(recording, chamber)
        is_settled = centres >= SETTLING
        step_times[chamber] = fit_step_time(centres[is_settled], curves["d3"][is_settled])
    before, after = (sine_fit(t[mask], run.outputs["x"][mask], test.omega).slope * 1e3 for mask in masks)
    return LeakTestMeasures(
        rms=part_detail_rms(recording, test.parts),
        speed=compute_pair(run.outputs["omega"]),
        drift=(before, after),
        velocity=compute_pair(run.outputs["v"] * 1e3),
        range_MPa={chamber: compute_pair(run.outputs[chamber] / 1e6, pressure_range) for chamber in CHAMBERS},
        step_s=step_times,
    )
