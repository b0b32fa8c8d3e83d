"""Judge the claims of the abstract, chapter 5 and the conclusions on leaks, details and success rates by the sheet.

A function `_test_...` yields the findings on a data sheet: the numbers as text, and for each part of the claim whether
they meet it. d3d4 is the product of the wavelet details d3 and d4. A change is "beyond the noise" if it exceeds a limit
that noise alone exceeds in 5 % of the tests (`d1_threshold`).
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from sealscope.errors import MissingExtra
from sealscope.evaluation.binomial import upper_tail
from sealscope.recordings.channels import CHAMBERS
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
    change_design,
    classify_without_baseline,
    condition_design,
    format_rate,
    holm_p_values,
    is_correlated,
    judge_on_sheets,
    leave_one_out_r2,
    moves_beyond_chance,
    partial_correlation,
)
from sealscope.thesis.engine.products import Claim
from sealscope.thesis.engine.texts import judge_claim, load_texts
from sealscope.thesis.sheet import APPENDIX_C, DataSheet, log_change_to_percent, mean_leaks

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
    """Find the tests (tests,) in which a detail's RMS falls (p_A) or rises (p_B) with the leak beyond the noise."""
    return np.asarray(sheet.log_change(chamber, name) * DIRECTION[chamber] > d1_threshold(sheet, chamber))


def _format_controls(evidence: ClaimEvidence, rule: Rule) -> str:
    """Format the false-alarm rates of a rule of Table 5.1, simulated without a leak, without and with drift."""
    no_leak, drift = (format_rate(rule.fires(sheet)) for sheet in (evidence.no_leak_sheet, evidence.drift_sheet))
    return f"In simulation the rule fires in {no_leak} with no leak and in {drift} with drift alone"


def _judge_rate(evidence: ClaimEvidence, sheet: DataSheet, number: int, rule: Rule) -> Claim:
    """Judge claim 5.4.`number`, that a rule of Table 5.1 has the success rate that the thesis prints for it.

    The rate must be within 1 percentage point of a printed one, and higher than by chance: without an effect each of
    the rule's k details moves in the direction of a leak with probability 1/2, and all of them with 1/2^k. The
    one-sided binomial p-value must be below 0.05/10. For the rule on both chambers, the text also states the rates of
    d3d4 in `sheet`.
    """
    chance = 0.5 ** len(rule.details)
    printed = [int(rate) for rate in re.findall(r"\d+", rule.printed)]  # [%]; several where the thesis disagrees

    def test_rate(sheet: DataSheet) -> Iterator[Finding]:
        """Test that the rule's success rate is as printed, and higher than by chance."""
        fires = rule.fires(sheet)
        p = upper_tail(int(fires.sum()), fires.size, chance)
        as_printed = any(abs(100.0 * float(fires.mean()) - rate) <= 1.0 for rate in printed)
        text = f"{format_rate(fires)}; p = {p:.2g} against chance of {100 * chance:g} %"
        yield text, [as_printed, p < 0.05 / 10]  # Bonferroni's correction for ten columns

    where, product = f"Fig. 5.{89 + number}", ""  # Figs. 5.90 to 5.95
    if rule is _BOTH_D3D4:
        rate_A, rate_B = (float(part.fires(sheet).mean()) for part in (_A_D3D4, _B_D3D4))
        where = "section 5.6"
        product = (
            f"; the printed 65 is near the product of the two printed rates, 0.85 x 0.76 = {0.85 * 0.76:.3f} "
            f"(counted: {rate_A:.3f} x {rate_B:.3f} = {rate_A * rate_B:.3f}), not a count of tests"
        )
    return judge_on_sheets(
        evidence,
        f"5.4.{number}",
        test_rate,
        kind="5.4",
        where=where,
        name=rule.name,
        rates=" or ".join(f"{rate} %" for rate in printed),
        product=product,
        controls=_format_controls(evidence, rule),
    )


def _test_opposite_moves(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.5.7: d3, d4 and d3d4 of p_A rise with the leak, and those of p_B fall, in most tests.

    All other sentences of section 5.6 state the opposite (`DIRECTION`).
    """
    for chamber in CHAMBERS:
        for name in SENSITIVE:
            change = sheet.log_change(chamber, name)
            count = int(np.sum(change * DIRECTION[chamber] < 0))
            yield f"{chamber} {name} {count}", [count > change.size / 2]


def _test_rates_over_80(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.6.1: each rule of Table 5.1 detects the leak, that is fires, in more than 80 % of the tests."""
    for rule in CLAIMED:
        fires = rule.fires(sheet)
        yield f"{rule.name} {format_rate(fires)}", [bool(fires.mean() > 0.8)]


def _test_leak_levels(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.6.2: at each leak level, d3 of p_A falls beyond the noise in at least 80 % of the tests."""
    exceeds = _exceeds_noise(sheet, "p_A", "d3")
    for level in NOMINAL_LPM:
        level_exceeds = exceeds[[row.level == level for row in APPENDIX_C]]
        yield f"{level} {format_rate(level_exceeds)}", [bool(level_exceeds.mean() >= 0.8)]


def _test_smallest_leak(sheet: DataSheet, rules: tuple[Rule, ...] = CLAIMED_CELLS) -> Iterator[Finding]:
    """Test claim 5.6.3: in the test with the smallest leak, the rule of each cell of Table 5.1 fires.

    The rule on both chambers is left out by default: it fires if both of its cells do.
    """
    row = int(np.argmin(mean_leaks()))
    for rule in rules:
        changes = (log_change_to_percent(sheet.log_change(c, name)[row]) for c, name in rule.details)
        text = ", ".join(f"{change:+.1f} %" for change in changes)
        yield f"{rule.name}: {text}", [bool(rule.fires(sheet)[row])]


def _test_abstract_rate(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim a.2: leaks down to 0.0042 L/min are detected in 85 % of the tests, by the RMS of d3d4 of p_A.

    This is the detail for which Table 5.1 prints 85 %. Its RMS must fall at the smallest leak, and in at least 85 % of
    the tests with leaks up to 0.0050 L/min, the four smallest.
    """
    yield from _test_smallest_leak(sheet, (_A_D3D4,))
    fires = _A_D3D4.fires(sheet)
    fires_small = fires[mean_leaks() <= 0.0050]
    text = f"up to 0.0050 L/min {format_rate(fires_small)}; all leaks {format_rate(fires)}"
    yield text, [bool(fires_small.mean() >= 0.85)]


def _test_both_chambers(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 6.1.1: the RMS of d3d4 falls in p_A and rises in p_B down to a leak of 0.0048 L/min.

    The smallest leak of a test with both changes must be 0.0048 L/min, and over 80 % of all tests must have them.
    """
    fires, leak = _BOTH_D3D4.fires(sheet), mean_leaks()
    min_leak = float(leak[fires].min()) if fires.any() else math.nan
    yield f"{min_leak:.4f} L/min", [abs(min_leak - 0.0048) < _ROUNDING_LPM]
    yield f"both pass in {format_rate(fires)}", [bool(fires.mean() > 0.8)]


def _test_identified_leaks(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim a.1: in each chamber the best wavelet detail reveals the leak in at least 80 % of the tests.

    A detail reveals the leak if its RMS falls in p_A, or rises in p_B, beyond the noise; the best does so most often.
    """
    for chamber in CHAMBERS:
        best = max(SENSITIVE, key=lambda name: int(_exceeds_noise(sheet, chamber, name).sum()))
        exceeds = _exceeds_noise(sheet, chamber, best)
        yield f"{chamber}: {best} beyond noise in {format_rate(exceeds)}", [bool(exceeds.mean() >= 0.8)]


def _baseline_texts(sheet: DataSheet) -> dict[str, str]:
    """Format the success of detecting leaks without a healthy baseline: accuracy and area under the ROC curve.

    The classifier is cross-validated with single tests left out of the fit ("tests"), or whole operating conditions
    ("conditions"). Without scikit-learn the texts say only this.
    """
    try:
        results = (classify_without_baseline(sheet, "test"), classify_without_baseline(sheet, "condition"))
    except MissingExtra:
        return dict.fromkeys(("tests", "conditions"), "? (needs scikit-learn)")
    tests, conditions = (f"{accuracy:.2f} (AUC {area:.3f})" for accuracy, area in results)
    return {"tests": tests, "conditions": conditions}


def _test_trend(chamber: str, sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.5.3 (p_A) or 5.5.4 (p_B): each detail's log change is correlated with the mean leak.

    The sign must be negative for p_A and positive for p_B. This must hold at the 5 % level for the plain correlation,
    and for the partial correlation given the operating condition (command and throttles).
    """
    leak, conditions, direction = mean_leaks(), condition_design(), DIRECTION[chamber]
    for name in SENSITIVE:
        change = sheet.log_change(chamber, name)
        raw = float(np.corrcoef(change, leak)[0, 1])
        given_condition = partial_correlation(change, leak, conditions)
        parts = [
            raw * direction > 0 and is_correlated(raw, _N_TESTS),
            given_condition * direction > 0 and is_correlated(given_condition, _N_TESTS, conditions.shape[1]),
        ]
        yield f"{name}: {raw:+.2f}, at equal condition {given_condition:+.2f}", parts


def _test_sensitive_details(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.5.1: the wavelet details in Table 5.1 change significantly, and the details left out do not.

    d3, d4 and d3d4 must move as the thesis states (`moves_beyond_chance`). For d1 and d2, which the table leaves out,
    the p-value of the sign test, corrected by Holm, must be at least 0.05.
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

    The effect size is the mean of the log changes of the RMS with the leak over their standard deviation, with falls
    positive for p_A and rises for p_B.
    """
    for chamber in CHAMBERS:
        changes = {name: sheet.log_change(chamber, name) * DIRECTION[chamber] for name in SENSITIVE}
        effect_sizes = {name: float(change.mean() / change.std(ddof=1)) for name, change in changes.items()}
        text = ", ".join(f"{name} {size:.2f}" for name, size in effect_sizes.items())
        yield f"{chamber}: {text}", [effect_sizes["d3d4"] > max(effect_sizes["d3"], effect_sizes["d4"])]


def _test_opposite_chambers(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.5.6: the log changes of a detail in p_A and in p_B are negatively correlated, at the 5 % level."""
    for name in SENSITIVE:
        change_A, change_B = (sheet.log_change(chamber, name) for chamber in CHAMBERS)
        r = float(np.corrcoef(change_A, change_B)[0, 1])
        n_opposite = int(np.sum(change_A * change_B < 0))
        text = f"{name}: correlation {r:+.2f}, opposite signs in {n_opposite} of {change_A.size}"
        yield text, [r < 0 and is_correlated(r, change_A.size)]


def _test_p_B_rises(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.5.5: with the leak, the RMS of d3, d4 and d3d4 of p_B rises significantly."""
    p = holm_p_values(sheet)
    for name in SENSITIVE:
        n_up = int(np.sum(sheet.log_change("p_B", name) > 0))
        yield f"{name} up in {n_up} (p = {p['p_B', name]:.2g})", [moves_beyond_chance(sheet, "p_B", name)]


def _test_printed_rows(sheet: DataSheet) -> Iterator[Finding]:
    """Test claim 5.3.1: in all tests that chapter 5 shows, the RMS of d3, d4 and d3d4 falls in p_A and rises in p_B."""
    for chamber, verb in (("p_A", "falls"), ("p_B", "rises")):
        for name in SENSITIVE:
            moves = sheet.log_change(chamber, name)[_PRINTED_ROWS] * DIRECTION[chamber] > 0
            yield f"{name} of {chamber} {verb} in {int(moves.sum())}", [bool(np.all(moves))]


#: Indices of the sheet's rows whose tests chapter 5 shows.
_PRINTED_ROWS = sorted({test.condition.number - 1 for test in TESTS.values()})


def claims(evidence: ClaimEvidence) -> Iterator[Claim]:
    """Judge the claims on leak detection that the data sheet decides: abstract, chapter 5 with Table 5.1, chapter 6.

    The claims of `leak_level_claims` and `curve_claims` are left out.
    """
    judge = partial(judge_on_sheets, evidence)
    sheet = evidence.measured_sheet or evidence.leak_sheet  # the texts need numbers in either case
    for number, rule in enumerate(CLAIMED, start=1):
        yield _judge_rate(evidence, sheet, number, rule)
    yield judge("5.3.1", _test_printed_rows, f"of the {len(_PRINTED_ROWS)} rows: ", ", ")
    yield judge("a.1", _test_identified_leaks, **_baseline_texts(sheet))
    smallest = f"the {mean_leaks().min():g} L/min test: "
    yield judge("a.2", _test_abstract_rate, smallest)
    yield judge("5.5.7", _test_opposite_moves, f"tests as the sentence says, of {_N_TESTS}: ", ", ")
    finds = format_rate(_exceeds_noise(sheet, "p_A", "d3"))
    yield judge("5.6.1", _test_rates_over_80, controls=_format_controls(evidence, _A_D3), finds=finds)
    yield judge("5.6.2", _test_leak_levels, "d3 of P_A falls beyond noise: ")
    yield judge("5.6.3", _test_smallest_leak, smallest)
    yield judge("6.1.1", _test_both_chambers, "smallest test that passes d3d4 on both chambers: ")
    d2_rule = UNCLAIMED[1]  # d2 of p_A falls
    yield judge("5.5.1", _test_sensitive_details, d2=format_rate(d2_rule.fires(sheet)))
    yield judge("5.5.2", _test_product_detail, "mean over scatter of the log change, ")
    # leave-one-out R^2 of the mean leak's regression on the operating condition, and on the changes of the details
    condition, changes = (leave_one_out_r2(x, mean_leaks()) for x in (condition_design(), change_design(sheet)))
    for id, chamber in (("5.5.3", "p_A"), ("5.5.4", "p_B")):
        head = "correlation of the change with the mean leak: "
        yield judge(id, partial(_test_trend, chamber), head, condition=condition, changes=changes)
    yield judge("5.5.5", _test_p_B_rises, f"of {_N_TESTS}: ", ", ")
    yield judge("5.5.6", _test_opposite_chambers)


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
    sheet: DataSheet, test: PrintedTest, chamber: str, names: Sequence[str], falls: bool
) -> tuple[str, list[bool]]:
    """Test that the RMS of wavelet details change by more than the noise in the row of the data sheet for `test`.

    `names`: the details; `falls`: True if only falls count, False for changes in either direction. Returns a text, and
    True or False for each detail. If several rows can be the test of chapter 5, the text also counts the rows that
    change beyond the noise.
    """
    row = test.condition.number - 1
    limit = d1_threshold(sheet, chamber, either_side=not falls)
    changes = {name: sheet.log_change(chamber, name) for name in names}
    exceeds = {name: (-change if falls else np.abs(change)) > limit for name, change in changes.items()}
    row_changes = {name: log_change_to_percent(float(change[row])) for name, change in changes.items()}
    changes_text = ", ".join(f"{name} {percent:+.1f} %" for name, percent in row_changes.items())
    noise_text = f"{log_change_to_percent(-limit):+.1f} %"
    if not falls:
        noise_text += f" or {log_change_to_percent(limit):+.1f} %"
    text = f"row {row + 1}: {changes_text}; noise reaches {noise_text}"
    rows = [candidate.number - 1 for candidate in test.candidates]
    if len(rows) > 1:
        counts = ", ".join(f"{name} {np.sum(mask[rows])}" for name, mask in exceeds.items())
        text += f"; of the {len(rows)} rows it can be, beyond noise: {counts}"
    return text, [bool(mask[row]) for mask in exceeds.values()]


def curve_claims(evidence: ClaimEvidence) -> Iterator[Claim]:
    """Judge the claims of chapter 5 that a leak changes the RMS of some wavelet details of a chamber's pressure.

    Some claims state a fall, others any change. It must exceed the noise in the measured data sheet (`_test_rows`).
    The texts also state the simulated changes, and the changes that drift alone exceeds in 5 % of the simulated tests.
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
            sheet_text, is_beyond = _test_rows(evidence.measured_sheet, test, chamber, names, statement == "fall")
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
