"""The two kinds of plan: simulated records, and recordings of a real machine.

A field is the entry of the plan's file with its name or its `alias`; `place` is the path of the file.
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

_MAX_NAME_LENGTH = 80


def _quantity_validator(unit: str) -> BeforeValidator:
    """Build a validator that converts a text such as '20 s' to a number in `unit`."""
    return BeforeValidator(lambda value: parse_quantity(value, unit) if isinstance(value, str) else value)


def _validate_file_name(name: str) -> str:
    """Return `name`; raise ValueError if it is no plain file name."""
    if not all(c.isalnum() or c in "-_." for c in name) or name.startswith(".") or len(name) > _MAX_NAME_LENGTH:
        raise ValueError(f"must be of at most {_MAX_NAME_LENGTH} letters, digits, '-', '_' and '.'")
    return name


def _validate_pattern(files: str) -> str:
    """Return the pattern `files`; raise ValueError if it leaves its folder or uses `**` in an unsupported way."""
    parts = Path(files).parts
    if not parts or Path(files).is_absolute() or ".." in parts:
        raise ValueError("must be a pattern within the folder")
    if "\0" in files or any("**" in part and part != "**" for part in parts) or files.count("**") > 1:
        raise ValueError("must be a pattern of names, with ** once at most")
    return files


def _validate_level(value: Any) -> Any:
    """Return the level `value`; raise ValueError if it is neither text nor a finite number."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if isinstance(value, str) or (is_number and math.isfinite(value)):
        return value
    raise ValueError(f"must be a text or a number, got {value!r:.60}")


def _validate_channels(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the channels `names`; raise ValueError for an unknown or repeated one, or the measured leak."""
    if not set(names) <= set(CHANNEL_UNITS) or len(set(names)) < len(names):
        raise ValueError(f"must be a list of channels, each once, got {list(names)}")
    if "q_leak" in names:
        raise ValueError("must not contain q_leak: it measures the leak that detectors are to find")
    return names


def _validate_view_name(name: str) -> str:
    """Return the view's name; raise ValueError if `parse_detector_name` could not parse it."""
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
#: One name or more.
Names = Annotated[tuple[str, ...], Field(min_length=1)]
Channels = Annotated[Names, AfterValidator(_validate_channels)]
Level = Annotated[str | int | float, BeforeValidator(_validate_level)]
Values = Mapping[str, Any]


class _TomlTable:
    """A table of a plan's file; entries that are no field are refused."""

    __pydantic_config__ = ConfigDict(extra="forbid")


@dataclass(frozen=True, kw_only=True)
class RecordGroup(_TomlTable):
    """`count` records of one kind, spread evenly over the cells of the factors.

    `use`: `calibrate` for leak-free records that set thresholds, `judge` for records that are judged by them;
    `leak_lpm`: mean flow [L/min] of the leak from the plan's onset on, 0 for none; `law`: its law, `mixture` for half
    of each; `fault`: another fault, as text.
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
    """The fields of all plans; an empty `title` is replaced by the name."""

    name: FileName
    title: Text = ""
    confidence: Fraction = 0.95
    note: Text = ""
    place: str = ""


@dataclass(frozen=True, kw_only=True)
class _JudgedPlan(_Plan):
    """The fields that plans over simulated and over recorded records share.

    `false_alarm`, `promise`: as in `quantile_threshold`; `unit`: unit of the leaks' sizes; `views`: sets of channels by
    the names that `detectors` may use; `channels`: the channels of detectors without a view; `assume`: the rig that
    detectors may assume, with the values `assume_set`.
    """

    false_alarm: Fraction = 0.01
    promise: Promise = "average"
    detectors: Names
    unit: Text = "L/min"
    views: Mapping[Annotated[str, AfterValidator(_validate_view_name)], Channels] = field(default_factory=dict)
    channels: Channels | None = None
    assume: Text | None = None
    assume_set: Values = field(default_factory=dict)

    def _load_assumed(self, rig: Rig | None) -> Rig | None:
        """Load the rig that detectors may assume, by default `rig`; None if neither is given.

        The values `assume_set` are applied to it, or to the rig `thesis` in place of None.
        """
        rig = rig if self.assume is None else load_rig(self.assume)
        if not self.assume_set:
            return rig
        return (rig or load_rig("thesis")).with_overrides(self.assume_set, source="assumed by the plan")


@dataclass(frozen=True, kw_only=True)
class SimulatedPlan(_JudgedPlan):
    """A simulated campaign.

    `rig_name`: the rig, with its sampling `rate` and the values `rig_set`; `profile`: the bench profile from which each
    record's machine is drawn, "" for the rig as it is; `onset_s`: start [s] of the leaks, nan for half of the duration;
    `factors`: name -> levels, every combination is a cell. The factors `command`, `controller`, `load` and `closed` set
    the duty, `family` selects families of the profile, other names are parameters of the rig. `seed`: base of every
    case's seed; `part`: purpose of the plan, such as development or judging.
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

    @cached_property
    def rig(self) -> Rig:
        """The rig that is simulated."""
        values = self.rig_set if self.rate is None else {"daq.sample_rate": self.rate, **self.rig_set}
        rig = load_rig(self.rig_name)
        return rig.with_overrides(values, source="set by the plan") if values else rig

    @cached_property
    def assumed(self) -> Rig:
        """The rig that detectors may assume."""
        return self._load_assumed(self.rig) or self.rig

    @property
    def size(self) -> int:
        """Number of records."""
        return sum(group.count for group in self.records)


@dataclass(frozen=True, kw_only=True)
class RecordingSet(_TomlTable):
    """Recordings of one kind.

    `files`: pattern of the files, which are ordered by the numbers in their names; the set is numbers `first` to `end`
    - 1 of them, counted from 1; `size`: 0 for healthy recordings, else the size of the leak in the plan's `unit`.
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
class RecordedPlan(_JudgedPlan):
    """A campaign over recordings in a folder of the caller."""

    channel_map: Annotated[Mapping[str, str], Field(alias="map")] = field(default_factory=dict)
    rate_hz: Annotated[Number | None, _quantity_validator("Hz"), Field(alias="rate")] = None
    sets: Annotated[tuple[RecordingSet, ...], Field(min_length=1)]

    @cached_property
    def assumed(self) -> Rig | None:
        """The rig that detectors may assume, None if the plan states none."""
        return self._load_assumed(None)


AnyPlan: TypeAlias = SimulatedPlan | RecordedPlan
