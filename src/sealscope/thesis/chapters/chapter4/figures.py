"""Chapter 4: the cases of Tables 4.2 and 4.3 and the simulated curves of Figs. 4.4-4.36, as the thesis integrated them
and converged."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from sealscope.recordings.chambers import CHAMBERS, PRESSURES
from sealscope.thesis.chapters.chapter4.cases import (
    AS_PRINTED,
    CASES,
    CLOSINGS,
    OURS,
    WINDOW,
    Case,
    Pair,
    Reading,
    mean_difference,
    pair,
    settled,
    span,
)
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Curve, Figure, Number, Panel, Role, Table, thinned

#: Unit and factor from SI of what the figures show.
QUANTITIES: dict[str, tuple[str, float]] = {
    "u": ("V", 1.0),
    "omega": ("rad/s", 1.0),
    "x": ("mm", 1e3),
    "p_1": ("MPa", 1e-6),
    "p_2": ("MPa", 1e-6),
    "p_A": ("MPa", 1e-6),
    "p_B": ("MPa", 1e-6),
    "Q_A": ("L/min", 6e4),
    "Q_B": ("L/min", 6e4),
}
_LETTERS = "abcdefgh"
_COMPARED = "5 sin(2t)"  # the command of section 4.3
_VACUUM = -0.101325
_WITHOUT_MEASURED = "The thesis also draws the curve measured on its rig, whose numbers it does not give."
#: Two curves nearer than this share of their range (rms) lie on each other: one is drawn as so many marks.
_ALIKE, _MARKS = 0.005, 80
_SPLIT: dict[float, Role] = {25.0: "25 %", 50.0: "50 %", 75.0: "75 %"}


def _reading_inputs(reading: Reading) -> tuple[tuple[str, str | float], ...]:
    return tuple((field.name, getattr(reading, field.name)) for field in fields(Reading))


def _case_items() -> list[Item]:
    return [
        Item(
            f"table-{case.name}",
            4,
            "case",
            f"Case {case.name[:3]} {case.name[-1]}): {case.title}",
            f"{__name__}:case_table",
            (("case", case.name), *_reading_inputs(OURS)),
        )
        for case in CASES.values()
    ]


def _figure(number: str, title: str, case: str, shown: tuple[str, ...], make: str = "course") -> Item:
    return Item(
        f"fig-{number}",
        4,
        "figure",
        f"{title}: {CASES[case].title}",
        f"{__name__}:{make}",
        (("case", case), ("quantities", shown), *_reading_inputs(OURS)),
    )


def _without_orifice() -> list[Item]:
    found = []
    for first, case in zip((4, 6, 8), ("4.2-a", "4.2-b", "4.2-c"), strict=True):
        found.append(_figure(f"4.{first}", "Command, motor speed and displacement", case, ("u", "omega", "x")))
        found.append(_figure(f"4.{first + 1}", "Chamber pressures", case, CHAMBERS))
    return found


def _with_orifice() -> list[Item]:
    at = {"a": 10, "b": 17, "c": 19, "d": 21, "e": 23, "f": 25, "g": 27, "h": 29, "i": 31}
    found = []
    for letter, first in at.items():
        case = f"4.3-{letter}"
        found.append(_figure(f"4.{first}", "Pump pressures", case, ("p_1", "p_2")))
        found.append(_figure(f"4.{first + 1}", "Chamber pressures", case, CHAMBERS))
        if letter == "a":
            found.append(_figure("4.12", "Flows through the orifices", case, ("Q_A", "Q_B")))
            found += _both_ends("4.13", ("p_1", "p_A")) + _both_ends("4.14", ("p_2", "p_B"))
    return found


def _both_ends(number: str, shown: tuple[str, str]) -> list[Item]:
    usual = _figure(number, f"{shown[0]} and {shown[1]}", "4.3-a", shown, "across_orifice")
    return [usual, _as_printed(usual)]


def _as_printed(item: Item) -> Item:
    """The same figure under the reading that takes eqs. (4.11), (4.12) and the text's 3.75 mm of 5 mm at their word."""
    inputs = {**dict(item.inputs), **dict(_reading_inputs(AS_PRINTED))}
    title = f"{item.title}, equations as printed, 3.75 mm of 5 mm open"
    if "%" not in item.title:
        title = f"{item.title}, equations as printed, closed by diameter of 5 mm"
    return Item(f"{item.id}-printed", 4, "figure", title, item.make, tuple(inputs.items()))


def _openings() -> list[Item]:
    found = []
    for number, name, where in zip(
        ("4.33", "4.34", "4.35", "4.36"),
        PRESSURES,
        ("pump inlet", "pump outlet", "chamber A", "chamber B"),
        strict=True,
    ):
        inputs = (("quantity", name), ("command", _COMPARED), *_reading_inputs(OURS))
        usual = Item(
            f"fig-{number}",
            4,
            "figure",
            f"{name} ({where}) over the openings, {_COMPARED}",
            f"{__name__}:openings",
            inputs,
        )
        found += [usual, _as_printed(usual)]
    return found


ITEMS: tuple[Item, ...] = (
    Item("fig-4.2", 4, "figure", "Friction models", "sealscope.thesis.chapters.chapter4.friction:friction_models"),
    Item(
        "fig-4.3",
        4,
        "figure",
        "Friction against velocity: the Stribeck curve",
        "sealscope.thesis.chapters.chapter4.friction:stribeck_curve",
    ),
    *_case_items(),
    *_without_orifice(),
    *_with_orifice(),
    *_openings(),
    Item(
        "chapter-4-measured",
        4,
        "table",
        "Curves of chapter 4 that only the rig can give",
        f"{__name__}:measured_only",
    ),
    Item(
        "chapter-4-volumes",
        4,
        "figure",
        "What the line volumes V_1 = V_2 do",
        "sealscope.thesis.chapters.chapter4.volumes:volume_sweep",
    ),
)


def reading_of(item: Item) -> Reading:
    """The reading of the equations that an item asks for."""
    inputs = dict(item.inputs)
    return Reading(**{field.name: inputs[field.name] for field in fields(Reading)})  # type: ignore[arg-type]


def case_of(item: Item) -> Case:
    """The case of Table 4.2 or 4.3 that an item shows."""
    return CASES[str(item.input("case"))]


def _label(name: str) -> str:
    return f"{name} [{QUANTITIES[name][0]}]"


def _shown(pair: Pair, name: str) -> tuple[Curve, ...]:
    factor = QUANTITIES[name][1]
    curves = [Curve(*thinned(run.t, run.outputs[name] * factor), label, role) for role, label, run in pair.runs()]
    if len(curves) == 2 and _difference(pair, name) < _ALIKE * span(pair.converged, name) * factor:
        few = slice(None, None, max(1, pair.literal.t.size // _MARKS))
        t, y = pair.literal.t[few], pair.literal.outputs[name][few] * factor
        curves = [curves[1], Curve(t, y, f"{curves[0].label} (the same)", "literal", "points")]
    return tuple(curves)


def _difference(pair: Pair, name: str) -> float:
    """Rms of the difference between the two runs over the steady periods, in the figure's unit; nan if one diverged."""
    if len(pair.runs()) < 2:
        return float("nan")
    gap = settled(pair.literal, name) - settled(pair.converged, name)
    return float(np.sqrt(np.mean(gap**2)) * QUANTITIES[name][1])


def _notes(pair: Pair, case: Case, reading: Reading) -> str:
    words = [_WITHOUT_MEASURED]
    if case.closed_pct is not None:
        words.append(f"Reading: {reading.title}.")
    for _, label, run in pair.runs():
        lowest = min(float(run.outputs[name].min()) for name in PRESSURES) * 1e-6
        if lowest < _VACUUM:
            words.append(f"With {label} a pressure falls to {lowest:.2f} MPa, below vacuum, which oil cannot.")
    words += [f"{run.diverged}." for run in (pair.literal, pair.converged) if run.diverged]
    if not pair.literal.resolved and pair.converged.resolved:
        words.append("The converged run passes the halving test, the one with RK4 at 1e-4 s does not.")
    return " ".join(words)


def case_table(context: Context, item: Item) -> tuple[Table, ...]:
    """Key numbers of one case: least, greatest and rms about the mean of every quantity, with RK4 at 1e-4 s and
    converged."""
    case, reading = case_of(item), reading_of(item)
    both = pair(context, case, reading)
    rows = []
    for name in ("omega", "x", "p_1", "p_2", "p_A", "p_B", "Q_A", "Q_B"):
        factor = QUANTITIES[name][1]
        row: list[float | str | None] = [_label(name)]
        for run in (both.literal, both.converged):
            if run.diverged:
                row += [None, None, None]
                continue
            values = settled(run, name) * factor
            row += [float(values.min()), float(values.max()), float(values.std())]
        rows.append((*row, _difference(both, name)))
    columns = (
        "quantity",
        *(f"{what}, {how}" for how in ("RK4 1e-4 s", "converged") for what in ("least", "greatest", "rms about mean")),
        "rms of the difference",
    )
    notes = f"Numbers {WINDOW}. {_notes(both, case, reading)}"
    return (Table(item.id, item.title, columns, tuple(rows), (), both.resolved, notes),)


def course(context: Context, item: Item) -> tuple[Figure, ...]:
    """The named quantities over time, each with the thesis's method and step and converged on one axis."""
    from sealscope.simulation.commands import parse_command

    case, reading = case_of(item), reading_of(item)
    both = pair(context, case, reading)
    names = tuple(str(name) for name in item.input("quantities"))  # type: ignore[union-attr]
    panels, numbers = [], []
    for letter, name in zip(_LETTERS, names, strict=False):
        if name == "u":
            t = both.converged.t
            command = Curve(*thinned(t, parse_command(case.command).volts(t)), case.command, "command")
            panels.append(Panel("t [s]", _label(name), (command,), f"({letter})"))
            continue
        panels.append(Panel("t [s]", _label(name), _shown(both, name), f"({letter})"))
        unit, factor = QUANTITIES[name]
        numbers += [
            Number(f"range of {name}, {label}", span(run, name) * factor, unit) for _, label, run in both.runs()
        ]
        numbers.append(Number(f"rms of the difference in {name}", _difference(both, name), unit))
    claims = _CLAIMS.get(item.id.removeprefix("fig-"), ())
    return (
        Figure(item.id, item.title, tuple(panels), tuple(numbers), claims, both.resolved, _notes(both, case, reading)),
    )


def across_orifice(context: Context, item: Item) -> tuple[Figure, ...]:
    """The pressures at both ends of one orifice, converged and with RK4 at 1e-4 s, and their difference (Figs. 4.13,
    4.14)."""
    case, reading = case_of(item), reading_of(item)
    both = pair(context, case, reading)
    pump, chamber = (str(name) for name in item.input("quantities"))  # type: ignore[union-attr]
    end: Role = "A" if chamber == "p_A" else "B"
    panels, gaps, numbers = [], [], []
    for letter, (role, label, run) in zip("ab", reversed(both.runs()), strict=False):
        both_ends = _both_pressures(run, pump, chamber, end)
        panels.append(Panel("t [s]", "pressure [MPa]", both_ends, f"({letter}) {label}"))
        gap = (run.outputs[pump] - run.outputs[chamber]) * 1e-6
        gaps.append(Curve(*thinned(run.t, gap), label, role))
        peak_gap = float(settled(run, pump).max() - settled(run, chamber).max()) * 1e-6
        numbers += [
            Number(f"mean of {pump} - {chamber}, {label}", mean_difference(run, pump, chamber) * 1e-6, "MPa"),
            Number(f"peak of {pump} less peak of {chamber}, {label}", peak_gap, "MPa"),
        ]
    panels.append(Panel("t [s]", f"{pump} - {chamber} [MPa]", tuple(gaps), "(c) Difference"))
    return (
        Figure(
            item.id,
            item.title,
            tuple(panels),
            tuple(numbers),
            ("claim-4.10", "claim-4.11") if pump == "p_1" else ("claim-4.10", "claim-4.12"),
            both.resolved,
            _notes(both, case, reading),
        ),
    )


def _both_pressures(run: SimulatedRun, pump: str, chamber: str, end: Role) -> tuple[Curve, ...]:
    """Both pressures over time [MPa]; the pump's as marks where it lies on the chamber's."""
    at_chamber = Curve(*thinned(run.t, run.outputs[chamber] * 1e-6), chamber, end)
    apart = float(np.sqrt(np.mean((settled(run, pump) - settled(run, chamber)) ** 2)))
    if apart >= _ALIKE * span(run, chamber):
        return Curve(*thinned(run.t, run.outputs[pump] * 1e-6), pump, "reference"), at_chamber
    few = slice(None, None, max(1, run.t.size // _MARKS))
    return at_chamber, Curve(run.t[few], run.outputs[pump][few] * 1e-6, f"{pump} (the same)", "reference", "points")


def openings(context: Context, item: Item) -> tuple[Figure, ...]:
    """One pressure at 25, 50 and 75 % closed, converged and with RK4 at 1e-4 s, and its range against the closing."""
    name, command, reading = str(item.input("quantity")), str(item.input("command")), reading_of(item)
    pairs = {closed: pair(context, Case("", command, closed), reading) for closed in CLOSINGS}
    panels, numbers, ranges = [], [], []
    for letter, role, label in (("a", "converged", "converged"), ("b", "literal", "RK4, 1e-4 s")):
        runs = {closed: getattr(pairs[closed], role) for closed in CLOSINGS}
        curves = tuple(
            Curve(*thinned(run.t, run.outputs[name] * 1e-6), f"{closed:g} % closed", _SPLIT[closed])
            for closed, run in runs.items()
            if not run.diverged
        )
        panels.append(Panel("t [s]", _label(name), curves, f"({letter}) {label}"))
        spans = np.array([span(run, name) * 1e-6 for run in runs.values()])
        kind: Role = "converged" if role == "converged" else "literal"
        ranges.append(Curve(np.array(CLOSINGS), spans, label, kind))
        numbers += [
            Number(f"range at {closed:g} % closed, {label}", float(one), "MPa")
            for closed, one in zip(CLOSINGS, spans, strict=True)
        ]
    panels.append(Panel("closed [%]", f"range of {name} [MPa]", tuple(ranges), "(c) Range against closing"))
    resolved = all(one.resolved for one in pairs.values())
    tightest = Case("", command, CLOSINGS[-1])
    notes = _notes(pairs[CLOSINGS[-1]], tightest, reading)
    return (Figure(item.id, item.title, tuple(panels), tuple(numbers), ("claim-4.16",), resolved, notes),)


def measured_only(context: Context, item: Item) -> tuple[Table, ...]:
    """The figures of chapter 4 that show measured curves alone, and what stands in their place here."""
    rows = tuple(
        (number, shown, f"fig-{beside}", "cannot be reproduced: no numbers are given")
        for number, shown, beside in (
            ("Fig. 4.15", "measured p_1 and p_A, 25 % closed", "4.13"),
            ("Fig. 4.16", "measured p_2 and p_B, 25 % closed", "4.14"),
            ("Fig. 4.37", "measured p_1 over the openings", "4.33"),
            ("Fig. 4.38", "measured p_2 over the openings", "4.34"),
            ("Fig. 4.39", "measured p_A over the openings", "4.35"),
            ("Fig. 4.40", "measured p_B over the openings", "4.36"),
        )
    )
    notes = (
        "The measured curves beside the simulated ones in Figs. 4.4-4.11 and 4.17-4.32 are missing for the same reason."
    )
    return (Table(item.id, item.title, ("figure", "what it shows", "simulated", "why"), rows, (), None, notes),)


#: Claims that a figure bears on, by its number.
_CLAIMS: dict[str, tuple[str, ...]] = {
    "4.4": ("claim-4.1", "claim-4.2", "claim-4.4"),
    "4.5": ("claim-4.5",),
    "4.6": ("claim-4.4",),
    "4.8": ("claim-4.4",),
    "4.10": ("claim-4.7", "claim-4.8"),
    "4.11": ("claim-4.7", "claim-4.8"),
    "4.12": ("claim-4.9",),
    **{f"4.{n}": ("claim-4.14",) for n in (21, 22, 25)},
    "4.26": ("claim-4.14", "claim-4.15"),
}
