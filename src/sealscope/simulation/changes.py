"""Changes of machine and instruments within a run, which drifts (in this module) and faults (in `faults`) cause."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import Polyline

if TYPE_CHECKING:
    from sealscope.physics.rig import RigNumbers

T = TypeVar("T", float, Array)
#: Longest and shortest block [s] within which changing parameters are constant (jumps may cut a shorter one).
LONGEST_BLOCK, SHORTEST_BLOCK = 0.5, 0.05
#: Largest relative change of a drifting parameter from one block to the next.
MAX_RELATIVE_CHANGE = 5e-4
#: Parameters that drift together, by the name of the group.
PARAMETER_GROUPS = {"friction": ("friction.F_pr", "friction.F_cfr", "friction.F_v")}
#: Flow coefficients of the throttles in the lines to chambers A and B, by flow direction.
THROTTLES = ("c_A_in", "c_A_out", "c_B_in", "c_B_out")
#: Model parameters that are proportional to a power of a rig parameter of another name, as (name, exponent).
_POWERS = {
    "line.C_d": tuple((field, 1.0) for field in THROTTLES),
    "line.d_line": tuple((field, 2.0) for field in THROTTLES),
    "fluid.rho": (*((field, -0.5) for field in THROTTLES), ("c_slip", -0.5), ("k_h", 1.0)),
    "pump.q_b": (("q_b", 1.0), ("c_slip", 2.0 / 3.0), ("k_h", 5.0 / 3.0)),
    "pump.C_st": (("c_slip", 1.0),),
    "pump.C_h": (("k_h", 1.0),),
}
#: Parameters that `ParameterDrift` refuses: geometry, and conditions at the start. Faults are not checked against them.
_CANNOT_DRIFT = {"cylinder.L", "cylinder.V", "fluid.p_charge", "makeup.V_gas"}
#: Points at which the range of a drift's path is computed.
_N_PATH_POINTS = 1001
#: Symbols (last parts of dotted names) of the instruments' parameters that can change.
_INSTRUMENT_SYMBOLS = {"noise", "hum", "offset", "gain_error", "scale_error", "common_noise"}


@dataclass(frozen=True)
class Effect:
    """Change of one parameter of the machine or of an instrument over time.

    `field`: name of a parameter of the compiled model (`RigNumbers`), or dotted name of an instrument's parameter;
    `change(t)`: addend (if `additive`) or factor at times t [s]. Several effects on one parameter give (value + sum of
    addends) x product of factors. The solver takes parameters as constant within blocks of time, in which `change` must
    not change by more than `max_change`, unless the block would be shorter than `min_block` [s]. `breakpoints`: times
    [s] at which `change` jumps or changes its slope.
    """

    field: str
    change: Callable[[Array], Array]
    max_change: float
    additive: bool = False
    breakpoints: tuple[float, ...] = ()
    min_block: float = SHORTEST_BLOCK

    @property
    def changes_instrument(self) -> bool:
        """True if the effect changes an instrument, False if it changes the machine."""
        return self.field.startswith("sensors.")


def apply_effects(rig_value: T, effects: Sequence[Effect], field: str, t: Array) -> T | Array:
    """Compute the parameter `field` at times t [s] from its `rig_value` and the `effects` on it, if any."""
    value: T | Array = rig_value
    for effect in sorted(effects, key=lambda effect: not effect.additive):  # sums before products
        if effect.field == field:
            value = value + effect.change(t) if effect.additive else value * effect.change(t)
    return value


def changing_values(effects: Sequence[Effect], base: RigNumbers, t: Array) -> dict[str, Array]:
    """Compute the values (n,) of all parameters that effects change, by name, at times t (n,) [s].

    `base`: the parameters of the model without effects.
    """
    names = dict.fromkeys(effect.field for effect in effects)
    return {name: apply_effects(np.full(t.size, float(getattr(base, name))), effects, name, t) for name in names}


def block_bounds(effects: Sequence[Effect], n_out: int, rate: float) -> np.ndarray:
    """Divide a run into blocks of time within which the solver takes all parameters as constant.

    Returns the bounds of the blocks (blocks + 1,) as indices, 0 to `n_out`, of the solver's outputs at `rate` [Hz].
    Without effects, the whole run is one block.

    The run is first divided at the breakpoints of effects, to within one output interval, and at times `LONGEST_BLOCK`
    apart. Then each block is divided into equal parts, as many as the most demanding effect needs: an effect may change
    by its `max_change` from part to part, or more if the parts would otherwise be shorter than its own `min_block`.
    """
    if not effects:
        return np.array([0, n_out], dtype=np.int64)
    breakpoints = np.array([t for effect in effects for t in effect.breakpoints if math.isfinite(t)], dtype=np.float64)
    grid = np.arange(0, n_out, max(1, round(LONGEST_BLOCK * rate)))
    break_outputs = np.ceil(breakpoints * rate * (1.0 - 1e-12))  # 1e-12: a breakpoint on an output stays there
    bounds = np.unique(np.clip(np.r_[grid, n_out, break_outputs], 0, n_out))
    starts, stops = bounds[:-1], bounds[1:]
    inset = 1e-6 / rate  # excludes a jump at a block's bound from the change within the block
    n_parts = np.ones(starts.size)
    for effect in effects:
        change = np.abs(effect.change(stops / rate - inset) - effect.change(starts / rate + inset))
        max_parts = np.maximum(1, (stops - starts) // max(1, round(effect.min_block * rate)))
        needed_parts = np.ceil(change / effect.max_change - 1e-9)  # 1e-9: rounding adds no part
        n_parts = np.maximum(n_parts, np.minimum(needed_parts, max_parts))
    counts = n_parts.astype(np.int64)
    part = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)  # number of each part in its block
    part_starts = np.repeat(starts, counts) + part * np.repeat((stops - starts) / counts, counts)
    return np.unique(np.rint(np.r_[part_starts, n_out]).astype(np.int64))


def add_needed_laws(base: RigNumbers, effects: Sequence[Effect]) -> RigNumbers:
    """Add to the parameters `base` the optional laws that effects need: leaks to the outside, and free air.

    A factor needs no law: it leaves a parameter of 0 at 0.
    """
    options: dict[str, Any] = {}
    for effect in effects:
        if effect.additive and effect.field.startswith("G_ext"):
            options["open_circuit"] = (True,)
        elif effect.additive and effect.field == "air":
            options["aerated"] = (True,)
    return base._replace(**options) if options else base  # the same object: runs that share it are told by its id


def build_blocks(
    effects: Sequence[Effect], base: RigNumbers, n_out: int, rate: float
) -> tuple[np.ndarray, dict[str, Array]]:
    """Divide a run into blocks of constant parameters; return their bounds, and the values of changing parameters.

    `base`: the parameters without effects. The blocks are those of `block_bounds`, merged where neighbours have equal
    parameters. The values (blocks,), by parameter, are those of the blocks' middles.
    """
    bounds = block_bounds(effects, n_out, rate)
    values = changing_values(effects, base, np.asarray(0.5 * (bounds[:-1] + bounds[1:]) / rate, dtype=np.float64))
    if not values:
        return bounds, values
    table = np.array(list(values.values()))  # (parameters, blocks)
    differs = np.r_[True, np.any(table[:, 1:] != table[:, :-1], axis=0)]
    return np.r_[bounds[:-1][differs], n_out], {name: series[differs] for name, series in values.items()}


class Schedule:
    """The model's parameters over a run of `n_out` solver outputs at `rate` [Hz], block by block (`build_blocks`).

    `bounds` (blocks + 1,): bounds of the blocks as output indices; `numbers`: the parameters in each block.
    """

    def __init__(self, effects: Sequence[Effect], base: RigNumbers, n_out: int, rate: float) -> None:
        self.bounds, values = build_blocks(effects, base, n_out, rate)
        numbers = add_needed_laws(base, effects)
        rows = zip(*(series.tolist() for series in values.values()), strict=True)
        self.numbers = [numbers._replace(**dict(zip(values, row, strict=True))) for row in rows] or [numbers]

    def blocks_between(self, first: int, last: int) -> Iterator[tuple[int, int, RigNumbers]]:
        """Yield (start, stop, parameters) for each span of outputs in first <= k < last with constant parameters."""
        block = int(np.searchsorted(self.bounds, first, side="right")) - 1  # the block that contains output `first`
        while first < last:
            stop = min(int(self.bounds[block + 1]), last)
            yield first, stop, self.numbers[block]
            first, block = stop, block + 1


@dataclass(frozen=True)
class Wander:
    """A smooth random walk over `duration` T [s]: slope t / T + sum of w_k sin((k - 1/2) pi t / T), k = 1, 2, ...

    `weights` are the w_k. If they are normal with standard deviations 1/(k - 1/2), this is the Karhunen-Loeve expansion
    of the Wiener process (Loeve, Probability Theory, 1955, section 34.5); of six terms, the shortest period is T/2.75.
    """

    weights: tuple[float, ...]
    duration: float
    slope: float = 0.0

    def __post_init__(self) -> None:
        if not (all(map(math.isfinite, (*self.weights, self.slope))) and self.duration > 0):
            raise InputError(f"a wander must have finite weights and last > 0 s, got {self}")

    def value_at(self, t: Array) -> Array:
        """Compute the random walk at times t [s]; 0 before t = 0."""
        phase = np.pi / self.duration * np.maximum(t, 0.0)
        change = np.asarray(self.slope / np.pi * phase)  # slope t / T
        if self.weights:
            sine, twice_cosine = np.sin(0.5 * phase), 2.0 * np.cos(phase)  # sin((k - 1/2) phase) for k = 1
            previous_sine = -sine  # k = 0
            for weight in self.weights:
                change = change + weight * sine
                # sin(a + phase) = 2 cos(phase) sin(a) - sin(a - phase), with a = (k - 1/2) phase
                previous_sine, sine = sine, twice_cosine * sine - previous_sine
        return change

    def breakpoints(self) -> tuple[float, ...]:
        """Return no times: the walk is smooth."""
        return ()

    def scale_to_range(self, size: float) -> Wander:
        """Scale the walk so that its maximum minus minimum over its duration is `size`; leave a constant walk."""
        path = self.value_at(np.linspace(0.0, self.duration, _N_PATH_POINTS))
        path_range = float(np.ptp(path))
        return self.times(size / path_range) if path_range > 0 else self

    def times(self, factor: float) -> Wander:
        """Multiply the walk by a factor."""
        return Wander(tuple(weight * factor for weight in self.weights), self.duration, self.slope * factor)

    def plus(self, other: Wander) -> Wander:
        """Add another walk over the same duration."""
        pairs = zip_longest(self.weights, other.weights, fillvalue=0.0)
        return Wander(tuple(a + b for a, b in pairs), self.duration, self.slope + other.slope)


def linear_path(size: float, duration: float) -> Wander:
    """Make a drift that is linear in time: 0 at the start of the run, `size` at the time `duration` [s]."""
    return Wander((), duration, size)


#: Largest change from one block to the next of model parameters that drift in their own unit, here [N].
_ABSOLUTE_MAX_CHANGES = {"F_l": 0.2}


def is_absolute_drift(parameter: str) -> bool:
    """Return True if a drift adds to the parameter, which may be 0; False if a drift is a fraction of its value."""
    return parameter.rpartition(".")[2] in ("offset", "gain_error", "scale_error", *_ABSOLUTE_MAX_CHANGES)


@dataclass(frozen=True)
class ParameterDrift:
    """A parameter that drifts: value(t) = value (1 + shape(t)), or value + shape(t) in its SI unit if `absolute`.

    `parameter`: bare or dotted name of a parameter of the machine; of a sensor's noise, hum, offset, gain error or
    scale error; or `friction`, for all friction forces together; value: its value in the rig. `absolute` must be
    `is_absolute_drift(parameter)`. Raises InputError for a parameter that cannot drift, such as `cylinder.L`.
    """

    parameter: str
    shape: Wander | Polyline
    absolute: bool = False

    def __post_init__(self) -> None:
        if self.parameter not in PARAMETER_GROUPS:
            from sealscope.parameters.rig import resolve_name

            object.__setattr__(self, "parameter", resolve_name(self.parameter))
        if not (self._is_instrument() or model_parameters_derived_from(self.parameter)):
            raise InputError(f"{self.parameter} cannot drift within a run")
        if self.absolute != is_absolute_drift(self.parameter):
            kind = "relative" if self.absolute else "absolute"
            raise InputError(f"a drift of {self.parameter} must be {kind}")

    def __str__(self) -> str:
        return f"{self.parameter} drifts"

    def _is_instrument(self) -> bool:
        """Return True if the parameter belongs to an instrument and can drift."""
        return self.parameter.startswith("sensors.") and self.parameter.rpartition(".")[2] in _INSTRUMENT_SYMBOLS

    def check(self, t: Array) -> None:
        """Raise InputError if a relative drift does not leave its parameter above 0 at the times t [s]."""
        if not self.absolute and (lowest := float(np.min(self.shape.value_at(t), initial=0.0))) <= -1.0:
            raise InputError(f"a relative drift must stay above -100 %, got {100 * lowest:.4g} % ({self.parameter})")

    def effects(self) -> tuple[Effect, ...]:
        """Build the effects of the drift on an instrument, or on all model parameters derived from its parameter."""
        breakpoints = self.shape.breakpoints()

        def build_effect(name: str, power: float) -> Effect:
            """Build the change of one parameter: the drift is added if absolute, else (1 + drift)^power is a factor."""
            if self.absolute:  # instruments have no limit of their change: the solver does not simulate them
                max_change = _ABSOLUTE_MAX_CHANGES.get(name, math.inf)
                return Effect(name, self.shape.value_at, max_change, additive=True, breakpoints=breakpoints)
            return Effect(
                name, lambda t: (1.0 + self.shape.value_at(t)) ** power, MAX_RELATIVE_CHANGE, breakpoints=breakpoints
            )

        if self._is_instrument():
            return (build_effect(self.parameter, 1.0),)
        return tuple(build_effect(name, power) for name, power in model_parameters_derived_from(self.parameter))


@cache
def model_parameters_derived_from(parameter: str) -> tuple[tuple[str, float], ...]:
    """List the model parameters that are proportional to a power of a rig parameter, as (name, exponent).

    `parameter`: dotted name, or a group such as `friction`. The list is empty for a parameter that cannot drift.
    """
    from sealscope.physics.rig import NUMBERS

    if parameter in PARAMETER_GROUPS:
        names = PARAMETER_GROUPS[parameter]
        return tuple(derived for name in names for derived in model_parameters_derived_from(name))
    if parameter in _POWERS:
        return _POWERS[parameter]
    group, _, symbol = parameter.rpartition(".")
    if group.startswith(("sensors", "daq")) or parameter in _CANNOT_DRIFT:
        return ()
    return ((symbol, 1.0),) if symbol in NUMBERS else ()
