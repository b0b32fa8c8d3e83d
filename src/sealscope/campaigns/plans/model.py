"""The two kinds of plan: simulated records, and recordings of a real machine.

Fields are the entries of a plan's file, under their names there or their `alias`, and `place`, the file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field

from sealscope.evaluation.thresholds import Promise
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import CHANNEL_UNITS
from sealscope.units import parse_quantity

Use = Literal["calibrate", "judge"]
LeakLaw = Literal["laminar", "orifice", "mixture"]

_LONGEST_NAME = 80


def _quantity(unit: str) -> BeforeValidator:
    """Build a validator that reads a number with its unit from text."""
    return BeforeValidator(lambda value: parse_quantity(value, unit) if isinstance(value, str) else value)


def _file_name(name: str) -> str:
    if not all(c.isalnum() or c in "-_." for c in name) or name.startswith(".") or len(name) > _LONGEST_NAME:
        raise ValueError(f"must be of at most {_LONGEST_NAME} letters, digits, '-', '_' and '.'")
    return name


def _pattern(files: str) -> str:
    parts = Path(files).parts
    if not parts or Path(files).is_absolute() or ".." in parts:
        raise ValueError("must be a pattern within the folder")
    if "\0" in files or any("**" in part and part != "**" for part in parts) or files.count("**") > 1:
        raise ValueError("must be a pattern of names, with ** once at most")
    return files


def _level(value: Any) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if isinstance(value, str) or (number and math.isfinite(value)):
        return value
    raise ValueError(f"must be a text or a number, got {value!r:.60}")


def _channels(names: tuple[str, ...]) -> tuple[str, ...]:
    if not set(names) <= set(CHANNEL_UNITS) or len(set(names)) < len(names):
        raise ValueError(f"must be a list of channels, each once, got {list(names)}")
    if "q_leak" in names:
        raise ValueError("must not hold q_leak: it measures what detectors are to find")
    return names


def _view(name: str) -> str:
    if not name.strip() or name != name.strip() or "@" in name:
        raise ValueError("must be a plain name without '@'")
    return name


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Share = Annotated[Number, Field(gt=0, lt=1)]
Whole = Annotated[int, Field(strict=True, ge=0)]
Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, Field(pattern=r"^[^\n]*$")]
FileName = Annotated[str, Field(min_length=1), AfterValidator(_file_name)]
Seconds = Annotated[Number, _quantity("s")]
#: Names, one or more.
Names = Annotated[tuple[str, ...], Field(min_length=1)]
Channels = Annotated[Names, AfterValidator(_channels)]
Level = Annotated[str | int | float, BeforeValidator(_level)]
Values = Mapping[str, Any]


class _Entries:
    """Entries of a table, which has no others."""

    __pydantic_config__ = ConfigDict(extra="forbid")


@dataclass(frozen=True, kw_only=True)
class RecordGroup(_Entries):
    """`count` records of one kind, spread evenly over the cells of the factors.

    `use`: `calibrate` sets thresholds (leak-free), `judge` is judged by them, on seeds of its own; `leak_lpm`: mean
    flow [L/min] of a leak of that `law` (`mixture`: half of each) from the plan's onset on, 0 for none; `fault`:
    another fault, as text.
    """

    count: Annotated[Whole, Field(ge=1)]
    use: Use = "judge"
    leak_lpm: Annotated[Number, Field(ge=0, alias="leak"), _quantity("L/min")] = 0.0
    law: LeakLaw = "laminar"
    fault: Text = ""

    def __post_init__(self) -> None:
        if self.use == "calibrate" and (self.leak_lpm or self.fault):
            raise ValueError("must be leak-free and without a fault where use = 'calibrate'")


@dataclass(frozen=True, kw_only=True)
class _Plan(_Entries):
    """The fields of all plans; `title`: the name where it is empty."""

    name: FileName
    title: Text = ""
    confidence: Share = 0.95
    note: Text = ""
    place: str = ""


@dataclass(frozen=True, kw_only=True)
class _JudgedPlan(_Plan):
    """The fields of plans over records of a machine.

    `unit`: of the sizes of leaks; `views`: sets of channels by name, for the detectors that name one (`detectors`);
    `channels`: for all others; `assume`: the rig that detectors may assume, with the values `assume_set`.
    """

    false_alarm: Share = 0.01
    promise: Promise = "average"
    detectors: Names
    unit: Text = "L/min"
    views: Mapping[Annotated[str, AfterValidator(_view)], Channels] = field(default_factory=dict)
    channels: Channels | None = None
    assume: Text | None = None
    assume_set: Values = field(default_factory=dict)

    def _assumed(self, rig: Rig | None) -> Rig | None:
        rig = rig if self.assume is None else load_rig(self.assume)
        if not self.assume_set:
            return rig
        return (rig or load_rig("thesis")).with_overrides(self.assume_set, source="assumed by the plan")


@dataclass(frozen=True, kw_only=True)
class SimulatedPlan(_JudgedPlan):
    """A simulated campaign.

    `rig_name`: the rig, with its sampling `rate` and the values `rig_set`; `profile`: the bench whose nuisances each
    record draws, "" for the rig without drift; `onset_s`: of the leaks, nan for half of the duration; `factors`: name
    -> levels, every combination is a cell; `command` and `closed` are the duty, `family` names families of the profile,
    other names are parameters of the rig; `seed`: the base of every case's seed; `part`: what the plan is for, such as
    development or judging.
    """

    rig_name: Annotated[Text, Field(alias="rig")] = "thesis"
    rig_set: Annotated[Values, Field(alias="set")] = field(default_factory=dict)
    rate: Level | None = None
    profile: Text = ""
    duration_s: Annotated[Seconds, Field(alias="duration")]
    onset_s: Annotated[Seconds, Field(alias="onset")] = math.nan
    seed: Whole = 0
    keep_recordings: Flag = False
    records: Annotated[tuple[RecordGroup, ...], Field(min_length=1)]
    factors: Mapping[str, Annotated[tuple[Level, ...], Field(min_length=1)]] = field(default_factory=dict)
    part: Text = ""

    @cached_property
    def rig(self) -> Rig:
        """The rig that is simulated."""
        values = self.rig_set if self.rate is None else {"daq.sample_rate": self.rate, **self.rig_set}
        rig = load_rig(self.rig_name)
        return rig.with_overrides(values, source="set by the plan") if values else rig

    @cached_property
    def assumed(self) -> Rig:
        """The rig that detectors may assume."""
        return self._assumed(self.rig) or self.rig

    @property
    def size(self) -> int:
        """Number of records."""
        return sum(group.count for group in self.records)


@dataclass(frozen=True, kw_only=True)
class RecordingSet(_Entries):
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

    channel_map: Annotated[Mapping[str, str], Field(alias="map")] = field(default_factory=dict)
    rate_hz: Annotated[Number | None, _quantity("Hz"), Field(alias="rate")] = None
    sets: Annotated[tuple[RecordingSet, ...], Field(min_length=1)]

    @cached_property
    def assumed(self) -> Rig | None:
        """The rig that detectors may assume, None where the plan states none."""
        return self._assumed(None)


AnyPlan: TypeAlias = SimulatedPlan | RecordedPlan
