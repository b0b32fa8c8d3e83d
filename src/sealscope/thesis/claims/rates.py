"""What abstract, section 5.6 and the conclusions say of success rates, judged by the sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sealscope.evaluation.binomial import at_least
from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters.appendix_c.success_rates import CLAIMED, DIRECTION, Rule, d1_threshold
from sealscope.thesis.chapters.chapter5 import NOMINAL_LPM
from sealscope.thesis.claims.evidence import (
    SENSITIVE,
    ClaimEvidence,
    SheetTest,
    counted_share,
    fired,
    in_percent,
    on_sheet,
)
from sealscope.thesis.claims.regressions import mean_leaks, told_apart_by_levels
from sealscope.thesis.engine.products import Claim
from sealscope.thesis.sheet import APPENDIX_C, DataSheet

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


def _past_noise(sheet: DataSheet, chamber: str, name: str) -> np.ndarray:
    """Return the tests whose change moves in the chamber's direction beyond what d1 does one time in twenty."""
    return np.asarray(sheet.log_change(chamber, name) * DIRECTION[chamber] > d1_threshold(sheet, chamber))


def _by_chance(rule: Rule) -> float:
    return 0.5 ** len(rule.details)


def _controls(evidence: ClaimEvidence, rule: Rule) -> str:
    return (
        f"In simulation the rule fires in {fired(evidence.still, rule)} with no leak and in "
        f"{fired(evidence.drift, rule)} with drift alone"
    )


def _cell(evidence: ClaimEvidence, number: int, rule: Rule, where: str, printed: Sequence[int]) -> Claim:
    def test(sheet: DataSheet) -> tuple[str, list[bool]]:
        fires = rule.fires(sheet)
        percentage = 100.0 * float(fires.mean())
        p = at_least(int(fires.sum()), fires.size, _by_chance(rule))
        parts = [any(abs(percentage - of) <= 1.0 for of in printed), p < 0.05 / 10]
        return f"{fired(sheet, rule)}; p = {p:.2g} against chance of {100 * _by_chance(rule):g} %", parts

    def why(sheet: DataSheet) -> str:
        reason = (
            "Two parts: the printed rate is within a point of the counted one, and more than chance (5 %, ten columns)"
        )
        if rule is _TOGETHER:
            a, b = (float(part.fires(sheet).mean()) for part in (_A_BOTH, _B_BOTH))
            reason += (
                f"; the printed 65 is near the product of the two printed rates, 0.85 x 0.76 = {0.85 * 0.76:.3f} "
                f"(counted: {a:.3f} x {b:.3f} = {a * b:.3f}), not a count of tests"
            )
        return f"{reason}. {_controls(evidence, rule)}."

    rates = " or ".join(f"{of} %" for of in printed)
    return on_sheet(
        evidence,
        f"claim-5.4.{number}",
        f"Table 5.1 and {where}",
        f"The rule '{rule.name}' succeeds in {rates} of the tests.",
        test,
        why,
    )


def _before_table(sheet: DataSheet) -> tuple[str, list[bool]]:
    texts, parts = [], []
    for chamber, direction in (("p_A", 1), ("p_B", -1)):
        for name in SENSITIVE:
            change = sheet.log_change(chamber, name)
            count = int(np.sum(change * direction > 0))
            texts.append(f"{chamber} {name} {count}")
            parts.append(count > change.size / 2)
    return f"tests as the sentence says, of {_N}: {', '.join(texts)}", parts


def _over_80(sheet: DataSheet) -> tuple[str, list[bool]]:
    texts = "; ".join(f"{rule.name} {fired(sheet, rule)}" for rule in CLAIMED)
    return texts, [bool(rule.fires(sheet).mean() > 0.8) for rule in CLAIMED]


def _levels(sheet: DataSheet) -> tuple[str, list[bool]]:
    past = _past_noise(sheet, "p_A", "d3")
    of_level = {level: past[[row.level == level for row in APPENDIX_C]] for level in NOMINAL_LPM}
    texts = "; ".join(f"{level} {counted_share(tests)}" for level, tests in of_level.items())
    return f"d3 of P_A falls beyond noise: {texts}", [bool(tests.mean() >= 0.8) for tests in of_level.values()]


def _smallest(rules: tuple[Rule, ...]) -> SheetTest:
    def test(sheet: DataSheet) -> tuple[str, list[bool]]:
        row = int(np.argmin(mean_leaks()))
        texts = []
        for rule in rules:
            change = ", ".join(f"{in_percent(sheet.log_change(c, name)[row]):+.1f} %" for c, name in rule.details)
            texts.append(f"{rule.name}: {change}")
        return f"the {mean_leaks()[row]:g} L/min test: {'; '.join(texts)}", [bool(r.fires(sheet)[row]) for r in rules]

    return test


def _abstract_85(sheet: DataSheet) -> tuple[str, list[bool]]:
    fires = _A_BOTH.fires(sheet)
    small = fires[mean_leaks() <= 0.0050]
    text, smallest = _smallest((_A_BOTH,))(sheet)
    return (
        f"{text}; up to 0.0050 L/min {counted_share(small)}; all leaks {counted_share(fires)}",
        [*smallest, bool(small.mean() >= 0.85)],
    )


def _passes_both(sheet: DataSheet) -> tuple[str, list[bool]]:
    fires, leak = _TOGETHER.fires(sheet), mean_leaks()
    least = float(leak[fires].min()) if fires.any() else math.nan
    return (
        f"smallest test that passes d3d4 on both chambers: {least:.4f} L/min; both pass in {counted_share(fires)}",
        [abs(least - 0.0048) < 5e-5, bool(fires.mean() > 0.8)],
    )


def _identified(sheet: DataSheet) -> tuple[str, list[bool]]:
    texts, parts = [], []
    for chamber in CHAMBERS:
        best = max(SENSITIVE, key=lambda name: int(_past_noise(sheet, chamber, name).sum()))
        past = _past_noise(sheet, chamber, best)
        texts.append(f"{chamber}: {best} beyond noise in {counted_share(past)}")
        parts.append(bool(past.mean() >= 0.8))
    return "; ".join(texts), parts


def _without_baseline(sheet: DataSheet) -> str:
    tests, conditions = ("{:.2f} (AUC {:.3f})".format(*told_apart_by_levels(sheet, of)) for of in ("test", "condition"))
    return (
        "Identified: beyond what d1 (noise) does one time in twenty, in 80 % of the tests. Without any baseline, the "
        f"levels of d1..d4 of both chambers tell leak from no leak with an accuracy of {tests} with whole tests held "
        f"out and {conditions} with whole conditions held out; the leak always came second, so drift is in these "
        "figures too."
    )


def claims(evidence: ClaimEvidence) -> tuple[Claim, ...]:
    """Judge the claims of the abstract, sections 5.6 and 5.7, Table 5.1, and chapter 6 on what was detected."""
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
            "The sentence is the wrong way round for the sheet and for Table 5.1; a part holds where most tests are as "
            "it says.",
        ),
        on_sheet(
            evidence,
            "claim-5.6.1",
            "section 5.7",
            "The success rate is above 80 %.",
            _over_80,
            lambda sheet: (
                f"A part for each rate of Table 5.1. {_controls(evidence, _A_D3)} (d3 of P_A). Set for 5 % false "
                f"alarms by d1's scatter, d3 of P_A finds {counted_share(_past_noise(sheet, 'p_A', 'd3'))}."
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
            _smallest(CLAIMED[:6]),
            "A part for each cell of Table 5.1 in that one test.",
        ),
        on_sheet(
            evidence,
            "claim-6.1.1",
            "section 6.1",
            "The success rate is above 80 % with a smallest mean leak of 0.0048 L/min.",
            _passes_both,
            "Parts: 0.0048 L/min is the smallest leak that passes d3d4 on both chambers, and both pass in over 80 %. "
            "Abstract and section 5.7 say 0.0042.",
        ),
    )
