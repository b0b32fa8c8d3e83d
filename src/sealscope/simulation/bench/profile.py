"""Profiles of nuisances as files: differences between healthy machines, and drifts within a recording."""

from __future__ import annotations

import os
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from sealscope.errors import InputError
from sealscope.parameters.fields import choices_of, unit_of
from sealscope.parameters.rig import declared_fields, resolve_name
from sealscope.simulation.changes import ParameterDrift, is_absolute_drift, linear_path
from sealscope.simulation.targets_and_loads import Position, command_or_target, parse_force
from sealscope.storage.plain_values import convert_type
from sealscope.storage.toml_file import read_toml
from sealscope.units import to_si

_PACKAGED = Path(__file__).parent / "profiles"
#: Setting of pydantic that refuses unknown fields.
_KNOWN_ONLY = ConfigDict(extra="forbid")
_Entries = TypeVar("_Entries", bound=tuple[Any, ...])


def _check_rising(pair: tuple[float, float]) -> tuple[float, float]:
    """Return a pair [low, high]; raise ValueError if low > high (a pydantic validator)."""
    if pair[0] > pair[1]:
        raise ValueError(f"must be [low, high] with low <= high, got {list(pair)}")
    return pair


_Text = Annotated[str, Field(pattern=r"\S")]
_Names = Annotated[tuple[str, ...], Field(min_length=1)]
_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_Pair = Annotated[tuple[_Number, _Number], AfterValidator(_check_rising)]
_Flag = Annotated[bool, Field(strict=True)]
_Closed = Annotated[_Number, Field(ge=0.0, le=99.0), AfterValidator(lambda percent: percent / 100.0)]


class _DriftEntry(BaseModel, extra="forbid"):
    """The drift in an entry of a profile's file, with `size` in `unit`; the other fields are those of `DriftRange`."""

    size: _Pair
    unit: _Text
    shapes: Annotated[tuple[Literal["linear", "wander"], ...], Field(min_length=1)] | None = None
    oil: Annotated[_Number, Field(ge=-1.0, le=1.0)] | None = None


class _NuisanceEntry(BaseModel, extra="forbid"):
    """An entry of a profile's file, a difference between machines; it states one of `range`, `scale` and `values`.

    `range` [low, high] and `values` are in `unit`; `scale` is the range [low, high] of a factor on the rig's value. The
    other fields are those of `Nuisance`.
    """

    name: _Text
    parameters: _Names
    range: _Pair | None = None
    scale: _Pair | None = None
    values: Annotated[tuple[_Number | str, ...], Field(min_length=1)] | None = None
    unit: _Text | None = None
    each: _Flag = False
    drift: _DriftEntry | None = None
    why: _Text


@dataclass(frozen=True)
class DriftRange:
    """The distribution from which a parameter's drift is drawn.

    `size`: limits of the drift's maximum minus minimum, in SI units if `absolute`, else relative to the parameter;
    `shapes`: courses to choose from ("linear", "wander"); `oil`: weight of the oil temperature's course, -1 .. 1.
    """

    size: tuple[float, float]
    absolute: bool
    shapes: tuple[str, ...]
    oil: float


@dataclass(frozen=True)
class Nuisance:
    """A difference between healthy machines, distributed uniformly between `low` and `high`.

    `low`, `high`: SI values, or factors on the rig's values if `scales`; `each`: True to draw a value for each
    parameter, False to draw one for all; `drift`: distribution of their drift, if any; `why`: the reason for the range.
    """

    name: str
    parameters: tuple[str, ...]
    low: float
    high: float
    scales: bool
    each: bool
    drift: DriftRange | None
    why: str


@dataclass(frozen=True)
class NuisanceChoice:
    """A difference between machines, one of some `values` (SI or texts) for all `parameters`; `why`: the reason."""

    name: str
    parameters: tuple[str, ...]
    values: tuple[float | str, ...]
    why: str


@dataclass(frozen=True, repr=False, kw_only=True)
class Duty:
    """The commands, throttle settings, loads and controllers of which each machine of a profile draws one.

    `commands`: texts of commands or position targets; `closed`: closed fractions of both throttles (in the file: per
    cent); `amplitude`: range of a factor on the command's amplitude; `loads`: texts of loads on the rod, () for none;
    `controllers`: names of controllers that follow a position target, () for PI; `why`: the reason for this duty.
    """

    __pydantic_config__ = _KNOWN_ONLY
    commands: _Names
    closed: Annotated[tuple[_Closed, ...], Field(min_length=1)] = field(default_factory=lambda: (0.0,))
    amplitude: _Pair = field(default_factory=lambda: (1.0, 1.0))
    why: _Text
    loads: _Names = ()
    controllers: _Names = ()

    def __post_init__(self) -> None:
        for text in self.commands:
            command = command_or_target(text)
            if self.controllers and not isinstance(command, Position):
                raise InputError(f"a controller must have a target to follow, got {text!r}")
            if self.amplitude != (1.0, 1.0) and not hasattr(command, "amplitude"):
                raise InputError(f"a range of amplitudes needs commands with an amplitude, got {text!r}")
        for text in self.loads:
            parse_force(text)

    def __repr__(self) -> str:
        # seeds of cases derive from this text: `loads` and `controllers`, the fields with a plain default, are left out
        # unless stated, so that profiles without them draw the same cases as before these fields existed
        stated_fields = [
            part for part in fields(self) if part.default is MISSING or getattr(self, part.name) != part.default
        ]
        return f"Duty({', '.join(f'{part.name}={getattr(self, part.name)!r}' for part in stated_fields)})"


AnyNuisance = Nuisance | NuisanceChoice


def _parse_nuisance(table: Any) -> AnyNuisance:
    """Parse an entry of a profile as a nuisance; the message of an InputError begins with the entry's name."""
    entry = _NuisanceEntry.model_validate(table)
    try:
        return _convert_to_si(entry)
    except InputError as error:
        raise InputError(f"{entry.name}: {error}") from None


def _convert_to_si(entry: _NuisanceEntry) -> AnyNuisance:
    """Make the nuisance of an entry, in SI units; raise InputError if the entry's fields do not fit together."""
    parameters = tuple(resolve_name(name) for name in entry.parameters)
    declarations = [declared_fields()[parameter] for parameter in parameters]
    kinds = {(choices_of(declaration), unit_of(declaration)) for declaration in declarations}
    choices, si_unit = next(iter(kinds))  # several are refused below, unless the SI unit is not used
    if entry.values is not None:
        if len(kinds) > 1 or entry.range or entry.scale or entry.drift or entry.each:
            raise InputError(
                "an entry with values must have parameters of one kind and unit, and no range, scale, drift or each"
            )
        return NuisanceChoice(entry.name, parameters, _convert_values(entry, choices, si_unit), entry.why)
    if any(kind_choices for kind_choices, _ in kinds):
        raise InputError(f"{', '.join(parameters)}: a choice cannot be drawn from a range")
    if entry.scale is not None and entry.range is None and entry.unit is None:
        low, high = entry.scale
        if low <= 0:
            raise InputError(f"scale must be > 0, got {low:g}")
    elif entry.range is not None and entry.scale is None and entry.unit is not None:
        if len(kinds) > 1:
            raise InputError(
                f"parameters of one range must have one unit, got {', '.join(sorted(unit for _, unit in kinds))}"
            )
        low, high = (to_si(value, entry.unit, si_unit, name="range") for value in entry.range)
    else:
        raise InputError("there must be a range with a unit, or a scale without a unit")
    if entry.drift is not None and len(kinds) > 1 and is_absolute_drift(parameters[0]):
        units = ", ".join(sorted(unit for _, unit in kinds))
        raise InputError(f"parameters that drift by one size must have one unit, got {units}")
    drift = None if entry.drift is None else _parse_drift(entry.drift, parameters, si_unit)
    scales = entry.scale is not None
    return Nuisance(entry.name, parameters, low, high, scales=scales, each=entry.each, drift=drift, why=entry.why)


def _convert_values(entry: _NuisanceEntry, choices: tuple[str, ...], si_unit: str) -> tuple[float | str, ...]:
    """Convert the listed values of a parameter to SI units; `choices`: the parameter's options, () for a number."""
    values = entry.values or ()
    for value in values:
        if choices and value not in choices:
            raise InputError(f"values must be among {', '.join(choices)}, got {value!r}")
        if not choices and (isinstance(value, str) or entry.unit is None):
            raise InputError(f"values must be numbers with a unit, got {value!r}")
    if choices:
        return values
    return tuple(to_si(float(value), entry.unit or "", si_unit, name="values") for value in values)


def _parse_drift(entry: _DriftEntry, parameters: tuple[str, ...], si_unit: str) -> DriftRange:
    """Convert the drift in an entry to `si_unit`, or to a fraction of the parameters' values if it is relative."""
    absolute = is_absolute_drift(parameters[0])
    for parameter in parameters:
        ParameterDrift(parameter, linear_path(0.0, 1.0), absolute)  # raises InputError if it cannot drift like this
    low, high = (to_si(value, entry.unit, si_unit if absolute else "1", name="drift") for value in entry.size)
    if low < 0:
        raise InputError(f"size of the drift must be >= 0, got {low:g} to {high:g}")
    if entry.shapes is not None and entry.oil is not None:
        raise InputError("the drift must have shapes or oil, got both")
    # the part of a drift that does not follow the oil wanders
    shapes = entry.shapes or (("linear", "wander") if entry.oil is None else ("wander",))
    return DriftRange((low, high), absolute, shapes, float(entry.oil or 0.0))


def _check_distinct(nuisances: tuple[AnyNuisance, ...]) -> tuple[AnyNuisance, ...]:
    """Return the nuisances (differences between machines); raise InputError if two share a parameter or a name."""
    owner: dict[str, str] = {}
    for nuisance in nuisances:
        for parameter in nuisance.parameters:
            if owner.setdefault(parameter, nuisance.name) != nuisance.name:
                raise InputError(f"{parameter} must be in one nuisance, got {owner[parameter]} and {nuisance.name}")
    return _check_distinct_names(nuisances)


def _check_distinct_names(entries: _Entries) -> _Entries:
    """Return the entries of a profile; raise InputError if two have the same name."""
    if len({entry.name for entry in entries}) < len(entries):
        raise InputError("must have different names")
    return entries


def _check_falls(nuisances: tuple[AnyNuisance, ...], *, warms: bool = False) -> tuple[AnyNuisance, ...]:
    """Return the nuisances (differences between machines); raise InputError if a drift may make a parameter <= 0.

    `warms`: True if the oil only warms, so that a drift that follows nothing else (`oil` = 1) only rises.
    """
    for nuisance in nuisances:
        drift = nuisance.drift if isinstance(nuisance, Nuisance) else None
        if drift and not drift.absolute and drift.size[1] >= 1.0 and not (warms and drift.oil == 1.0):
            low, high = (100.0 * size for size in drift.size)
            raise InputError(
                f"{nuisance.name}: size of the drift must be < 100 %, except with oil = 1 in a family with warms = "
                f"true, got {low:g} % to {high:g} %"
            )
    return nuisances


_Nuisances = Annotated[
    tuple[Annotated[AnyNuisance, BeforeValidator(_parse_nuisance)], ...], AfterValidator(_check_distinct)
]


@dataclass(frozen=True, kw_only=True)
class Family:
    """A family of machines, which differs from the other machines of a profile in one respect.

    `nuisances` replace those of the profile for the same parameters; `duty` (commands and loads) replaces the
    profile's, None keeps it; `warms`: True if the oil warms linearly in all of them; `why`: the reason for the family.
    """

    __pydantic_config__ = _KNOWN_ONLY
    name: _Text
    nuisances: Annotated[_Nuisances, Field(alias="nuisance")] = ()
    duty: Duty | None = None
    warms: _Flag = False
    why: _Text

    def __post_init__(self) -> None:
        _check_falls(self.nuisances, warms=self.warms)


@dataclass(frozen=True)
class Profile:
    """The differences between healthy machines of one kind (`nuisances`), and their duty, i.e. commands and loads.

    `families`: groups of machines that differ from the others; `place`: path of the file, for messages; `seeds`: name
    from which the seeds of cases are derived if the profile was renamed and must draw the same cases, "" for `name`.
    """

    name: str
    title: str
    duty: Duty
    nuisances: tuple[AnyNuisance, ...]
    place: str
    families: tuple[Family, ...] = field(default=(), repr=False)
    seeds: str = field(default="", repr=False)

    def family(self, name: str) -> Family:
        """Return the profile's family of machines with this name; raise InputError if there is none."""
        for family in self.families:
            if family.name == name:
                return family
        names = ", ".join(family.name for family in self.families) or "none"
        raise InputError(f"a family of {self.name} must be one of its own ({names}), got {name!r} ({self.place})")

    def of_family(self, name: str) -> Profile:
        """Build the profile of a family of machines, whose nuisances and duty replace those of this profile."""
        family = self.family(name)
        nuisances = _replace_nuisances(self.nuisances, family.nuisances)
        return replace(self, duty=family.duty or self.duty, nuisances=nuisances, families=())


def _replace_nuisances(
    nuisances: tuple[AnyNuisance, ...], replacing: tuple[AnyNuisance, ...]
) -> tuple[AnyNuisance, ...]:
    """Remove the parameters in `replacing` from all `nuisances` (differences between machines); append `replacing`."""
    replaced_parameters = {parameter for nuisance in replacing for parameter in nuisance.parameters}
    remaining: list[AnyNuisance] = []
    for nuisance in nuisances:
        parameters = tuple(parameter for parameter in nuisance.parameters if parameter not in replaced_parameters)
        remaining += [replace(nuisance, parameters=parameters)] if parameters else []
    return (*remaining, *replacing)


def profile_names() -> tuple[str, ...]:
    """List the names of the profiles that come with the package."""
    return tuple(sorted(path.stem for path in _PACKAGED.glob("*.toml")))


def load_profile(name_or_path: str | os.PathLike[str] = "bench") -> Profile:
    """Read a profile of the differences between healthy machines, by the name of a packaged profile or by path."""
    text = os.fspath(name_or_path)
    if text in profile_names():
        return _read_profile(_PACKAGED / f"{text}.toml", f"profiles/{text}.toml")
    if not (text.endswith(".toml") or os.sep in text):
        raise InputError(f"{text!r} is no packaged profile ({', '.join(profile_names())}) and no .toml file")
    return _read_profile(Path(text), text)


class _Head(BaseModel, extra="forbid"):
    """The table `[profile]` of a file.

    `extends`: packaged profile whose nuisances the file inherits, and whose duty if it states none, but no families.
    """

    name: _Text
    title: _Text
    seeds: str = ""
    extends: Literal[profile_names()] | None = None  # type: ignore[valid-type]


class _File(BaseModel, extra="forbid"):
    """The file of a profile: its tables [profile] and [duty], and its lists of [[nuisance]] and [[family]]."""

    profile: _Head
    duty: Duty | None = None
    nuisance: Annotated[_Nuisances, AfterValidator(_check_falls)] = ()
    family: Annotated[tuple[Family, ...], AfterValidator(_check_distinct_names)] = ()


def _read_profile(path: Path, place: str) -> Profile:
    """Read a profile of machines from its TOML file; `place` names the file in messages."""
    tree = read_toml(path, "a profile", place)
    try:
        file = convert_type(_File, tree)
    except ValueError as error:
        raise InputError(f"{error} ({place})") from None
    table = file.profile
    base = None if table.extends is None else load_profile(table.extends)
    duty = base.duty if base is not None and file.duty is None else file.duty
    if duty is None:
        raise InputError(f"a profile must have [duty], got none ({place})")
    nuisances = _replace_nuisances(() if base is None else base.nuisances, file.nuisance)
    return Profile(table.name, table.title, duty, nuisances, place, file.family, table.seeds)
