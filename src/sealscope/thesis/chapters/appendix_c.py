"""Appendix C simulated, as the thesis tabulates it, beside its own sheet; and Figs. 5.90 to 5.95."""

from __future__ import annotations

import numpy as np

from sealscope.evaluation.binomial import clopper_pearson
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.appendix_c_runs import simulated_sheet
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Figure, FigureCurve, Number, Panel, Role, ThesisTable
from sealscope.thesis.sheet import APPENDIX_C, COLUMNS, QUANTITIES, UNITS, DataSheet, mean_leaks

AGREEMENT = (
    *("chamber", "detail", "mean change with leak, simulated [%]", "mean change with leak, measured [%]"),
    *("leak-free RMS, simulated / measured", "scatter of that ratio [factor]"),
    *("tests with the same sign of change [of 41]", "correlation of the changes"),
)


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
            pairs = None if source is None else source.rms[chamber][name]
            values = (None,) * 3 if pairs is None else (pairs[:, 0], pairs[:, 1], _difference(pairs))
            columns += [[None] * len(APPENDIX_C) if of is None else of.tolist() for of in values]
    rows = tuple(
        (row.number, row.mean_leak_lpm, row.command, row.closed_pct, row.level, *(values[k] for values in columns))
        for k, row in enumerate(APPENDIX_C)
    )
    return ThesisTable(item, f"Appendix C, RMS of the wavelet details of {chamber}", tuple(heads), rows)


def agreement(sheet: DataSheet, measured: DataSheet | None) -> list[tuple[Cell, ...]]:
    """Compare the simulated sheet with the measured one, a row for each chamber and detail."""
    rows: list[tuple[Cell, ...]] = []
    for chamber, name in COLUMNS:
        change = sheet.log_change(chamber, name)
        compared: tuple[Cell, ...] = (None,) * 5
        if measured is not None:
            real = measured.log_change(chamber, name)
            ratio = np.log(sheet.rms[chamber][name][:, 0] / measured.rms[chamber][name][:, 0])
            same, correlation = int(np.sum(np.sign(change) == np.sign(real))), np.corrcoef(change, real)[0, 1]
            numbers = (100 * np.expm1(real.mean()), np.exp(ratio.mean()), np.exp(ratio.std(ddof=1)))
            compared = (*map(float, numbers), same, float(correlation))
        rows.append((chamber, name, float(100 * np.expm1(change.mean())), *compared))
    return rows


def appendix(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate how simulation and sheet agree, and the thesis's two tables with both side by side."""
    table, sheet = simulated_sheet(context, "leak")
    notes = f"{table.notes} Means are geometric." + ("" if context.sheet else " No measured sheet was given.")
    rows = tuple(agreement(sheet, context.sheet))
    summary = ThesisTable(item.id, item.title, AGREEMENT, rows, resolved=table.resolved, notes=notes)
    ids = {chamber: f"{item.id}-{chamber.lower().replace('_', '')}" for chamber in CHAMBERS}
    return summary, *(chamber_table(sheet, context.sheet, chamber, name) for chamber, name in ids.items())


def difference_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the change of a detail's RMS against the mean leak: measured, simulated, simulated without a leak."""
    chamber, name, direction = (item.inputs[key] for key in ("chamber", "detail", "way"))
    (table, sheet), leak = simulated_sheet(context, "leak"), mean_leaks()
    sources: tuple[tuple[DataSheet | None, str, Role], ...] = (
        (context.sheet, "measured (sheet)", "measured"),
        (sheet, "simulated", "simulated"),
        (simulated_sheet(context, "no-leak")[1], "simulated, nothing leaks", "no leak"),
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


def _items() -> list[Item]:
    needs = ("appendix-c-leak", "appendix-c-no-leak")
    title = "Appendix C, simulated beside measured"
    items = [Item("appendix-c", 5, "table", title, appendix, uses_sheet=True, needs=needs[:1])]
    for chamber, way in (("p_A", "down"), ("p_B", "up")):  # how each is said to move when a leak opens
        for name in ("d3", "d4", "d3d4"):
            inputs = {"chamber": chamber, "detail": name, "way": way}
            title = f"Change of the RMS of {name} of {chamber} against the mean leak"
            number = f"fig-5.{89 + len(items)}"
            items.append(Item(number, 5, "figure", title, difference_figure, inputs, uses_sheet=True, needs=needs))
    return items


ITEMS: tuple[Item, ...] = tuple(_items())
