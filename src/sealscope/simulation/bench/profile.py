"""Profiles of nuisances as files: how healthy machines differ, and how each changes within a record."""

from __future__ import annotations

import math
import os
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from sealscope.errors import InputError
from sealscope.simulation.changes import Linear, ParameterDrift, drifts_absolutely
from sealscope.simulation.courses import Position, command_or_target, parse_force
from sealscope.storage.toml_file import read_toml

_PACKAGED = Path(__file__).parent / "profiles"
_SHAPES = ("linear", "wander")


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
    """All nuisances of a kind of machines, and their duty; `families` of machines that depart from it."""

    name: str
    title: str
    duty: Duty
    nuisances: tuple[AnyNuisance, ...]
    place: str
    families: tuple[Family, ...] = field(default=(), repr=False)

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


def _profile(path: Path, place: str) -> Profile:
    tree = read_toml(path, "a profile", place)
    _known(tree, ("profile", "duty", "nuisance", "family"), "a profile", place)
    head = tree.get("profile", {})
    _known(head, ("name", "title", "extends"), "[profile]", place)
    base = None
    if "extends" in head:
        if head["extends"] not in profile_names():
            known = ", ".join(profile_names())
            raise InputError(f"extends must be a packaged profile ({known}), got {head['extends']!r} ({place})")
        base = load_profile(head["extends"])
    name, title = (_text(head, key, "[profile]", place) for key in ("name", "title"))
    duty = base.duty if base is not None and "duty" not in tree else _duty(tree.get("duty"), place)
    nuisances = _in_place(() if base is None else base.nuisances, _nuisances(tree, place))
    entries = tree.get("family", [])
    if not isinstance(entries, list):
        raise InputError(f"families must be [[family]] tables, got {entries!r} ({place})")
    families = tuple(_family(entry, place) for entry in entries)
    if len({family.name for family in families}) < len(families):
        raise InputError(f"families must have names of their own ({place})")
    return Profile(name, title, duty, nuisances, place, families)


def _family(entry: Any, place: str) -> Family:
    _known(entry, ("name", "why", "warms", "duty", "nuisance"), "a family", place)
    name = _text(entry, "name", "a family", place)
    why = _text(entry, "why", name, place)
    warms = entry.get("warms", False)
    if not isinstance(warms, bool):
        raise InputError(f"warms of {name} must be true or false, got {warms!r} ({place})")
    duty = _duty(entry["duty"], place) if "duty" in entry else None
    return Family(name, _nuisances(entry, place), duty, warms, why)


def _nuisances(tree: dict[str, Any], place: str) -> tuple[AnyNuisance, ...]:
    entries = tree.get("nuisance", [])
    if not isinstance(entries, list):
        raise InputError(f"nuisances must be [[nuisance]] tables, got {entries!r} ({place})")
    nuisances = tuple(_nuisance(entry, place) for entry in entries)
    owner: dict[str, str] = {}
    for nuisance in nuisances:
        for parameter in nuisance.parameters:
            if owner.setdefault(parameter, nuisance.name) != nuisance.name:
                raise InputError(
                    f"{parameter} must be in one nuisance, got {owner[parameter]} and {nuisance.name} ({place})"
                )
    if len({nuisance.name for nuisance in nuisances}) < len(nuisances):
        raise InputError(f"nuisances must have names of their own ({place})")
    return nuisances


def _known(table: Any, keys: tuple[str, ...], what: str, place: str) -> None:
    if not isinstance(table, dict):
        raise InputError(f"{what} must be a table, got {table!r} ({place})")
    for key in table:
        if key not in keys:
            raise InputError(f"{key} is not known in {what}, which has {', '.join(keys)} ({place})")


def _text(table: dict[str, Any], key: str, what: str, place: str) -> str:
    value = table.get(key)
    if not isinstance(value, str) or not value.strip():
        raise InputError(f"{key} of {what} must be a text, got {value!r} ({place})")
    return value


def _pair(value: Any, what: str, place: str) -> tuple[float, float]:
    numbers = isinstance(value, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    if not (numbers and len(value) == 2 and all(map(math.isfinite, value)) and value[0] <= value[1]):
        raise InputError(f"{what} must be [low, high] with low <= high, got {value!r} ({place})")
    return float(value[0]), float(value[1])


def _nuisance(entry: Any, place: str) -> AnyNuisance:
    from sealscope.parameters import declared_names
    from sealscope.parameters.fields import choices_of, unit_of
    from sealscope.parameters.names import resolve
    from sealscope.parameters.rig import _declared
    from sealscope.units import to_si

    _known(
        entry, ("name", "parameters", "range", "unit", "scale", "values", "each", "drift", "why"), "a nuisance", place
    )
    name = _text(entry, "name", "a nuisance", place)
    why = _text(entry, "why", name, place)
    given = entry.get("parameters")
    if not isinstance(given, list) or not given or not all(isinstance(item, str) for item in given):
        raise InputError(f"parameters of {name} must be a list of names, got {given!r} ({place})")
    try:
        parameters = tuple(resolve(item, declared_names()) for item in given)
    except InputError as error:
        raise InputError(f"{error} ({name}, {place})") from None
    if "values" in entry:
        return NuisanceChoice(name, parameters, _values(entry, name, parameters, place), why)
    fields = [_declared()[parameter] for parameter in parameters]
    if choice := next(
        (parameter for parameter, field in zip(parameters, fields, strict=True) if choices_of(field)), None
    ):
        raise InputError(f"{choice} is a choice and cannot be drawn from a range ({name}, {place})")
    scales = "scale" in entry
    if scales == ("range" in entry) or (scales and "unit" in entry):
        raise InputError(f"{name} must have a range with its unit or a scale without one ({place})")
    low, high = _pair(entry["scale" if scales else "range"], f"{'scale' if scales else 'range'} of {name}", place)
    units = {unit_of(field) for field in fields}
    if not scales:
        if len(units) > 1:
            got = ", ".join(sorted(units))
            raise InputError(f"parameters of one range must have one unit, got {got} ({name}, {place})")
        unit = _text(entry, "unit", name, place)
        low, high = (to_si(value, unit, next(iter(units)), name=name, place=place) for value in (low, high))
    elif low <= 0:
        raise InputError(f"scale of {name} must be > 0, got {low:g} ({place})")
    each = entry.get("each", False)
    if not isinstance(each, bool):
        raise InputError(f"each of {name} must be true or false, got {each!r} ({place})")
    drift = None if "drift" not in entry else _drift(entry["drift"], name, parameters, place)
    return Nuisance(name, parameters, low, high, scales, each, drift, why)


def _values(entry: dict[str, Any], name: str, parameters: tuple[str, ...], place: str) -> tuple[float | str, ...]:
    """Return the values of a `NuisanceChoice`: of a choice as they are, of a number in SI."""
    from sealscope.parameters.fields import choices_of, unit_of
    from sealscope.parameters.rig import _declared
    from sealscope.units import to_si

    _known(entry, ("name", "parameters", "values", "unit", "why"), "a nuisance with values", place)
    given = entry["values"]
    fields = [_declared()[parameter] for parameter in parameters]
    allowed = {choices_of(field) for field in fields}
    units = {unit_of(field) for field in fields}
    if len(allowed) > 1 or len(units) > 1:
        raise InputError(f"parameters of one list of values must be of one kind and unit ({name}, {place})")
    choices = next(iter(allowed))
    if not isinstance(given, list) or not given:
        raise InputError(f"values of {name} must be a list of one or more, got {given!r} ({place})")
    if choices:
        for value in given:
            if value not in choices:
                raise InputError(f"values of {name} must be among {', '.join(choices)}, got {value!r} ({place})")
        return tuple(given)
    for value in given:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"values of {name} must be numbers, got {value!r} ({place})")
    unit = _text(entry, "unit", name, place)
    return tuple(to_si(float(value), unit, next(iter(units)), name=name, place=place) for value in given)


def _drift(table: Any, name: str, parameters: tuple[str, ...], place: str) -> DriftRange:
    from sealscope.parameters.fields import unit_of
    from sealscope.parameters.rig import _declared
    from sealscope.units import to_si

    _known(table, ("size", "unit", "shapes", "oil"), f"the drift of {name}", place)
    low, high = _pair(table.get("size"), f"size of the drift of {name}", place)
    unit = _text(table, "unit", f"the drift of {name}", place)
    try:
        absolute = drifts_absolutely(parameters[0])
        for parameter in parameters:
            ParameterDrift(parameter, Linear(0.0, 1.0), absolute)
    except InputError as error:
        raise InputError(f"{error} ({name}, {place})") from None
    si_unit = unit_of(_declared()[parameters[0]]) if absolute else "1"
    low, high = (to_si(value, unit, si_unit, name=f"drift of {name}", place=place) for value in (low, high))
    falls = table.get("oil") != 1.0  # with the oil alone, which warms, it only rises
    if low < 0 or (not absolute and falls and high >= 1):
        raise InputError(f"size of the drift of {name} must be >= 0 and < 100 %, got {low:g} to {high:g} ({place})")
    if "shapes" in table and "oil" in table:
        raise InputError(f"the drift of {name} must have shapes or oil, got both ({place})")
    shapes = table.get("shapes", ["wander"] if "oil" in table else list(_SHAPES))
    if not isinstance(shapes, list) or not shapes or any(shape not in _SHAPES for shape in shapes):
        raise InputError(f"shapes of the drift of {name} must be of {', '.join(_SHAPES)}, got {shapes!r} ({place})")
    oil = table.get("oil", 0.0)
    if isinstance(oil, bool) or not isinstance(oil, int | float) or not -1 <= oil <= 1:
        raise InputError(f"oil of {name} must be a weight in -1..1, got {oil!r} ({place})")
    return DriftRange((low, high), absolute, tuple(shapes), float(oil))


def _duty(table: Any, place: str) -> Duty:
    if table is None:
        raise InputError(f"a profile must have [duty], got none ({place})")
    _known(table, ("commands", "closed", "amplitude", "loads", "controllers", "why"), "[duty]", place)
    commands = _texts(table, "commands", place)
    amplitude = _pair(table.get("amplitude", [1.0, 1.0]), "amplitude of [duty]", place)
    for text in commands:
        try:
            command = command_or_target(text)
        except InputError as error:
            raise InputError(f"{error} ({place})") from None
        if "controllers" in table and not isinstance(command, Position):
            raise InputError(f"a controller must have a target to follow, got {text!r} ({place})")
        if amplitude != (1.0, 1.0) and not hasattr(command, "amplitude"):
            raise InputError(f"{text!r} has no amplitude to be drawn ({place})")
    closed = table.get("closed", [0])
    if not isinstance(closed, list) or not closed or not all(_percent(share) for share in closed):
        raise InputError(f"closed of [duty] must be a list of per cent, 0 to 99, got {closed!r} ({place})")
    shares = tuple(share / 100.0 for share in closed)
    why = _text(table, "why", "[duty]", place)
    loads, controllers = (_texts(table, key, place) if key in table else () for key in ("loads", "controllers"))
    for text in loads:
        try:
            parse_force(text)
        except InputError as error:
            raise InputError(f"{error} ({place})") from None
    return Duty(commands, shares, amplitude, why, loads, controllers)


def _texts(table: dict[str, Any], key: str, place: str) -> tuple[str, ...]:
    given = table.get(key)
    if not isinstance(given, list) or not given or not all(isinstance(item, str) for item in given):
        raise InputError(f"{key} of [duty] must be a list of texts, got {given!r} ({place})")
    return tuple(given)


def _percent(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= 99
