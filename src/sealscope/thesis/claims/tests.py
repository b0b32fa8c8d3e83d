"""What chapter 5 says of its leaks' sizes and of the RMS curves of its ten tests, judged by rows of Appendix C."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters.appendix_c.success_rates import DIRECTION, d1_threshold, drift_threshold
from sealscope.thesis.chapters.chapter5 import NOMINAL_LPM, TESTS, ShownTest
from sealscope.thesis.claims.evidence import NO_SHEET, SENSITIVE, ClaimEvidence, Finding, SheetClaim, in_percent
from sealscope.thesis.claims.judged import judged
from sealscope.thesis.engine.products import Claim
from sealscope.thesis.sheet import APPENDIX_C, DataSheet

#: What is said of a chamber's curves: that they fall, or only that they change.
Statement = Literal["fall", "change"]

#: Section, chamber, details named, and what is said of them.
CURVES: tuple[tuple[str, str, tuple[str, ...], Statement], ...] = (
    ("5.2a", "p_A", SENSITIVE, "change"),
    ("5.2a", "p_B", ("d4", "d3d4"), "change"),
    ("5.2b", "p_A", SENSITIVE, "fall"),
    ("5.2b", "p_B", ("d3d4",), "change"),
    ("5.3a", "p_A", SENSITIVE, "fall"),
    ("5.3a", "p_B", SENSITIVE, "change"),
    ("5.3b", "p_A", ("d3", "d3d4"), "change"),
    ("5.3b", "p_B", ("d4", "d3d4"), "change"),
    *((section, chamber, SENSITIVE, "change") for section in list(TESTS)[4:] for chamber in CHAMBERS),
)


def levels() -> Iterator[Claim]:
    """Judge claims 5.1.1 to 5.1.3."""
    spans = {level: [row.mean_leak_lpm for row in APPENDIX_C if row.level == level] for level in NOMINAL_LPM}
    texts = [f"{level} {min(of):.4f} to {max(of):.4f}, mean {np.mean(of):.4f}" for level, of in spans.items()]
    within = [min(of) <= NOMINAL_LPM[level] <= max(of) for level, of in spans.items()]
    apart = [min(upper) > max(lower) for upper, lower in itertools.pairwise(spans.values())]
    yield judged("5.1.1", [*within, *apart], levels="; ".join(texts))
    nominal, real = (
        (of[1] / of[0], of[2] / of[1], of[3] / of[0])
        for of in (list(NOMINAL_LPM.values()), [float(np.mean(of)) for of in spans.values()])
    )
    tests = [abs(of / stated - 1.0) < 0.25 for of, stated in zip(nominal, (0.5, 0.5, 1.0 / 16.0), strict=True)]
    shown = {name: ", ".join(f"{of:.2f}" for of in ratios) for name, ratios in (("nominal", nominal), ("real", real))}
    yield judged("5.1.2", tests, **shown)
    named = [row for row in APPENDIX_C if row.level == "large" and row.command == "3 sin(4t)"]
    rows = ", ".join(f"row {row.number}: {row.mean_leak_lpm:g} L/min" for row in named)
    same = [f"{row.number} ({row.command}, {row.level})" for row in APPENDIX_C if row.mean_leak_lpm == 0.0087]
    tests = [any(abs(row.mean_leak_lpm - 0.0087) < 5e-5 for row in named)]
    yield judged("5.1.3", tests, rows=rows, same=", ".join(same))


def _on_rows(
    sheet: DataSheet, test: ShownTest, chamber: str, names: Sequence[str], statement: Statement
) -> tuple[str, list[bool]]:
    """Test the changes of the named details in the row taken for the test, and count them over all rows it can be."""
    row, limit = test.condition.number - 1, d1_threshold(sheet, chamber, either_side=statement == "change")
    changes = {name: sheet.log_change(chamber, name) for name in names}
    beyond = {name: -of > limit if statement == "fall" else np.abs(of) > limit for name, of in changes.items()}
    changed = ", ".join(f"{name} {in_percent(float(of[row])):+.1f} %" for name, of in changes.items())
    reach = f"{in_percent(-limit):+.1f} %" + ("" if statement == "fall" else f" or {in_percent(limit):+.1f} %")
    text = f"row {row + 1}: {changed}; noise reaches {reach}"
    others = [candidate.number - 1 for candidate in test.candidates]
    if len(others) > 1:
        counts = ", ".join(f"{name} {np.sum(of[others])}" for name, of in beyond.items())
        text += f"; of the {len(others)} rows it can be, beyond noise: {counts}"
    return text, [bool(of[row]) for of in beyond.values()]


def curves(evidence: ClaimEvidence) -> Iterator[Claim]:
    """Judge a claim for each chamber of each test."""
    for number, (section, chamber, names, statement) in enumerate(CURVES, start=1):
        test, rms = TESTS[section], evidence.shown[section].rms[chamber]
        limits = (DIRECTION[chamber] * drift_threshold(evidence.drift, chamber, name) for name in names)
        parts: list[bool] = []
        text = NO_SHEET
        if evidence.measured is not None:
            text, parts = _on_rows(evidence.measured, test, chamber, names, statement)
        beyond = [name for name, part in zip(names, parts, strict=False) if part]
        sides = {"beyond": beyond, "within": [name for name in names if name not in beyond]}
        first = test.first + test.inputs + 2 + (0 if chamber == "p_A" else 3)  # the details; their RMS two on
        claim = judged(
            f"5.2.{number}",
            parts,
            "5.2",
            section=f"{section[:3]} {section[3:]}",
            first=first,
            last=first + 2,
            level=f"{'an' if test.level[0] in 'aeiou' else 'a'} {test.level} leak",
            command=test.command,
            names=_and(names),
            chamber=chamber,
            does="falls" if statement == "fall" else "changes",
            sheet=text,
            simulated=", ".join(f"{name} {100 * (rms[name][1] / rms[name][0] - 1):+.1f} %" for name in names),
            limits=", ".join(f"{in_percent(limit):+.1f} %" for limit in limits),
            beyond_or_within=" and ".join(f"{_and(of)} {side}" for side, of in sides.items() if of),
        )
        yield claim if parts else replace(claim, why=NO_SHEET)


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def consistent(evidence: ClaimEvidence) -> Claim:
    """Judge whether the ten shown tests go the way that section 5.6 says all do."""
    rows = sorted({evidence.shown[section].test.condition.number - 1 for section in TESTS})

    def test(sheet: DataSheet) -> Iterator[Finding]:
        for chamber, verb in (("p_A", "falls"), ("p_B", "rises")):
            for name in SENSITIVE:
                moves = sheet.log_change(chamber, name)[rows] * DIRECTION[chamber] > 0
                yield f"{name} of {chamber} {verb} in {int(moves.sum())}", [bool(np.all(moves))]

    return SheetClaim(test, f"of the {len(rows)} rows: ", ", ").judge(evidence, "5.3.1")
