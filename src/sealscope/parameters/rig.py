"""The Rig: all parameters of one machine, immutable, each number in SI with its unit and source.

Rigs are loaded from TOML files: packaged ones by their names, and a user's own, each of which may extend another.
"""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache, lru_cache
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
from pydantic import PrivateAttr, model_validator
from pydantic.fields import FieldInfo

from sealscope.calls import checked_call, suggestion
from sealscope.errors import InputError
from sealscope.parameters.fields import Part, PartsDisagreeError, absent_of, choices_of, iter_fields, unit_of, with_unit
from sealscope.parameters.parts import (
    CIRCUITS,
    Cylinder,
    Daq,
    Fluid,
    Friction,
    HydraulicCircuit,
    HydraulicLine,
    MakeUp,
    Motor,
    Pump,
    Sensors,
    ServoValve,
    Supply,
)
from sealscope.storage.atomic import atomic_write
from sealscope.storage.opening import is_file_path
from sealscope.storage.toml_file import read_toml
from sealscope.units import parse_quantity, to_si

Value = float | int | str
P = TypeVar("P", bound=Part)
#: Prefix of the source of a value that is not stated for this machine.
ASSUMED = "assumed:"
GAS_OVER_ROD = 5.0  # volume of an accumulator's gas, divided by that of the oil that the rod displaces in a stroke
#: Names of parameters in textbooks and other programs, in lower case and without underscores.
_OTHER_NAMES = {
    **dict.fromkeys(("beta", "betae", "bulkmodulus"), "fluid.K_oil"),
    **dict.fromkeys(("ap", "area", "pistonarea"), "cylinder.A_A"),
    **dict.fromkeys(("m", "mass"), "cylinder.M_eq"),
    **dict.fromkeys(("dp", "displacement"), "pump.q_b"),
    **dict.fromkeys(("kt", "torqueconstant"), "motor.C_m"),
    **dict.fromkeys(("stroke", "strokelength"), "cylinder.L"),
}


class ParameterEntry(NamedTuple):
    """A parameter as stated: value, unit ("" for a choice), source, and the file or option that states it."""

    value: Value
    unit: str
    source: str
    place: str

    def text(self) -> str:
        """Format the parameter's value and unit as they were stated, without the unit "1"."""
        return str(self.value) if self.unit in ("", "1") else f"{self.value} {self.unit}"


class ParameterRow(NamedTuple):
    """A row of the table of a rig's parameters."""

    symbol: str
    name: str
    meaning: str
    value: Value  # in the SI unit `unit`
    unit: str
    text: str  # value and unit, as the rig's file or an override states them
    source: str


class Rig(Part):
    """Parameters of one actuator, immutable; `load_rig` reads them, `with_overrides` returns a changed copy.

    Numbers are SI doubles: `rig.motor.R_c` [ohm], `rig.sensors.p_A.noise` [Pa]. Two rigs are equal if all their
    numbers and choices are equal, even if these were stated in other units or have other sources.

    Parameters
    ----------
    motor : Motor
        Servo motor with its speed loop.
    pump : Pump
        Bidirectional pump of fixed displacement.
    line : HydraulicLine
        Lines between pump and cylinder, and the throttles in them.
    cylinder : Cylinder
        Piston, chambers, end stops and load.
    friction : Friction
        Friction of the piston, by one of three laws.
    fluid : Fluid
        Oil, the air in it, and the charge pressure.
    makeup : MakeUp
        Accumulator with check and relief valves.
    valve : ServoValve
        Servo valve, or none.
    supply : Supply
        Supply of the servo valve.
    sensors : Sensors
        Every sensor, by the name of its channel.
    daq : Daq
        Data acquisition: rate, resolution, range.

    Raises
    ------
    InputError
        A rule on several parameters is broken.

    Examples
    --------
    >>> import sealscope as ss
    >>> rig = ss.load_rig("thesis").with_overrides({"V_1": "50[cm^3]"}, source="hose 8 mm x 1 m, measured")
    >>> rig.line.V_1, rig["V_1"], rig.entry("V_1").source
    (5e-05, 5e-05, 'hose 8 mm x 1 m, measured')
    >>> rig == ss.load_rig("thesis"), rig.entry("cylinder.L").source
    (False, 'Table 4.1; section 2.4 d (60 cm)')
    """

    motor: Motor
    pump: Pump
    line: HydraulicLine
    cylinder: Cylinder
    friction: Friction
    fluid: Fluid
    makeup: MakeUp
    valve: ServoValve
    supply: Supply
    sensors: Sensors
    daq: Daq
    _name: str = PrivateAttr(default="")
    _title: str = PrivateAttr(default="")
    _entries: tuple[tuple[str, ParameterEntry], ...] = PrivateAttr(default=())
    _channel_map: tuple[tuple[str, str], ...] = PrivateAttr(default=())

    @model_validator(mode="after")
    def _check_parts(self) -> Self:
        """Raise ValueError, as pydantic requires, if a rule that relates several parameters is broken."""
        cylinder, makeup, friction = self.cylinder, self.makeup, self.friction
        V, V_rod = cylinder.V, cylinder.V_rod
        if V_rod >= V:
            raise ValueError(f"cylinder.V_rod must be < V = {with_unit(V, 'm^3')}, got {with_unit(V_rod, 'm^3')}")
        sides = (("A_A", V), ("A_B", V - V_rod)) if cylinder.volumes == "position" else ()
        for symbol, volume in sides:
            swept = getattr(cylinder, symbol) * cylinder.L / 2.0
            if swept >= volume:
                rule = f'must be > {symbol} L/2 = {with_unit(swept, "m^3")} when volumes = "position"'
                # `volume` is less than V only if it is V - V_rod; this is shown rounded, V in SI without rounding
                text, value = ("V - V_rod", with_unit(volume, "")) if volume < V else ("V", str(volume))
                raise ValueError(f"cylinder.{text} {rule}, got {value}")
        if makeup.G_relief > 0 and makeup.check_valves == "absent":
            raise ValueError(
                f"makeup.G_relief = {makeup.G_relief:g} m^3/(s Pa): relief valves must have an accumulator to open "
                "into (makeup.check_valves = present or pilot-operated), got check_valves = absent"
            )
        self._check_circuit()
        self._check_lines()
        displaced_volume = abs(cylinder.A_A - cylinder.A_B) * cylinder.L
        if makeup.check_valves == "pilot-operated" and makeup.V_gas <= displaced_volume:
            raise ValueError(
                f"makeup.V_gas must be > the oil that the rod displaces over the stroke, |A_A - A_B| L = "
                f"{with_unit(displaced_volume, 'm^3')}, got {with_unit(makeup.V_gas, 'm^3')}"
            )
        if friction.law != "stribeck" and (friction.coulomb_pressure != "sum" or friction.F_pr <= 0):
            raise ValueError(
                f'friction.law = "{friction.law}" must have coulomb_pressure = "sum" and F_pr > 0, so that its force '
                f"is > 0, got {friction.coulomb_pressure} and {with_unit(friction.F_pr, 'N')}"
            )
        return self

    def _check_circuit(self) -> None:
        """Raise ValueError unless parameters have the values that the circuit and a servo valve's supply require."""
        supply, circuit = self.supply, self.circuit
        for name, required in circuit.required.items():
            value = attrgetter(name)(self)
            if value != required:
                raise ValueError(f"a rig that is {circuit} must have {name} = {required}, got {value}")
        if supply.drive == "absent":
            return
        if self.motor.K_i <= 0:
            raise ValueError(
                f"motor.K_i must be > 0 V/rad where the motor holds the speed of a supply, got {self.motor.K_i:g}"
            )
        if supply.V_acc > 0 and supply.p_pre >= supply.p_set + supply.p_return:
            raise ValueError(
                f"supply.p_pre must be < p_set + p_return = {with_unit(supply.p_set + supply.p_return, 'Pa')}, so that "
                f"the accumulator takes oil, got {with_unit(supply.p_pre, 'Pa')}"
            )

    def _check_lines(self) -> None:
        """Raise ValueError for a valve or filter without the part that it needs, or for conflicting viscosities."""
        line, oil = self.line, self.fluid
        # `absent`: the value of a rig without such a valve or filter
        for name, absent in (("open_A", 1.0), ("open_B", 1.0), ("R_A", 0.0), ("R_B", 0.0)):
            if getattr(line, name) != absent and line.orifices == "absent":
                raise ValueError(
                    f"a {'filter' if absent == 0.0 else 'shut-off valve'} must be in a line (line.orifices = present), "
                    f"got line.{name} = {getattr(line, name):g} and line.orifices = absent"
                )
        R_A, R_B = line.R_A, line.R_B
        for name, R_name, R in (
            ("k_clog_A", "R_A", R_A),
            ("k_clog_B", "R_B", R_B),
            ("G_bypass", "R_A or R_B", max(R_A, R_B)),
        ):
            if getattr(line, name) > 0.0 and R == 0.0:
                raise ValueError(
                    f"line.{name} must belong to a filter ({R_name} > 0), got line.{name} = "
                    f"{getattr(line, name):g} and none"
                )
        if not oil.nu_100 < oil.nu_40:
            raise ValueError(
                f"fluid.nu_100 must be < nu_40 = {with_unit(oil.nu_40, 'm^2/s')}: oil thins as it warms, got "
                f"{with_unit(oil.nu_100, 'm^2/s')}"
            )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Rig):
            return NotImplemented
        return all(getattr(self, part) == getattr(other, part) for part in Rig.model_fields)

    def __hash__(self) -> int:
        return hash(tuple(getattr(self, part) for part in Rig.model_fields))

    def __repr__(self) -> str:
        # sources of values set by a caller, an option or a plan; those that describe a measurement are not counted
        n_overrides = sum(entry.source.startswith("set by") for _, entry in self._entries)
        overridden = f", {n_overrides} overridden" if n_overrides else ""
        return f"<Rig {self._name}: {self._title or 'no title'}, {len(self._entries)} parameters{overridden}>"

    __str__ = __repr__

    @property
    def name(self) -> str:
        """Name of the rig."""
        return self._name

    @property
    def title(self) -> str:
        """Description of the rig in words."""
        return self._title

    @property
    def circuit(self) -> HydraulicCircuit:
        """Hydraulic circuit of the rig, i.e. the first of `CIRCUITS` that a parameter of the rig chooses."""
        return next(circuit for circuit in CIRCUITS if attrgetter(circuit.parameter)(self) == circuit.value)

    @property
    def channel_map(self) -> dict[str, str]:
        """Mapping from channel to column of this machine's logs; empty if its file has no table `[map]`."""
        return dict(self._channel_map)

    def with_channel_map(self, columns: Mapping[str, str]) -> Rig:
        """Return the same rig with another map from channel to column of the machine's logs."""
        rig = self.model_copy()
        rig._channel_map = tuple(columns.items())
        return rig

    def __getitem__(self, name: str) -> Value:
        """Return the SI value of a parameter; `name`: its symbol, if that is unique, or its dotted name."""
        value: Any = self
        for symbol in resolve_name(name).split("."):
            value = getattr(value, symbol)
        return value  # type: ignore[no-any-return]

    def entry(self, name: str) -> ParameterEntry:
        """Return the value, unit and source stated for a parameter; `name`: its symbol or its dotted name."""
        return self._stated_entries()[resolve_name(name)]

    def states(self, *names: str) -> bool:
        """Test whether all the named parameters are stated for this machine, i.e. have no source `assumed: ...`."""
        return not any(self.entry(name).source.startswith(ASSUMED) for name in names)

    def as_assumed(self, reason: str) -> Rig:
        """Return the same rig with all values marked as assumed; `reason` becomes part of the values' sources."""
        entries = {name: entry._replace(source=f"{ASSUMED} {reason}") for name, entry in self._stated_entries().items()}
        return self._with_entries(entries, self._name)

    def _with_entries(self, entries: Mapping[str, ParameterEntry], place: str) -> Rig:
        """Build a rig from other entries, stated in `place`, with this rig's name, title and channel map."""
        rig = Rig.from_entries(entries, name=self._name, title=self._title, place=place)
        return rig.with_channel_map(self.channel_map)

    def _stated_entries(self) -> dict[str, ParameterEntry]:
        """Return the entries of all parameters by dotted name; raise InputError for a rig built from values alone."""
        if not self._entries:
            raise InputError("a rig must have sources; make it with load_rig or Rig.from_entries, not from bare parts")
        return dict(self._entries)

    def with_overrides(self, overrides: Mapping[str, Value], *, source: str = "set by caller") -> Rig:
        """Return another rig with some values replaced, each of them with the source `source`.

        `overrides`: mapping from name to value. The name may be the bare symbol if that is unique (`V_1`), else it is
        dotted (`sensors.p_A.noise`). A number is in SI; a text states its unit (`"0.8[ohm]"`, `"50 %"`) or is the value
        of a choice. Raises InputError for an unknown or ambiguous name, a parameter that is named twice, a wrong unit,
        a value out of range or a blank `source`.
        """
        if not source.strip():
            raise InputError("source must not be blank")
        entries = self._stated_entries()
        names_by_parameter: dict[str, str] = {}  # dotted name -> name that the caller wrote
        for name, value in overrides.items():
            full_name = resolve_name(name)
            if full_name in names_by_parameter:
                raise InputError(f"{full_name} must be set once, got {names_by_parameter[full_name]} and {name}")
            names_by_parameter[full_name] = name
            # the last argument: errors state the source as the place of the value
            entries[full_name] = _make_entry(full_name, value, source, source)
        return self._with_entries(entries, source)

    def with_areas(self, A_A: float, A_B: float, *, source: str) -> Rig:
        """Return the same rig with other piston areas [m^2] from `source`, and with volumes that suit these areas.

        Chamber volumes that depend on the position are computed anew, with a dead volume that is scaled with the larger
        area. The gas of an accumulator is scaled likewise, and is at least `GAS_OVER_ROD` times the oil that the rod
        displaces in a stroke. These values are marked as assumed.
        """
        entries, cylinder = self._stated_entries(), self.cylinder
        scale = max(A_A, A_B) / max(cylinder.A_A, cylinder.A_B)
        scaled_values: dict[str, float] = {}
        if cylinder.volumes == "position":
            dead_volume = cylinder.V - 0.5 * max(cylinder.A_A, cylinder.A_B) * cylinder.L  # > 0 by `_check_parts`
            scaled_values["cylinder.V"] = 0.5 * max(A_A, A_B) * cylinder.L + scale * dead_volume
            scaled_values["cylinder.V_rod"] = max(0.5 * (A_A - A_B) * cylinder.L, 0.0)  # 0 if the rod is on side A
        if self.makeup.check_valves != "absent":
            min_gas = GAS_OVER_ROD * abs(A_A - A_B) * cylinder.L
            scaled_values["makeup.V_gas"] = max(scale * self.makeup.V_gas, min_gas)
        assumed = f"{ASSUMED} that of {self._name}, scaled with the area"
        for full_name, value in scaled_values.items():
            entries[full_name] = _make_entry(full_name, value, assumed, source)
        for full_name, value in (("cylinder.A_A", A_A), ("cylinder.A_B", A_B)):
            entries[full_name] = _make_entry(full_name, value, source, source)
        return self._with_entries(entries, source)

    def table(self) -> list[ParameterRow]:
        """List all parameters as rows of a table, in the order of their declaration."""
        entries = self._stated_entries()
        return [
            ParameterRow(
                symbol=name.rpartition(".")[2],
                name=name,
                meaning=str(field.title),
                value=self[name],
                unit=unit_of(field),
                text=entries[name].text(),
                source=entries[name].source,
            )
            for name, field in declared_fields().items()
        ]

    def present_values(self) -> dict[str, Value]:
        """Return the SI values of the parameters whose part or effect is in the model, by dotted name.

        `absent` values, such as the volume 0 of a hose, are left out. The result thus identifies a machine across
        versions of the package, as a parameter that a later version adds is absent in older rigs.
        """
        return {name: self[name] for name, field in declared_fields().items() if self[name] != absent_of(field)}

    def as_dict(self) -> dict[str, Any]:
        """Convert the rig, without channel map, to nested values: `{"motor": {"R_c": {"value": 0.73, ...}}, ...}`."""
        tree: dict[str, Any] = {"rig": {"name": self._name, "title": self._title}}
        for name, entry in self._stated_entries().items():
            *groups, symbol = name.split(".")
            node = tree
            for group in groups:
                node = node.setdefault(group, {})
            unit = {} if entry.unit == "" else {"unit": entry.unit}
            node[symbol] = {"value": entry.value, **unit, "source": entry.source}
        return tree

    @classmethod
    def from_dict(cls, tree: Mapping[str, Any], *, place: str) -> Rig:
        """Build the rig from the values of `as_dict`; raise InputError for invalid values, stating their `place`."""
        table = tree.get("rig")
        name, title = (table.get("name", ""), table.get("title", "")) if isinstance(table, Mapping) else ("", "")
        parts = ((key, item) for key, item in tree.items() if key != "rig")
        return cls.from_entries(flatten_entries(parts, place), name=str(name), title=str(title), place=place)

    @classmethod
    def from_entries(cls, entries: Mapping[str, ParameterEntry], *, name: str, title: str = "", place: str) -> Rig:
        """Build a rig from the entries of its parameters by dotted name; `place`: where they come from, for messages.

        A parameter without an entry gets its `absent` value. Raises InputError if it has no such value, or if an entry
        has a wrong value.
        """
        complete_entries: dict[str, ParameterEntry] = {}
        for full_name, field in declared_fields().items():
            entry = entries.get(full_name)
            if entry is None:
                value = absent_of(field)
                if value is None:
                    raise InputError(f"{full_name} is missing ({place})")
                entry = ParameterEntry(value, unit_of(field), "absent from the model: not stated", place)
            complete_entries[full_name] = entry
        rig = _build_part(cls, "", complete_entries, place)
        rig._name, rig._title, rig._entries = name, title, tuple(complete_entries.items())
        return rig


@cache
def declared_fields() -> dict[str, FieldInfo]:
    """Return the declarations (pydantic fields) of all parameters of a rig by dotted name, in order."""
    return dict(iter_fields(Rig))


@cache
def declared_names() -> tuple[str, ...]:
    """List the dotted names of all parameters, in the order of declaration."""
    return tuple(declared_fields())


def resolve_name(name: str) -> str:
    """Find the dotted name of a parameter from its end, such as `V_1` or `p_A.noise`, or from the dotted name itself.

    Raises InputError if no parameter has the name, or if several have it. The error for a name that is usual in other
    programs (`_OTHER_NAMES`) suggests the parameter.
    """
    names = declared_names()
    if name in names:
        return name
    matches = [full_name for full_name in names if full_name.endswith("." + name)] if name else []
    if len(matches) == 1:
        return matches[0]
    if matches:
        listed_names = ", ".join(matches[:6]) + (", ..." if len(matches) > 6 else "")
        raise InputError(f"parameter {name} is not unique, give one of {listed_names}")
    if synonym := _OTHER_NAMES.get(name.casefold().replace("_", "").replace(" ", "")):
        raise InputError(f"{name!r} is not a parameter; did you mean {synonym}?")
    symbols = dict.fromkeys(full_name.rpartition(".")[2] for full_name in names)
    raise InputError(f"{name!r} is not a parameter{suggestion(name, names if '.' in name else symbols)}")


def parse_overrides(texts: Sequence[str]) -> dict[str, str]:
    """Parse overrides `NAME=VALUE[unit]`, as typed on a command line, to a mapping from `NAME` to `VALUE[unit]`.

    Raises InputError for a text of another form, or for a name with two different values.
    """
    overrides: dict[str, str] = {}
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        if not (name and value):
            raise InputError(f"an override must be NAME=VALUE or NAME=VALUE[unit], got {text!r}")
        if overrides.setdefault(name, value) != value:
            raise InputError(f"{name} must be set once, got {overrides[name]} and {value}")
    return overrides


def _build_part(model: type[P], path: str, entries: Mapping[str, ParameterEntry], place: str) -> P:
    """Build a part of a rig, such as its pump, from the entries of its parameters.

    `path`: beginning of the dotted names of its parameters, such as "pump.", empty for the whole rig. Raises InputError
    for an invalid value, with the place that states it, or with `place` if a rule on several parameters is broken.
    """
    values: dict[str, Any] = {}
    for symbol, field in model.model_fields.items():
        field_type = field.annotation
        if isinstance(field_type, type) and issubclass(field_type, Part):
            values[symbol] = _build_part(field_type, f"{path}{symbol}.", entries, place)
        else:
            values[symbol] = _si_value(path + symbol, field, entries[path + symbol])
    try:
        return model(**values)
    except InputError as error:
        text = str(error)
        wrong_parameter = path + text.split(maxsplit=1)[0]  # a message of `Part` begins with the symbol
        wrong_place = place if isinstance(error, PartsDisagreeError) else entries[wrong_parameter].place
        # without a `path` the rule is one of `Rig`, whose messages contain dotted names
        raise InputError(f"{_qualify_symbol(wrong_parameter, text) if path else text} ({wrong_place})") from None


def _qualify_symbol(full_name: str, text: str) -> str:
    """Replace the symbol at the beginning of a message by the parameter's dotted name, unless the symbol is unique."""
    symbol = full_name.rpartition(".")[2]
    return text if _symbol_counts()[symbol] <= 1 else full_name + text[len(symbol) :]


@cache
def _symbol_counts() -> Counter[str]:
    """Count the parameters that have each symbol."""
    return Counter(name.rpartition(".")[2] for name in declared_names())


@cache
def _short_name(full_name: str) -> str:
    """Return the symbol of a parameter if no other parameter has the same symbol, else its dotted name."""
    return _qualify_symbol(full_name, full_name.rpartition(".")[2])


def _si_value(full_name: str, field: FieldInfo, entry: ParameterEntry) -> Value:
    """Convert the entry of a parameter to a number in SI, or to the value of a choice.

    Raises InputError for a wrong type or unit, a number that is not finite, an unknown option, or no source.
    """
    short_name, place = _short_name(full_name), entry.place
    if not isinstance(entry.source, str) or not entry.source.strip():
        raise InputError(f"{short_name} must have a source, got none ({place})")
    if allowed := choices_of(field):
        if entry.value not in allowed:
            raise InputError(f"{short_name} must be one of {', '.join(allowed)}, got {entry.value!r} ({place})")
        if entry.unit:
            raise InputError(f"{short_name} is a choice and must have no unit, got {entry.unit!r} ({place})")
        return entry.value
    if isinstance(entry.value, bool) or not isinstance(entry.value, int | float):
        raise InputError(f"{short_name} must be a number, got {entry.value!r} ({place})")
    si_unit = unit_of(field)
    if not entry.unit:
        raise InputError(f"{short_name} must have a unit, such as {si_unit}, got none ({place})")
    try:
        number = to_si(float(entry.value), entry.unit, si_unit, name=short_name, place=place)
    except OverflowError:  # an integer beyond the largest double
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{short_name} must be finite, got {entry.value} ({place})")
    # strict models of pydantic refuse floats for an int: a whole number is converted here, any other refused there
    return int(number) if field.annotation is int and number.is_integer() else number


def _make_entry(full_name: str, value: Any, source: str, place: str) -> ParameterEntry:
    """Make the entry of a parameter's new value: a number in SI with its unit, or an option of a choice, without unit.

    `value`: a number in SI, a text with a unit such as "50[cm^3]", or an option. Raises InputError for a text that is
    not a quantity of the parameter's dimension; range and options are checked later.
    """
    field = declared_fields()[full_name]
    unit = unit_of(field)
    if choices_of(field):
        value = value.strip() if isinstance(value, str) else value
    elif isinstance(value, str):
        value = parse_quantity(value, unit, name=_short_name(full_name), place=place)
    elif isinstance(value, np.generic):  # NumPy's integers and single-precision numbers are no int and no float
        value = value.item()
    return ParameterEntry(value, unit, source, place)


def flatten_entries(tree: Iterable[tuple[str, Any]], place: str, prefix: str = "") -> dict[str, ParameterEntry]:
    """Flatten nested tables `{group: {symbol: {value, unit, source}}}` to entries by dotted name.

    `tree`: pairs of key and table. Raises InputError for an unknown name or an invalid entry.
    """
    entries: dict[str, ParameterEntry] = {}
    for key, item in tree:
        full_name = prefix + key
        if full_name in declared_fields():
            entries[full_name] = _parse_entry(full_name, item, place)
        elif isinstance(item, dict) and "value" not in item:
            entries |= flatten_entries(item.items(), place, full_name + ".")
        else:
            raise InputError(f"{full_name} is not a parameter{suggestion(full_name, declared_names())} ({place})")
    return entries


def _parse_entry(full_name: str, item: Any, place: str) -> ParameterEntry:
    """Check the form of a parameter's table, and make its entry of value, unit and source.

    Raises InputError if the table is wrong. Nothing is converted (`_si_value` does that); a missing unit or source
    becomes "".
    """
    short_name = _short_name(full_name)
    if not isinstance(item, dict):
        raise InputError(f"{short_name} must be {{ value = ..., unit = ..., source = ... }}, got {item!r} ({place})")
    if unknown := sorted(set(item) - {"value", "unit", "source"}):
        raise InputError(f"{short_name} must have value, unit and source only, got {unknown[0]} ({place})")
    if "value" not in item:
        raise InputError(f"{short_name} must have a value, got none ({place})")
    for key in ("unit", "source"):
        if not isinstance(item.get(key, ""), str):
            raise InputError(f"{key} of {short_name} must be a text, got {item[key]!r} ({place})")
    return ParameterEntry(item["value"], item.get("unit", ""), item.get("source", ""), place)


_PACKAGED = Path(__file__).parent / "rigs"
_MAX_LAYERS = 8
_MAP = "[map]"
#: Tables in the file of a commissioned machine in addition to its rig.
MACHINE_TABLES = ("machine", "learnt", "healthy", "alarms")


def rig_names() -> tuple[str, ...]:
    """List the names of the packaged rigs."""
    return tuple(sorted(path.stem for path in _PACKAGED.glob("*.toml")))


@checked_call
def rigs() -> tuple[str, ...]:
    """Return the names of the packaged rigs, which `load_rig` loads.

    Returns
    -------
    tuple of str
        In alphabetical order.

    Examples
    --------
    >>> import sealscope as ss
    >>> "thesis" in ss.rigs()
    True
    """
    return rig_names()


@checked_call
def load_rig(rig: Rig | str | os.PathLike[str] = "thesis") -> Rig:
    """Load the parameters of a rig.

    Parameters
    ----------
    rig : Rig, str or path-like, optional
        Name of a packaged rig, or path of a TOML file with value, unit and source for each parameter; a Rig is
        returned as it is. The command `sealscope parameters NAME` prints the parameters of a rig. A file may say
        ``[rig] extends = "thesis"`` (or the path of another file) and then states only the values that differ. A
        table ``[map]`` names the columns of the machine's logs (``p_A = "PG_1[psi]"``). The file that commissioning
        writes for a machine can be loaded, too, if it states an area.

    Returns
    -------
    Rig
        The parameters, immutable, in SI units.

    Raises
    ------
    InputError
        The file cannot be read, a name is unknown, or a value has no source, a wrong unit or is out of its range.

    Examples
    --------
    >>> import sealscope as ss
    >>> rig = ss.load_rig("thesis")
    >>> rig["cylinder.L"]
    0.6
    >>> ss.load_rig(rig) is rig
    True
    """
    if isinstance(rig, Rig):
        return rig
    if not isinstance(rig, str | os.PathLike):
        raise InputError(f"rig must be a Rig, the name of a rig or a path, got {rig!r}")
    text = os.fspath(rig)
    if text in rig_names():
        return _load_packaged(text)
    if "\0" in text or not _is_path(text):
        raise InputError(
            f"{text!r} is no packaged rig ({', '.join(rig_names())}) and no .toml file{suggestion(text, rig_names())}"
        )
    return _load_file(Path(text), text)


@lru_cache(maxsize=32)
def _load_packaged(name: str) -> Rig:
    """Load a packaged rig by its name; later calls return the same object."""
    return _load_file(_PACKAGED / f"{name}.toml", f"rigs/{name}.toml")


def _is_path(text: str) -> bool:
    """Test whether a text is a rig file's path: it ends in .toml, contains a slash, or names an existing file."""
    return text.endswith(".toml") or "/" in text or os.sep in text or is_file_path(text)


def _load_file(path: Path, place: str) -> Rig:
    """Load a rig from its file, called `place` in messages, and from the files that this one extends."""
    rig_table, entries, columns = _read_layers(path, place, visited=())
    name, title = rig_table.get("name", path.stem), rig_table.get("title", "")
    rig = Rig.from_entries(entries, name=name, title=title, place=place)
    return rig.with_channel_map(columns) if columns else rig


def save_channel_map(path: str | os.PathLike[str], columns: Mapping[str, str]) -> None:
    """Write the map `columns`, channel -> column, into a rig's file as its table `[map]`, in place of an earlier one.

    Raises InputError if `path` is not the file of a rig or cannot be written; the file is then unchanged.
    """
    if os.fspath(path) in rig_names():
        raise InputError(f"a map must be saved in your own rig's file (.toml), got the packaged rig {path}")
    file = Path(path)
    load_rig(file)  # raises if this is not a rig's file
    lines = file.read_text(encoding="utf-8-sig").splitlines()
    map_lines = [number for number, line in enumerate(lines) if line.strip() == _MAP]
    if map_lines:  # delete the table up to the heading of the next one
        start = map_lines[0]
        end = next((k for k in range(start + 1, len(lines)) if lines[k].lstrip().startswith("[")), len(lines))
        del lines[start:end]
    while lines and not lines[-1].strip():
        lines.pop()
    table = [f"{json.dumps(channel)} = {json.dumps(column)}" for channel, column in columns.items()]
    with atomic_write(file) as temporary:
        temporary.write_text("\n".join([*lines, "", _MAP, *table]) + "\n", encoding="utf-8")
        _read_layers(temporary, os.fspath(path), visited=())  # raises if the result is not a rig's file


def _read_layers(
    path: Path, place: str, visited: tuple[Path, ...]
) -> tuple[dict[str, str], dict[str, ParameterEntry], dict[str, str]]:
    """Read a rig's file together with the files that it extends.

    Returns its table `[rig]`, the parameters by dotted name, and the map from channel to column of the machine's logs.
    A parameter of the file replaces that of an extended file, and a table `[map]` that is not empty the whole map. The
    tables `MACHINE_TABLES` of a commissioned machine are left out. `place`: name of the file in messages; `visited`:
    the files that extend it, directly or indirectly. Raises InputError for a wrong table or key, and for files that
    extend each other in a circle, or more than `_MAX_LAYERS` deep.
    """
    file = path.resolve()
    if file in visited or len(visited) >= _MAX_LAYERS:
        raise InputError(
            f"extends must lead to a file that extends none, got a circle or more than {_MAX_LAYERS} files ({place})"
        )
    tree = read_toml(path, "a rig file", place)
    if "machine" in tree:
        tree = {name: table for name, table in tree.items() if name not in MACHINE_TABLES}
        if not set(tree) - {"map"}:  # no tables of a rig: neither a rig nor sizes were stated at commissioning
            raise InputError(f"a machine's file must state an area to be a rig, got none: commission it anew ({place})")
    rig_table = tree.pop("rig", {})
    if not isinstance(rig_table, dict):
        raise InputError(f"rig must be a table, got {rig_table!r} ({place})")
    for key, value in rig_table.items():
        if key not in ("name", "title", "extends"):
            raise InputError(f"rig.{key} is not known; [rig] has name, title and extends ({place})")
        if not isinstance(value, str) or not value.strip():
            raise InputError(f"rig.{key} must be a text, got {value!r} ({place})")
    channel_map = tree.pop("map", {})
    if not isinstance(channel_map, dict) or not all(
        isinstance(column, str) and column.strip() for column in channel_map.values()
    ):
        raise InputError(
            f"map must be a table of channels and the names of their columns, got {channel_map!r:.80} ({place})"
        )
    entries: dict[str, ParameterEntry] = {}
    columns: dict[str, str] = {}
    base = rig_table.get("extends")
    if base in rig_names():
        _, entries, columns = _read_layers(_PACKAGED / f"{base}.toml", f"rigs/{base}.toml", (*visited, file))
    elif base is not None and "\0" not in base and _is_path(base):
        _, entries, columns = _read_layers(path.parent / base, os.fspath(Path(place).parent / base), (*visited, file))
    elif base is not None:
        raise InputError(
            f"extends must be a packaged rig ({', '.join(rig_names())}) or a .toml file, got {base!r} ({place})"
        )
    return rig_table, entries | flatten_entries(tree.items(), place), channel_map or columns
