"""The terms of a machine's volume balance, computed from recorded channels, by expressions where streams need them too.

A balance states where the volume of oil goes that the pump delivers. It is linear in the unknown coefficients of the
machine. For a pump-controlled cylinder

    D dtheta = sum_j c_j f_j dg_j + G (p_A - p_B) dt,

with the pump's displacement D [m^3/rad] and angle theta, the leakage conductance G [m^3/(s Pa)] and a coefficient c_j
for each term; f_j and g_j are functions of the recorded channels. A term computes its increment f_j dg_j over each
sampling interval dt, so no signal is differentiated (`rows`). With a servo valve, each chamber has a balance. Its left
side is the volume displaced by the piston, and its terms include the orifice flows of the valve's metering edges. G is
the same in both chambers.

An expression computes the increment of a term, such as ``mean(x) * change(p_A)``; NumPy evaluates it for files
(`increments_of`), and a kernel for streams is written from it (`build_increments`). Its words are:

- a channel, such as ``p_A``, ``absolute(p_A)``, an absolute pressure, and ``log(...)`` are values at a sample;
- ``change(v)`` and ``mean(v)``: difference and mean of a value v at the two ends of the interval;
- ``dt``: the interval [s]; ``rate``: its inverse [Hz]; ``pressure_difference``: mean of p_A - p_B without the sensors'
  offset; ``out_A``, ``out_B``, ``in_A``, ``in_B``: 1 while the piston moves towards B (out) or A (in) and side A or B
  carries the load, else 0, and 1/2 if that changes within the interval; ``displacement``: that of the pump [m^3/rad];
- ``gradient(e)``: change of an increment e from one interval to the next, by a central difference;
- numbers, and ``+ - * /``.

Source: Merritt, Hydraulic Control Systems, 1967, sections 5.2 and 6.3 (continuity of the chambers, flow of edges).
"""

from __future__ import annotations

import ast
import linecache
import math
from collections.abc import Callable, Container, Mapping, Sequence
from enum import Enum
from functools import cache, cached_property, partial
from itertools import count
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.compiled import kernel
from sealscope.diagnosis.inference.machine_states import RestLimits, find_rests
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig


#: Minimum absolute pressure in the terms of air [Pa].
MIN_ABSOLUTE_PRESSURE: float = INFERENCE.pressure.least
#: Half the time of the central difference for speed and direction [s]: a few encoder counts at slow motion.
HALF_DIFFERENCE = 0.025


class Signals:
    """Samples (n,) of recorded channels by name, in SI units, and signals derived from them.

    - `rate`: sampling rate [Hz];
    - `to_absolute`: absolute minus gauge pressure [Pa] by channel, by default atmospheric pressure;
    - `offset`: sensor offset [Pa] that is subtracted from p_A - p_B;
    - `rest_limits`: speeds below which the machine rests, None to find no rests.
    """

    def __init__(
        self,
        channels: Mapping[str, Array],
        rate: float,
        to_absolute: Mapping[str, float] | None = None,
        offset: float = 0.0,
        rest_limits: RestLimits | None = None,
    ) -> None:
        self._channels, self.rate, self._to_absolute, self._offset = channels, rate, to_absolute or {}, offset
        self._rest_limits = rest_limits
        self._rests: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None = None  # of the pump, and of the piston
        self._steps, self._means = dict[str, Array](), dict[str, Array]()

    def __contains__(self, name: object) -> bool:
        return name in self._channels

    def __getitem__(self, name: str) -> Array:
        return self._channels[name]

    def step(self, name: str) -> Array:
        """Return the differences (n - 1,) of neighbouring samples of a channel, which are kept."""
        if name not in self._steps:
            values = self._channels[name]
            self._steps[name] = values[1:] - values[:-1]
        return self._steps[name]

    def mean(self, name: str) -> Array:
        """Return the means (n - 1,) of neighbouring samples of a channel, which are kept."""
        if name not in self._means:
            self._means[name] = interval_means(self._channels[name])
        return self._means[name]

    @property
    def dt(self) -> float:
        """Sampling interval [s]."""
        return 1.0 / self.rate

    @property
    def time_step(self) -> Array:
        """Sampling interval dt [s], repeated for each interval, shape (n - 1,)."""
        return np.full(len(next(iter(self._channels.values()))) - 1, self.dt)

    @cached_property
    def pressure_difference(self) -> Array:
        """p_A - p_B [Pa] in the middle of each sampling interval, without the sensor offset, shape (n - 1,)."""
        return self.compute_pressure_difference()

    def compute_pressure_difference(self) -> Array:
        """Compute `pressure_difference` anew, which the caller may change; it is not kept."""
        difference = self._difference("p_A", "p_B")
        difference -= self._offset
        return difference

    @property
    def pressure_root(self) -> Array:
        """sign(dp) sqrt(abs(dp)) [Pa^0.5] of the pressure difference dp = p_A - p_B, shape (n - 1,)."""
        return signed_root(self.pressure_difference)

    @cached_property
    def port_difference(self) -> Array:
        """p_1 - p_2 [Pa] of the two ports of pump or valve, in the middle of each sampling interval, shape (n - 1,)."""
        return self._difference("p_1", "p_2")

    def _difference(self, name: str, other: str) -> Array:
        """Compute the difference (n - 1,) of the means of two channels, neither of which is kept."""
        difference = interval_means(self._channels[name])
        difference -= interval_means(self._channels[other])
        return difference

    @cached_property
    def absolute_pressure(self) -> Mapping[str, Array]:
        """Absolute pressure [Pa] at each sample, at least `MIN_ABSOLUTE_PRESSURE`, by the names "p_A" and "p_B"."""
        return {
            name: np.maximum(self._channels[name] + self._to_absolute.get(name, P_ATM), MIN_ABSOLUTE_PRESSURE)
            for name in ("p_A", "p_B")
        }

    @cached_property
    def speed(self) -> Array:
        """Speed of the piston [m/s] at each sample, by a central difference of x; x stays constant beyond the ends."""
        half_width = max(1, round(HALF_DIFFERENCE * self.rate))  # [samples]
        return central_difference(self._channels["x"], half_width) * (0.5 * self.rate / half_width)

    @cached_property
    def carried_by_A(self) -> Array:
        """1 for each sample (n,) in which side A carries the load, i.e. p_A - p_B exceeds the sensor offset, else 0.

        It is 0 also where a pressure is missing.
        """
        return (self._channels["p_A"] > self._channels["p_B"] + self._offset).astype(float)

    @cached_property
    def unknown_motion(self) -> NDArray[np.intp]:
        """Indices of the intervals at either end of which the speed is missing."""
        return np.flatnonzero(np.isnan(interval_means(self.speed)))

    def direction_weights(self, outward: bool, by_A: bool) -> Array:
        """Return 1 for each interval (n - 1,) of motion in a given direction while a given side carries the load.

        `outward`: motion towards B, or standstill, as opposed to motion towards A; `by_A`: side A, as opposed to B, has
        the load (`carried_by_A`). Other intervals have the weight 0, and 1/2 if direction or side change within. A
        missing speed counts as towards A.
        """
        is_counted = ((self.speed >= 0.0) == outward) & (self.carried_by_A == by_A)
        return interval_means(is_counted.astype(float))

    def moving(self, pump_volume: Callable[[Signals], Array]) -> Array:
        """Return 1 for each sampling interval (n - 1,) in which pump and piston move, else 0.

        `pump_volume` computes the left side of the volume balance [m^3] in each interval; later calls use that of the
        first one. Without `rest_limits` all intervals count as motion.
        """
        rests = self._find_rests(pump_volume)
        return np.ones_like(self.time_step) if rests is None else (~rests[0] & ~rests[1]).astype(float)

    def holding(self, pump_volume: Callable[[Signals], Array]) -> Array:
        """Return 1 for each sampling interval (n - 1,) in which the pump turns and the piston rests, else 0.

        `pump_volume`: as in `moving`. Without `rest_limits` the piston never rests.
        """
        rests = self._find_rests(pump_volume)
        return np.zeros_like(self.time_step) if rests is None else (~rests[0] & rests[1]).astype(float)

    def _find_rests(
        self, pump_volume: Callable[[Signals], Array]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
        """Flag the rests of the pump and those of the piston, for later calls, too; None without `rest_limits`."""
        limits = self._rest_limits
        if self._rests is None and limits is not None:
            self._rests = (
                find_rests(pump_volume(self), self.rate, limits.pump, limits.shortest),
                find_rests(self.step("x"), self.rate, limits.piston, limits.shortest),
            )
        return self._rests


def central_difference(values: Array, half_width: int) -> Array:
    """Compute the difference (n,) of the values `half_width` samples after and before each of n samples.

    It is not divided by the time. Beyond the ends the first and last values are repeated.
    """
    padded = np.empty(len(values) + 2 * half_width)
    padded[:half_width], padded[half_width:-half_width], padded[-half_width:] = values[:1], values, values[-1:]
    return np.asarray(padded[2 * half_width :] - padded[: -2 * half_width])


def interval_means(values: Array) -> Array:
    """Compute the means of neighbouring samples (n,), shape (n - 1,)."""
    means = values[1:] + values[:-1]
    means *= 0.5
    return means


def signed_root(values: Array) -> Array:
    """Compute sign(v) sqrt(abs(v)) of each value v."""
    return np.asarray(np.sign(values) * np.sqrt(np.abs(values)))


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


#: Kinds of coefficients: each has a prior on its differences between recordings and, but for "speed", on its drift.
Coefficient = Literal["motion", "speed", "compliance", "air", "bias", "piston", "pump", "outside", "edge"]


class Term(NamedTuple):
    """A term of a volume balance: an unknown coefficient times a function of recorded channels.

    Parameters
    ----------
    name : str
        Name of the term, for example "compliance A".
    unit : str
        Unit of the coefficient, m^3 over that of the increments.
    increments : callable
        Computes the increments f dg from `Signals` over each sampling interval, shape (n - 1,).
    cause : str
        Cause of a sudden change of the coefficient, for example "external leak".
    drift : str
        Kind of the coefficient, with its priors in `priors.toml`; "" if it is zero unless `cause` is present.
    needs : tuple of str
        Channels from which the increments are computed.
    driver : {"", "pressure", "root"}
        Pressure or square root of a pressure that drives the flow, so that an offset of a pressure sensor changes the
        increments; "" if such an offset is neglected.
    expression : str
        The increments as an expression, which streams compute, too; "" if only files compute them.
    """

    name: str
    unit: str
    increments: Callable[[Signals], Array]
    cause: Cause
    drift: Coefficient | Literal[""] = ""
    needs: tuple[str, ...] = ()
    driver: Literal["", "pressure", "root"] = ""
    expression: str = ""

    def with_increments(self, increments: Callable[[Signals], Array]) -> Term:
        """Return the term with other increments, which only files compute."""
        return self._replace(increments=increments, expression="")

    def scaled_by(self, expression: str) -> Term:
        """Return the term with increments times an `expression`, which streams compute, too, if they do the term's."""
        factor = increments_of(expression)
        scaled = self.with_increments(lambda s: np.asarray(factor(s) * self.increments(s)))
        return scaled._replace(expression=f"({expression}) * ({self.expression})" if self.expression else "")

    @property
    def is_fitted(self) -> bool:
        """True if the coefficient is fitted in every recording, since it is unknown even in a healthy machine."""
        return bool(self.drift) and not self.is_compared

    @property
    def is_compared(self) -> bool:
        """True if the coefficient is fitted only to compare recordings: within one, the motion varies too little."""
        return self.drift == "speed"


class Flow(Enum):
    """Source of the flow in a volume balance.

    `PUMP`: the pump's angle or speed; `METER`: a flow meter between pump and cylinder; `SUPPLY`: one in the supply line
    of a valve; `COMMAND`: the command u, from which a speed is computed (`balances.derive_drive_signals`);
    `VALVE`: the opening of a servo valve, with one balance for each chamber; `CREEP`: nothing but the creep of a load
    that valves hold.
    """

    PUMP = "pump"
    METER = "meter"
    SUPPLY = "supply"
    COMMAND = "command"
    VALVE = "valve"
    CREEP = "creep"

    @property
    def is_measured(self) -> bool:
        """True if a flow meter measures it, which sees no leakage inside the pump."""
        return self in (Flow.METER, Flow.SUPPLY)


class Equation(NamedTuple):
    """A volume balance of a machine: its left side equals the sum of its terms.

    Parameters
    ----------
    name : str
        Name of the balance, for example "cylinder".
    left : callable
        Computes the increments of the left side [m^3] from `Signals`, shape (n - 1,).
    terms : tuple of Term
        The terms; those of the leak are the last two.
    healthy : float
        Standard deviation of a healthy machine's leakage conductance [m^3/(s Pa)]; infinite if unknown.
    flow : Flow
        Source of the flow on the left side.
    flow_sign : float
        1 if a flow into A is positive on the left side, -1 if it is negative.
    area_ratio : float
        Area of the piston on side B over that on side A; 1 in a balance of one chamber.
    fed_outward : {"", "A", "B"}
        Chamber that the pump feeds while x grows, if it feeds one at a time (`feed`); "" in a closed circuit.
    left_expression : str
        The left side as an expression, "" if only files compute it.
    """

    name: str
    left: Callable[[Signals], Array]
    terms: tuple[Term, ...]
    healthy: float = float("inf")
    flow: Flow = Flow.PUMP
    flow_sign: float = 1.0
    area_ratio: float = 1.0
    fed_outward: Literal["", "A", "B"] = ""
    left_expression: str = ""


#: Names of terms: first the leak past the piston or in the pump, laminar (the tested term) and through an orifice.
LEAK, ORIFICE = "leak through a gap", "leak through an orifice"
#: Free air in both chambers together, instead of one term for each chamber.
AIR = "free air"
#: The pump's leakage, driven by the pressures at its ports.
PUMP = "pump leak"
#: The same driven by the pressure drop of the lines between the pump's ports and the chambers.
LINES = "pump leak by the lines"
#: The pump's leakage driven by p_A - p_B, if a valve cuts the pump off at rest: while the pump moves the piston, and
#: while it turns only to hold the load.
TURNING, HOLDING = "pump leak while it turns", "pump leak while it holds"
#: Constant flow, for example by an offset of a flow sensor; an offset of the pressure sensors changes it, too.
BIAS = "bias"
#: Suffix for an external leak that a check valve compensates.
MADE_UP = ", made up"
#: A delay between position and flow.
LAG = "lag"
#: Loss of the pump that grows with speed: incomplete filling, and slip that depends on no recorded pressure.
SPEED_LOSS = "loss over speed"
#: The constant flow while pump and piston move.
MOVING_BIAS = "bias in motion"
#: The terms that `balances.with_rests` adds, each zero in some states of the machine.
STATES = TURNING, HOLDING, MOVING_BIAS
#: Flow from the supply past a valve while the piston rests: a constant part, and one in proportion to p_A - p_B.
NULL_FLOW, LOADED_NULL_FLOW = "flow past the valve at rest", "flow past the valve at rest, under load"
#: Name of the balance of a cylinder, by its position and the flow of a pump or meter.
CYLINDER = "cylinder"
#: Name of a derived signal: the decay, with the drive's time constant, of the speed loop's unknown initial state.
START = "start"

PRESSURES = ("p_A", "p_B")
#: Makes a term whose coefficient changes suddenly only by a sensor fault.
fitted_term = partial(Term, cause="sensor fault")
#: Makes a term of oil that the pressure compresses; air in the oil changes its coefficient suddenly.
compliance_term = partial(Term, cause="air in the oil", drift="compliance")


def expressed_term(name: str, unit: str, expression: str, cause: Cause, **properties: Any) -> Term:
    """Make a term from the expression of its increments; `properties`: those of `Term`."""
    return Term(name, unit, increments_of(expression), cause, expression=expression, **properties)


def conductance_term(
    name: str,
    increments: Callable[[Signals], Array],
    cause: Cause,
    needs: tuple[str, ...] = PRESSURES,
    drift: Coefficient | Literal[""] = "",
) -> Term:
    """Make the term of a conductance; `increments` computes the driving pressure times dt [Pa s]."""
    return Term(name, "m^3/(s Pa)", increments, cause, drift=drift, needs=needs, driver="pressure")


_LEAK_CAUSE: Cause = "piston or pump leak"
LEAKS = (
    expressed_term(
        LEAK,
        "m^3/(s Pa)",
        "pressure_difference * dt",
        _LEAK_CAUSE,
        drift="piston",
        needs=PRESSURES,
        driver="pressure",
    ),
    Term(ORIFICE, "m^3/(s Pa^0.5)", lambda s: s.pressure_root * s.dt, _LEAK_CAUSE, needs=PRESSURES, driver="root"),
)


#: Word of the expression that is 1 in a direction of motion while a side carries the load, by the name of the term.
_MOTION_WORDS = {
    "motion out, A carries": "out_A",
    "motion out, B carries": "out_B",
    "motion in, A carries": "in_A",
    "motion in, B carries": "in_B",
}
#: Direction of the piston's motion (true: to B) and loaded side (true: A) of the terms of motion, by their names.
MOTIONS = {name: DIRECTIONS[word] for name, word in _MOTION_WORDS.items()}


def motion_term(name: str) -> Term:
    """Make the term of the piston's motion in one direction while one side carries the load (`MOTIONS`)."""
    expression = f"{_MOTION_WORDS[name]} * change(x)"
    return expressed_term(name, "m^2", expression, "sensor fault", drift="motion", needs=("x",))


def chamber_terms(side: str) -> tuple[Term, ...]:
    """Make the four terms of one chamber, `side` "A" or "B": two of its compliance, and two of the air in its oil.

    With the chamber's absolute pressure p, the position x, and changes d over a sampling interval, the increments are
    dp for a constant compliance, x dp for its change over the stroke, d(1/p) for free air, d ln p for dissolving air.
    """
    p, name = f"p_{side}", f"compliance {side}"
    term = partial(expressed_term, cause="air in the oil")
    return (
        term(name, "m^3/Pa", f"change({p})", drift="compliance", needs=(p,)),
        term(f"{name} over the stroke", "m^2/Pa", f"mean(x) * change({p})", drift="compliance", needs=(p, "x")),
        term(f"free air {side}", "m^3 Pa", f"change(1 / absolute({p}))", drift="air", needs=(p,)),
        term(f"dissolving air {side}", "m^3", f"change(log(absolute({p})))", drift="air", needs=(p,)),
    )


def free_air_term(rig: Rig, weight_A: Callable[[Signals], Array | float]) -> Term:
    """Make the term of free air in both chambers: w V_A d(1/p_A) - (1 - w) V_B d(1/p_B).

    p_A and p_B are absolute. V_A and V_B are the volumes of the chambers at the position x, which counts from
    mid-stroke, or at mid-stroke if the rig's file states fixed volumes. `weight_A` computes w, the weight (0 to 1) of
    chamber A in the balance. The coefficient [Pa] is minus the fraction of free air at atmospheric pressure, times that
    pressure.
    """
    from sealscope.physics.cylinder import mid_stroke_volumes

    cylinder = rig.cylinder
    mid_volumes = dict(zip("AB", mid_stroke_volumes(cylinder), strict=True))
    # change of each volume with the position
    areas = {"A": cylinder.A_A, "B": -cylinder.A_B} if cylinder.volumes == "position" else {"A": 0.0, "B": 0.0}

    def expansion(s: Signals, side: str) -> Array:
        """Compute V d(1/p) [m^3/Pa] of the chamber `side` in each interval, with the volume V at the mean position."""
        # at least a tenth of the volume at mid-stroke: x of an unknown origin may exceed the stroke
        volumes = np.maximum(mid_volumes[side] + areas[side] * s.mean("x"), 0.1 * mid_volumes[side])
        return np.asarray(volumes * np.diff(1.0 / s.absolute_pressure[f"p_{side}"]))

    def weighted_expansion(s: Signals) -> Array:
        """Compute the increments of the term [m^3/Pa], shape (n - 1,)."""
        weight = weight_A(s)
        return np.asarray(weight * expansion(s, "A") - (1.0 - weight) * expansion(s, "B"))

    return Term(AIR, "Pa", weighted_expansion, "air in the oil", needs=("x", *PRESSURES))


def external_leak_term(side: str, weight: float = 1.0) -> Term:
    """Make the term of an external leak from `side` "A" or "B" at its gauge pressure p: `weight` max(p, 0) dt [Pa s].

    No oil flows in at a negative pressure. `weight`: 1 for a leak from A, -1 for a leak from B, and 0 in a balance of
    the other chamber alone.
    """
    p = f"p_{side}"
    return conductance_term(
        f"external leak {side}", lambda s: weight * np.maximum(s.mean(p), 0.0) * s.dt, "external leak", needs=(p,)
    )


def compensated_leak_term(side: str) -> Term:
    """Make the term of an external leak from one side in a circuit whose check valve refills the low-pressure side.

    The leak counts only while its side has the higher pressure: max(p, 0) dt [Pa s] for A, -max(p, 0) dt for B.
    """

    def lost_volume(s: Signals) -> Array:
        """Compute the increments of the term [Pa s], shape (n - 1,)."""
        weight = interval_means(s.carried_by_A) - float(side == "B")  # 1 or 0 for side A, 0 or -1 for side B
        return np.asarray(weight * np.maximum(s.mean(f"p_{side}"), 0.0) * s.dt)

    return conductance_term(f"external leak {side}{MADE_UP}", lost_volume, cause="external leak")


START_TERM = fitted_term("start of the drive", "m^3/s", lambda s: s.mean(START) * s.dt, drift="bias", needs=(START,))
BIAS_TERM = expressed_term(BIAS, "m^3/s", "dt", "sensor fault", drift="bias")
SPEED_LOSS_TERM = fitted_term(
    SPEED_LOSS, "m s", lambda s: interval_means(np.abs(s.speed)) * s.step("x"), drift="speed", needs=("x",)
)
PUMP_TERM = conductance_term(PUMP, lambda s: s.port_difference * s.dt, "pump leak", needs=("p_1", "p_2"))
#: The pressure drop of the lines acts on the pump's leakage only. With this term the leak's coefficient remains the
#: conductance of pump and piston together.
LINES_TERM = conductance_term(
    LINES,
    lambda s: (s.port_difference - s.pressure_difference) * s.dt,
    "pump leak",
    needs=("p_1", "p_2", *PRESSURES),
    drift="pump",
)
#: The increments are changes of the piston's speed; the coefficient is the piston's area times the delay.
LAG_TERM = expressed_term(LAG, "m^2 s", "gradient(change(x) * rate)", "sensor fault", drift="motion", needs=("x",))


def delay_name(channel: str) -> str:
    """Return the name of the term of a channel's delay, but for `LAG`, the delay of a position after the flow."""
    return f"delay of {channel}"


def delay_term(channel: str, volume: Callable[[Signals], Array], unit: str, needs: tuple[str, ...]) -> Term:
    """Make the term of a channel's delay: the change of `volume`, its increments, between sampling intervals."""
    return fitted_term(delay_name(channel), unit, lambda s: np.gradient(volume(s) * s.rate), needs=needs)


def metering_edge_terms(
    edge: str, upstream: str, downstream: str, sign: float, channels: Container[str], return_pressure: float
) -> tuple[Term, ...]:
    """Make the three terms of the flow over one metering edge of a servo valve: gain, delay and overlap.

    `edge`: its name, for example "P to A"; `upstream`, `downstream`: channels of the pressures; `sign`: sign of the
    command u that opens the edge, 1 or -1; `channels`: names of the recorded channels; `return_pressure`: pressure [Pa]
    in place of p_2 if that is not recorded. With dp = upstream pressure - downstream pressure, the flow is

        flow = (gain abs(u) - overlap) sign(dp) sqrt(abs(dp)),    overlap = gain times dead band of u,

    delayed by the lag of the spool. Up to their signs, the unknown coefficients are gain, gain times lag, and overlap.
    """
    recorded = tuple(name for name in (upstream, downstream) if name in channels)

    def pressure(s: Signals, name: str) -> Array | float:
        """Return the pressure [Pa] on one side of the edge in each interval, or `return_pressure` if not recorded."""
        return s.mean(name) if name in recorded else return_pressure

    def pressure_root(s: Signals) -> Array:
        """Compute sign(dp) sqrt(abs(dp)) [Pa^0.5] of the pressure drop dp over the edge, shape (n - 1,)."""
        return signed_root(np.asarray(pressure(s, upstream) - pressure(s, downstream)))

    def proportional_increments(s: Signals) -> Array:
        """Compute the increments abs(u) sign(dp) sqrt(abs(dp)) dt [V Pa^0.5 s], 0 unless u opens the edge."""
        return np.asarray(np.maximum(sign * s.mean("u"), 0.0) * pressure_root(s) * s.dt)

    def late_increments(s: Signals) -> Array:
        """Compute the changes of abs(u) sign(dp) sqrt(abs(dp)) in each interval [V Pa^0.5], for gain times lag."""
        return np.asarray(np.gradient(proportional_increments(s)) * s.rate)

    edge_term = partial(fitted_term, drift="edge", needs=("u", *recorded))
    return (
        edge_term(f"edge {edge}", "m^3/(s V Pa^0.5)", proportional_increments),
        edge_term(f"late edge {edge}", "m^3/(V Pa^0.5)", late_increments),
        edge_term(f"overlap {edge}", "m^3/(s Pa^0.5)", lambda s: (sign * s.mean("u") > 0.0) * pressure_root(s) * s.dt),
    )
