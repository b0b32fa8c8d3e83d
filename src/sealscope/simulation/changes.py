"""Changes within a run: numbers of the machine over time, constant within short blocks, and instrument readings.

An `Effect` is a changing number of the compiled laws, or a changing parameter of an instrument; a `Hold` is a reading
that repeats itself. Drifts (here) and faults (`faults`) list theirs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array

if TYPE_CHECKING:
    from sealscope.physics.rig import RigNumbers

T = TypeVar("T", float, Array)
#: Longest time [s] over which a changing number is held, and the shortest (unless something jumps within it).
LONGEST_BLOCK, SHORTEST_BLOCK = 0.5, 0.05
#: Most that a drifting parameter changes from one block of the solver to the next, relative.
RESOLUTION = 5e-4
#: Parameters that drift together under one name.
GROUPS = {"friction": ("friction.F_pr", "friction.F_cfr", "friction.F_v")}
THROTTLES = ("c_A_in", "c_A_out", "c_B_in", "c_B_out")
#: Parameters that the compiled laws know within numbers that follow from them, which go with these powers of them.
_POWERS = {
    "line.C_d": tuple((field, 1.0) for field in THROTTLES),
    "line.d_line": tuple((field, 2.0) for field in THROTTLES),
    "fluid.rho": (*((field, -0.5) for field in THROTTLES), ("c_slip", -0.5), ("k_h", 1.0)),
    "pump.q_b": (("q_b", 1.0), ("c_slip", 2.0 / 3.0), ("k_h", 5.0 / 3.0)),
    "pump.C_st": (("c_slip", 1.0),),
    "pump.C_h": (("k_h", 1.0),),
}
#: What is not a state of the machine that could drift: geometry, choices, the start.
_FIXED = {"cylinder.L", "cylinder.V", "fluid.p_charge", "makeup.V_gas"}
_OF_INSTRUMENTS = {"noise", "hum", "offset", "gain_error", "scale_error", "common_noise"}


@dataclass(frozen=True)
class Effect:
    """One number of the rig that changes: value = (own value + sum of `added`) x product of the others.

    `field`: a number of the compiled laws, or the dotted name of an instrument's parameter. `change(t)` at times t [s]:
    what is added, or the factor; `resolution`: most that it may change from one block to the next; `jumps`: times [s]
    at which it may jump or bend; `shortest`: length [s] below which no block is cut.
    """

    field: str
    change: Callable[[Array], Array]
    resolution: float
    added: bool = False
    jumps: tuple[float, ...] = ()
    shortest: float = SHORTEST_BLOCK

    @property
    def of_instrument(self) -> bool:
        """True for a change of an instrument, False for one of the machine."""
        return self.field.startswith("sensors.")


def apply_effects(rig_value: T, effects: Sequence[Effect], field: str, t: Array) -> T | Array:
    """Compute a number at times t [s]: (rig's value + sum of additions) x product of factors."""
    value: T | Array = rig_value
    for effect in sorted(effects, key=lambda effect: not effect.added):  # sums before products
        if effect.field == field:
            value = value + effect.change(t) if effect.added else value * effect.change(t)
    return value


def values_of(effects: Sequence[Effect], base: RigNumbers, t: Array) -> dict[str, Array]:
    """Compute the numbers of `base` that change, by name, at times t [s]."""
    names = dict.fromkeys(effect.field for effect in effects)
    return {name: apply_effects(np.full(t.size, float(getattr(base, name))), effects, name, t) for name in names}


def blocks_of(effects: Sequence[Effect], n_out: int, rate: float) -> np.ndarray:
    """Compute the bounds (n + 1,) in outputs at `rate` [Hz] of the blocks over which changing numbers are held.

    A block is at most `LONGEST_BLOCK` long, and so short (down to the effect's shortest) that no effect moves by more
    than its resolution; a jump falls on a block's boundary, within one output interval.
    """
    if not effects:
        return np.array([0, n_out], dtype=np.int64)
    jumps = np.array([jump for effect in effects for jump in effect.jumps if math.isfinite(jump)], dtype=np.float64)
    grid = np.arange(0, n_out, max(1, round(LONGEST_BLOCK * rate)))
    bounds = np.unique(np.clip(np.r_[grid, n_out, np.ceil(jumps * rate * (1.0 - 1e-12))], 0, n_out))
    starts, stops = bounds[:-1], bounds[1:]
    inside = 1e-6 / rate  # so that a jump at a bound is no slope
    parts = np.ones(starts.size)
    for effect in effects:
        jumps_of_effect = np.abs(effect.change(stops / rate - inside) - effect.change(starts / rate + inside))
        most = np.maximum(1, (stops - starts) // max(1, round(effect.shortest * rate)))
        parts = np.maximum(parts, np.minimum(np.ceil(jumps_of_effect / effect.resolution - 1e-9), most))
    cuts = [np.linspace(a, b, int(n), endpoint=False) for a, b, n in zip(starts, stops, parts, strict=True)]
    return np.unique(np.rint(np.concatenate([*cuts, [n_out]])).astype(np.int64))


def extremes(effects: Sequence[Effect], base: RigNumbers) -> tuple[RigNumbers, ...]:
    """Collect `base`, and the numbers just before and after each bend of effects without a shortest block."""
    quick = [effect for effect in effects if effect.shortest < SHORTEST_BLOCK]
    bends = np.array(sorted({jump for effect in quick for jump in effect.jumps if math.isfinite(jump)}))
    values = values_of(quick, base, np.concatenate([bends - 1e-9, bends + 1e-9])) if bends.size else {}
    rows = np.unique(np.array(list(values.values())).T, axis=0) if values else ()
    return base, *(base._replace(**dict(zip(values, row.tolist(), strict=True))) for row in rows)


class Schedule:
    """The rig's numbers over a run, constant within blocks: `bounds` (n + 1,) output indices, one number set a block.

    The blocks are those of `blocks_of`; within one a number has its value at the middle. Neighbours with the same
    numbers are one block.
    """

    def __init__(self, effects: Sequence[Effect], base: RigNumbers, n_out: int, rate: float) -> None:
        self.bounds = blocks_of(effects, n_out, rate)
        self.numbers = [base]
        if not effects:
            return
        middles: Array = np.asarray(0.5 * (self.bounds[:-1] + self.bounds[1:]) / rate, dtype=np.float64)
        values = values_of(effects, base, middles)
        table = np.array(list(values.values()))
        new = np.r_[True, np.any(table[:, 1:] != table[:, :-1], axis=0)]
        self.bounds = np.r_[self.bounds[:-1][new], n_out]
        # a run has one kind of numbers throughout: what the compiler leaves out is left out from its beginning
        kinds: dict[str, Any] = {}
        if any(name.startswith("G_ext") and np.any(series > 0) for name, series in values.items()):
            kinds["open_circuit"] = (True,)
        if "air" in values and np.any(values["air"] > 0):
            kinds["aerated"] = (True,)
        numbers = base._replace(**kinds)
        rows = table[:, new].T.tolist()
        self.numbers = [numbers._replace(**dict(zip(values, row, strict=True))) for row in rows]

    def blocks_between(self, first: int, last: int) -> Iterator[tuple[int, int, RigNumbers]]:
        """Yield the parts (start, stop, numbers) of the outputs first <= k < last."""
        k = int(np.searchsorted(self.bounds, first, side="right")) - 1
        while first < last:
            stop = min(int(self.bounds[k + 1]), last)
            yield first, stop, self.numbers[k]
            first, k = stop, k + 1


@dataclass(frozen=True)
class Hold:
    """A channel that repeats its reading of `start` until `stop` [s]."""

    channel: str
    start: float
    stop: float


@dataclass(frozen=True)
class Readings:
    """All changes at the instruments of a run; none by default."""

    effects: tuple[Effect, ...] = ()
    holds: tuple[Hold, ...] = ()

    def value(self, parameter: str, rig_value: float, t: Array) -> Array | float:
        """Compute a parameter of an instrument at times t [s]; `rig_value` where nothing changes it."""
        return apply_effects(rig_value, self.effects, parameter, t)

    def hold_readings(self, channel: str, values: Array, t: Array) -> Array:
        """Apply the holds of a channel to its readings (n,)."""
        for hold in self.holds:
            still = np.flatnonzero((t >= hold.start) & (t < hold.stop))
            if hold.channel == channel and still.size:
                values = values.copy()
                values[still] = values[still[0]]
        return values


class Shape(Protocol):
    """The course of a drift: a parameter's change since the start, as a share of its value or in its unit."""

    def value_at(self, t: Array) -> Array:
        """Compute the change at times t [s] (any shape); 0 at t = 0."""
        ...

    def bends(self) -> tuple[float, ...]:
        """List the times [s] of its jumps and bends."""
        ...


@dataclass(frozen=True)
class Wander:
    """A smooth random walk over `duration` T [s]: slope t / T + sum of w_k sin((k - 1/2) pi t / T), k = 1, 2, ...

    With w_k normal of deviation 1/(k - 1/2) this is the Karhunen-Loeve expansion of the Wiener process, cut off where
    it becomes quick (Loeve, Probability Theory, 1955, section 34.5; six terms: nothing quicker than T/2.75).
    """

    weights: tuple[float, ...]
    duration: float
    slope: float = 0.0

    def __post_init__(self) -> None:
        if not (all(map(math.isfinite, (*self.weights, self.slope))) and self.duration > 0):
            raise InputError(f"a wander must have finite weights and last > 0 s, got {self}")

    def value_at(self, t: Array) -> Array:
        """Compute the change at times t [s]."""
        phase = np.pi / self.duration * np.maximum(t, 0.0)
        change = np.asarray(self.slope / np.pi * phase)
        if self.weights:  # sin(a + phi) = 2 cos(phi) sin(a) - sin(a - phi)
            term, turn = np.sin(0.5 * phase), 2.0 * np.cos(phase)
            before = -term
            for weight in self.weights:
                change = change + weight * term
                before, term = term, turn * term - before
        return change

    def bends(self) -> tuple[float, ...]:
        """Return an empty tuple: the path is smooth."""
        return ()

    def scaled(self, size: float) -> Wander:
        """Scale the path to the distance `size` between its highest and lowest point within the duration."""
        path = self.value_at(np.linspace(0.0, self.duration, 1001))
        span = float(np.ptp(path))
        return self.times(size / span) if span > 0 else self

    def times(self, factor: float) -> Wander:
        """Multiply the path by `factor`."""
        return Wander(tuple(weight * factor for weight in self.weights), self.duration, self.slope * factor)

    def plus(self, other: Wander) -> Wander:
        """Add another path of the same duration."""
        pairs = zip_longest(self.weights, other.weights, fillvalue=0.0)
        return Wander(tuple(a + b for a, b in pairs), self.duration, self.slope + other.slope)


def linear(size: float, duration: float) -> Wander:
    """Make a linear change of `size` over `duration` [s], with the same slope afterwards."""
    return Wander((), duration, size)


#: Most that a number that drifts in its own unit changes from one block of the solver to the next.
_STEPS = {"F_l": 0.2}


def drifts_absolutely(parameter: str) -> bool:
    """Return True for a parameter that drifts in its own unit: an error or a load, which may be zero."""
    return parameter.rpartition(".")[2] in ("offset", "gain_error", "scale_error", *_STEPS)


@dataclass(frozen=True)
class ParameterDrift:
    """A parameter that drifts: value(t) = value (1 + shape(t)), or value + shape(t) in its SI unit if `absolute`.

    `parameter`: bare or dotted name of a number of motor, pump, lines, cylinder, friction, oil or make-up, of a
    sensor's noise, hum, offset, gain or scale, or `friction` for the whole level of friction. Offsets, gain and scale
    errors and the load `F_l` drift in absolute terms, all others in relative ones. Raises InputError for any other
    parameter.
    """

    parameter: str
    shape: Shape
    absolute: bool = False

    def __post_init__(self) -> None:
        if self.parameter not in GROUPS:
            from sealscope.parameters import declared_names
            from sealscope.parameters.names import resolve

            object.__setattr__(self, "parameter", resolve(self.parameter, declared_names()))
        if not (self._of_instruments() or fields_of(self.parameter)):
            raise InputError(f"{self.parameter} cannot drift within a run")
        if self.absolute != drifts_absolutely(self.parameter):
            kind = "relative" if self.absolute else "absolute"
            raise InputError(f"a drift of {self.parameter} must be {kind}")

    def __str__(self) -> str:
        return f"{self.parameter} drifts"

    def _of_instruments(self) -> bool:
        return self.parameter.startswith("sensors.") and self.parameter.rpartition(".")[2] in _OF_INSTRUMENTS

    def check(self, t: Array) -> None:
        """Raise InputError where a relative drift takes its parameter to zero or below at the times t [s]."""
        if not self.absolute and (least := float(np.min(self.shape.value_at(t), initial=0.0))) <= -1.0:
            raise InputError(f"a relative drift must stay above -100 %, got {100 * least:.4g} % ({self.parameter})")

    def effects(self) -> tuple[Effect, ...]:
        """Build the effects of the drift on the machine or its instruments."""
        jumps = self.shape.bends()

        def effect(field: str, power: float) -> Effect:
            if self.absolute:
                return Effect(field, self.shape.value_at, _STEPS.get(field, math.inf), added=True, jumps=jumps)
            return Effect(field, lambda t: (1.0 + self.shape.value_at(t)) ** power, RESOLUTION, jumps=jumps)

        fields = ((self.parameter, 1.0),) if self._of_instruments() else fields_of(self.parameter)
        return tuple(effect(field, power) for field, power in fields)


@cache
def fields_of(parameter: str) -> tuple[tuple[str, float], ...]:
    """Find the numbers of the compiled laws that follow a parameter, each with its power; () where there is none."""
    from sealscope.physics.rig import NUMBERS

    if parameter in GROUPS:
        return tuple(field for name in GROUPS[parameter] for field in fields_of(name))
    if parameter in _POWERS:
        return _POWERS[parameter]
    group, _, symbol = parameter.rpartition(".")
    if group.startswith(("sensors", "daq")) or parameter in _FIXED:
        return ()
    return ((symbol, 1.0),) if symbol in NUMBERS else ()
