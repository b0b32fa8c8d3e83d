"""What the claims on detection are judged by: the measured sheet, the simulated ones and the ten shown tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.evaluation.binomial import clopper_pearson, holm, sign_test
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.appendix_c.simulated_sheet import QUANTITIES, log_change
from sealscope.thesis.chapters.appendix_c.success_rates import WAY, Rule
from sealscope.thesis.chapters.appendix_c.tables import simulated
from sealscope.thesis.chapters.chapter5.shown_tests import Shown, all_shown, shown
from sealscope.thesis.chapters.chapter5.tests import test_of
from sealscope.thesis.claims.judging import verdict_of
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.products import Claim, Table
from sealscope.thesis.sheet import Sheet

NO_SHEET = "the thesis's data sheet was not given"
NOT_ON_SHEET = "not on the sheet"
#: A test on a sheet, measured or simulated: what it finds, and which of the claim's parts it bears out.
SheetTest = Callable[[Sheet], tuple[str, Sequence[bool]]]


@dataclass(frozen=True, eq=False)
class Evidence:
    """The measured sheet (None: not given), the simulated sheets with leak, with none and with drift only, the table of
    the first, the ten tests of chapter 5, and the first of them without its leak."""

    measured: Sheet | None
    leak: Sheet
    still: Sheet
    drift: Sheet
    table: Table
    shown: dict[str, Shown]
    control: Shown

    @property
    def judging(self) -> Sheet:
        """The measured sheet, or the simulated one where it was not given."""
        return self.measured or self.leak


def gather(context: Context) -> Evidence:
    """All of it, from the context's items and runs."""
    table, leak = simulated(context, "appendix-c-leak")
    _, still = simulated(context, "appendix-c-no-leak")
    _, drift = simulated(context, "appendix-c-drift")
    control = shown(context, test_of("5.2a"), leak=False)
    return Evidence(context.sheet, leak, still, drift, table, all_shown(context), control)


def on_sheet(
    evidence: Evidence, id: str, where: str, claim: str, test: SheetTest, why: str | Callable[[Sheet], str]
) -> Claim:
    """A claim judged by the measured sheet; the same test on the simulated sheet stands beside it."""
    simulation, _ = test(evidence.leak)
    told, parts = (NO_SHEET, ()) if evidence.measured is None else test(evidence.measured)
    reason = why if isinstance(why, str) else why(evidence.judging)
    return Claim(id, where, claim, told, simulation, verdict_of(parts), reason)


def by_simulation(id: str, where: str, claim: str, told: str, parts: Sequence[bool | None], why: str) -> Claim:
    """A claim that the sheet is silent on."""
    return Claim(id, where, claim, NOT_ON_SHEET, told, verdict_of(parts), why)


def fired(sheet: Sheet, rule: Rule) -> str:
    """`k/n = rate %` of a rule, with its exact 95 % interval."""
    found = rule.fires(sheet)
    return share(int(found.sum()), found.size)


def share(k: int, n: int) -> str:
    """`k/n = rate % (low to high)` with the exact 95 % interval."""
    low, high = clopper_pearson(k, n)
    return f"{k}/{n} = {100 * k / n:.1f} % ({100 * low:.0f} to {100 * high:.0f} %)"


def percent(change: Array | float) -> float:
    """A log change, or the mean of several, in percent."""
    return float(100.0 * np.expm1(np.mean(change)))


def corrected_p(sheet: Sheet) -> dict[tuple[str, str], float]:
    """Sign-test p of every column, corrected (Holm) for all ten."""
    columns = [(chamber, name) for chamber in CHAMBERS for name in QUANTITIES]
    raw = []
    for chamber, name in columns:
        change = log_change(sheet, chamber, name)
        down, up = int(np.sum(change < 0)), int(np.sum(change > 0))
        raw.append(sign_test(down, down + up))
    return dict(zip(columns, holm(raw), strict=True))


def moved(sheet: Sheet, chamber: str, name: str) -> bool:
    """Whether a column moves the chamber's way beyond chance (5 %, corrected for ten columns)."""
    change = log_change(sheet, chamber, name) * WAY[chamber]
    return bool(np.sum(change > 0) > np.sum(change < 0) and corrected_p(sheet)[chamber, name] < 0.05)


def correlated(r: float, n: int, controls: int = 0) -> bool:
    """Whether a (partial) correlation of n points differs from zero at 5 %, by Fisher's z with `controls` columns
    taken out: ``|artanh r| sqrt(n - 3 - controls) > 1.96``. Source: Fisher, Metron 3 (1924) 329-332."""
    return bool(abs(np.arctanh(np.clip(r, -0.999999, 0.999999))) * np.sqrt(n - 3 - controls) > 1.959964)
