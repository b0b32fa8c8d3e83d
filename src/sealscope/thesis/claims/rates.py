"""What abstract, section 5.6 and the conclusions say of success rates and trends, judged by the sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sealscope.evaluation.binomial import at_least
from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters.appendix_c.simulated_sheet import log_change
from sealscope.thesis.chapters.appendix_c.success_rates import CLAIMED, WAY, Rule, d1_threshold
from sealscope.thesis.chapters.chapter5.tests import NOMINAL_LPM
from sealscope.thesis.claims.evidence import Evidence, SheetTest, fired, on_sheet, percent, share
from sealscope.thesis.claims.leak_size import condition_groups, mean_leaks, told_by_levels
from sealscope.thesis.conditions import APPENDIX_C
from sealscope.thesis.engine.products import Claim
from sealscope.thesis.sheet import Sheet

_N = len(APPENDIX_C)
_A_D3, _A_D4, _A_BOTH, _B_D3, _B_D4, _B_BOTH, _TOGETHER = CLAIMED
#: Figure and printed rate [%] of each cell of Table 5.1, and the one the text prints beside it.
_CELLS: tuple[tuple[Rule, str, tuple[int, ...]], ...] = (
    (_A_D3, "Fig. 5.90", (100,)),
    (_A_D4, "Fig. 5.91", (64, 65)),
    (_A_BOTH, "Fig. 5.92", (85,)),
    (_B_D3, "Fig. 5.93", (48,)),
    (_B_D4, "Fig. 5.94", (76,)),
    (_B_BOTH, "Fig. 5.95", (76,)),
    (_TOGETHER, "section 5.6", (65,)),
)


def _past_noise(sheet: Sheet, chamber: str, name: str) -> np.ndarray:
    """Tests whose change goes the chamber's way beyond what d1's scatter does one time in twenty."""
    return np.asarray(log_change(sheet, chamber, name) * WAY[chamber] > d1_threshold(sheet, chamber))


def _by_chance(rule: Rule) -> float:
    return 0.5 ** len(rule.details)


def _controls(evidence: Evidence, rule: Rule) -> str:
    return (
        f"In simulation the rule fires in {fired(evidence.still, rule)} with no leak and in "
        f"{fired(evidence.drift, rule)} with drift alone"
    )


def _cell(evidence: Evidence, number: int, rule: Rule, where: str, printed: Sequence[int]) -> Claim:
    def test(sheet: Sheet) -> tuple[str, list[bool]]:
        found = rule.fires(sheet)
        k, rate = int(found.sum()), 100.0 * float(found.mean())
        p = at_least(k, found.size, _by_chance(rule))
        parts = [any(abs(rate - one) <= 1.0 for one in printed), p < 0.05 / 10]
        return f"{fired(sheet, rule)}; p = {p:.2g} against chance of {100 * _by_chance(rule):g} %", parts

    def why(sheet: Sheet) -> str:
        told = (
            "Two parts: the printed rate is within a point of the counted one, and more than chance (5 %, ten columns)"
        )
        if rule is _TOGETHER:
            a, b = (float(one.fires(sheet).mean()) for one in (_A_BOTH, _B_BOTH))
            told += (
                f"; the printed 65 is near the product of the two printed rates, 0.85 x 0.76 = {0.85 * 0.76:.3f} "
                f"(counted: {a:.3f} x {b:.3f} = {a * b:.3f}), not a count of tests"
            )
        return f"{told}. {_controls(evidence, rule)}."

    rates = " or ".join(f"{one} %" for one in printed)
    return on_sheet(
        evidence,
        f"claim-5.4.{number}",
        f"Table 5.1 and {where}",
        f"The rule '{rule.name}' succeeds in {rates} of the tests.",
        test,
        why,
    )


def _before_table(sheet: Sheet) -> tuple[str, list[bool]]:
    told, parts = [], []
    for chamber, said in (("p_A", 1), ("p_B", -1)):
        for name in ("d3", "d4", "d3d4"):
            change = log_change(sheet, chamber, name)
            goes = int(np.sum(change * said > 0))
            told.append(f"{chamber} {name} {goes}")
            parts.append(goes > change.size / 2)
    return f"tests as the sentence says, of {_N}: {', '.join(told)}", parts


def _over_80(sheet: Sheet) -> tuple[str, list[bool]]:
    return "; ".join(f"{rule.name} {fired(sheet, rule)}" for rule in CLAIMED), [
        bool(rule.fires(sheet).mean() > 0.8) for rule in CLAIMED
    ]


def _levels(sheet: Sheet) -> tuple[str, list[bool]]:
    told, parts = [], []
    found = _past_noise(sheet, "p_A", "d3")
    for level in NOMINAL_LPM:
        rows = np.array([row.level == level for row in APPENDIX_C])
        told.append(f"{level} {share(int(found[rows].sum()), int(rows.sum()))}")
        parts.append(bool(found[rows].mean() >= 0.8))
    return f"d3 of P_A falls beyond noise: {'; '.join(told)}", parts


def _smallest(names: tuple[Rule, ...]) -> SheetTest:
    def test(sheet: Sheet) -> tuple[str, list[bool]]:
        row = int(np.argmin(mean_leaks()))
        told = []
        for rule in names:
            change = ", ".join(f"{percent(log_change(sheet, c, name)[row]):+.1f} %" for c, name in rule.details)
            told.append(f"{rule.name}: {change}")
        return f"the {mean_leaks()[row]:g} L/min test: {'; '.join(told)}", [bool(r.fires(sheet)[row]) for r in names]

    return test


def _abstract_85(sheet: Sheet) -> tuple[str, list[bool]]:
    leak = mean_leaks()
    fires = _A_BOTH.fires(sheet)
    small = leak <= 0.0050
    told, smallest = _smallest((_A_BOTH,))(sheet)
    return (
        f"{told}; up to 0.0050 L/min {share(int(fires[small].sum()), int(small.sum()))}; all leaks "
        f"{share(int(fires.sum()), _N)}",
        [*smallest, bool(fires[small].mean() >= 0.85)],
    )


def _passes_both(sheet: Sheet) -> tuple[str, list[bool]]:
    fires, leak = _TOGETHER.fires(sheet), mean_leaks()
    least = float(leak[fires].min()) if fires.any() else math.nan
    return (
        f"smallest test that passes d3d4 on both chambers: {least:.4f} L/min; both pass in "
        f"{share(int(fires.sum()), _N)}",
        [abs(least - 0.0048) < 5e-5, bool(fires.mean() > 0.8)],
    )


def _identified(sheet: Sheet) -> tuple[str, list[bool]]:
    told, parts = [], []
    for chamber in CHAMBERS:
        best = max(("d3", "d4", "d3d4"), key=lambda name: int(_past_noise(sheet, chamber, name).sum()))
        found = _past_noise(sheet, chamber, best)
        told.append(f"{chamber}: {best} beyond noise in {share(int(found.sum()), found.size)}")
        parts.append(bool(found.mean() >= 0.8))
    return "; ".join(told), parts


def _without_baseline(sheet: Sheet) -> str:
    tests, conditions = (told_by_levels(sheet, held) for held in (np.arange(_N), condition_groups()))
    return (
        "Identified: beyond what d1 (noise) does one time in twenty, in 80 % of the tests. Without any baseline, the "
        f"levels of d1..d4 of both chambers tell leak from no leak with an accuracy of {tests.accuracy:.2f} (AUC "
        f"{tests.auc:.3f}) with whole tests held out and {conditions.accuracy:.2f} (AUC {conditions.auc:.3f}) with "
        "whole "
        "conditions held out; the leak always came second, so drift is in these figures too."
    )


def claims(evidence: Evidence) -> tuple[Claim, ...]:
    """Claims of the abstract, sections 5.6 and 5.7, Table 5.1, and chapter 6 on what was detected."""
    cells = tuple(_cell(evidence, k, rule, where, printed) for k, (rule, where, printed) in enumerate(_CELLS, start=1))
    return (
        on_sheet(
            evidence,
            "claim-a.1",
            "abstract",
            "The wavelet details of the pressures on either side identify the internal leak clearly.",
            _identified,
            _without_baseline,
        ),
        on_sheet(
            evidence,
            "claim-a.2",
            "abstract",
            "Leaks down to 0.0042 L/min are detected 85 % of the time.",
            _abstract_85,
            "85 % is the rate of d3d4 on P_A over leaks of all sizes; it says nothing of the smallest, of which there "
            "is one.",
        ),
        *cells,
        on_sheet(
            evidence,
            "claim-5.5.7",
            "section 5.6, sentence before Table 5.1",
            "On P_A the RMS without a leak is lower than with one, on P_B higher.",
            _before_table,
            "The sentence is the wrong way round for the sheet and for Table 5.1; a part holds where most tests are "
            "as it says.",
        ),
        on_sheet(
            evidence,
            "claim-5.6.1",
            "section 5.7",
            "The success rate is above 80 %.",
            _over_80,
            lambda sheet: (
                f"A part for each rate of Table 5.1. {_controls(evidence, _A_D3)} (d3 of P_A). Set for 5 % false "
                f"alarms by d1's scatter, d3 of P_A finds {share(int(_past_noise(sheet, 'p_A', 'd3').sum()), _N)}."
            ),
        ),
        on_sheet(
            evidence,
            "claim-5.6.2",
            "section 5.7",
            "The method detects leaks of every level, from large to extra-small.",
            _levels,
            "A part for each level: d3 of P_A falls beyond noise in 80 % of its tests.",
        ),
        on_sheet(
            evidence,
            "claim-5.6.3",
            "section 5.7",
            "The smallest mean leak detected is 0.0042 L/min.",
            _smallest((_A_D3, _A_D4, _A_BOTH, _B_D3, _B_D4, _B_BOTH)),
            "A part for each cell of Table 5.1 in that one test.",
        ),
        on_sheet(
            evidence,
            "claim-6.1.1",
            "section 6.1",
            "The success rate is above 80 % with a smallest mean leak of 0.0048 L/min.",
            _passes_both,
            "Parts: 0.0048 L/min is the smallest leak that passes d3d4 on both chambers, and both pass in over 80 %. "
            "Abstract "
            "and section 5.7 say 0.0042.",
        ),
    )
