"""Statements and expressions of a program on one state record: what `specialise` writes, and each language renders.

A program has no pointers and allocates nothing. Its state is a record of numbers and arrays with fixed sizes. An
array's element has one index, computed from the sizes. Functions have scalars as parameters, and return any number of
scalars. Expressions have no side effects.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

#: Type of a number: floating point, whole, or truth value.
Kind = Literal["real", "whole", "truth"]


@dataclass(frozen=True)
class Constant:
    """A number that is known when the program is written."""

    value: float | int | bool
    kind: Kind


@dataclass(frozen=True)
class Local:
    """A local variable or parameter of a function."""

    name: str
    kind: Kind


@dataclass(frozen=True)
class Element:
    """A number of the state: the field `name`, or if that is an array, its element `index`."""

    name: str
    index: Expression | None
    kind: Kind


@dataclass(frozen=True)
class TableElement:
    """The element `index` of the constant table `name`."""

    name: str
    index: Expression
    kind: Kind


@dataclass(frozen=True)
class Operation:
    """An operator or a function of mathematics, such as "+", "floor_mod", "log", applied to its operands.

    Operators: + - * / (real, or whole for the first three), floor_div, floor_mod (whole), negative, < <= > >= == !=,
    not, and, or (of truth values; the second operand is evaluated only where it decides), select (condition, value if
    true, value if false; only the chosen value is evaluated), real, whole, truth (conversions; whole drops the
    fraction), absolute, log, log1p, exp, sqrt, hypot, power, floor, ceil, log_gamma, is_nan, is_finite.
    """

    operator: str
    operands: tuple[Expression, ...]
    kind: Kind


Expression = Constant | Local | Element | TableElement | Operation
#: What a value is assigned to.
Target = Local | Element


@dataclass(frozen=True)
class Assign:
    """Assign a value to a variable or to a number of the state."""

    target: Target
    value: Expression


@dataclass(frozen=True)
class If:
    """Run `body` if the condition is true, else `otherwise`."""

    condition: Expression
    body: tuple[Statement, ...]
    otherwise: tuple[Statement, ...] = ()


@dataclass(frozen=True)
class For:
    """Run `body` for each whole value of `variable` from `start` to `stop` - 1; both are constants or variables."""

    variable: Local
    start: Expression
    stop: Expression
    body: tuple[Statement, ...]


@dataclass(frozen=True)
class While:
    """Run `body` as long as the condition is true."""

    condition: Expression
    body: tuple[Statement, ...]


@dataclass(frozen=True)
class Break:
    """Leave the innermost loop."""


@dataclass(frozen=True)
class Return:
    """Leave the function; the values are those of `Function.results`."""

    values: tuple[Expression, ...]


@dataclass(frozen=True)
class Call:
    """Call a function of the program, and assign its results; None for a result that is not used."""

    function: str
    arguments: tuple[Expression, ...]
    results: tuple[Local | None, ...]


Statement = Assign | If | For | While | Break | Return | Call


@dataclass
class Function:
    """A function of a program: its parameters, the kinds of its results, its local variables and its statements."""

    name: str
    summary: str
    parameters: tuple[Local, ...] = ()
    results: tuple[Kind, ...] = ()
    variables: dict[str, Kind] = field(default_factory=dict)
    body: tuple[Statement, ...] = ()


@dataclass(frozen=True)
class StateField:
    """A field of the state: a number (size None), or an array of `size` numbers; `comment` says what it holds."""

    name: str
    kind: Kind
    size: int | None
    comment: str = ""


@dataclass(frozen=True)
class Program:
    """The fields of the state, constant tables, and functions, each after those that it calls."""

    fields: tuple[StateField, ...]
    tables: Mapping[str, tuple[float | int, ...]]
    functions: tuple[Function, ...]

    def function(self, name: str) -> Function:
        """Return the function `name`."""
        return next(function for function in self.functions if function.name == name)


def parts(value: Expression) -> Iterator[Expression]:
    """Yield an expression and all expressions within it."""
    yield value
    if isinstance(value, Operation):
        for operand in value.operands:
            yield from parts(operand)
    elif isinstance(value, (Element, TableElement)) and value.index is not None:
        yield from parts(value.index)


def iter_expressions(statements: Iterable[Statement]) -> Iterator[Expression]:
    """Yield the expressions of statements and of those within them, and what they assign to."""
    for statement in statements:
        if isinstance(statement, Assign):
            yield from (statement.value, statement.target)
        elif isinstance(statement, If):
            yield statement.condition
            yield from iter_expressions((*statement.body, *statement.otherwise))
        elif isinstance(statement, While):
            yield statement.condition
            yield from iter_expressions(statement.body)
        elif isinstance(statement, For):
            yield from (statement.start, statement.stop)
            yield from iter_expressions(statement.body)
        elif isinstance(statement, Return):
            yield from statement.values
        elif isinstance(statement, Call):
            yield from statement.arguments


def iter_calls(statements: Iterable[Statement]) -> Iterator[Call]:
    """Yield the calls of statements and of those within them."""
    for statement in statements:
        if isinstance(statement, Call):
            yield statement
        elif isinstance(statement, If):
            yield from iter_calls((*statement.body, *statement.otherwise))
        elif isinstance(statement, (For, While)):
            yield from iter_calls(statement.body)


def iter_read_names(statements: Iterable[Statement]) -> Iterator[str]:
    """Yield the names of the variables and parameters that statements read."""
    for statement in statements:
        if isinstance(statement, Assign):
            target = statement.target
            values: tuple[Expression, ...] = (statement.value,)
            values += () if isinstance(target, Local) or target.index is None else (target.index,)
        elif isinstance(statement, (If, While)):
            values = (statement.condition,)
            yield from iter_read_names((*statement.body, *(statement.otherwise if isinstance(statement, If) else ())))
        elif isinstance(statement, For):
            values = (statement.start, statement.stop)
            yield from iter_read_names(statement.body)
        elif isinstance(statement, Return):
            values = statement.values
        else:
            values = statement.arguments if isinstance(statement, Call) else ()
        yield from (part.name for value in values for part in parts(value) if isinstance(part, Local))


def iter_written_names(statements: Iterable[Statement]) -> Iterator[str]:
    """Yield the names of the variables that statements write."""
    for statement in statements:
        if isinstance(statement, Assign):
            yield from (statement.target.name,) if isinstance(statement.target, Local) else ()
        elif isinstance(statement, Call):
            yield from (variable.name for variable in statement.results if variable is not None)
        elif isinstance(statement, If):
            yield from iter_written_names((*statement.body, *statement.otherwise))
        elif isinstance(statement, (For, While)):
            yield from (statement.variable.name,) if isinstance(statement, For) else ()
            yield from iter_written_names(statement.body)


def drop_unread(statements: Iterable[Statement], read: Container[str], changing: Container[str]) -> Iterator[Statement]:
    """Yield statements without those whose only effect is on variables other than those in `read`.

    `changing`: names of the functions that change the state.
    """
    for statement in statements:
        if isinstance(statement, Call) and statement.function not in changing:
            is_read = any(variable is not None and variable.name in read for variable in statement.results)
            if not is_read:
                continue
        if isinstance(statement, Assign) and isinstance(statement.target, Local) and statement.target.name not in read:
            continue
        if isinstance(statement, If):
            body, otherwise = (
                tuple(drop_unread(part, read, changing)) for part in (statement.body, statement.otherwise)
            )
            if not body and not otherwise:
                continue
            condition = statement.condition if body else Operation("not", (statement.condition,), "truth")
            yield If(condition, body or otherwise, otherwise if body else ())
        elif isinstance(statement, (For, While)):
            yield replace(statement, body=tuple(drop_unread(statement.body, read, changing)))
        else:
            yield statement
