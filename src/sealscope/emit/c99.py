"""Render a program as C99: a header and a source without heap, recursion and libraries other than ``math.h``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Literal

from sealscope.emit.program import (
    Assign,
    Break,
    Call,
    Constant,
    Element,
    Expression,
    For,
    Function,
    If,
    Kind,
    Local,
    Operation,
    Program,
    Return,
    Statement,
    TableElement,
    Target,
    While,
    iter_calls,
    iter_expressions,
    parts,
)

Precision = Literal["double", "single"]
#: Functions of math.h, whose names have an f at the end for single precision.
_MATH = {
    **{"absolute": "fabs", "log": "log", "log1p": "log1p", "exp": "exp", "sqrt": "sqrt", "hypot": "hypot"},
    **{"power": "pow", "log_gamma": "lgamma", "floor": "floor", "ceil": "ceil"},
    "copysign": "copysign",
}
#: Name of the pointer to the state.
_STATE = "record"
_BINARY = {"+": "+", "-": "-", "*": "*", "/": "/", "and": "&&", "or": "||"}
_COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
#: Helpers that a source begins with: whole quotients and remainders towards minus infinity, as of Python.
_HELPERS = """\
static int32_t floor_div(int32_t a, int32_t b)
{
    const int32_t quotient = a / b;
    return (((a % b) != 0) && ((a < 0) != (b < 0))) ? (quotient - 1) : quotient;
}

static int32_t floor_mod(int32_t a, int32_t b)
{
    const int32_t rest = a % b;
    return ((rest != 0) && ((rest < 0) != (b < 0))) ? (rest + b) : rest;
}
"""


class CText:
    """A program as C99 with names that begin with `prefix`."""

    def __init__(self, program: Program, prefix: str, precision: Precision = "double") -> None:
        self._program, self._prefix, self._precision = program, prefix, precision
        self._types: dict[Kind, str] = {"real": f"{prefix}_real", "whole": "int32_t", "truth": "bool"}

    @property
    def real_type(self) -> str:
        """C's type of a real number."""
        return "double" if self._precision == "double" else "float"

    def declare_state(self) -> str:
        """Declare the types of real numbers and of the state."""
        lines = [f"typedef {self.real_type} {self._prefix}_real;", "", "typedef struct {"]
        for field in self._program.fields:
            size = "" if field.size is None else f"[{field.size}]"
            comment = f" /* {field.comment} */" if field.comment else ""
            lines.append(f"    {self._types[field.kind]} {field.name}{size};{comment}")
        return "\n".join([*lines, f"}} {self._prefix}_state;"])

    def declare_function(self, function: Function, static: bool = False) -> str:
        """Declare a function: a single result is returned, several are written to the last arguments."""
        results = function.results
        parameters = [
            f"{self._prefix}_state *{_STATE}",
            *(f"{self._types[p.kind]} {p.name}" for p in function.parameters),
        ]
        parameters += [f"{self._types[kind]} *result_{k}" for k, kind in enumerate(results)] if len(results) > 1 else []
        returned = self._types[results[0]] if len(results) == 1 else "void"
        return f"{'static ' if static else ''}{returned} {self._prefix}_{function.name}({', '.join(parameters)})"

    def render_source(self, public: Iterable[str]) -> str:
        """Render helpers, tables and functions; those not in `public` are static."""
        names = set(public)
        used = set().union(*map(_operators, self._program.functions))
        helpers = [text + "}\n" for text in _HELPERS.split("\n}\n") if text.strip()]
        chunks = [text.lstrip("\n") for text in helpers if any(f" {name}(" in text for name in used)]
        for name, values in self._program.tables.items():
            kind: Kind = "real" if any(isinstance(value, float) for value in values) else "whole"
            numbers = ", ".join(self._constant(Constant(value, kind)) for value in values)
            chunks.append(f"static const {self._types[kind]} {self._table(name)}[{len(values)}] = {{{numbers}}};\n")
        functions = self._program.functions
        chunks += [
            "\n".join(self._render_function(function, function.name not in names)) + "\n" for function in functions
        ]
        return "\n".join(chunks)

    def _table(self, name: str) -> str:
        """Return the name of a table in C."""
        return f"{self._prefix}_{name}"

    def _render_function(self, function: Function, static: bool) -> Iterator[str]:
        """Yield the lines of a function."""
        self._results = function.results
        if function.summary:
            yield f"/* {function.summary.replace('*/', '* /')} */"
        yield self.declare_function(function, static)
        yield "{"
        for name, kind in function.variables.items():
            zero = {"real": self._real(0.0), "whole": "0", "truth": "false"}[kind]
            yield f"    {self._types[kind]} {name} = {zero};"
        if not _uses_state(function):
            yield f"    (void){_STATE};"
        yield from self._render_block(function.body, "    ")
        yield "}"

    def _render_block(self, statements: Iterable[Statement], indent: str) -> Iterator[str]:
        """Yield the lines of statements."""
        for statement in statements:
            yield from self._render(statement, indent)

    def _render(self, statement: Statement, indent: str) -> Iterator[str]:
        """Yield the lines of a statement."""
        inner = indent + "    "
        if isinstance(statement, Assign):
            yield f"{indent}{self._place(statement.target)} = {self._expression(statement.value)};"
        elif isinstance(statement, If):
            yield f"{indent}if ({self._condition(statement.condition)}) {{"
            yield from self._render_block(statement.body, inner)
            if statement.otherwise:
                yield f"{indent}}} else {{"
                yield from self._render_block(statement.otherwise, inner)
            yield f"{indent}}}"
        elif isinstance(statement, For):
            name = statement.variable.name
            start, stop = self._expression(statement.start), self._expression(statement.stop)
            yield f"{indent}for ({name} = {start}; {name} < {stop}; ++{name}) {{"
            yield from self._render_block(statement.body, inner)
            yield f"{indent}}}"
        elif isinstance(statement, While):
            yield f"{indent}while ({self._condition(statement.condition)}) {{"
            yield from self._render_block(statement.body, inner)
            yield f"{indent}}}"
        elif isinstance(statement, Break):
            yield f"{indent}break;"
        elif isinstance(statement, Return):
            yield from self._render_return(statement, indent)
        else:
            yield self._render_call(statement, indent)

    def _render_return(self, statement: Return, indent: str) -> Iterator[str]:
        """Yield the lines of a return."""
        if len(statement.values) == 1:
            yield f"{indent}return {self._expression(statement.values[0])};"
            return
        for k, value in enumerate(statement.values):
            yield f"{indent}*result_{k} = {self._expression(value)};"
        yield f"{indent}return;"

    def _render_call(self, statement: Call, indent: str) -> str:
        """Render a call."""
        function = self._program.function(statement.function)
        arguments = [_STATE, *map(self._expression, statement.arguments)]
        single = len(function.results) == 1
        if not single:
            arguments += [f"&{variable.name}" for variable in statement.results if variable is not None]
        call = f"{self._prefix}_{statement.function}({', '.join(arguments)});"
        return f"{indent}{statement.results[0].name} = {call}" if single and statement.results[0] else indent + call

    def _place(self, target: Target) -> str:
        """Render what is assigned to."""
        return target.name if isinstance(target, Local) else self._element(target)

    def _element(self, element: Element) -> str:
        """Render a number of the state."""
        return f"{_STATE}->{element.name}" + ("" if element.index is None else f"[{self._expression(element.index)}]")

    def _real(self, value: float) -> str:
        """Render a real constant."""
        if math.isnan(value) or math.isinf(value):
            name = "NAN" if math.isnan(value) else "INFINITY"
            return f"{'-' if value < 0 else ''}({self._types['real']}){name}"
        if self._precision == "single" and 0.0 < abs(value) < 1.2e-38:
            value = math.copysign(1.2e-38, value)
        return repr(float(value)) + ("f" if self._precision == "single" else "")

    def _constant(self, constant: Constant) -> str:
        """Render a constant."""
        if constant.kind == "real":
            text = self._real(float(constant.value))
        elif constant.kind == "truth":
            return "true" if constant.value else "false"
        else:
            text = str(int(constant.value))
        return f"({text})" if text.startswith("-") else text

    def _expression(self, value: Expression) -> str:
        """Render an expression, in brackets if it is an operation."""
        if isinstance(value, Constant):
            return self._constant(value)
        if isinstance(value, Local):
            return value.name
        if isinstance(value, Element):
            return self._element(value)
        if isinstance(value, TableElement):
            return f"{self._table(value.name)}[{self._expression(value.index)}]"
        return self._operation(value)

    def _condition(self, value: Expression) -> str:
        """Render an expression that stands in brackets already."""
        text = self._expression(value)
        is_bracketed = isinstance(value, Operation) and value.operator in (*_BINARY, *_COMPARISONS)
        return text[1:-1] if is_bracketed else text

    def _operation(self, value: Operation) -> str:
        """Render an operation."""
        name, operands = value.operator, [self._expression(operand) for operand in value.operands]
        if name in _BINARY or name in _COMPARISONS:
            return f"({operands[0]} {_BINARY.get(name, name)} {operands[1]})"
        if name == "select":
            return f"({operands[0]} ? {operands[1]} : {operands[2]})"
        if name == "not":
            return f"(!{operands[0]})"
        if name == "negative":
            return f"(-{operands[0]})"
        if name in ("floor_div", "floor_mod"):
            return f"{name}({', '.join(operands)})"
        if name == "truth":
            return f"({operands[0]} != 0)"
        if name in ("real", "whole"):
            if value.operands[0].kind == "truth":
                numbers = ("1", "0") if name == "whole" else (self._real(1.0), self._real(0.0))
                return f"({operands[0]} ? {numbers[0]} : {numbers[1]})"
            return f"({self._types[value.kind]})({operands[0]})"
        if name in ("is_nan", "is_finite"):
            return f"({'isnan' if name == 'is_nan' else 'isfinite'}({operands[0]}) != 0)"
        if name == "absolute" and value.kind == "whole":
            return f"(({operands[0]} < 0) ? (-{operands[0]}) : {operands[0]})"
        call = f"{_MATH[name]}{'f' if self._precision == 'single' else ''}({', '.join(operands)})"
        return f"({self._types['whole']}){call}" if value.kind == "whole" else call


def _operators(function: Function) -> set[str]:
    """Collect the operators of a function."""
    values = (part for value in iter_expressions(function.body) for part in parts(value))
    return {part.operator for part in values if isinstance(part, Operation)}


def _uses_state(function: Function) -> bool:
    """Return True if a function reads or writes the state, or calls a function, which gets it."""
    values = (part for value in iter_expressions(function.body) for part in parts(value))
    return any(isinstance(part, Element) for part in values) or any(True for _ in iter_calls(function.body))
