"""What section 5.6 says of which details move, how, and how that goes with the leak, judged by the sheet."""

from __future__ import annotations

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters.appendix_c.success_rates import CLAIMED, DIRECTION, UNCLAIMED
from sealscope.thesis.claims.evidence import (
    SENSITIVE,
    ClaimEvidence,
    corrected_p,
    correlated,
    fired,
    in_percent,
    moves_beyond_chance,
    on_sheet,
)
from sealscope.thesis.claims.regressions import (
    change_columns,
    condition_columns,
    left_out_r2,
    mean_leaks,
    partial_correlation,
)
from sealscope.thesis.engine.products import Claim
from sealscope.thesis.sheet import APPENDIX_C, DataSheet

_N = len(APPENDIX_C)


def _trend(evidence: ClaimEvidence, id: str, where: str, claim: str, chamber: str) -> Claim:
    leak, given = mean_leaks(), condition_columns()
    direction = DIRECTION[chamber]

    def test(sheet: DataSheet) -> tuple[str, list[bool]]:
        texts, parts = [], []
        for name in SENSITIVE:
            change = sheet.log_change(chamber, name)
            raw, left = float(np.corrcoef(change, leak)[0, 1]), partial_correlation(change, leak, given)
            texts.append(f"{name}: {raw:+.2f}, at equal condition {left:+.2f}")
            parts += [
                raw * direction > 0 and correlated(raw, _N),
                left * direction > 0 and correlated(left, _N, given.shape[1]),
            ]
        return f"correlation of the change with the mean leak: {'; '.join(texts)}", parts

    def why(sheet: DataSheet) -> str:
        return (
            "Parts: the correlation, and the one left once command and throttle are taken out, each beyond chance. "
            f"Command and throttle alone predict the mean leak with a left-out R2 of {left_out_r2(given, leak):.2f}, "
            f"the six changes with {left_out_r2(change_columns(sheet), leak):.2f}: the trend is mostly that of the "
            "condition."
        )

    return on_sheet(evidence, id, where, claim, test, why)


def _sensitive(sheet: DataSheet) -> tuple[str, list[bool]]:
    p = corrected_p(sheet)
    claimed = [rule.details[0] for rule in CLAIMED[:6]]
    others = [rule.details[0] for rule in UNCLAIMED]
    texts = [
        f"{chamber} {name} {in_percent(sheet.log_change(chamber, name)):+.1f} % (p = {p[chamber, name]:.2g})"
        for chamber, name in (*claimed, *others)
    ]
    parts = [moves_beyond_chance(sheet, *column) for column in claimed] + [p[column] >= 0.05 for column in others]
    return "; ".join(texts), parts


def _amplified(sheet: DataSheet) -> tuple[str, list[bool]]:
    texts, parts = [], []
    for chamber in CHAMBERS:
        changes = {name: sheet.log_change(chamber, name) * DIRECTION[chamber] for name in SENSITIVE}
        sizes = {name: float(change.mean() / change.std(ddof=1)) for name, change in changes.items()}
        texts.append(f"{chamber}: " + ", ".join(f"{name} {size:.2f}" for name, size in sizes.items()))
        parts.append(sizes["d3d4"] > max(sizes["d3"], sizes["d4"]))
    return f"mean over scatter of the log change, {'; '.join(texts)}", parts


def _inverse(sheet: DataSheet) -> tuple[str, list[bool]]:
    texts, parts = [], []
    for name in SENSITIVE:
        a, b = (sheet.log_change(chamber, name) for chamber in CHAMBERS)
        r = float(np.corrcoef(a, b)[0, 1])
        texts.append(f"{name}: correlation {r:+.2f}, opposite signs in {int(np.sum(a * b < 0))} of {a.size}")
        parts.append(r < 0 and correlated(r, a.size))
    return "; ".join(texts), parts


def _upward(sheet: DataSheet) -> tuple[str, list[bool]]:
    p = corrected_p(sheet)
    up = [f"{q} up in {int(np.sum(sheet.log_change('p_B', q) > 0))} (p = {p['p_B', q]:.2g})" for q in SENSITIVE]
    return f"of {sheet.rms['p_B']['d3'].shape[0]}: {', '.join(up)}", [
        moves_beyond_chance(sheet, "p_B", q) for q in SENSITIVE
    ]


def claims(evidence: ClaimEvidence) -> tuple[Claim, ...]:
    """Judge claims 5.5.1 to 5.5.6."""
    return (
        on_sheet(
            evidence,
            "claim-5.5.1",
            "sections 5.2 to 5.7",
            "The sensitive details are d3, d4 and d3d4.",
            _sensitive,
            lambda sheet: (
                "Parts: each of the six claimed columns moves beyond chance (Holm over ten), each of the four others "
                f"does not. d2 of P_A, never claimed, falls in {fired(sheet, UNCLAIMED[1])}."
            ),
        ),
        on_sheet(
            evidence,
            "claim-5.5.2",
            "sections 5.2 to 5.7",
            "The product d3d4 amplifies the change and makes the detection surer.",
            _amplified,
            "Two parts, one for each chamber: d3d4's change is larger than d3's and d4's when each is measured by its "
            "own scatter. In percent it is larger because it is a product.",
        ),
        _trend(
            evidence,
            "claim-5.5.3",
            "section 5.6, Figs. 5.90 to 5.92",
            "On P_A the change of d3, d4 and d3d4 grows downward with the mean leak.",
            "p_A",
        ),
        _trend(
            evidence,
            "claim-5.5.4",
            "section 5.6, Figs. 5.93 to 5.95",
            "On P_B the change of d3, d4 and d3d4 grows upward with the mean leak.",
            "p_B",
        ),
        on_sheet(
            evidence,
            "claim-5.5.5",
            "section 5.6",
            "On P_B the differences are positive.",
            _upward,
            "A part for each of d3, d4 and d3d4: more tests rise than chance gives (Holm over ten columns).",
        ),
        on_sheet(
            evidence,
            "claim-5.5.6",
            "section 5.6",
            "The details' RMS values of the two chambers are inversely related.",
            _inverse,
            "A part for each detail: the changes of the two chambers correlate negatively beyond chance over the "
            "tests. Opposite mean signs alone are no inverse relation.",
        ),
    )
