"""Formulas in a map: a channel computed from columns, such as ``ch2*0.0625-0.625 bar`` or ``rpm*valve/100``."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from math import isfinite
from operator import add, mul, neg, sub, truediv
from typing import Any, Generic, TypeVar, cast

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.channels import Array
from sealscope.units import parse_unit, same_dimension, to_si

#: Name -> function of a formula. `sin`, `cos` and `tan` take an angle, in rad without a unit.
FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    **{"abs": np.abs, "sign": np.sign, "sqrt": np.sqrt},
    **{"sin": np.sin, "cos": np.cos, "tan": np.tan},
}
_OPERATORS: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    **{ast.Add: add, ast.Sub: sub, ast.Mult: mul, ast.Div: truediv}
}
_RULE = (
    "a formula of a map must be numbers and columns with + - * / and "
    f"{', '.join(FUNCTIONS)}, such as ch2*0.0625-0.625 bar or rpm*valve/100"
)
_MAX_LENGTH = 400
#: The name of a column (`PG_1`, `Rig.p`, `#2`, or any text between backquotes), and its name in the syntax tree.
_NAME, _COLUMN = re.compile(r"`([^`]+)`|(#\d+|(?<![\w.])[^\W\d][\w.]*)"), "column{}"
#: Positions where a formula may end and its unit begin.
_END = re.compile(r"\s+(?=\S)|(?=\[)|$")
K = TypeVar("K")
L = TypeVar("L")
#: Text of the unit of a pure number.
_NUMBER = "1"


@dataclass(frozen=True)
class ColumnOperand(Generic[K]):
    """A column in a formula, by its name or number."""

    key: K


@dataclass(frozen=True)
class FormulaOperation(Generic[K]):
    """An operation of a formula on one operand or two."""

    function: Callable[..., Any]
    operands: tuple[Node[K], ...]


Node = float | ColumnOperand[K] | FormulaOperation[K]


@dataclass(frozen=True)
class Formula(Generic[K]):
    """A formula of columns. A column is called by its name or number; `unit`: unit of the result, None if unknown."""

    tree: Node[K]
    unit: str | None = None

    @classmethod
    def of_column(cls, column: K, unit: str | None = None) -> Formula[K]:
        """Make the formula that is a column."""
        return cls(ColumnOperand(column), unit)

    @property
    def column(self) -> K | None:
        """The column of a formula that is just this column; None for other formulas."""
        return self.tree.key if isinstance(self.tree, ColumnOperand) else None

    @property
    def columns(self) -> tuple[K, ...]:
        """The columns of the formula, each once, in their order in it."""
        return tuple(dict.fromkeys(_iter_columns(self.tree)))

    def values(self, columns: Mapping[K, Array]) -> Array:
        """Compute the values (n,), in the formula's unit, from its columns (n,); a single column is not copied."""
        with np.errstate(all="ignore"):
            return cast(Array, _evaluate(self.tree, columns))

    def with_columns(self, find: Callable[[K], L], find_unit: Callable[[L], str | None]) -> Formula[L]:
        """Replace the columns by those that `find` returns, and derive the unit, unless it is stated, from theirs.

        Angles within `sin`, `cos` and `tan` are converted to rad. Per cent and columns without a unit count as pure
        numbers beside others. Raises InputError if units differ in a sum, or if no angle is in such a function.
        """
        tree, unit = _resolve(self.tree, find, find_unit, self.unit is not None)
        return Formula(tree, unit if self.unit is None else self.unit)


def parse_formula(text: str) -> Formula[str]:
    """Parse the text of a formula and the unit after it, such as `2*(ch1 - 0.5) + ch2/4 bar`, without evaluating it.

    The formula is the longest possible beginning of the text. Raises InputError if there is none with a column.
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
            tree = _parse_tree(ast.parse(_NAME.sub(replace_name, text[:end].strip()), mode="eval").body, names)
        except (SyntaxError, ValueError, ArithmeticError, RecursionError, MemoryError):
            continue
        unit = text[end:].strip()
        unit = unit[1:-1].strip() if unit.startswith("[") and unit.endswith("]") else unit
        if not isinstance(tree, float):
            return Formula(tree, unit or None)
    raise InputError(f"{_RULE}, got {text[:80]!r}")


def _parse_tree(tree: ast.expr, names: list[str]) -> Node[str]:
    """Convert the syntax tree of a formula, in which `columnN` is `names[N]`; raise ValueError if it is no formula."""

    def name_of(text: str) -> str:
        """Return the name that stands for `columnN`."""
        return names[int(text.removeprefix("column"))]

    match tree:
        case ast.Name(id=name):
            return ColumnOperand(name_of(name))
        case ast.Constant(value=float() | int() as value) if not isinstance(value, bool):
            return _fold(float, (float(value),))
        case ast.UnaryOp(op=ast.UAdd(), operand=inner):
            return _parse_tree(inner, names)
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            return _fold(neg, (_parse_tree(inner, names),))
        case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _OPERATORS:
            return _fold(_OPERATORS[type(operator)], (_parse_tree(left, names), _parse_tree(right, names)))
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]):
            if (function := FUNCTIONS.get(name_of(name).casefold())) is not None:
                return _fold(function, (_parse_tree(argument, names),))
    raise ValueError("no formula")


def _fold(function: Callable[..., Any], operands: tuple[Node[str], ...]) -> Node[str]:
    """Make an operation, or its value if all operands are numbers; raise ValueError if that is not finite."""
    numbers = [operand for operand in operands if isinstance(operand, float)]
    if function is truediv and operands[1] == 0.0:
        raise ValueError("division by zero")
    if len(numbers) < len(operands):
        return FormulaOperation(function, operands)
    with np.errstate(all="ignore"):
        value = float(function(*numbers))
    if not isfinite(value):
        raise ValueError("not finite")
    return value


def _iter_columns(node: Node[K]) -> list[K]:
    """List the columns of a formula, in order and possibly several times."""
    if isinstance(node, FormulaOperation):
        return reduce(add, (_iter_columns(operand) for operand in node.operands))
    return [node.key] if isinstance(node, ColumnOperand) else []


def _evaluate(node: Node[K], columns: Mapping[K, Array]) -> Array | float:
    """Compute the values (n,) of a part of a formula, or its number."""
    if isinstance(node, FormulaOperation):
        return cast(Array, node.function(*(_evaluate(operand, columns) for operand in node.operands)))
    return columns[node.key] if isinstance(node, ColumnOperand) else node


def _resolve(
    node: Node[K], find: Callable[[K], L], find_unit: Callable[[L], str | None], is_stated: bool
) -> tuple[Node[L], str | None]:
    """Replace the columns of a part of a formula (`Formula.with_columns`); also derive the unit of its values.

    The unit is `_NUMBER` of a pure number, and None if no unit is known. `is_stated`: sums are not checked, as the
    user has stated the unit of the result.
    """
    if isinstance(node, float):
        return node, _NUMBER
    if isinstance(node, ColumnOperand):
        column = find(node.key)
        unit = find_unit(column)
        return ColumnOperand(column), _NUMBER if unit is not None and is_pure_number(unit) else unit
    parts = [_resolve(operand, find, find_unit, is_stated) for operand in node.operands]
    operands, units = tuple(part for part, _ in parts), [unit for _, unit in parts]
    if node.function in (np.sin, np.cos, np.tan):
        (unit,) = units
        if unit not in (None, _NUMBER):
            if not same_dimension(unit, "rad"):
                raise InputError(f"{node.function.__name__} in a formula of a map must have an angle, got {unit}")
            operands = (FormulaOperation(mul, (operands[0], float(to_si(1.0, unit, "rad", name="angle")))),)
        return FormulaOperation(node.function, operands), _NUMBER
    if node.function is np.sign:
        return FormulaOperation(node.function, operands), _NUMBER
    if node.function is np.sqrt:
        return FormulaOperation(node.function, operands), units[0] if units[0] in (
            None,
            _NUMBER,
        ) else f"({units[0]})^0.5"
    if node.function in (mul, truediv):
        return FormulaOperation(node.function, operands), _multiply_units(
            units, "/" if node.function is truediv else " "
        )
    known = list(dict.fromkeys(unit for unit in units if unit not in (None, _NUMBER)))
    if len(known) > 1 and not is_stated:
        raise InputError(f"a formula of a map must state its unit, got a sum of columns in {' and '.join(known)}")
    return FormulaOperation(node.function, operands), known[0] if known else None if None in units else _NUMBER


def _multiply_units(units: list[str | None], joint: str) -> str | None:
    """Derive the unit of a product (`joint` " ") or quotient ("/") of two values; one without a unit is a number."""
    first, second = units
    if second in (None, _NUMBER):
        return None if first in (None, _NUMBER) and None in units else first
    if first in (None, _NUMBER):
        return second if joint == " " else f"1/({second})"
    return f"({first}){joint}({second})"


def is_pure_number(unit: str) -> bool:
    """Test whether a text is the unit of a pure number, such as %."""
    try:
        return parse_unit(unit).powers == ()
    except InputError:
        return False
