"""Profiles of nuisances as files: how healthy machines differ, and how each changes within a record."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sealscope.errors import InputError
from sealscope.simulation.changes import Linear, ParameterDrift, drifts_absolutely
from sealscope.simulation.commands import parse_command
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
class Duty:
    """What the machines are asked for.

    One of `commands`, times a factor within `amplitude`, both throttles `closed` by one of these shares.
    """

    commands: tuple[str, ...]
    closed: tuple[float, ...]
    amplitude: tuple[float, float]
    why: str


@dataclass(frozen=True)
class Profile:
    """All nuisances of a kind of machines, and their duty."""

    name: str
    title: str
    duty: Duty
    nuisances: tuple[Nuisance, ...]
    place: str


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
    _known(tree, ("profile", "duty", "nuisance"), "a profile", place)
    head = tree.get("profile", {})
    _known(head, ("name", "title"), "[profile]", place)
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
    name, title = (_text(head, key, "[profile]", place) for key in ("name", "title"))
    return Profile(name, title, _duty(tree.get("duty"), place), nuisances, place)


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


def _nuisance(entry: Any, place: str) -> Nuisance:
    from sealscope.parameters import declared_names
    from sealscope.parameters.fields import choices_of, unit_of
    from sealscope.parameters.names import resolve
    from sealscope.parameters.rig import _declared
    from sealscope.units import to_si

    _known(entry, ("name", "parameters", "range", "unit", "scale", "each", "drift", "why"), "a nuisance", place)
    name = _text(entry, "name", "a nuisance", place)
    why = _text(entry, "why", name, place)
    given = entry.get("parameters")
    if not isinstance(given, list) or not given or not all(isinstance(item, str) for item in given):
        raise InputError(f"parameters of {name} must be a list of names, got {given!r} ({place})")
    try:
        parameters = tuple(resolve(item, declared_names()) for item in given)
    except InputError as error:
        raise InputError(f"{error} ({name}, {place})") from None
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
    if low < 0 or (not absolute and high >= 1):
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
    _known(table, ("commands", "closed", "amplitude", "why"), "[duty]", place)
    commands = table.get("commands")
    if not isinstance(commands, list) or not commands or not all(isinstance(item, str) for item in commands):
        raise InputError(f"commands of [duty] must be a list of texts, got {commands!r} ({place})")
    amplitude = _pair(table.get("amplitude", [1.0, 1.0]), "amplitude of [duty]", place)
    for text in commands:
        try:
            command = parse_command(text)
        except InputError as error:
            raise InputError(f"{error} ({place})") from None
        if amplitude != (1.0, 1.0) and not hasattr(command, "amplitude"):
            raise InputError(f"{text!r} has no amplitude to be drawn ({place})")
    closed = table.get("closed", [0])
    if not isinstance(closed, list) or not closed or not all(_percent(share) for share in closed):
        raise InputError(f"closed of [duty] must be a list of per cent, 0 to 99, got {closed!r} ({place})")
    shares = tuple(share / 100.0 for share in closed)
    return Duty(tuple(commands), shares, amplitude, _text(table, "why", "[duty]", place))


def _percent(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= 99
