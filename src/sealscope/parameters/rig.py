"""The Rig: all parameters of one machine, immutable, each number in SI with its unit and source."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
from pydantic import PrivateAttr, model_validator
from pydantic.fields import FieldInfo

from sealscope.calls import closest
from sealscope.errors import InputError
from sealscope.parameters.actuator import Cylinder, Friction
from sealscope.parameters.drive import Fluid, HydraulicLine, MakeUp, Motor, Pump
from sealscope.parameters.fields import Part, PartsDisagreeError, absent_of, choices_of, leaves, unit_of, with_unit
from sealscope.parameters.instruments import Daq, Sensors
from sealscope.parameters.names import resolve
from sealscope.parameters.valve import ServoValve, Supply
from sealscope.units import parse_quantity, to_si

Value = float | int | str
P = TypeVar("P", bound=Part)
#: Begins the source of a value that nobody has stated of this machine.
ASSUMED = "assumed:"
#: Gas of an accumulator over the oil that the rod displaces over the stroke.
_GAS_OVER_ROD = 5.0


class ParameterEntry(NamedTuple):
    """One value as stated: number or choice, unit ("" for a choice), source, and its file or option."""

    value: Value
    unit: str
    source: str
    place: str

    def text(self) -> str:
        """Value and unit as given."""
        return str(self.value) if self.unit in ("", "1") else f"{self.value} {self.unit}"


class ParameterRow(NamedTuple):
    """One line of the table of parameters; `value` in the SI unit `unit`, `given` as the file states it."""

    symbol: str
    name: str
    meaning: str
    value: Value
    unit: str
    given: str
    source: str


class Rig(Part):
    """Parameters of one actuator; made by `load_rig`, changed only into another one by `with_overrides`.

    Numbers are SI doubles: `rig.motor.R_c` [ohm], `rig.sensors.p_A.noise` [Pa]. Two rigs are equal when all numbers and
    choices are, whatever the units and sources they came with.

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
        Where parts do not fit together.

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
    def _parts_fit_together(self) -> Self:
        c = self.cylinder
        if c.V_rod >= c.V:
            raise ValueError(f"cylinder.V_rod must be < V = {with_unit(c.V, 'm^3')}, got {with_unit(c.V_rod, 'm^3')}")
        for symbol, volume in (("A_A", c.V), ("A_B", c.V - c.V_rod)) if c.volumes == "position" else ():
            swept = getattr(c, symbol) * c.L / 2.0
            if swept >= volume:
                rule = f'must be > {symbol} L/2 = {with_unit(swept, "m^3")} when volumes = "position"'
                less = " - V_rod" if volume < c.V else ""
                raise ValueError(f"cylinder.V{less} {rule}, got {with_unit(volume, '') if less else volume}")
        m = self.makeup
        if m.G_relief > 0 and m.check_valves == "absent":
            raise ValueError(
                f"makeup.G_relief = {m.G_relief:g} m^3/(s Pa): relief valves must have an accumulator to open into "
                "(makeup.check_valves = present or pilot-operated), got check_valves = absent"
            )
        self._valve_fits()
        self._lines_hold_what_is_in_them()
        rod = abs(c.A_A - c.A_B) * c.L
        if m.check_valves == "pilot-operated" and m.V_gas <= rod:
            raise ValueError(
                f"makeup.V_gas must be > the oil that the rod displaces over the stroke, |A_A - A_B| L = "
                f"{with_unit(rod, 'm^3')}, got {with_unit(m.V_gas, 'm^3')}"
            )
        f = self.friction
        if f.law != "stribeck" and (f.coulomb_pressure != "sum" or f.F_pr <= 0):
            raise ValueError(
                f'friction.law = "{f.law}" must have coulomb_pressure = "sum" and F_pr > 0, for its force must be > 0, '
                f"got {f.coulomb_pressure} and {with_unit(f.F_pr, 'N')}"
            )
        return self

    def _valve_fits(self) -> None:
        """Raise ValueError for a valve without a supply, a supply without a valve, and parts that neither can have."""
        valve, supply = self.valve, self.supply
        if (valve.spool == "present") != (supply.drive != "absent"):
            raise ValueError(
                "a servo valve must have a supply, and a supply a valve (valve.spool = present and supply.drive = "
                f"constant-speed), got valve.spool = {valve.spool} and supply.drive = {supply.drive}"
            )
        if valve.spool == "absent":
            return
        for name, value in (("line.orifices", self.line.orifices), ("makeup.check_valves", self.makeup.check_valves)):
            if value != "absent":
                raise ValueError(f"a servo valve (valve.spool = present) must have {name} = absent, got {value}")
        if self.motor.K_i <= 0:
            raise ValueError(
                f"motor.K_i must be > 0 V/rad where the motor holds the speed of a supply, got {self.motor.K_i:g}"
            )
        if supply.V_acc > 0 and supply.p_pre >= supply.p_set + supply.p_return:
            raise ValueError(
                f"supply.p_pre must be < p_set + p_return = {with_unit(supply.p_set + supply.p_return, 'Pa')}, so that "
                f"the accumulator takes oil, got {with_unit(supply.p_pre, 'Pa')}"
            )

    def _lines_hold_what_is_in_them(self) -> None:
        """Raise ValueError for shut-off valves or filters in absent lines, and for an oil that thickens."""
        line, oil = self.line, self.fluid
        for name, absent in (("open_A", 1.0), ("open_B", 1.0), ("R_A", 0.0), ("R_B", 0.0)):
            if getattr(line, name) != absent and line.orifices == "absent":
                raise ValueError(
                    f"a {'filter' if absent == 0.0 else 'shut-off valve'} must be in a line (line.orifices = present), "
                    f"got line.{name} = {getattr(line, name):g} and line.orifices = absent"
                )
        for name, needed in (("k_clog_A", line.R_A), ("k_clog_B", line.R_B), ("G_bypass", max(line.R_A, line.R_B))):
            if getattr(line, name) > 0.0 and needed == 0.0:
                raise ValueError(
                    f"line.{name} must stand with a filter ({name.replace('k_clog', 'R').replace('G_bypass', 'R_A')} > "
                    f"0), got line.{name} = {getattr(line, name):g} and none"
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
        overrides = sum(entry.source.startswith("set by") for _, entry in self._entries)
        changed = f", {overrides} overridden" if overrides else ""
        return f"<Rig {self._name}: {self._title or 'no title'}, {len(self._entries)} parameters{changed}>"

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
    def channel_map(self) -> dict[str, str]:
        """Channel -> column of this machine's logs, from the table `[map]` of its file."""
        return dict(self._channel_map)

    def with_channel_map(self, columns: Mapping[str, str]) -> Rig:
        """Return the same rig with another map of columns."""
        rig = self.model_copy()
        rig._channel_map = tuple(columns.items())
        return rig

    def __getitem__(self, name: str) -> Value:
        """Return the SI value of a parameter by its bare or dotted name."""
        value: Any = self
        for symbol in resolve(name, declared_names()).split("."):
            value = getattr(value, symbol)
        return value  # type: ignore[no-any-return]

    def entry(self, name: str) -> ParameterEntry:
        """Return value, unit, source and place of a parameter, as stated."""
        return self._stated_entries()[resolve(name, declared_names())]

    def states(self, *names: str) -> bool:
        """Return True if these parameters are stated: a source that begins with `assumed:` states nothing."""
        return not any(self.entry(name).source.startswith(ASSUMED) for name in names)

    def as_assumed(self, reason: str) -> Rig:
        """Return the same rig with each value an assumption, for this reason."""
        entries = {name: entry._replace(source=f"{ASSUMED} {reason}") for name, entry in self._stated_entries().items()}
        rig = Rig.from_entries(entries, name=self._name, title=self._title, place=self._name)
        return rig.with_channel_map(self.channel_map)

    def _stated_entries(self) -> dict[str, ParameterEntry]:
        if not self._entries:
            raise InputError("a rig must have sources; make it with load_rig or Rig.from_entries, not from bare parts")
        return dict(self._entries)

    def with_overrides(self, overrides: Mapping[str, Value], *, source: str = "set by caller") -> Rig:
        """Return another rig with some values replaced, each with the source `source`.

        A name is bare where it is unique (`V_1`), else dotted (`sensors.p_A.noise`). A number is in SI; a text carries
        its unit (`"0.8[ohm]"`, `"50 %"`) or is a choice's value. Raises InputError for an unknown or ambiguous name, a
        wrong unit or a value out of range.
        """
        if not source.strip():
            raise InputError("source must not be blank")
        entries = self._stated_entries()
        replaced: dict[str, str] = {}
        for name, value in overrides.items():
            full = resolve(name, declared_names())
            if full in replaced:
                raise InputError(f"{full} must be set once, got {replaced[full]} and {name}")
            replaced[full] = name
            entries[full] = ParameterEntry(*_as_given(full, value, source), source, source)
        rig = Rig.from_entries(entries, name=self._name, title=self._title, place=source)
        return rig.with_channel_map(self.channel_map)

    def with_areas(self, A_A: float, A_B: float, *, source: str) -> Rig:
        """Return the same machine with other piston areas [m^2]; volumes that move with the piston fit them.

        The dead volume beside the stroke and the accumulator's gas are scaled with the larger area, an assumption.
        """
        entries, old = self._stated_entries(), self.cylinder
        scale = max(A_A, A_B) / max(old.A_A, old.A_B)
        fitted: dict[str, float] = {}
        if old.volumes == "position":
            dead = max(old.V - 0.5 * max(old.A_A, old.A_B) * old.L, 0.0)
            fitted["cylinder.V"] = 0.5 * max(A_A, A_B) * old.L + scale * dead
            fitted["cylinder.V_rod"] = max(0.5 * (A_A - A_B) * old.L, 0.0)
        if self.makeup.check_valves != "absent":
            gas = _GAS_OVER_ROD * abs(A_A - A_B) * old.L
            fitted["makeup.V_gas"] = max(scale * self.makeup.V_gas, gas)
        assumed = f"{ASSUMED} that of {self._name}, scaled with the area"
        stated = {"cylinder.A_A": A_A, "cylinder.A_B": A_B}
        for values, why in ((fitted, assumed), (stated, source)):
            for full, value in values.items():
                entries[full] = ParameterEntry(*_as_given(full, value, source), why, source)
        rig = Rig.from_entries(entries, name=self._name, title=self._title, place=source)
        return rig.with_channel_map(self.channel_map)

    def table(self) -> list[ParameterRow]:
        """List every parameter in the order of declaration."""
        entries = self._stated_entries()
        return [
            ParameterRow(
                name.rpartition(".")[2],
                name,
                str(field.title),
                self[name],
                unit_of(field),
                entries[name].text(),
                entries[name].source,
            )
            for name, field in declared().items()
        ]

    def present(self) -> dict[str, Value]:
        """Return the values in SI by dotted name, without those of parameters absent from the model.

        Two rigs have the same ones where they are the same machine, whichever parameters Sealscope has learnt since.
        """
        return {name: self[name] for name, field in declared().items() if self[name] != absent_of(field)}

    def as_dict(self) -> dict[str, Any]:
        """Convert the rig to plain nested values, fit for JSON: `{"motor": {"R_c": {"value": 0.73, ...}}, ...}`."""
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
        """Read the rig that `as_dict` wrote, for example in a recording's provenance.

        `place` is named in errors.
        """
        head = tree.get("rig")
        name, title = (head.get("name", ""), head.get("title", "")) if isinstance(head, Mapping) else ("", "")
        parts = ((key, item) for key, item in tree.items() if key != "rig")
        return cls.from_entries(flatten(parts, place), name=str(name), title=str(title), place=place)

    @classmethod
    def from_entries(cls, entries: Mapping[str, ParameterEntry], *, name: str, title: str = "", place: str) -> Rig:
        """Build a rig from one entry for each declared parameter, by dotted name.

        One that is not stated has the value at which it is absent; `place` is named where it has none such.
        """
        entries = {**_absent_entries(place), **entries}
        names = declared_names()
        for full in entries:
            if full not in declared():
                raise InputError(f"{full} is not a parameter{closest(full, names)} ({entries[full].place})")
        for full in names:
            if full not in entries:
                raise InputError(f"{full} is missing ({place})")
        rig = _built(cls, "", entries, place)
        rig._name, rig._title = name, title
        rig._entries = tuple((full, entries[full]) for full in names)
        return rig


@cache
def declared() -> dict[str, FieldInfo]:
    """Return the declaration of each parameter by dotted name, in the order of declaration."""
    return dict(leaves(Rig))


def _absent_entries(place: str) -> dict[str, ParameterEntry]:
    """Make an entry for each parameter that need not be stated."""
    return {
        full: ParameterEntry(value, unit_of(field), "absent from the model: not stated", place)
        for full, field in declared().items()
        if (value := absent_of(field)) is not None
    }


@cache
def declared_names() -> tuple[str, ...]:
    """List the dotted names of all parameters, in the order of declaration."""
    return tuple(declared())


def _built(model: type[P], path: str, entries: Mapping[str, ParameterEntry], place: str) -> P:
    """Build a part of parameters whose names begin with `path`; an error names the place of the wrong value."""
    values: dict[str, Any] = {}
    for symbol, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, Part):
            values[symbol] = _built(kind, f"{path}{symbol}.", entries, place)
        else:
            values[symbol] = _si_value(path + symbol, field, entries[path + symbol])
    try:
        return model(**values)
    except InputError as error:
        text = str(error)
        culprit = path + text.split(maxsplit=1)[0]
        where = place if isinstance(error, PartsDisagreeError) else entries[culprit].place
        raise InputError(f"{_qualified(culprit, text) if path else text} ({where})") from None


def _qualified(full: str, text: str) -> str:
    """Replace the first word of `text` by its dotted name where it is not unique among parameters."""
    symbol = full.rpartition(".")[2]
    unique = sum(name.rpartition(".")[2] == symbol for name in declared_names()) <= 1
    return text if unique else full + text[len(symbol) :]


@cache
def _short_name(full: str) -> str:
    return _qualified(full, full.rpartition(".")[2])


def _si_value(full: str, field: FieldInfo, entry: ParameterEntry) -> Value:
    """Convert one entry to its SI number or its choice.

    Raises InputError for a blank source, a wrong type or a wrong unit.
    """
    short_name, place = _short_name(full), entry.place
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
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{short_name} must be finite, got {entry.value} ({place})")
    return int(number) if field.annotation is int and number.is_integer() else number


def _as_given(full: str, value: Any, place: str) -> tuple[Value, str]:
    """Parse value and unit of a caller's number (SI) or text (with its unit)."""
    field = declared()[full]
    if choices_of(field):
        return (value.strip() if isinstance(value, str) else value), ""
    si_unit = unit_of(field)
    if isinstance(value, str):
        return parse_quantity(value, si_unit, name=_short_name(full), place=place), si_unit
    return (value.item() if isinstance(value, np.generic) else value), si_unit


def flatten(tree: Iterable[tuple[str, Any]], place: str, prefix: str = "") -> dict[str, ParameterEntry]:
    """Flatten nested tables `{group: {symbol: {value, unit, source}}}` to entries by dotted name."""
    entries: dict[str, ParameterEntry] = {}
    for key, item in tree:
        full = prefix + key
        if full in declared() or (isinstance(item, dict) and "value" in item):
            entries[full] = _entry(full, item, place)
        elif isinstance(item, dict):
            entries |= flatten(item.items(), place, full + ".")
        else:
            raise InputError(f"{full} is not a parameter{closest(full, declared_names())} ({place})")
    return entries


def _entry(full: str, item: Any, place: str) -> ParameterEntry:
    if full not in declared():
        raise InputError(f"{full} is not a parameter{closest(full, declared_names())} ({place})")
    short_name = _short_name(full)
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
