"""Evidence: the verdict of one detector, of one of its parts, or of all detectors together, with the figures for it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from sealscope.recordings.recording import Array

Verdict = Literal["leak", "no leak", "cannot tell"]
#: What a change can come from.
Cause = Literal[
    "piston leak",
    "piston or pump leak",
    "pump leak",
    "external leak",
    "friction change",
    "air in the oil",
    "sensor fault",
    "changed duty",
]
#: Figures that a detector may refuse to state.
Figure = Literal["onset_s", "leak_lpm"]
#: The causes for which the verdict is `leak`: piston and pump lie in parallel, and often no channel tells them apart.
LEAKS: tuple[Cause, ...] = ("piston leak", "piston or pump leak")


#: Smallest chance that is stated: no null distribution is known further out.
RAREST = 1e-4
#: Chance from which on a recording looks like any healthy one.
OFTEN = 0.2


@dataclass(frozen=True, eq=False)
class LeakCourse:
    """Leak over a recording.

    Estimates `lpm` (k,) [L/min] at the instants `t` (k,) [s], each with its 95 % interval `low`, `high` (k,).
    """

    t: Array
    lpm: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Passage:
    """What pump and piston together pass over a whole recording, a leak included that was there from the start.

    Parameters
    ----------
    lpm, interval_lpm : float and pair of floats
        Mean flow, and its 95 % interval [L/min].
    pressure : float
        Mean size of the pressure difference at which it flows [Pa].
    findable_lpm : float, optional
        Smallest step of that flow that would have been found [L/min]; None where a step was found.
    healthy_lpm : float, optional
        The most that a healthy machine passes at that pressure [L/min], by the rig; None where the rig does not say.
    """

    lpm: float
    interval_lpm: tuple[float, float]
    pressure: float
    findable_lpm: float | None = None
    healthy_lpm: float | None = None

    @property
    def healthy(self) -> bool:
        """Whether it is surely no more than a healthy machine passes."""
        return self.healthy_lpm is not None and self.interval_lpm[1] <= self.healthy_lpm


@dataclass(frozen=True)
class Evidence:
    """Verdict on one recording and the figures it rests on.

    Parameters
    ----------
    verdict : {"leak", "no leak", "cannot tell"}
    reason : str
        Why, in one line.
    score, threshold : float, optional
        A leak is reported where the score exceeds the threshold; None where it could not be computed.
    onset_s, onset_interval_s : float and pair of floats, optional
        Time since when oil leaks, on the recording's time axis, and its 95 % interval [s].
    leak_lpm, leak_interval_lpm : float and pair of floats, optional
        Mean flow past the piston while the leak is open, and its 95 % interval [L/min].
    parts : tuple of Evidence
        The detector's own parts, each with a score and a threshold; of a fused verdict, the evidence of every detector.
    cause : str, optional
        What the change is attributed to. None where there is no change, or where its cause cannot be told. A detector
        that attributes a change to something other than a piston leak says `no leak` or `cannot tell`, and the cause.
    course : LeakCourse, optional
        The leak over the recording, where the detector follows it.
    refuses : frozenset of {"onset_s", "leak_lpm"}
        Figures that the detector has a reason not to state, as opposed to those it cannot compute. No other detector's
        figure takes their place in the fused verdict.
    passage : Passage, optional
        What pump and piston pass together, where the detector measures it.
    share : float
        Share of the recording, 0 to 1, that the verdict rests on: less than 1 where blocks with missing samples are
        left out.
    detector : str
        Name of the detector, or of the part; of a fused verdict, the detector that judged, "" where none did.
    usable : bool
        Whether the recording had what the detector needs.
    chance : float, optional
        Probability that a leak-free recording scores as high, by the detector's own null distribution; at most the
        false-alarm probability where the score is over the threshold. None where the detector does not state it. Less
        than `RAREST` is not told apart from it.
    """

    verdict: Verdict
    reason: str
    score: float | None = None
    threshold: float | None = None
    onset_s: float | None = None
    onset_interval_s: tuple[float, float] | None = None
    leak_lpm: float | None = None
    leak_interval_lpm: tuple[float, float] | None = None
    parts: tuple[Evidence, ...] = ()
    cause: Cause | None = None
    course: LeakCourse | None = field(default=None, compare=False, repr=False)
    refuses: frozenset[Figure] = frozenset()
    passage: Passage | None = None
    share: float = 1.0
    detector: str = ""
    usable: bool = True
    chance: float | None = None

    @property
    def alarmed(self) -> bool:
        """Whether the score exceeds the threshold."""
        return self.score is not None and self.threshold is not None and self.score > self.threshold

    @property
    def abstains(self) -> bool:
        """Whether the next detector judges: `cannot tell`, and no change was seen."""
        return self.verdict == "cannot tell" and self.cause is None and not self.alarmed

    @property
    def odds(self) -> str | None:
        """How many healthy recordings look like this one, in words; None where that is not stated."""
        if self.chance is None:
            return None
        if self.chance <= RAREST:
            return f"fewer than 1 in {grouped(1.0 / RAREST)} healthy recordings looks like this"
        if self.chance >= OFTEN:
            return f"more than 1 in {1.0 / OFTEN:.0f} healthy recordings look like this"
        return f"1 in {grouped(1.0 / self.chance)} healthy recordings looks like this"


def grouped(value: float) -> str:
    """Return a number of two digits, its thousands apart."""
    rounded = float(f"{value:.2g}")
    return f"{rounded:,.0f}".replace(",", " ")
