"""An experiment: rig, command, leaks, other faults and drifts, duration, sampling and integration."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from sealscope.calls import with_arguments_of
from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.arguments import Arguments, Method
from sealscope.simulation.changes import Effect, ParameterDrift, Readings
from sealscope.simulation.commands import Command, Sine, check_command
from sealscope.simulation.courses import Force, Position, command_or_target, parse_force
from sealscope.simulation.faults import Fault, parse_fault
from sealscope.simulation.leaks import Leak, Thinned, parse_leak
from sealscope.units import parse_quantity

if TYPE_CHECKING:
    from sealscope.control import Controller
    from sealscope.parameters import Rig

#: Most samples a recording may have (about 1.4 GB of channels), so that a slip of the unit cannot fill the memory.
MOST_SAMPLES = 20_000_000
#: Most steps of the solver that may be asked for: an hour at 3.6 us.
MOST_STEPS = 1_000_000_000
#: Longest step [s] that is tried when the step is chosen by error (docs/decisions/0004-solvers.md).
LONGEST_STEP = 1e-3
#: Default for the rms error [Pa] that a pressure may have (a transducer's noise is 8600 Pa).
PRESSURE_TOLERANCE = 100.0
_Kind = TypeVar("_Kind", Leak, Fault)


def choose_method(rig: Rig, method: Method) -> Literal["rk4", "imex"]:
    """Return the stated method, or choose by the rig: implicit-explicit with throttles, explicit without."""
    if method not in ("auto", "rk4", "imex"):
        raise InputError(f"method must be auto, rk4 or imex, got {method!r}")
    throttled = rig.line.orifices == "present"
    if method == "imex" and not throttled:
        raise InputError("method imex needs throttles (line.orifices = present), got line.orifices = absent; use rk4")
    euler = rig.motor.integrator == "euler"
    if euler and (method == "imex" or (throttled and method == "auto")):
        raise InputError("motor.integrator = euler (eq. 4.2 taken literally) needs method rk4, got imex")
    if method == "auto":
        return "imex" if throttled else "rk4"
    return method


def check_target(target: Position, t: Array, half: float) -> None:
    """Raise InputError where a target leaves the stroke, +-`half` [m], at any of the times `t` [s]."""
    x = np.broadcast_to(target.value_at(t), t.shape)
    bad = ~(np.abs(x) <= half)
    if bad.any():
        k = int(np.argmax(bad))
        raise InputError(
            f"position must stay within the stroke, +-{1e3 * half:g} mm, got {1e3 * x[k]:.4g} mm at t = {t[k]:.4g} s "
            f"({target})"
        )


def check_circuit(rig: Rig) -> None:
    """Raise InputError for a single-rod cylinder in a closed circuit from which its rod cannot displace oil."""
    c, m = rig.cylinder, rig.makeup
    if rig.valve.spool == "present":
        return
    if c.A_A != c.A_B and not (m.check_valves == "pilot-operated" or m.G_relief > 0):
        raise InputError(
            f"a single-rod cylinder (A_A = {1e6 * c.A_A:g} mm^2, A_B = {1e6 * c.A_B:g} mm^2) must have "
            "makeup.check_valves = pilot-operated, through which its rod displaces oil, got "
            f"makeup.check_valves = {m.check_valves}"
        )


@dataclass(frozen=True, repr=False)
class Experiment:
    """Everything a run depends on; equal experiments give equal bytes.

    `Experiment.of` makes one of texts with units. The sampling rate is the rig's `daq.sample_rate`.

    Parameters
    ----------
    rig, command, duration, leaks, seed, x_0, method, step, allow_unresolved, faults, drifts, error, load, controller :
        The arguments of `of` once they are read: numbers in SI units; leaks, faults and drifts as tuples of objects.

    Raises
    ------
    InputError
        Where a number is out of its range, or parts do not fit together.

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
    command: Command | Position = field(default_factory=lambda: Sine(3.0, 4.0))
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
        if samples < 1 or samples > MOST_SAMPLES:
            raise InputError(
                f"duration x daq.sample_rate must be 1 to {MOST_SAMPLES} samples, got {samples:.4g} "
                f"({self.duration:g} s at {self.rate:g} Hz)"
            )
        if self.seed < 0:
            raise InputError(f"seed must be >= 0, got {self.seed}")
        half = self.rig.cylinder.L / 2
        if not abs(self.x_0) <= half:
            raise InputError(f"x_0 must be within the stroke, -{half:g} m to {half:g} m, got {self.x_0}")
        step = LONGEST_STEP if self.step is None else self.step
        if step > 0 and self.duration / step > MOST_STEPS:
            what = f"at least, of {step:g} s" if self.step is None else f"step = {step:g} s"
            raise InputError(
                f"a run must have at most {MOST_STEPS} steps of the solver, got {self.duration / step:.4g} ({what})"
            )
        if self.step is not None and self.error is not None:
            raise InputError(
                f"a run must have a stated step or a stated error, not both, got step = {self.step:g} s and "
                f"error = {self.error:g} Pa"
            )
        choose_method(self.rig, self.method)
        check_circuit(self.rig)
        if self.target is not None:
            check_target(self.target, self.sample_times(), half)
        elif self.controller is not None:
            raise InputError(
                f"a controller must have a target to follow ('position 50 mm sin(2t)'), got {self.command}"
            )
        else:
            command, u_max = self.commanded, self.rig.daq.u_max
            if not (isinstance(command, Sine) and abs(command.offset) + abs(command.amplitude) <= u_max):
                check_command(command, self.sample_times(), u_max)
        for drift in self.drifts:
            drift.check(np.linspace(0.0, self.duration, 2001))
        self._effects()

    @staticmethod
    @with_arguments_of(Arguments)
    def of(arguments: Arguments) -> Experiment:
        """Make an experiment of numbers in SI units and texts with units; the arguments are those of `simulate`.

        Returns
        -------
        Experiment
            With all texts read; InputError for whatever breaks a rule.

        Examples
        --------
        >>> import sealscope as ss
        >>> ss.Experiment.of(leak="0.0042 L/min from 1.5 min", duration="3 min", seed=1)
        <Experiment: rig thesis, 3 sin(4t), 180 s at 500 Hz, 0.0042 L/min laminar from 90 s, seed 1>
        """
        from sealscope.parameters import load_rig

        numbers: dict[str, Any] = {}
        for declared in fields(arguments):
            value, unit = getattr(arguments, declared.name), declared.metadata["unit"]
            if unit and value is not declared.default:
                value = parse_quantity(value, unit, name=declared.name, finite=False)
            if unit:
                numbers[declared.name] = value
        rate = numbers.pop("rate")
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
            **numbers,
        )

    def __repr__(self) -> str:
        parts = [f"rig {self.rig.name}", str(self.command), f"{self.duration:g} s at {self.rate:g} Hz"]
        parts += [] if self.load is None else [str(self.load)]
        parts += [str(change) for change in (*self.leaks, *self.faults, *self.drifts)]
        return f"<Experiment: {', '.join(parts)}, seed {self.seed}>"

    @property
    def commanded(self) -> Command:
        """The command that the rig gets, as the faults of the duty leave `command`; InputError for a target."""
        if isinstance(self.command, Position):
            raise InputError(f"what a controller sends is known after its run only, got {self.command}")
        return self._changed(self.command)

    @property
    def target(self) -> Position | None:
        """The target of the controller, as the faults of the duty leave it; None where there is a command."""
        if not isinstance(self.command, Position):
            return None
        return replace(self.command, course=self._changed(self.command.course))

    def _changed(self, command: Command) -> Command:
        for fault in self.faults:
            command = fault.commanded(command)
        return command

    @property
    def controlled(self) -> Controller | None:
        """The controller that follows the target, its own or the one that knows the rig; None for a command."""
        if not isinstance(self.command, Position):
            return None
        from sealscope.control import PositionPI

        return self.controller or PositionPI.from_rig(self.rig)

    def effects(self) -> tuple[Effect, ...]:
        """Collect the changes in the machine within the run."""
        return tuple(effect for effect in self._effects() if not effect.of_instrument)

    def _effects(self) -> tuple[Effect, ...]:
        drifting = [effect for drift in self.drifts for effect in drift.effects()]
        return (*drifting, *(effect for fault in self.faults for effect in fault.effects(self.rig)))

    def flowing(self, leaks: tuple[Leak, ...]) -> tuple[Leak, ...]:
        """Adapt leaks to the run's oil: a laminar one passes more where the oil is warmer than the rig's.

        Their coefficients are those at the rig's own viscosity.
        """
        for fault in self.thins:
            viscosity = fault.viscosity(self.rig)
            leaks = tuple(
                replace(leak, opening=Thinned(leak.opening, viscosity)) if viscosity and leak.law == "laminar" else leak
                for leak in leaks
            )
        return leaks

    @property
    def thins(self) -> tuple[Fault, ...]:
        """The faults that change the oil's viscosity within the run."""
        return tuple(fault for fault in self.faults if fault.viscosity(self.rig) is not None)

    def readings(self) -> Readings:
        """Collect the changes at the instruments within the run."""
        effects = tuple(effect for effect in self._effects() if effect.of_instrument)
        return Readings(effects, tuple(hold for fault in self.faults for hold in fault.holds()))

    @property
    def error_allowed(self) -> float:
        """Error by which a step is chosen [Pa], the stated one or else the default."""
        return PRESSURE_TOLERANCE if self.error is None else self.error

    @property
    def rate(self) -> float:
        """Sampling rate of the recording [Hz]."""
        return self.rig.daq.sample_rate

    def sample_times(self) -> Array:
        """Compute the times [s] of the recording's samples."""
        return np.arange(round(self.duration * self.rate)) / self.rate

    def onset(self) -> float | None:
        """Time [s] at which the first leak opens within the run, None for a run without one."""
        onsets = [leak.opening.onset() for leak in self.leaks if (leak.mean or leak.coefficient or 0.0) > 0]
        onsets = [onset for onset in onsets if onset < self.duration]
        return max(0.0, min(onsets)) if onsets else None

    def describe(self) -> dict[str, Any]:
        """Convert the experiment to plain values, without its truth (leaks, faults, drifts)."""
        return {
            "rig": self.rig.name,
            "overrides": {
                row.name: f"{row.value} {row.unit}".strip()
                for row in self.rig.table()
                if row.source.startswith("set by")
            },
            "command": str(self.command),
            "duration_s": self.duration,
            "sample_rate_hz": self.rate,
            "seed": self.seed,
            "x_0_m": self.x_0,
            **({} if self.load is None else {"load": self.load.words}),
            **({} if self.controlled is None else {"controller": repr(self.controlled)}),
        }

    def key(self) -> str:
        """Compute a short name that equal experiments alone share."""
        values = {name: repr(value) for name, value in self.rig.present().items()}
        inputs = [exact(self.command), *(exact(leak) for leak in self.leaks)]
        inputs += [exact(change) for change in (*self.faults, *self.drifts)]
        solver = [self.method, self.step, self.allow_unresolved]
        solver += [] if self.error is None else [self.error]
        inputs += [exact(added) for added in (self.load, self.controlled) if added is not None]
        text = json.dumps([self.describe(), values, inputs, solver], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def exact(value: Any) -> Any:
    """Convert a command or a leak to plain values that differ wherever its numbers do.

    Down to the last digit, and deep in a table.
    """
    if isinstance(value, np.ndarray):
        return hashlib.sha256(np.ascontiguousarray(value, dtype=np.float64).tobytes()).hexdigest()
    if is_dataclass(value):
        return [type(value).__name__, *(exact(getattr(value, part.name)) for part in fields(value))]
    return repr(value)


def _parse_several(
    argument: Any, kind: type[_Kind], parse: Callable[[str], _Kind | None], name: str
) -> tuple[_Kind, ...]:
    """Read the leaks or faults of an argument: one or several, as texts or as objects.

    Raises InputError for anything else.
    """
    several = [] if argument is None else [argument] if isinstance(argument, (str, kind)) else argument
    if not isinstance(several, Iterable):
        raise InputError(f"{name} must be a text, a {kind.__name__} or several of them, got {argument!r}")
    result = []
    for item in several:
        if not isinstance(item, (str, kind)):
            raise InputError(f"{name} must be a text, a {kind.__name__} or several of them, got {item!r}")
        parsed = parse(item) if isinstance(item, str) else item
        if parsed is not None:
            result.append(parsed)
    return tuple(result)
