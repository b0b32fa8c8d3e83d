"""Formulas of a map: a channel as a constant plus columns times factors, ``ch2*0.0625-0.625 bar``."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite

from sealscope.errors import InputError

_RULE = "a formula of a map must be a constant plus columns times factors, such as ch2*0.0625-0.625 bar"
_LONGEST = 400
#: The name of a column: `PG_1`, `Rig.p`, `#2`, or any text between backquotes; its number in the syntax tree.
_NAME, _COLUMN = re.compile(r"`([^`]+)`|(#\d+|(?<![\w.])[^\W\d][\w.]*)"), "column{}"
#: Where a formula may end and its unit begin.
_END = re.compile(r"\s+(?=\S)|(?=\[)|$")


@dataclass(frozen=True)
class Formula:
    """`constant` plus the sum of columns times their `factors`; `unit`: as written behind, None where none is."""

    factors: Mapping[str, float]
    constant: float = 0.0
    unit: str | None = None

    @classmethod
    def parse(cls, text: str) -> Formula:
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
                return cls(value.factors, value.constant, unit or None)
        raise InputError(f"{_RULE}, got {text[:80]!r}")

    def plus(self, other: Formula, times: float = 1.0) -> Formula:
        """Return the sum of this formula and `times` another."""
        factors = dict(self.factors)
        for name, factor in other.factors.items():
            factors[name] = factors.get(name, 0.0) + times * factor
        return Formula(factors, self.constant + times * other.constant)


def _linear(tree: ast.expr, names: list[str]) -> Formula:
    """Return the formula of a syntax tree; raise ValueError where it is not linear in the columns."""
    zero = Formula({})
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
