"""Count the success rates of Table 5.1 again, on the data sheet and in simulation, with the rules' false alarms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.interval import UPPER_95, WITHIN_95
from sealscope.evaluation.binomial import clopper_pearson, holm, sign_test
from sealscope.thesis.chapters.appendix_c_runs import simulated_sheet
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, ThesisTable
from sealscope.thesis.engine.texts import format_note, load_texts
from sealscope.thesis.sheet import COLUMNS, DataSheet, log_change_to_percent

#: Sign of the change of each chamber's RMS when a leak opens, as section 5.6 states it.
DIRECTION: Mapping[str, int] = {"p_A": -1, "p_B": 1}
#: False-alarm probability at which the rules with a threshold are set.
FALSE_ALARMS = 0.05
Fires = NDArray[np.bool_]
_Row = tuple[Cell, ...]


@dataclass(frozen=True)
class Rule:
    """A rule of Table 5.1, which fires, i.e. indicates a leak, if the RMS of all its `details` move as with a leak.

    With a leak, those of p_A fall and those of p_B rise (`DIRECTION`). `details`: (chamber, detail) pairs; `printed`:
    success rates [%] that the thesis prints, "" for a rule that the thesis does not claim.
    """

    name: str
    details: Sequence[tuple[str, str]]
    printed: str = ""

    def fires(self, sheet: DataSheet) -> Fires:
        """Find the tests (tests,) of a data sheet in which the rule fires."""
        moves = [sheet.log_change(chamber, detail) * DIRECTION[chamber] > 0 for chamber, detail in self.details]
        return np.asarray(np.all(moves, axis=0))


#: Rules of the six cells of Table 5.1, then of d3d4 in both chambers; and of the columns that the table leaves out.
CLAIMED, UNCLAIMED = (tuple(Rule(*row) for row in load_texts("cases.toml")[key]) for key in ("claimed", "unclaimed"))
#: Rules of the six cells only, each with one detail.
CLAIMED_CELLS = CLAIMED[:6]


def _format_count(fires: Fires | None) -> tuple[Cell, Cell, Cell, Cell]:
    """Format how often a rule fires as four cells, empty for None: k/n, rate [%], and its 95 % interval [%]."""
    if fires is None:
        return None, None, None, None
    k, n = int(fires.sum()), fires.size
    low, high = clopper_pearson(k, n)
    return f"{k}/{n}", 100.0 * k / n, 100.0 * low, 100.0 * high


def _count_heads(source: str, count: str) -> tuple[str, ...]:
    """Build the heads of the four columns of `_format_count`, for the sheet `source` and a `count` such as "fires"."""
    return tuple(f"{source}: {part}" for part in (count, "rate [%]", "95 % low [%]", "95 % high [%]"))


_SOURCES = ("sheet", "simulated leak", "simulated, no leak", "simulated, drift only")
RATES = (
    *("rule", "printed [%]", *(head for source in _SOURCES for head in _count_heads(source, "fires"))),
    "simulated leak less drift [points]",
)
TESTS = (
    *("source", "chamber", "detail", "down", "up", "geometric mean change [%]"),
    *("sign test p", "p, Holm over ten columns", "moves (p < 0.05)"),
)
THRESHOLDS = (
    *("rule", "sheet: threshold from d1's scatter [%]", *_count_heads("sheet", "finds")),
    *("simulated: threshold from drift only [%]", *_count_heads("simulated leak", "finds")),
)


def count_rules(measured: DataSheet | None, leak: DataSheet, no_leak: DataSheet, drift: DataSheet) -> list[_Row]:
    """Count the tests in which each rule fires, as rows with the columns `RATES`.

    For comparison there are two more rules, one that always fires and one that never does. `measured`: measured sheet,
    None if not given; `leak`, `no_leak`, `drift`: sheets simulated with leak, without, and with drift alone.
    """
    sheets = (measured, leak, no_leak, drift)
    rules: list[tuple[str, str, Callable[[DataSheet], Fires]]] = [
        *((rule.name, rule.printed, rule.fires) for rule in (*CLAIMED, *UNCLAIMED)),
        ("always fires", "", lambda sheet: np.full(sheet.tests, True)),
        ("never fires", "", lambda sheet: np.full(sheet.tests, False)),
    ]
    rows: list[_Row] = []
    for name, printed, fires in rules:
        cells = [cell for sheet in sheets for cell in _format_count(None if sheet is None else fires(sheet))]
        difference = 100.0 * float(fires(leak).mean() - fires(drift).mean())
        rows.append((name, printed or None, *cells, difference))
    return rows


def column_tests(sheet: DataSheet) -> list[_Row]:
    """Test each column of a data sheet, a chamber's wavelet detail, for a change with the leak by a sign test.

    Holm's correction covers all ten columns, since Table 5.1 chose among them. Returns rows with the columns `TESTS`,
    without the source.
    """
    rows = []
    for chamber, name in COLUMNS:
        change = sheet.log_change(chamber, name)
        down, up = int(np.sum(change < 0)), int(np.sum(change > 0))
        rows.append((chamber, name, down, up, log_change_to_percent(change), sign_test(down, down + up)))
    corrected = holm([p for *_, p in rows])
    return [(*row, p, "yes" if p < 0.05 else "no") for row, p in zip(rows, corrected, strict=True)]


def d1_threshold(sheet: DataSheet, chamber: str, either_side: bool = False) -> float:
    """Compute the change of log RMS that noise alone exceeds in 5 % of the tests (`FALSE_ALARMS`).

    The finest wavelet detail d1 of the pressure `chamber` is noise and does not depend on the leak; the other details
    scatter at least as much. The threshold is 1.645 times the rms log change of d1 over the tests of the sheet, or
    1.960 times if changes of `either_side` count, rises as well as falls.
    """
    change = sheet.log_change(chamber, "d1")
    return float((WITHIN_95 if either_side else UPPER_95) * np.sqrt(np.mean(change**2)))


def drift_threshold(drift: DataSheet, chamber: str, detail: str) -> float:
    """Compute the change of log RMS that drift alone exceeds in 5 % of the simulated tests (`FALSE_ALARMS`).

    Positive is the direction that a leak should cause: down for p_A, up for p_B (`DIRECTION`).
    """
    return float(np.quantile(drift.log_change(chamber, detail) * DIRECTION[chamber], 1.0 - FALSE_ALARMS))


def count_with_thresholds(measured: DataSheet | None, leak: DataSheet, drift: DataSheet) -> list[_Row]:
    """Count the leaks that each rule on a single detail finds if changes of the RMS count only above a threshold.

    The threshold is `d1_threshold` for the `measured` sheet, None if not given, and `drift_threshold` for the sheet
    simulated with a `leak`. Returns rows with the columns `THRESHOLDS`.
    """
    rows: list[_Row] = []
    for rule in (*CLAIMED_CELLS, *UNCLAIMED):
        ((chamber, detail),) = rule.details
        row: list[Cell] = [rule.name]
        d1_limit = None if measured is None else d1_threshold(measured, chamber)
        for sheet, limit in ((measured, d1_limit), (leak, drift_threshold(drift, chamber, detail))):
            if sheet is None or limit is None:
                row += [None, *_format_count(None)]
                continue
            fires = sheet.log_change(chamber, detail) * DIRECTION[chamber] > limit
            row += [log_change_to_percent(DIRECTION[chamber] * limit), *_format_count(fires)]
        rows.append(tuple(row))
    return rows


def success_rate_tables(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the success rates of Table 5.1, sign tests of all columns, and the rates with thresholds."""
    leak_runs, leak = simulated_sheet(context, "leak")
    _, no_leak = simulated_sheet(context, "no-leak")
    _, drift = simulated_sheet(context, "drift")
    measured, resolved = context.sheet, leak_runs.resolved
    sheets = dict(zip(_SOURCES, (measured, leak, no_leak, drift), strict=True))
    tests = [(name, *row) for name, sheet in sheets.items() if sheet is not None for row in column_tests(sheet)]
    notes = format_note("rates", none="" if measured else " No measured sheet was given.", runs=leak_runs.notes)
    tests_title = "Sign tests of every column of Appendix C"
    limits_title = f"The rules of Table 5.1 set for {100 * FALSE_ALARMS:g} % false alarms"
    limits = count_with_thresholds(measured, leak, drift)
    return (
        item.table(count_rules(measured, leak, no_leak, drift), notes, RATES, resolved=resolved),
        item.table(tests, format_note("column-tests"), TESTS, tail="-columns", title=tests_title, resolved=resolved),
        item.table(
            limits, format_note("thresholds"), THRESHOLDS, tail="-thresholds", title=limits_title, resolved=resolved
        ),
    )
