"""What chapter 5 says of its leaks' sizes and of the RMS curves of its ten tests, judged by rows of Appendix C."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Literal

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters.appendix_c.success_rates import DIRECTION, d1_threshold, drift_threshold
from sealscope.thesis.chapters.chapter5 import NOMINAL_LPM, TESTS, ShownTest
from sealscope.thesis.claims.evidence import NO_SHEET, SENSITIVE, ClaimEvidence, in_percent, on_sheet
from sealscope.thesis.engine.products import Claim, verdict_of
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


def levels() -> tuple[Claim, ...]:
    """Judge claims 5.1.1 to 5.1.3."""
    spans = {level: [row.mean_leak_lpm for row in APPENDIX_C if row.level == level] for level in NOMINAL_LPM}
    texts = "; ".join(f"{level} {min(of):.4f} to {max(of):.4f}, mean {np.mean(of):.4f}" for level, of in spans.items())
    within = [min(of) <= NOMINAL_LPM[level] <= max(of) for level, of in spans.items()]
    apart = [min(upper) > max(lower) for upper, lower in itertools.pairwise(spans.values())]

    def ratios(of: Sequence[float]) -> tuple[float, ...]:
        return of[1] / of[0], of[2] / of[1], of[3] / of[0]

    nominal, stated = ratios(list(NOMINAL_LPM.values())), (0.5, 0.5, 1.0 / 16.0)
    real = ratios([float(np.mean(of)) for of in spans.values()])
    named = [row for row in APPENDIX_C if row.level == "large" and row.command == "3 sin(4t)"]
    same = [f"{row.number} ({row.command}, {row.level})" for row in APPENDIX_C if row.mean_leak_lpm == 0.0087]
    return (
        Claim(
            "claim-5.1.1",
            "section 5.1",
            "The tests fall into four leak levels: 0.0150, 0.0100, 0.0075 and 0.0042 L/min.",
            f"mean leaks [L/min]: {texts}",
            "an input of the simulation",
            verdict_of([*within, *apart]),
            "Parts: each nominal leak lies within its level's range, and neighbouring levels do not overlap. The level "
            "is the needle's position; the mean leak depends on the pressures too.",
        ),
        Claim(
            "claim-5.1.2",
            "sections 5.3 to 5.5",
            "Medium is half of large, small half of medium, extra-small a sixteenth of large.",
            f"ratios of the nominal leaks {', '.join(f'{of:.2f}' for of in nominal)}; of the mean leaks "
            f"{', '.join(f'{of:.2f}' for of in real)}",
            "an input of the simulation",
            verdict_of(abs(of / ratio - 1.0) < 0.25 for of, ratio in zip(nominal, stated, strict=True)),
            "A part holds where the thesis's own nominal values have the stated ratio within a quarter of it.",
        ),
        Claim(
            "claim-5.1.3",
            "section 5.2 a",
            "The mean leak of the large test at 3 sin(4t) is 0.0087 L/min.",
            ", ".join(f"row {row.number}: {row.mean_leak_lpm:g} L/min" for row in named),
            "an input of the simulation",
            verdict_of([any(abs(row.mean_leak_lpm - 0.0087) < 5e-5 for row in named)]),
            f"0.0087 L/min belongs to row {', '.join(same)}.",
        ),
    )


def _beyond(change: float, limit: float, statement: Statement) -> bool:
    return change < -limit if statement == "fall" else abs(change) > limit


def _on_rows(
    sheet: DataSheet, test: ShownTest, chamber: str, names: Sequence[str], statement: Statement
) -> tuple[str, list[bool]]:
    """Test the changes of the named details in the row taken for the test, and count them over all rows it can be."""
    row, limit = test.condition.number - 1, d1_threshold(sheet, chamber, either_side=statement == "change")
    every = {name: sheet.log_change(chamber, name) for name in names}
    parts = [_beyond(float(changes[row]), limit, statement) for changes in every.values()]
    changed = ", ".join(f"{name} {in_percent(float(changes[row])):+.1f} %" for name, changes in every.items())
    reach = f"{in_percent(-limit):+.1f} %" + ("" if statement == "fall" else f" or {in_percent(limit):+.1f} %")
    text = f"row {row + 1}: {changed}; noise reaches {reach}"
    others = [candidate.number - 1 for candidate in test.candidates]
    if len(others) > 1:
        counts = ", ".join(
            f"{name} {sum(_beyond(float(changes[k]), limit, statement) for k in others)}"
            for name, changes in every.items()
        )
        text += f"; of the {len(others)} rows it can be, beyond noise: {counts}"
    return text, parts


def curves(evidence: ClaimEvidence) -> tuple[Claim, ...]:
    """Judge a claim for each chamber of each test."""
    claims = []
    for number, (section, chamber, names, statement) in enumerate(CURVES, start=1):
        test = TESTS[section]
        rms = evidence.shown[section].rms[chamber]
        simulated = ", ".join(f"{name} {100 * (rms[name][1] / rms[name][0] - 1):+.1f} %" for name in names)
        limits = ", ".join(
            f"{in_percent(DIRECTION[chamber] * drift_threshold(evidence.drift, chamber, name)):+.1f} %"
            for name in names
        )
        parts: list[bool] = []
        text = NO_SHEET
        if evidence.measured is not None:
            text, parts = _on_rows(evidence.measured, test, chamber, names, statement)
        first = test.first + test.inputs + 2 + (0 if chamber == "p_A" else 3)  # the details; their RMS two on
        article = "an" if test.level[0] in "aeiou" else "a"
        claims.append(
            Claim(
                f"claim-5.2.{number}",
                f"section {section[:3]} {section[3:]}, Figs. 5.{first} and 5.{first + 2}",
                f"With {article} {test.level} leak at {test.command} the RMS of {_and(names)} of {chamber} "
                f"{'falls' if statement == 'fall' else 'changes'} visibly.",
                text,
                f"{simulated}; drift alone reaches {limits} (one time in twenty)",
                verdict_of(parts),
                _why(parts, names),
            )
        )
    return tuple(claims)


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _why(parts: Sequence[bool], names: Sequence[str]) -> str:
    if not parts:
        return NO_SHEET
    beyond = [name for name, part in zip(names, parts, strict=True) if part]
    within = [name for name in names if name not in beyond]
    texts = [f"{_and(of)} {where}" for of, where in ((beyond, "beyond"), (within, "within")) if of]
    return (
        f"{' and '.join(texts)} what d1, which is noise, does in 5 % of the tests. A product of two details scatters "
        "more than d1, so for d3d4 this is a mild measure."
    )


def consistent(evidence: ClaimEvidence) -> Claim:
    """Judge whether the ten shown tests go the way that section 5.6 says all do."""
    rows = sorted({evidence.shown[section].test.condition.number - 1 for section in TESTS})

    def test(sheet: DataSheet) -> tuple[str, list[bool]]:
        texts, parts = [], []
        for chamber, verb in (("p_A", "falls"), ("p_B", "rises")):
            for name in SENSITIVE:
                moves = sheet.log_change(chamber, name)[rows] * DIRECTION[chamber] > 0
                texts.append(f"{name} of {chamber} {verb} in {int(moves.sum())}")
                parts.append(bool(np.all(moves)))
        return f"of the {len(rows)} rows: " + ", ".join(texts), parts

    return on_sheet(
        evidence,
        "claim-5.3.1",
        "section 5.6",
        "The tests shown all behave as the whole sheet: the RMS values of P_A fall and those of P_B rise.",
        test,
        "A part holds only where all ten rows go the stated way.",
    )
