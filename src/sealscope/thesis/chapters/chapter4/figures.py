"""Tabulate the cases of Tables 4.2 and 4.3, and draw the simulated curves of Figs. 4.4-4.36 with both solvers."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sealscope.recordings.chambers import PRESSURES
from sealscope.simulation.commands import parse_command
from sealscope.thesis.chapters.chapter4.cases import (
    CASES,
    CLOSINGS,
    COMMAND,
    DEFAULT_READING,
    LABELS,
    SOLVERS,
    WINDOW,
    Reading,
    Runs,
    Solver,
    all_resolved,
    completed_runs,
    mean_difference,
    run_both_solvers,
    steady_output,
    steady_range,
)
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Figure, FigureCurve, Number, Panel, Role, ThesisTable
from sealscope.thesis.engine.texts import format_note, load_texts
from sealscope.units import LITRE_PER_MINUTE, P_ATM


class FigureUnit(NamedTuple):
    """Unit in which the figures show a quantity, and the factor `scale` from SI units to it."""

    unit: str
    scale: float


FIGURE_UNITS: dict[str, FigureUnit] = {
    "u": FigureUnit("V", 1.0),
    "omega": FigureUnit("rad/s", 1.0),
    "x": FigureUnit("mm", 1e3),
    **dict.fromkeys(PRESSURES, FigureUnit("MPa", 1e-6)),
    **dict.fromkeys(("Q_A", "Q_B"), FigureUnit("L/min", 1.0 / LITRE_PER_MINUTE)),
}
#: Gauge pressure [MPa] of a vacuum.
_VACUUM = -1e-6 * P_ATM
#: Curves with an rms difference below this fraction of their range coincide; one is drawn as so many marks or more.
_COINCIDENCE_FRACTION, _N_MARKS = 0.005, 80
_CLOSING_ROLES: dict[float, Role] = {25.0: "25 %", 50.0: "50 %", 75.0: "75 %"}
#: Line volumes V_1 = V_2 [cm^3] that are compared, and those of a quick reproduction.
_VOLUMES, _QUICK_VOLUMES = (10.0, 20.0, 44.0, 100.0, 234.0, 500.0), (10.0, 44.0, 234.0)


def item_reading(item: Item) -> Reading:
    """Return the interpretation of the throttles' equations in `item.inputs`, the default one if there is none."""
    return Reading(**item.inputs.get("reading", {}))


def _run_case(context: Context, item: Item) -> tuple[Runs, str]:
    """Simulate by both solvers the case of Table 4.2 or 4.3 in `item.inputs`; return the runs and notes on them."""
    (command, closed_pct), reading = CASES[item.inputs["case"]], item_reading(item)
    runs = run_both_solvers(context, command, closed_pct, reading)
    return runs, _run_notes([runs], reading if closed_pct is not None else None)


def _run_notes(cases: Sequence[Runs], reading: Reading | None) -> str:
    """Format the notes on some cases: reading of the equations, failed or unresolved runs, and pressures below vacuum.

    `reading`: one way to understand the thesis's inconsistent equations; None for cases without orifices.
    """
    notes = [format_note("measured-curve")]
    if reading is not None:
        notes.append(f"Reading: {reading.title}.")
    min_MPa: dict[str, float] = {}  # lowest pressure by the solver's label
    for _, label, run in itertools.chain.from_iterable(map(completed_runs, cases)):
        lowest = min(float(run.outputs[name].min()) for name in PRESSURES) * 1e-6
        min_MPa[label] = min(lowest, min_MPa.get(label, lowest))
    notes += [
        format_note("vacuum", label=label, lowest=lowest) for label, lowest in min_MPa.items() if lowest < _VACUUM
    ]
    notes += dict.fromkeys(f"{run.diverged}." for runs in cases for run in runs.values() if run.diverged)
    if all(runs["converged"].resolved and not runs["as_published"].resolved for runs in cases):
        notes.append(format_note("published-unresolved"))
    return " ".join(notes)


def _axis_label(name: str) -> str:
    """Format the label of a quantity with its unit in the figures, such as "p_A [MPa]"."""
    return f"{name} [{FIGURE_UNITS[name].unit}]"


def _line_curve(run: SimulatedRun, name: str, label: str, role: Role) -> FigureCurve:
    """Build the curve of an output of a run over time, in the figures' unit; `role` determines its line style."""
    return FigureCurve(run.t, run.outputs[name] * FIGURE_UNITS[name].scale, label, role)


def _mark_points(curve: FigureCurve) -> FigureCurve:
    """Convert a line to 80 to 159 marks, between which another curve with the same values stays visible.

    A line of fewer than 80 points gets a mark at each.
    """
    step = max(1, curve.x.size // _N_MARKS)
    return replace(curve, x=curve.x[::step], y=curve.y[::step], label=f"{curve.label} (the same)", kind="points")


def _solver_curves(runs: Runs, name: str) -> tuple[FigureCurve, ...]:
    """Build the curves of an output over time, one for each solver whose run did not diverge.

    If both coincide (rms difference below 0.5 % of the output's range), the thesis's solver is drawn as a few marks.
    """
    max_difference = _COINCIDENCE_FRACTION * steady_range(runs["converged"], name) * FIGURE_UNITS[name].scale
    curves = {solver: _line_curve(run, name, label, solver) for solver, label, run in completed_runs(runs)}
    if len(curves) == 2 and _rms_difference(runs, name) < max_difference:
        return curves["converged"], _mark_points(curves["as_published"])
    return tuple(curves.values())


def _rms_difference(runs: Runs, name: str) -> float:
    """Compute the rms difference of an output between the two solvers, in the figures' unit; nan if a run diverged."""
    difference = steady_output(runs["as_published"], name) - steady_output(runs["converged"], name)
    return float(np.sqrt(np.mean(difference**2)) * FIGURE_UNITS[name].scale)


def case_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate minimum, maximum and standard deviation of each output in a case of Table 4.2 or 4.3, by solver.

    The last column is the rms difference between the two solvers. All numbers are from pi to 2 pi seconds of the runs.
    """
    runs, notes = _run_case(context, item)
    rows: list[tuple[Cell, ...]] = []
    for name in list(FIGURE_UNITS)[1:]:  # the first output is the command
        row: list[Cell] = [_axis_label(name)]
        for run in runs.values():
            values = steady_output(run, name) * FIGURE_UNITS[name].scale
            row += [None if run.diverged else float(statistic(values)) for statistic in (np.min, np.max, np.std)]
        rows.append((*row, _rms_difference(runs, name)))
    statistics = ("least", "greatest", "rms about mean")
    heads = [f"{statistic}, {LABELS[solver]}" for solver in runs for statistic in statistics]
    columns = ("quantity", *heads, "rms of the difference")
    return (item.table(rows, f"Numbers {WINDOW}. {notes}", columns, resolved=all_resolved(runs)),)


def time_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the quantities that `item.inputs` names, such as "p_A", over time in a case, by solver."""
    runs, notes = _run_case(context, item)
    command, _ = CASES[item.inputs["case"]]
    t = runs["converged"].t
    panels, numbers = [], []
    for letter, name in zip("abc", item.inputs["quantities"], strict=False):
        if name == "u":
            curves: tuple[FigureCurve, ...] = (FigureCurve(t, parse_command(command).volts(t), command, "command"),)
        else:
            curves = _solver_curves(runs, name)
            unit, scale = FIGURE_UNITS[name]
            ranges = [(label, steady_range(run, name) * scale) for _, label, run in completed_runs(runs)]
            numbers += [Number(f"range of {name}, {label}", value, unit) for label, value in ranges]
            numbers.append(Number(f"rms of the difference in {name}", _rms_difference(runs, name), unit))
        panels.append(Panel("t [s]", _axis_label(name), curves, f"({letter})"))
    return (item.figure(panels, numbers, all_resolved(runs), notes),)


def orifice_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the pressures on both sides of an orifice and their difference over time (Figs. 4.13, 4.14), by solver.

    `item.inputs` has the case and the names of the pressures on the pump's and on the cylinder's side.
    """
    runs, notes = _run_case(context, item)
    pump, chamber = item.inputs["quantities"]
    panels, differences, numbers = [], [], []
    # the converged run first; a run that diverged has no panel
    for letter, (role, label, run) in zip("ab", reversed(completed_runs(runs)), strict=False):
        panels.append(Panel("t [s]", "pressure [MPa]", _orifice_curves(run, pump, chamber), f"({letter}) {label}"))
        differences.append(FigureCurve(run.t, (run.outputs[pump] - run.outputs[chamber]) * 1e-6, label, role))
        peak_difference = float(steady_output(run, pump).max() - steady_output(run, chamber).max()) * 1e-6
        numbers += [
            Number(f"mean of {pump} - {chamber}, {label}", mean_difference(run, pump, chamber) * 1e-6, "MPa"),
            Number(f"peak of {pump} less peak of {chamber}, {label}", peak_difference, "MPa"),
        ]
    panels.append(Panel("t [s]", f"{pump} - {chamber} [MPa]", tuple(differences), "(c) Difference"))
    return (item.figure(panels, numbers, all_resolved(runs), notes),)


def _orifice_curves(run: SimulatedRun, pump: str, chamber: str) -> tuple[FigureCurve, ...]:
    """Build the curves of the pressures on both sides of an orifice over time.

    `pump`, `chamber`: names of the pressures on the pump's and on the cylinder's side, such as "p_1" and "p_A". If both
    curves coincide, the pump's is drawn as a few marks.
    """
    chamber_curve = _line_curve(run, chamber, chamber, "A" if chamber == "p_A" else "B")
    pump_curve = _line_curve(run, pump, pump, "reference")
    rms_difference = float(np.sqrt(np.mean((steady_output(run, pump) - steady_output(run, chamber)) ** 2)))
    if rms_difference >= _COINCIDENCE_FRACTION * steady_range(run, chamber):
        return pump_curve, chamber_curve
    return chamber_curve, _mark_points(pump_curve)


def _sweep_curves(
    template: str, sweep: Mapping[float, Runs], measure: Callable[[SimulatedRun], float], solvers: Sequence[Solver]
) -> tuple[tuple[FigureCurve, ...], list[Number]]:
    """Build a curve of a measure over a varied parameter for each solver, and list the curves' points as numbers [MPa].

    `template`: name of a number, with a placeholder for the parameter's value; `sweep`: runs by this value and by
    solver; `measure`: computes the measure [Pa] of a run, such as the range of a pressure.
    """
    curves, numbers = [], []
    for solver in solvers:
        values = [measure(runs[solver]) * 1e-6 for runs in sweep.values()]
        curves.append(FigureCurve(np.array(list(sweep)), np.array(values), LABELS[solver], solver))
        pairs = zip(sweep, values, strict=True)
        numbers += [Number(f"{template.format(varied)}, {LABELS[solver]}", value, "MPa") for varied, value in pairs]
    return tuple(curves), numbers


def closing_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw a pressure with orifices that are 25, 50 and 75 % closed, and its range over the closing, by solver."""
    name, reading = item.inputs["quantity"], item_reading(item)
    sweep = {closed: run_both_solvers(context, COMMAND, closed, reading) for closed in CLOSINGS}
    panels = []
    for letter, solver in zip("ab", SOLVERS, strict=True):
        curves = tuple(
            _line_curve(runs[solver], name, f"{closed:g} % closed", _CLOSING_ROLES[closed])
            for closed, runs in sweep.items()
            if not runs[solver].diverged
        )
        panels.append(Panel("t [s]", _axis_label(name), curves, f"({letter}) {LABELS[solver]}"))
    ranges, numbers = _sweep_curves("range at {:g} % closed", sweep, lambda run: steady_range(run, name), SOLVERS)
    panels.append(Panel("closed [%]", f"range of {name} [MPa]", ranges, "(c) Range against closing"))
    resolved = all(map(all_resolved, sweep.values()))
    return (item.figure(panels, numbers, resolved, _run_notes(list(sweep.values()), reading)),)


def volume_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the ranges of p_1 and p_A and the mean of p_1 - p_A over the line volumes V_1 = V_2, for both solvers.

    The thesis does not give these volumes.
    """
    command, closed = "3 sin(4t)", 25.0  # closed [%]
    volumes = _QUICK_VOLUMES if context.quick else _VOLUMES
    sweep = {volume: run_both_solvers(context, command, closed, Reading(V_line_cm3=volume)) for volume in volumes}
    measures: dict[str, Callable[[SimulatedRun], float]] = {
        "range of p_1": lambda run: steady_range(run, "p_1"),
        "range of p_A": lambda run: steady_range(run, "p_A"),
        "mean of p_1 - p_A": lambda run: mean_difference(run, "p_1", "p_A"),
    }
    panels, numbers = [], []
    for letter, (name, measure) in zip("abc", measures.items(), strict=True):
        curves, curve_numbers = _sweep_curves(f"{name} at {{:g}} cm3", sweep, measure, list(LABELS))
        panels.append(Panel("V_1 = V_2 [cm3]", f"{name} [MPa]", curves, f"({letter})", log_x=True))
        numbers += curve_numbers
    notes = format_note("volumes", command=command, closed=closed, reading=DEFAULT_READING.title)
    return (item.figure(panels, numbers, all(map(all_resolved, sweep.values())), notes),)


def measured_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the figures of chapter 4 that show only measured curves, for which the thesis gives no numbers.

    Each row also names the simulated figure that replaces the measured one. `context` is not used.
    """
    rows = ((*row, "cannot be reproduced: no numbers are given") for row in load_texts("cases.toml")["measured"])
    return (item.table(rows, format_note("measured-only")),)
