"""Specialise compiled kernels to a program on one state record: sizes are numbers, views are indices into fields.

A kernel is a Python function that numba compiles (`compiled.law`). Its syntax tree is evaluated in part: whatever is
known before the machine runs, such as sizes, settings and the order of columns, becomes numbers; a view of an array, as
`gram[block]`, becomes the array's field with an offset; a function is written once for each combination of fields and
settings with which it is called. What remains are the statements of `emit.program`. Numbers are computed in the order
and with the operations of the compiled kernel, so that the program's results equal the kernel's.

The subset: numbers, arrays of the state and views of them, tuples of settings; assignments, `if`, `while`, `for` over
ranges and tuples of settings, `break`, `return`; functions of `OPERATORS` and other kernels. Everything else is refused
with file and line.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import operator
import textwrap
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

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
    StateField,
    Statement,
    TableElement,
    While,
    drop_unread,
    iter_calls,
    iter_expressions,
    iter_read_names,
    iter_written_names,
    parts,
)
from sealscope.errors import InputError
from sealscope.physics.lanes import exponential, select

#: Functions of one or two real numbers by which kernels compute, and the operator that each becomes.
OPERATORS: Mapping[Any, str] = {
    **{math.log: "log", np.log: "log", math.log1p: "log1p", np.log1p: "log1p", math.exp: "exp", np.exp: "exp"},
    **{math.sqrt: "sqrt", np.sqrt: "sqrt", math.hypot: "hypot", np.hypot: "hypot", math.lgamma: "log_gamma"},
    **{math.isnan: "is_nan", np.isnan: "is_nan", math.isfinite: "is_finite", np.isfinite: "is_finite"},
    **{math.floor: "floor", math.ceil: "ceil", math.pow: "power", math.copysign: "copysign", exponential: "exp"},
}
_TRUTHS = ("is_nan", "is_finite")
_KINDS: tuple[Kind, ...] = ("truth", "whole", "real")  # from narrow to wide
_COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_TRUTH_OPERATORS: Mapping[type[ast.operator], str] = {ast.BitAnd: "and", ast.BitOr: "or"}
_ARITHMETIC = {
    **{ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "floor_div", ast.Mod: "floor_mod"},
    ast.Pow: "power",
}
#: Operators of Python by which operations on known numbers are evaluated.
_EVALUATE: Mapping[str, Callable[..., Any]] = {
    **{"+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv, "power": operator.pow},
    **{"floor_div": operator.floordiv, "floor_mod": operator.mod, "<": operator.lt, "<=": operator.le},
    **{">": operator.gt, ">=": operator.ge, "==": operator.eq, "!=": operator.ne},
}


@dataclass(frozen=True)
class Known:
    """A value that is known before the machine runs: a number, tuple, array, function, module or None."""

    value: Any


@dataclass(frozen=True)
class Record:
    """A record within the state: `prefix` of the names of its fields, and its dtype."""

    prefix: str
    layout: np.dtype[Any]


@dataclass(frozen=True)
class View:
    """A view of an array of the state: field, kind, offset, and the size and stride of each dimension."""

    name: str
    kind: Kind
    offset: Expression
    sizes: tuple[Expression, ...]
    strides: tuple[int, ...]


@dataclass(frozen=True)
class Several:
    """A tuple of values."""

    values: tuple[Value, ...]


Value = Expression | Known | Record | View | Several


def _iter_fields(layout: np.dtype[Any], prefix: str = "", begin: int = 0) -> Iterator[tuple[StateField, int, int]]:
    """Yield the fields of a state record with their begin and end in bytes, those of nested records, too.

    The names of nested records and their fields are joined by an underscore.
    """
    for name, (dtype, offset, *_) in (layout.fields or {}).items():
        if dtype.fields:
            yield from _iter_fields(dtype, f"{prefix}{name}_", begin + offset)
        else:
            size = int(np.prod(dtype.shape)) if dtype.shape else None
            yield StateField(prefix + name, _kind_of(dtype.base), size), begin + offset, begin + offset + dtype.itemsize


def allocate_fields(layout: np.dtype[Any]) -> tuple[tuple[StateField, ...], dict[str, tuple[str, int]]]:
    """Find the fields of a state record, where arrays that overlap become one array.

    Returns the fields, and for each of the arrays that overlap, by its name, the common array and the index of its
    first number in it. Raises InputError if fields other than arrays of real numbers overlap.
    """
    groups: list[list[tuple[StateField, int, int]]] = []
    reach = 0
    for entry in sorted(_iter_fields(layout), key=lambda entry: entry[1]):
        if groups and entry[1] < reach:
            groups[-1].append(entry)
        else:
            groups.append([entry])
        reach = max(reach, entry[2])
    fields: list[StateField] = []
    places: dict[str, tuple[str, int]] = {}
    for group in groups:
        if len(group) == 1:
            fields.append(group[0][0])
            continue
        names = [field.name for field, _, _ in group]
        if any(field.kind != "real" or field.size is None for field, _, _ in group):
            raise InputError(f"fields of a state that overlap must be arrays of real numbers, got {', '.join(names)}")
        begin, end = group[0][1], max(last for _, _, last in group)
        common = f"shared_{len({name for name, _ in places.values()})}"
        fields.append(StateField(common, "real", (end - begin) // 8, f"at different times {', '.join(names)}"))
        places |= {field.name: (common, (first - begin) // 8) for field, first, _ in group}
    return tuple(fields), places


def specialise(
    layout: np.dtype[Any],
    entries: Mapping[str, tuple[Any, Mapping[str, Any]]],
    constants: Mapping[str, float] | None = None,
    known: Mapping[str, Any] | None = None,
) -> Program:
    """Specialise kernels to a program whose state is a record of the dtype `layout`.

    Parameters
    ----------
    layout : numpy.dtype
        Record of numbers, arrays and further records, as `compiled.record_dtype` builds it.
    entries : mapping of str to tuple
        Name of each function to be called from outside; the kernel, and a value for each of its arguments: "state" for
        the record, "real" or "whole" for a number, anything else for a setting.
    constants : mapping of str to float, optional
        Values of module constants, by name, that differ from the kernels' own, such as limits of rounding.
    known : mapping of str to object, optional
        Settings that kernels read as if they were fields of the state, by the field's name.

    Raises
    ------
    InputError
        A kernel is outside of the subset that can be written; the message has file, line and reason.
    """
    writer = _Writer(layout, constants or {}, known or {})
    for name, (kernel, arguments) in entries.items():
        values = {key: _value_of_argument(key, kind, layout) for key, kind in arguments.items()}
        writer.add_function(source_function(kernel), values, name)
    functions = {function.name: function for function in writer.functions.values()}
    called, found = set(entries), list(entries)
    while found:
        new = {call.function for call in iter_calls(functions[found.pop()].body)} - called
        called |= new
        found += new
    kept = tuple(function for name, function in functions.items() if name in called)
    return Program(writer.fields, writer.tables, kept)


def source_function(kernel: Any) -> Callable[..., Any]:
    """Return the Python function of a kernel, which numba may have wrapped."""
    return getattr(kernel, "py_func", kernel)  # type: ignore[no-any-return]


def _value_of_argument(name: str, kind: Any, layout: np.dtype[Any]) -> Value:
    """Return the value that an argument of an entry has while its statements are written."""
    if isinstance(kind, str) and kind == "state":
        return Record("", layout)
    if isinstance(kind, str) and kind in ("real", "whole", "truth"):
        return Local(name, kind)  # type: ignore[arg-type]
    return Known(kind)


def _kind_of(dtype: np.dtype[Any]) -> Kind:
    """Return the kind of the numbers of a NumPy type."""
    return "real" if dtype.kind == "f" else "whole"


class _Writer:
    """The program under construction: its functions by what they are specialised for, and its tables."""

    def __init__(self, layout: np.dtype[Any], constants: Mapping[str, float], known: Mapping[str, Any]) -> None:
        self.layout, self.constants, self.known = layout, constants, known
        self.fields, self.places = allocate_fields(layout)
        self.functions: dict[Any, Function] = {}
        self.writes_state: set[str] = set()
        self.result_shapes: dict[str, Any] = {}
        self.tables: dict[str, tuple[float | int, ...]] = {}
        self._names: Counter[str] = Counter()

    def table(self, values: Any, hint: str) -> str:
        """Return the name of a constant table of `values`, a new one if there is none with these values."""
        numbers = tuple(np.ravel(np.asarray(values)).tolist())
        for name, other in self.tables.items():
            if other == numbers and [type(number) for number in other] == [type(number) for number in numbers]:
                return name
        name = self.free_name(hint.strip("_").lower() or "table")
        self.tables[name] = numbers
        return name

    def free_name(self, name: str) -> str:
        """Return a name that no function or table has: `name`, or with a number."""
        self._names[name] += 1
        return name if self._names[name] == 1 else f"{name}_{self._names[name]}"

    def add_function(self, function: Callable[..., Any], values: Mapping[str, Value], name: str = "") -> Function:
        """Return the function of the program for a kernel with arguments of these values; write it if it is new."""
        passed = {key: _parameter_value(key, value) for key, value in values.items()}
        key = (function, tuple((key, _freeze(value)) for key, value in passed.items()))
        if key not in self.functions:
            body = _Body(self, function, passed)
            written = body.write(self.free_name(name or function.__name__.strip("_")), keeps_parameters=bool(name))
            if body.writes_state:
                self.writes_state.add(written.name)
            self.result_shapes[written.name] = body.result_shape
            self.functions[key] = written
        return self.functions[key]


def _freeze(value: Value) -> Any:
    """Return something hashable that is equal for values for which a function is written alike."""
    if isinstance(value, Known):
        known = value.value
        return (
            "known",
            known.tobytes() if isinstance(known, np.ndarray) else repr(known) if callable(known) else known,
        )
    if isinstance(value, Record):
        return ("record", value.prefix)
    return value


def _parameter_value(name: str, value: Value) -> Value:
    """Return the value that an argument has within a function: numbers of the caller become parameters."""
    if isinstance(value, Known) and isinstance(value.value, (bool, int, float, np.number)):
        return Local(name, _constant(value.value).kind)
    if isinstance(value, View):
        offset = value.offset if isinstance(value.offset, Constant) else Local(f"{name}_offset", "whole")
        sizes = tuple(
            size if isinstance(size, Constant) else Local(f"{name}_size{k}", "whole")
            for k, size in enumerate(value.sizes)
        )
        return replace(value, offset=offset, sizes=sizes)
    if isinstance(value, Several):
        return Several(tuple(_parameter_value(f"{name}_{k}", part) for k, part in enumerate(value.values)))
    if isinstance(value, (Known, Record)):
        return value
    return Local(name, value.kind)


def _pairs(inner: Value, outer: Value) -> Iterator[tuple[Local, Expression]]:
    """Yield the parameters of an argument within a function, and the caller's expression for each."""
    if isinstance(inner, Local):
        yield inner, _constant(outer.value) if isinstance(outer, Known) else outer  # type: ignore[misc]
    elif isinstance(inner, View) and isinstance(outer, View):
        for parameter, number in zip((inner.offset, *inner.sizes), (outer.offset, *outer.sizes), strict=True):
            if isinstance(parameter, Local):
                yield parameter, number
    elif isinstance(inner, Several) and isinstance(outer, Several):
        for mine, theirs in zip(inner.values, outer.values, strict=True):
            yield from _pairs(mine, theirs)  # type: ignore[arg-type]


def _shape_of(value: Value) -> Any:
    """Return the shapes of the parts of a tuple, None for anything else."""
    return tuple(map(_shape_of, value.values)) if isinstance(value, Several) else None


def _leaves(value: Value) -> Iterator[Value]:
    """Yield the parts of a tuple, and of the tuples in it."""
    if isinstance(value, Several):
        for part in value.values:
            yield from _leaves(part)
    else:
        yield value


def _shaped(shape: Any, leaves: Iterator[Value]) -> Value:
    """Build the value of a shape (`_shape_of`) from its numbers."""
    return next(leaves) if shape is None else Several(tuple(_shaped(part, leaves) for part in shape))


def _constant(value: Any) -> Constant:
    """Make the constant of a number."""
    if isinstance(value, (bool, np.bool_)):
        return Constant(bool(value), "truth")
    if isinstance(value, (int, np.integer)):
        return Constant(int(value), "whole")
    return Constant(float(value), "real")


def _is_object(value: Value) -> bool:
    """Return True for a known value that is no number."""
    return isinstance(value, Known) and not _is_number(value.value)


def _is_number(value: Any) -> bool:
    """Return True for a number or truth value of Python or NumPy."""
    return isinstance(value, (bool, int, float, np.number, np.bool_))


def convert(value: Expression, kind: Kind) -> Expression:
    """Convert an expression to another kind of number."""
    if value.kind == kind:
        return value
    if isinstance(value, Constant):
        return _constant({"real": float, "whole": int, "truth": bool}[kind](value.value))
    return Operation(kind, (value,), kind)


def _wider(kinds: Sequence[Kind]) -> Kind:
    """Return the widest of some kinds of numbers."""
    return _KINDS[max(map(_KINDS.index, kinds))]


class _Body:
    """The statements of one function, written from its syntax tree with the values of its arguments."""

    def __init__(self, writer: _Writer, function: Callable[..., Any], values: Mapping[str, Value]) -> None:
        self._writer, self._function, self._arguments = writer, function, values
        lines, self._first_line = inspect.getsourcelines(function)
        tree = ast.parse(textwrap.dedent("".join(lines))).body[0]
        assert isinstance(tree, ast.FunctionDef)
        self._tree = tree
        self._file = Path(inspect.getsourcefile(function) or "").name
        self._names = self._global_names()
        stores = Counter(
            node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        )
        changed = {node.target.id for node in ast.walk(tree)
                   if isinstance(node, (ast.AugAssign, ast.For)) and isinstance(node.target, ast.Name)}  # fmt: skip
        self._single = {name for name, count in stores.items() if count == 1} - changed - set(values)
        self._stored = set(stores)
        self._part_variables: set[str] = set()  # those of tuples that are assigned anew
        self._kinds: dict[str, Kind] = {}
        self._result_kinds: list[Kind] | None = None
        self._is_settled = True
        self.writes_state = False
        self.result_shape: Any = ()  # a tuple of the shapes of a tuple's parts, None for a number
        self._reset()

    def _reset(self) -> None:
        """Begin to write anew, with the kinds of variables that are known so far."""
        self._values: dict[str, Value] = {}
        for name, value in self._arguments.items():
            self._values[name] = value
        self._statements: list[Statement] = []
        self._n_temporary = 0
        self._conditional = 0  # depth within expressions that are evaluated only under a condition
        self._root: ast.AST | None = None  # expression of the present statement
        self._variables: dict[str, Kind] = {}

    def _global_names(self) -> dict[str, Any]:
        """Collect what names of the function's surroundings stand for."""
        function = self._function
        closure = function.__closure__ or ()
        captured = {name: cell.cell_contents for name, cell in zip(function.__code__.co_freevars, closure, strict=True)}
        changed = {name: value for name, value in self._writer.constants.items() if name in function.__globals__}
        return {**vars(builtins), **function.__globals__, **changed, **captured}

    def write(self, name: str, keeps_parameters: bool) -> Function:
        """Write the function, again until the kinds of its variables are settled.

        Parameters that it does not use are left out unless it `keeps_parameters`.
        """
        while True:
            self._is_settled = True
            self._reset()
            for key in self._stored & set(self._arguments):  # a parameter that is assigned to: a variable of its own
                self._copy_parameter(key)
            self._block(self._tree.body)
            if self._is_settled:
                break
        self._drop_unread()
        parameters = [inner for key, value in self._arguments.items() for inner in _parameters(value)]
        if not keeps_parameters:
            used = {part.name for value in iter_expressions(self._statements) for part in parts(value)
                    if isinstance(part, Local)}  # fmt: skip
            parameters = [parameter for parameter in parameters if parameter.name in used]
        document = (ast.get_docstring(self._tree) or "").partition("\n")[0]
        results = tuple(self._result_kinds or ())
        return Function(name, document, tuple(parameters), results, dict(self._variables), tuple(self._statements))

    def _drop_unread(self) -> None:
        """Drop assignments to variables that nothing reads."""
        n_before = -1
        while n_before != len(self._variables):
            n_before = len(self._variables)
            read = set(iter_read_names(self._statements))
            self._statements = list(drop_unread(self._statements, read, self._writer.writes_state))
            written = set(iter_written_names(self._statements))
            self._variables = {name: kind for name, kind in self._variables.items() if name in written}

    def _copy_parameter(self, key: str) -> None:
        """Copy a parameter that the function assigns to into a variable."""
        value = self._arguments[key]
        if not isinstance(value, Local):
            raise self._refusal(self._tree, f"{key} is assigned to, and must be a number")
        del self._values[key]
        self._assign_name(key, value, self._tree, f"{key}_now")

    # ---- statements

    def _refusal(self, node: ast.AST, reason: str) -> InputError:
        """Make the error for a node that cannot be written."""
        line = self._first_line + getattr(node, "lineno", 1) - 1
        return InputError(f"{self._file}:{line}: {reason}")

    def _block(self, nodes: Sequence[ast.stmt]) -> None:
        """Write statements."""
        for node in nodes:
            method = getattr(self, f"_write_{type(node).__name__}", None)
            if method is None:
                raise self._refusal(node, f"a statement must be of the subset, got {type(node).__name__}")
            self._root = None
            method(node)
            if self._statements and isinstance(self._statements[-1], (Return, Break)):
                break  # what follows is never reached

    def _nested(self, nodes: Sequence[ast.stmt]) -> tuple[Statement, ...]:
        """Write statements into a block of their own."""
        outer, self._statements = self._statements, []
        self._block(nodes)
        inner, self._statements = self._statements, outer
        return tuple(inner)

    def _write_Pass(self, node: ast.Pass) -> None:
        """Write nothing."""

    def _write_Expr(self, node: ast.Expr) -> None:
        """Write a call whose results are not used; leave out a docstring."""
        if isinstance(node.value, ast.Constant):
            return
        if not isinstance(node.value, ast.Call):
            raise self._refusal(node, "an expression without an effect must be a call")
        self._root = node.value
        self._value(node.value)

    def _write_Return(self, node: ast.Return) -> None:
        """Write the end of the function."""
        values: tuple[Expression, ...] = ()
        if node.value is not None:
            self._root = node.value
            value = self._value(node.value)
            self.result_shape = _shape_of(value)
            values = tuple(self._number(part, node) for part in _leaves(value))
        kinds = [value.kind for value in values]
        if self._result_kinds is None:
            self._result_kinds = kinds
        if len(kinds) != len(self._result_kinds):
            raise self._refusal(node, "each return must have the same number of results")
        wide = [_wider(pair) for pair in zip(kinds, self._result_kinds, strict=True)]
        if wide != self._result_kinds:
            self._result_kinds, self._is_settled = wide, False
        self._statements.append(Return(tuple(convert(value, kind) for value, kind in zip(values, wide, strict=True))))

    def _write_Break(self, node: ast.Break) -> None:
        """Write the end of a loop."""
        self._statements.append(Break())

    def _write_If(self, node: ast.If) -> None:
        """Write a branch, or of a known condition the statements that it chooses."""
        self._root = node.test
        condition = self._value(node.test)
        if isinstance(condition, Known):
            self._block(node.body if condition.value else node.orelse)
            return
        truth = self._truth_value(condition, node)
        if isinstance(truth, Constant):
            self._block(node.body if truth.value else node.orelse)
            return
        self._statements.append(If(truth, self._nested(node.body), self._nested(node.orelse)))

    def _write_While(self, node: ast.While) -> None:
        """Write a loop under a condition, which must not call other kernels."""
        if node.orelse:
            raise self._refusal(node, "a loop must have no else")
        self._conditional += 1
        condition = self._truth_value(self._value(node.test), node)
        self._conditional -= 1
        self._statements.append(While(condition, self._nested(node.body)))

    def _write_For(self, node: ast.For) -> None:
        """Write a loop over a range, or the statements once for each of some settings."""
        if node.orelse or not isinstance(node.target, ast.Name):
            raise self._refusal(node, "a loop must have one variable and no else")
        name = node.target.id
        if isinstance(node.iter, ast.Call) and isinstance(node.iter.func, ast.Name) and node.iter.func.id == "range":
            bounds = [self._whole_number(self._value(bound), node) for bound in node.iter.args]
            if len(bounds) > 2 or node.iter.keywords:
                raise self._refusal(node, "a range must have the step 1")
            start, stop = (Constant(0, "whole"), bounds[0]) if len(bounds) == 1 else bounds
            if self._indexes_tuple(node, name):
                for k in range(*(self._known_number(bound, node) for bound in (start, stop))):
                    self._values[name] = Known(k)
                    self._block(node.body)
                return
            if isinstance(start, Constant) and isinstance(stop, Constant) and stop.value <= start.value:
                return  # no round, in which indices might be beyond an array
            start, stop = self._steady(start, node), self._steady(stop, node)
            self._declare(name, "whole", node)
            variable = Local(name, "whole")
            self._values[name] = variable
            self._statements.append(For(variable, start, stop, self._nested(node.body)))
            return
        settings = self._value(node.iter)
        if not isinstance(settings, (Several, Known)):
            raise self._refusal(node, "a loop must be over a range or a tuple of settings")
        values = settings.values if isinstance(settings, Several) else tuple(self._lift(v) for v in settings.value)
        for value in values:
            self._values[name] = value
            self._block(node.body)

    def _indexes_tuple(self, loop: ast.For, name: str) -> bool:
        """Return True if a loop's variable `name` is an index of a tuple, whose parts have no index in the program."""
        return any(
            isinstance(part, ast.Subscript)
            and isinstance(part.value, ast.Name)
            and isinstance(self._values.get(part.value.id), Several)
            and any(isinstance(used, ast.Name) and used.id == name for used in ast.walk(part.slice))
            for statement in loop.body
            for part in ast.walk(statement)
        )

    def _known_number(self, value: Expression, node: ast.AST) -> int:
        """Return a whole number that is known."""
        if not isinstance(value, Constant):
            raise self._refusal(node, "the range of a tuple's index must be known")
        return int(value.value)

    def _write_AnnAssign(self, node: ast.AnnAssign) -> None:
        """Write an assignment with a type."""
        if node.value is not None:
            self._write_targets([node.target], node.value, node)

    def _write_Assign(self, node: ast.Assign) -> None:
        """Write an assignment."""
        self._write_targets(node.targets, node.value, node)

    def _write_AugAssign(self, node: ast.AugAssign) -> None:
        """Write an assignment of a value computed from the target's present one."""
        load = ast.copy_location(_as_load(node.target), node)
        value = ast.copy_location(ast.BinOp(load, node.op, node.value), node)
        self._write_targets([node.target], value, node)

    def _write_targets(self, targets: Sequence[ast.expr], value_node: ast.expr, node: ast.stmt) -> None:
        """Assign the value of an expression to one or several targets."""
        self._root = value_node
        value = self._value(value_node)
        if len(targets) > 1 and not isinstance(value, (Known, View, Record, Several)):
            value = self._steady(value, node)
        for target in targets:
            self._assign(target, value, node)

    def _assign(self, target: ast.expr, value: Value, node: ast.stmt) -> None:
        """Assign a value to a target, or the parts of a tuple to those of the target."""
        if isinstance(target, (ast.Tuple, ast.List)):
            values = value.values if isinstance(value, Several) else ()
            if isinstance(value, Known):
                values = tuple(self._lift(part) for part in value.value)
            if len(values) != len(target.elts):
                raise self._refusal(node, f"{len(target.elts)} targets must get as many values, got {len(values)}")
            for part, single in zip(target.elts, self._independent(target.elts, values, node), strict=True):
                self._assign(part, single, node)
        elif isinstance(target, ast.Name):
            self._assign_name(target.id, value, node)
        else:
            self._assign_state(target, value, node)

    def _independent(self, targets: Sequence[ast.expr], values: Sequence[Value], node: ast.stmt) -> list[Value]:
        """Copy values that an assignment to one of the earlier targets would change."""
        names = {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)} - self._single
        has_state = any(isinstance(target, (ast.Subscript, ast.Attribute)) for target in targets)

        def depends(value: Value) -> bool:
            return isinstance(value, (Operation, Element, Local, TableElement)) and any(
                (isinstance(part, Element) and has_state) or (isinstance(part, Local) and part.name in names)
                for part in parts(value)
            )

        return [
            value if k == 0 and not depends(value) else self._copied_value(value, node) if depends(value) else value
            for k, value in enumerate(values)
        ]

    def _copied_value(self, value: Value, node: ast.AST) -> Value:
        """Copy a number into a new variable."""
        return self._temporary(self._number(value, node))

    def _assign_name(self, name: str, value: Value, node: ast.AST, written: str = "") -> None:
        """Assign to a local name: views and known values only name, numbers are stored in a variable."""
        if name == "_":
            return
        if isinstance(value, Several):
            self._assign_parts(name, value, node)
            return
        if isinstance(value, (View, Record)) or (isinstance(value, Known) and not _is_number(value.value)):
            if name not in self._single:
                raise self._refusal(node, f"{name} is assigned to more than once, and must be a number")
            self._values[name] = self._fixed_view(value, node) if isinstance(value, View) else value
            return
        if isinstance(value, Known) and name in self._single:
            self._values[name] = value
            return
        number = self._number(value, node)
        variable_name = written or self._free_variable(name)
        self._declare(variable_name, number.kind, node)
        variable = Local(variable_name, self._kinds[variable_name])
        self._values[name] = variable
        self._statements.append(Assign(variable, convert(number, variable.kind)))

    def _assign_parts(self, name: str, value: Several, node: ast.AST) -> None:
        """Assign a tuple to a local name; of a name that is assigned to more than once, each part is a variable."""
        is_number = [not isinstance(part, (View, Record, Several)) and not _is_object(part) for part in value.values]
        if name in self._single:
            values = [
                self._steady(part, node) if number and not isinstance(part, Known) else part
                for part, number in zip(value.values, is_number, strict=True)
            ]
            self._values[name] = Several(tuple(values))
            return
        if not all(is_number):
            raise self._refusal(node, f"{name} is assigned to more than once, and must have numbers only")
        names = [f"{self._free_variable(name)}_part{k}" for k in range(len(value.values))]
        self._part_variables |= set(names)
        numbers = [self._number(part, node) for part in value.values]
        for k, number in enumerate(numbers):
            if any(isinstance(part, Local) and part.name in names for part in parts(number)):
                numbers[k] = self._temporary(number)
        for variable_name, number in zip(names, numbers, strict=True):
            self._declare(variable_name, number.kind, node)
            variable = Local(variable_name, self._kinds[variable_name])
            self._statements.append(Assign(variable, convert(number, variable.kind)))
        self._values[name] = Several(tuple(Local(variable, self._kinds[variable]) for variable in names))

    def _free_variable(self, name: str) -> str:
        """Return the name of the variable for a local name, another one than a parameter's."""
        return f"{name}_now" if name in self._arguments else name

    def _declare(self, name: str, kind: Kind, node: ast.AST) -> None:
        """Declare a variable, or widen its kind."""
        kind = self._variables[name] = _wider([kind, self._kinds.get(name, kind)])
        if self._kinds.get(name, kind) != kind:
            self._is_settled = False
        self._kinds[name] = kind

    def _fixed_view(self, view: View, node: ast.AST) -> View:
        """Store an offset and sizes that may change later in variables."""
        offset = self._steady(view.offset, node)
        return replace(view, offset=offset, sizes=tuple(self._steady(size, node) for size in view.sizes))

    def _assign_state(self, target: ast.expr, value: Value, node: ast.AST) -> None:
        """Assign to a number of the state, or to all numbers of a view."""
        place = self._value(target)
        self.writes_state = True
        if isinstance(place, Element):
            self._statements.append(Assign(place, convert(self._number(value, node), place.kind)))
        elif isinstance(place, View):
            number = self._number(value, node)
            number = number if isinstance(number, Constant) else self._temporary(number)
            self._fill(self._fixed_view(place, node), number, node)
        else:
            raise self._refusal(node, "a target must be a number of the state")

    def _fill(self, view: View, number: Expression, node: ast.AST) -> None:
        """Write loops that set all numbers of a view."""
        variables = [Local(self._temporary_name("whole"), "whole") for _ in view.sizes]
        index = view.offset
        for variable, stride in zip(variables, view.strides, strict=True):
            index = self._operate("+", index, self._operate("*", variable, Constant(stride, "whole")))
        body: tuple[Statement, ...] = (Assign(Element(view.name, index, view.kind), convert(number, view.kind)),)
        for variable, size in zip(reversed(variables), reversed(view.sizes), strict=True):
            body = (For(variable, Constant(0, "whole"), size, body),)
        self._statements.extend(body)

    # ---- expressions

    def _temporary_name(self, kind: Kind) -> str:
        """Declare a variable of a new name."""
        self._n_temporary += 1
        name = f"t{self._n_temporary}"
        self._variables[name] = kind
        return name

    def _temporary(self, value: Expression) -> Local:
        """Store a number in a new variable."""
        variable = Local(self._temporary_name(value.kind), value.kind)
        self._statements.append(Assign(variable, value))
        return variable

    def _steady(self, value: Value, node: ast.AST) -> Expression:
        """Return a number that later statements do not change: a constant, a parameter, or a new variable."""
        number = self._number(value, node)
        if isinstance(number, Constant) or (isinstance(number, Local) and self._is_steady(number.name)):
            return number
        return self._temporary(number)

    def _is_steady(self, name: str) -> bool:
        """Return True for a variable that is assigned to once, and for a parameter."""
        return name in self._single or name not in self._stored | self._part_variables

    def _number(self, value: Value, node: ast.AST) -> Expression:
        """Return the expression of a number; raise InputError for anything else."""
        if isinstance(value, Known) and _is_number(value.value):
            return _constant(value.value)
        if isinstance(value, (Known, Record, View, Several)):
            raise self._refusal(node, "a number must stand here")
        return value

    def _whole_number(self, value: Value, node: ast.AST) -> Expression:
        """Return the expression of a whole number."""
        number = self._number(value, node)
        if number.kind == "real":
            raise self._refusal(node, "a whole number must stand here")
        return convert(number, "whole")

    def _truth_value(self, value: Value, node: ast.AST) -> Expression:
        """Return an expression as a truth value, which is True for a number other than 0."""
        number = self._number(value, node)
        if number.kind == "truth":
            return number
        return self._operate("!=", number, Constant(0, number.kind))

    def _value(self, node: ast.expr) -> Value:
        """Evaluate an expression as far as it is known."""
        method = getattr(self, f"_value_{type(node).__name__}", None)
        if method is None:
            raise self._refusal(node, f"an expression must be of the subset, got {type(node).__name__}")
        value: Value = method(node)
        return value

    def _lift(self, value: Any) -> Value:
        """Return a value of Python as a known one."""
        return Known(value)

    def _value_Constant(self, node: ast.Constant) -> Value:
        """Return a number that stands in the source."""
        return Known(node.value)

    def _value_Name(self, node: ast.Name) -> Value:
        """Return the value of a name."""
        if node.id in self._values:
            value = self._values[node.id]
            if isinstance(value, Local) and value.name in self._kinds and node.id in self._stored:
                return Local(value.name, self._kinds[value.name])
            return value
        if node.id in self._stored:
            raise self._refusal(node, f"{node.id} must be assigned to before it is used")
        if node.id not in self._names:
            raise self._refusal(node, f"the name {node.id} is not known")
        return self._lift(self._names[node.id])

    def _value_Tuple(self, node: ast.Tuple) -> Value:
        """Return a tuple of values."""
        return Several(tuple(self._value(part) for part in node.elts))

    def _value_Attribute(self, node: ast.Attribute) -> Value:
        """Return a field of a record, the shape of a view, or an attribute of a known object."""
        owner = self._value(node.value)
        if isinstance(owner, Record):
            return self._field(owner, node)
        if isinstance(owner, View) and node.attr == "shape":
            return Several(owner.sizes)
        if isinstance(owner, Known):
            return self._lift(getattr(owner.value, node.attr))
        raise self._refusal(node, f"{node.attr} must be a field of the state")

    def _field(self, record: Record, node: ast.Attribute) -> Value:
        """Return a field of a record: a number, a view of an array, a record, or a setting."""
        if record.prefix + node.attr in self._writer.known:
            return self._lift(self._writer.known[record.prefix + node.attr])
        if node.attr not in (record.layout.fields or {}):
            raise self._refusal(node, f"the state has no field {node.attr}")
        dtype = record.layout[node.attr]
        name = record.prefix + node.attr
        if dtype.fields:
            return Record(name + "_", dtype)
        kind = _kind_of(dtype.base)
        if not dtype.shape:
            return Element(name, None, kind)
        sizes = tuple(Constant(size, "whole") for size in dtype.shape)
        strides = tuple(int(np.prod(dtype.shape[k + 1 :], dtype=int)) for k in range(len(dtype.shape)))
        common, first = self._writer.places.get(name, (name, 0))
        return View(common, kind, Constant(first, "whole"), sizes, strides)

    def _value_Subscript(self, node: ast.Subscript) -> Value:
        """Return an element or a part of a view, a tuple or a table."""
        owner = self._value(node.value)
        if isinstance(owner, View):
            return self._part_of_view(owner, node)
        index = self._value(node.slice)
        if isinstance(index, Known):
            if isinstance(owner, Several):
                part: Value = owner.values[int(index.value)]
                return part
            if isinstance(owner, Known):
                return self._lift(owner.value[index.value])
        if isinstance(owner, Known) and isinstance(owner.value, (tuple, np.ndarray)):
            values = np.asarray(owner.value)
            if values.ndim != 1:
                raise self._refusal(node, "a table must have one dimension")
            hint = node.value.id if isinstance(node.value, ast.Name) else "table"
            name = self._writer.table(owner.value, hint)
            return TableElement(name, self._whole_number(index, node), _constant(values[0]).kind)
        raise self._refusal(node, "an index must be into an array of the state or a table")

    def _part_of_view(self, view: View, node: ast.Subscript) -> Value:
        """Return the element or the smaller view at some indices or slices of a view."""
        indices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if len(indices) > len(view.sizes):
            raise self._refusal(node, f"an array of {len(view.sizes)} dimensions must have as many indices at most")
        offset, sizes, strides = view.offset, list(view.sizes[len(indices) :]), list(view.strides[len(indices) :])
        kept: list[tuple[Expression, int]] = []
        for index, size, stride in zip(indices, view.sizes, view.strides, strict=False):
            if isinstance(index, ast.Slice):
                start, stop = self._limits(index, size, node)
                kept.append((self._operate("-", stop, start), stride))
            else:
                start = self._counted_from_start(self._whole_number(self._value(index), node), size)
            offset = self._operate("+", offset, self._operate("*", start, Constant(stride, "whole")))
        if not kept and not sizes:
            return Element(view.name, offset, view.kind)
        return View(view.name, view.kind, offset, (*(s for s, _ in kept), *sizes), (*(s for _, s in kept), *strides))

    def _limits(self, index: ast.Slice, size: Expression, node: ast.AST) -> tuple[Expression, Expression]:
        """Return the first index of a slice, and the one after its last."""
        if index.step is not None:
            raise self._refusal(node, "a slice must have the step 1")
        start = Constant(0, "whole") if index.lower is None else self._whole_number(self._value(index.lower), node)
        stop = size if index.upper is None else self._whole_number(self._value(index.upper), node)
        return self._counted_from_start(start, size), self._counted_from_start(stop, size)

    def _counted_from_start(self, index: Expression, size: Expression) -> Expression:
        """Return an index counted from the start, if it is a constant counted from the end."""
        if isinstance(index, Constant) and index.value < 0:
            return self._operate("+", size, index)
        return index

    def _operate(self, name: str, *operands: Expression) -> Expression:
        """Apply an operator, evaluated at once where all operands are constants."""
        if name in _EVALUATE and all(isinstance(operand, Constant) for operand in operands):
            numbers = [operand.value for operand in operands if isinstance(operand, Constant)]
            try:
                return _constant(_EVALUATE[name](*numbers))
            except ZeroDivisionError:
                pass
        first, second = operands[0], operands[1] if len(operands) > 1 else None
        if name in ("+", "-") and isinstance(second, Constant) and second.kind == "whole" and second.value == 0:
            return first
        if second is not None and first.kind == second.kind == "whole":
            if name == "+" and isinstance(first, Constant) and first.value == 0:
                return second
            if name == "*" and isinstance(second, Constant) and second.value == 1:
                return first
        kind: Kind = _wider([operand.kind for operand in operands])
        if name == "/":
            kind = "real"
        elif name in _COMPARISONS.values():
            return Operation(name, tuple(convert(operand, kind) for operand in operands), "truth")
        elif kind == "truth":
            kind = "whole"
        return Operation(name, tuple(convert(operand, kind) for operand in operands), kind)

    def _value_BinOp(self, node: ast.BinOp) -> Value:
        """Return the result of an operator of two values."""
        name = _ARITHMETIC.get(type(node.op))
        left, right = self._value(node.left), self._value(node.right)
        if type(node.op) in _TRUTH_OPERATORS:
            truths = tuple(self._truth_value(value, node) for value in (left, right))
            return Operation(_TRUTH_OPERATORS[type(node.op)], truths, "truth")
        if name is None:
            raise self._refusal(node, f"an operator must be of the subset, got {type(node.op).__name__}")
        if isinstance(left, Known) and isinstance(right, Known):
            return self._lift(_EVALUATE[name](left.value, right.value))
        a, b = self._number(left, node), self._number(right, node)
        if name == "power":
            return self._power(a, b, node)
        if name in ("floor_div", "floor_mod") and "real" in (a.kind, b.kind):
            raise self._refusal(node, "operands of // and % must be whole")
        return self._operate(name, a, b)

    def _power(self, base: Expression, exponent: Expression, node: ast.AST) -> Expression:
        """Return a power: by products for a whole exponent that is known, in the order in which numba multiplies."""
        if not (isinstance(exponent, Constant) and exponent.kind == "whole"):
            return Operation("power", (convert(base, "real"), convert(exponent, "real")), "real")
        remaining, square = abs(int(exponent.value)), self._atom(base)
        result: Expression | None = None
        while remaining:
            if remaining & 1:
                result = square if result is None else self._operate("*", result, square)
            remaining >>= 1
            if remaining:
                square = self._atom(self._operate("*", square, square))
        result = Constant(1.0, "real") if result is None else result
        return self._operate("/", Constant(1.0, "real"), result) if int(exponent.value) < 0 else result

    def _atom(self, value: Expression) -> Expression:
        """Store a number that is used more than once in a variable, where statements may precede the expression."""
        if isinstance(value, (Constant, Local)) or self._conditional:
            return value
        return self._temporary(value)

    def _value_UnaryOp(self, node: ast.UnaryOp) -> Value:
        """Return the result of an operator of one value."""
        value = self._value(node.operand)
        if isinstance(node.op, ast.Not):
            if isinstance(value, Known):
                return self._lift(not value.value)
            return Operation("not", (self._truth_value(value, node),), "truth")
        if isinstance(value, Known) and isinstance(node.op, ast.USub):
            return self._lift(-value.value)
        if not isinstance(node.op, ast.USub):
            raise self._refusal(node, f"an operator must be of the subset, got {type(node.op).__name__}")
        number = self._number(value, node)
        number = convert(number, "whole") if number.kind == "truth" else number
        return Operation("negative", (number,), number.kind)

    def _value_Compare(self, node: ast.Compare) -> Value:
        """Return the truth of one or several comparisons."""
        if len(node.ops) == 1 and isinstance(node.ops[0], (ast.Is, ast.IsNot)):
            left, right = self._value(node.left), self._value(node.comparators[0])
            is_same = isinstance(left, Known) and isinstance(right, Known) and left.value is right.value
            return self._lift(is_same == isinstance(node.ops[0], ast.Is))
        values = [self._value(part) for part in (node.left, *node.comparators)]
        results: list[Expression] = []
        for kind, first, second in zip(node.ops, values, values[1:], strict=False):
            name = _COMPARISONS.get(type(kind))
            if name is None:
                raise self._refusal(node, f"a comparison must be of the subset, got {type(kind).__name__}")
            if isinstance(first, Known) and isinstance(second, Known):
                results.append(_constant(_EVALUATE[name](first.value, second.value)))
            else:
                results.append(self._operate(name, self._number(first, node), self._number(second, node)))
        result = results[0]
        for part in results[1:]:
            result = Operation("and", (result, part), "truth")
        return self._lift(result.value) if isinstance(result, Constant) else result

    def _value_BoolOp(self, node: ast.BoolOp) -> Value:
        """Return the truth of several conditions, of which a later one is evaluated only where it decides."""
        name = "and" if isinstance(node.op, ast.And) else "or"
        decides = name == "or"  # the truth value that decides at once
        results: list[Expression] = []
        for k, part in enumerate(node.values):
            self._conditional += k > 0
            value = self._value(part)
            self._conditional -= k > 0
            if isinstance(value, Known):
                if bool(value.value) == decides:
                    results.append(_constant(decides))
                    break
                continue
            results.append(self._truth_value(value, node))
        if not results:
            return self._lift(not decides)
        result = results[0]
        for condition in results[1:]:
            result = Operation(name, (result, condition), "truth")
        return self._lift(result.value) if isinstance(result, Constant) else result

    def _value_IfExp(self, node: ast.IfExp) -> Value:
        """Return one of two values by a condition."""
        condition = self._value(node.test)
        if isinstance(condition, Known):
            return self._value(node.body if condition.value else node.orelse)
        truth = self._truth_value(condition, node)
        self._conditional += 1
        values = [self._number(self._value(part), node) for part in (node.body, node.orelse)]
        self._conditional -= 1
        kind = _wider([value.kind for value in values])
        return Operation("select", (truth, *(convert(value, kind) for value in values)), kind)

    # ---- calls

    def _value_Call(self, node: ast.Call) -> Value:
        """Return the result of a function: of the subset, or a kernel of its own."""
        function = self._value(node.func)
        if not isinstance(function, Known) or isinstance(function.value, ModuleType):
            raise self._refusal(node, "a function must be known before the machine runs")
        called = function.value
        methods: dict[Any, Callable[[ast.Call, Sequence[Value]], Value]] = {
            **{len: self._call_len, abs: self._call_abs, min: self._call_least, max: self._call_largest},
            **{int: self._call_int, float: self._call_float, bool: self._call_bool, select: self._call_select},
        }
        if called in methods:
            return methods[called](node, [self._value(part) for part in node.args])
        if called in OPERATORS:
            name = OPERATORS[called]
            values = [self._value(part) for part in node.args]
            if all(isinstance(value, Known) for value in values):
                return self._lift(called(*(value.value for value in values if isinstance(value, Known))))
            numbers = tuple(convert(self._number(value, node), "real") for value in values)
            kind: Kind = "truth" if name in _TRUTHS else "whole" if name in ("floor", "ceil") else "real"
            return Operation(name, numbers, kind)
        if not hasattr(called, "py_func") and not inspect.isfunction(called):
            raise self._refusal(node, f"a function must be a kernel or of the subset, got {ast.unparse(node.func)}")
        return self._call_kernel(called, node)

    def _call_kernel(self, kernel: Any, node: ast.Call) -> Value:
        """Write the call of another kernel, before the statement in which its results are used."""
        function = source_function(kernel)
        signature = inspect.signature(function)
        positional = [self._value(part) for part in node.args]
        named = {str(keyword.arg): self._value(keyword.value) for keyword in node.keywords}
        bound = signature.bind(*positional, **named)
        for name, parameter in signature.parameters.items():
            if name not in bound.arguments:
                bound.arguments[name] = self._lift(parameter.default)
        outer = {name: bound.arguments[name] for name in signature.parameters}
        written = self._writer.add_function(function, outer)
        changes_state = written.name in self._writer.writes_state
        self.writes_state |= changes_state
        if self._conditional:
            raise self._refusal(node, "a kernel must not be called where only a condition decides whether it is")
        if changes_state and not self._reads_state_only_in(node):
            raise self._refusal(node, "a kernel that changes the state must not be called beside a number of the state")
        passed: dict[str, Expression] = {}
        for name, value in outer.items():
            passed |= {inner.name: theirs for inner, theirs in _pairs(_parameter_value(name, value), value)}
        arguments = [convert(passed[parameter.name], parameter.kind) for parameter in written.parameters]
        results = tuple(Local(self._temporary_name(kind), kind) for kind in written.results)
        self._statements.append(Call(written.name, tuple(arguments), results))
        if not results:
            return Known(None)
        return _shaped(self._writer.result_shapes[written.name], iter(results))

    def _reads_state_only_in(self, call: ast.Call) -> bool:
        """Return True if the present statement's expression reads no state outside of a call, which may change it."""
        if self._root is None:
            return False
        inside = {id(node) for node in ast.walk(call)}
        names = [node.id for node in ast.walk(self._root) if isinstance(node, ast.Name) and id(node) not in inside]
        calls = [node for node in ast.walk(self._root) if isinstance(node, ast.Call) and id(node) not in inside]
        kernels = [node for node in calls if hasattr(getattr(self._value(node.func), "value", None), "py_func")]
        return not kernels and not any(isinstance(self._values.get(name), (View, Record)) for name in names)

    def _call_len(self, node: ast.Call, values: Sequence[Value]) -> Value:
        """Return the number of entries of a view or a tuple."""
        (value,) = values
        if isinstance(value, View):
            size = value.sizes[0]
            return Known(size.value) if isinstance(size, Constant) else size
        if isinstance(value, Several):
            return Known(len(value.values))
        if isinstance(value, Known):
            return Known(len(value.value))
        raise self._refusal(node, "len must be of an array or a tuple")

    def _call_abs(self, node: ast.Call, values: Sequence[Value]) -> Value:
        """Return the magnitude of a number."""
        (value,) = values
        if isinstance(value, Known):
            return Known(abs(value.value))
        number = self._number(value, node)
        return Operation("absolute", (number,), number.kind)

    def _extreme(self, name: str, node: ast.Call, values: Sequence[Value]) -> Value:
        """Return the extreme of some numbers as Python does: a later one replaces an earlier one that it passes."""
        if all(isinstance(value, Known) for value in values):
            return Known((max if name == ">" else min)(v.value for v in values if isinstance(v, Known)))
        numbers = [self._number(value, node) for value in values]
        kind = _wider([number.kind for number in numbers])
        numbers = [self._atom(convert(number, kind)) for number in numbers]
        extreme = numbers[0]
        for number in numbers[1:]:
            chosen = Operation("select", (self._operate(name, number, extreme), number, extreme), kind)
            extreme = self._atom(chosen) if number is not numbers[-1] else chosen
        return extreme

    def _call_least(self, node: ast.Call, values: Sequence[Value]) -> Value:
        """Return the least of some numbers."""
        return self._extreme("<", node, values)

    def _call_largest(self, node: ast.Call, values: Sequence[Value]) -> Value:
        """Return the largest of some numbers."""
        return self._extreme(">", node, values)

    def _call_select(self, node: ast.Call, values: Sequence[Value]) -> Value:
        """Return one of two numbers by a condition."""
        truth = self._truth_value(values[0], node)
        numbers = [self._number(value, node) for value in values[1:]]
        kind = _wider([number.kind for number in numbers])
        return Operation("select", (truth, *(convert(number, kind) for number in numbers)), kind)

    def _call_int(self, node: ast.Call, values: Sequence[Value]) -> Value:
        """Return a number without its fraction."""
        (value,) = values
        return Known(int(value.value)) if isinstance(value, Known) else convert(self._number(value, node), "whole")

    def _call_float(self, node: ast.Call, values: Sequence[Value]) -> Value:
        """Return a number as a real one."""
        (value,) = values
        return Known(float(value.value)) if isinstance(value, Known) else convert(self._number(value, node), "real")

    def _call_bool(self, node: ast.Call, values: Sequence[Value]) -> Value:
        """Return the truth of a number."""
        (value,) = values
        return Known(bool(value.value)) if isinstance(value, Known) else self._truth_value(value, node)


def _parameters(value: Value) -> Iterator[Local]:
    """Yield the parameters of an argument within a function."""
    if isinstance(value, Local):
        yield value
    elif isinstance(value, View):
        yield from (part for part in (value.offset, *value.sizes) if isinstance(part, Local))
    elif isinstance(value, Several):
        for part in value.values:
            yield from _parameters(part)


def _as_load(target: ast.expr) -> ast.expr:
    """Copy a target of an assignment as an expression that reads it."""
    if isinstance(target, ast.Name):
        return ast.copy_location(ast.Name(target.id, ast.Load()), target)
    if isinstance(target, ast.Attribute):
        return ast.copy_location(ast.Attribute(target.value, target.attr, ast.Load()), target)
    assert isinstance(target, ast.Subscript)
    return ast.copy_location(ast.Subscript(target.value, target.slice, ast.Load()), target)
