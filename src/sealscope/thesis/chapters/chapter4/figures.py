"""Tabulate the cases of Tables 4.2 and 4.3, and draw the simulated curves of Figs. 4.4-4.36 with both solvers."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sealscope.recordings.channels import PRESSURES
from sealscope.simulation.commands import parse_command
from sealscope.thesis.chapters.chapter4 import cases
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Figure, FigureCurve, Number, Panel, Role, ThesisTable
from sealscope.thesis.engine.texts import format_note, load_texts
from sealscope.units import LITRE_PER_MINUTE, P_ATM

#: Unit in which the figures show a quantity, and the factor from SI units to it.
FIGURE_UNITS: dict[str, tuple[str, float]] = {
    "u": ("V", 1.0),
    "omega": ("rad/s", 1.0),
    "x": ("mm", 1e3),
    **dict.fromkeys(PRESSURES, ("MPa", 1e-6)),
    **dict.fromkeys(("Q_A", "Q_B"), ("L/min", 1.0 / LITRE_PER_MINUTE)),
}
#: Gauge pressure [MPa] of a vacuum.
_VACUUM = -1e-6 * P_ATM
#: Curves with an rms difference below this fraction of their range coincide; one is drawn as so many marks or more.
_COINCIDENCE_FRACTION, _N_MARKS = 0.005, 80
_CLOSING_ROLES: dict[float, Role] = {25.0: "25 %", 50.0: "50 %", 75.0: "75 %"}
#: Line volumes V_1 = V_2 [cm^3] that are compared, and those of a quick reproduction.
_VOLUMES, _QUICK_VOLUMES = (10.0, 20.0, 44.0, 100.0, 234.0, 500.0), (10.0, 44.0, 234.0)


def item_reading(item: Item) -> cases.Reading:
    """Return the interpretation of the throttles' equations in `item.inputs`, the default one if there is none."""
    return cases.Reading(**item.inputs.get("reading", {}))


def _run_case(context: Context, item: Item) -> tuple[cases.Runs, str]:
    """Simulate the case of Table 4.2 or 4.3 in `item.inputs` by both solvers; return the runs and notes on them."""
    (command, closed_pct), reading = cases.CASES[item.inputs["case"]], item_reading(item)
    runs = cases.run_both_solvers(context, command, closed_pct, reading)
    return runs, _run_notes([runs], reading if closed_pct is not None else None)


def _run_notes(runs_of_cases: Sequence[cases.Runs], reading: cases.Reading | None) -> str:
    """Format the notes on some cases: reading of the equations, failed or unresolved runs, and pressures below vacuum.

    `reading`: None for cases without orifices. Unresolved runs are noted if the thesis's solver has them in all cases,
    and the converged one in none.
    """
    notes = [format_note("measured-curve")]
    if reading is not None:
        notes.append(f"Reading: {reading.title}.")
    min_MPa: dict[str, float] = {}  # lowest pressure by the solver's label
    for _, label, run in itertools.chain.from_iterable(map(cases.completed_runs, runs_of_cases)):
        lowest = min(float(run.outputs[name].min()) for name in PRESSURES) * 1e-6
        min_MPa[label] = min(lowest, min_MPa.get(label, lowest))
    notes += [
        format_note("vacuum", label=label, lowest=lowest) for label, lowest in min_MPa.items() if lowest < _VACUUM
    ]
    notes += dict.fromkeys(f"{run.diverged}." for runs in runs_of_cases for run in runs.values() if run.diverged)
    if all(runs["converged"].resolved and not runs["as_published"].resolved for runs in runs_of_cases):
        notes.append(format_note("published-unresolved"))
    return " ".join(notes)


def _axis_label(name: str) -> str:
    """Format the label of a quantity with its unit in the figures, such as "p_A [MPa]"."""
    unit, _ = FIGURE_UNITS[name]
    return f"{name} [{unit}]"


def _line_curve(run: SimulatedRun, name: str, label: str, role: Role) -> FigureCurve:
    """Build the curve of an output of a run over time, in the figures' unit."""
    _, scale = FIGURE_UNITS[name]
    return FigureCurve(run.t, run.outputs[name] * scale, label, role)


def _mark_points(curve: FigureCurve) -> FigureCurve:
    """Convert a line to 80 to 159 marks (fewer if it is shorter), which leave a coinciding curve visible."""
    step = max(1, curve.x.size // _N_MARKS)
    return replace(curve, x=curve.x[::step], y=curve.y[::step], label=f"{curve.label} (the same)", kind="points")


def _solver_curves(runs: cases.Runs, name: str) -> tuple[FigureCurve, ...]:
    """Build the curves of an output over time, one for each solver whose run did not diverge.

    If both coincide (rms difference below 0.5 % of the output's range), the thesis's solver is drawn as a few marks.
    """
    _, scale = FIGURE_UNITS[name]
    max_difference = _COINCIDENCE_FRACTION * cases.steady_range(runs["converged"], name) * scale
    curves = {solver: _line_curve(run, name, label, solver) for solver, label, run in cases.completed_runs(runs)}
    if len(curves) == 2 and _rms_difference(runs, name) < max_difference:
        return curves["converged"], _mark_points(curves["as_published"])
    return tuple(curves.values())


def _rms_difference(runs: cases.Runs, name: str) -> float:
    """Compute the rms difference of an output between the two solvers, in the figures' unit; nan if a run diverged."""
    _, scale = FIGURE_UNITS[name]
    difference = cases.steady_output(runs["as_published"], name) - cases.steady_output(runs["converged"], name)
    return float(np.sqrt(np.mean(difference**2)) * scale)


def case_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate minimum, maximum and deviation of each output in a case by solver, and the solvers' difference."""
    runs, notes = _run_case(context, item)
    rows: list[tuple[Cell, ...]] = []
    for name, (_, scale) in FIGURE_UNITS.items():
        if name == "u":  # the command, the same for both solvers
            continue
        row: list[Cell] = [_axis_label(name)]
        for run in runs.values():
            values = cases.steady_output(run, name) * scale
            row += [None if run.diverged else float(statistic(values)) for statistic in (np.min, np.max, np.std)]
        rows.append((*row, _rms_difference(runs, name)))
    statistics = ("least", "greatest", "rms about mean")
    heads = [f"{statistic}, {cases.LABELS[solver]}" for solver in runs for statistic in statistics]
    columns = ("quantity", *heads, "rms of the difference")
    return (item.table(rows, f"Numbers {cases.WINDOW}. {notes}", columns, resolved=cases.all_resolved(runs)),)


def time_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the quantities that `item.inputs` names, such as "p_A", over time in a case, by solver."""
    runs, notes = _run_case(context, item)
    command, _ = cases.CASES[item.inputs["case"]]
    t = runs["converged"].t
    panels, numbers = [], []
    for letter, name in zip("abc", item.inputs["quantities"], strict=False):  # three at most
        if name == "u":
            curves: tuple[FigureCurve, ...] = (FigureCurve(t, parse_command(command).volts(t), command, "command"),)
        else:
            curves = _solver_curves(runs, name)
            unit, scale = FIGURE_UNITS[name]
            ranges = [(label, cases.steady_range(run, name) * scale) for _, label, run in cases.completed_runs(runs)]
            numbers += [Number(f"range of {name}, {label}", value, unit) for label, value in ranges]
            numbers.append(Number(f"rms of the difference in {name}", _rms_difference(runs, name), unit))
        panels.append(Panel("t [s]", _axis_label(name), curves, f"({letter})"))
    return (item.figure(panels, numbers, cases.all_resolved(runs), notes),)


def orifice_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the pressures on both sides of an orifice, and their difference, by solver (Figs. 4.13, 4.14)."""
    runs, notes = _run_case(context, item)
    pump, chamber = item.inputs["quantities"]
    panels, differences, numbers = [], [], []
    # the converged run first; a run that diverged has no panel
    for letter, (role, label, run) in zip("ab", reversed(cases.completed_runs(runs)), strict=False):
        panels.append(Panel("t [s]", "pressure [MPa]", _orifice_curves(run, pump, chamber), f"({letter}) {label}"))
        differences.append(FigureCurve(run.t, (run.outputs[pump] - run.outputs[chamber]) * 1e-6, label, role))
        peak_difference = float(cases.steady_output(run, pump).max() - cases.steady_output(run, chamber).max()) * 1e-6
        numbers += [
            Number(f"mean of {pump} - {chamber}, {label}", cases.mean_difference(run, pump, chamber) * 1e-6, "MPa"),
            Number(f"peak of {pump} less peak of {chamber}, {label}", peak_difference, "MPa"),
        ]
    panels.append(Panel("t [s]", f"{pump} - {chamber} [MPa]", tuple(differences), "(c) Difference"))
    return (item.figure(panels, numbers, cases.all_resolved(runs), notes),)


def _orifice_curves(run: SimulatedRun, pump: str, chamber: str) -> tuple[FigureCurve, ...]:
    """Build the curves of the pressures `pump` and `chamber`; if both coincide, the pump's is drawn as a few marks."""
    chamber_curve = _line_curve(run, chamber, chamber, "A" if chamber == "p_A" else "B")
    pump_curve = _line_curve(run, pump, pump, "reference")
    rms_difference = float(np.sqrt(np.mean((cases.steady_output(run, pump) - cases.steady_output(run, chamber)) ** 2)))
    if rms_difference >= _COINCIDENCE_FRACTION * cases.steady_range(run, chamber):
        return pump_curve, chamber_curve
    return chamber_curve, _mark_points(pump_curve)


def _sweep_curves(
    template: str,
    sweep: Mapping[float, cases.Runs],
    measure: Callable[[SimulatedRun], float],
    solvers: Sequence[cases.Solver],
) -> tuple[tuple[FigureCurve, ...], list[Number]]:
    """Build a curve of a measure over a varied parameter for each solver, and list the curves' points as numbers [MPa].

    `template`: name of a number, with a placeholder for the parameter's value; `sweep`: runs by this value; `measure`:
    computes the measure [Pa] of a run, such as the range of a pressure.
    """
    curves, numbers = [], []
    for solver in solvers:
        values = [measure(runs[solver]) * 1e-6 for runs in sweep.values()]
        curves.append(FigureCurve(np.array(list(sweep)), np.array(values), cases.LABELS[solver], solver))
        pairs = zip(sweep, values, strict=True)
        numbers += [
            Number(f"{template.format(varied)}, {cases.LABELS[solver]}", value, "MPa") for varied, value in pairs
        ]
    return tuple(curves), numbers


def closing_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw a pressure with orifices that are 25, 50 and 75 % closed, and its range over the closing, by solver."""
    name, reading = item.inputs["quantity"], item_reading(item)
    sweep = {closed: cases.run_both_solvers(context, cases.COMMAND, closed, reading) for closed in cases.CLOSINGS}
    panels = []
    for letter, solver in zip("ab", cases.SOLVERS, strict=True):
        curves = tuple(
            _line_curve(runs[solver], name, f"{closed:g} % closed", _CLOSING_ROLES[closed])
            for closed, runs in sweep.items()
            if not runs[solver].diverged
        )
        panels.append(Panel("t [s]", _axis_label(name), curves, f"({letter}) {cases.LABELS[solver]}"))
    ranges, numbers = _sweep_curves(
        "range at {:g} % closed", sweep, lambda run: cases.steady_range(run, name), cases.SOLVERS
    )
    panels.append(Panel("closed [%]", f"range of {name} [MPa]", ranges, "(c) Range against closing"))
    resolved = all(map(cases.all_resolved, sweep.values()))
    return (item.figure(panels, numbers, resolved, _run_notes(list(sweep.values()), reading)),)


def volume_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw ranges of p_1 and p_A and mean of p_1 - p_A over the line volumes V_1 = V_2, which the thesis omits."""
    command, closed = "3 sin(4t)", 25.0  # closed [%]
    volumes = _QUICK_VOLUMES if context.quick else _VOLUMES
    sweep = {
        volume: cases.run_both_solvers(context, command, closed, cases.Reading(V_line_cm3=volume)) for volume in volumes
    }
    measures: dict[str, Callable[[SimulatedRun], float]] = {
        "range of p_1": lambda run: cases.steady_range(run, "p_1"),
        "range of p_A": lambda run: cases.steady_range(run, "p_A"),
        "mean of p_1 - p_A": lambda run: cases.mean_difference(run, "p_1", "p_A"),
    }
    panels, numbers = [], []
    for letter, (name, measure) in zip("abc", measures.items(), strict=True):
        curves, curve_numbers = _sweep_curves(f"{name} at {{:g}} cm3", sweep, measure, list(cases.LABELS))
        panels.append(Panel("V_1 = V_2 [cm3]", f"{name} [MPa]", curves, f"({letter})", log_x=True))
        numbers += curve_numbers
    notes = format_note("volumes", command=command, closed=closed, reading=cases.DEFAULT_READING.title)
    return (item.figure(panels, numbers, all(map(cases.all_resolved, sweep.values())), notes),)


def measured_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the figures of chapter 4 with measured curves only, and the simulated figures that replace them."""
    rows = ((*row, "cannot be reproduced: no numbers are given") for row in load_texts("cases.toml")["measured"])
    return (item.table(rows, format_note("measured-only")),)
