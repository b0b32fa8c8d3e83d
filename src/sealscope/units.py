"""Convert the units of files, options and figures to the SI doubles used inside, and back.

A unit is parsed to powers of base units and a factor, a fraction times a power of pi. The conversion of a number is
exact, except for pi, for roots such as ``bar^0.5`` and for factors from pint: ``234 cm^3`` is the double ``2.34e-4``.
Angles and raw counts are dimensions: ``Hz`` is not ``rad/s``, ``m^3/rev`` is not ``m^3``, and raw counts are not a
pressure. The units of hydraulics are in `units.toml`; others are looked up by pint, which is loaded only then.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping
from fractions import Fraction
from functools import cache, lru_cache
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sealscope.errors import InputError

Array = NDArray[np.float64]
#: One litre and one millilitre per minute [m^3/s], one millimetre per minute [m/s], one bar and one pound-force per
#: square inch [Pa].
LITRE_PER_MINUTE = 1e-3 / 60.0
ML_PER_MINUTE = 1e-3 * LITRE_PER_MINUTE
MM_PER_MINUTE = 1e-3 / 60.0
BAR = 1e5
PSI = 0.45359237 * 9.80665 / 0.0254**2
#: Seconds of a day, days of a Julian year and of a twelfth of it.
DAY = 86_400.0
DAYS_PER_YEAR = 365.25
DAYS_PER_MONTH = DAYS_PER_YEAR / 12.0
_Powers = tuple[tuple[str, Fraction], ...]
_Conversion = tuple[Fraction, float, Fraction, Fraction]


class Unit(NamedTuple):
    """A unit of measurement: SI value = (value + offset) * factor * pi**pi_power.

    `powers`: pairs of base unit and exponent, sorted; they define the dimension.
    """

    factor: Fraction = Fraction(1)
    pi_power: Fraction = Fraction(0)
    powers: _Powers = ()
    offset: Fraction = Fraction(0)

    def times(self, other: Unit, power: Fraction) -> Unit:
        """Multiply by `other` raised to a `power`; the product has no offset, such as that of degC.

        Raises ValueError beyond the limits `_MAX_BITS` and `_MAX_PI`.
        """
        bits = max(other.factor.numerator, other.factor.denominator).bit_length()
        if abs(power) * bits > _MAX_BITS:  # checked first, as the power itself could take forever
            raise ValueError
        factor, pi_power = self.factor * Fraction(other.factor**power), self.pi_power + other.pi_power * power
        if max(factor.numerator, factor.denominator).bit_length() > _MAX_BITS or abs(pi_power) > _MAX_PI:
            raise ValueError
        powers = dict(self.powers)
        for base, exponent in other.powers:
            powers[base] = powers.get(base, Fraction(0)) + exponent * power
        return Unit(factor, pi_power, tuple(sorted((base, total) for base, total in powers.items() if total)))


def _build_unit(row: Mapping[str, Any]) -> Unit:
    """Build the Unit of a row of `units.toml`: its keys are those of `_DEFAULTS`, and base units with their powers."""
    powers = {base: Fraction(power) for base, power in row.items() if base not in _DEFAULTS}
    factor, pi_power, offset = (Fraction(row.get(name, default)) for name, default in _DEFAULTS.items())
    return Unit(factor, pi_power, tuple(sorted(powers.items())), offset)


def _absolute_unit(unit: Unit) -> Unit:
    """Build the unit of absolute pressure from `unit`, that of gauge pressure; in SI, pressures are gauge pressures."""
    return unit._replace(offset=-_TABLES["absolute"]["atmosphere"] / unit.factor)


_DEFAULTS = {"factor": 1, "pi": 0, "offset": 0}
_TABLES: dict[str, Any] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
#: Name of a single unit, such as `mbar` -> the unit; powers, products and other spellings are not in it.
_ATOMS = {
    prefix + name: _build_unit({**row, "factor": Fraction(row.get("factor", 1)) * Fraction(10) ** power})
    for name, row in _TABLES["prefixed"].items()
    for prefix, power in _TABLES["prefixes"].items()
} | {name: _build_unit(row) for name, row in _TABLES["plain"].items()}
#: Standard atmosphere [Pa], the difference between absolute and gauge pressure.
P_ATM = float(_TABLES["absolute"]["atmosphere"])
_ATOMS |= {name: _absolute_unit(_ATOMS[gauge]) for name, gauge in _TABLES["absolute"].items() if name != "atmosphere"}
_SPELLINGS = {spelling: name for name, spellings in _TABLES["spellings"].items() for spelling in spellings.split()} | {
    "": "1"
}
_CHARACTERS, _KINDS = str.maketrans(_TABLES["signs"]), _TABLES["kinds"]
_TOKEN = re.compile(
    r"\s*(?:(?P<op>[/()])|\^(?P<power>[+-]?\d(?:\.5)?)(?![\d.])|(?P<name>[^\W\d]\w*?|%|°[CF]?|1)(?P<digit>[23]?)(?=$|[\s/()^]))"
)
_NUMBER = re.compile(
    r"\s*(?P<number>[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:inf|nan)\b)(?P<rest>.*)",
    re.DOTALL | re.IGNORECASE,
)
#: Marks of absolute and gauge pressures: `bar abs`, `MPa(g)`, and `bar\u00fc` (gauge, in German).
_MARKED = re.compile(
    r"(?P<unit>.{1,40}?)[\s_]*\(?(?:(?P<absolute>a|A|abs\.?|absolute?)|g|G|gauge|gage|rel\.?|relative?|\u00fc|\u00dc)\)?"
)
#: Longest text [characters] that is parsed as a unit or a quantity.
_MAX_TEXT = 200
#: Most bits of a factor's numerator and denominator, and largest power of pi, so that the factor is a double.
_MAX_BITS, _MAX_PI = 900, 100


@cache
def _registry() -> Any:
    """Create pint's registry of units, which takes long and is therefore cached."""
    import pint

    return pint.UnitRegistry(cache_folder=None)


def _parse_name(name: str) -> Unit:
    """Look up a unit in `units.toml` and then in pint; raise InputError if neither has it, proportional to SI units."""
    unit_of_table = _ATOMS.get(_SPELLINGS.get(name, name))
    if unit_of_table is not None:
        return unit_of_table
    registry = _registry()
    try:
        factor, base = registry.get_base_units(name)
        is_proportional = registry.Quantity(0, name).to_base_units().magnitude == 0
    except Exception as error:  # pint raises errors of many classes
        raise InputError(f"got {name}, which is no known unit") from error
    if not is_proportional:
        raise InputError(f"got {name}, which is not proportional to an SI unit")
    result = Unit(Fraction(repr(float(factor))))  # `repr`: the decimal number, such as 0.3048, not the nearest double
    for base_name, power in base._units.items():
        # pint's name of a base unit is a word, such as meter; a unit that `units.toml` lacks is a dimension of its own
        unit = _ATOMS.get(_SPELLINGS.get(base_name, base_name), Unit(powers=((base_name, Fraction(1)),)))
        result = result.times(unit, Fraction(power).limit_denominator(12))  # pint's powers are floats, such as 0.5
    return result


def _tokenize(text: str) -> list[str]:
    """Split a unit's text into names, powers such as `^2`, brackets and slashes; raise ValueError for other text."""
    tokens, position = [], 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None:
            raise ValueError
        position = match.end()
        name, digit = match["name"] or "", match["digit"] or ""
        if match["op"]:
            tokens.append(match["op"])
        elif match["power"]:
            tokens.append(f"^{match['power']}")
        elif digit:  # a power without `^`, such as m3
            tokens += [name, f"^{digit}"]
        else:
            tokens.append(name)
    return tokens


def _parse_product(tokens: list[str]) -> Unit:
    """Parse a product of units, such as ``m^3/(s Pa)``, from the first `tokens`, and remove them from the list.

    A slash divides by the next factor alone. Raises ValueError if there is no valid product.
    """
    result: Unit | None = None
    divides = False
    while tokens and tokens[0] != ")":
        token = tokens.pop(0)
        if token == "/" and result is not None and not divides:
            divides = True
            continue
        if token == "(":
            unit = _parse_product(tokens)
            if not tokens or tokens.pop(0) != ")":
                raise ValueError
        elif token[0] in "/^":
            raise ValueError
        else:
            unit = _parse_name(token)
        power = Fraction(tokens.pop(0)[1:]) if tokens and tokens[0][0] == "^" else Fraction(1)
        if result is not None or power != 1:  # only a single unit keeps its offset
            unit = (result or Unit()).times(unit, -power if divides else power)
        result = unit
        divides = False
    if result is None or divides:
        raise ValueError
    return result


def _parse_marked_pressure(text: str) -> Unit | None:
    """Parse a unit of pressure marked as absolute or gauge, such as `bar abs` or `MPa(g)`; None for other texts."""
    match = _MARKED.fullmatch(text)
    if match is None or not same_dimension(match["unit"], "Pa"):
        return None
    unit = parse_unit(match["unit"])
    if unit.offset:  # absolute already
        return None
    return _absolute_unit(unit) if match["absolute"] else unit


@lru_cache(maxsize=1024)
def parse_unit(text: str) -> Unit:
    """Parse the text of a unit, such as `L/min`, `m^3/(s Pa)` or `bar abs`; raise InputError for any other text."""
    text = text.strip()
    text = _SPELLINGS.get(text, text)
    if text in _ATOMS:
        return _ATOMS[text]
    if len(text) > _MAX_TEXT:
        raise InputError(f"got {text[:60]}..., which is no product of units")
    pressure = _parse_marked_pressure(text)
    if pressure is not None:
        return pressure
    # a hyphen between letters, as in N-m, stands for a product
    normalised = re.sub(r"(?<=[A-Za-z])-(?=[A-Za-z])", " ", text.replace("**", "^").translate(_CHARACTERS))
    try:
        tokens = _tokenize(normalised.strip())
        unit = _parse_product(tokens)
        if tokens:  # a closing bracket too many
            raise ValueError
    except InputError:  # a ValueError, too, but with a message
        raise
    except ValueError:
        raise InputError(f"got {normalised.strip()[:60]}, which is no product of units") from None
    return unit


def _describe_dimension(si_unit: str) -> str:
    """Describe the units that have the dimension of `si_unit`, for a message: `a unit of pressure, such as Pa`."""
    if parse_unit(si_unit).powers == ():
        return "no unit, or %"
    return f"a unit of {_KINDS[si_unit]}, such as {si_unit}" if si_unit in _KINDS else f"a unit such as {si_unit}"


def same_dimension(unit: str, other: str) -> bool:
    """Test whether values can be converted between two units; False also if one of the texts is not a unit."""
    try:
        return parse_unit(unit).powers == parse_unit(other).powers
    except InputError:
        return False


def is_familiar(unit: str) -> bool:
    """Test whether a unit is a name that is known without pint or a quotient of these, such as `psig` and `cm3/s`.

    Products and powers with ^ are not recognised. Pint also knows ordinary words, such as `rod`, which is 5 m.
    """
    names = {*_ATOMS, *_SPELLINGS} - {""}
    parts = [unit] if unit in names else unit.split("/")  # a name may contain a slash, such as r/min
    for part in parts:
        without_power = part.rstrip("23")
        without_mark = part[:-1] if part.endswith(("a", "g")) else part  # "a": absolute, "g": gauge pressure
        if names.isdisjoint((part, without_power, without_mark)):
            return False
    return True


@lru_cache(maxsize=1024)
def _conversion(unit: str, si_unit: str) -> _Conversion:
    """Compute the exact conversion from `unit` to `si_unit`: (factor, power of pi, first offset, second offset).

    SI value = (value + first offset) * factor * pi**power - second offset. Raises InputError if the dimensions differ.
    """
    source, target = parse_unit(unit), parse_unit(si_unit)
    if source.powers != target.powers:
        raise InputError(f"got {unit.strip() or 'none'}")
    return source.factor / target.factor, float(source.pi_power - target.pi_power), source.offset, target.offset


def _require_conversion(unit: str, si_unit: str, name: str, place: str | None) -> _Conversion:
    """Compute the `_conversion` from `unit` to `si_unit`; raise InputError for the quantity `name` of file `place`."""
    try:
        return _conversion(unit, si_unit)
    except InputError as error:
        suffix = f" ({place})" if place else ""
        message = f"{name} must have {_describe_dimension(si_unit)}, {error}{suffix}"
        raise InputError(" ".join(message.split())) from None  # one line


def _convert_exactly(value: Fraction, conversion: _Conversion) -> float:
    """Convert a number by a `_conversion` in exact arithmetic, except for pi; infinite beyond the range of doubles."""
    factor, pi_power, first_offset, second_offset = conversion
    exact = (value + first_offset) * factor
    try:
        if pi_power == 0:
            return float(exact - second_offset)
        return float(float(exact) * math.pi**pi_power - float(second_offset))
    except OverflowError:
        return math.inf if exact > 0 else -math.inf


@overload
def to_si(values: float, unit: str, si_unit: str, *, name: str = ..., place: str | None = ...) -> float: ...
@overload
def to_si(values: ArrayLike, unit: str, si_unit: str, *, name: str = ..., place: str | None = ...) -> Array: ...
def to_si(
    values: ArrayLike | float, unit: str, si_unit: str, *, name: str = "value", place: str | None = None
) -> Array | float:
    """Convert `values` (any shape, or one number) in `unit` to doubles in `si_unit`.

    One number is converted exactly and rounded once, except for units with pi, such as rpm. An array is converted with
    an error of up to 2 units in the last place, or more for a unit with an offset, such as degF; with equal units, an
    array of doubles is returned itself. Raises InputError for a unit of another dimension; the message states `name`,
    the unit, the expected dimension and the file `place`.
    """
    scalar = isinstance(values, int | float)
    if unit == si_unit:
        return float(values) if scalar else np.asarray(values, dtype=np.float64)  # type: ignore[arg-type]
    conversion = _require_conversion(unit, si_unit, name, place)
    if scalar:
        number = float(values)  # type: ignore[arg-type]
        return _convert_exactly(Fraction(repr(number)), conversion) if math.isfinite(number) else number
    factor, pi_power, first_offset, second_offset = conversion
    result = np.array(values, dtype=np.float64)
    if first_offset:
        result += float(first_offset)
    if factor.numerator == 1 and float(factor.denominator) == factor.denominator:
        result /= float(factor.denominator)  # more exact than a product with the rounded factor
    else:
        result *= float(factor)
    if pi_power:
        result *= math.pi**pi_power
    if second_offset:
        result -= float(second_offset)
    return result


@overload
def from_si(values: float, unit: str, si_unit: str, *, name: str = ...) -> float: ...
@overload
def from_si(values: ArrayLike, unit: str, si_unit: str, *, name: str = ...) -> Array: ...
def from_si(values: ArrayLike | float, unit: str, si_unit: str, *, name: str = "value") -> Array | float:
    """Convert `values` (any shape, or one number) in `si_unit` to doubles in `unit`; the inverse of `to_si`."""
    _require_conversion(unit, si_unit, name, None)  # raises the error on `unit`; that of `to_si` would be on `si_unit`
    return to_si(values, si_unit, unit)


def parse_quantity(
    value: float | str, si_unit: str, *, name: str = "value", place: str | None = None, finite: bool = True
) -> float:
    """Parse a text such as ``2[L/min]``, ``3 psi`` or ``5``, or a number, to a number in `si_unit`, the default unit.

    Raises InputError for any other text, for a unit of another dimension and, with `finite`, for an infinite number or
    NaN. The message names the quantity (`name`) and the file or option (`place`).
    """
    suffix = f" ({place})" if place else ""
    text = value if isinstance(value, str) else ""
    if isinstance(value, Real) and not isinstance(value, bool):
        text = repr(float(value))
    match = _NUMBER.fullmatch(text) if len(text) <= _MAX_TEXT else None
    if match is None:
        entry = repr(value[:60] if isinstance(value, str) else value)
        raise InputError(f"{name} must be a number with or without a unit, such as 2[{si_unit}], got {entry}{suffix}")
    unit = match["rest"].strip() or si_unit
    if unit.startswith("[") and unit.endswith("]"):
        unit = unit[1:-1]
    number = float(match["number"])
    if not math.isfinite(number) or number == 0:  # 1e-999999, 0 as a double, would be a huge fraction
        result = to_si(number, unit, si_unit, name=name, place=place)
    elif unit == si_unit:
        result = number
    else:
        result = _convert_exactly(Fraction(match["number"]), _require_conversion(unit, si_unit, name, place))
    if finite and not math.isfinite(result):
        raise InputError(f"{name} must be a finite number, got {text[:60].strip()}{suffix}")
    return result
