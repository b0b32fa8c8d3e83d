"""Terms of a volume balance as expressions, evaluated by NumPy for files and written as a kernel for streams.

An expression computes the increment of a term over one sampling interval, such as ``mean(x) * change(p_A)``:

- a channel, such as ``p_A``, ``absolute(p_A)``, an absolute pressure, and ``log(...)`` are values at a sample;
- ``change(v)`` and ``mean(v)``: difference and mean of a value v at the two ends of the interval;
- ``dt``: the interval [s]; ``rate``: its inverse [Hz]; ``pressure_difference``: mean of p_A - p_B without the sensors'
  offset; ``out_A``, ``out_B``, ``in_A``, ``in_B``: 1 while the piston moves towards B (out) or A (in) and side A or B
  carries the load, else 0, and 1/2 if that changes within the interval; ``displacement``: that of the pump [m^3/rad];
- ``gradient(e)``: change of an increment e from one interval to the next, by a central difference;
- numbers, and ``+ - * /``.
"""

from __future__ import annotations

import ast
import linecache
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from itertools import count
from typing import Any

import numpy as np

from sealscope.compiled import kernel
from sealscope.diagnosis.inference.equations.signals import MIN_ABSOLUTE_PRESSURE, Signals, interval_means
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM

#: Directions of motion with the side that carries the load: (towards B, side A) by the word of an expression.
DIRECTIONS = {"out_A": (True, True), "out_B": (True, False), "in_A": (False, True), "in_B": (False, False)}
_FUNCTIONS = ("change", "mean", "absolute", "log", "gradient")
_WORDS = (*DIRECTIONS, "dt", "rate", "pressure_difference", "displacement")
_OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_numbers = count(1)


@cache
def parse_expression(text: str) -> ast.expr:
    """Parse an expression; raise ValueError with the word that it must not have."""
    tree = ast.parse(text, mode="eval").body
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            known = node.id in CHANNEL_UNITS or node.id in _WORDS or node.id in _FUNCTIONS
        elif isinstance(node, ast.Constant):
            known = isinstance(node.value, (int, float))
        else:
            known = isinstance(node, (ast.Call, ast.BinOp, ast.expr_context, *_OPERATORS))
        if not known:
            raise ValueError(f"an expression of a term must be of its words, got {ast.unparse(node)!r} in {text!r}")
    return tree


@cache
def channels_of(text: str) -> frozenset[str]:
    """Return the channels that an expression reads."""
    names = {node.id for node in ast.walk(parse_expression(text)) if isinstance(node, ast.Name)}
    needed = names & set(CHANNEL_UNITS)
    needed |= {"p_A", "p_B"} if "pressure_difference" in names else set()
    return frozenset(needed | ({"p_A", "p_B", "x"} if names & set(DIRECTIONS) else set()))


@cache
def increments_of(text: str, displacement: float = 1.0) -> Callable[[Signals], Array]:
    """Return a function that evaluates an expression over all sampling intervals of `Signals`, shape (n - 1,)."""
    evaluate = _over_intervals(parse_expression(text), displacement)

    def increments(signals: Signals) -> Array:
        """Evaluate the expression."""
        values = evaluate(signals)
        return np.asarray(values) if np.ndim(values) else np.full(len(signals.time_step), values)

    return increments


#: Evaluates a part of an expression, over the sampling intervals (n - 1,) or at the samples (n,) of `Signals`.
_Evaluate = Callable[[Signals], Any]


def _over_intervals(node: ast.expr, displacement: float) -> _Evaluate:
    """Build the function that evaluates an expression over the sampling intervals (n - 1,)."""
    if isinstance(node, ast.Constant):
        return _constant(node)
    if isinstance(node, ast.BinOp):
        return _binary(node, *(_over_intervals(side, displacement) for side in (node.left, node.right)))
    if isinstance(node, ast.Name):
        if node.id in DIRECTIONS:
            return partial(_direction, *DIRECTIONS[node.id])
        words: dict[str, _Evaluate] = {
            "pressure_difference": lambda s: s.pressure_difference,
            "dt": lambda s: s.dt,
            "rate": lambda s: s.rate,
            "displacement": lambda _: displacement,
        }
        return words[node.id]
    name, value = _call(node)
    if name == "gradient":
        rates = _over_intervals(value, displacement)
        return lambda s: np.gradient(rates(s))
    if isinstance(value, ast.Name):
        channel = value.id
        return (lambda s: s.step(channel)) if name == "change" else (lambda s: s.mean(channel))
    points, combine = _at_samples(value), np.diff if name == "change" else interval_means
    return lambda s: combine(points(s))


def _at_samples(node: ast.expr) -> _Evaluate:
    """Build the function that evaluates an expression at the samples (n,)."""
    if isinstance(node, ast.Constant):
        return _constant(node)
    if isinstance(node, ast.Name):
        channel = node.id
        return lambda s: s[channel]
    if isinstance(node, ast.BinOp):
        return _binary(node, _at_samples(node.left), _at_samples(node.right))
    name, value = _call(node)
    if name == "absolute":
        assert isinstance(value, ast.Name)
        pressure = value.id
        return lambda s: s.absolute_pressure[pressure]
    points = _at_samples(value)

    def logarithm(s: Signals) -> Array:
        """Compute the logarithm at each sample."""
        values = np.asarray(points(s))
        logarithms = np.empty(values.shape)
        _take_logarithms(values, logarithms)
        return logarithms

    return logarithm


def _constant(node: ast.Constant) -> _Evaluate:
    """Build the function that returns a number."""
    number = float(node.value)  # type: ignore[arg-type]
    return lambda _: number


def _binary(node: ast.BinOp, left: _Evaluate, right: _Evaluate) -> _Evaluate:
    """Build the function that applies an operator to the values of both sides."""
    operator = {"+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide}[_OPERATORS[type(node.op)]]  # type: ignore[index]
    return lambda s: operator(left(s), right(s))


def _direction(outward: bool, by_A: bool, s: Signals) -> Array:
    """Return the weights of a direction of motion with the side that carries the load, NaN without a known speed."""
    weights = s.direction_weights(outward, by_A)
    weights[s.unknown_motion] = np.nan
    return weights


@kernel
def _take_logarithms(values: Any, logarithms: Any) -> None:
    """Compute logarithms by the function that streams call: NumPy's may differ in the last bit."""
    for i in range(len(values)):
        logarithms[i] = math.log(values[i])


def _call(node: ast.expr) -> tuple[str, ast.expr]:
    """Return name and argument of a function in an expression."""
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) == 1):
        raise ValueError(f"a function of an expression must have one argument, got {ast.unparse(node)!r}")
    return node.func.id, node.args[0]


def build_increments(
    expressions: Sequence[str],
    channels: Mapping[str, int],
    limits: Mapping[str, float],
    to_absolute: Mapping[str, float],
) -> Callable[..., None]:
    """Write a function that evaluates expressions over one interval of the last samples, for `compiled.large_law`.

    The function's arguments are `ring` (channels, width), in whose columns sample k stands at k modulo the width; the
    interval k, from sample k to k + 1; `half`, the samples on either side of the central difference that shows the
    direction of motion; `rate` [Hz]; `displacement` [m^3/rad]; and `out`, which receives the increments. `channels`:
    rows of `ring` by name; `limits`: `MAX_READING`, beyond which a reading is missing, and `BEYOND`, a missing one;
    `to_absolute`: absolute minus gauge pressure [Pa] by channel, by default atmospheric pressure.
    """
    lines = [
        "def compute_increments(ring: Any, k: int, half: int, rate: float, displacement: float, out: Any) -> None:",
        '    """Compute the increments of all terms of the volume balance over the interval from sample k to k + 1."""',
        "    width = ring.shape[1]",
        "    earlier, later = max(k - 1, 0), k + 1",
    ]
    words = {node.id for text in expressions for node in ast.walk(parse_expression(text)) if isinstance(node, ast.Name)}
    if words & set(DIRECTIONS):
        x, p_A, p_B = (channels[name] for name in ("x", "p_A", "p_B"))
        lines += [f"    {word} = 0.0" for word in DIRECTIONS] + ["    is_known = True"]
        lines += [
            "    for i in range(k, k + 2):  # either end of the interval counts half",
            f"        x_before, x_after = ring[{x}, max(i - half, 0) % width], ring[{x}, (i + half) % width]",
            "        is_known = is_known and max(abs(x_before), abs(x_after)) < MAX_READING",
            "        is_outward = x_after >= x_before",
            f"        A_carries = ring[{p_A}, i % width] > ring[{p_B}, i % width]",
        ]
        for word, (outward, by_A) in DIRECTIONS.items():
            conditions = f"is_outward == {outward} and A_carries == {by_A}"
            lines += [f"        if {conditions}:", f"            {word} += 0.5"]
    for column, text in enumerate(expressions):
        lines.append(f"    out[{column}] = {_interval_text(parse_expression(text), 'k', channels, to_absolute)}")
    if words & set(DIRECTIONS):  # without a direction the interval counts as one with a missing reading
        lines += ["    if not is_known:", "        out[0] = BEYOND"]
    source = "\n".join([*lines, ""])
    file = f"<terms {next(_numbers)}>"
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    namespace: dict[str, Any] = {"Any": Any, "math": math, **limits}
    exec(compile(source, file, "exec"), namespace)
    return namespace["compute_increments"]  # type: ignore[no-any-return]


def _interval_text(node: ast.expr, interval: str, channels: Mapping[str, int], to_absolute: Mapping[str, float]) -> str:
    """Write an expression over an interval, from the sample of this name to the next."""
    if isinstance(node, ast.Constant):
        return repr(float(node.value))  # type: ignore[arg-type]
    if isinstance(node, ast.BinOp):
        sides = (_interval_text(side, interval, channels, to_absolute) for side in (node.left, node.right))
        return f"({next(sides)} {_OPERATORS[type(node.op)]} {next(sides)})"  # type: ignore[index]
    if isinstance(node, ast.Name):
        if node.id == "pressure_difference":
            difference = ast.parse("mean(p_A) - mean(p_B)", mode="eval").body
            return _interval_text(difference, interval, channels, to_absolute)
        return "(1.0 / rate)" if node.id == "dt" else node.id
    name, value = _call(node)
    if name == "gradient":
        after, before = (_interval_text(value, k, channels, to_absolute) for k in ("later", "earlier"))
        return f"(({after} - {before}) / (later - earlier))"
    points = (_point_text(value, sample, channels, to_absolute) for sample in (interval, f"({interval} + 1)"))
    first, second = points
    return f"({second} - {first})" if name == "change" else f"(0.5 * ({second} + {first}))"


def _point_text(node: ast.expr, sample: str, channels: Mapping[str, int], to_absolute: Mapping[str, float]) -> str:
    """Write an expression at the sample of this name."""
    if isinstance(node, ast.Constant):
        return repr(float(node.value))  # type: ignore[arg-type]
    if isinstance(node, ast.Name):
        return f"ring[{channels[node.id]}, {sample} % width]"
    if isinstance(node, ast.BinOp):
        sides = (_point_text(side, sample, channels, to_absolute) for side in (node.left, node.right))
        return f"({next(sides)} {_OPERATORS[type(node.op)]} {next(sides)})"  # type: ignore[index]
    name, value = _call(node)
    inner = _point_text(value, sample, channels, to_absolute)
    if name != "absolute":
        return f"math.log({inner})"
    assert isinstance(value, ast.Name)
    return f"max({inner} + {to_absolute.get(value.id, P_ATM)!r}, {MIN_ABSOLUTE_PRESSURE!r})"
