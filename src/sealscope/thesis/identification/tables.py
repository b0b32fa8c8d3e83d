"""The calibration as tables: what was fitted, how well it fits, what it predicts, and what could explain the rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.appendix_c.simulated_sheet import log_change
from sealscope.thesis.conditions import APPENDIX_C, groups
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Table
from sealscope.thesis.identification.fit import residuals
from sealscope.thesis.identification.forward import QUANTITIES, noise_of
from sealscope.thesis.identification.hypotheses import HYPOTHESES, outcome

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: The packaged rig that the fit made.
CALIBRATED = "thesis-calibrated"
_RATIO = "geometric mean of simulated / measured leak-free RMS"


def _rig() -> Rig:
    from sealscope.parameters import load_rig

    return load_rig(CALIBRATED)


def parameters(context: Context, item: Item) -> tuple[Table, ...]:
    """Every parameter in which the calibrated rig differs from the thesis's."""
    from sealscope.parameters import load_rig

    fitted, printed = _rig(), {row.name: row for row in load_rig("thesis").table()}
    rows = tuple(
        (row.name, row.meaning, printed[row.name].given, row.given, row.source)
        for row in fitted.table()
        if row.given != printed[row.name].given
    )
    sigma = ", ".join(f"{noise_of(fitted, chamber):.2f} psi in {chamber}" for chamber in CHAMBERS)
    heads = ("parameter", "meaning", "rig thesis", f"rig {CALIBRATED}", "source and interval")
    return (Table(item.id, item.title, heads, rows, notes=f"Noise of a sample, all sources together: {sigma}."),)


def fit_table(context: Context, item: Item) -> tuple[Table, ...]:
    """Simulated over measured leak-free RMS: geometric means over all tests, and each operating condition."""
    assert context.sheet is not None
    log = residuals(_rig(), context.sheet)
    summary = Table(
        item.id,
        item.title,
        ("chamber", "detail", _RATIO, "within 25 %", "scatter between tests [factor]"),
        tuple(
            (
                chamber,
                name,
                float(np.exp(log[:, k, j].mean())),
                _within(log[:, k, j]),
                float(np.exp(log[:, k, j].std(ddof=1))),
            )
            for k, chamber in enumerate(CHAMBERS)
            for j, name in enumerate(QUANTITIES)
        ),
        notes="Only these columns were fitted. Noise is added by its mean square; nothing is drawn.",
    )
    heads = (
        "input",
        "closed [%]",
        "tests",
        *(f"{chamber} {name} simulated / measured" for chamber in CHAMBERS for name in QUANTITIES),
    )
    rows = []
    for command, closed in groups():
        of = np.array([condition.group == (command, closed) for condition in APPENDIX_C])
        rows.append((command, closed, int(of.sum()), *np.exp(log[of].mean(axis=0)).ravel().tolist()))
    return summary, Table(f"{item.id}-conditions", f"{item.title}, by operating condition", heads, tuple(rows))


def _within(log: Array) -> str:
    return "yes" if abs(float(np.exp(log.mean())) - 1.0) <= 0.25 else "no"


def hypotheses(context: Context, item: Item) -> tuple[Table, ...]:
    """What each hypothesis makes of the leak-free level and of the change with the leak, beside the sheet."""
    assert context.sheet is not None
    sheet = context.sheet
    shown = ("d2", "d3", "d4")
    heads = ["hypothesis", *(f"{c} {q} simulated / measured, leak-free" for c in CHAMBERS for q in shown[1:])]
    heads += [f"{c} {q} change with leak [%]" for c in CHAMBERS for q in shown]
    heads += [f"{c} {q} sign right [of 41]" for c in CHAMBERS for q in shown[1:]]
    at = [QUANTITIES.index(q) for q in shown]
    measured = [100 * np.expm1(np.mean(log_change(sheet, c, q))) for c in CHAMBERS for q in shown]
    rows: list[tuple[float | int | str | None, ...]] = [("the sheet", *[1.0] * 4, *map(float, measured), *[41] * 4)]
    rig = _rig()
    for hypothesis in HYPOTHESES[:2] if context.quick else HYPOTHESES:
        found = outcome(rig, hypothesis)
        ratio, change, right = found.ratio(sheet), found.change(), found.right_sign(sheet)
        rows.append(
            (
                hypothesis.name,
                *ratio[:, at[1:]].ravel().tolist(),
                *(100 * (change[:, at] - 1.0)).ravel().tolist(),
                *right[:, at[1:]].ravel().tolist(),
            )
        )
    notes = "Nothing here was fitted to the leak columns. Changes are geometric means over the 41 tests."
    return (Table(item.id, item.title, tuple(heads), tuple(rows), notes=notes),)
