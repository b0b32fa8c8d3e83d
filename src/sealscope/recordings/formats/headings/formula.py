"""Formulas of a map: a channel as a constant plus columns times factors, ``ch2*0.0625-0.625 bar``."""

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
_LONGEST = 400
#: The name of a column: `PG_1`, `Rig.p`, `#2`, or any text between backquotes; its number in the syntax tree.
_NAME, _COLUMN = re.compile(r"`([^`]+)`|(#\d+|(?<![\w.])[^\W\d][\w.]*)"), "column{}"
#: Where a formula may end and its unit begin.
_END = re.compile(r"\s+(?=\S)|(?=\[)|$")
K = TypeVar("K")


@dataclass(frozen=True)
class Formula(Generic[K]):
    """`constant` plus the sum of columns, by name or number, times their `factors`, in `unit`, None where none is."""

    factors: Mapping[K, float]
    constant: float = 0.0
    unit: str | None = None

    @property
    def column(self) -> K | None:
        """The column that it is, as it stands; None for a sum or a product."""
        return next(iter(self.factors)) if self.constant == 0.0 and [*self.factors.values()] == [1.0] else None

    def plus(self, other: Formula[K], times: float = 1.0) -> Formula[K]:
        """Return the sum of this formula and `times` another."""
        factors = dict(self.factors)
        for name, factor in other.factors.items():
            factors[name] = factors.get(name, 0.0) + times * factor
        return Formula(factors, self.constant + times * other.constant)

    def values(self, columns: Mapping[K, Array]) -> Array:
        """Return the samples (n,) in `unit`: those of the only column itself, where it is one."""
        if self.column is not None:
            return columns[self.column]
        with np.errstate(over="ignore", invalid="ignore"):
            terms = [factor * columns[column] for column, factor in self.factors.items()]
            return np.asarray(self.constant + np.sum(terms, axis=0))


def parse_formula(text: str) -> Formula[str]:
    """Parse sums, products with numbers, quotients by numbers and brackets; the rest of the text is the unit.

    Only the syntax is Python's: nothing is evaluated. The longest beginning of the text that is a formula is taken.
    Raises InputError for any other text, such as a product of two columns.
    """
    if len(text) > _LONGEST:
        raise InputError(f"{_RULE}, got {len(text)} signs")
    for end in sorted({match.start() for match in _END.finditer(text)}, reverse=True):
        names: list[str] = []

        def column(match: re.Match[str], names: list[str] = names) -> str:
            names.append(match[1] or match[2])
            return _COLUMN.format(len(names) - 1)

        try:
            tree = ast.parse(_NAME.sub(column, text[:end].strip()), mode="eval").body
            value = _linear(tree, names)
        except (SyntaxError, ValueError, ArithmeticError, RecursionError, MemoryError):
            continue
        unit = text[end:].strip()
        unit = unit[1:-1].strip() if unit.startswith("[") and unit.endswith("]") else unit
        if value.factors and all(map(isfinite, (value.constant, *value.factors.values()))):
            return Formula(value.factors, value.constant, unit or None)
    raise InputError(f"{_RULE}, got {text[:80]!r}")


def _linear(tree: ast.expr, names: list[str]) -> Formula[str]:
    """Return the formula of a syntax tree; raise ValueError where it is not linear in the columns."""
    zero = Formula[str]({})
    match tree:
        case ast.Name(id=name):
            return Formula({names[int(name.removeprefix("column"))]: 1.0})
        case ast.Constant(value=float() | int() as value) if not isinstance(value, bool):
            return Formula({}, float(value))
        case ast.UnaryOp(op=ast.UAdd() | ast.USub() as sign, operand=inner):
            return zero.plus(_linear(inner, names), -1.0 if isinstance(sign, ast.USub) else 1.0)
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as sign, right=right):
            return _linear(left, names).plus(_linear(right, names), -1.0 if isinstance(sign, ast.Sub) else 1.0)
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as sign, right=right):
            product, other = _linear(left, names), _linear(right, names)
            if isinstance(sign, ast.Mult) and not product.factors:
                product, other = other, product
            if not other.factors:
                return zero.plus(product, other.constant if isinstance(sign, ast.Mult) else 1.0 / other.constant)
    raise ValueError("not linear")
