"""What the claims on detection are judged by: the measured sheet, the simulated ones and the ten shown tests."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sealscope.evaluation.binomial import clopper_pearson
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.appendix_c.success_rates import DIRECTION, Rule, column_tests
from sealscope.thesis.chapters.appendix_c.tables import simulated_sheet
from sealscope.thesis.chapters.chapter5 import TESTS, ShownMeasures, measure_test
from sealscope.thesis.claims.judged import judged
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.products import Claim, ThesisTable
from sealscope.thesis.sheet import DataSheet

NO_SHEET = "the thesis's data sheet was not given"
#: The details that chapter 5 calls sensitive.
SENSITIVE = ("d3", "d4", "d3d4")


@dataclass(frozen=True, eq=False)
class ClaimEvidence:
    """The data that the claims are judged by.

    The measured sheet (None: not given), the simulated sheets with leak, with none and with drift only, the table of
    the first, the ten tests of chapter 5 by section, and the first of them without its leak.
    """

    measured: DataSheet | None
    leak: DataSheet
    still: DataSheet
    drift: DataSheet
    table: ThesisTable
    shown: dict[str, ShownMeasures]
    control: ShownMeasures


def gather(context: Context) -> ClaimEvidence:
    """Gather the evidence from the context's items and runs."""
    table, leak = simulated_sheet(context, "appendix-c-leak")
    _, still = simulated_sheet(context, "appendix-c-no-leak")
    _, drift = simulated_sheet(context, "appendix-c-drift")
    control = measure_test(context, TESTS["5.2a"], leak=False)
    shown = {section: measure_test(context, test) for section, test in TESTS.items()}
    return ClaimEvidence(context.sheet, leak, still, drift, table, shown, control)


#: A finding on a sheet, measured or simulated: its words, and which of the claim's parts hold.
Finding = tuple[str, Sequence[bool]]
#: Finds in a sheet what a claim says of it.
SheetTest = Callable[[DataSheet], Iterable[Finding]]


@dataclass(frozen=True)
class SheetClaim:
    """How a claim is judged by a sheet.

    `test` gives the findings, written after `head` with `joint` between them; `values` of the other texts of the claim.
    """

    test: SheetTest
    head: str = ""
    joint: str = "; "
    values: Callable[[ClaimEvidence, DataSheet], Mapping[str, Any]] = lambda evidence, sheet: {}

    def judge(self, evidence: ClaimEvidence, id: str, kind: str = "") -> Claim:
        """Judge by the measured sheet; the same test on the simulated sheet stands beside it."""

        def found(sheet: DataSheet) -> tuple[str, list[bool]]:
            texts, parts = zip(*self.test(sheet), strict=True)
            return self.head + self.joint.join(texts), [part for of in parts for part in of]

        result, parts = (NO_SHEET, []) if evidence.measured is None else found(evidence.measured)
        values = self.values(evidence, evidence.measured or evidence.leak)
        return judged(id, parts, kind, sheet=result, simulation=found(evidence.leak)[0], **values)


def fired(sheet: DataSheet, rule: Rule) -> str:
    """Return `k/n = share %` of the tests that a rule fires in, with its exact 95 % interval."""
    return counted_share(rule.fires(sheet))


def counted_share(tests: Sequence[bool] | np.ndarray) -> str:
    """Return `k/n = share % (low to high)` of the tests that are true, with the exact 95 % interval."""
    k, n = int(np.sum(tests)), len(tests)
    low, high = clopper_pearson(k, n)
    return f"{k}/{n} = {100 * k / n:.1f} % ({100 * low:.0f} to {100 * high:.0f} %)"


def in_percent(change: Array | float) -> float:
    """Return a log change, or the mean of several, in percent."""
    return float(100.0 * np.expm1(np.mean(change)))


def corrected_p(sheet: DataSheet) -> dict[tuple[str, str], float]:
    """Return the sign-test p of every column, corrected (Holm) for all ten."""
    return {(str(row[0]), str(row[1])): float(row[-2]) for row in column_tests(sheet)}  # type: ignore[arg-type]


def moves_beyond_chance(sheet: DataSheet, chamber: str, name: str) -> bool:
    """Return whether a column moves in the chamber's direction beyond chance (5 %, corrected for ten columns)."""
    change = sheet.log_change(chamber, name) * DIRECTION[chamber]
    return bool(np.sum(change > 0) > np.sum(change < 0) and corrected_p(sheet)[chamber, name] < 0.05)


def correlated(r: float, n: int, controls: int = 0) -> bool:
    """Return whether a (partial) correlation of n points differs from zero at 5 %, with `controls` columns taken out.

    By Fisher's z: ``|artanh r| sqrt(n - 3 - controls) > 1.96``. Source: Fisher, Metron 3 (1924) 329-332.
    """
    return bool(abs(np.arctanh(np.clip(r, -0.999999, 0.999999))) * np.sqrt(n - 3 - controls) > 1.959964)
