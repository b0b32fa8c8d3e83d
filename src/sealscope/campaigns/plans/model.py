"""The three kinds of plan: simulated records, recordings of a real machine, and measured data held out in turn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, Literal, TypeAlias

if TYPE_CHECKING:
    from sealscope.parameters import Rig

Use = Literal["calibrate", "judge"]
LeakLaw = Literal["laminar", "orifice", "mixture"]
Promise = Literal["average", "bound"]
DataSet = Literal["appendix-c", "hydraulic"]
LeaveOut = Literal["test", "condition"]


@dataclass(frozen=True)
class RecordGroup:
    """`count` records of one kind, spread evenly over the cells of the factors.

    `use`: `calibrate` sets thresholds (leak-free), `judge` is judged by them, on seeds of its own; `leak_lpm`: mean
    flow [L/min] of a leak of that `law` (`mixture`: half of each) from the plan's onset on, 0 for none; `fault`:
    another fault, as text; `bound`: whether the rows of leaks of this size say what the Cramer-Rao bound of their
    machine allows, which does not depend on the size.
    """

    use: Use
    count: int
    leak_lpm: float = 0.0
    law: LeakLaw = "laminar"
    fault: str = ""
    bound: bool = False


@dataclass(frozen=True, kw_only=True)
class _JudgedPlan:
    """What plans over records of a machine have in common.

    `unit`: of the sizes of leaks; `views`: sets of channels that detectors see (`detectors`); `assumed`: what detectors
    may assume of the machine, None for the plan's rig, or the thesis's where it has none.
    """

    name: str
    title: str
    false_alarm: float
    promise: Promise
    confidence: float
    detectors: tuple[str, ...]
    place: str = ""
    unit: str = "L/min"
    note: str = ""
    views: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    assumed: Rig | None = None


@dataclass(frozen=True, kw_only=True)
class SimulatedPlan(_JudgedPlan):
    """A simulated campaign.

    `profile`: the bench whose nuisances each record draws, "" for the rig without drift; `factors`: name -> levels,
    every combination is a cell; `command` and `closed` are the duty, `family` names families of the profile, other
    names are parameters of the rig; `seed`: the base of every case's seed; `part`: what the plan is for, such as
    development or judging.
    """

    rig: Rig
    profile: str
    duration_s: float
    onset_s: float
    seed: int
    keep_recordings: bool
    records: tuple[RecordGroup, ...]
    factors: Mapping[str, tuple[str | float, ...]] = field(default_factory=dict)
    part: str = ""

    @property
    def size(self) -> int:
        """Number of records."""
        return sum(group.count for group in self.records)

    @property
    def bounded(self) -> frozenset[float]:
        """Sizes of leaks [L/min] whose rows get the bound of their machine."""
        return frozenset(group.leak_lpm for group in self.records if group.bound and group.leak_lpm)


@dataclass(frozen=True)
class RecordingSet:
    """Recordings of one kind.

    `files`: a pattern; of the files that match, in the order of the numbers in their names, the `first` to before the
    `end`-th belong to the set; `size`: 0 for healthy recordings, else the grade of the leak.
    """

    files: str
    use: Use
    size: float
    first: int
    end: int
    label: str


@dataclass(frozen=True, kw_only=True)
class RecordedPlan(_JudgedPlan):
    """A campaign over recordings in a folder of the caller."""

    channel_map: Mapping[str, str]
    rate_hz: float | None
    sets: tuple[RecordingSet, ...]


@dataclass(frozen=True)
class LogisticClassifier:
    """A logistic regression on `features` with a `ridge` on the standardised coefficients."""

    name: str
    features: tuple[str, ...]
    ridge: float


@dataclass(frozen=True)
class ChosenClassifier:
    """A logistic regression whose features and ridge are chosen within the training samples.

    Candidates are the unions of `groups` of features with each of `ridges`; the one with the smallest loss on tests
    held out within the training samples is taken.
    """

    name: str
    groups: tuple[tuple[str, ...], ...]
    ridges: tuple[float, ...]

    def candidates(self) -> list[LogisticClassifier]:
        """Return every union of groups with every ridge, few features first and of these the larger ridge first."""
        unions = [union for size in range(1, len(self.groups) + 1) for union in combinations(self.groups, size)]
        return [
            LogisticClassifier(self.name, tuple(feature for group in union for feature in group), ridge)
            for union in unions
            for ridge in sorted(self.ridges, reverse=True)
        ]


Classifier = LogisticClassifier | ChosenClassifier


@dataclass(frozen=True)
class HeldOutPlan:
    """A campaign over a measured data set.

    `unit`: of the sizes of its faults; `leave_out`: what is held out whole in turn, a test (its part without and its
    part with the leak, or its unbroken block of cycles) or all tests of one operating condition; `permutations`: how
    often labels are swapped within tests to estimate what chance reaches, 0 for no such check; `seed`: of the swaps.
    """

    name: str
    title: str
    data: DataSet
    leave_out: LeaveOut
    detectors: tuple[Classifier, ...]
    confidence: float
    place: str = ""
    unit: str = "L/min"
    note: str = ""
    permutations: int = 0
    seed: int = 0


AnyPlan: TypeAlias = SimulatedPlan | HeldOutPlan | RecordedPlan
