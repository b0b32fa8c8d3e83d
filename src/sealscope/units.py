"""Units at the edges: what a file, an option or a figure says, turned into the SI doubles used inside, and back.

A unit is parsed into powers of base units, its factor held as an exact fraction times a power of pi, so that
``234 cm^3`` is exactly the double ``2.34e-4``. An angle and a count of a converter are dimensions of their own:
``Hz`` is not ``rad/s``, ``m^3/rev`` is not ``m^3``, and raw counts are not a pressure. The units of hydraulics are
known without help; for all others pint is asked, and loaded only then.
"""

from __future__ import annotations

import math
import re
from fractions import Fraction
from functools import cache, lru_cache
from numbers import Real
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sealscope.errors import InputError

Array = NDArray[np.float64]
#: One litre per minute [m^3/s], one pound-force per square inch [Pa].
LITRE_PER_MINUTE = 1e-3 / 60.0
PSI = 0.45359237 * 9.80665 / 0.0254**2
_Powers = tuple[tuple[str, Fraction], ...]
_Conversion = tuple[Fraction, float, Fraction, Fraction]


class Unit(NamedTuple):
    """SI value = (value + offset) * factor * pi**pi_power, in the product of `powers` of base units."""

    factor: Fraction
    pi_power: Fraction
    powers: _Powers
    offset: Fraction = Fraction(0)


def _unit(factor: Fraction | str | int, *, pi: int = 0, offset: Fraction | str | int = 0, **powers: int) -> Unit:
    ordered = tuple(sorted((base, Fraction(power)) for base, power in powers.items()))
    return Unit(Fraction(factor), Fraction(pi), ordered, Fraction(offset))


_PREFIXES = {"n": -9, "u": -6, "m": -3, "c": -2, "": 0, "k": 3, "M": 6, "G": 9}
_PREFIXED = {
    "Pa": _unit(1, kg=1, m=-1, s=-2),
    "m": _unit(1, m=1),
    "s": _unit(1, s=1),
    "V": _unit(1, kg=1, m=2, s=-3, A=-1),
    "A": _unit(1, A=1),
    "N": _unit(1, kg=1, m=1, s=-2),
    "g": _unit("1/1000", kg=1),
    "L": _unit("1/1000", m=3),
    "l": _unit("1/1000", m=3),
    "W": _unit(1, kg=1, m=2, s=-3),
    "J": _unit(1, kg=1, m=2, s=-2),
    "H": _unit(1, kg=1, m=2, s=-2, A=-2),
    "ohm": _unit(1, kg=1, m=2, s=-3, A=-2),
    "Hz": _unit(1, s=-1),
    "rad": _unit(1, rad=1),
    "bar": _unit(10**5, kg=1, m=-1, s=-2),
}
_PSI = Fraction("0.45359237") * Fraction("9.80665") / Fraction("0.0254") ** 2
_ATOMS: dict[str, Unit] = {
    prefix + name: unit._replace(factor=unit.factor * Fraction(10) ** power)
    for name, unit in _PREFIXED.items()
    for prefix, power in _PREFIXES.items()
} | {
    "1": _unit(1),
    "%": _unit("1/100"),
    "psi": _unit(_PSI, kg=1, m=-1, s=-2),
    "psia": _unit(_PSI, offset=-101325 / _PSI, kg=1, m=-1, s=-2),
    "bara": _unit(10**5, offset="-1.01325", kg=1, m=-1, s=-2),
    "kgf": _unit("9.80665", kg=1, m=1, s=-2),
    "in": _unit("0.0254", m=1),
    "mil": _unit("0.0000254", m=1),
    "lpm": _unit("1/60000", m=3, s=-1),
    "min": _unit(60, s=1),
    "h": _unit(3600, s=1),
    "rev": _unit(2, pi=1, rad=1),
    "rpm": _unit("1/30", pi=1, rad=1, s=-1),
    "deg": _unit("1/180", pi=1, rad=1),
    "count": _unit(1, count=1),
    "K": _unit(1, K=1),
    "degC": _unit(1, K=1, offset="273.15"),
    "degF": _unit("5/9", K=1, offset="459.67"),
}
# pressures inside are gauge pressures; absolute ones lose one standard atmosphere
_SPELLINGS = {
    spelling: name
    for name, spellings in {
        "psi": "PSI Psi",
        "bar": "BAR Bar бар",
        "Pa": "pa PA",
        "kPa": "kpa Kpa KPA KPa кПа",
        "MPa": "mpa Mpa MPA МПа",
        "mbar": "MBAR Mbar",
        "kgf": "kp",
        "kgf/cm^2": "kg/cm2 kg/cm^2 kg/cm\u00b2",
        "lbf/in^2": "lb/in2 lb/in^2 lb/in\u00b2 lbs/in2",
        "rpm": "RPM Rpm U/min r/min Upm UPM upm tr/min giri/min r.p.m.",
        "lpm": "LPM",
        "V": "Volt volt Volts volts",
        "s": "sec Sec second seconds Seconds sek Sek Sekunden secondes secondi segundos с сек",
        "ms": "msec Millisekunden",
        "mm": "MM мм millimetre millimeter Millimeter millimeters",
        "cm": "CM Zentimeter",
        "in": 'inch inches Inch Inches IN Zoll in. " \u2033',
        "mil": "mils thou",
        "min": "minute minutes",
        "h": "hr hour hours",
        "count": "counts Count Counts cts",
        "ohm": "Ohm",
        "rev": "revolution revs revolutions turn turns Umdr Umdr. Umdrehungen tr tours giri",
        "rad": "radian radians",
        "deg": "degree degrees Degree Degrees DEG Deg deg. Grad \u00b0",
        "degC": "°C C",
        "degF": "°F",
        "m": "metre meter",
        "g": "gram",
        "kg": "kilogram",
        "K": "kelvin",
        "A": "ampere",
        "1": "-",
        "%": "percent",
    }.items()
    for spelling in spellings.split()
} | {"": "1"}
_SIGNS = str.maketrans(
    dict.fromkeys("\u00b7\u22c5\u00d7*", " ")
    | {
        "\u00b2": "^2",
        "\u00b3": "^3",
        "\u207b": "^-",
        "\u00b9": "1",
        "\u00b5": "u",
        "\u03bc": "u",
        "\u03a9": "ohm",
        "\u2126": "ohm",
        "\u2212": "-",
    }
)
_KINDS = {
    "Pa": "pressure", "m": "length", "m^2": "area", "m^3": "volume", "m^3/s": "volume flow", "rad/s": "angular speed",
    "rad": "angle", "s": "time", "V": "voltage", "A": "current", "N": "force", "kg": "mass", "Hz": "frequency",
    "ohm": "resistance", "H": "inductance", "kg m^2": "inertia", "kg/m^3": "density", "K": "temperature",
    "m/s": "speed", "m^3/rev": "volume per turn",
}  # fmt: skip
_TOKEN = re.compile(
    r"\s*(?:(?P<op>[/()])|\^(?P<power>[+-]?\d(?:\.5)?)(?![\d.])|(?P<name>[^\W\d]\w*?|%|°[CF]?|1)(?P<digit>[23]?)(?=$|[\s/()^]))"
)
_NUMBER = re.compile(
    r"\s*(?P<number>[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:inf|nan)\b)(?P<rest>.*)",
    re.DOTALL | re.IGNORECASE,
)
#: How instruments mark a pressure as absolute or as gauge: `bar abs`, `MPa(g)`, `bar\u00fc`.
_MARKED = re.compile(
    r"(?P<unit>.{1,40}?)[\s_]*\(?(?:(?P<absolute>a|A|abs\.?|absolute?)|g|G|gauge|gage|rel\.?|relative?|\u00fc|\u00dc)\)?"
)
_STANDARD_ATMOSPHERE = 101325
_LONGEST_TEXT = 200
#: A unit's factor is a double: its fraction has at most so many bits, and pi at most this power.
_MOST_BITS, _MOST_PI = 900, 100


@cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry(cache_folder=None)


def _atom(name: str) -> Unit:
    known = _ATOMS.get(_SPELLINGS.get(name, name))
    if known is not None:
        return known
    registry = _registry()
    try:
        factor, base = registry.get_base_units(name)
        offset_free = registry.Quantity(0, name).to_base_units().magnitude == 0
    except Exception as error:  # pint raises many kinds, some of its parser's own
        raise InputError(f"got {name}, which is no known unit") from error
    if not offset_free:
        raise InputError(f"got {name}, which is not proportional to an SI unit")
    powers: dict[str, Fraction] = {}
    result = Fraction(repr(float(factor)))
    for long_name, power in base._units.items():
        unit = _ATOMS.get(_SPELLINGS.get(long_name, long_name))
        exact = Fraction(power).limit_denominator(12)
        if unit is None:
            powers[long_name] = powers.get(long_name, Fraction(0)) + exact
            continue
        result *= unit.factor ** int(exact) if exact.denominator == 1 else Fraction(float(unit.factor) ** float(exact))
        for symbol, exponent in unit.powers:
            powers[symbol] = powers.get(symbol, Fraction(0)) + exponent * exact
    return Unit(result, Fraction(0), tuple(sorted(powers.items())))


class _Parser:
    """Product of powers with `/`, blanks and brackets: ``m^3/(s Pa)``, ``N m/A``, ``cm3/rev``, ``rad/s/V``."""

    def __init__(self, text: str) -> None:
        self.tokens: list[tuple[str, str]] = []
        at = 0
        self.text = text = text.strip()
        while at < len(text):
            match = _TOKEN.match(text, at)
            if match is None:
                raise InputError(f"got {self.text[:60]}, which is no product of units")
            at = match.end()
            if match["op"]:
                self.tokens.append((match["op"], ""))
            elif match["power"]:
                self.tokens.append(("^", match["power"]))
            elif match["name"] + match["digit"] in _SPELLINGS or not match["digit"]:
                self.tokens.append(("name", match["name"] + match["digit"]))
            else:
                self.tokens += [("name", match["name"]), ("^", match["digit"])]

    def product(self, depth: int = 0) -> Unit:
        factor, pi_power, powers = Fraction(1), Fraction(0), dict[str, Fraction]()
        sign, count = 1, 0
        alone: Unit | None = None
        while self.tokens and self.tokens[0][0] != ")":
            kind, value = self.tokens.pop(0)
            if kind == "/":
                if sign < 0 or not count:
                    break
                sign = -1
                continue
            if kind == "(":
                unit = self.product(depth + 1)
                if not self.tokens or self.tokens.pop(0)[0] != ")":
                    break
            elif kind == "name":
                unit = _atom(value)
            else:
                break
            power = Fraction(sign)
            if self.tokens and self.tokens[0][0] == "^":
                power = sign * Fraction(self.tokens.pop(0)[1])
            if abs(power) * max(unit.factor.numerator, unit.factor.denominator).bit_length() > _MOST_BITS:
                break
            factor *= Fraction(unit.factor**power)
            pi_power += unit.pi_power * power
            if max(factor.numerator, factor.denominator).bit_length() > _MOST_BITS or abs(pi_power) > _MOST_PI:
                break
            for base, exponent in unit.powers:
                powers[base] = powers.get(base, Fraction(0)) + exponent * power
            alone = unit if count == 0 and power == 1 else None
            sign, count = 1, count + 1
        else:
            if count and sign > 0 and (not self.tokens or depth):
                offset = alone.offset if alone is not None else Fraction(0)
                return Unit(factor, pi_power, tuple(sorted((b, p) for b, p in powers.items() if p)), offset)
        raise InputError(f"got {self.text[:60]}, which is no product of units")


def _marked_pressure(text: str) -> Unit | None:
    """Return the unit of a pressure marked as absolute, which has an offset, or as gauge; None for any other text."""
    marked = _MARKED.fullmatch(text)
    if marked is None:
        return None
    try:
        unit = parse_unit(marked["unit"])
    except InputError:
        return None
    if unit.powers != _ATOMS["Pa"].powers or unit.offset:
        return None
    return unit._replace(offset=-_STANDARD_ATMOSPHERE / unit.factor) if marked["absolute"] else unit


@lru_cache(maxsize=1024)
def parse_unit(text: str) -> Unit:
    """Return the unit that `text` names; raises InputError where it is not one."""
    text = text.strip()
    text = _SPELLINGS.get(text, text)
    if text in _ATOMS:
        return _ATOMS[text]
    if len(text) > _LONGEST_TEXT:
        raise InputError(f"got {text[:60]}..., which is no product of units")
    pressure = _marked_pressure(text)
    if pressure is not None:
        return pressure
    plain = re.sub(r"(?<=[A-Za-z])-(?=[A-Za-z])", " ", text.replace("**", "^").translate(_SIGNS))
    return _Parser(plain).product()


def _expected(si_unit: str) -> str:
    """Return what a unit must measure, in words, for messages: `a unit of pressure, such as Pa`."""
    if parse_unit(si_unit).powers == ():
        return "no unit, or %"
    return f"a unit of {_KINDS[si_unit]}, such as {si_unit}" if si_unit in _KINDS else f"a unit such as {si_unit}"


def same_dimension(unit: str, other: str) -> bool:
    """Whether values can be converted from one unit to the other; False also where one of them is no unit."""
    try:
        return parse_unit(unit).powers == parse_unit(other).powers
    except InputError:
        return False


def is_familiar(unit: str) -> bool:
    """Whether a unit is made of those known without pint, as `bar`, `psig` and `cm3/s`; a name's last word may be one.

    Of pint's thousands of names many are plain words: a rod is 5 m long.
    """
    names = {*_ATOMS, *_SPELLINGS} - {""}
    parts = [unit] if unit in names else unit.split("/")
    return all(names & {part, part.rstrip("23"), part[:-1] if part[-1:] in ("a", "g") else part} for part in parts)


@lru_cache(maxsize=1024)
def _conversion(unit: str, si_unit: str) -> _Conversion:
    """(factor, power of pi, offset before, offset after): target = (value + before) * factor * pi**power - after."""
    source, target = parse_unit(unit), parse_unit(si_unit)
    if source.powers != target.powers:
        raise InputError(f"got {unit.strip() or 'none'}")
    return source.factor / target.factor, float(source.pi_power - target.pi_power), source.offset, target.offset


def _look_up(unit: str, si_unit: str, name: str, place: str | None) -> _Conversion:
    try:
        return _conversion(unit, si_unit)
    except InputError as error:
        where = f" ({place})" if place else ""
        raise InputError(" ".join(f"{name} must have {_expected(si_unit)}, {error}{where}".split())) from None


def _convert_one(value: Fraction, conversion: _Conversion) -> float:
    factor, pi_power, before, after = conversion
    exact = (value + before) * factor
    try:
        if pi_power == 0:
            return float(exact - after)
        return float(float(exact) * math.pi**pi_power - float(after))
    except OverflowError:
        return math.inf if exact > 0 else -math.inf


@overload
def to_si(values: float, unit: str, si_unit: str, *, name: str = ..., place: str | None = ...) -> float: ...
@overload
def to_si(values: ArrayLike, unit: str, si_unit: str, *, name: str = ..., place: str | None = ...) -> Array: ...
def to_si(
    values: ArrayLike | float, unit: str, si_unit: str, *, name: str = "value", place: str | None = None
) -> Array | float:
    """`values` (any shape, or one number) given in `unit`, as doubles in `si_unit`.

    One number is converted exactly and rounded once; an array within 2 units in the last place. Raises InputError that
    names `name`, the unit and the dimension expected (and `place`, a file), where the dimension is another.
    """
    scalar = isinstance(values, int | float)
    if unit == si_unit:
        return float(values) if scalar else np.asarray(values, dtype=np.float64)  # type: ignore[arg-type]
    conversion = _look_up(unit, si_unit, name, place)
    if scalar:
        number = float(values)  # type: ignore[arg-type]
        return _convert_one(Fraction(repr(number)), conversion) if math.isfinite(number) else number
    factor, pi_power, before, after = conversion
    result = np.array(values, dtype=np.float64)
    if before:
        result += float(before)
    if factor.numerator == 1 and float(factor.denominator) == factor.denominator:
        result /= float(factor.denominator)
    else:
        result *= float(factor)
    if pi_power:
        result *= math.pi**pi_power
    if after:
        result -= float(after)
    return result


@overload
def from_si(values: float, unit: str, si_unit: str, *, name: str = ..., place: str | None = ...) -> float: ...
@overload
def from_si(values: ArrayLike, unit: str, si_unit: str, *, name: str = ..., place: str | None = ...) -> Array: ...
def from_si(
    values: ArrayLike | float, unit: str, si_unit: str, *, name: str = "value", place: str | None = None
) -> Array | float:
    """`values` in `si_unit`, as doubles in `unit`; the inverse of `to_si`, with the same errors."""
    _look_up(unit, si_unit, name, place)
    return to_si(values, si_unit, unit, name=name, place=place)


def parse_quantity(
    value: float | str, si_unit: str, *, name: str = "value", place: str | None = None, finite: bool = True
) -> float:
    """Return the number that a text such as ``2[L/min]``, ``3 psi`` or ``5`` (already SI) stands for, in `si_unit`.

    A number is taken as SI. Raises InputError where there is no number, for another dimension, and, if `finite`, for an
    infinite one or NaN.
    """
    where = f" ({place})" if place else ""
    text = value if isinstance(value, str) else ""
    if isinstance(value, Real) and not isinstance(value, bool):
        text = repr(float(value))
    match = _NUMBER.fullmatch(text) if len(text) <= _LONGEST_TEXT else None
    if match is None:
        shown = repr(value[:60] if isinstance(value, str) else value)
        raise InputError(f"{name} must be a number with or without a unit, such as 2[{si_unit}], got {shown}{where}")
    rest = match["rest"].strip()
    unit = (rest[1:-1] if rest.startswith("[") and rest.endswith("]") else rest) if rest else si_unit
    number = float(match["number"])
    if not math.isfinite(number) or number == 0:  # exact arithmetic is for finite numbers; 1e-999999 is 0
        result = to_si(number, unit, si_unit, name=name, place=place)
    elif unit == si_unit:
        result = number
    else:
        result = _convert_one(Fraction(match["number"]), _look_up(unit, si_unit, name, place))
    if finite and not math.isfinite(result):
        raise InputError(f"{name} must be a finite number, got {text[:60].strip()}{where}")
    return result
