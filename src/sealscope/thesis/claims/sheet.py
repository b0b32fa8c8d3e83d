"""Judge the claims of the abstract, chapter 5 and the conclusions on leaks, details and success rates by the sheet.

A function `_test_...` yields the findings on a data sheet: a text, and True or False for each part of the claim. The
detail d3d4 is the product of the wavelet details d3 and d4. A change is "beyond the noise" if it is larger than a
limit that noise alone exceeds in 5 % of the tests (`d1_threshold`).
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np

from sealscope.errors import MissingExtra
from sealscope.evaluation.binomial import upper_tail
from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters.chapter5 import NOMINAL_LPM, TESTS, PrintedTest
from sealscope.thesis.chapters.success_rates import (
    CLAIMED,
    CLAIMED_CELLS,
    DIRECTION,
    UNCLAIMED,
    Rule,
    d1_threshold,
    drift_threshold,
)
from sealscope.thesis.claims.evidence import (
    NO_SHEET,
    SENSITIVE,
    ClaimEvidence,
    Finding,
    SheetClaim,
    SheetTest,
    change_design,
    classify_without_baseline,
    condition_design,
    format_rate,
    format_rule_rate,
    holm_p_values,
    is_correlated,
    leave_one_out_r2,
    log_change_to_percent,
    moves_beyond_chance,
    partial_correlation,
)
from sealscope.thesis.engine.products import Claim
from sealscope.thesis.engine.texts import judge_claim, load_texts
from sealscope.thesis.sheet import APPENDIX_C, DataSheet, mean_leaks

_N_TESTS = len(APPENDIX_C)
#: Largest rounding error of a leak printed with four decimals [L/min].
_ROUNDING_LPM = 5e-5
#: Leak [L/min] that section 5.2 a states for the large test at 3 sin(4t).
_STATED_LPM = 0.0087
#: Ratios that sections 5.3 to 5.5 state: medium over large, small over medium, extra-small over large.
_STATED_RATIOS = (0.5, 0.5, 1.0 / 16.0)
#: Rules of Table 5.1: d3 of p_A, d3d4 of p_A, d3d4 of p_B, and d3d4 of both chambers.
_A_D3, _, _A_D3D4, _, _, _B_D3D4, _BOTH_D3D4 = CLAIMED


def _exceeds_noise(sheet: DataSheet, chamber: str, name: str) -> np.ndarray:
    """Find the tests in which the RMS of a wavelet detail changes with the leak by more than noise would change it.

    `chamber`: "p_A", for which only falls count, or "p_B", for which only rises count; `name`: the detail, such as
    "d3". The limit is the change of log RMS that noise alone exceeds in 5 % of the tests (`d1_threshold`). Returns a
    mask (tests,).
    """
    return np.asarray(sheet.log_change(chamber, name) * DIRECTION[chamber] > d1_threshold(sheet, chamber))


def _format_controls(evidence: ClaimEvidence, rule: Rule) -> str:
    """Format how often a rule of Table 5.1 fires, i.e. indicates a leak, in simulations without a leak (false alarms).

    One simulation has constant parameters, the other drifting parameters.
    """
    return (
        f"In simulation the rule fires in {format_rule_rate(evidence.no_leak_sheet, rule)} with no leak and in "
        f"{format_rule_rate(evidence.drift_sheet, rule)} with drift alone"
    )


def _rate_claim(rule: Rule, where: str) -> SheetClaim:
    """Build the claim that a rule of Table 5.1 has its printed success rate.

    `where`: place of the claim in the thesis, such as "Fig. 5.90".
    """
    # without an effect each of the rule's details moves in its direction with probability 1/2
    chance = 0.5 ** len(rule.details)
    printed = [int(rate) for rate in re.findall(r"\d+", rule.printed)]  # [%]

    def test_rate(sheet: DataSheet) -> Iterator[Finding]:
        """Test that a rule's success rate is within 1 percentage point of a printed rate, and higher than by chance.

        The success rate is the fraction of the tests in which the rule detects the leak. By chance, each of the rule's
        k details moves as a leak would move it with probability 1/2, which gives a rate of 1/2^k. The rate counts as
        higher if the one-sided binomial p-value is below 0.05/10, as there are ten columns. Yields one finding with two
        results.
        """
        fires = rule.fires(sheet)
        p = upper_tail(int(fires.sum()), fires.size, chance)
        as_printed = any(abs(100.0 * float(fires.mean()) - rate) <= 1.0 for rate in printed)
        text = f"{format_rule_rate(sheet, rule)}; p = {p:.2g} against chance of {100 * chance:g} %"
        yield text, [as_printed, p < 0.05 / 10]  # Bonferroni's correction for ten columns

    def format_values(evidence: ClaimEvidence, sheet: DataSheet) -> dict[str, str]:
        """Make the values that fill the placeholders of the claim's texts, by name.

        - "where": place of the claim in the thesis
        - "name": details and chambers that the rule of Table 5.1 tests
        - "rates": success rates [%] that the thesis prints for the rule
        - "product": a remark on the rate of d3d4 in both chambers, with rates counted on `sheet`; "" for other rules
        - "controls": how often the rule fires in the simulations without a leak, which `evidence` has
        """
        rate_A, rate_B = (float(part.fires(sheet).mean()) for part in (_A_D3D4, _B_D3D4))
        product = (
            f"; the printed 65 is near the product of the two printed rates, 0.85 x 0.76 = {0.85 * 0.76:.3f} "
            f"(counted: {rate_A:.3f} x {rate_B:.3f} = {rate_A * rate_B:.3f}), not a count of tests"
        )
        return {
            "where": where,
            "name": rule.name,
            "rates": " or ".join(f"{rate} %" for rate in printed),
            "product": product if rule is _BOTH_D3D4 else "",
            "controls": _format_controls(evidence, rule),
        }

    return SheetClaim(test_rate, values=format_values)


def _test_opposite_moves(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.5.7: with the leak, the RMS of the wavelet details of p_A rise and those of p_B fall.

    Each of d3, d4 and d3d4 of each chamber must move in this direction in more than half of the tests. All other
    sentences of section 5.6 state the opposite (`DIRECTION`).
    """
    for chamber in CHAMBERS:
        for name in SENSITIVE:
            change = sheet.log_change(chamber, name)
            count = int(np.sum(change * DIRECTION[chamber] < 0))
            yield f"{chamber} {name} {count}", [count > change.size / 2]


def _test_rates_over_80(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.6.1: each rule of Table 5.1 detects the leak, that is fires, in more than 80 % of the tests."""
    for rule in CLAIMED:
        yield f"{rule.name} {format_rule_rate(sheet, rule)}", [bool(rule.fires(sheet).mean() > 0.8)]


def _test_leak_levels(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.6.2: at each level of the leak, d3 of p_A falls beyond the noise in at least 80 % of the tests.

    The levels are "large" to "extra-small". The RMS of the wavelet detail d3 falls beyond the noise if its fall is
    larger than a limit that noise alone exceeds in 5 % of the tests (`d1_threshold`).
    """
    exceeds = _exceeds_noise(sheet, "p_A", "d3")
    for level in NOMINAL_LPM:
        level_exceeds = exceeds[[row.level == level for row in APPENDIX_C]]
        yield f"{level} {format_rate(level_exceeds)}", [bool(level_exceeds.mean() >= 0.8)]


def _smallest_leak_test(rules: tuple[Rule, ...]) -> SheetTest:
    """Build the function that tests whether each of some rules of Table 5.1 detects the smallest leak.

    The smallest leak is that of the test of Appendix C with the smallest mean leak. A rule detects a leak if the rule
    fires (`Rule`).
    """

    def test_smallest(sheet: DataSheet) -> Iterator[Finding]:
        """Test that each rule fires, i.e. detects the leak, in the test with the smallest mean leak."""
        row = int(np.argmin(mean_leaks()))
        for rule in rules:
            changes = (log_change_to_percent(sheet.log_change(c, name)[row]) for c, name in rule.details)
            text = ", ".join(f"{change:+.1f} %" for change in changes)
            yield f"{rule.name}: {text}", [bool(rule.fires(sheet)[row])]

    return test_smallest


def _test_abstract_rate(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim a.2: even small leaks lower the RMS of the product d3d4 of p_A.

    The RMS must fall at the smallest leak, and in at least 85 % of the tests with leaks up to 0.0050 L/min.
    """
    yield from _smallest_leak_test((_A_D3D4,))(sheet)
    fires = _A_D3D4.fires(sheet)
    fires_small = fires[mean_leaks() <= 0.0050]
    text = f"up to 0.0050 L/min {format_rate(fires_small)}; all leaks {format_rate(fires)}"
    yield text, [bool(fires_small.mean() >= 0.85)]


def _test_both_chambers(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 6.1.1: the smallest leak that passes d3d4 on both chambers is 0.0048 L/min, and over 80 % pass.

    A test passes if the RMS of d3d4, the product of the wavelet details d3 and d4, falls in p_A and rises in p_B. The
    first finding is the smallest mean leak of the tests that pass, the second the rate of these among all tests.
    """
    fires, leak = _BOTH_D3D4.fires(sheet), mean_leaks()
    min_leak = float(leak[fires].min()) if fires.any() else math.nan
    yield f"{min_leak:.4f} L/min", [abs(min_leak - 0.0048) < _ROUNDING_LPM]
    yield f"both pass in {format_rate(fires)}", [bool(fires.mean() > 0.8)]


def _test_identified_leaks(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim a.1: in each chamber the best wavelet detail reveals the leak in at least 80 % of the tests.

    A detail reveals the leak if its RMS falls in p_A, or rises in p_B, by more than a limit that noise alone exceeds in
    5 % of the tests (`d1_threshold`). The best of d3, d4 and d3d4 is the detail that reveals the leak most often.
    """
    for chamber in CHAMBERS:
        best = max(SENSITIVE, key=lambda name: int(_exceeds_noise(sheet, chamber, name).sum()))
        exceeds = _exceeds_noise(sheet, chamber, best)
        yield f"{chamber}: {best} beyond noise in {format_rate(exceeds)}", [bool(exceeds.mean() >= 0.8)]


def _baseline_texts(evidence: ClaimEvidence, sheet: DataSheet) -> dict[str, Any]:
    """Format the success of detecting leaks without a healthy baseline, for the texts of claim a.1.

    Both texts state the accuracy of a cross-validated classifier and its area under the ROC curve, with single tests
    left out of the fit ("tests"), and with whole operating conditions left out ("conditions"). Without scikit-learn
    they state that it is needed. `evidence` is not used.
    """
    texts = {}
    groups: tuple[Literal["test", "condition"], ...] = ("test", "condition")
    for name in groups:
        try:
            accuracy, area = classify_without_baseline(sheet, name)
            texts[f"{name}s"] = f"{accuracy:.2f} (AUC {area:.3f})"
        except MissingExtra:
            texts[f"{name}s"] = "? (needs scikit-learn)"
    return texts


def _noise_limit_texts(evidence: ClaimEvidence, sheet: DataSheet) -> dict[str, Any]:
    """Format two results on the rule that the RMS of d3 of p_A falls, for the texts of claim 5.6.1.

    - "controls": how often the rule fires in simulations without a leak (false alarms)
    - "finds": rate of the tests on the sheet in which the RMS falls beyond the noise (`d1_threshold`)
    """
    rate_beyond_noise = format_rate(_exceeds_noise(sheet, "p_A", "d3"))
    return {"controls": _format_controls(evidence, _A_D3), "finds": rate_beyond_noise}


def _trend_test(chamber: str) -> SheetTest:
    """Build the function that tests if a chamber's wavelet details follow the mean leak in the claimed direction.

    The function tests claim 5.5.3 for p_A or 5.5.4 for p_B on a data sheet. `chamber`: "p_A" or "p_B".
    """
    leak, conditions, direction = mean_leaks(), condition_design(), DIRECTION[chamber]

    def test_correlations(sheet: DataSheet) -> Iterator[Finding]:
        """Test that each detail's log change is significantly correlated with the mean leak, with the claimed sign.

        The sign is negative for p_A and positive for p_B. Tested are the plain correlation and the partial correlation
        given the operating condition (`partial_correlation`), both at the 5 % level.
        """
        for name in SENSITIVE:
            change = sheet.log_change(chamber, name)
            raw = float(np.corrcoef(change, leak)[0, 1])
            partial = partial_correlation(change, leak, conditions)
            is_raw_significant = is_correlated(raw, _N_TESTS)
            is_partial_significant = is_correlated(partial, _N_TESTS, conditions.shape[1])
            parts = [raw * direction > 0 and is_raw_significant, partial * direction > 0 and is_partial_significant]
            yield f"{name}: {raw:+.2f}, at equal condition {partial:+.2f}", parts

    return test_correlations


def _prediction_values(evidence: ClaimEvidence, sheet: DataSheet) -> dict[str, Any]:
    """Compute how well two linear regressions predict the mean leak of a test, for the texts of claims 5.5.3 and 5.5.4.

    Returns the leave-one-out R^2 of each regression over the tests of Appendix C:

    - "condition": on the operating condition alone, i.e. the command and the closing of the throttles
    - "changes": on the logarithmic changes of the RMS of both chambers' details on `sheet` (`change_design`)

    `evidence` is not used.
    """
    return {
        "condition": leave_one_out_r2(condition_design(), mean_leaks()),
        "changes": leave_one_out_r2(change_design(sheet), mean_leaks()),
    }


def _test_sensitive_details(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.5.1: the wavelet details in Table 5.1 change significantly, and the details left out do not.

    The table has d3, d4 and d3d4 of both chambers, which must move as the thesis states (`moves_beyond_chance`). The
    table leaves out d1 and d2, for which the sign test, corrected by Holm for ten columns, must give a p-value of at
    least 0.05.
    """
    p = holm_p_values(sheet)
    for rule in (*CLAIMED_CELLS, *UNCLAIMED):
        ((chamber, name),) = rule.details  # one detail
        column_p = p[chamber, name]
        as_claimed = moves_beyond_chance(sheet, chamber, name) if rule in CLAIMED else column_p >= 0.05
        change = log_change_to_percent(sheet.log_change(chamber, name))
        yield f"{chamber} {name} {change:+.1f} % (p = {column_p:.2g})", [as_claimed]


def _test_product_detail(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.5.2: the product d3d4 has a larger effect size than d3 and than d4, for each chamber.

    The effect size is the mean of the log changes of the RMS with the leak in all tests, divided by their standard
    deviation. A fall counts as positive for p_A, and a rise for p_B.
    """
    for chamber in CHAMBERS:
        changes = {name: sheet.log_change(chamber, name) * DIRECTION[chamber] for name in SENSITIVE}
        effect_sizes = {name: float(change.mean() / change.std(ddof=1)) for name, change in changes.items()}
        text = ", ".join(f"{name} {size:.2f}" for name, size in effect_sizes.items())
        yield f"{chamber}: {text}", [effect_sizes["d3d4"] > max(effect_sizes["d3"], effect_sizes["d4"])]


def _test_opposite_chambers(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.5.6: the log changes of the RMS of a detail in p_A and in p_B are negatively correlated.

    For each of d3, d4 and d3d4, the correlation over the tests must be negative and differ from 0 at the 5 % level.
    """
    for name in SENSITIVE:
        change_A, change_B = (sheet.log_change(chamber, name) for chamber in CHAMBERS)
        r = float(np.corrcoef(change_A, change_B)[0, 1])
        n_opposite = int(np.sum(change_A * change_B < 0))
        text = f"{name}: correlation {r:+.2f}, opposite signs in {n_opposite} of {change_A.size}"
        yield text, [r < 0 and is_correlated(r, change_A.size)]


def _test_p_B_rises(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.5.5: with the leak, the RMS of the wavelet details d3, d4 and d3d4 of p_B rises significantly.

    The criterion is that of `moves_beyond_chance`: more rises than falls, and a corrected p-value below 0.05.
    """
    p = holm_p_values(sheet)
    for name in SENSITIVE:
        n_up = int(np.sum(sheet.log_change("p_B", name) > 0))
        yield f"{name} up in {n_up} (p = {p['p_B', name]:.2g})", [moves_beyond_chance(sheet, "p_B", name)]


def _test_printed_rows(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.3.1: in the ten tests that chapter 5 shows, the details of p_A fall and those of p_B rise.

    For each of d3, d4 and d3d4, the RMS with the leak must be smaller (p_A) or larger (p_B) than without it in all of
    these tests.
    """
    for chamber, verb in (("p_A", "falls"), ("p_B", "rises")):
        for name in SENSITIVE:
            moves = sheet.log_change(chamber, name)[_PRINTED_ROWS] * DIRECTION[chamber] > 0
            yield f"{name} of {chamber} {verb} in {int(moves.sum())}", [bool(np.all(moves))]


#: Rows of the sheet that chapter 5 shows.
_PRINTED_ROWS = sorted({test.condition.number - 1 for test in TESTS.values()})
_SMALLEST = f"the {mean_leaks().min():g} L/min test: "
_CORRELATION = "correlation of the change with the mean leak: "
_CLAIMS: dict[str, SheetClaim] = {
    "5.3.1": SheetClaim(_test_printed_rows, f"of the {len(_PRINTED_ROWS)} rows: ", ", "),
    "a.1": SheetClaim(_test_identified_leaks, values=_baseline_texts),
    "a.2": SheetClaim(_test_abstract_rate, _SMALLEST),
    "5.5.7": SheetClaim(_test_opposite_moves, f"tests as the sentence says, of {_N_TESTS}: ", ", "),
    "5.6.1": SheetClaim(_test_rates_over_80, values=_noise_limit_texts),
    "5.6.2": SheetClaim(_test_leak_levels, "d3 of P_A falls beyond noise: "),
    "5.6.3": SheetClaim(_smallest_leak_test(CLAIMED_CELLS), _SMALLEST),
    "6.1.1": SheetClaim(_test_both_chambers, "smallest test that passes d3d4 on both chambers: "),
    "5.5.1": SheetClaim(
        _test_sensitive_details, values=lambda evidence, sheet: {"d2": format_rule_rate(sheet, UNCLAIMED[1])}
    ),
    "5.5.2": SheetClaim(_test_product_detail, "mean over scatter of the log change, "),
    "5.5.3": SheetClaim(_trend_test("p_A"), _CORRELATION, values=_prediction_values),
    "5.5.4": SheetClaim(_trend_test("p_B"), _CORRELATION, values=_prediction_values),
    "5.5.5": SheetClaim(_test_p_B_rises, f"of {_N_TESTS}: ", ", "),
    "5.5.6": SheetClaim(_test_opposite_chambers),
}


def claims(evidence: ClaimEvidence) -> Iterator[Claim]:
    """Judge the claims that the data sheet decides: abstract, sections 5.6 and 5.7, Table 5.1, and chapter 6."""
    for number, rule in enumerate(CLAIMED, start=1):
        where = "section 5.6" if rule is _BOTH_D3D4 else f"Fig. 5.{89 + number}"  # Figs. 5.90 to 5.95
        yield _rate_claim(rule, where).judge(evidence, id=f"5.4.{number}", kind="5.4")
    for id, claim in _CLAIMS.items():
        yield claim.judge(evidence, id)


#: The thesis's statement on a chamber's curves: they fall, or only change.
Statement = Literal["fall", "change"]


def leak_level_claims() -> Iterator[Claim]:
    """Judge claims 5.1.1 to 5.1.3 on the levels of the leak ("large" to "extra-small").

    5.1.1: each level's nominal leak is within the range of its tests' mean leaks, and the ranges do not overlap. 5.1.2:
    the nominal leaks have the ratios that the thesis states, within 25 %. 5.1.3: a "large" test with the command 3
    sin(4t) has the mean leak that section 5.2 states.
    """
    leaks = {level: [row.mean_leak_lpm for row in APPENDIX_C if row.level == level] for level in NOMINAL_LPM}
    texts = [f"{level} {min(lpm):.4f} to {max(lpm):.4f}, mean {np.mean(lpm):.4f}" for level, lpm in leaks.items()]
    contains_nominal = [min(values) <= NOMINAL_LPM[level] <= max(values) for level, values in leaks.items()]
    is_separate = [min(upper) > max(lower) for upper, lower in itertools.pairwise(leaks.values())]  # largest first
    yield judge_claim("5.1.1", [*contains_nominal, *is_separate], levels="; ".join(texts))
    real_lpm = {level: float(np.mean(values)) for level, values in leaks.items()}
    nominal, real = (
        (lpm["medium"] / lpm["large"], lpm["small"] / lpm["medium"], lpm["extra-small"] / lpm["large"])
        for lpm in (NOMINAL_LPM, real_lpm)
    )
    tests = [abs(ratio / stated - 1.0) < 0.25 for ratio, stated in zip(nominal, _STATED_RATIOS, strict=True)]
    nominal_text, real_text = (", ".join(f"{ratio:.2f}" for ratio in ratios) for ratios in (nominal, real))
    yield judge_claim("5.1.2", tests, nominal=nominal_text, real=real_text)
    large_rows = [row for row in APPENDIX_C if row.level == "large" and row.command == "3 sin(4t)"]
    rows = ", ".join(f"row {row.number}: {row.mean_leak_lpm:g} L/min" for row in large_rows)
    same_leak = [row for row in APPENDIX_C if row.mean_leak_lpm == _STATED_LPM]
    same_text = ", ".join(f"{row.number} ({row.command}, {row.level})" for row in same_leak)
    tests = [any(abs(row.mean_leak_lpm - _STATED_LPM) < _ROUNDING_LPM for row in large_rows)]
    yield judge_claim("5.1.3", tests, rows=rows, same=same_text)


def _test_rows(
    sheet: DataSheet, test: PrintedTest, chamber: str, names: Sequence[str], statement: Statement
) -> tuple[str, list[bool]]:
    """Test that the RMS of wavelet details change by more than the noise in one row of the data sheet.

    The row is that of `test.condition`, the test of Appendix C for which the test of chapter 5 is taken. `names`: the
    details; `statement`: "fall" if only falls count, "change" for changes of either sign. The limit is the change that
    noise alone exceeds in 5 % of the tests (`d1_threshold`). Returns a text, and True or False for each detail. If
    several rows can be the test of chapter 5, the text also counts how many of them change beyond the noise.
    """
    row = test.condition.number - 1
    limit = d1_threshold(sheet, chamber, either_side=statement == "change")
    changes = {name: sheet.log_change(chamber, name) for name in names}
    falls = statement == "fall"
    exceeds = {name: (-change if falls else np.abs(change)) > limit for name, change in changes.items()}
    row_changes = {name: log_change_to_percent(float(change[row])) for name, change in changes.items()}
    changes_text = ", ".join(f"{name} {percent:+.1f} %" for name, percent in row_changes.items())
    noise_text = f"{log_change_to_percent(-limit):+.1f} %"
    if statement == "change":
        noise_text += f" or {log_change_to_percent(limit):+.1f} %"
    text = f"row {row + 1}: {changes_text}; noise reaches {noise_text}"
    rows = [candidate.number - 1 for candidate in test.candidates]
    if len(rows) > 1:
        counts = ", ".join(f"{name} {np.sum(mask[rows])}" for name, mask in exceeds.items())
        text += f"; of the {len(rows)} rows it can be, beyond noise: {counts}"
    return text, [bool(mask[row]) for mask in exceeds.values()]


def curve_claims(evidence: ClaimEvidence) -> Iterator[Claim]:
    """Judge the claims of chapter 5 that a leak lowers, or changes, the RMS of wavelet details of a chamber's pressure.

    Each claim names a test, some details, and whether their RMS fall or only change. In the measured data sheet the RMS
    of each detail must do so by more than the noise (`_test_rows`); without this sheet the claim cannot be tested. For
    comparison, the texts state the simulated changes, and the changes that drifting parameters alone exceed in 5 % of
    the simulated tests.
    """
    curves = load_texts("cases.toml")["curves"]
    for number, (section, chamber, names, statement) in enumerate(curves, start=1):
        test = TESTS[section]
        rms_pairs = ((name, evidence.test_measures[section].rms[chamber][name]) for name in names)
        simulated_changes = {name: 100 * (after / before - 1) for name, (before, after) in rms_pairs}
        drift_limits = (DIRECTION[chamber] * drift_threshold(evidence.drift_sheet, chamber, name) for name in names)
        is_beyond: list[bool] = []
        sheet_text = NO_SHEET
        if evidence.measured_sheet is not None:
            sheet_text, is_beyond = _test_rows(evidence.measured_sheet, test, chamber, names, statement)
        # `is_beyond` is empty without the measured sheet
        exceeding = [name for name, exceeds_noise in zip(names, is_beyond, strict=False) if exceeds_noise]
        by_relation = {"beyond": exceeding, "within": [name for name in names if name not in exceeding]}
        relations = [f"{_join_words(details)} {relation}" for relation, details in by_relation.items() if details]
        # order of a test's figures: input figures, two of the leak, three of p_A (details, close-up, RMS), three of p_B
        first = test.first_figure + test.n_input_figures + 2 + (0 if chamber == "p_A" else 3)
        yield judge_claim(
            f"5.2.{number}",
            is_beyond,
            "5.2",
            section=f"{section[:3]} {section[3:]}",
            first=first,
            last=first + 2,
            level=f"{'an' if test.level[0] in 'aeiou' else 'a'} {test.level} leak",
            command=test.command,
            names=_join_words(names),
            chamber=chamber,
            does="falls" if statement == "fall" else "changes",
            sheet=sheet_text,
            simulated=", ".join(f"{name} {percent:+.1f} %" for name, percent in simulated_changes.items()),
            limits=", ".join(f"{log_change_to_percent(limit):+.1f} %" for limit in drift_limits),
            beyond_or_within=" and ".join(relations),
            **({} if is_beyond else {"why": NO_SHEET}),
        )


def _join_words(names: Sequence[str]) -> str:
    """Join words with commas and a final "and", such as "d3, d4 and d3d4"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
