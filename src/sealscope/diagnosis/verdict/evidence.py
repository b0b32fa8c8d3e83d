"""Evidence: the verdict of one detector, one of its tests, or all detectors together, with the figures behind it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from sealscope.diagnosis.priors.decision import DECISION
from sealscope.recordings.recording import Array

Verdict = Literal["leak", "no leak", "cannot tell"]
#: The three verdicts.
LEAK, NO_LEAK, CANNOT_TELL = get_args(Verdict)
#: Causes of a change. `[causes]` in `states.toml` states the action for each.
Cause = Literal[
    "piston leak",
    "piston or pump leak",
    "piston or external leak",
    "piston, pump or external leak",
    "pump leak",
    "external leak",
    "friction change",
    "air in the oil",
    "sensor fault",
    "changed duty",
]
#: Figures that a detector may refuse to state.
Figure = Literal["onset_s", "leak_lpm"]
#: The causes for which the verdict is `leak`. Piston and pump are hydraulically in parallel, and often no channel
#: separates their leaks. Without a recorded position, an external leak looks the same, too.
LEAKS: tuple[Cause, ...] = (
    "piston leak",
    "piston or pump leak",
    "piston or external leak",
    "piston, pump or external leak",
)
#: Tests of the leakage: for a rise within the recording, and for a rise over healthy recordings.
WITHIN, AGAINST = "within the recording", "against the baseline"
#: Smallest p-value that is stated, as smaller ones cannot be trusted.
RAREST: float = DECISION.false_alarm.rarest
#: The built-in detectors. They use the balance of volumes, a model of the pressures, and changes of the pressures'
#: wavelet details. RMS_CHANGE decides only if no other detector can, and states no size of a leak.
VOLUME_BALANCE, PRESSURE_RESPONSE, RMS_CHANGE = "volume balance", "pressure response", "rms change"


@dataclass(frozen=True, eq=False)
class LeakCourse:
    """Leak flow over the time of a recording.

    Attributes
    ----------
    t : ndarray, shape (k,)
        Times of the estimates [s].
    lpm, low, high : ndarray, shape (k,)
        Flow at these times, and its 95 % interval [L/min].
    whole : bool
        True for the total flow past pump and piston, without a known onset; False for its increase since the onset.
    """

    t: Array
    lpm: Array
    low: Array
    high: Array
    whole: bool = False


@dataclass(frozen=True)
class TotalLeakage:
    """Mean flow past pump and piston together in a recording, including any leak from before its start.

    Attributes
    ----------
    lpm, interval_lpm : float and pair of floats, or None
        The flow and its 95 % interval [L/min], None if unknown, for example without the machine's sizes.
    pressure : float
        Mean absolute pressure difference that drives the flow [Pa].
    findable_lpm : float or None
        Smallest step of the flow that would have been detected [L/min], None if a leak was detected or if unknown.
    healthy_lpm : float or None
        Largest flow of a healthy machine at this pressure [L/min] by the rig; None if the rig does not state it, or if
        healthy recordings are compared instead.
    pump_share, findable_share : float or None
        Flow and smallest step as fractions of the pump's mean flow, also if L/min are unknown; None if unknown.
    """

    lpm: float | None
    interval_lpm: tuple[float, float] | None
    pressure: float
    findable_lpm: float | None = None
    healthy_lpm: float | None = None
    pump_share: float | None = None
    findable_share: float | None = None

    @property
    def healthy(self) -> bool:
        """True if the 95 % interval of the flow ends at `healthy_lpm` or below; False if one of them is unknown."""
        is_known = self.healthy_lpm is not None and self.interval_lpm is not None
        return is_known and self.interval_lpm[1] <= self.healthy_lpm  # type: ignore[index,operator]


@dataclass(frozen=True)
class RelativeLeak:
    """Size of a leak relative to other measured quantities, which needs no stated area or displacement.

    Attributes
    ----------
    pump_share, pump_share_interval : float and pair of floats, or None
        Leak as a fraction of the pump's mean flow, and its 95 % interval; None if the pump's flow is 0 or unknown.
    creep, creep_interval : float and pair of floats, or None
        Speed at which the leak would let the piston creep with its lines shut (leak over piston area), and its 95 %
        interval [m/s]; None if the piston's area is unknown.
    """

    pump_share: float | None = None
    pump_share_interval: tuple[float, float] | None = None
    creep: float | None = None
    creep_interval: tuple[float, float] | None = None


@dataclass(frozen=True)
class Evidence:
    """Verdict on one recording and the figures it rests on; unknown figures are None.

    Parameters
    ----------
    verdict : {"leak", "no leak", "cannot tell"}
        The verdict.
    reason : str
        Reason for the verdict, in one line.
    score, threshold : float, optional
        A change is detected if the score exceeds the threshold; it is a leak if no other event explains it better.
    onset_s, onset_interval_s : float and pair of floats, optional
        Time at which the leak began, on the recording's time axis, and its 95 % interval [s].
    leak_lpm, leak_interval_lpm : float and pair of floats, optional
        Mean flow past the piston while the leak is open, and its 95 % interval [L/min].
    parts : tuple of Evidence
        The detector's single tests; for a combined verdict, the evidence of every detector.
    cause : str, optional
        Cause of the change. Unless it is a leak past piston or pump, the verdict is `no leak` or `cannot tell`.
    course : LeakCourse, optional
        The leak over the time of the recording, if the detector estimates it.
    refuses : frozenset of {"onset_s", "leak_lpm"}
        Figures that the detector has a reason not to state, as opposed to those it cannot compute.
    total_leakage : TotalLeakage, optional
        Total flow past pump and piston, if the detector measures it.
    share : float
        Fraction of the recording, 0 to 1, that was used for the verdict.
    judged_until : float
        Time of the last judged sample, as a fraction of the duration; any leak that begins later is overlooked.
    detector : str
        Name of the detector or of its test; for a combined verdict, of the deciding detector, "" if none did.
    usable : bool
        Whether the recording had the channels and the length that the detector needs.
    chance : float, optional
        p-value: probability that a leak-free recording scores as high, judged by healthy recordings if there are any,
        and at least `RAREST`.
    relative : RelativeLeak, optional
        The leak relative to other quantities of the recording; stated even if L/min is refused.
    ratio, ratio_interval : float and pair of floats, optional
        Measured ratio of the pump's displacement to the piston's area, divided by the assumed ratio, and its 95 %
        interval.
    bound_lpm : float, optional
        95 % upper bound of a leak [L/min] if none is reported.
    rarest_chance : float
        Probability that a healthy recording shows anything as rare as the rarest of all changes in this one.
    rarest_change : str
        What this rarest change is of, in words such as "the free air in the oil"; "" if nothing was tested.
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
    cause: str | None = None
    course: LeakCourse | None = field(default=None, compare=False, repr=False)
    refuses: frozenset[Figure] = frozenset()
    total_leakage: TotalLeakage | None = None
    share: float = 1.0
    judged_until: float = 1.0
    detector: str = ""
    usable: bool = True
    chance: float | None = None
    relative: RelativeLeak | None = None
    ratio: float | None = None
    ratio_interval: tuple[float, float] | None = None
    bound_lpm: float | None = None
    rarest_chance: float = 1.0
    rarest_change: str = ""

    @property
    def alarmed(self) -> bool:
        """True if there is a score and it exceeds the threshold."""
        return self.score is not None and self.threshold is not None and self.score > self.threshold

    @property
    def abstains(self) -> bool:
        """True if the verdict is "cannot tell" and no change was detected, so that the next detector is asked."""
        return self.verdict == CANNOT_TELL and self.cause is None and not self.alarmed

    @property
    def summary(self) -> str:
        """The verdict in words, with the cause of the change unless the cause is a leak past piston or pump."""
        if self.cause is None or self.cause in LEAKS or self.verdict == LEAK:
            return self.verdict
        if self.verdict == CANNOT_TELL:
            return f"cannot tell ({self.cause})"
        # "none" refers to the leak that the name of the cause mentions, as in "external leak"
        return f"{self.cause} ({'none' if self.cause.endswith('leak') else 'no leak'} across the piston)"

    @property
    def odds(self) -> str | None:
        """The p-value (`chance`) in words, such as "1 in 50 healthy recordings looks like this"; None if it is unknown.

        For the verdict `no leak` without an alarm, the words are "shows as much change" instead of "looks like this".
        """
        if self.chance is None:
            return None
        is_unchanged = self.verdict == NO_LEAK and not self.alarmed
        if self.chance >= 0.2:
            return f"more than 1 in 5 healthy recordings {'show as much change' if is_unchanged else 'look like this'}"
        two_digits = float(f"{1.0 / self.chance:.2g}")
        count = f"{two_digits:,.0f}".replace(",", " ")
        limit = "fewer than " if self.chance == RAREST else ""
        return f"{limit}1 in {count} healthy recordings {'shows as much change' if is_unchanged else 'looks like this'}"
