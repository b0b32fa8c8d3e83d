"""Formulas in a map: a channel as a constant plus columns times factors, such as ``ch2*0.0625-0.625 bar``."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Generic, TypeVar

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.channels import Array

_RULE = "a formula of a map must be a constant plus columns times factors, such as ch2*0.0625-0.625 bar"
_MAX_LENGTH = 400
#: The name of a column (`PG_1`, `Rig.p`, `#2`, or any text between backquotes), and its name in the syntax tree.
_NAME, _COLUMN = re.compile(r"`([^`]+)`|(#\d+|(?<![\w.])[^\W\d][\w.]*)"), "column{}"
#: Positions where a formula may end and its unit begin.
_END = re.compile(r"\s+(?=\S)|(?=\[)|$")
K = TypeVar("K")


@dataclass(frozen=True)
class Formula(Generic[K]):
    """A linear formula: `constant` plus the sum of columns times their `factors`.

    A column is called by its name or number. `unit`: unit of the result, None if unknown.
    """

    factors: Mapping[K, float]
    constant: float = 0.0
    unit: str | None = None

    @property
    def column(self) -> K | None:
        """The only column of a formula that has the factor 1 and no constant; None for other formulas."""
        return next(iter(self.factors)) if self.constant == 0.0 and [*self.factors.values()] == [1.0] else None

    def plus(self, other: Formula[K], times: float = 1.0) -> Formula[K]:
        """Add another formula, multiplied by `times`, to this one; the sum has no unit."""
        factors = dict(self.factors)
        for name, factor in other.factors.items():
            factors[name] = factors.get(name, 0.0) + times * factor
        return Formula(factors, self.constant + times * other.constant)

    def values(self, columns: Mapping[K, Array]) -> Array:
        """Compute the values (n,), in the formula's unit, from its columns (n,); a single column is not copied."""
        if self.column is not None:
            return columns[self.column]
        with np.errstate(over="ignore", invalid="ignore"):
            terms = [factor * columns[column] for column, factor in self.factors.items()]
            return np.asarray(self.constant + np.sum(terms, axis=0))


def parse_formula(text: str) -> Formula[str]:
    """Parse the text of a formula and the unit after it, such as `2*(ch1 - 0.5) + ch2/4 bar`, without evaluating it.

    The formula is the longest possible beginning of the text. Raises InputError if there is none that is linear.
    """
    if len(text) > _MAX_LENGTH:
        raise InputError(f"{_RULE}, got {len(text)} characters")
    for end in sorted({match.start() for match in _END.finditer(text)}, reverse=True):  # the longest formula first
        names: list[str] = []

        def replace_name(match: re.Match[str], names: list[str] = names) -> str:
            """Append a column's name to `names` of this step of the loop; return `columnN`, which Python can parse."""
            names.append(match[1] or match[2])
            return _COLUMN.format(len(names) - 1)

        try:
            tree = ast.parse(_NAME.sub(replace_name, text[:end].strip()), mode="eval").body
            value = _parse_linear(tree, names)
        except (SyntaxError, ValueError, ArithmeticError, RecursionError, MemoryError):
            continue
        unit = text[end:].strip()
        unit = unit[1:-1].strip() if unit.startswith("[") and unit.endswith("]") else unit
        if value.factors and all(map(isfinite, (value.constant, *value.factors.values()))):
            return Formula(value.factors, value.constant, unit or None)
    raise InputError(f"{_RULE}, got {text[:80]!r}")


def _parse_linear(tree: ast.expr, names: list[str]) -> Formula[str]:
    """Convert the syntax tree of a formula, in which `columnN` is `names[N]`; raise ValueError if it is not linear."""
    empty = Formula[str]({})  # `empty.plus(formula, number)` is `formula` times `number`
    match tree:
        case ast.Name(id=name):
            return Formula({names[int(name.removeprefix("column"))]: 1.0})
        case ast.Constant(value=float() | int() as value) if not isinstance(value, bool):
            return Formula({}, float(value))
        case ast.UnaryOp(op=ast.UAdd() | ast.USub() as operator, operand=inner):
            return empty.plus(_parse_linear(inner, names), -1.0 if isinstance(operator, ast.USub) else 1.0)
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as operator, right=right):
            return _parse_linear(left, names).plus(
                _parse_linear(right, names), -1.0 if isinstance(operator, ast.Sub) else 1.0
            )
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as operator, right=right):
            formula, number = _parse_linear(left, names), _parse_linear(right, names)
            if isinstance(operator, ast.Mult) and not formula.factors:
                formula, number = number, formula
            if not number.factors:
                return empty.plus(formula, number.constant if isinstance(operator, ast.Mult) else 1.0 / number.constant)
    raise ValueError("not linear")
