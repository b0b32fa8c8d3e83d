"""Appendix C: the 41 tests simulated, as the thesis tabulates them, beside its own sheet; and Figs. 5.90 to 5.95."""

from __future__ import annotations

import numpy as np

from sealscope.evaluation.binomial import clopper_pearson
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.appendix_c import simulation
from sealscope.thesis.chapters.appendix_c.simulation import sheet_of, table_of
from sealscope.thesis.engine.context import Context, first_table
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Figure, FigureCurve, Number, Panel, Role, ThesisTable
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG, QUANTITIES, UNITS, DataSheet

#: Figs. 5.90 to 5.95: chamber, quantity, and the direction it is said to move when a leak opens.
DIFFERENCES = tuple((c, name, way) for c, way in (("p_A", "down"), ("p_B", "up")) for name in ("d3", "d4", "d3d4"))
AGREEMENT = (
    *("chamber", "detail", "mean change with leak, simulated [%]", "mean change with leak, measured [%]"),
    *("leak-free RMS, simulated / measured", "scatter of that ratio [factor]"),
    *("tests with the same sign of change [of 41]", "correlation of the changes"),
)


def _where(context: Context) -> str:
    half = "40 s a half (quick)" if context.quick else "90 s a half"
    return f"Rig {BENCH_RIG}, {half}, the first 5 s left out; RMS in psi, the unit the sheet is taken to be in."


def leak_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the 41 tests with their leak from half time on."""
    proof = (
        "No run is proved (quick)." if context.quick else "One test of each condition is proved by halving the step."
    )
    notes = f"{_where(context)} Laminar leak of the test's own mean. {proof}"
    return (table_of(list(simulation.with_leak(context.quick)), item.id, item.title, notes),)


def no_leak_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the 41 tests with nothing happening at half time."""
    notes = f'{_where(context)} Nothing leaks: "leak" heads the second half.'
    return (table_of(list(simulation.without_leak(context.quick)), item.id, item.title, notes),)


def drift_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the 41 tests without a leak on a rig that drifts between the halves."""
    drifts = (simulation.FRICTION_DRIFT, simulation.BULK_DRIFT, simulation.NOISE_DRIFT)
    bounds = [f"{100 * low:g} to {100 * high:g} %" for low, high in drifts]
    notes = (
        f'{_where(context)} Nothing leaks: "leak" heads the second half, from a rig with friction moved {bounds[0]}, '
        f"bulk modulus {bounds[1]}, noise {bounds[2]}, up or down at random. The sizes are assumed: the scatter "
        "of d1 on the thesis's own sheet is 4 %, the others were not measured."
    )
    return (table_of(list(simulation.with_drift(context.quick)), item.id, item.title, notes),)


def simulated_sheet(context: Context, item: str) -> tuple[ThesisTable, DataSheet]:
    """Return the table of `appendix-c-leak`, `-no-leak` or `-drift`, and the sheet in it."""
    table = first_table(context, item)
    return table, sheet_of(table)


def _difference(pairs: Array) -> Array:
    return np.asarray(100.0 * (pairs[:, 1] - pairs[:, 0]) / pairs[:, 0])


def chamber_table(sheet: DataSheet, measured: DataSheet | None, chamber: str, item: str) -> ThesisTable:
    """Tabulate one chamber as the thesis does: RMS without and with leak and the difference [%], with both sources."""
    heads = ["test", "mean leak [L/min]", "input", "closed [%]", "level"]
    columns: list[list[float] | list[None]] = []
    for name in QUANTITIES:
        for label, source in (("simulated", sheet), ("measured", measured)):
            heads += [f"{name} {when}, {label} [{UNITS[name]}]" for when in ("no leak", "leak")]
            heads.append(f"{name} diff, {label} [%]")
            if source is None:
                columns += [[None] * len(APPENDIX_C)] * 3
            else:
                pairs = source.rms[chamber][name]
                columns += [pairs[:, 0].tolist(), pairs[:, 1].tolist(), _difference(pairs).tolist()]
    rows = tuple(
        (row.number, row.mean_leak_lpm, row.command, row.closed_pct, row.level, *(values[k] for values in columns))
        for k, row in enumerate(APPENDIX_C)
    )
    return ThesisTable(item, f"Appendix C, RMS of the wavelet details of {chamber}", tuple(heads), rows)


def agreement(sheet: DataSheet, measured: DataSheet | None) -> list[tuple[Cell, ...]]:
    """Compare the simulated sheet with the measured one, a row for each chamber and detail."""
    rows: list[tuple[Cell, ...]] = []
    for chamber in CHAMBERS:
        for name in QUANTITIES:
            change = sheet.log_change(chamber, name)
            row: list[Cell] = [chamber, name, float(100 * np.expm1(change.mean()))]
            if measured is None:
                rows.append((*row, *[None] * 5))
                continue
            real = measured.log_change(chamber, name)
            ratio = np.log(sheet.rms[chamber][name][:, 0] / measured.rms[chamber][name][:, 0])
            same, correlation = int(np.sum(np.sign(change) == np.sign(real))), np.corrcoef(change, real)[0, 1]
            numbers = (100 * np.expm1(real.mean()), np.exp(ratio.mean()), np.exp(ratio.std(ddof=1)))
            rows.append((*row, *map(float, numbers), same, float(correlation)))
    return rows


def appendix(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate how simulation and sheet agree, and the thesis's two tables with both side by side."""
    table, sheet = simulated_sheet(context, "appendix-c-leak")
    notes = f"{table.notes} Means are geometric." + ("" if context.sheet else " No measured sheet was given.")
    rows = tuple(agreement(sheet, context.sheet))
    summary = ThesisTable(item.id, item.title, AGREEMENT, rows, resolved=table.resolved, notes=notes)
    return summary, *(
        chamber_table(sheet, context.sheet, chamber, f"{item.id}-{short}")
        for chamber, short in zip(CHAMBERS, ("pa", "pb"), strict=True)
    )


def difference_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the change of a detail's RMS against the mean leak: measured, simulated, simulated without a leak."""
    chamber, name, direction = (item.inputs[key] for key in ("chamber", "detail", "way"))
    table, sheet = simulated_sheet(context, "appendix-c-leak")
    leak = np.array([row.mean_leak_lpm for row in APPENDIX_C])
    sources: tuple[tuple[DataSheet | None, str, Role], ...] = (
        (context.sheet, "measured (sheet)", "measured"),
        (sheet, "simulated", "simulated"),
        (simulated_sheet(context, "appendix-c-no-leak")[1], "simulated, nothing leaks", "no leak"),
    )
    numbers, absolute, relative = [], [], []
    for source, label, role in sources:
        if source is None:
            continue
        pairs, change = source.rms[chamber][name], source.log_change(chamber, name)
        absolute.append(FigureCurve(leak, pairs[:, 1] - pairs[:, 0], label, role, "points"))
        relative.append(FigureCurve(leak, _difference(pairs), label, role, "points"))
        k = int(np.sum(change < 0 if direction == "down" else change > 0))
        low, high = clopper_pearson(k, change.size)
        numbers += [
            Number(f"{label}: tests that go {direction}", f"{k} of {change.size}"),
            Number(f"{label}: rate, 95 % interval", f"{k / change.size:.3f} ({low:.3f} to {high:.3f})"),
            Number(f"{label}: correlation of the change with the leak", float(np.corrcoef(change, leak)[0, 1])),
        ]
    zero = FigureCurve(np.array([leak.min(), leak.max()]), np.zeros(2), "no change", "reference")
    heads = (f"RMS with - without leak, {name} [{UNITS[name]}]", f"change of the RMS of {name} [%]")
    drawn = zip(heads, (absolute, relative), strict=True)
    panels = tuple(Panel("mean leak [L/min]", head, (*curves, zero)) for head, curves in drawn)
    return (Figure(item.id, item.title, panels, tuple(numbers), resolved=table.resolved, notes=table.notes),)


ITEMS: tuple[Item, ...] = (
    Item("appendix-c-leak", 5, "case", "The 41 tests of Appendix C simulated with their leak", leak_table),
    Item("appendix-c-no-leak", 5, "case", "The same 41 tests simulated with no leak", no_leak_table),
    Item("appendix-c-drift", 5, "case", "The same 41 tests simulated with no leak on a rig that drifts", drift_table),
    Item(
        "appendix-c",
        5,
        "table",
        "Appendix C, simulated beside measured",
        appendix,
        uses_sheet=True,
        needs=("appendix-c-leak",),
    ),
    *(
        Item(
            f"fig-5.{number}",
            5,
            "figure",
            f"Change of the RMS of {name} of {chamber} against the mean leak",
            difference_figure,
            {"chamber": chamber, "detail": name, "way": direction},
            uses_sheet=True,
            needs=("appendix-c-leak", "appendix-c-no-leak"),
        )
        for number, (chamber, name, direction) in enumerate(DIFFERENCES, 90)
    ),
)
