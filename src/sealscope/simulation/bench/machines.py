"""The bench: healthy machines drawn at random from a profile, each with parameters and slow drifts of its own."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from sealscope.control import controller_named, drive_of
from sealscope.errors import InputError
from sealscope.simulation.bench.profile import DriftRange, Nuisance, NuisanceChoice, Profile, load_profile
from sealscope.simulation.changes import ParameterDrift, Wander
from sealscope.simulation.commands import Command, parse_command
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.targets_and_loads import Force, Position, command_or_target, parse_force

if TYPE_CHECKING:
    from sealscope.parameters import Rig

T = TypeVar("T")
#: Terms of a wandering drift.
WANDER_TERMS = 6
#: Time step [s] at which the piston's path is estimated for `centred_start`.
_PATH_STEP = 0.05


@dataclass(frozen=True)
class BenchMachine:
    """One healthy machine in one recording: how it deviates from the designed rig, its drifts, its command and load.

    `overrides`: the machine's parameters by dotted name, in SI units; `duration` [s]: length of the recording, over
    which the drifts have their sizes; `closed`: closed fraction of both throttles; `command`: voltage command or
    position target. A position target is followed by the controller of the name `controller`, built for the designed
    `rig` and not for the machine.
    """

    profile: str
    seed: int
    rig: Rig
    duration: float
    overrides: Mapping[str, float | str]
    drifts: tuple[ParameterDrift, ...]
    command: Command | Position
    closed: float
    load: Force | None = None
    controller: str = "pi"

    def experiment(self, **arguments: Any) -> Experiment:
        """Make the experiment of this machine, with a start position from which its strokes are centred.

        `arguments`: those of `Experiment.of`, such as leak and fault; seed, duration, command, load and drifts are
        the machine's unless stated. Raises InputError as `Experiment.of` does, also if a drawn parameter is out of
        its range.
        """
        machine = self.rig.with_overrides(self.overrides, source=f"drawn from profile {self.profile}, seed {self.seed}")
        machine_values = {"seed": self.seed, "duration": self.duration, "command": self.command, "drifts": self.drifts}
        values = {"load": self.load, **machine_values, **arguments}
        if isinstance(values["command"], str):
            values["command"] = command_or_target(values["command"])
        if isinstance(values["command"], Position):
            values.setdefault("controller", controller_named(self.controller, self.rig))
        values.setdefault("x_0", centred_start(machine, values["command"], values["duration"]))
        return Experiment.of(rig=machine, **values)


def centred_start(rig: Rig, command: Command | Position | str, duration: float) -> float:
    """Estimate the start position [m] from which the strokes under a command are centred at mid-stroke.

    For a position target it is the target's first value. The result is limited to the stroke. `duration` [s]: length
    of the run.

    The piston moves with the pump's flow, A v = q_b omega/(2 pi), and the motor is taken as unloaded and without
    inertia in its PI loop: (k_p + C_e) omega = k_p omega_d + K_i I, dI/dt = omega_d - omega (eqs. 4.2-4.5). Behind a
    servo valve the piston moves with the valve's flow without load.
    """
    command = parse_command(command) if isinstance(command, str) else command
    motor, cylinder = rig.motor, rig.cylinder
    dt, half_stroke = _PATH_STEP, 0.5 * cylinder.L
    if isinstance(command, Position):
        return float(np.clip(command.value_at(np.zeros(())), -half_stroke, half_stroke))
    area, volts = 0.5 * (cylinder.A_A + cylinder.A_B), command.volts(np.arange(0.0, duration + dt, dt))
    if not rig.circuit.pump_feeds_chambers:
        flow_per_volt = drive_of(rig).unloaded_flow(1.0)
        positions = dt * np.cumsum(volts) * flow_per_volt / area
        centre = 0.5 * (min(positions.min(), 0.0) + max(positions.max(), 0.0))
        return float(np.clip(-centre, -half_stroke, half_stroke))
    integral = angle = min_angle = max_angle = 0.0
    for omega_d in map(float, motor.omega_per_volt * volts):
        omega = (motor.k_p * omega_d + motor.K_i * integral) / (motor.k_p + motor.C_e)
        integral += dt * (omega_d - omega)
        angle += dt * omega
        min_angle, max_angle = min(min_angle, angle), max(max_angle, angle)
    travel_per_angle = rig.pump.q_b / (2.0 * np.pi) / area
    return float(np.clip(-0.5 * travel_per_angle * (min_angle + max_angle), -half_stroke, half_stroke))


def _random_stream(seed: int, name: str) -> np.random.Generator:
    """Make the random generator of one nuisance, that is of one difference between machines.

    It depends on `seed` and `name` only, so that the draws of a nuisance do not depend on the other nuisances of a
    profile.
    """
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def _draw_path(random: np.random.Generator, shapes: tuple[str, ...], duration: float, *, warms: bool = False) -> Wander:
    """Draw the course of a drift over `duration` [s]: linear with an end value of +-1, or a walk with a range of 1.

    The range is maximum minus minimum. `shapes`: names of the courses to choose from, "linear" and "wander" (a smooth
    random walk); `warms`: a linear course always rises, otherwise it rises or falls at random.
    """
    shape = shapes[int(random.integers(len(shapes)))]
    rises = random.random() < 0.5 or warms
    weights = random.standard_normal(WANDER_TERMS) / (np.arange(WANDER_TERMS) + 0.5)  # standard deviations of `Wander`
    if shape == "linear":
        return Wander((), duration, 1.0 if rises else -1.0)
    return Wander(tuple(map(float, weights)), duration).scale_to_range(1.0)


def _draw_drift(random: np.random.Generator, drift: DriftRange, oil: Wander) -> Wander:
    """Draw the course of a parameter's drift: a mixture of the oil temperature's course and an independent one.

    It is w oil + sqrt(1 - w^2) path, scaled to a range (maximum minus minimum) that is drawn uniformly from
    `drift.size`. Here w is `drift.oil`, `oil` the course of the oil temperature, and path an independent course.
    """
    path = _draw_path(random, drift.shapes, oil.duration)
    # weights whose squares sum to 1, so that the mixture varies as much as either path
    mixture = oil.times(drift.oil).plus(path.times((1.0 - drift.oil**2) ** 0.5)) if drift.oil else path
    return mixture.scale_to_range(float(random.uniform(*drift.size)))


def _draw_nuisance(nuisance: Nuisance, seed: int, oil: Wander) -> tuple[dict[str, float], list[ParameterDrift]]:
    """Draw the values of a nuisance, that is of one difference between machines, and its drifts.

    Returns the values by parameter, and the list of drifts. A value is in SI units, or a factor on the rig's value if
    `nuisance.scales`. `oil`: course of the oil temperature, which drifts may follow.
    """
    values: dict[str, float] = {}
    drifts: list[ParameterDrift] = []
    groups = [(name,) for name in nuisance.parameters] if nuisance.each else [nuisance.parameters]
    for group in groups:
        random = _random_stream(seed, f"{nuisance.name}/{group[0]}" if nuisance.each else nuisance.name)
        value = float(random.uniform(nuisance.low, nuisance.high)) if nuisance.high > nuisance.low else nuisance.low
        values |= dict.fromkeys(group, value)
        if nuisance.drift is not None:
            path = _draw_drift(random, nuisance.drift, oil)
            drifts += [ParameterDrift(name, path, nuisance.drift.absolute) for name in group]
    return values, drifts


def draw(
    profile: Profile | str = "bench",
    seed: int = 0,
    *,
    rig: Rig | str = "thesis",
    duration: float = 180.0,
    family: str = "",
) -> BenchMachine:
    """Draw a healthy machine like `rig` at random from a profile; equal seeds give equal machines.

    `profile`: a profile, its name or its file; `duration` [s]: length of the recording, over which the drifts have
    their sizes; `family`: one of the profile's families of machines, "" for none. Raises InputError for a seed below
    0, a duration that is not positive and finite, or an unknown rig, profile or family.
    """
    from sealscope.parameters import load_rig

    distribution = load_profile(profile) if isinstance(profile, str) else profile
    warms = bool(family) and distribution.family(family).warms
    distribution = distribution.of_family(family) if family else distribution
    base = load_rig(rig)
    if seed < 0:
        raise InputError(f"seed must be >= 0, got {seed}")
    if not (math.isfinite(duration) and duration > 0):
        raise InputError(f"duration must be > 0 s and finite, got {duration}")
    oil_shapes = ("linear",) if warms else ("linear", "wander")
    oil = _draw_path(_random_stream(seed, "temperature of the oil"), oil_shapes, duration, warms=True)
    overrides: dict[str, float | str] = {}
    drifts: list[ParameterDrift] = []
    for nuisance in distribution.nuisances:
        if isinstance(nuisance, NuisanceChoice):
            value = nuisance.values[int(_random_stream(seed, nuisance.name).integers(len(nuisance.values)))]
            overrides |= dict.fromkeys(nuisance.parameters, value)
            continue
        values, nuisance_drifts = _draw_nuisance(nuisance, seed, oil)
        overrides |= {name: float(base[name]) * value for name, value in values.items()} if nuisance.scales else values
        drifts += nuisance_drifts
    random, duty = _random_stream(seed, "duty"), distribution.duty

    def draw_one(options: Sequence[T]) -> T:
        """Draw one of the options at random, each with the same probability."""
        return options[int(random.integers(len(options)))]

    command, closed = command_or_target(draw_one(duty.commands)), draw_one(duty.closed)
    overrides |= {"line.closed_A": closed, "line.closed_B": closed}
    if closed > 0:
        overrides["line.orifices"] = "present"
    amplitude = float(random.uniform(*duty.amplitude))
    if amplitude != 1.0:
        command = replace(command, amplitude=command.amplitude * amplitude)  # type: ignore[type-var, union-attr]
    load = parse_force(draw_one(duty.loads)) if duty.loads else None
    controller = draw_one(duty.controllers) if duty.controllers else "pi"
    return BenchMachine(
        profile=distribution.name,
        seed=seed,
        rig=base,
        duration=duration,
        overrides=overrides,
        drifts=tuple(drifts),
        command=command,
        closed=closed,
        load=load,
        controller=controller,
    )
