"""An experiment: rig, command, leaks, other faults and drifts, duration, sampling and integration."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from sealscope.calls import take_fields_of
from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.arguments import Arguments, Method
from sealscope.simulation.changes import Effect, ParameterDrift
from sealscope.simulation.commands import DEFAULT_COMMAND, Command, Sine, check_command
from sealscope.simulation.faults import Fault, parse_fault
from sealscope.simulation.leaks import Leak, Thinned, parse_leak
from sealscope.simulation.targets_and_loads import Force, Position, command_or_target, parse_force
from sealscope.units import parse_quantity

if TYPE_CHECKING:
    from sealscope.control import Controller
    from sealscope.parameters import Rig

#: Most samples of a recording (about 1.4 GB of channels), so that a wrong unit cannot fill the memory.
MAX_SAMPLES = 20_000_000
#: Most steps of the solver in a run, such as an hour at a step of 3.6 us.
MAX_STEPS = 1_000_000_000
#: Times at which a drift is checked.
_N_DRIFT_CHECKS = 2001
#: Half length of the instruments' anti-alias filter, in samples of the recording.
FILTER_REACH = 16
#: Longest step [s] that is tried when the step is chosen by error (docs/decisions/0004-solvers.md).
LONGEST_STEP = 1e-3
#: Default for the rms error [Pa] that a pressure may have (a transducer's noise is 8600 Pa).
PRESSURE_TOLERANCE = 100.0
_Kind = TypeVar("_Kind", Leak, Fault)


def choose_method(rig: Rig, method: Method) -> Literal["rk4", "imex"]:
    """Choose the integration method of a rig: `method` as stated, or for `auto` imex with throttles, rk4 without.

    Raises InputError for a method that does not suit the rig: imex without throttles or with the integrator `euler`.
    """
    if method not in ("auto", "rk4", "imex"):
        raise InputError(f"method must be auto, rk4 or imex, got {method!r}")
    is_throttled = rig.line.orifices == "present"
    if method == "imex" and not is_throttled:
        raise InputError("method imex needs throttles (line.orifices = present), got line.orifices = absent; use rk4")
    is_euler = rig.motor.integrator == "euler"
    if is_euler and (method == "imex" or (is_throttled and method == "auto")):
        raise InputError("motor.integrator = euler (eq. 4.2 taken literally) needs method rk4, got imex")
    if method == "auto":
        return "imex" if is_throttled else "rk4"
    return method


def throttle_values(closed: float) -> dict[str, str | float]:
    """Build the rig parameters, by name, that close both throttles by the fraction `closed`, 0 to 1.

    Above 0 they give the rig throttles (`line.orifices`); at 0 it keeps its own choice.
    """
    values: dict[str, str | float] = {"line.closed_A": closed, "line.closed_B": closed}
    return {**values, "line.orifices": "present"} if closed > 0 else values


def check_target(target: Position, t: Array, half_stroke: float) -> None:
    """Raise InputError unless a position target stays within +-`half_stroke` [m] at the times `t` [s]."""
    x = np.broadcast_to(target.value_at(t), t.shape)
    is_outside = ~(np.abs(x) <= half_stroke)
    if is_outside.any():
        k = int(np.argmax(is_outside))
        raise InputError(
            f"position must stay within the stroke, +-{1e3 * half_stroke:g} mm, got {1e3 * x[k]:.4g} mm at "
            f"t = {t[k]:.4g} s ({target})"
        )


def check_circuit(rig: Rig) -> None:
    """Raise InputError for a single-rod cylinder in a closed circuit without pilot-operated check or relief valves.

    When its piston moves, one chamber gives off more oil than the other takes in. Only these valves let the difference
    out of the circuit.
    """
    cylinder, makeup = rig.cylinder, rig.makeup
    is_single_rod = rig.circuit.pump_feeds_chambers and cylinder.A_A != cylinder.A_B
    if is_single_rod and makeup.check_valves != "pilot-operated" and not makeup.G_relief > 0:
        raise InputError(
            f"a single-rod cylinder (A_A = {1e6 * cylinder.A_A:g} mm^2, A_B = {1e6 * cylinder.A_B:g} mm^2) must "
            "have makeup.check_valves = pilot-operated or makeup.G_relief > 0, through which its rod displaces oil, "
            f"got makeup.check_valves = {makeup.check_valves}, makeup.G_relief = {makeup.G_relief:g}"
        )


@dataclass(frozen=True, repr=False)
class Experiment:
    """All inputs of a simulated run; equal experiments give, on one processor, recordings that are equal byte for byte.

    `Experiment.of` makes one from texts with units. The sampling rate is the rig's `daq.sample_rate`.

    Parameters
    ----------
    rig, command, duration, leaks, seed, x_0, method, step, allow_unresolved, faults, drifts, error, load, controller :
        The arguments of `of` after parsing: numbers in SI units; leaks, faults and drifts as tuples of objects.

    Raises
    ------
    InputError
        A number is out of its range, or the inputs do not fit together.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import sealscope as ss
    >>> experiment = ss.Experiment.of(command="5 sin(2t)", leak="0.0042 L/min from 90 s", duration="2 min")
    >>> experiment.onset(), len(experiment.sample_times())
    (90.0, 60000)
    >>> replace(experiment, seed=1).key() == experiment.key()
    False
    """

    rig: Rig
    command: Command | Position = DEFAULT_COMMAND
    duration: float = 180.0
    leaks: tuple[Leak, ...] = ()
    seed: int = 0
    x_0: float = 0.0
    method: Method = "auto"
    step: float | None = None
    allow_unresolved: bool = False
    faults: tuple[Fault, ...] = ()
    drifts: tuple[ParameterDrift, ...] = ()
    error: float | None = None
    load: Force | None = None
    controller: Controller | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.duration) and self.duration > 0):
            raise InputError(f"duration must be > 0 s and finite, got {self.duration}")
        samples = self.duration * self.rate
        if samples < 1 or samples > MAX_SAMPLES:
            raise InputError(
                f"duration x daq.sample_rate must be 1 to {MAX_SAMPLES} samples, got {samples:.4g} "
                f"({self.duration:g} s at {self.rate:g} Hz)"
            )
        if self.seed < 0:
            raise InputError(f"seed must be >= 0, got {self.seed}")
        half_stroke = self.rig.cylinder.L / 2
        if not abs(self.x_0) <= half_stroke:
            raise InputError(f"x_0 must be within the stroke, -{half_stroke:g} m to {half_stroke:g} m, got {self.x_0}")
        step = LONGEST_STEP if self.step is None else self.step
        if step > 0 and self.duration / step > MAX_STEPS:  # `integrate_run` refuses other steps
            origin = f"at least, of {step:g} s" if self.step is None else f"step = {step:g} s"
            raise InputError(
                f"a run must have at most {MAX_STEPS} steps of the solver, got {self.duration / step:.4g} ({origin})"
            )
        if self.step is not None and self.error is not None:
            raise InputError(
                f"a run must have a stated step or a stated error, not both, got step = {self.step:g} s and "
                f"error = {self.error:g} Pa"
            )
        choose_method(self.rig, self.method)
        check_circuit(self.rig)
        if self.target is not None:
            check_target(self.target, self.sample_times(), half_stroke)
        elif self.controller is not None:
            raise InputError(
                f"a controller must have a target to follow ('position 50 mm sin(2t)'), got {self.command}"
            )
        else:
            command, u_max = self.voltage_command, self.rig.daq.u_max
            # a small enough sine needs no samples
            if not (isinstance(command, Sine) and abs(command.offset) + abs(command.amplitude) <= u_max):
                check_command(command, self.sample_times(), u_max)
        for drift in self.drifts:
            drift.check(np.linspace(0.0, self.duration, _N_DRIFT_CHECKS))
        self._all_effects()  # raises InputError for a fault that this rig cannot have

    @staticmethod
    @take_fields_of(Arguments)
    def of(arguments: Arguments) -> Experiment:
        """Make an experiment from numbers in SI units and texts with units; the arguments are those of `simulate`.

        Returns
        -------
        Experiment
            The experiment, with all texts parsed. An argument that breaks a rule raises InputError.

        Examples
        --------
        >>> import sealscope as ss
        >>> ss.Experiment.of(leak="0.0042 L/min from 1.5 min", duration="3 min", seed=1)
        <Experiment: rig thesis, 3 sin(4t), 180 s at 500 Hz, 0.0042 L/min laminar from 90 s, seed 1>
        """
        from sealscope.parameters import load_rig

        quantities: dict[str, Any] = {}  # values in SI units by argument
        for declared in fields(arguments):
            value, unit = getattr(arguments, declared.name), declared.metadata["unit"]
            if unit and value is declared.default:  # a default is in SI units already, or None
                quantities[declared.name] = value
            elif unit:
                quantities[declared.name] = parse_quantity(value, unit, name=declared.name, finite=False)
        rate = quantities.pop("rate")
        if not isinstance(arguments.set, Mapping | None):
            raise InputError(f"set must map names of parameters to values, got {arguments.set!r}")
        overrides = {**(arguments.set or {}), **({} if rate is None else {"daq.sample_rate": rate})}
        rig = load_rig(arguments.rig)
        command = command_or_target(arguments.command) if isinstance(arguments.command, str) else arguments.command
        if not (hasattr(command, "volts") or isinstance(command, Position)):
            raise InputError(f"command must be a text or a Command, got {command!r}")
        if not isinstance(arguments.load, str | Force | None):
            raise InputError(f"load must be a text or a Force, got {arguments.load!r}")
        if isinstance(arguments.seed, bool) or not isinstance(arguments.seed, int | np.integer):
            raise InputError(f"seed must be a whole number, got {arguments.seed!r}")
        controller = arguments.controller
        if isinstance(controller, str):
            from sealscope.control import controller_named

            controller = controller_named(controller, rig)
        return Experiment(
            rig=rig.with_overrides(overrides) if overrides else rig,
            command=command,
            leaks=_parse_several(arguments.leak, Leak, parse_leak, "leak"),
            seed=int(arguments.seed),
            method=arguments.method,
            allow_unresolved=arguments.allow_unresolved,
            faults=_parse_several(arguments.fault, Fault, parse_fault, "fault"),
            drifts=tuple(arguments.drifts),
            load=parse_force(arguments.load) if isinstance(arguments.load, str) else arguments.load,
            controller=controller,
            **quantities,
        )

    def __repr__(self) -> str:
        parts = [f"rig {self.rig.name}", str(self.command), f"{self.duration:g} s at {self.rate:g} Hz"]
        parts += [] if self.load is None else [str(self.load)]
        parts += [str(change) for change in (*self.leaks, *self.faults, *self.drifts)]
        return f"<Experiment: {', '.join(parts)}, seed {self.seed}>"

    @property
    def voltage_command(self) -> Command:
        """The voltage command with its changes by faults; raises InputError if there is a position target instead."""
        if isinstance(self.command, Position):
            raise InputError(f"a run with a position target has no voltage command, got {self.command}")
        return self._with_duty_changes(self.command)

    @property
    def target(self) -> Position | None:
        """The position target of the run, including the changes by faults; None for a voltage command."""
        if not isinstance(self.command, Position):
            return None
        return replace(self.command, signal=self._with_duty_changes(self.command.signal))

    def _with_duty_changes(self, command: Command) -> Command:
        """Apply the faults of the duty to a command."""
        for fault in self.faults:
            command = fault.change_command(command)
        return command

    @property
    def active_controller(self) -> Controller | None:
        """The controller that follows the position target, by default a PI controller; None for a voltage command."""
        if not isinstance(self.command, Position):
            return None
        from sealscope.control import PositionPI

        return self.controller or PositionPI.from_rig(self.rig)

    def effects(self) -> tuple[Effect, ...]:
        """Collect the changes over time of the machine's parameters (not the instruments') by drifts and faults."""
        return tuple(effect for effect in self._all_effects() if not effect.changes_instrument)

    def _all_effects(self) -> tuple[Effect, ...]:
        """Collect the changes over time of all parameters of machine and instruments, by drifts and faults."""
        drift_effects = [effect for drift in self.drifts for effect in drift.effects()]
        return (*drift_effects, *(effect for fault in self.faults for effect in fault.effects(self.rig)))

    def scale_with_viscosity(self, leaks: tuple[Leak, ...]) -> tuple[Leak, ...]:
        """Divide the openings of laminar leaks by the oil's viscosity relative to the rig's, if a fault changes it."""
        for fault in self.faults:
            if (viscosity := fault.viscosity_ratio(self.rig)) is not None:
                leaks = tuple(
                    replace(leak, opening=Thinned(leak.opening, viscosity)) if leak.law == "laminar" else leak
                    for leak in leaks
                )
        return leaks

    def instrument_effects(self) -> tuple[Effect, ...]:
        """Collect the changes over time of the instruments' parameters by drifts and faults."""
        return tuple(effect for effect in self._all_effects() if effect.changes_instrument)

    @property
    def error_allowed(self) -> float:
        """Largest rms error [Pa] of a pressure that the solver's step may cause, stated or by default."""
        return PRESSURE_TOLERANCE if self.error is None else self.error

    @property
    def rate(self) -> float:
        """Sampling rate of the recording [Hz]."""
        return self.rig.daq.sample_rate

    def sample_times(self) -> Array:
        """Compute the times [s] of the recording's samples."""
        return np.arange(round(self.duration * self.rate)) / self.rate

    def onset(self) -> float | None:
        """Compute the time >= 0 [s] at which the first leak opens; None if no leak of size > 0 opens within the run."""
        sized_leaks = [leak for leak in self.leaks if (leak.mean or leak.coefficient or 0.0) > 0]
        onsets = [onset for leak in sized_leaks if (onset := leak.opening.onset()) < self.duration]
        return max(0.0, min(onsets)) if onsets else None

    def describe(self) -> dict[str, Any]:
        """Describe the experiment for the provenance, without leaks, faults and drifts, which a diagnosis must find."""
        overrides = [row for row in self.rig.table() if row.source.startswith("set by")]
        return {
            "rig": self.rig.name,
            "overrides": {row.name: f"{row.value} {row.unit}".strip() for row in overrides},
            "command": str(self.command),
            "duration_s": self.duration,
            "sample_rate_hz": self.rate,
            "seed": self.seed,
            "x_0_m": self.x_0,
            **({} if self.load is None else {"load": self.load.words}),
            **({} if self.active_controller is None else {"controller": repr(self.active_controller)}),
        }

    def key(self) -> str:
        """Compute the key of the experiment, a hash of 16 hexadecimal digits; equal experiments have equal keys."""
        values = {name: repr(value) for name, value in self.rig.present_values().items()}
        inputs = [identity_values(self.command), *(identity_values(leak) for leak in self.leaks)]
        inputs += [identity_values(change) for change in (*self.faults, *self.drifts)]
        solver = [self.method, self.step, self.allow_unresolved]
        # without a tolerance `error`, keys must stay those of older versions
        solver += [] if self.error is None else [self.error]
        inputs += [identity_values(added) for added in (self.load, self.active_controller) if added is not None]
        text = json.dumps([self.describe(), values, inputs, solver], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def identity_values(value: Any) -> Any:
    """Convert a command, leak or other object to plain values that are equal only for equal objects."""
    if isinstance(value, np.ndarray):
        return hashlib.sha256(np.ascontiguousarray(value, dtype=np.float64).tobytes()).hexdigest()
    if is_dataclass(value):
        return [type(value).__name__, *(identity_values(getattr(value, declared.name)) for declared in fields(value))]
    return repr(value)


def _parse_several(
    argument: Any, kind: type[_Kind], parse: Callable[[str], _Kind | None], name: str
) -> tuple[_Kind, ...]:
    """Parse the argument `name`, which states one or several leaks or faults.

    `argument`: a text, an object of the class `kind`, an iterable of these, or None. `parse` returns None for a text
    such as ``none``, which is left out.
    """
    if argument is None:
        return ()
    is_single = isinstance(argument, (str, kind)) or not isinstance(argument, Iterable)
    result = []
    for item in [argument] if is_single else argument:
        if not isinstance(item, (str, kind)):
            raise InputError(f"{name} must be a text, a {kind.__name__} or several of them, got {item!r}")
        parsed = parse(item) if isinstance(item, str) else item
        if parsed is not None:
            result.append(parsed)
    return tuple(result)
