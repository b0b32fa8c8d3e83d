"""The claims of chapter 4, each checked by number under every reading of the equations."""

from __future__ import annotations

import math

from sealscope.recordings.chambers import PRESSURES
from sealscope.thesis.chapters.chapter4.cases import WINDOW
from sealscope.thesis.chapters.chapter4.variants import (
    COMMAND,
    SOLVER_TEXT,
    SOLVERS,
    Throttled,
    over_closings,
    readings,
)
from sealscope.thesis.claims.chapter4.orifices import orifice_claims
from sealscope.thesis.claims.chapter4.plain import plain_claims
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, Table

ITEMS: tuple[Item, ...] = (
    Item(
        "chapter-4-claims",
        4,
        "claims",
        f"Chapter 4 under every reading of its equations, {COMMAND}",
        f"{__name__}:claims",
    ),
)
_COLUMNS = (
    "reading",
    "closed [%]",
    "solver",
    *(f"range of {name} [MPa]" for name in PRESSURES),
    "least pressure [MPa]",
    "mean of p_1 - p_A [kPa]",
    "mean of p_2 - p_B [kPa]",
    "largest drop [kPa]",
    "Q_A unlike Q_B [%]",
    "halving test",
)


def claims(context: Context, item: Item) -> tuple[Table | Claim, ...]:
    """The table of all readings, closings and solvers, and the claims of chapter 4."""
    found = sorted((*plain_claims(context), *orifice_claims(context)), key=lambda claim: _number(claim.id))
    rows = []
    for reading in readings(context.quick):
        for solver in SOLVERS:
            for closed, numbers in over_closings(context, reading, solver).items():
                rows.append((reading.title, closed, SOLVER_TEXT[solver], *_row(numbers)))
    notes = (
        f"Numbers {WINDOW}. Q_A unlike Q_B: rms of their difference over the rms of Q_A. Rows that did not pass the "
        "halving test show the step, not the rig."
    )
    ids = tuple(claim.id for claim in found)
    return (Table(item.id, item.title, _COLUMNS, tuple(rows), ids, None, notes), *found)


def _number(claim_id: str) -> int:
    return int(claim_id.rpartition(".")[2])


def _row(one: Throttled) -> tuple[float | str | None, ...]:
    values: tuple[float, ...] = (
        *(one.span[name] * 1e-6 for name in PRESSURES),
        min(one.least.values()) * 1e-6,
        one.p_1_less_p_A * 1e-3,
        one.p_2_less_p_B * 1e-3,
        one.largest_drop * 1e-3,
        one.flows_differ * 100.0,
    )
    tested = {True: "passed", False: "not passed", None: "not made"}[one.resolved]
    return (*(value if math.isfinite(value) else None for value in values), tested)
