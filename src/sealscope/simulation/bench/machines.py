"""The bench: healthy machines drawn at random from a profile, with different parameters and slow drifts."""

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
from sealscope.simulation.changes import ParameterDrift, Wander, linear_path
from sealscope.simulation.commands import Command, parse_command
from sealscope.simulation.experiment import Experiment, throttle_values
from sealscope.simulation.targets_and_loads import Force, Position, command_or_target, parse_force

if TYPE_CHECKING:
    from sealscope.parameters import Rig

T = TypeVar("T")
#: Number of sines in a wandering drift (`Wander.weights`).
WANDER_TERMS = 6
#: Time step [s] at which the piston's path is estimated for `centred_start`.
_PATH_STEP = 0.05


@dataclass(frozen=True)
class BenchMachine:
    """One healthy machine in one recording: how it deviates from the designed rig, its drifts, its command and load.

    `profile`, `seed`: name of the profile and seed with which the machine was drawn; `rig`: the designed rig;
    `overrides`: parameters in which the machine deviates, by dotted name, in SI units; `duration` [s]: length of the
    recording; `closed`: closed fraction of both throttles; `command`: voltage command or position target; `controller`:
    name of the controller that follows a target, with the parameters of the designed rig.
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
        """Make an experiment with this machine.

        `arguments`: those of `Experiment.of`, such as leak and fault. By default seed, duration, command, load, drifts
        and, for a position target, the controller are the machine's, and the piston starts at `centred_start`. Raises
        InputError as `Experiment.of` does, also if a drawn parameter is out of range.
        """
        machine = self.rig.with_overrides(self.overrides, source=f"drawn from profile {self.profile}, seed {self.seed}")
        names = ("load", "seed", "duration", "command", "drifts")
        values = {name: getattr(self, name) for name in names} | arguments
        if isinstance(values["command"], str):
            values["command"] = command_or_target(values["command"])
        if isinstance(values["command"], Position):
            values.setdefault("controller", controller_named(self.controller, self.rig))
        values.setdefault("x_0", centred_start(machine, values["command"], values["duration"]))
        return Experiment.of(rig=machine, **values)


def centred_start(rig: Rig, command: Command | Position | str, duration: float) -> float:
    """Estimate the start position [m] from which the piston's travel under a command is centred at mid-stroke.

    `duration` [s]: length of the command. With a position target, the result is the target's first value. Every result
    is limited to the stroke.

    The piston moves with the pump's flow, A v = q_b omega/(2 pi), A the mean of both piston areas. The motor is taken
    as unloaded and without inertia, with its PI controller of the speed: (k_p + C_e) omega = k_p omega_d + K_i I, dI/dt
    = omega_d - omega (thesis, eqs. 4.2-4.5). Behind a servo valve the piston moves with the valve's flow without load.
    """
    command = parse_command(command) if isinstance(command, str) else command
    motor, cylinder = rig.motor, rig.cylinder
    half_stroke = 0.5 * cylinder.L
    if isinstance(command, Position):
        return float(np.clip(command.value_at(np.zeros(())), -half_stroke, half_stroke))  # the target at t = 0
    dt = _PATH_STEP
    volts = command.volts(np.arange(0.0, duration + dt, dt))
    area = 0.5 * (cylinder.A_A + cylinder.A_B)
    if not rig.circuit.pump_feeds_chambers:
        flow_per_volt = drive_of(rig).flow_per_volt
        positions = dt * np.cumsum(volts) * flow_per_volt / area
        centre = 0.5 * (min(positions.min(), 0.0) + max(positions.max(), 0.0))  # 0: the path's start
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
    """Make the random generator for one part of a machine, which is independent of those with other names."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def _draw_path(random: np.random.Generator, shapes: tuple[str, ...], duration: float, *, warms: bool = False) -> Wander:
    """Draw the course of a drift over `duration` [s]: linear with an end value of +-1, or a walk with a range of 1.

    `shapes`: courses to choose from, "linear" and "wander"; `warms`: True for a linear course that always rises.
    """
    # all numbers are drawn for either shape, so that later draws do not depend on the shape
    shape = shapes[int(random.integers(len(shapes)))]
    rises = random.random() < 0.5 or warms
    weights = random.standard_normal(WANDER_TERMS) / (np.arange(WANDER_TERMS) + 0.5)  # standard deviations of `Wander`
    if shape == "linear":
        return linear_path(1.0 if rises else -1.0, duration)
    return Wander(tuple(map(float, weights)), duration).scale_to_range(1.0)


def _draw_drift(random: np.random.Generator, drift: DriftRange, oil: Wander) -> Wander:
    """Draw the course of a drift: w oil + sqrt(1 - w^2) path, with the weight w = `drift.oil`.

    `oil`: course of the oil temperature. The path is drawn independently of it. The sum is scaled to a range (maximum
    minus minimum) that is drawn uniformly from `drift.size`.
    """
    path = _draw_path(random, drift.shapes, oil.duration)
    weight = drift.oil
    # the squares of the weights sum to 1, so that the mixture varies as much as either path
    mixture = oil.times(weight).plus(path.times((1.0 - weight**2) ** 0.5)) if weight else path
    return mixture.scale_to_range(float(random.uniform(*drift.size)))


def _draw_nuisance(nuisance: Nuisance, seed: int, oil: Wander) -> tuple[dict[str, float], list[ParameterDrift]]:
    """Draw the values by parameter, and the drifts, of a nuisance, which is a difference between machines.

    A value is in SI units, or a factor if `nuisance.scales`; `oil`: course of the oil temperature, for the drifts.
    """
    values: dict[str, float] = {}
    drifts: list[ParameterDrift] = []
    groups = [(nuisance.name, nuisance.parameters)]
    if nuisance.each:  # the parameters are drawn one by one
        groups = [(f"{nuisance.name}/{parameter}", (parameter,)) for parameter in nuisance.parameters]
    for stream_name, group in groups:
        random = _random_stream(seed, stream_name)
        # without a range no number is drawn: the drift takes the stream's first numbers
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
    """Draw a healthy machine like `rig`, with its duty, at random from a profile; equal seeds give equal machines.

    `profile`: a profile, its name or its file; `duration` [s]: length of the recording, over which the parameters
    drift; `family`: one of the profile's families of machines, "" for none.
    """
    from sealscope.parameters import load_rig

    distribution = load_profile(profile) if isinstance(profile, str) else profile
    oil_warms = bool(family) and distribution.family(family).warms  # True: the oil never wanders, but warms linearly
    distribution = distribution.of_family(family) if family else distribution
    designed_rig = load_rig(rig)
    if seed < 0:
        raise InputError(f"seed must be >= 0, got {seed}")
    if not (math.isfinite(duration) and duration > 0):
        raise InputError(f"duration must be > 0 s and finite, got {duration}")
    oil_shapes = ("linear",) if oil_warms else ("linear", "wander")
    oil = _draw_path(_random_stream(seed, "temperature of the oil"), oil_shapes, duration, warms=True)
    overrides: dict[str, float | str] = {}
    drifts: list[ParameterDrift] = []
    for nuisance in distribution.nuisances:
        if isinstance(nuisance, NuisanceChoice):
            value = nuisance.values[int(_random_stream(seed, nuisance.name).integers(len(nuisance.values)))]
            overrides |= dict.fromkeys(nuisance.parameters, value)
            continue
        values, nuisance_drifts = _draw_nuisance(nuisance, seed, oil)
        if nuisance.scales:
            values = {name: float(designed_rig[name]) * factor for name, factor in values.items()}
        overrides |= values
        drifts += nuisance_drifts
    random, duty = _random_stream(seed, "duty"), distribution.duty

    def draw_one(options: Sequence[T]) -> T:
        """Draw one of the options, each with the same probability."""
        return options[int(random.integers(len(options)))]

    command, closed_fraction = command_or_target(draw_one(duty.commands)), draw_one(duty.closed)
    overrides |= throttle_values(closed_fraction)
    amplitude = float(random.uniform(*duty.amplitude))
    if amplitude != 1.0:  # then all commands have an amplitude (`Duty`)
        command = replace(command, amplitude=command.amplitude * amplitude)  # type: ignore[type-var, union-attr]
    load = parse_force(draw_one(duty.loads)) if duty.loads else None
    controller = draw_one(duty.controllers) if duty.controllers else "pi"
    return BenchMachine(
        profile=distribution.name,
        seed=seed,
        rig=designed_rig,
        duration=duration,
        overrides=overrides,
        drifts=tuple(drifts),
        command=command,
        closed=closed_fraction,
        load=load,
        controller=controller,
    )
