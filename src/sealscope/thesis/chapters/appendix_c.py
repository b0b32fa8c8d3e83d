"""Compare the simulated tests of Appendix C with the thesis's data sheet, and draw Figs. 5.90 to 5.95."""

from __future__ import annotations

import numpy as np

from sealscope.evaluation.binomial import clopper_pearson
from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.signals.details import QUANTITIES
from sealscope.thesis.chapters.appendix_c_runs import simulated_sheet
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Figure, FigureCurve, Number, Panel, Role, ThesisTable
from sealscope.thesis.sheet import APPENDIX_C, COLUMNS, UNITS, DataSheet, log_change_to_percent, mean_leaks


def _percent_change(pairs: Array) -> Array:
    """Compute the relative change [%] from the first to the second value of each pair, (n, 2)."""
    return np.asarray(100.0 * (pairs[:, 1] - pairs[:, 0]) / pairs[:, 0])


def _chamber_table(sheet: DataSheet, measured: DataSheet | None, chamber: str, item: Item) -> ThesisTable:
    """Tabulate the RMS of one chamber's wavelet details in all tests of Appendix C, in the form of the thesis."""
    heads = ["test", "mean leak [L/min]", "input", "closed [%]", "level"]
    rows: list[tuple[Cell, ...]] = [
        (row.number, row.mean_leak_lpm, row.command, row.closed_pct, row.level) for row in APPENDIX_C
    ]
    for name in QUANTITIES:
        for label, source in (("simulated", sheet), ("measured", measured)):
            heads += [f"{name} {when}, {label} [{UNITS[name]}]" for when in ("no leak", "leak")]
            heads.append(f"{name} diff, {label} [%]")
            cells: list[list[float | None]] = [[None] * 3] * len(rows)
            if source is not None:
                pairs = source.rms[chamber][name]
                cells = np.column_stack([pairs, _percent_change(pairs)]).tolist()
            rows = [(*row, *three_cells) for row, three_cells in zip(rows, cells, strict=True)]
    # the tail of the id, "-pa" or "-pb", tells the chambers' tables apart
    tail, title = f"-p{chamber[-1].lower()}", f"Appendix C, RMS of the wavelet details of {chamber}"
    return item.table(rows, "", heads, tail=tail, title=title)


def compare_sheets(sheet: DataSheet, measured: DataSheet | None) -> list[tuple[Cell, ...]]:
    """Compare the simulated data sheet with the measured one, in one row for each chamber and wavelet detail.

    The cells are change of the RMS [%], simulated and measured (geometric means over the tests); ratio of simulated to
    measured RMS without the leak, mean and scatter; tests with the same sign of change, and correlation of the changes.
    Without a measured sheet all but the simulated change are None.
    """
    rows: list[tuple[Cell, ...]] = []
    for chamber, name in COLUMNS:
        simulated_change = sheet.log_change(chamber, name)
        comparison: tuple[Cell, ...] = (None,) * 5
        if measured is not None:
            measured_change = measured.log_change(chamber, name)
            log_ratio = sheet.log_ratio(measured, chamber, name)
            comparison = (
                log_change_to_percent(measured_change),
                float(np.exp(log_ratio.mean())),
                float(np.exp(log_ratio.std(ddof=1))),
                sheet.count_same_signs(measured, chamber, name),
                float(np.corrcoef(simulated_change, measured_change)[0, 1]),
            )
        rows.append((chamber, name, log_change_to_percent(simulated_change), *comparison))
    return rows


def agreement_tables(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the agreement of the simulated data sheet with the measured one, and for each chamber both sheets."""
    table, sheet = simulated_sheet(context, "leak")
    notes = f"{table.notes} Means are geometric." + ("" if context.sheet else " No measured sheet was given.")
    summary = item.table(compare_sheets(sheet, context.sheet), notes, resolved=table.resolved)
    return summary, *(_chamber_table(sheet, context.sheet, chamber, item) for chamber in CHAMBERS)


def difference_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw the change of a wavelet detail's RMS with the leak, in its unit and in %, over the mean leak of each test.

    `item.inputs`: chamber, detail, and the direction in which a leak should change the RMS ("down" or "up").
    """
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
        relative.append(FigureCurve(leak, _percent_change(pairs), label, role, "points"))
        n_moved = int(np.sum(change < 0 if direction == "down" else change > 0))
        low, high = clopper_pearson(n_moved, change.size)
        numbers += [
            Number(f"{label}: tests that go {direction}", f"{n_moved} of {change.size}"),
            Number(f"{label}: rate, 95 % interval", f"{n_moved / change.size:.3f} ({low:.3f} to {high:.3f})"),
            Number(f"{label}: correlation of the change with the leak", float(np.corrcoef(change, leak)[0, 1])),
        ]
    no_change = FigureCurve(np.array([leak.min(), leak.max()]), np.zeros(2), "no change", "reference")
    labels = (f"RMS with - without leak, {name} [{UNITS[name]}]", f"change of the RMS of {name} [%]")
    curves_by_label = zip(labels, (absolute, relative), strict=True)
    panels = tuple(Panel("mean leak [L/min]", label, (*curves, no_change)) for label, curves in curves_by_label)
    return (item.figure(panels, numbers, table.resolved, table.notes),)
