"""Table 5.1 counted anew, from the sheet and from simulation, with the false alarms of its rules."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.onset import BELOW_95, WITHIN_95
from sealscope.evaluation.binomial import clopper_pearson, holm, sign_test
from sealscope.thesis.chapters.appendix_c_runs import simulated_sheet
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, ThesisTable
from sealscope.thesis.engine.texts import note, texts_of
from sealscope.thesis.sheet import COLUMNS, DataSheet

#: The direction in which each chamber's RMS is said to move when a leak opens, section 5.6.
DIRECTION: Mapping[str, int] = {"p_A": -1, "p_B": 1}
#: False-alarm probability at which the rules with a threshold are set.
FALSE_ALARMS = 0.05

Fires = NDArray[np.bool_]


@dataclass(frozen=True)
class Rule:
    """A rule of Table 5.1: it fires when every named detail moves in its chamber's direction.

    `printed` [%]: as the thesis has it (with its variants), empty for one it does not claim.
    """

    name: str
    details: Sequence[tuple[str, str]]
    printed: str = ""

    def fires(self, sheet: DataSheet) -> Fires:
        """Find the tests in which the rule fires, (n,) truth values."""
        moves = [sheet.log_change(chamber, detail) * DIRECTION[chamber] > 0 for chamber, detail in self.details]
        return np.asarray(np.all(moves, axis=0))


def _rules(name: str) -> tuple[Rule, ...]:
    return tuple(Rule(*row) for row in texts_of("cases.toml")[name])


#: The six cells of Table 5.1 and the cumulative one; and the columns of Appendix C that the table leaves out.
CLAIMED, UNCLAIMED = _rules("claimed"), _rules("unclaimed")


def _count_cells(fires: Fires | None) -> tuple[Cell, Cell, Cell, Cell]:
    """Count as "k/n", share of the tests and its interval [%]."""
    if fires is None:
        return None, None, None, None
    k, n = int(fires.sum()), fires.size
    low, high = clopper_pearson(k, n)
    return f"{k}/{n}", 100.0 * k / n, 100.0 * low, 100.0 * high


def _heads(what: str, count: str) -> tuple[str, ...]:
    return tuple(f"{what}: {part}" for part in (count, "rate [%]", "95 % low [%]", "95 % high [%]"))


_SOURCES = ("sheet", "simulated leak", "simulated, no leak", "simulated, drift only")
RATES = (
    *("rule", "printed [%]", *(head for source in _SOURCES for head in _heads(source, "fires"))),
    "simulated leak less drift [points]",
)
TESTS = (
    *("source", "chamber", "detail", "down", "up", "geometric mean change [%]"),
    *("sign test p", "p, Holm over ten columns", "moves (p < 0.05)"),
)
THRESHOLDS = (
    *("rule", "sheet: threshold from d1's scatter [%]", *_heads("sheet", "finds")),
    *("simulated: threshold from drift only [%]", *_heads("simulated leak", "finds")),
)


def counts(measured: DataSheet | None, leak: DataSheet, still: DataSheet, drift: DataSheet) -> list[tuple[Cell, ...]]:
    """Count each rule of Table 5.1 on the sheet, in simulation with leak, with none, and with drift but no leak.

    The last rows are the rules that always and never fire.
    """
    rules: dict[str, tuple[str, Callable[[DataSheet], Fires]]] = {
        **{rule.name: (rule.printed, rule.fires) for rule in (*CLAIMED, *UNCLAIMED)},
        "always fires": ("", lambda sheet: np.full(sheet.tests, True)),
        "never fires": ("", lambda sheet: np.full(sheet.tests, False)),
    }
    rows: list[tuple[Cell, ...]] = []
    for name, (printed, fires) in rules.items():
        sheets = (measured, leak, still, drift)
        cells = [cell for sheet in sheets for cell in _count_cells(None if sheet is None else fires(sheet))]
        rows.append((name, printed or None, *cells, 100.0 * float(fires(leak).mean() - fires(drift).mean())))
    return rows


def column_tests(sheet: DataSheet) -> list[tuple[Cell, ...]]:
    """Test every column of a sheet.

    How many tests fell and rose, the sign test's p, and p corrected (Holm) for all ten columns that were there to
    choose from.
    """
    rows = []
    for chamber, name in COLUMNS:
        change = sheet.log_change(chamber, name)
        down, up = int(np.sum(change < 0)), int(np.sum(change > 0))
        mean = float(100 * np.expm1(change.mean()))
        rows.append((chamber, name, down, up, mean, sign_test(down, down + up)))
    corrected = holm([row[-1] for row in rows])
    return [(*row, p, "yes" if p < 0.05 else "no") for row, p in zip(rows, corrected, strict=True)]


def d1_threshold(sheet: DataSheet, chamber: str, either_side: bool = False) -> float:
    """Compute the log change that noise alone passes with probability `FALSE_ALARMS`, to one side or to either.

    From the scatter of d1 about zero: ``1.645 rms(log change of d1)``, or 1.960 times it. d1 is noise: no leak moves
    it, so its changes between the halves are those of a leak-free rig. The other details can only scatter more.
    """
    change = sheet.log_change(chamber, "d1")
    return float((WITHIN_95 if either_side else BELOW_95) * np.sqrt(np.mean(change**2)))


def drift_threshold(drift: DataSheet, chamber: str, detail: str) -> float:
    """Compute the log change, in the chamber's direction, that drift alone passes with probability `FALSE_ALARMS`."""
    return float(np.quantile(drift.log_change(chamber, detail) * DIRECTION[chamber], 1.0 - FALSE_ALARMS))


def thresholds(measured: DataSheet | None, leak: DataSheet, drift: DataSheet) -> list[tuple[Cell, ...]]:
    """Count the leaks that each single-detail rule still finds with a threshold instead of the bare sign."""
    rows: list[tuple[Cell, ...]] = []
    for rule in (*CLAIMED[:6], *UNCLAIMED):
        ((chamber, detail),) = rule.details
        row: list[Cell] = [rule.name]
        by_d1 = None if measured is None else d1_threshold(measured, chamber)
        for sheet, limit in ((measured, by_d1), (leak, drift_threshold(drift, chamber, detail))):
            if sheet is None or limit is None:
                row += [None] * 5
                continue
            fires = sheet.log_change(chamber, detail) * DIRECTION[chamber] > limit
            row += [100.0 * float(np.expm1(DIRECTION[chamber] * limit)), *_count_cells(fires)]
        rows.append(tuple(row))
    return rows


def table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate Table 5.1 with its controls, the sign tests of every column, and the rules with a threshold."""
    (leak_runs, leak), (_, still), (_, drift) = (
        simulated_sheet(context, runs) for runs in ("leak", "no-leak", "drift")
    )
    measured, resolved = context.sheet, leak_runs.resolved
    sheets = dict(zip(_SOURCES, (measured, leak, still, drift), strict=True))
    tests = [(name, *row) for name, sheet in sheets.items() if sheet is not None for row in column_tests(sheet)]
    notes = note("rates", none="" if measured else " No measured sheet was given.", runs=leak_runs.notes)
    of_columns, set_for = "Sign tests of every column of Appendix C", f"{100 * FALSE_ALARMS:g} % false alarms"
    limits, title = thresholds(measured, leak, drift), f"The rules of Table 5.1 set for {set_for}"
    return (
        item.table(counts(measured, leak, still, drift), notes, RATES, resolved=resolved),
        item.table(tests, note("column-tests"), TESTS, tail="-columns", title=of_columns, resolved=resolved),
        item.table(limits, note("thresholds"), THRESHOLDS, tail="-thresholds", title=title, resolved=resolved),
    )
