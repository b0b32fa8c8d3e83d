"""Drifts: parameters of the rig and of its instruments that change slowly within a run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from typing import Protocol, get_type_hints

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.changes.readings import Adjustment
from sealscope.simulation.changes.rig import Effect

#: Most that a drifting parameter changes from one block of the solver to the next, relative.
RESOLUTION = 5e-4
#: Parameters that drift together under one name.
GROUPS = {"friction": ("friction.F_pr", "friction.F_cfr", "friction.F_v")}
_THROTTLES = ("c_A_in", "c_A_out", "c_B_in", "c_B_out")
#: Parameters that the compiled laws know only within the throttles' coefficients, which go with this power of them.
_POWERS = {"line.C_d": 1.0, "line.d_line": 2.0, "fluid.rho": -0.5}
#: What is not a state of the machine that could drift: geometry, choices, the start.
_FIXED = {"cylinder.L", "fluid.p_charge", "makeup.V_gas"}
_OF_INSTRUMENTS = {"noise", "hum", "offset", "gain_error", "scale_error", "common_noise"}


class Shape(Protocol):
    """How a parameter drifts: its change since the start, as a share of its value (or in its unit)."""

    def at(self, t: Array) -> Array:
        """The change at times t [s] (any shape); 0 at t = 0."""
        ...


@dataclass(frozen=True)
class Linear:
    """An even change of `size` over `duration` [s], going on as long as the run does."""

    size: float
    duration: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.size) and self.duration > 0):
            raise InputError(f"a linear drift must be finite and last > 0 s, got {self.size} over {self.duration} s")

    def at(self, t: Array) -> Array:
        return self.size / self.duration * np.maximum(t, 0.0)


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

    def at(self, t: Array) -> Array:
        phase = np.pi / self.duration * np.maximum(t, 0.0)
        found = np.asarray(self.slope / np.pi * phase)
        if self.weights:  # sin(a + phi) = 2 cos(phi) sin(a) - sin(a - phi)
            term, turn = np.sin(0.5 * phase), 2.0 * np.cos(phase)
            before = -term
            for weight in self.weights:
                found = found + weight * term
                before, term = term, turn * term - before
        return found

    def scaled(self, size: float) -> Wander:
        """The same path with the distance `size` between its highest and lowest point within the duration."""
        path = self.at(np.linspace(0.0, self.duration, 1001))
        span = float(np.ptp(path))
        return self.times(size / span) if span > 0 else self

    def times(self, factor: float) -> Wander:
        """The same path, `factor` times as large."""
        return Wander(tuple(weight * factor for weight in self.weights), self.duration, self.slope * factor)

    def plus(self, other: Wander) -> Wander:
        """The sum of two paths of one duration."""
        pairs = zip_longest(self.weights, other.weights, fillvalue=0.0)
        return Wander(tuple(a + b for a, b in pairs), self.duration, self.slope + other.slope)


@dataclass(frozen=True, eq=False)
class Table:
    """A change linear between the points of a table; constant before the first and after the last."""

    t: Array
    change: Array

    def __post_init__(self) -> None:
        if self.t.size != self.change.size or self.t.size < 1 or np.any(np.diff(self.t) < 0):
            raise InputError("a drift table must have one change for each time, and its times must rise")
        if not (np.all(np.isfinite(self.t)) and np.all(np.isfinite(self.change))):
            raise InputError("times and changes of a drift table must be finite, got NaN or infinity")

    def at(self, t: Array) -> Array:
        return np.interp(t, self.t, self.change)


def drifts_absolutely(parameter: str) -> bool:
    """Whether a parameter drifts in its own unit: an error, which is zero on a perfect instrument."""
    return parameter.rpartition(".")[2] in ("offset", "gain_error", "scale_error")


@dataclass(frozen=True)
class Drift:
    """A parameter that drifts: value(t) = value (1 + shape(t)), or value + shape(t) in its SI unit if `absolute`.

    `parameter`: bare or dotted name of a number of motor, pump, lines, cylinder, friction, oil or make-up, of a
    sensor's noise, hum, offset, gain or scale, or `friction` for the whole level of friction. Offsets, gain and scale
    errors drift in absolute terms, all others in relative ones. Raises InputError for any other parameter.
    """

    parameter: str
    shape: Shape
    absolute: bool = False

    def __post_init__(self) -> None:
        if self.parameter not in GROUPS:
            from sealscope.parameters import declared_names
            from sealscope.parameters.names import resolve

            object.__setattr__(self, "parameter", resolve(self.parameter, declared_names()))
        if not (self.of_instruments() or fields_of(self.parameter)):
            raise InputError(f"{self.parameter} cannot drift within a run")
        if self.absolute != drifts_absolutely(self.parameter):
            wanted = "relative" if self.absolute else "absolute"
            raise InputError(f"a drift of {self.parameter} must be {wanted}")

    def __str__(self) -> str:
        return f"{self.parameter} drifts, {type(self.shape).__name__.lower()}"

    def of_instruments(self) -> bool:
        """Whether it is an instrument that drifts, and not the machine."""
        return self.parameter.startswith("sensors.") and self.parameter.rpartition(".")[2] in _OF_INSTRUMENTS

    def check(self, t: Array) -> None:
        """Raise InputError where a relative drift takes its parameter to zero or below at the times t [s]."""
        if not self.absolute and (least := float(np.min(self.shape.at(t), initial=0.0))) <= -1.0:
            raise InputError(f"a relative drift must stay above -100 %, got {100 * least:.4g} % ({self.parameter})")

    def effects(self) -> tuple[Effect, ...]:
        """What it changes in the machine."""
        jumps = tuple(map(float, self.shape.t)) if isinstance(self.shape, Table) and self.shape.t.size < 1000 else ()

        def effect(field: str, power: float) -> Effect:
            return Effect(field, lambda t: (1.0 + self.shape.at(t)) ** power, RESOLUTION, jumps=jumps)

        return () if self.of_instruments() else tuple(effect(*one) for one in fields_of(self.parameter))

    def adjustments(self) -> tuple[Adjustment, ...]:
        """What it changes at the instruments."""
        return (Adjustment(self.parameter, self.shape.at, self.absolute),) if self.of_instruments() else ()


@cache
def fields_of(parameter: str) -> tuple[tuple[str, float], ...]:
    """Numbers of the compiled laws that go with a parameter, each with its power; () where there is none."""
    from sealscope.physics.rig import RigNumbers

    if parameter in GROUPS:
        return tuple(one for name in GROUPS[parameter] for one in fields_of(name))
    if parameter in _POWERS:
        return tuple((field, _POWERS[parameter]) for field in _THROTTLES)
    group, _, symbol = parameter.rpartition(".")
    if group.startswith(("sensors", "daq")) or parameter in _FIXED:
        return ()
    return ((symbol, 1.0),) if get_type_hints(RigNumbers).get(symbol) is float else ()
