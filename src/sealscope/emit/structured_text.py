"""Render a program as Structured Text of IEC 61131-3, edition 2: a data type of the state, and a function block each.

Edition 2 has no conditional expression, evaluates both operands of AND and OR, and compares names without regard to
case; compilers differ in how they read literals above 1E38 and names that are words of the language. So a conditional
expression becomes IF, names are made unique, and large literals products. A function block of the program gets the
state as VAR_IN_OUT, which passes a reference.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from itertools import count

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
from sealscope.errors import InputError

_TYPES: dict[Kind, str] = {"real": "LREAL", "whole": "DINT", "truth": "BOOL"}
_BINARY = {"+": "+", "-": "-", "*": "*", "/": "/", "and": "AND", "or": "OR", "==": "=", "!=": "<>"}
_BINARY |= {name: name for name in ("<", "<=", ">", ">=")}
_FUNCTIONS = {"absolute": "ABS", "log": "LN", "exp": "EXP", "sqrt": "SQRT"}
#: Words that a name must not be: keywords, types, standard functions and blocks of IEC 61131-3, and of SFC and IL.
_RESERVED_TEXT = """\
abs acos action add and andn any array asin at atan bool by byte cal calc calcn case concat configuration constant cos
ct ctd ctu ctud cu cv date day dint div do dt dword edge else elsif end eq exit exp expt f_edge f_trig false find for
from function function_block ge goto gt if in initial insert int interval jmp jmpc jmpcn ld ldn le left len limit lint
ln log lreal lt lword max mid min mod move mul mux ne not of on or orn parameter persistent pointer priority program
pt q r r1 r_edge r_trig read_only read_write real ref_to reference repeat replace resource ret retain retc retcn
return right rol ror rs rtc s s1 sd sel sema shl shr sin single sint sl sqrt sr st step stn string struct sub super
tan task then this time tod tof ton to tp transition true trunc type udint uint ulint until usint var while with word
wstring xor xorn
"""
RESERVED = frozenset(_RESERVED_TEXT.split())
#: Limit of a literal, and the factor by which larger ones are written.
_LARGEST = 1e38


class StText:
    """A program as Structured Text; `prefix` begins the names of its types and function blocks."""

    def __init__(self, program: Program, prefix: str) -> None:
        self._program, self._prefix = program, prefix
        self._field_names = _unique_names(field.name for field in program.fields)

    @property
    def state_type(self) -> str:
        """Name of the data type of the state."""
        return f"{self._prefix}_STATE"

    def field_name(self, name: str) -> str:
        """Return the name of a field of the state."""
        return self._field_names[name]

    def block_name(self, name: str) -> str:
        """Return the name of the function block of a function."""
        return f"{self._prefix}_{name}"

    def render_state(self) -> str:
        """Declare the data type of the state."""
        lines = [f"TYPE {self.state_type} :", "STRUCT"]
        for field in self._program.fields:
            kind = _TYPES[field.kind]
            array = kind if field.size is None else f"ARRAY [0..{field.size - 1}] OF {kind}"
            lines.append(f"    {self._field_names[field.name]} : {array};")
        return "\n".join([*lines, "END_STRUCT;", "END_TYPE", ""])

    def render_blocks(self) -> Iterator[tuple[str, str]]:
        """Yield name and text of each function block, those that another one calls before it."""
        used = {part.operator for function in self._program.functions for value in iter_expressions(function.body)
                for part in parts(value) if isinstance(part, Operation)}  # fmt: skip
        for name, text in _helpers(self._prefix).items():
            if name in used:
                yield f"{self._prefix}_{name}", text
        for function in self._program.functions:
            yield self.block_name(function.name), _BlockText(self, self._program, function, self._field_names).render()


def _unique_names(names: Iterable[str], reserved: Iterable[str] = ()) -> dict[str, str]:
    """Choose names that differ without regard to case, and are no words of the language, for a program's names."""
    chosen: dict[str, str] = {}
    used = {name.lower() for name in reserved}
    for name in names:
        base = re.sub(r"_+", "_", name).strip("_") or "v"
        candidates = (base if k == 0 else f"{base}{'x' if k == 1 else f'x{k}'}" for k in count())
        chosen[name] = next(c for c in candidates if c.lower() not in used and c.lower() not in RESERVED)
        used.add(chosen[name].lower())
    return chosen


def _helpers(prefix: str) -> dict[str, str]:
    """Return functions of mathematics that edition 2 lacks, by the operator that needs them."""
    log1p = f"""\
(* ln(1 + a), accurate for small a: W. Kahan's formula *)
FUNCTION {prefix}_log1p : LREAL
VAR_INPUT
    a : LREAL;
END_VAR
VAR
    u : LREAL;
END_VAR
u := LREAL#1.0 + a;
IF u = LREAL#1.0 THEN
    {prefix}_log1p := a;
ELSE
    {prefix}_log1p := LN(u) * a / (u - LREAL#1.0);
END_IF;
END_FUNCTION
"""
    hypot = f"""\
(* root of a a + b b, without overflow *)
FUNCTION {prefix}_hypot : LREAL
VAR_INPUT
    a : LREAL;
    b : LREAL;
END_VAR
VAR
    large : LREAL;
    small : LREAL;
END_VAR
large := ABS(a);
small := ABS(b);
IF small > large THEN
    large := ABS(b);
    small := ABS(a);
END_IF;
IF large > LREAL#0.0 THEN
    small := small / large;
    {prefix}_hypot := large * SQRT(LREAL#1.0 + small * small);
ELSE
    {prefix}_hypot := large;
END_IF;
END_FUNCTION
"""
    return {"log1p": log1p, "hypot": hypot}


class _BlockText:
    """The function block of one function."""

    def __init__(self, text: StText, program: Program, function: Function, field_names: dict[str, str]) -> None:
        self._text, self._program, self._function, self._fields = text, program, function, field_names
        callees = list(dict.fromkeys(call.function for call in iter_calls(function.body)))
        locals_ = [parameter.name for parameter in function.parameters]
        locals_ += [name for name in function.variables if name not in locals_]
        results = [f"result_{k}" for k in range(len(function.results))]
        instances = [f"call_{callee}" for callee in callees]
        tables = sorted({part.name for value in iter_expressions(function.body) for part in parts(value)
                         if isinstance(part, TableElement)})  # fmt: skip
        self._names = _unique_names([*results, *locals_, *instances, *(f"table_{name}" for name in tables)], ["state"])
        self._callees, self._tables = callees, tables
        self._conditions: list[tuple[str, Kind]] = []  # variables of conditional expressions

    def render(self) -> str:
        """Render the function block."""
        function, names = self._function, self._names
        body = list(self._block(function.body, "", names))
        lines = [f"(* {function.summary.replace('*)', '* )')} *)"] if function.summary else []
        lines += [f"FUNCTION_BLOCK {self._text.block_name(function.name)}"]
        lines += ["VAR_IN_OUT", f"    state : {self._text.state_type};", "END_VAR"]
        if function.parameters:
            lines += [
                "VAR_INPUT",
                *(f"    {names[p.name]} : {_TYPES[p.kind]};" for p in function.parameters),
                "END_VAR",
            ]
        if function.results:
            results = (f"    {names[f'result_{k}']} : {_TYPES[kind]};" for k, kind in enumerate(function.results))
            lines += ["VAR_OUTPUT", *results, "END_VAR"]
        variables = [f"    {names[name]} : {_TYPES[kind]};" for name, kind in function.variables.items()]
        variables += [f"    {name} : {_TYPES[kind]};" for name, kind in self._conditions]
        variables += [f"    {names[f'call_{callee}']} : {self._text.block_name(callee)};" for callee in self._callees]
        if variables:
            lines += ["VAR", *variables, "END_VAR"]
        if self._tables:
            lines += ["VAR CONSTANT", *map(self._declare_table, self._tables), "END_VAR"]
        return "\n".join([*lines, *body, "END_FUNCTION_BLOCK", ""])

    def _declare_table(self, name: str) -> str:
        """Declare a constant table."""
        values = self._program.tables[name]
        kind: Kind = "real" if any(isinstance(value, float) for value in values) else "whole"
        numbers = ", ".join(format_initial(value) if kind == "real" else str(value) for value in values)
        return f"    {self._names[f'table_{name}']} : ARRAY [0..{len(values) - 1}] OF {_TYPES[kind]} := [{numbers}];"

    def _block(self, statements: Iterable[Statement], indent: str, names: dict[str, str]) -> Iterator[str]:
        """Yield the lines of statements."""
        for statement in statements:
            yield from self._statement(statement, indent, names)

    def _statement(self, statement: Statement, indent: str, names: dict[str, str]) -> Iterator[str]:
        """Yield the lines of a statement, after those of the conditional expressions within it."""
        lines: list[str] = []
        inner = indent + "    "
        if isinstance(statement, Assign):
            value = self._expression(statement.value, lines, indent)
            target = self._place(statement.target, lines, indent)
            yield from lines
            yield f"{indent}{target} := {value};"
        elif isinstance(statement, If):
            condition = self._expression(statement.condition, lines, indent)
            yield from lines
            yield f"{indent}IF {condition} THEN"
            yield from self._block(statement.body, inner, names) if statement.body else (f"{inner};",)
            if statement.otherwise:
                yield f"{indent}ELSE"
                yield from self._block(statement.otherwise, inner, names)
            yield f"{indent}END_IF;"
        elif isinstance(statement, For):
            start = self._expression(statement.start, lines, indent)
            stop = self._last(statement.stop, lines, indent)
            yield from lines
            yield f"{indent}FOR {names[statement.variable.name]} := {start} TO {stop} DO"
            yield from self._block(statement.body, inner, names)
            yield f"{indent}END_FOR;"
        elif isinstance(statement, While):
            yield from self._while(statement, indent, names)
        elif isinstance(statement, Break):
            yield f"{indent}EXIT;"
        elif isinstance(statement, Return):
            values = [self._expression(value, lines, indent) for value in statement.values]
            yield from lines
            yield from (f"{indent}{names[f'result_{k}']} := {value};" for k, value in enumerate(values))
            yield f"{indent}RETURN;"
        else:
            yield from self._call(statement, indent, names)

    def _last(self, stop: Expression, lines: list[str], indent: str) -> str:
        """Render the last value of a loop's variable."""
        if isinstance(stop, Constant):
            return format_constant(Constant(int(stop.value) - 1, "whole"))
        return f"{self._expression(stop, lines, indent)} - 1"

    def _while(self, statement: While, indent: str, names: dict[str, str]) -> Iterator[str]:
        """Yield the lines of a loop; a condition with lines of its own is tested within."""
        lines: list[str] = []
        inner = indent + "    "
        condition = self._expression(statement.condition, lines, inner)
        if lines:
            yield f"{indent}WHILE TRUE DO"
            yield from lines
            yield f"{inner}IF NOT {condition} THEN"
            yield f"{inner}    EXIT;"
            yield f"{inner}END_IF;"
        else:
            yield f"{indent}WHILE {condition} DO"
        yield from self._block(statement.body, inner, names)
        yield f"{indent}END_WHILE;"

    def _call(self, statement: Call, indent: str, names: dict[str, str]) -> Iterator[str]:
        """Yield the lines of a call and of the assignment of its results."""
        lines: list[str] = []
        callee = self._program.function(statement.function)
        results = [f"result_{k}" for k in range(len(callee.results))]
        variables = [p.name for p in callee.parameters] + list(callee.variables)
        theirs = _unique_names(dict.fromkeys([*results, *variables]), ["state"])
        values = [self._expression(argument, lines, indent) for argument in statement.arguments]
        passed = [f"{theirs[p.name]} := {value}" for p, value in zip(callee.parameters, values, strict=True)]
        instance = names[f"call_{callee.name}"]
        yield from lines
        yield f"{indent}{instance}({', '.join(['state := state', *passed])});"
        for k, variable in enumerate(statement.results):
            if variable is not None:
                yield f"{indent}{names[variable.name]} := {instance}.{theirs[f'result_{k}']};"

    def _place(self, target: Target, lines: list[str], indent: str) -> str:
        """Render what is assigned to."""
        return self._names[target.name] if isinstance(target, Local) else self._element(target, lines, indent)

    def _element(self, element: Element, lines: list[str], indent: str) -> str:
        """Render a number of the state."""
        name = f"state.{self._fields[element.name]}"
        return name if element.index is None else f"{name}[{self._expression(element.index, lines, indent)}]"

    def _expression(self, value: Expression, lines: list[str], indent: str) -> str:
        """Render an expression; the lines that must precede it are appended to `lines`."""
        if isinstance(value, Constant):
            return format_constant(value)
        if isinstance(value, Local):
            return self._names[value.name]
        if isinstance(value, Element):
            return self._element(value, lines, indent)
        if isinstance(value, TableElement):
            return f"{self._names[f'table_{value.name}']}[{self._expression(value.index, lines, indent)}]"
        if value.operator == "select" or (value.operator in ("and", "or") and _is_partial(value.operands[1])):
            return self._conditional(value, lines, indent)
        return self._operation(value, [self._expression(operand, lines, indent) for operand in value.operands])

    def _conditional(self, value: Operation, lines: list[str], indent: str) -> str:
        """Write a conditional expression as IF, whose result is a variable; return its name."""
        name = f"choice{len(self._conditions) + 1}"
        self._conditions.append((name, value.kind))
        inner = indent + "    "
        first = self._expression(value.operands[0], lines, indent)
        branches: list[list[str]] = [[], []]
        if value.operator == "select":
            texts = [self._expression(value.operands[k + 1], branches[k], inner) for k in range(2)]
        elif value.operator == "and":
            texts = [self._expression(value.operands[1], branches[0], inner), "FALSE"]
        else:
            texts = ["TRUE", self._expression(value.operands[1], branches[1], inner)]
        lines += [f"{indent}IF {first} THEN", *branches[0], f"{inner}{name} := {texts[0]};"]
        lines += [f"{indent}ELSE", *branches[1], f"{inner}{name} := {texts[1]};", f"{indent}END_IF;"]
        return name

    def _operation(self, value: Operation, operands: list[str]) -> str:
        """Render an operation of rendered operands."""
        name, first = value.operator, operands[0]
        if name in _BINARY:
            return f"({first} {_BINARY[name]} {operands[1]})"
        if name in _FUNCTIONS:
            return f"{_FUNCTIONS[name]}({first})"
        if name == "not":
            return f"(NOT {first})"
        if name == "negative":
            return f"(-{first})"
        if name in ("floor_mod", "floor_div"):
            remainder = f"((({first} MOD {operands[1]}) + {operands[1]}) MOD {operands[1]})"
            return remainder if name == "floor_mod" else f"(({first} - {remainder}) / {operands[1]})"
        if name == "power":
            return f"EXPT({first}, {operands[1]})"
        if name in ("real", "whole", "truth"):
            return _conversion(value, first)
        if name == "is_nan":
            return f"({first} <> {first})"
        if name == "is_finite":
            return f"(({first} - {first}) = LREAL#0.0)"
        if name in ("log1p", "hypot"):
            arguments = (f"{key} := {operand}" for key, operand in zip("ab", operands, strict=False))
            return f"{self._text.block_name(name)}({', '.join(arguments)})"
        raise ValueError(f"the operator {name} must be one that Structured Text has")


def _conversion(value: Operation, operand: str) -> str:
    """Render a conversion of a number."""
    kind = value.operands[0].kind
    if value.operator == "truth":
        return f"({operand} <> {format_constant(Constant(0, kind))})"
    if kind == "truth":
        return f"SEL({operand}, LREAL#0.0, LREAL#1.0)" if value.operator == "real" else f"SEL({operand}, 0, 1)"
    return f"DINT_TO_LREAL({operand})" if value.operator == "real" else f"TRUNC({operand})"


def _is_partial(value: Expression) -> bool:
    """Return True for an expression that only a condition before it makes valid, such as an index or a quotient."""
    return any(
        (isinstance(part, (Element, TableElement)) and part.index is not None)
        or (
            isinstance(part, Operation)
            and part.operator in ("/", "floor_div", "floor_mod", "log", "sqrt", "power", "select")
        )
        for part in parts(value)
    )


def format_constant(constant: Constant) -> str:
    """Render a constant; a large or tiny one as a product of literals that each compiler reads."""
    if constant.kind == "truth":
        return "TRUE" if constant.value else "FALSE"
    if constant.kind == "whole":
        text = str(int(constant.value))
        return f"({text})" if text.startswith("-") else text
    number = float(constant.value)
    if math.isinf(number):  # no reading is as large, and the product of such numbers is still finite
        return f"{'(-' if number < 0 else '('}{_product(1e150)})"
    text = _product(abs(number))
    return f"(-{text})" if number < 0 else text


def _product(number: float) -> str:
    """Render a number >= 0 as a literal, or as a product of literals between 1E-37 and 1E38."""
    factors = []
    while number >= _LARGEST:
        factors.append("LREAL#1.0E37")
        number /= 1e37
    while 0.0 < number < 1.0 / _LARGEST:
        factors.append("LREAL#1.0E-37")
        number *= 1e37
    text = repr(number).upper()
    mantissa, _, exponent = text.partition("E")
    mantissa += "" if "." in mantissa else ".0"
    literal = f"LREAL#{mantissa}" + (f"E{exponent.replace('+', '')}" if exponent else "")
    return f"({' * '.join([literal, *factors])})" if factors else literal


def format_initial(number: float) -> str:
    """Render a real number as an initial value: one literal, with its sign in it, as edition 2 has them."""
    if abs(number) >= _LARGEST:
        raise InputError(f"an initial value of Structured Text must be below {_LARGEST:g}, got {number:g}")
    if abs(number) < 1.0 / _LARGEST:
        return "LREAL#0.0"
    return _product(abs(number)).replace("#", "#-" if number < 0 else "#")
