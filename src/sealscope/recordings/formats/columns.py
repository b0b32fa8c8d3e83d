"""Choose the columns of a table that are read as channels, by headings, units, the map of the user, and its formulas.

A formula of a map computes a channel from columns, such as ``ch2*0.0625-0.625 bar`` or ``rpm*valve/100``.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import reduce
from math import isfinite
from operator import add, mul, neg, sub, truediv
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, cast

import numpy as np

from sealscope.calls import nearest
from sealscope.errors import InputError
from sealscope.paragraphs import join_names
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS, UNUSED, Array
from sealscope.recordings.formats.headings.actuators import find_actuators
from sealscope.recordings.formats.headings.labels import (
    WORDS,
    Label,
    ends_in,
    format_map,
    is_current_or_fraction,
    is_measured,
    is_temperature,
    is_time,
    proposed_map,
    split_square_brackets,
    split_unit,
    unit_of_time,
)
from sealscope.recordings.formats.times.timebase import find_time_parts
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


class _MissingColumnError(InputError):
    """A map names a column that a file does not have."""


_MAX_DIGITS = 9  # most digits of a column's number; no log has as many columns
#: Separators of the parts of a path such as `Rig.Cyl.p_A`.
_PATH_SEPARATORS = re.compile(r"[./\\:<>]")
#: Channel (or `t`) -> column, given by a caller; or "auto": choose by the columns' names. The entry `REST` -> "auto" of
#: a mapping does this for the channels that it does not name.
ChannelMap = Mapping[str, str] | Literal["auto"]
REST = "*"
#: Entry of a map that names one of several actuators, as "boom": the columns of the others are not read.
GROUP = "group"
#: Label of a file's own sampling times, which come after its columns if none of these is called t.
CLOCK_LABEL = Label("t [s]", "t", "s")


@dataclass(frozen=True)
class Request:
    """Choices of a user for reading a file; invalid values raise InputError."""

    map: ChannelMap  # channel -> column, or "auto" to choose by the columns' names
    rate: float | None = None  # sampling rate [Hz] in place of a time column
    file: str = ""  # name of the file for the provenance
    path: Path | None = None  # the file, if others beside it may tell whether dates begin with the day
    optional: frozenset[str] = frozenset()  # entries of the map that do not count in a file that lacks their columns
    every_column: bool = False  # read every column as it is, without a channel's meaning; of the map only `t` counts

    def __post_init__(self) -> None:
        check_request(self.map, self.rate)


@dataclass
class ColumnMap:
    """The columns of a table that are read, and their meaning; columns are numbered from 0."""

    labels: Sequence[Label]
    rate: float | None = None  # sampling rate [Hz] from the caller or the file
    time: int | None = None  # the time column
    time_label: Label | None = None  # name and unit used for it
    channels: dict[str, Formula[int]] = field(default_factory=dict)  # channel -> formula of its columns
    parts: dict[str, int] = field(default_factory=dict)  # part of a time in several columns, such as "hour" -> column
    #: Column of the date, in case the time column contains only times of day. If the name of the time column means a
    #: date, it is the time column itself, which may then contain only dates.
    date: int | None = None
    names: dict[str, str] = field(default_factory=dict)  # channel -> its name in the file, if that differs
    unused: tuple[str, ...] = ()  # names of columns with measured quantities that are in no channel
    unused_temperatures: tuple[str, ...] = ()  # names of columns with temperatures, unless one is the oil's
    notes: list[str] = field(default_factory=list)  # lines for the history of the recording
    #: Kind of the cells of columns that are no time: "numbers" or, for infinity in place of words, "any".
    cells: Literal["numbers", "any"] = "numbers"

    @property
    def channel_of(self) -> dict[int, str]:
        """Mapping from each column that a channel uses to this channel, the last one if there are several."""
        return {column: name for name, formula in self.channels.items() for column in formula.columns}

    @property
    def wordy(self) -> frozenset[int]:
        """Columns that may hold words, which are no reason not to read the file: the direction of a valve."""
        return frozenset(self.channels["valve"].columns if "valve" in self.channels else ())

    @property
    def columns(self) -> dict[int, str]:
        """Mapping from each column to read to its kind, `cells` or "time"; the time column comes last."""
        # a time column that is also a channel is read as numbers
        number_columns = {*self.channel_of, *self.parts.values()} - {self.time}
        columns: dict[int, str] = dict.fromkeys(sorted(number_columns), self.cells)
        if self.time is not None:
            columns[self.time] = self.cells if self.time in self.channel_of else "time"
        return columns


def split_map_option(text: str) -> tuple[str, str]:
    """Split ``p_A=PG_1`` or ``p_A=PG_1[psi]`` into channel and column; raise InputError for any other text."""
    channel, equals, column = (part.strip() for part in text.partition("="))
    if not equals or not channel or not column:
        raise InputError(f"a map must read CHANNEL=COLUMN, such as p_A=PG_1 or p_A=PG_1[psi], got {text!r}")
    _check_channel(channel)
    return channel, column


def _check_channel(channel: str) -> None:
    """Raise InputError unless `channel` is the name of a channel or `t`."""
    names = [*CHANNEL_UNITS, "t"]
    if channel not in names:
        suggestions = nearest(channel, names)
        hint = f" (did you mean {suggestions[0]}?)" if suggestions else ""
        raise InputError(f"a mapped channel must be one of {', '.join(names)}, got {channel}{hint}")


def check_request(channel_map: ChannelMap, rate: float | None) -> None:
    """Raise InputError for an unknown channel or a wrong word in a map, and for a rate that is not positive."""
    if isinstance(channel_map, str) and channel_map != "auto":
        raise InputError(f"map must be a mapping or the word auto, got {channel_map!r}")
    for channel in explicit_columns(channel_map):
        _check_channel(channel)
    group = find_group(channel_map)
    if group is not None and not (isinstance(group, str) and group.strip()):
        raise InputError(f"group must be the words for one actuator, such as boom, got {group!r}")
    if not isinstance(channel_map, str) and channel_map.get(REST, "auto") != "auto":
        raise InputError(f"map must map {REST} to the word auto, got {channel_map[REST]!r}")
    if rate is not None and not (isfinite(rate) and rate > 0):
        raise InputError(f"rate must be > 0 Hz, got {rate}")


def uses_names(channel_map: ChannelMap) -> bool:
    """Test whether the columns' names choose the channels that a map does not name: it has "auto", or a group."""
    return isinstance(channel_map, str) or REST in channel_map or GROUP in channel_map


def find_group(channel_map: ChannelMap) -> str | None:
    """Find the actuator that a map names, such as "boom"; None if it names none."""
    return None if isinstance(channel_map, str) else channel_map.get(GROUP)


def as_mapping(channel_map: ChannelMap) -> dict[str, str]:
    """Convert a map to a dictionary; "auto" becomes the entry of `REST`."""
    return {REST: channel_map} if isinstance(channel_map, str) else dict(channel_map)


def with_group(channel_map: ChannelMap, group: str | None) -> ChannelMap:
    """Add the name of an actuator to a map; without one, return the map unchanged."""
    return channel_map if group is None else as_mapping(channel_map) | {GROUP: group}


def explicit_columns(channel_map: ChannelMap) -> dict[str, str]:
    """Return the entries of a map, channel -> column, that name a column; empty for the map "auto"."""
    if isinstance(channel_map, str):
        return {}
    return {name: column for name, column in channel_map.items() if name not in (REST, GROUP)}


def reconstruct_map(provenance: Mapping[str, object]) -> dict[str, str]:
    """Reconstruct the map that "auto" has chosen for a recording, channel -> column, from its provenance.

    A unit at the end of a column's name is added, as in `PA_bar[bar]`; units in a user's map are not in the provenance.
    """
    names = provenance.get("columns")
    columns = {str(channel): str(heading) for channel, heading in names.items()} if isinstance(names, Mapping) else {}
    proposed = proposed_map([Label.parse(heading) for heading in columns.values()])
    return {channel: proposed.get(channel, heading) for channel, heading in columns.items()}


def _find_unit(label: Label, channel: str) -> str | None:
    """Find the unit of a column in its heading, else at the end of its name if it suits `channel`; None if unknown."""
    name_unit = split_unit(label.name)[1] if label.unit is None else None
    is_possible = name_unit is not None and same_dimension(name_unit, "s" if channel == "t" else CHANNEL_UNITS[channel])
    return name_unit if is_possible else label.unit


def _format_columns(labels: Sequence[Label]) -> str:
    """Format the headings of all columns as a list for messages."""
    return join_names(label.whole for label in labels)


def _find_column(labels: Sequence[Label], name: str, description: str, mapped: bool = False) -> int | None:
    """Find the index of the column called `name`; None if there is none.

    Names are compared by criteria from strict to loose; the first that a column meets decides. With `mapped`, the last
    words of a column's name are enough, such as `ch2` for `ADC1_Channel_2`. A name such as `#4` may also be a number,
    counted from 1. Raises InputError, which calls the column `description`, if several columns meet that criterion.
    """
    folded = name.casefold()
    for matches_name in (
        lambda label: label.whole == name,
        lambda label: label.name == name,
        lambda label: label.called and label.called == name,
        lambda label: folded in (label.whole.casefold(), label.name.casefold()),
        lambda label: mapped and ends_in(label.name, name),
    ):
        matches = [i for i, label in enumerate(labels) if matches_name(label)]
        if len(matches) > 1:
            numbers = " and ".join(str(i + 1) for i in matches)
            raise InputError(
                f"{description} must be one column, got columns {numbers}: map its number, #{matches[0] + 1}"
            )
        if matches:
            return matches[0]
    digits = name[1:].lstrip("0") if name.startswith("#") else ""
    is_number = digits.isascii() and digits.isdigit() and len(digits) <= _MAX_DIGITS
    return int(digits) - 1 if is_number and int(digits) <= len(labels) else None


def _parse_mapping(labels: Sequence[Label], channel: str, column_text: str) -> Formula[int]:
    """Convert the entry of a channel in a user's map to a formula of column numbers.

    `column_text`: a column's name, possibly with a unit, or a formula of several columns. Without a unit, that in the
    columns' headings is used. Raises InputError if a column does not exist, or if these units differ.
    """
    description = f"{column_text}, mapped to {channel},"
    name_before_blank, _, unit_after_blank = column_text.rpartition(" ")
    # try the text as a name without a unit, as `name [unit]`, and as `name unit`
    for name, unit in ((column_text, None), split_square_brackets(column_text), (name_before_blank, unit_after_blank)):
        column = _find_column(labels, name, description) if name else None
        if column is not None:
            return Formula.of_column(column, _find_unit(labels[column], channel) if unit is None else unit)
    try:
        formula = parse_formula(column_text)
    except InputError:  # without an operator the text is meant as a name, which may contain - and /
        if any(operator in column_text for operator in "*+"):
            raise
        formula = Formula.of_column(column_text)

    def find(name: str) -> int:
        """Find the column with this name in the formula."""
        operand = description if name == column_text else f"{name} of {description}"
        column = _find_column(labels, name, operand, mapped=True)
        if column is None:
            raise _MissingColumnError(f"{operand} must be a column, got columns {_format_columns(labels)}")
        return column

    try:
        formula_of_columns = formula.with_columns(find, lambda column: _find_unit(labels[column], channel))
    except _MissingColumnError:
        raise
    except InputError as error:
        raise InputError(f"{description} cannot be computed: {error}") from None
    column, unit = formula_of_columns.column, formula_of_columns.unit
    if column is not None:
        return replace(formula_of_columns, unit=_find_unit(labels[column], channel) if formula.unit is None else unit)
    # a pure number is no unit of a channel: raw counts
    return replace(formula_of_columns, unit=None if unit is not None and is_pure_number(unit) else unit)


def _choose_unit(channel: str, unit: str | None, description: str) -> tuple[str, str | None]:
    """Choose the unit in which a column in `unit` is read as a channel; also return a note for the history, or None.

    The column keeps its unit, with these exceptions. A column without unit (None), or a command in amperes or per cent,
    is read as raw counts, i.e. numbers of an unknown scale; a temperature without unit is in deg C. A speed in turns
    per minute, however written, is in rpm.
    The note begins with `description`. Raises InputError for a unit of the wrong dimension.
    """
    if unit is None and channel == "T_oil":
        return "degC", f"{description} has no unit: taken as °C"
    if unit is None and channel == "valve":
        return COUNTS, None
    if unit is None:
        return COUNTS, f"{description} has no unit: taken as raw counts"
    if same_dimension(unit, COUNTS):
        return COUNTS, None
    if channel == "omega" and unit in WORDS["rotation_units"]:
        return "rpm", None
    if channel == "valve" and is_current_or_fraction(unit):
        return COUNTS, None  # only its side counts
    if channel == "u" and is_current_or_fraction(unit):
        return COUNTS, f"{description} is a command in {unit}: its scale in V is unknown, so only its changes are used"
    to_si(0.0, unit, CHANNEL_UNITS[channel], name=channel)  # raises InputError for a wrong dimension
    return unit, None


def _apply_map(choice: ColumnMap, columns: Mapping[str, str]) -> None:
    """Add to `choice` the channels and the time column that a user has mapped: channel or "t" -> text of the map."""
    for channel, column_text in columns.items():
        formula = _parse_mapping(choice.labels, channel, column_text)
        name = column_text if formula.column is None else choice.labels[formula.column].whole
        if channel == "t":
            if formula.column is None:
                raise InputError(f"t must be a column and its unit, such as t=time ms, got {column_text}")
            choice.time, choice.time_label = formula.column, Label(name, name, formula.unit)
            continue
        kind = "formula" if formula.column is None else "column"
        unit, note = _choose_unit(channel, formula.unit, f"{kind} {name}, read as {channel},")
        choice.channels[channel] = replace(formula, unit=unit)
        if formula.column is None or choice.labels[formula.column].name != channel:
            choice.names[channel] = name
        choice.notes.append(note or f"{kind} {name} read as {channel} in {unit}")


def _apply_names(choice: ColumnMap, labels: Sequence[Label]) -> None:
    """Add to `choice` the channels and the time column that the names of columns show, beside those already chosen.

    `labels`: those of all columns, as the names of one actuator show them (`_select_actuator`).
    """
    embedded: list[int] = []  # columns with the name of a channel in a path, or before a unit
    for channel in CHANNEL_UNITS:
        if channel in choice.channels:
            continue
        column = _find_column(labels, channel, f"channel {channel}")
        if column is None and (column := _find_embedded_name(labels, channel)) is not None:
            embedded.append(column)
        if column is not None and column != choice.time and column not in choice.channel_of:
            found_unit = _find_unit(labels[column], channel)
            unit, note = _choose_unit(channel, found_unit, f"column {labels[column].whole}")
            choice.channels[channel] = Formula.of_column(column, unit)
            if choice.labels[column].name != channel:
                choice.names[channel] = labels[column].whole
            choice.notes += [note] if note else []
    actuators = find_actuators(choice.labels) if len(embedded) > 1 else None
    if actuators is not None and actuators.names and not actuators.find_containing(embedded):
        raise InputError(actuators.question())
    if choice.time is None and (time := _find_time(labels)) is not None:
        label = labels[time]
        unit_of_name = label.unit or WORDS["time"].get(label.name.casefold()) or unit_of_time(label)
        choice.time, choice.time_label = time, replace(label, unit=unit_of_name)


def _select_actuator(choice: ColumnMap, request: Request, mapped_columns: Container[int]) -> Sequence[Label]:
    """Select the columns of one actuator: return the labels without the others' columns and without words for it.

    It is that of the map's `group`, else that to which the user's `mapped_columns` belong, else the default of
    `find_actuators`. If the mapped columns are of several, only columns common to all are selected. A note names the
    columns left out. Raises InputError, a question that names the actuators, if it is not known which is meant.
    """
    labels, group = choice.labels, find_group(request.map)
    folders = {label.whole.rpartition("/")[0] for label in labels if label.name in ("p_A", "p_B")}
    has_own_names = len(folders) == 1 and {"p_A", "p_B"} <= {label.name for label in labels}
    if group is None and (has_own_names or not uses_names(request.map)):
        return labels  # by the channels' own names; `_check_actuator` follows
    actuators = find_actuators(labels)
    mapped = [column for column, label in enumerate(actuators.shared) if not label.whole and column in mapped_columns]
    number = actuators.default if group is None else actuators.find(group)
    if group is None and mapped:
        candidates = actuators.find_containing(mapped)
        if not candidates:
            return actuators.shared
        number = candidates[0] if len(candidates) == 1 else number
    if number is None:
        if not actuators.names:
            return labels
        raise InputError(actuators.question())
    selected = actuators.labels[number]
    left_out = [label.whole for label, other in zip(labels, selected, strict=True) if label.whole and not other.whole]
    if left_out:
        choice.notes.append(f"columns of {actuators.names[number]} read, not {join_names(left_out, 6)}")
    return selected


def _find_embedded_name(labels: Sequence[Label], channel: str) -> int | None:
    """Find the only column with a channel's name in a path or before a unit, such as `Rig.Cyl.p_A [bar]` or `p_A_bar`.

    The unit must suit the channel. None if there is no such column or several.
    """
    matches = [
        i
        for i, label in enumerate(labels)
        if (
            channel in _PATH_SEPARATORS.split(label.name)
            and label.unit is not None
            and same_dimension(label.unit, CHANNEL_UNITS[channel])
        )
        or (split_unit(label.name)[0] == channel and _find_unit(label, channel) is not None)
    ]
    return matches[0] if len(matches) == 1 else None


def _find_time(labels: Sequence[Label]) -> int | None:
    """Find the index of the time column; None if there is none.

    It is a column named `t`, else one with another usual name (`WORDS["time"]`, in this order), else one that `is_time`
    accepts and that is not named as a date. Of several such columns, the first with a unit is preferred.
    Raises InputError if several are called `t`.
    """
    if (exact := next((i for i, label in enumerate(labels) if label.name == "t"), None)) is not None:
        _find_column(labels, "t", "t")  # raises if there are several
        return exact
    with_usual_names = [
        [i for i, label in enumerate(labels) if name in (label.whole.casefold(), label.name.casefold())]
        for name in WORDS["time"]
    ]
    times = [i for i, label in enumerate(labels) if is_time(label) and label.name.casefold() not in WORDS["date"]]
    matches = next(filter(None, (*with_usual_names, times)), [])
    return next((i for i in matches if labels[i].unit is not None), matches[0] if matches else None)


def _choose_time_columns(choice: ColumnMap) -> None:
    """Complete `choice` with a time in several columns, or in a column whose name does not mean a time.

    - Columns of hours, minutes and seconds form the time, alone or with a date.
    - Otherwise, without a time column and a rate, the time is a column of dates, or the only column in a unit of time.
    - Columns with parts of a second are added to the time, unless it is the file's own (`CLOCK_LABEL`).
    """
    labels, used = choice.labels, choice.channel_of
    parts = find_time_parts(labels, used)
    if "hour" in parts and choice.time in (None, *parts.values()):  # a time column besides them takes precedence
        dates = [i for i in _date_columns(choice) if i not in parts.values()]
        time = parts["hour"] if choice.time is None else choice.time
        time = dates[0] if dates and "year" not in parts else time  # the date to which the parts are added
        names = ", ".join(labels[i].whole for i in dict.fromkeys((time, *parts.values())))
        # if the values prove not to be parts of one time, a time column that was found by its name is read alone, in s
        choice.time_label = Label(names, names, "s" if choice.time is not None else None)
        choice.time, choice.parts = time, parts
        return
    if choice.time is None and choice.rate is None:
        in_time_units = [
            i for i, label in enumerate(labels) if i not in used and label.unit and same_dimension(label.unit, "s")
        ]
        dates = _date_columns(choice)
        if dates or len(in_time_units) == 1:  # `x-axis` over `second`, as oscilloscopes write
            choice.time = (dates or in_time_units)[0]
            choice.time_label = labels[choice.time]
    if choice.time is not None and labels[choice.time] is not CLOCK_LABEL:
        choice.parts = find_time_parts(labels, {*used, choice.time}, only_subsecond=True)


def _date_columns(choice: ColumnMap) -> list[int]:
    """List the columns that are called a date, such as `Datum`, and are used by no channel."""
    columns = [i for i, label in enumerate(choice.labels) if label.name.casefold() in WORDS["date"]]
    return [i for i in columns if i not in choice.channel_of]


def _format_hint(labels: Sequence[Label], known: Container[str] = (), also: str = "") -> str:
    """Format a hint on what "auto" would read, but for `known` channels, or the question which actuator is meant.

    `also`: word before "read". Without such a channel the hint is empty.
    """
    actuators = find_actuators(labels)
    if actuators.names and actuators.default is None:
        return f"; {actuators.question()}"
    own_labels = labels if actuators.default is None else actuators.labels[actuators.default]
    proposed = proposed_map(own_labels, labels)
    proposal = format_map({name: column for name, column in proposed.items() if name not in known})
    return f"; map auto would {also}read {proposal}" if proposal else ""


def _note_unused(choice: ColumnMap, labels: Sequence[Label], used: Container[int | None]) -> None:
    """Add a note on unused columns to `choice`, with a map by which some of them could be read.

    Also set `choice.unused` and, if no column is T_oil, `choice.unused_temperatures`. `labels`: those of all columns,
    empty for those of other actuators; `used`: numbers of used columns.
    """
    unused = [label for i, label in enumerate(labels) if i not in used and label.whole]
    choice.unused = tuple(label.whole for label in unused if is_measured(label))
    if not unused:
        return
    channel_names = {*choice.channels, "t"}
    hint = _format_hint(labels, channel_names, "also ")
    if "T_oil" not in channel_names:
        choice.unused_temperatures = tuple(label.whole for label in unused if is_temperature(label))
    if choice.unused_temperatures:
        hint += f"; if it is the oil's temperature: --map 'T_oil={choice.unused_temperatures[0]}'"
    choice.notes.append(f"{UNUSED}: {join_names((label.whole for label in unused), 40)}{hint}")


def _choose_every_column(labels: Sequence[Label], request: Request, stated_rate: float | None) -> ColumnMap:
    """Choose all columns of a table, each as numbers without a meaning under its heading, and their time.

    The time is that of `choose_columns`. Without one, the rate is that of the request or of the file, else 1 Hz.
    """
    choice = ColumnMap(labels, stated_rate if request.rate is None else request.rate, cells="any")
    if request.rate is None:
        if time := explicit_columns(request.map).get("t"):
            _apply_map(choice, {"t": time})
        elif (column := _find_time(labels)) is not None:
            label = labels[column]
            unit = label.unit or WORDS["time"].get(label.name.casefold()) or unit_of_time(label)
            choice.time, choice.time_label = column, replace(label, unit=unit)
        _choose_time_columns(choice)
    used = {choice.time, *choice.parts.values()}
    if choice.time is not None:
        choice.date = next((i for i in _date_columns(choice) if i not in used), None)
    elif choice.rate is None:
        choice.rate = 1.0
        choice.notes.append("neither a time nor a rate: drawn over the number of the row")
    for column, label in enumerate(labels):
        if column not in {*used, choice.date}:
            name = label.whole or f"column {column + 1}"
            name = f"{name} (column {column + 1})" if name in choice.channels else name
            choice.channels[name] = Formula.of_column(column, COUNTS)
    if not choice.channels:
        raise InputError(f"a table must have a column beside its time, got columns {_format_columns(labels)}")
    return choice


def find_missing_entries(columns: Mapping[str, str], labels: Sequence[Label]) -> list[str]:
    """Find the channels of a map whose columns a table lacks; `labels`: headings of the table."""
    missing = []
    for channel, column in columns.items():
        try:
            _parse_mapping(labels, channel, column)
        except _MissingColumnError:
            missing.append(channel)
    return missing


def choose_columns(labels: Sequence[Label], request: Request, stated_rate: float | None = None) -> ColumnMap:
    """Choose the columns of a table to read, and the channel of each.

    With a requested rate no time is read. Without a time column the rate is the `stated_rate` [Hz] of the file. If the
    map contains "auto", other columns are chosen by their names and units (`proposed_map`). A column in the map takes
    precedence over a column with the channel's name. Raises InputError if a mapped column does not exist, unless its
    entry is `optional`, if no column is a channel, there is neither a time nor a rate, or a unit has the wrong
    dimension.
    """
    if request.every_column:
        return _choose_every_column(labels, request, stated_rate)
    choice = ColumnMap(labels, stated_rate)
    columns, rate = explicit_columns(request.map), request.rate
    for channel in find_missing_entries({name: columns[name] for name in request.optional & columns.keys()}, labels):
        choice.notes.append(f"{columns[channel]}, which the machine's map reads as {channel}, is not in this file")
        del columns[channel]
    mapped_columns: dict[int, str] = {}
    for channel, column_text in columns.items():
        with suppress(InputError):  # raised again by `_apply_map`
            mapped_columns.update(dict.fromkeys(_parse_mapping(labels, channel, column_text).columns, channel))
    named_labels = _select_actuator(choice, request, mapped_columns)
    if uses_names(request.map):
        # no channel is proposed for an empty heading
        other_labels = [Label("", "") if k in mapped_columns else label for k, label in enumerate(named_labels)]
        columns = {**proposed_map(other_labels, labels), **columns}
    _apply_map(choice, columns)
    _apply_names(choice, named_labels)
    if rate is None:
        _choose_time_columns(choice)
    if not choice.channels:
        raise InputError(
            f"a recording must have a channel ({', '.join(CHANNEL_UNITS)}) or be given a map such as p_A=COLUMN, "
            f"got columns {_format_columns(labels)}{_format_hint(labels)}"
        )
    used = {*choice.channel_of, choice.time, *choice.parts.values()}
    if rate is not None:
        choice.rate = rate
        if choice.time_label is not None:
            choice.notes.append(f"time column {choice.time_label.whole} not used: the rate was given as {rate:g} Hz")
    elif choice.time is None:
        if stated_rate is None:
            proposal = format_map({channel: labels[column].whole for column, channel in choice.channel_of.items()})
            raise InputError(
                "a recording must have a time column such as t [s] or be given a rate, "
                f"got columns {_format_columns(labels)}; name it by --map t=COLUMN; channels would be {proposal}"
            )
        choice.notes.append(f"no time column: sampled at {stated_rate:g} Hz, as the file says")
    if choice.time is not None:  # a column of dates completes a time column that has only times of day
        choice.date = next((i for i in _date_columns(choice) if i not in used), None)
    _note_unused(choice, named_labels, {*used, choice.date})
    if rate is not None:  # the time is named in the notes, but not read
        choice.time = choice.time_label = choice.date = None
    elif "t" not in columns and not choice.parts and choice.time is not None:
        # without columns of hours, minutes, ... (`parts`) a time column that is called a date may have only dates, and
        # is then refused (`convert_columns`), unless the user has mapped it
        is_date = labels[choice.time].name.casefold() in WORDS["date"]
        choice.date = choice.time if is_date else choice.date
    # in the order of the first column of each in the file
    choice.channels = dict(sorted(choice.channels.items(), key=lambda item: item[1].columns[0]))
    return choice
