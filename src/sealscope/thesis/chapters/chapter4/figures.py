"""Chapter 4: the cases of Tables 4.2 and 4.3 and the simulated curves of Figs. 4.4-4.36, with both solvers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields

import numpy as np

from sealscope.recordings.chambers import CHAMBERS, PRESSURES
from sealscope.thesis.chapters.chapter4.cases import (
    AS_PRINTED,
    CASES,
    CLOSINGS,
    COMMAND,
    LABELS,
    OURS,
    WINDOW,
    Reading,
    Solver,
    SolverPair,
    mean_difference,
    run_pair,
    span,
    steady_output,
)
from sealscope.thesis.chapters.chapter4.friction import friction_models, stribeck_curve
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Figure, FigureCurve, Number, Panel, Role, ThesisTable
from sealscope.thesis.texts import note
from sealscope.units import LITRE_PER_MINUTE

#: Unit and factor from SI of what the figures show.
OUTPUTS: dict[str, tuple[str, float]] = {
    "u": ("V", 1.0),
    "omega": ("rad/s", 1.0),
    "x": ("mm", 1e3),
    **dict.fromkeys(PRESSURES, ("MPa", 1e-6)),
    **dict.fromkeys(("Q_A", "Q_B"), ("L/min", 1.0 / LITRE_PER_MINUTE)),
}
_VACUUM = -0.101325
#: Two curves nearer than this share of their range (rms) lie on each other: one is drawn as so many marks.
_ALIKE, _MARKS = 0.005, 80
_CLOSING_ROLES: dict[float, Role] = {25.0: "25 %", 50.0: "50 %", 75.0: "75 %"}
_VOLUMES, _QUICK_VOLUMES = (10.0, 20.0, 44.0, 100.0, 234.0, 500.0), (10.0, 44.0, 234.0)
#: Claims 4.n that a figure bears on, by the figure's number.
_CLAIMS = {4: (1, 2, 4), 5: (5,), 6: (4,), 8: (4,), 10: (7, 8), 11: (7, 8), 12: (9,)} | {
    13: (10, 11), 14: (10, 12), 21: (14,), 22: (14,), 25: (14,), 26: (14, 15)
}  # fmt: skip
#: Figures of measured curves alone, and the simulated ones in their place.
_MEASURED = (
    ("Fig. 4.15", "measured p_1 and p_A, 25 % closed", "fig-4.13"),
    ("Fig. 4.16", "measured p_2 and p_B, 25 % closed", "fig-4.14"),
    *(
        (f"Fig. 4.{number + 4}", f"measured {name} over the openings", f"fig-4.{number}")
        for number, name in enumerate(PRESSURES, 33)
    ),
)


def reading_of(item: Item) -> Reading:
    """Return the reading of the equations that an item asks for."""
    return Reading(**{field.name: item.inputs[field.name] for field in fields(Reading)})


def _case_of(context: Context, item: Item) -> tuple[SolverPair, str]:
    """Run the case of Table 4.2 or 4.3 that an item shows; return it with the notes on it."""
    case, reading = CASES[item.inputs["case"]], reading_of(item)
    pair = run_pair(context, case.command, case.closed_pct, reading)
    return pair, _notes(pair, reading if case.closed_pct is not None else None)


def _notes(pair: SolverPair, reading: Reading | None) -> str:
    """Return the notes on a figure of a pair; `reading`: None without orifices."""
    notes = [note("measured-curve")]
    if reading is not None:
        notes.append(f"Reading: {reading.title}.")
    for _, label, run in pair.runs():
        lowest = min(float(run.outputs[name].min()) for name in PRESSURES) * 1e-6
        if lowest < _VACUUM:
            notes.append(note("vacuum", label=label, lowest=lowest))
    notes += [f"{run.diverged}." for run in (pair.literal, pair.converged) if run.diverged]
    if not pair.literal.resolved and pair.converged.resolved:
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


def _both_solvers(pair: SolverPair, name: str) -> tuple[FigureCurve, ...]:
    if len(pair.runs()) == 2 and _difference(pair, name) < _ALIKE * span(pair.converged, name) * OUTPUTS[name][1]:
        same = _marks(pair.literal, name, LABELS["literal"], "literal")
        return _line(pair.converged, name, LABELS["converged"], "converged"), same
    return tuple(_line(run, name, label, solver) for solver, label, run in pair.runs())


def _difference(pair: SolverPair, name: str) -> float:
    """Rms of the difference between the two runs over the steady periods, in the figure's unit; nan if one diverged."""
    gap = steady_output(pair.literal, name) - steady_output(pair.converged, name)
    return float(np.sqrt(np.mean(gap**2)) * OUTPUTS[name][1])


def case_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate a case: least, greatest and rms about the mean of every quantity, with RK4 at 1e-4 s and converged."""
    pair, notes = _case_of(context, item)
    rows: list[tuple[Cell, ...]] = []
    for name in list(OUTPUTS)[1:]:
        row: list[Cell] = [_label(name)]
        for run in (pair.literal, pair.converged):
            values = steady_output(run, name) * OUTPUTS[name][1]
            row += [None if run.diverged else float(of(values)) for of in (np.min, np.max, np.std)]
        rows.append((*row, _difference(pair, name)))
    heads = [
        f"{what}, {how}" for how in ("RK4 1e-4 s", "converged") for what in ("least", "greatest", "rms about mean")
    ]
    columns = ("quantity", *heads, "rms of the difference")
    return (ThesisTable(item.id, item.title, columns, tuple(rows), (), pair.resolved, f"Numbers {WINDOW}. {notes}"),)


def _figure(
    item: Item, panels: Sequence[Panel], numbers: Sequence[Number], resolved: bool, notes: str, claims: Sequence[int]
) -> tuple[Figure, ...]:
    ids = tuple(f"claim-4.{number}" for number in claims)
    return (Figure(item.id, item.title, tuple(panels), tuple(numbers), ids, resolved, notes),)


def over_time(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the named quantities over time, each with both solvers on one axis."""
    from sealscope.simulation.commands import parse_command

    pair, notes = _case_of(context, item)
    command, t = CASES[item.inputs["case"]].command, pair.converged.t
    panels, numbers = [], []
    for letter, name in zip("abc", item.inputs["quantities"], strict=False):
        if name == "u":
            curves: tuple[FigureCurve, ...] = (FigureCurve(t, parse_command(command).volts(t), command, "command"),)
        else:
            curves = _both_solvers(pair, name)
            unit, factor = OUTPUTS[name]
            ranges = [(label, span(run, name) * factor) for _, label, run in pair.runs()]
            numbers += [Number(f"range of {name}, {label}", value, unit) for label, value in ranges]
            numbers.append(Number(f"rms of the difference in {name}", _difference(pair, name), unit))
        panels.append(Panel("t [s]", _label(name), curves, f"({letter})"))
    return _figure(item, panels, numbers, pair.resolved, notes, item.inputs["claims"])


def across_orifice(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the pressures at both ends of one orifice and their difference, with both solvers (Figs. 4.13, 4.14)."""
    pair, notes = _case_of(context, item)
    pump, chamber = item.inputs["quantities"]
    panels, gaps, numbers = [], [], []
    for letter, (role, label, run) in zip("ab", reversed(pair.runs()), strict=False):
        panels.append(Panel("t [s]", "pressure [MPa]", _both_ends(run, pump, chamber), f"({letter}) {label}"))
        gaps.append(FigureCurve(run.t, (run.outputs[pump] - run.outputs[chamber]) * 1e-6, label, role))
        peak_gap = float(steady_output(run, pump).max() - steady_output(run, chamber).max()) * 1e-6
        numbers += [
            Number(f"mean of {pump} - {chamber}, {label}", mean_difference(run, pump, chamber) * 1e-6, "MPa"),
            Number(f"peak of {pump} less peak of {chamber}, {label}", peak_gap, "MPa"),
        ]
    panels.append(Panel("t [s]", f"{pump} - {chamber} [MPa]", tuple(gaps), "(c) Difference"))
    return _figure(item, panels, numbers, pair.resolved, notes, item.inputs["claims"])


def _both_ends(run: SimulatedRun, pump: str, chamber: str) -> tuple[FigureCurve, ...]:
    """Both pressures over time; the pump's as marks where it lies on the chamber's."""
    at_chamber = _line(run, chamber, chamber, "A" if chamber == "p_A" else "B")
    apart = float(np.sqrt(np.mean((steady_output(run, pump) - steady_output(run, chamber)) ** 2)))
    if apart >= _ALIKE * span(run, chamber):
        return _line(run, pump, pump, "reference"), at_chamber
    return at_chamber, _marks(run, pump, pump, "reference")


def _swept(
    name: str, pairs: Mapping[float, SolverPair], measure: Callable[[SimulatedRun], float], solvers: Sequence[Solver]
) -> tuple[tuple[FigureCurve, ...], list[Number]]:
    """Draw a measure [Pa] over what was varied, in MPa, with its numbers; `name` has a place for what was varied."""
    curves, numbers = [], []
    for solver in solvers:
        values = [measure(pair.of(solver)) * 1e-6 for pair in pairs.values()]
        curves.append(FigureCurve(np.array(list(pairs)), np.array(values), LABELS[solver], solver))
        of = zip(pairs, values, strict=True)
        numbers += [Number(f"{name.format(at)}, {LABELS[solver]}", value, "MPa") for at, value in of]
    return tuple(curves), numbers


def openings(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw one pressure at 25, 50 and 75 % closed with both solvers, and its range against the closing."""
    name, command, reading = item.inputs["quantity"], item.inputs["command"], reading_of(item)
    pairs = {closed: run_pair(context, command, closed, reading) for closed in CLOSINGS}
    solvers: tuple[Solver, ...] = ("converged", "literal")
    panels = []
    for letter, solver in zip("ab", solvers, strict=True):
        runs = {closed: pair.of(solver) for closed, pair in pairs.items() if not pair.of(solver).diverged}
        curves = [_line(run, name, f"{closed:g} % closed", _CLOSING_ROLES[closed]) for closed, run in runs.items()]
        panels.append(Panel("t [s]", _label(name), tuple(curves), f"({letter}) {LABELS[solver]}"))
    ranges, numbers = _swept("range at {:g} % closed", pairs, lambda run: span(run, name), solvers)
    panels.append(Panel("closed [%]", f"range of {name} [MPa]", ranges, "(c) Range against closing"))
    resolved = all(pair.resolved for pair in pairs.values())
    return _figure(item, panels, numbers, resolved, _notes(pairs[CLOSINGS[-1]], reading), (16,))


def volume_sweep(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the range of p_1 and p_A and their mean difference over V_1 = V_2, which the thesis does not give."""
    command, closed = "3 sin(4t)", 25.0
    volumes = _QUICK_VOLUMES if context.quick else _VOLUMES
    pairs = {volume: run_pair(context, command, closed, Reading(V_line_cm3=volume)) for volume in volumes}
    measures: dict[str, Callable[[SimulatedRun], float]] = {
        "range of p_1": lambda run: span(run, "p_1"),
        "range of p_A": lambda run: span(run, "p_A"),
        "mean of p_1 - p_A": lambda run: mean_difference(run, "p_1", "p_A"),
    }
    panels, numbers = [], []
    for letter, (what, measure) in zip("abc", measures.items(), strict=True):
        curves, added = _swept(f"{what} at {{:g}} cm3", pairs, measure, list(LABELS))
        panels.append(Panel("V_1 = V_2 [cm3]", f"{what} [MPa]", curves, f"({letter})", log_x=True))
        numbers += added
    notes = note("volumes", command=command, closed=closed, reading=OURS.title)
    return _figure(item, panels, numbers, all(pair.resolved for pair in pairs.values()), notes, (1,))


def measured_only(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the figures of chapter 4 that show measured curves alone, and the simulated ones in their place."""
    rows = tuple((*row, "cannot be reproduced: no numbers are given") for row in _MEASURED)
    heads = ("figure", "what it shows", "simulated", "why")
    return (ThesisTable(item.id, item.title, heads, rows, notes=note("measured-only")),)


def _of_case(number: int, title: str, case: str, quantities: tuple[str, ...]) -> Item:
    inputs = {"case": case, "quantities": quantities, "claims": _CLAIMS.get(number, ()), **asdict(OURS)}
    make = across_orifice if number in (13, 14) else over_time
    return Item(f"fig-4.{number}", 4, "figure", f"{title}: {CASES[case].title}", make, inputs)


def _with_printed(item: Item) -> tuple[Item, Item]:
    """Return a figure, and the same under the reading that takes the equations as printed and 3.75 mm of 5 mm open."""
    closed = "3.75 mm of 5 mm open" if "%" in item.title else "closed by diameter of 5 mm"
    title = f"{item.title}, equations as printed, {closed}"
    return item, Item(f"{item.id}-printed", 4, "figure", title, item.make, {**item.inputs, **asdict(AS_PRINTED)})


def _items() -> list[Item]:
    items = [
        Item("fig-4.2", 4, "figure", "Friction models", friction_models),
        Item("fig-4.3", 4, "figure", "Friction against velocity: the Stribeck curve", stribeck_curve),
    ]
    for case in CASES.values():
        title = f"Case {case.name[:3]} {case.name[-1]}): {case.title}"
        items.append(Item(f"table-{case.name}", 4, "case", title, case_table, {"case": case.name, **asdict(OURS)}))
    for first, name in zip((4, 6, 8), ("4.2-a", "4.2-b", "4.2-c"), strict=True):
        items.append(_of_case(first, "Command, motor speed and displacement", name, ("u", "omega", "x")))
        items.append(_of_case(first + 1, "Chamber pressures", name, CHAMBERS))
    for first, letter in zip((10, 17, 19, 21, 23, 25, 27, 29, 31), "abcdefghi", strict=True):
        items.append(_of_case(first, "Pump pressures", f"4.3-{letter}", ("p_1", "p_2")))
        items.append(_of_case(first + 1, "Chamber pressures", f"4.3-{letter}", CHAMBERS))
        if letter == "a":
            items.append(_of_case(12, "Flows through the orifices", "4.3-a", ("Q_A", "Q_B")))
            items += _with_printed(_of_case(13, "p_1 and p_A", "4.3-a", ("p_1", "p_A")))
            items += _with_printed(_of_case(14, "p_2 and p_B", "4.3-a", ("p_2", "p_B")))
    places = ("pump inlet", "pump outlet", "chamber A", "chamber B")
    for number, (name, place) in enumerate(zip(PRESSURES, places, strict=True), start=33):
        title = f"{name} ({place}) over the openings, {COMMAND}"
        inputs = {"quantity": name, "command": COMMAND, **asdict(OURS)}
        items += _with_printed(Item(f"fig-4.{number}", 4, "figure", title, openings, inputs))
    return [
        *items,
        Item("chapter-4-measured", 4, "table", "Curves of chapter 4 that only the rig can give", measured_only),
        Item("chapter-4-volumes", 4, "figure", "What the line volumes V_1 = V_2 do", volume_sweep),
    ]


ITEMS: tuple[Item, ...] = tuple(_items())
