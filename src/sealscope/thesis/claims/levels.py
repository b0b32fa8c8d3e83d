"""What chapter 5 says of the sizes of its leaks, judged by the mean leaks of the tests."""

from __future__ import annotations

import itertools

import numpy as np

from sealscope.thesis.chapters.chapter5.tests import NOMINAL_LPM
from sealscope.thesis.claims.judging import verdict_of
from sealscope.thesis.conditions import APPENDIX_C
from sealscope.thesis.engine.products import Claim


def _mean_of_5_2a() -> Claim:
    rows = [row for row in APPENDIX_C if row.level == "large" and row.command == "3 sin(4t)"]
    same = [f"{row.number} ({row.command}, {row.level})" for row in APPENDIX_C if row.mean_leak_lpm == 0.0087]
    return Claim(
        "claim-5.1.3",
        "section 5.2 a",
        "The mean leak of the large test at 3 sin(4t) is 0.0087 L/min.",
        ", ".join(f"row {row.number}: {row.mean_leak_lpm:g} L/min" for row in rows),
        "an input of the simulation",
        verdict_of([any(abs(row.mean_leak_lpm - 0.0087) < 5e-5 for row in rows)]),
        f"0.0087 L/min belongs to row {', '.join(same)}.",
    )


def claims() -> tuple[Claim, ...]:
    """Claims 5.1.1 to 5.1.3."""
    spans = {level: [row.mean_leak_lpm for row in APPENDIX_C if row.level == level] for level in NOMINAL_LPM}
    told = "; ".join(
        f"{level} {min(found):.4f} to {max(found):.4f}, mean {np.mean(found):.4f}" for level, found in spans.items()
    )
    within = [min(found) <= NOMINAL_LPM[level] <= max(found) for level, found in spans.items()]
    ordered = list(spans.values())
    apart = [min(upper) > max(lower) for upper, lower in itertools.pairwise(ordered)]
    nominal = list(NOMINAL_LPM.values())
    ratios = [nominal[1] / nominal[0], nominal[2] / nominal[1], nominal[3] / nominal[0]]
    means = [float(np.mean(found)) for found in ordered]
    real = [means[1] / means[0], means[2] / means[1], means[3] / means[0]]
    stated = (0.5, 0.5, 1.0 / 16.0)
    return (
        Claim(
            "claim-5.1.1",
            "section 5.1",
            "The tests fall into four leak levels: 0.0150, 0.0100, 0.0075 and 0.0042 L/min.",
            f"mean leaks [L/min]: {told}",
            "an input of the simulation",
            verdict_of([*within, *apart]),
            "Parts: each nominal leak lies within its level's range, and neighbouring levels do not overlap. The "
            "level is "
            "the needle's position; the mean leak depends on the pressures too.",
        ),
        Claim(
            "claim-5.1.2",
            "sections 5.3 to 5.5",
            "Medium is half of large, small half of medium, extra-small a sixteenth of large.",
            "ratios of the nominal leaks "
            + ", ".join(f"{one:.2f}" for one in ratios)
            + "; of the mean leaks "
            + ", ".join(f"{one:.2f}" for one in real),
            "an input of the simulation",
            verdict_of([abs(one / said - 1.0) < 0.25 for one, said in zip(ratios, stated, strict=True)]),
            "A part holds where the thesis's own nominal values have the stated ratio within a quarter of it.",
        ),
        _mean_of_5_2a(),
    )
