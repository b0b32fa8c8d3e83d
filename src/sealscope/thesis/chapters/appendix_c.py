"""Appendix C simulated and compared with the thesis's own sheet; and Figs. 5.90 to 5.95."""

from __future__ import annotations

import numpy as np

from sealscope.evaluation.binomial import clopper_pearson
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.signals.details import QUANTITIES
from sealscope.thesis.chapters.appendix_c_runs import simulated_sheet
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Figure, FigureCurve, Number, Panel, Role, ThesisTable
from sealscope.thesis.sheet import APPENDIX_C, COLUMNS, UNITS, DataSheet, mean_leaks


def _difference(pairs: Array) -> Array:
    return np.asarray(100.0 * (pairs[:, 1] - pairs[:, 0]) / pairs[:, 0])


def _chamber_table(sheet: DataSheet, measured: DataSheet | None, chamber: str, item: Item) -> ThesisTable:
    """Tabulate one chamber as the thesis does: RMS without and with leak and the difference [%], with both sources."""
    heads = ["test", "mean leak [L/min]", "input", "closed [%]", "level"]
    columns: list[list[float] | list[None]] = []
    for name in QUANTITIES:
        for label, source in (("simulated", sheet), ("measured", measured)):
            heads += [f"{name} {when}, {label} [{UNITS[name]}]" for when in ("no leak", "leak")]
            heads.append(f"{name} diff, {label} [%]")
            pairs = None if source is None else source.rms[chamber][name]
            values = (None,) * 3 if pairs is None else (pairs[:, 0], pairs[:, 1], _difference(pairs))
            columns += [[None] * len(APPENDIX_C) if series is None else series.tolist() for series in values]
    rows = (
        (row.number, row.mean_leak_lpm, row.command, row.closed_pct, row.level, *(values[k] for values in columns))
        for k, row in enumerate(APPENDIX_C)
    )
    tail, title = f"-p{chamber[-1].lower()}", f"Appendix C, RMS of the wavelet details of {chamber}"
    return item.table(rows, "", heads, tail=tail, title=title)


def agreement(sheet: DataSheet, measured: DataSheet | None) -> list[tuple[Cell, ...]]:
    """Compare the simulated sheet with the measured one, a row for each chamber and detail."""
    rows: list[tuple[Cell, ...]] = []
    for chamber, name in COLUMNS:
        change = sheet.log_change(chamber, name)
        compared: tuple[Cell, ...] = (None,) * 5
        if measured is not None:
            real = measured.log_change(chamber, name)
            ratio = np.log(sheet.rms[chamber][name][:, 0] / measured.rms[chamber][name][:, 0])
            same_sign, correlation = int(np.sum(np.sign(change) == np.sign(real))), np.corrcoef(change, real)[0, 1]
            numbers = (100 * np.expm1(real.mean()), np.exp(ratio.mean()), np.exp(ratio.std(ddof=1)))
            compared = (*map(float, numbers), same_sign, float(correlation))
        rows.append((chamber, name, float(100 * np.expm1(change.mean())), *compared))
    return rows


def appendix(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the agreement of simulation and sheet, and the thesis's two tables with both of them."""
    table, sheet = simulated_sheet(context, "leak")
    notes = f"{table.notes} Means are geometric." + ("" if context.sheet else " No measured sheet was given.")
    summary = item.table(agreement(sheet, context.sheet), notes, resolved=table.resolved)
    return summary, *(_chamber_table(sheet, context.sheet, chamber, item) for chamber in CHAMBERS)


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
    lines = zip(heads, (absolute, relative), strict=True)
    panels = tuple(Panel("mean leak [L/min]", head, (*curves, zero)) for head, curves in lines)
    return (item.figure(panels, numbers, table.resolved, table.notes),)
