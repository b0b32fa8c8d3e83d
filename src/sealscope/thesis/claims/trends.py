"""What section 5.6 says of which details move, how, and how that goes with the leak, judged by the sheet."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters.appendix_c.success_rates import CLAIMED, DIRECTION, UNCLAIMED
from sealscope.thesis.claims.evidence import (
    SENSITIVE,
    ClaimEvidence,
    Finding,
    SheetClaim,
    SheetTest,
    corrected_p,
    correlated,
    fired,
    in_percent,
    moves_beyond_chance,
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


def _trend(chamber: str) -> SheetTest:
    """Find how the changes of a chamber's details go with the mean leak."""
    leak, given, direction = mean_leaks(), condition_columns(), DIRECTION[chamber]

    def test(sheet: DataSheet) -> Iterator[Finding]:
        for name in SENSITIVE:
            change = sheet.log_change(chamber, name)
            raw, left = float(np.corrcoef(change, leak)[0, 1]), partial_correlation(change, leak, given)
            beyond = correlated(raw, _N), correlated(left, _N, given.shape[1])
            parts = [r * direction > 0 and of for r, of in zip((raw, left), beyond, strict=True)]
            yield f"{name}: {raw:+.2f}, at equal condition {left:+.2f}", parts

    return test


def _predicted(evidence: ClaimEvidence, sheet: DataSheet) -> dict[str, Any]:
    columns = {"condition": condition_columns(), "changes": change_columns(sheet)}
    return {name: left_out_r2(of, mean_leaks()) for name, of in columns.items()}


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


_CORRELATION = "correlation of the change with the mean leak: "
_CLAIMS: dict[str, SheetClaim] = {
    "5.5.1": SheetClaim(_sensitive, values=lambda evidence, sheet: {"d2": fired(sheet, UNCLAIMED[1])}),
    "5.5.2": SheetClaim(_amplified, "mean over scatter of the log change, "),
    "5.5.3": SheetClaim(_trend("p_A"), _CORRELATION, values=_predicted),
    "5.5.4": SheetClaim(_trend("p_B"), _CORRELATION, values=_predicted),
    "5.5.5": SheetClaim(_upward, f"of {_N}: ", ", "),
    "5.5.6": SheetClaim(_inverse),
}


def claims(evidence: ClaimEvidence) -> tuple[Claim, ...]:
    """Judge claims 5.5.1 to 5.5.6."""
    return tuple(of.judge(evidence, id) for id, of in _CLAIMS.items())
