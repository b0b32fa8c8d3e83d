"""Profiles of nuisances as files: how healthy machines differ, and how each changes within a record."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sealscope.errors import InputError
from sealscope.parameters import declared_names
from sealscope.parameters.fields import choices_of, unit_of
from sealscope.parameters.names import resolve
from sealscope.parameters.rig import declared
from sealscope.simulation.changes import Linear, ParameterDrift, drifts_absolutely
from sealscope.simulation.courses import Position, command_or_target, parse_force
from sealscope.storage.toml_file import read_toml
from sealscope.units import to_si

_PACKAGED = Path(__file__).parent / "profiles"


@dataclass(frozen=True)
class DriftRange:
    """How far a parameter drifts.

    `size` low and high of the distance between its extremes (a share, or SI if `absolute`); forms it may take; weight
    `oil` of the oil's temperature in it, the rest wanders.
    """

    size: tuple[float, float]
    absolute: bool
    shapes: tuple[str, ...]
    oil: float


@dataclass(frozen=True)
class Nuisance:
    """One thing that differs between machines, uniformly between `low` and `high`.

    a value in SI, or a factor on the rig's own (`scales`); `each`: a draw for each parameter, else one for all.
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
    """One thing that differs between machines: one of `values`, in SI or texts of a choice, for all `parameters`."""

    name: str
    parameters: tuple[str, ...]
    values: tuple[float | str, ...]
    why: str


@dataclass(frozen=True, repr=False)
class Duty:
    """What the machines are asked for.

    One of `commands`, times a factor within `amplitude`, both throttles `closed` by one of these shares. Where commands
    are targets for the piston, one of `controllers` follows them (none: PI); one of `loads` acts on the rod.
    """

    commands: tuple[str, ...]
    closed: tuple[float, ...]
    amplitude: tuple[float, float]
    why: str
    loads: tuple[str, ...] = ()
    controllers: tuple[str, ...] = ()

    def __repr__(self) -> str:  # seeds of cases derive from it: what a profile does not state is left out
        stated = [part for part in fields(self) if part.default is MISSING or getattr(self, part.name) != part.default]
        return f"Duty({', '.join(f'{part.name}={getattr(self, part.name)!r}' for part in stated)})"


AnyNuisance = Nuisance | NuisanceChoice


@dataclass(frozen=True)
class Family:
    """Machines that depart from the others of a profile in one way.

    `nuisances` take the place of the profile's for the same parameters, `duty` (None: the profile's) that of its duty;
    `warms`: the oil warms evenly in all of them.
    """

    name: str
    nuisances: tuple[AnyNuisance, ...]
    duty: Duty | None
    warms: bool
    why: str


@dataclass(frozen=True)
class Profile:
    """All nuisances of a kind of machines, and their duty; `families` of machines that depart from it.

    `seeds`: name that the seeds of cases derive from, "" for its own: a renamed profile draws the same machines.
    """

    name: str
    title: str
    duty: Duty
    nuisances: tuple[AnyNuisance, ...]
    place: str
    families: tuple[Family, ...] = field(default=(), repr=False)
    seeds: str = field(default="", repr=False)

    def family(self, name: str) -> Family:
        """Return the family of that name; raise InputError where there is none."""
        for family in self.families:
            if family.name == name:
                return family
        known = ", ".join(family.name for family in self.families) or "none"
        raise InputError(f"a family of {self.name} must be one of its own ({known}), got {name!r} ({self.place})")

    def of_family(self, name: str) -> Profile:
        """Return the profile of one family's machines: its nuisances, and the others of this one."""
        family = self.family(name)
        nuisances = _in_place(self.nuisances, family.nuisances)
        return replace(self, duty=family.duty or self.duty, nuisances=nuisances, families=())


def _in_place(nuisances: tuple[AnyNuisance, ...], own: tuple[AnyNuisance, ...]) -> tuple[AnyNuisance, ...]:
    """Return the nuisances with `own` in place of those for the same parameters."""
    taken = {parameter for nuisance in own for parameter in nuisance.parameters}
    kept: list[AnyNuisance] = []
    for nuisance in nuisances:
        left = tuple(parameter for parameter in nuisance.parameters if parameter not in taken)
        kept += [replace(nuisance, parameters=left)] if left else []
    return (*kept, *own)


def profile_names() -> tuple[str, ...]:
    """Names of the packaged profiles."""
    return tuple(sorted(path.stem for path in _PACKAGED.glob("*.toml")))


def load_profile(name_or_path: str | os.PathLike[str] = "bench") -> Profile:
    """Return the profile of that name, or of a TOML file laid out like `profiles/bench.toml`.

    Raises InputError where the file cannot be read, a name or unit is unknown, a range is none or a reason is missing.
    """
    text = os.fspath(name_or_path)
    if text in profile_names():
        return _profile(_PACKAGED / f"{text}.toml", f"profiles/{text}.toml")
    if not (text.endswith(".toml") or os.sep in text):
        raise InputError(f"{text!r} is no packaged profile ({', '.join(profile_names())}) and no .toml file")
    return _profile(Path(text), text)


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


_Text = Annotated[str, Field(pattern=r"\S")]
_Names = Annotated[list[str], Field(min_length=1)]
_Pair = Annotated[list[float], Field(min_length=2, max_length=2)]


class _DriftEntry(_Entry):
    size: _Pair
    unit: _Text
    shapes: Annotated[list[Literal["linear", "wander"]], Field(min_length=1)] | None = None
    oil: Annotated[float, Field(ge=-1.0, le=1.0)] | None = None


class _NuisanceEntry(_Entry):
    name: _Text
    parameters: _Names
    range: _Pair | None = None
    scale: _Pair | None = None
    values: Annotated[list[float | str], Field(min_length=1)] | None = None
    unit: _Text | None = None
    each: bool = False
    drift: _DriftEntry | None = None
    why: _Text


class _DutyEntry(_Entry):
    commands: _Names
    closed: list[Annotated[float, Field(ge=0.0, le=99.0)]] = Field([0.0], min_length=1)
    amplitude: _Pair = Field([1.0, 1.0])
    loads: _Names = Field([])
    controllers: _Names = Field([])
    why: _Text


class _FamilyEntry(_Entry):
    name: _Text
    why: _Text
    warms: bool = False
    duty: _DutyEntry | None = None
    nuisance: list[_NuisanceEntry] = Field([])


class _HeadEntry(_Entry):
    name: _Text
    title: _Text
    seeds: str = ""
    extends: Literal[profile_names()] | None = None  # type: ignore[valid-type]


class _ProfileEntry(_Entry):
    profile: _HeadEntry
    duty: _DutyEntry | None = None
    nuisance: list[_NuisanceEntry] = Field([])
    family: list[_FamilyEntry] = Field([])


def _profile(path: Path, place: str) -> Profile:
    tree = read_toml(path, "a profile", place)
    try:
        entry = _ProfileEntry(**tree)
    except ValidationError as error:
        raise InputError(f"{_rule_broken(error)} ({place})") from None
    try:
        base = None if entry.profile.extends is None else load_profile(entry.profile.extends)
        if entry.duty is None and base is None:
            raise InputError("a profile must have [duty], got none")
        duty = base.duty if base is not None and entry.duty is None else _duty(entry.duty)
        nuisances = _in_place(() if base is None else base.nuisances, _nuisances(entry.nuisance))
        families = tuple(
            Family(
                one.name, _nuisances(one.nuisance), None if one.duty is None else _duty(one.duty), one.warms, one.why
            )
            for one in entry.family
        )
        _names_of_their_own("families", families)
    except InputError as error:
        raise InputError(f"{error} ({place})") from None
    return Profile(entry.profile.name, entry.profile.title, duty, nuisances, place, families, entry.profile.seeds)


def _rule_broken(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    entry = "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in first["loc"])[1:]
    if plain := {"missing": "is missing", "extra_forbidden": "is not known"}.get(first["type"]):
        return f"{entry} {plain}"
    return f"{entry} must be {first['msg'].removeprefix('Input should be ')}, got {first['input']!r}"


def _names_of_their_own(what: str, entries: Sequence[AnyNuisance | Family]) -> None:
    if len({entry.name for entry in entries}) < len(entries):
        raise InputError(f"{what} must have names of their own")


def _nuisances(entries: Sequence[_NuisanceEntry]) -> tuple[AnyNuisance, ...]:
    nuisances = []
    for entry in entries:
        try:
            nuisances.append(_nuisance(entry))
        except InputError as error:
            raise InputError(f"{entry.name}: {error}") from None
    owner: dict[str, str] = {}
    for nuisance in nuisances:
        for parameter in nuisance.parameters:
            if owner.setdefault(parameter, nuisance.name) != nuisance.name:
                raise InputError(f"{parameter} must be in one nuisance, got {owner[parameter]} and {nuisance.name}")
    _names_of_their_own("nuisances", nuisances)
    return tuple(nuisances)


def _pair(given: Sequence[float], what: str) -> tuple[float, float]:
    if given[0] > given[1]:
        raise InputError(f"{what} must be [low, high] with low <= high, got {list(given)}")
    return float(given[0]), float(given[1])


def _nuisance(entry: _NuisanceEntry) -> AnyNuisance:
    parameters = tuple(resolve(name, declared_names()) for name in entry.parameters)
    fields = [declared()[parameter] for parameter in parameters]
    kinds = {(choices_of(field), unit_of(field)) for field in fields}
    choices, si_unit = next(iter(kinds))
    if entry.values is not None:
        if len(kinds) > 1 or entry.range or entry.scale or entry.drift or entry.each:
            raise InputError(
                "a list of values must be of parameters of one kind and unit, with neither range nor drift"
            )
        return NuisanceChoice(entry.name, parameters, _values(entry, choices, si_unit), entry.why)
    if any(chosen for chosen, _ in kinds):
        raise InputError(f"{', '.join(parameters)}: a choice cannot be drawn from a range")
    if entry.scale is not None and entry.range is None and entry.unit is None:
        low, high = _pair(entry.scale, "scale")
        if low <= 0:
            raise InputError(f"scale must be > 0, got {low:g}")
    elif entry.range is not None and entry.scale is None and entry.unit is not None:
        low, high = _pair(entry.range, "range")
        if len(kinds) > 1:
            raise InputError(
                f"parameters of one range must have one unit, got {', '.join(sorted(u for _, u in kinds))}"
            )
        low, high = (to_si(value, entry.unit, si_unit, name="range") for value in (low, high))
    else:
        raise InputError("there must be a range with its unit or a scale without one")
    drift = None if entry.drift is None else _drift(entry.drift, parameters, si_unit)
    return Nuisance(entry.name, parameters, low, high, entry.scale is not None, entry.each, drift, entry.why)


def _values(entry: _NuisanceEntry, choices: tuple[str, ...], si_unit: str) -> tuple[float | str, ...]:
    """Return the values of a `NuisanceChoice`: of a choice as they are, of a number in SI."""
    for value in entry.values or ():
        if choices and value not in choices:
            raise InputError(f"values must be among {', '.join(choices)}, got {value!r}")
        if not choices and (isinstance(value, str) or entry.unit is None):
            raise InputError(f"values must be numbers with a unit, got {value!r}")
    if choices:
        return tuple(entry.values or ())
    return tuple(to_si(float(value), entry.unit or "", si_unit, name="values") for value in entry.values or ())


def _drift(entry: _DriftEntry, parameters: tuple[str, ...], si_unit: str) -> DriftRange:
    absolute = drifts_absolutely(parameters[0])
    for parameter in parameters:
        ParameterDrift(parameter, Linear(0.0, 1.0), absolute)
    low, high = (
        to_si(value, entry.unit, si_unit if absolute else "1", name="drift") for value in _pair(entry.size, "size")
    )
    falls = entry.oil != 1.0  # with the oil alone, which warms, it only rises
    if low < 0 or (not absolute and falls and high >= 1):
        raise InputError(f"size of the drift must be >= 0 and < 100 %, got {low:g} to {high:g}")
    if entry.shapes is not None and entry.oil is not None:
        raise InputError("the drift must have shapes or oil, got both")
    shapes = entry.shapes or (["linear", "wander"] if entry.oil is None else ["wander"])
    return DriftRange((low, high), absolute, tuple(shapes), float(entry.oil or 0.0))


def _duty(entry: _DutyEntry | None) -> Duty:
    assert entry is not None
    amplitude = _pair(entry.amplitude, "amplitude of [duty]")
    for text in entry.commands:
        command = command_or_target(text)
        if entry.controllers and not isinstance(command, Position):
            raise InputError(f"a controller must have a target to follow, got {text!r}")
        if amplitude != (1.0, 1.0) and not hasattr(command, "amplitude"):
            raise InputError(f"{text!r} has no amplitude to be drawn")
    for text in entry.loads:
        parse_force(text)
    closed = tuple(share / 100.0 for share in entry.closed)
    return Duty(tuple(entry.commands), closed, amplitude, entry.why, tuple(entry.loads), tuple(entry.controllers))
