"""Claims of chapter 5, the abstract and the conclusions on leaks, details and success rates, judged by the sheet."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np

from sealscope.errors import MissingExtra
from sealscope.evaluation.binomial import at_least
from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters.chapter5 import NOMINAL_LPM, TESTS, ShownTest
from sealscope.thesis.chapters.success_rates import CLAIMED, DIRECTION, UNCLAIMED, Rule, d1_threshold, drift_threshold
from sealscope.thesis.claims import evidence as ev
from sealscope.thesis.claims.evidence import (
    NO_SHEET,
    SENSITIVE,
    ClaimEvidence,
    Finding,
    SheetClaim,
    SheetTest,
    corrected_p,
    correlated,
    counted_share,
    fired_share,
    in_percent,
    moves_beyond_chance,
)
from sealscope.thesis.engine.products import Claim
from sealscope.thesis.engine.texts import judge_claim, texts_of
from sealscope.thesis.sheet import APPENDIX_C, DataSheet, mean_leaks

_N = len(APPENDIX_C)
_A_D3, _, _A_BOTH, _, _, _B_BOTH, _TOGETHER = CLAIMED


def _past_noise(sheet: DataSheet, chamber: str, name: str) -> np.ndarray:
    """Select the tests whose change moves in the chamber's direction beyond d1's of one time in twenty."""
    return np.asarray(sheet.log_change(chamber, name) * DIRECTION[chamber] > d1_threshold(sheet, chamber))


def _controls(evidence: ClaimEvidence, rule: Rule) -> str:
    return (
        f"In simulation the rule fires in {fired_share(evidence.still, rule)} with no leak and in "
        f"{fired_share(evidence.drift, rule)} with drift alone"
    )


def _cell(rule: Rule, where: str) -> SheetClaim:
    chance, printed = 0.5 ** len(rule.details), [int(rate) for rate in re.findall(r"\d+", rule.printed)]

    def test(sheet: DataSheet) -> Iterator[Finding]:
        fires = rule.fires(sheet)
        p = at_least(int(fires.sum()), fires.size, chance)
        near = any(abs(100.0 * float(fires.mean()) - rate) <= 1.0 for rate in printed)
        yield f"{fired_share(sheet, rule)}; p = {p:.2g} against chance of {100 * chance:g} %", [near, p < 0.05 / 10]

    def values(evidence: ClaimEvidence, sheet: DataSheet) -> dict[str, str]:
        a, b = (float(part.fires(sheet).mean()) for part in (_A_BOTH, _B_BOTH))
        product = (
            f"; the printed 65 is near the product of the two printed rates, 0.85 x 0.76 = {0.85 * 0.76:.3f} "
            f"(counted: {a:.3f} x {b:.3f} = {a * b:.3f}), not a count of tests"
        )
        return {
            "where": where,
            "name": rule.name,
            "rates": " or ".join(f"{rate} %" for rate in printed),
            "product": product if rule is _TOGETHER else "",
            "controls": _controls(evidence, rule),
        }

    return SheetClaim(test, values=values)


def _before_table(sheet: DataSheet) -> Iterator[Finding]:
    for chamber in CHAMBERS:
        for name in SENSITIVE:
            change = sheet.log_change(chamber, name)
            count = int(np.sum(change * DIRECTION[chamber] < 0))
            yield f"{chamber} {name} {count}", [count > change.size / 2]


def _over_80(sheet: DataSheet) -> Iterator[Finding]:
    for rule in CLAIMED:
        yield f"{rule.name} {fired_share(sheet, rule)}", [bool(rule.fires(sheet).mean() > 0.8)]


def _levels(sheet: DataSheet) -> Iterator[Finding]:
    past = _past_noise(sheet, "p_A", "d3")
    for level in NOMINAL_LPM:
        tests = past[[row.level == level for row in APPENDIX_C]]
        yield f"{level} {counted_share(tests)}", [bool(tests.mean() >= 0.8)]


def _smallest(rules: tuple[Rule, ...]) -> SheetTest:
    """Build the test of the rules on the test with the smallest mean leak."""

    def test(sheet: DataSheet) -> Iterator[Finding]:
        row = int(np.argmin(mean_leaks()))
        for rule in rules:
            change = ", ".join(f"{in_percent(sheet.log_change(c, name)[row]):+.1f} %" for c, name in rule.details)
            yield f"{rule.name}: {change}", [bool(rule.fires(sheet)[row])]

    return test


def _abstract_85(sheet: DataSheet) -> Iterator[Finding]:
    yield from _smallest((_A_BOTH,))(sheet)
    fires = _A_BOTH.fires(sheet)
    small = fires[mean_leaks() <= 0.0050]
    yield f"up to 0.0050 L/min {counted_share(small)}; all leaks {counted_share(fires)}", [bool(small.mean() >= 0.85)]


def _passes_both(sheet: DataSheet) -> Iterator[Finding]:
    fires, leak = _TOGETHER.fires(sheet), mean_leaks()
    least = float(leak[fires].min()) if fires.any() else math.nan
    yield f"{least:.4f} L/min", [abs(least - 0.0048) < 5e-5]
    yield f"both pass in {counted_share(fires)}", [bool(fires.mean() > 0.8)]


def _identified(sheet: DataSheet) -> Iterator[Finding]:
    for chamber in CHAMBERS:
        best = max(SENSITIVE, key=lambda name: int(_past_noise(sheet, chamber, name).sum()))
        past = _past_noise(sheet, chamber, best)
        yield f"{chamber}: {best} beyond noise in {counted_share(past)}", [bool(past.mean() >= 0.8)]


def _without_baseline(evidence: ClaimEvidence, sheet: DataSheet) -> dict[str, Any]:
    texts = {}
    groups: tuple[Literal["test", "condition"], ...] = ("test", "condition")
    for name in groups:
        try:
            text = "{:.2f} (AUC {:.3f})".format(*ev.separation_by_levels(sheet, name))
        except MissingExtra:
            text = "? (needs scikit-learn)"
        texts[f"{name}s"] = text
    return texts


def _at_5_percent(evidence: ClaimEvidence, sheet: DataSheet) -> dict[str, Any]:
    finds = counted_share(_past_noise(sheet, "p_A", "d3"))
    return {"controls": _controls(evidence, _A_D3), "finds": finds}


def _trend(chamber: str) -> SheetTest:
    """Build the test of the changes of a chamber's details against the mean leak."""
    leak, conditions, direction = mean_leaks(), ev.condition_columns(), DIRECTION[chamber]

    def test(sheet: DataSheet) -> Iterator[Finding]:
        for name in SENSITIVE:
            change = sheet.log_change(chamber, name)
            raw, left = float(np.corrcoef(change, leak)[0, 1]), ev.partial_correlation(change, leak, conditions)
            significant = correlated(raw, _N), correlated(left, _N, conditions.shape[1])
            parts = [r * direction > 0 and passes for r, passes in zip((raw, left), significant, strict=True)]
            yield f"{name}: {raw:+.2f}, at equal condition {left:+.2f}", parts

    return test


def _predicted(evidence: ClaimEvidence, sheet: DataSheet) -> dict[str, Any]:
    columns = {"condition": ev.condition_columns(), "changes": ev.change_columns(sheet)}
    return {name: ev.left_out_r2(design, mean_leaks()) for name, design in columns.items()}


def _sensitive(sheet: DataSheet) -> Iterator[Finding]:
    p = corrected_p(sheet)
    for rule in (*CLAIMED[:6], *UNCLAIMED):
        ((chamber, name),) = rule.details
        column = chamber, name
        part = moves_beyond_chance(sheet, *column) if rule in CLAIMED else p[column] >= 0.05
        yield f"{chamber} {name} {in_percent(sheet.log_change(*column)):+.1f} % (p = {p[column]:.2g})", [part]


def _amplified(sheet: DataSheet) -> Iterator[Finding]:
    for chamber in CHAMBERS:
        changes = {name: sheet.log_change(chamber, name) * DIRECTION[chamber] for name in SENSITIVE}
        sizes = {name: float(change.mean() / change.std(ddof=1)) for name, change in changes.items()}
        text = ", ".join(f"{name} {size:.2f}" for name, size in sizes.items())
        yield f"{chamber}: {text}", [sizes["d3d4"] > max(sizes["d3"], sizes["d4"])]


def _inverse(sheet: DataSheet) -> Iterator[Finding]:
    for name in SENSITIVE:
        a, b = (sheet.log_change(chamber, name) for chamber in CHAMBERS)
        r = float(np.corrcoef(a, b)[0, 1])
        text = f"{name}: correlation {r:+.2f}, opposite signs in {int(np.sum(a * b < 0))} of {a.size}"
        yield text, [r < 0 and correlated(r, a.size)]


def _upward(sheet: DataSheet) -> Iterator[Finding]:
    p = corrected_p(sheet)
    for name in SENSITIVE:
        up = int(np.sum(sheet.log_change("p_B", name) > 0))
        yield f"{name} up in {up} (p = {p['p_B', name]:.2g})", [moves_beyond_chance(sheet, "p_B", name)]


def _consistent(sheet: DataSheet) -> Iterator[Finding]:
    for chamber, verb in (("p_A", "falls"), ("p_B", "rises")):
        for name in SENSITIVE:
            moves = sheet.log_change(chamber, name)[_SHOWN_ROWS] * DIRECTION[chamber] > 0
            yield f"{name} of {chamber} {verb} in {int(moves.sum())}", [bool(np.all(moves))]


#: Rows of the sheet that chapter 5 shows.
_SHOWN_ROWS = sorted({test.condition.number - 1 for test in TESTS.values()})
_SMALLEST = f"the {mean_leaks().min():g} L/min test: "
_CORRELATION = "correlation of the change with the mean leak: "
_CLAIMS: dict[str, SheetClaim] = {
    "5.3.1": SheetClaim(_consistent, f"of the {len(_SHOWN_ROWS)} rows: ", ", "),
    "a.1": SheetClaim(_identified, values=_without_baseline),
    "a.2": SheetClaim(_abstract_85, _SMALLEST),
    "5.5.7": SheetClaim(_before_table, f"tests as the sentence says, of {_N}: ", ", "),
    "5.6.1": SheetClaim(_over_80, values=_at_5_percent),
    "5.6.2": SheetClaim(_levels, "d3 of P_A falls beyond noise: "),
    "5.6.3": SheetClaim(_smallest(CLAIMED[:6]), _SMALLEST),
    "6.1.1": SheetClaim(_passes_both, "smallest test that passes d3d4 on both chambers: "),
    "5.5.1": SheetClaim(_sensitive, values=lambda evidence, sheet: {"d2": fired_share(sheet, UNCLAIMED[1])}),
    "5.5.2": SheetClaim(_amplified, "mean over scatter of the log change, "),
    "5.5.3": SheetClaim(_trend("p_A"), _CORRELATION, values=_predicted),
    "5.5.4": SheetClaim(_trend("p_B"), _CORRELATION, values=_predicted),
    "5.5.5": SheetClaim(_upward, f"of {_N}: ", ", "),
    "5.5.6": SheetClaim(_inverse),
}


def claims(evidence: ClaimEvidence) -> Iterator[Claim]:
    """Judge the claims of the abstract, sections 5.6 and 5.7, Table 5.1, and chapter 6 on detection."""
    for number, rule in enumerate(CLAIMED, start=1):
        where = "section 5.6" if rule is _TOGETHER else f"Fig. 5.{89 + number}"
        yield _cell(rule, where).judge(evidence, f"5.4.{number}", "5.4")
    for id, claim in _CLAIMS.items():
        yield claim.judge(evidence, id)


#: What is said of a chamber's curves: that they fall, or only that they change.
Statement = Literal["fall", "change"]


def levels() -> Iterator[Claim]:
    """Judge claims 5.1.1 to 5.1.3."""
    spans = {level: [row.mean_leak_lpm for row in APPENDIX_C if row.level == level] for level in NOMINAL_LPM}
    texts = [
        f"{level} {min(values):.4f} to {max(values):.4f}, mean {np.mean(values):.4f}" for level, values in spans.items()
    ]
    contains = [min(values) <= NOMINAL_LPM[level] <= max(values) for level, values in spans.items()]
    separate = [min(upper) > max(lower) for upper, lower in itertools.pairwise(spans.values())]
    yield judge_claim("5.1.1", [*contains, *separate], levels="; ".join(texts))
    nominal, real = (
        (values[1] / values[0], values[2] / values[1], values[3] / values[0])
        for values in (list(NOMINAL_LPM.values()), [float(np.mean(values)) for values in spans.values()])
    )
    tests = [abs(ratio / stated - 1.0) < 0.25 for ratio, stated in zip(nominal, (0.5, 0.5, 1.0 / 16.0), strict=True)]
    ratio_texts = {
        name: ", ".join(f"{ratio:.2f}" for ratio in ratios) for name, ratios in (("nominal", nominal), ("real", real))
    }
    yield judge_claim("5.1.2", tests, **ratio_texts)
    large_rows = [row for row in APPENDIX_C if row.level == "large" and row.command == "3 sin(4t)"]
    rows = ", ".join(f"row {row.number}: {row.mean_leak_lpm:g} L/min" for row in large_rows)
    same_leaks = [f"{row.number} ({row.command}, {row.level})" for row in APPENDIX_C if row.mean_leak_lpm == 0.0087]
    tests = [any(abs(row.mean_leak_lpm - 0.0087) < 5e-5 for row in large_rows)]
    yield judge_claim("5.1.3", tests, rows=rows, same=", ".join(same_leaks))


def _on_rows(
    sheet: DataSheet, test: ShownTest, chamber: str, names: Sequence[str], statement: Statement
) -> tuple[str, list[bool]]:
    """Test the changes of the named details in the row taken for the test, and count them over all possible rows."""
    row, limit = test.condition.number - 1, d1_threshold(sheet, chamber, either_side=statement == "change")
    changes = {name: sheet.log_change(chamber, name) for name in names}
    fires = {
        name: -change > limit if statement == "fall" else np.abs(change) > limit for name, change in changes.items()
    }
    changed = ", ".join(f"{name} {in_percent(float(change[row])):+.1f} %" for name, change in changes.items())
    reach = f"{in_percent(-limit):+.1f} %" + ("" if statement == "fall" else f" or {in_percent(limit):+.1f} %")
    text = f"row {row + 1}: {changed}; noise reaches {reach}"
    rows = [candidate.number - 1 for candidate in test.candidates]
    if len(rows) > 1:
        counts = ", ".join(f"{name} {np.sum(change[rows])}" for name, change in fires.items())
        text += f"; of the {len(rows)} rows it can be, beyond noise: {counts}"
    return text, [bool(change[row]) for change in fires.values()]


def curves(evidence: ClaimEvidence) -> Iterator[Claim]:
    """Judge a claim for each chamber of each test."""
    for number, (section, chamber, names, statement) in enumerate(texts_of("cases.toml")["curves"], start=1):
        test, rms = TESTS[section], evidence.shown[section].rms[chamber]
        limits = (DIRECTION[chamber] * drift_threshold(evidence.drift, chamber, name) for name in names)
        parts: list[bool] = []
        text = NO_SHEET
        if evidence.measured is not None:
            text, parts = _on_rows(evidence.measured, test, chamber, names, statement)
        beyond_names = [name for name, part in zip(names, parts, strict=False) if part]
        sides = {"beyond": beyond_names, "within": [name for name in names if name not in beyond_names]}
        first = test.first + test.inputs + 2 + (0 if chamber == "p_A" else 3)  # the details; their RMS two on
        yield judge_claim(
            f"5.2.{number}",
            parts,
            "5.2",
            section=f"{section[:3]} {section[3:]}",
            first=first,
            last=first + 2,
            level=f"{'an' if test.level[0] in 'aeiou' else 'a'} {test.level} leak",
            command=test.command,
            names=_join_words(names),
            chamber=chamber,
            does="falls" if statement == "fall" else "changes",
            sheet=text,
            simulated=", ".join(f"{name} {100 * (rms[name][1] / rms[name][0] - 1):+.1f} %" for name in names),
            limits=", ".join(f"{in_percent(limit):+.1f} %" for limit in limits),
            beyond_or_within=" and ".join(
                f"{_join_words(details)} {side}" for side, details in sides.items() if details
            ),
            **({} if parts else {"why": NO_SHEET}),
        )


def _join_words(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
