"""An evaluator of Structured Text, apart from the emitter: it knows the language, and nothing of what is written in it.

Function blocks become Python objects, statements Python code. Names have no case, AND and OR evaluate both sides, a FOR
loop evaluates its bounds once, integer division and MOD truncate, an index beyond an array is an error, and a literal
above 1E38 is one, too.
"""

from __future__ import annotations

import math
import re

_TOKEN = re.compile(
    r"\(\*.*?\*\)|(?P<real>(?:LREAL#-?|REAL#-?)?\d+\.\d+(?:E[+-]?\d+)?)|(?P<whole>\d+)|(?P<name>[A-Za-z]\w*)"
    r"|(?P<symbol>:=|=>|<=|>=|<>|\.\.|[-+*/()\[\];:,.=<>])|\s+",
    re.DOTALL | re.IGNORECASE,
)
_BINARY = [{"or": "|"}, {"and": "&"}, {"=": "==", "<>": "!="}, {"<": "<", "<=": "<=", ">": ">", ">=": ">="},
           {"+": "+", "-": "-"}, {"*": "*", "/": "_divide", "mod": "_mod"}]  # fmt: skip


def _divide(a, b):
    if isinstance(a, int) and isinstance(b, int):
        return int(a / b) if abs(a) < 2**52 else abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1)
    return a / b if b else math.nan if a == 0 or math.isnan(a) else math.copysign(math.inf, a) * math.copysign(1.0, b)


def _ln(a):
    return math.log(a) if a > 0.0 else -math.inf if a == 0.0 else math.nan


FUNCTIONS = {
    "abs": abs, "sqrt": lambda a: math.sqrt(a) if a >= 0 else math.nan, "ln": _ln,
    "exp": lambda a: math.exp(min(a, 709.0)),
    "trunc": int, "dint_to_lreal": float, "sel": lambda g, a, b: b if g else a, "expt": lambda a, b: a**b,
    "_divide": _divide, "_mod": lambda a, b: int(math.fmod(a, b)),
}  # fmt: skip


class Structure:
    """Fields of a data type, or the variables of a function block; other names are refused."""


class Program:
    """Data types, functions and function blocks of a text."""

    def __init__(self, text: str) -> None:
        self.types, self.blocks, self.functions = {}, {}, dict(FUNCTIONS)
        self._tokens, self._place = [], 0
        end = 0
        for match in _TOKEN.finditer(text):
            assert match.start() == end, text[end : end + 40]
            end = match.end()
            kind = match.lastgroup
            if kind == "real":
                number = float(match[0].rpartition("#")[2])
                assert number == 0.0 or 1e-38 < abs(number) < 1e38, number
                self._tokens.append((kind, repr(number)))
            elif kind:
                self._tokens.append((kind, match[0] if kind == "symbol" else match[0].lower()))
        assert end == len(text), text[end : end + 40]
        while self._place < len(self._tokens):
            {"type": self._type, "function_block": self._block, "function": self._function}[self._next()]()

    # ---- tokens

    def _peek(self):
        return self._tokens[self._place][1] if self._place < len(self._tokens) else ""

    def _next(self, expected=None):
        token = self._peek()
        assert expected is None or token == expected, (expected, self._tokens[self._place - 5 : self._place + 5])
        self._place += 1
        return token

    # ---- declarations

    def _kind(self):
        """A maker of initial values."""
        name = self._next()
        if name == "array":
            self._next("[")
            low, _, high = self._next(), self._next(".."), self._next()
            self._next("]"), self._next("of")
            assert low == "0"
            inner = self._kind()
            return lambda: [inner() for _ in range(int(high) + 1)]
        simple = {"lreal": 0.0, "dint": 0, "bool": False}
        return (lambda: simple[name]) if name in simple else lambda: self.make(name)

    def _declarations(self, end):
        """Names with makers of initial values."""
        variables = {}
        while self._peek() != end:
            name = self._next()
            assert name not in variables, name
            self._next(":")
            make = self._kind()
            if self._peek() == ":=":
                self._next()
                value = eval(self._list() if self._peek() == "[" else self._expression())
                make = lambda value=value: list(value) if isinstance(value, list) else value  # noqa: E731
            self._next(";")
            variables[name] = make
        self._next()
        return variables

    def _list(self):
        """Initial values, each of them one literal."""
        values = []
        while self._next() != "]":
            sign = self._next() if self._peek() == "-" else ""
            assert self._tokens[self._place][0] in ("real", "whole"), self._tokens[self._place]
            values.append(sign + self._next())
            assert self._peek() in (",", "]")
        return f"[{', '.join(values)}]"

    def _type(self):
        name = self._next()
        self._next(":"), self._next("struct")
        self.types[name] = self._declarations("end_struct")
        self._next(";"), self._next("end_type")

    def _sections(self):
        variables, by_reference = {}, set()
        while self._peek().startswith("var"):
            section = self._next()
            if self._peek() in ("constant", "retain"):
                self._next()
            declared = self._declarations("end_var")
            assert not declared.keys() & variables.keys()
            variables |= declared
            by_reference |= set(declared) if section == "var_in_out" else set()
        return variables, by_reference

    def _code(self, name, end, arguments, result=""):
        first, last = (f"  {result} = 0.0", f"  return {result}") if result else ("  pass", "  pass")
        lines = [f"def body({arguments}):", first, *self._statements("  ", end), last]
        self._next(end)
        namespace = dict(self.functions)
        exec(compile("\n".join(lines), f"<{name}>", "exec"), namespace)
        return namespace["body"]

    def _block(self):
        name = self._next()
        variables, by_reference = self._sections()
        self._local = False
        self.blocks[name] = variables, by_reference, self._code(name, "end_function_block", "v")

    def _function(self):
        name = self._next()
        self._next(":"), self._kind()
        variables, _ = self._sections()
        self._local = True
        inputs = ", ".join(f"{key}={make()!r}" for key, make in variables.items())
        self.functions[name] = self._code(name, "end_function", inputs, result=name)

    # ---- statements

    def _statements(self, indent, *ends):
        while self._peek() not in ends:
            yield from self._statement(indent)

    def _suite(self, indent, *ends):
        return [f"{indent}  pass", *self._statements(indent + "  ", *ends)]

    def _statement(self, indent):
        word = self._peek()
        if word == ";":
            self._next()
        elif word == "if":
            self._next()
            condition = self._expression()
            self._next("then")
            yield f"{indent}if {condition}:"
            yield from self._suite(indent, "else", "end_if")
            if self._peek() == "else":
                self._next()
                yield f"{indent}else:"
                yield from self._suite(indent, "end_if")
            self._next("end_if"), self._next(";")
        elif word == "for":
            self._next()
            target = self._variable()
            self._next(":=")
            start = self._expression()
            self._next("to")
            stop = self._expression()
            self._next("do")
            yield f"{indent}for {target} in range({start}, ({stop}) + 1):"
            yield from self._suite(indent, "end_for")
            self._next("end_for"), self._next(";")
        elif word == "while":
            self._next()
            condition = self._expression()
            self._next("do")
            yield f"{indent}while {condition}:"
            yield from self._suite(indent, "end_while")
            self._next("end_while"), self._next(";")
        elif word in ("exit", "return"):
            self._next(), self._next(";")
            yield f"{indent}{'break' if word == 'exit' else 'return'}"
        else:
            target = self._variable()
            if self._peek() == "(":
                yield f"{indent}{target}({self._arguments()})"
            else:
                self._next(":=")
                yield f"{indent}{target} = {self._expression()}"
            self._next(";")

    def _arguments(self):
        self._next("(")
        arguments = []
        while self._peek() != ")":
            if self._tokens[self._place + 1][1] == ":=":
                name = self._next()
                self._next(":=")
                arguments.append(f"{name}={self._expression()}")
            else:
                arguments.append(self._expression())
            if self._peek() == ",":
                self._next()
        self._next(")")
        return ", ".join(arguments)

    # ---- expressions

    def _variable(self):
        name = self._next()
        text = name if self._local else f"v.{name}"
        while self._peek() in (".", "["):
            if self._next() == ".":
                text += f".{self._next()}"
            else:
                text += f"[{self._expression()}]"
                self._next("]")
        return text

    def _expression(self, level=0):
        if level == len(_BINARY):
            return self._unary()
        left = self._expression(level + 1)
        while self._peek() in _BINARY[level]:
            operator = _BINARY[level][self._next()]
            right = self._expression(level + 1)
            left = f"{operator}({left}, {right})" if operator.startswith("_") else f"({left} {operator} {right})"
        return left

    def _unary(self):
        kind, word = self._tokens[self._place]
        if word in ("-", "not"):
            self._next()
            return f"({'-' if word == '-' else 'not '}{self._unary()})"
        if word == "(":
            self._next()
            inner = self._expression()
            self._next(")")
            return f"({inner})"
        if kind in ("real", "whole"):
            return self._next()
        if word in ("true", "false"):
            return self._next().capitalize()
        if self._tokens[self._place + 1][1] == "(":
            return f"{self._next()}({self._arguments()})"
        return self._variable()

    # ---- objects

    def make(self, name):
        """A structure of a data type, or an instance of a function block."""
        name = name.lower()
        if name in self.types:
            structure = Structure()
            for key, make in self.types[name].items():
                setattr(structure, key, make())
            return structure
        variables, by_reference, body = self.blocks[name]

        class Instance(Structure):
            def __call__(instance, **arguments):  # noqa: N805
                for key, value in arguments.items():
                    assert key in variables, key
                    setattr(instance, key, value)
                body(instance)

        instance = Instance()
        for key, make in variables.items():
            setattr(instance, key, None if key in by_reference else make())
        return instance
