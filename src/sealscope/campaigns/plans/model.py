"""The three kinds of plan: simulated records, recordings of a real machine, and measured data held out in turn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from pydantic import AfterValidator, BeforeValidator, Field

from sealscope.parameters import Rig
from sealscope.units import parse_quantity

Use = Literal["calibrate", "judge"]
LeakLaw = Literal["laminar", "orifice", "mixture"]
Promise = Literal["average", "bound"]
DataSet = Literal["appendix-c", "hydraulic"]
LeaveOut = Literal["test", "condition"]

_LONGEST_NAME = 80


def _quantity(unit: str) -> BeforeValidator:
    """Return what takes a text of a number with its unit for the number."""
    return BeforeValidator(lambda value: parse_quantity(value, unit) if isinstance(value, str) else value)


def _file_name(name: str) -> str:
    if not all(c.isalnum() or c in "-_." for c in name) or name.startswith(".") or len(name) > _LONGEST_NAME:
        raise ValueError(f"must be of at most {_LONGEST_NAME} letters, digits, '-', '_' and '.'")
    return name


def _pattern(files: str) -> str:
    parts = Path(files).parts
    if Path(files).is_absolute() or ".." in parts:
        raise ValueError("must be a pattern within the folder")
    if "\0" in files or any("**" in part and part != "**" for part in parts) or files.count("**") > 1:
        raise ValueError("must be a pattern of names, with ** once at most")
    return files


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Share = Annotated[Number, Field(gt=0, lt=1)]
Ridge = Annotated[Number, Field(gt=0)]
Whole = Annotated[int, Field(strict=True, ge=0)]
Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, Field(pattern=r"^[^\n]*$")]
FileName = Annotated[str, Field(min_length=1), AfterValidator(_file_name)]
Seconds = Annotated[Number, _quantity("s")]
#: Names, one or more.
Names = Annotated[tuple[str, ...], Field(min_length=1)]
Level = str | Annotated[int, Field(strict=True)] | Number


@dataclass(frozen=True)
class RecordGroup:
    """`count` records of one kind, spread evenly over the cells of the factors.

    `use`: `calibrate` sets thresholds (leak-free), `judge` is judged by them, on seeds of its own; `leak_lpm`: mean
    flow [L/min] of a leak of that `law` (`mixture`: half of each) from the plan's onset on, 0 for none; `fault`:
    another fault, as text; `bound`: whether the rows of leaks of this size say what the Cramer-Rao bound of their
    machine allows, which does not depend on the size.
    """

    count: Annotated[Whole, Field(ge=1)]
    use: Use = "judge"
    leak_lpm: Annotated[Number, Field(ge=0), _quantity("L/min")] = 0.0
    law: LeakLaw = "laminar"
    fault: Text = ""
    bound: Flag = False

    def __post_init__(self) -> None:
        if self.use == "calibrate" and (self.leak_lpm or self.fault):
            raise ValueError("must be leak-free and without a fault where use = 'calibrate'")


@dataclass(frozen=True, kw_only=True)
class _JudgedPlan:
    """What plans over records of a machine have in common.

    `unit`: of the sizes of leaks; `views`: sets of channels that detectors see (`detectors`); `assumed`: what detectors
    may assume of the machine, None for the plan's rig, or the thesis's where it has none.
    """

    name: FileName
    title: Text = ""
    false_alarm: Share = 0.01
    promise: Promise = "average"
    confidence: Share = 0.95
    detectors: Names
    place: str = ""
    unit: Text = "L/min"
    note: Text = ""
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
    profile: str = ""
    duration_s: Seconds
    onset_s: Seconds
    seed: Whole = 0
    keep_recordings: Flag = False
    records: tuple[RecordGroup, ...]
    factors: Mapping[str, Annotated[tuple[Level, ...], Field(min_length=1)]] = field(default_factory=dict)
    part: Text = ""

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

    files: Annotated[Text, AfterValidator(_pattern)]
    use: Use = "judge"
    size: Annotated[Number, Field(ge=0)] = 0.0
    first: Annotated[Whole, Field(ge=1)] = 1
    end: Annotated[Whole, Field(ge=2)] = 10**9
    label: Text = ""

    def __post_init__(self) -> None:
        if self.use == "calibrate" and self.size > 0:
            raise ValueError("must have the size 0 to calibrate")


@dataclass(frozen=True, kw_only=True)
class RecordedPlan(_JudgedPlan):
    """A campaign over recordings in a folder of the caller."""

    channel_map: Mapping[str, str] = field(default_factory=dict)
    rate_hz: Annotated[Number, _quantity("Hz")] | None = None
    sets: tuple[RecordingSet, ...]


@dataclass(frozen=True)
class LogisticClassifier:
    """A logistic regression on `features` with a `ridge` on the standardised coefficients."""

    name: Text
    features: Names
    ridge: Ridge = 1.0

    def candidates(self) -> list[LogisticClassifier]:
        """Return itself: nothing is chosen."""
        return [self]


@dataclass(frozen=True)
class ChosenClassifier:
    """A logistic regression whose features and ridge are chosen within the training samples.

    Candidates are the unions of `groups` of features with each of `ridges`; the one with the smallest loss on tests
    held out within the training samples is taken.
    """

    name: Text
    groups: Annotated[tuple[Names, ...], Field(min_length=1, max_length=8)]
    ridges: Annotated[tuple[Ridge, ...], Field(min_length=1)]

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

    name: FileName
    data: DataSet
    detectors: tuple[Classifier, ...]
    title: Text = ""
    leave_out: LeaveOut = "test"
    confidence: Share = 0.95
    place: str = ""
    unit: str = "L/min"
    note: Text = ""
    permutations: Annotated[Whole, Field(le=100_000)] = 0
    seed: Whole = 0


AnyPlan: TypeAlias = SimulatedPlan | HeldOutPlan | RecordedPlan
