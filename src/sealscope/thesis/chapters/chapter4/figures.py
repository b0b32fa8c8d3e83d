"""Chapter 4: the cases of Tables 4.2 and 4.3 and the simulated curves of Figs. 4.4-4.36, with both solvers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from sealscope.recordings.chambers import PRESSURES
from sealscope.simulation.commands import parse_command
from sealscope.thesis.chapters.chapter4.cases import (
    CASES,
    CLOSINGS,
    COMMAND,
    LABELS,
    OURS,
    SOLVER_TEXT,
    SOLVERS,
    WINDOW,
    Reading,
    Runs,
    Solver,
    both_runs,
    finished_runs,
    mean_difference,
    resolved,
    span,
    steady_output,
)
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Figure, FigureCurve, Number, Panel, Role, ThesisTable
from sealscope.thesis.engine.texts import note, texts_of
from sealscope.units import LITRE_PER_MINUTE, P_ATM

#: Unit and factor from SI of what the figures show.
OUTPUTS: dict[str, tuple[str, float]] = {
    "u": ("V", 1.0),
    "omega": ("rad/s", 1.0),
    "x": ("mm", 1e3),
    **dict.fromkeys(PRESSURES, ("MPa", 1e-6)),
    **dict.fromkeys(("Q_A", "Q_B"), ("L/min", 1.0 / LITRE_PER_MINUTE)),
}
_VACUUM = -1e-6 * P_ATM
#: Two curves nearer than this share of their range (rms) lie on each other: one is drawn as so many marks.
_ALIKE, _MARKS = 0.005, 80
_CLOSING_ROLES: dict[float, Role] = {25.0: "25 %", 50.0: "50 %", 75.0: "75 %"}
_VOLUMES, _QUICK_VOLUMES = (10.0, 20.0, 44.0, 100.0, 234.0, 500.0), (10.0, 44.0, 234.0)


def reading_of(item: Item) -> Reading:
    """Return the reading of the equations that an item names."""
    return Reading(**item.inputs.get("reading", {}))


def _case_of(context: Context, item: Item) -> tuple[Runs, str]:
    """Run the case of Table 4.2 or 4.3 that an item shows; return it with its notes."""
    (command, closed_pct), reading = CASES[item.inputs["case"]], reading_of(item)
    runs = both_runs(context, command, closed_pct, reading)
    return runs, _notes(runs, reading if closed_pct is not None else None)


def _notes(runs: Runs, reading: Reading | None) -> str:
    """Write the notes on a figure of both runs; `reading`: None without orifices."""
    notes = [note("measured-curve")]
    if reading is not None:
        notes.append(f"Reading: {reading.title}.")
    for _, label, run in finished_runs(runs):
        lowest = min(float(run.outputs[name].min()) for name in PRESSURES) * 1e-6
        if lowest < _VACUUM:
            notes.append(note("vacuum", label=label, lowest=lowest))
    notes += [f"{run.diverged}." for run in runs.values() if run.diverged]
    if runs["converged"].resolved and not runs["literal"].resolved:
        notes.append(note("literal-unresolved"))
    return " ".join(notes)


def _label(name: str) -> str:
    return f"{name} [{OUTPUTS[name][0]}]"


def _line(run: SimulatedRun, name: str, label: str, role: Role) -> FigureCurve:
    return FigureCurve(run.t, run.outputs[name] * OUTPUTS[name][1], label, role)


def _marks(run: SimulatedRun, name: str, label: str, role: Role) -> FigureCurve:
    """Draw an output that lies on another curve as a few marks."""
    few = slice(None, None, max(1, run.t.size // _MARKS))
    return FigureCurve(run.t[few], run.outputs[name][few] * OUTPUTS[name][1], f"{label} (the same)", role, "points")


def _both_solvers(runs: Runs, name: str) -> tuple[FigureCurve, ...]:
    converged = runs["converged"]
    if len(finished_runs(runs)) == 2 and _difference(runs, name) < _ALIKE * span(converged, name) * OUTPUTS[name][1]:
        same = _marks(runs["literal"], name, LABELS["literal"], "literal")
        return _line(converged, name, LABELS["converged"], "converged"), same
    return tuple(_line(run, name, label, solver) for solver, label, run in finished_runs(runs))


def _difference(runs: Runs, name: str) -> float:
    """Compute the rms difference of the two runs over the steady periods, in the figure's unit; nan if one diverged."""
    gap = steady_output(runs["literal"], name) - steady_output(runs["converged"], name)
    return float(np.sqrt(np.mean(gap**2)) * OUTPUTS[name][1])


def case_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate a case: least, greatest and rms about the mean of every quantity, with RK4 at 1e-4 s and converged."""
    runs, notes = _case_of(context, item)
    rows: list[tuple[Cell, ...]] = []
    for name in list(OUTPUTS)[1:]:
        row: list[Cell] = [_label(name)]
        for run in runs.values():
            values = steady_output(run, name) * OUTPUTS[name][1]
            row += [None if run.diverged else float(statistic(values)) for statistic in (np.min, np.max, np.std)]
        rows.append((*row, _difference(runs, name)))
    heads = [f"{what}, {SOLVER_TEXT[solver]}" for solver in runs for what in ("least", "greatest", "rms about mean")]
    columns = ("quantity", *heads, "rms of the difference")
    return (item.table(rows, f"Numbers {WINDOW}. {notes}", columns, resolved=resolved(runs)),)


def over_time(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the named quantities over time, each with both solvers on one axis."""
    runs, notes = _case_of(context, item)
    (command, _), t = CASES[item.inputs["case"]], runs["converged"].t
    panels, numbers = [], []
    for letter, name in zip("abc", item.inputs["quantities"], strict=False):
        if name == "u":
            curves: tuple[FigureCurve, ...] = (FigureCurve(t, parse_command(command).volts(t), command, "command"),)
        else:
            curves = _both_solvers(runs, name)
            unit, factor = OUTPUTS[name]
            ranges = [(label, span(run, name) * factor) for _, label, run in finished_runs(runs)]
            numbers += [Number(f"range of {name}, {label}", value, unit) for label, value in ranges]
            numbers.append(Number(f"rms of the difference in {name}", _difference(runs, name), unit))
        panels.append(Panel("t [s]", _label(name), curves, f"({letter})"))
    return (item.figure(panels, numbers, resolved(runs), notes),)


def across_orifice(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the pressures at both ends of one orifice and their difference, with both solvers (Figs. 4.13, 4.14)."""
    runs, notes = _case_of(context, item)
    pump, chamber = item.inputs["quantities"]
    panels, gaps, numbers = [], [], []
    for letter, (role, label, run) in zip("ab", reversed(finished_runs(runs)), strict=False):
        panels.append(Panel("t [s]", "pressure [MPa]", _both_ends(run, pump, chamber), f"({letter}) {label}"))
        gaps.append(FigureCurve(run.t, (run.outputs[pump] - run.outputs[chamber]) * 1e-6, label, role))
        peak_gap = float(steady_output(run, pump).max() - steady_output(run, chamber).max()) * 1e-6
        numbers += [
            Number(f"mean of {pump} - {chamber}, {label}", mean_difference(run, pump, chamber) * 1e-6, "MPa"),
            Number(f"peak of {pump} less peak of {chamber}, {label}", peak_gap, "MPa"),
        ]
    panels.append(Panel("t [s]", f"{pump} - {chamber} [MPa]", tuple(gaps), "(c) Difference"))
    return (item.figure(panels, numbers, resolved(runs), notes),)


def _both_ends(run: SimulatedRun, pump: str, chamber: str) -> tuple[FigureCurve, ...]:
    """Draw both pressures over time; the pump's as marks where it lies on the chamber's."""
    at_chamber = _line(run, chamber, chamber, "A" if chamber == "p_A" else "B")
    difference = float(np.sqrt(np.mean((steady_output(run, pump) - steady_output(run, chamber)) ** 2)))
    if difference >= _ALIKE * span(run, chamber):
        return _line(run, pump, pump, "reference"), at_chamber
    return at_chamber, _marks(run, pump, pump, "reference")


def _swept(
    name: str, swept: Mapping[float, Runs], measure: Callable[[SimulatedRun], float], solvers: Sequence[Solver]
) -> tuple[tuple[FigureCurve, ...], list[Number]]:
    """Draw a measure [Pa] over the varied quantity, in MPa, with its numbers; `name` has a place for its value."""
    curves, numbers = [], []
    for solver in solvers:
        values = [measure(runs[solver]) * 1e-6 for runs in swept.values()]
        curves.append(FigureCurve(np.array(list(swept)), np.array(values), LABELS[solver], solver))
        pairs = zip(swept, values, strict=True)
        numbers += [Number(f"{name.format(varied)}, {LABELS[solver]}", value, "MPa") for varied, value in pairs]
    return tuple(curves), numbers


def openings(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw one pressure at 25, 50 and 75 % closed with both solvers, and its range against the closing."""
    name, reading = item.inputs["quantity"], reading_of(item)
    swept = {closed: both_runs(context, COMMAND, closed, reading) for closed in CLOSINGS}
    panels = []
    for letter, solver in zip("ab", SOLVERS, strict=True):
        curves = tuple(
            _line(runs[solver], name, f"{closed:g} % closed", _CLOSING_ROLES[closed])
            for closed, runs in swept.items()
            if not runs[solver].diverged
        )
        panels.append(Panel("t [s]", _label(name), curves, f"({letter}) {LABELS[solver]}"))
    ranges, numbers = _swept("range at {:g} % closed", swept, lambda run: span(run, name), SOLVERS)
    panels.append(Panel("closed [%]", f"range of {name} [MPa]", ranges, "(c) Range against closing"))
    passed = all(map(resolved, swept.values()))
    return (item.figure(panels, numbers, passed, _notes(swept[CLOSINGS[-1]], reading)),)


def volume_sweep(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the range of p_1 and p_A and their mean difference over V_1 = V_2, which the thesis does not give."""
    command, closed = "3 sin(4t)", 25.0
    volumes = _QUICK_VOLUMES if context.quick else _VOLUMES
    swept = {volume: both_runs(context, command, closed, Reading(V_line_cm3=volume)) for volume in volumes}
    measures: dict[str, Callable[[SimulatedRun], float]] = {
        "range of p_1": lambda run: span(run, "p_1"),
        "range of p_A": lambda run: span(run, "p_A"),
        "mean of p_1 - p_A": lambda run: mean_difference(run, "p_1", "p_A"),
    }
    panels, numbers = [], []
    for letter, (what, measure) in zip("abc", measures.items(), strict=True):
        curves, added = _swept(f"{what} at {{:g}} cm3", swept, measure, list(LABELS))
        panels.append(Panel("V_1 = V_2 [cm3]", f"{what} [MPa]", curves, f"({letter})", log_x=True))
        numbers += added
    notes = note("volumes", command=command, closed=closed, reading=OURS.title)
    return (item.figure(panels, numbers, all(map(resolved, swept.values())), notes),)


def measured_only(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the figures of chapter 4 that show measured curves alone, and the simulated ones in their place."""
    rows = ((*row, "cannot be reproduced: no numbers are given") for row in texts_of("cases.toml")["measured"])
    return (item.table(rows, note("measured-only")),)
