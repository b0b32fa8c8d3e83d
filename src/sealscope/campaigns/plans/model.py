"""The two kinds of campaign plan: one of simulated records, and one of recordings of real machines.

A field is read from the entry of the plan's TOML file that has its name, or its `alias` if it has one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field

from sealscope.evaluation.thresholds import Promise
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import CHANNEL_UNITS
from sealscope.simulation.bench.profile import Profile, load_profile
from sealscope.units import parse_quantity

Use = Literal["calibrate", "judge"]
LeakLaw = Literal["laminar", "orifice", "mixture"]

_MAX_NAME_LENGTH = 80


def _quantity_validator(unit: str) -> BeforeValidator:
    """Build a pydantic validator that converts a text such as '20 s' to a number in `unit`; numbers stay unchanged."""
    return BeforeValidator(lambda value: parse_quantity(value, unit) if isinstance(value, str) else value)


def _validate_file_name(name: str) -> str:
    """Return a file name unchanged; raise ValueError if it is not a valid one."""
    if not all(c.isalnum() or c in "-_." for c in name) or name.startswith(".") or len(name) > _MAX_NAME_LENGTH:
        raise ValueError(
            f"must have at most {_MAX_NAME_LENGTH} letters, digits, '-', '_' and '.', and not begin with '.'"
        )
    return name


def _validate_pattern(pattern: str) -> str:
    """Return a pattern of file names, such as "day*/*.csv", unchanged; raise ValueError if it is not a valid one."""
    parts = Path(pattern).parts
    if not parts or Path(pattern).is_absolute() or ".." in parts:
        raise ValueError("must be a pattern within the folder")
    # a name cannot contain NUL, `glob` refuses ** within a name, and several ** would search the same folders again
    if "\0" in pattern or any("**" in part and part != "**" for part in parts) or pattern.count("**") > 1:
        raise ValueError("must be a pattern of names with at most one **, which stands for whole folders")
    return pattern


def _validate_level(value: Any) -> Any:
    """Return a level (a value of a factor) unchanged; raise ValueError unless it is a text or a finite number."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if isinstance(value, str) or (is_number and math.isfinite(value)):
        return value
    raise ValueError(f"must be a text or a number, got {value!r:.60}")


def _validate_channels(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of channels; raise ValueError for an unknown or repeated one, or the leak's meter `q_leak`."""
    if not set(names) <= set(CHANNEL_UNITS) or len(set(names)) < len(names):
        raise ValueError(f"must be a list of channels, each once, got {list(names)}")
    if "q_leak" in names:
        raise ValueError("must not contain q_leak: it measures the leak that detectors are to find")
    return names


def _validate_view_name(name: str) -> str:
    """Return the name of a view (set of channels) unchanged; raise ValueError if empty, or with "@" or outer blanks."""
    if not name.strip() or name != name.strip() or "@" in name:
        raise ValueError("must be a plain name without '@'")
    return name


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Fraction = Annotated[Number, Field(gt=0, lt=1)]
Count = Annotated[int, Field(strict=True, ge=0)]
Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, Field(pattern=r"^[^\n]*$")]
FileName = Annotated[str, Field(min_length=1), AfterValidator(_validate_file_name)]
Seconds = Annotated[Number, _quantity_validator("s")]
Names = Annotated[tuple[str, ...], Field(min_length=1)]
Channels = Annotated[Names, AfterValidator(_validate_channels)]
Level = Annotated[str | int | float, BeforeValidator(_validate_level)]
Values = Mapping[str, Any]


class _TomlTable:
    """A table of a plan's TOML file; reading one with an unknown entry raises an error."""

    __pydantic_config__ = ConfigDict(extra="forbid")


@dataclass(frozen=True, kw_only=True)
class RecordGroup(_TomlTable):
    """A group of simulated records with the same leak and fault, spread evenly over the conditions of the plan.

    The conditions are all combinations of the levels (values) of the plan's factors, such as command and load.

    - `count`: number of records
    - `use`: `calibrate` for leak-free records from which thresholds are set, `judge` for records to be judged
    - `leak_lpm` [L/min]: mean flow of the leak after the plan's onset, 0 for none
    - `law`: relation of the leak's flow and pressure; a `mixture` is half `laminar` flow and half `orifice` flow
    - `fault`: text of a fault other than this leak, "" for none
    """

    count: Annotated[Count, Field(ge=1)]
    use: Use = "judge"
    leak_lpm: Annotated[Number, Field(ge=0, alias="leak"), _quantity_validator("L/min")] = 0.0
    law: LeakLaw = "laminar"
    fault: Text = ""

    def __post_init__(self) -> None:
        if self.use == "calibrate" and (self.leak_lpm or self.fault):
            raise ValueError("must be leak-free and without a fault where use = 'calibrate'")


@dataclass(frozen=True, kw_only=True)
class _Plan(_TomlTable):
    """The fields that plans of simulated records and plans of recordings have in common.

    - `name`: name of the plan and of its files; `title`: by default the name; `note`: remark of the author
    - `place`: path of the plan's file
    - `confidence`: confidence level of all intervals, such as 0.95
    - `false_alarm`, `promise`: wanted false-alarm probability of each detector, and how thresholds keep it (`Promise`)
    - `detectors`: names in the forms that the module `plans.detectors` lists
    - `views`: sets of channels, by the name that follows the "@" in a detector's name
    - `channels`: channels of the detectors without "@", None for all but the flow meter of the leak
    - `assume`: name or file of the rig that detectors may assume, None for the default of the plan's type
    - `assume_set`: values that replace some parameters of this rig
    """

    name: FileName
    title: Text = ""
    confidence: Fraction = 0.95
    note: Text = ""
    place: str = ""
    false_alarm: Annotated[Fraction, Field(ge=1e-15)] = 0.01  # no number of records shows a smaller one
    promise: Promise = "average"
    detectors: Names
    views: Mapping[Annotated[str, AfterValidator(_validate_view_name)], Channels] = field(default_factory=dict)
    channels: Channels | None = None
    assume: Text | None = None
    assume_set: Values = field(default_factory=dict)

    def _load_assumed(self, default: Rig | None) -> Rig | None:
        """Load the rig that detectors assume: `assume` or, if that is None, `default`, with the values `assume_set`.

        If both are None, the values change the rig `thesis`; without values the result is None then.
        """
        rig = default if self.assume is None else load_rig(self.assume)
        if not self.assume_set:
            return rig
        return (rig or load_rig("thesis")).with_overrides(self.assume_set, source="assumed by the plan")


@dataclass(frozen=True, kw_only=True)
class SimulatedPlan(_Plan):
    """The plan of a simulated campaign.

    - `rig_name`, `rig_set`: name or file of the rig, and values that replace some of its parameters
    - `rate`: sampling rate, a number in Hz or a text with a unit, None for the rig's own
    - `profile`: distribution from which the machine of each record is drawn, "" to simulate the rig itself
    - `onset_s` [s]: start of the leaks, nan for half of the duration
    - `seed`: number from which the seeds of all records derive
    - `keep_recordings`: True to store the recordings
    - `factors`: by name, the levels (values) of each factor; a group's records take their combinations in turn
    - `part`: purpose of the plan, such as development or judging
    - `unit`: unit of the leaks' sizes, which a plan's file cannot change

    The factors `command`, `controller` and `load` set how the machine is moved and loaded, `closed` how far the
    throttles of its lines are closed, and `family` which groups of the profile's machines are drawn. Others are
    parameters of the rig.
    """

    rig_name: Annotated[Text, Field(alias="rig")] = "thesis"
    rig_set: Annotated[Values, Field(alias="set")] = field(default_factory=dict)
    rate: Level | None = None
    profile: Text = ""
    duration_s: Annotated[Seconds, Field(alias="duration")]
    onset_s: Annotated[Seconds, Field(alias="onset")] = math.nan
    seed: Count = 0
    keep_recordings: Flag = False
    records: Annotated[tuple[RecordGroup, ...], Field(min_length=1)]
    factors: Mapping[str, Annotated[tuple[Level, ...], Field(min_length=1)]] = field(default_factory=dict)
    part: Text = ""
    unit: ClassVar[str] = "L/min"

    @cached_property
    def rig(self) -> Rig:
        """The rig that is simulated, with the plan's sampling rate and other values."""
        values = self.rig_set if self.rate is None else {"daq.sample_rate": self.rate, **self.rig_set}
        rig = load_rig(self.rig_name)
        return rig.with_overrides(values, source="set by the plan") if values else rig

    @cached_property
    def assumed(self) -> Rig:
        """The rig that detectors may assume, by default the simulated one."""
        return self._load_assumed(self.rig) or self.rig  # `or`: for type checkers

    @cached_property
    def machine_profile(self) -> Profile | None:
        """The profile from which machines are drawn, None without one."""
        return load_profile(self.profile) if self.profile else None

    @property
    def size(self) -> int:
        """Number of records in all groups of the plan."""
        return sum(group.count for group in self.records)


@dataclass(frozen=True, kw_only=True)
class RecordingSet(_TomlTable):
    """A set of recordings with a leak of the same size, such as the same mean flow.

    - `files`: pattern of the file names
    - `use`: `calibrate` for healthy recordings from which thresholds are set, `judge` for recordings to be judged
    - `size`: size of the leak in the plan's `unit`, 0 for healthy recordings
    - `first`, `end`: position of the first file that is used, and one past that of the last, by default all files; they
      are ordered by the numbers in their names and counted from 1
    - `label`: name of the set in tables, by default the pattern
    """

    files: Annotated[Text, AfterValidator(_validate_pattern)]
    use: Use = "judge"
    size: Annotated[Number, Field(ge=0)] = 0.0
    first: Annotated[Count, Field(ge=1)] = 1
    end: Annotated[Count, Field(ge=2)] = 10**9
    label: Text = ""

    def __post_init__(self) -> None:
        if self.use == "calibrate" and self.size > 0:
            raise ValueError("must have the size 0 to calibrate")


@dataclass(frozen=True, kw_only=True)
class RecordedPlan(_Plan):
    """The plan of a campaign over recordings of real machines, which are files in a folder.

    `channel_map`: by channel, the name of its column; `rate_hz` [Hz]: sampling rate of files without times; `unit`:
    unit of the leaks' sizes.
    """

    channel_map: Annotated[Mapping[str, str], Field(alias="map")] = field(default_factory=dict)
    rate_hz: Annotated[Number | None, _quantity_validator("Hz"), Field(alias="rate")] = None
    unit: Text = "L/min"
    sets: Annotated[tuple[RecordingSet, ...], Field(min_length=1)]

    @cached_property
    def assumed(self) -> Rig | None:
        """The rig that detectors may assume, None if the plan states none."""
        return self._load_assumed(default=None)


AnyPlan: TypeAlias = SimulatedPlan | RecordedPlan
