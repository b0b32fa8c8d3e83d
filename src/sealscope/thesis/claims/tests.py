"""What chapter 5 says of the RMS curves of its ten tests, each judged by the rows of the sheet it can mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters.appendix_c.simulated_sheet import log_change
from sealscope.thesis.chapters.appendix_c.success_rates import WAY, d1_threshold, drift_threshold
from sealscope.thesis.chapters.chapter5.tests import ShownTest, test_of
from sealscope.thesis.claims.evidence import NO_SHEET, Evidence, percent
from sealscope.thesis.claims.judging import verdict_of
from sealscope.thesis.engine.products import Claim
from sealscope.thesis.sheet import Sheet

#: What is said of a chamber's curves: that they fall, or only that they change.
Said = Literal["fall", "change"]

#: Section, chamber, details named, and what is said of them.
CURVES: tuple[tuple[str, str, tuple[str, ...], Said], ...] = (
    ("5.2a", "p_A", ("d3", "d4", "d3d4"), "change"),
    ("5.2a", "p_B", ("d4", "d3d4"), "change"),
    ("5.2b", "p_A", ("d3", "d4", "d3d4"), "fall"),
    ("5.2b", "p_B", ("d3d4",), "change"),
    ("5.3a", "p_A", ("d3", "d4", "d3d4"), "fall"),
    ("5.3a", "p_B", ("d3", "d4", "d3d4"), "change"),
    ("5.3b", "p_A", ("d3", "d3d4"), "change"),
    ("5.3b", "p_B", ("d4", "d3d4"), "change"),
    *(
        (section, chamber, ("d3", "d4", "d3d4"), "change")
        for section in ("5.4a", "5.4b", "5.5a", "5.5b", "5.5c", "5.5d")
        for chamber in CHAMBERS
    ),
)


def _beyond(change: float, limit: float, said: Said) -> bool:
    return change < -limit if said == "fall" else abs(change) > limit


def _on_rows(sheet: Sheet, test: ShownTest, chamber: str, names: Sequence[str], said: Said) -> tuple[str, list[bool]]:
    """Changes of the named details in the row taken for the test, and over all rows it can be."""
    row, limit = test.condition.number - 1, d1_threshold(sheet, chamber, either_side=said == "change")
    taken = {name: float(log_change(sheet, chamber, name)[row]) for name in names}
    parts = [_beyond(change, limit, said) for change in taken.values()]
    told = ", ".join(f"{name} {percent(change):+.1f} %" for name, change in taken.items())
    reach = f"{percent(-limit):+.1f} %" + ("" if said == "fall" else f" or {percent(limit):+.1f} %")
    told = f"row {row + 1}: {told}; noise reaches {reach}"
    others = [one.number - 1 for one in test.candidates]
    if len(others) > 1:
        counts = ", ".join(
            f"{name} {sum(_beyond(float(log_change(sheet, chamber, name)[k]), limit, said) for k in others)}"
            for name in names
        )
        told += f"; of the {len(others)} rows it can be, beyond noise: {counts}"
    return told, parts


def curves(evidence: Evidence) -> tuple[Claim, ...]:
    """A claim for each chamber of each test."""
    made = []
    for number, (section, chamber, names, said) in enumerate(CURVES, start=1):
        test = test_of(section)
        rms = evidence.shown[section].rms[chamber]
        simulated = ", ".join(f"{name} {100 * (rms[name][1] / rms[name][0] - 1):+.1f} %" for name in names)
        limits = ", ".join(
            f"{percent(WAY[chamber] * drift_threshold(evidence.drift, chamber, name)):+.1f} %" for name in names
        )
        parts: list[bool] = []
        told = NO_SHEET
        if evidence.measured is not None:
            told, parts = _on_rows(evidence.measured, test, chamber, names, said)
        made.append(
            Claim(
                f"claim-5.2.{number}",
                f"section {section[:3]} {section[3:]}, Figs. {_figures(test, chamber)}",
                f"With {_article(test.level)} {test.level} leak at {test.command} the RMS of {_and(names)} of "
                f"{chamber} {'falls' if said == 'fall' else 'changes'} visibly.",
                told,
                f"{simulated}; drift alone reaches {limits} (one time in twenty)",
                verdict_of(parts),
                _why(parts, names),
            )
        )
    return tuple(made)


def _figures(test: ShownTest, chamber: str) -> str:
    """Numbers of the figure of the details and of that of their RMS."""
    first = test.first + test.inputs + 2 + (0 if chamber == "p_A" else 3)
    return f"5.{first} and 5.{first + 2}"


def _article(word: str) -> str:
    return "an" if word[0] in "aeiou" else "a"


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _why(parts: Sequence[bool], names: Sequence[str]) -> str:
    if not parts:
        return NO_SHEET
    beyond = [name for name, part in zip(names, parts, strict=True) if part]
    within = [name for name in names if name not in beyond]
    told = [f"{_and(beyond)} beyond" if beyond else "", f"{_and(within)} within" if within else ""]
    return (
        f"{' and '.join(word for word in told if word)} what d1, which is noise, does in 5 % of the tests. A product "
        "of "
        "two details scatters more than d1, so for d3d4 this is a mild measure."
    )


def consistent(evidence: Evidence) -> Claim:
    """Whether the ten shown tests go the way that section 5.6 says all do."""
    rows = sorted({evidence.shown[section].test.condition.number - 1 for section, *_ in CURVES})

    def test(sheet: Sheet) -> tuple[str, list[bool]]:
        told, parts = [], []
        for chamber, way, word in (("p_A", -1, "fall"), ("p_B", 1, "rise")):
            for name in ("d3", "d4", "d3d4"):
                goes = log_change(sheet, chamber, name)[rows] * way > 0
                told.append(f"{name} of {chamber} {word}s in {int(goes.sum())}")
                parts.append(bool(np.all(goes)))
        return f"of the {len(rows)} rows: " + ", ".join(told), parts

    told, parts = (NO_SHEET, []) if evidence.measured is None else test(evidence.measured)
    return Claim(
        "claim-5.3.1",
        "section 5.6",
        "The tests shown all behave as the whole sheet: the RMS values of P_A fall and those of P_B rise.",
        told,
        test(evidence.leak)[0],
        verdict_of(parts),
        "A part holds only where all ten rows go the stated way.",
    )
