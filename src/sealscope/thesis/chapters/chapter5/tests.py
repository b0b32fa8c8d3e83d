"""Chapter 5: the ten leakage tests the thesis shows, Figs. 5.1 to 5.89, each number as a test and a view of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.conditions import APPENDIX_C, Condition, Level
from sealscope.thesis.engine.items import Item

View = Literal["input", "leak", "details", "rms"]


@dataclass(frozen=True)
class ShownTest:
    """One of the ten tests: its section, command and level, when the leak opened [s], and which figures show it.

    `first` is the number of its first figure; `inputs`: how many figures show command, speed and displacement (two:
    whole and close-up).
    """

    section: str
    command: str
    level: Level
    first: int
    inputs: int = 0
    half: float = 90.0

    @property
    def closeup(self) -> tuple[float, float]:
        """The thesis's close-up [s]: ten seconds to both sides of the onset."""
        return self.half - 10.0, self.half + 10.0

    @property
    def candidates(self) -> tuple[Condition, ...]:
        """The rows of Appendix C with this command and level."""
        return tuple(row for row in APPENDIX_C if (row.command, row.level) == (self.command, self.level))

    @property
    def condition(self) -> Condition:
        """The row of Appendix C taken for this test: of the candidates the one whose mean leak is nearest to the
        level's nominal one (section 5.1). The thesis does not say which row each test is."""
        return min(self.candidates, key=lambda row: abs(row.mean_leak_lpm - NOMINAL_LPM[self.level]))


#: Nominal leak of each level [L/min], section 5.1.
NOMINAL_LPM: dict[Level, float] = {"large": 0.0150, "medium": 0.0100, "small": 0.0075, "extra-small": 0.0042}

TESTS: tuple[ShownTest, ...] = (
    ShownTest("5.2a", "3 sin(4t)", "large", 1, inputs=2, half=60.0),
    ShownTest("5.2b", "5 sin(2t)", "large", 11, inputs=2),
    ShownTest("5.3a", "3 sin(4t)", "medium", 21, inputs=2),
    ShownTest("5.3b", "8 sin(t)", "medium", 31, inputs=1),
    ShownTest("5.4a", "3 sin(4t)", "small", 40),
    ShownTest("5.4b", "8 sin(t)", "small", 48),
    ShownTest("5.5a", "3 sin(4t)", "extra-small", 56),
    ShownTest("5.5b", "7 sin(4t)", "extra-small", 64, inputs=2),
    ShownTest("5.5c", "5 sin(2t)", "extra-small", 74),
    ShownTest("5.5d", "8 sin(t)", "extra-small", 82),
)


def test_of(section: str) -> ShownTest:
    """The test of that section; KeyError where there is none."""
    return {test.section: test for test in TESTS}[section]


def _shown(test: ShownTest) -> list[tuple[View, str, bool]]:
    """View, chamber and whether a close-up, in the order of the test's figures."""
    views: list[tuple[View, str, bool]] = [("input", "", closeup) for closeup in (False, True)[: test.inputs]]
    views += [("leak", "", False), ("leak", "", True)]
    for chamber in CHAMBERS:
        views += [("details", chamber, False), ("details", chamber, True), ("rms", chamber, False)]
    return views


_WORDS: dict[View, str] = {
    "input": "command, motor speed and piston displacement",
    "leak": "leak flow and chamber pressures",
    "details": "wavelet details d1 to d4 and d3d4",
    "rms": "windowed RMS of d3, d4 and d3d4",
}


def _title(test: ShownTest, view: View, chamber: str, closeup: bool) -> str:
    of = f" of {chamber}" if chamber else ""
    when = "close-up {:g} to {:g} s".format(*test.closeup) if closeup else f"{2 * test.half:g} s"
    return f"Test {test.section}, {test.command}, {test.level} leak: {_WORDS[view]}{of}, {when}"


def items() -> tuple[Item, ...]:
    """Figs. 5.1 to 5.89 in their order."""
    return tuple(
        Item(
            id=f"fig-5.{test.first + k}",
            chapter=5,
            kind="figure",
            title=_title(test, view, chamber, closeup),
            make="sealscope.thesis.chapters.chapter5.views:figure",
            inputs=(
                ("test", test.section),
                ("view", view),
                ("chamber", chamber),
                ("from_s", test.closeup[0] if closeup else 0.0),
                ("to_s", test.closeup[1] if closeup else 2 * test.half),
            ),
        )
        for test in TESTS
        for k, (view, chamber, closeup) in enumerate(_shown(test))
    )


ITEMS: tuple[Item, ...] = items()
