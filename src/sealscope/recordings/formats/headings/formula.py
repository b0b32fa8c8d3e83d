"""Formulas of a map: a channel as a constant plus columns times factors, ``ch2*0.0625-0.625 bar``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite

from sealscope.errors import InputError

_RULE = "a formula of a map must be a constant plus columns times factors, such as ch2*0.0625-0.625 bar"
_LONGEST, _DEEPEST = 400, 20
#: A number, the name of a column (`PG_1`, `Rig.p`, `#2`, or any text between backquotes), a sign.
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)(?![\w.])|(?P<name>#\d+|[^\W\d][\w.]*|`[^`]+`)"
    r"|(?P<sign>[-+*/()]))"
)


@dataclass(frozen=True)
class Formula:
    """`constant` plus the sum of columns times their `factors`; `unit`: as written behind, None where none is."""

    factors: Mapping[str, float]
    constant: float = 0.0
    unit: str | None = None

    @classmethod
    def parse(cls, text: str) -> Formula:
        """Parse sums, products with numbers, quotients by numbers and brackets; the rest of the text is the unit.

        Nothing is evaluated as Python. Raises InputError for any other text, such as a product of two columns.
        """
        if len(text) > _LONGEST:
            raise InputError(f"{_RULE}, got {len(text)} signs")
        reader = _Reader(text)
        value = reader.sum(0)
        unit = text[reader.at :].strip()
        unit = unit[1:-1].strip() if unit.startswith("[") and unit.endswith("]") else unit
        if unit and not text[reader.at].isspace() and text[reader.at] != "[":
            raise reader.error()
        if not value.factors or not all(map(isfinite, (value.constant, *value.factors.values()))):
            raise reader.error()
        return cls(value.factors, value.constant, unit or None)

    def plus(self, other: Formula) -> Formula:
        """Return the sum of two formulas."""
        names = dict.fromkeys((*self.factors, *other.factors))
        factors = {name: self.factors.get(name, 0.0) + other.factors.get(name, 0.0) for name in names}
        return Formula(factors, self.constant + other.constant)

    def times(self, factor: float) -> Formula:
        """Return the formula times a number."""
        return Formula({name: factor * own for name, own in self.factors.items()}, factor * self.constant)


class _Reader:
    """Reads a formula from the left by recursive descent; `at`: where what is read ends."""

    def __init__(self, text: str) -> None:
        self.text, self.at = text, 0

    def error(self) -> InputError:
        return InputError(f"{_RULE}, got {self.text[:80]!r}")

    def sign(self, signs: str) -> str:
        """Return the next sign where it is one of these, and go behind it; empty otherwise."""
        match = _TOKEN.match(self.text, self.at)
        if match is None or not match["sign"] or match["sign"] not in signs:
            return ""
        self.at = match.end()
        return match["sign"]

    def sum(self, depth: int) -> Formula:
        value = self.product(depth)
        while sign := self.sign("+-"):
            value = value.plus(self.product(depth).times(-1.0 if sign == "-" else 1.0))
        return value

    def product(self, depth: int) -> Formula:
        value = self.factor(depth)
        while sign := self.sign("*/"):
            other = self.factor(depth)
            if sign == "*" and not value.factors:
                value, other = other, value
            if other.factors or (sign == "/" and other.constant == 0.0):
                raise self.error()
            value = value.times(other.constant if sign == "*" else 1.0 / other.constant)
        return value

    def factor(self, depth: int) -> Formula:
        if depth > _DEEPEST:
            raise self.error()
        if sign := self.sign("+-("):
            if sign != "(":
                return self.factor(depth + 1).times(-1.0 if sign == "-" else 1.0)
            value = self.sum(depth + 1)
            if not self.sign(")"):
                raise self.error()
            return value
        match = _TOKEN.match(self.text, self.at)
        if match is None or match["sign"]:
            raise self.error()
        self.at = match.end()
        if match["number"]:
            return Formula({}, float(match["number"]))
        return Formula({match["name"].strip("`"): 1.0})
