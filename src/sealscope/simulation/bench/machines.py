"""The bench: healthy machines drawn from a profile by a seed; each differs, and each changes within its record."""

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
from sealscope.simulation.courses import Force, Position, command_or_target, parse_force
from sealscope.simulation.experiment import Experiment

if TYPE_CHECKING:
    from sealscope.parameters import Rig

T = TypeVar("T")
#: Terms of a wandering drift.
WANDER_TERMS = 6


@dataclass(frozen=True)
class BenchMachine:
    """One machine on one day: its designed rig, its departures from that, its drifts and its duty.

    `overrides`: values of parameters by dotted name, in SI, throttles among them (`closed`; open ones leave
    `line.orifices` as the rig has it); `duration` [s] of the record over which the drifts have their sizes. A target is
    followed by the `controller` of that name, which assumes the rig as designed and not the machine.
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
        """Make the experiment of this machine on its duty, from a start that centres its strokes.

        `arguments`: those of `Experiment.of` (leak, fault), and the machine's own seed, duration and drifts where
        they are not among them.
        """
        built = self.rig.with_overrides(self.overrides, source=f"drawn from profile {self.profile}, seed {self.seed}")
        machine_values = {"seed": self.seed, "duration": self.duration, "command": self.command, "drifts": self.drifts}
        values = {"load": self.load, **machine_values, **arguments}
        if isinstance(values["command"], str):
            values["command"] = command_or_target(values["command"])
        if isinstance(values["command"], Position):
            values.setdefault("controller", controller_named(self.controller, self.rig))
        values.setdefault("x_0", centred_start(built, values["command"], values["duration"]))
        return Experiment.of(rig=built, **values)


def centred_start(rig: Rig, command: Command | Position | str, duration: float) -> float:
    """Compute the start [m] that centres the strokes of a command about mid-stroke, or comes closest to it.

    That of a target is where the target begins.

    The piston goes with the pump's flow, A v = q_b omega/(2 pi), and an unloaded motor without inertia follows its PI
    loop: (k_p + C_e) omega = k_p omega_d + K_i I, dI/dt = omega_d - omega (eqs. 4.2-4.5). Behind a servo valve it goes
    with the valve's flow without a load.
    """
    command = parse_command(command) if isinstance(command, str) else command
    motor, cylinder = rig.motor, rig.cylinder
    dt, half = 0.05, 0.5 * cylinder.L
    if isinstance(command, Position):
        return float(np.clip(command.value_at(np.zeros(())), -half, half))
    area = 0.5 * (cylinder.A_A + cylinder.A_B)
    if rig.valve.spool == "present":
        positions = dt * np.cumsum(command.volts(np.arange(0.0, duration + dt, dt))) * drive_of(rig).largest(1.0) / area
        return float(np.clip(-0.5 * (min(positions.min(), 0.0) + max(positions.max(), 0.0)), -half, half))
    demand = motor.omega_per_volt * command.volts(np.arange(0.0, duration + dt, dt))
    gain = motor.k_p + motor.C_e
    integral = angle = lowest = highest = 0.0
    for omega_d in map(float, demand):
        omega = (motor.k_p * omega_d + motor.K_i * integral) / gain
        integral += dt * (omega_d - omega)
        angle += dt * omega
        lowest, highest = min(lowest, angle), max(highest, angle)
    stroke = rig.pump.q_b / (2.0 * np.pi) / area
    return float(np.clip(-0.5 * stroke * (lowest + highest), -half, half))


def _random(seed: int, name: str) -> np.random.Generator:
    """Make the random stream of one nuisance, which no other nuisance of the profile changes."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def _path(random: np.random.Generator, shapes: tuple[str, ...], duration: float, *, warms: bool = False) -> Wander:
    """Draw a path with a distance of 1 between its extremes: linear, up or down, or wandering."""
    shape = shapes[int(random.integers(len(shapes)))]
    up = random.random() < 0.5 or warms
    weights = random.standard_normal(WANDER_TERMS) / (np.arange(WANDER_TERMS) + 0.5)
    if shape == "linear":
        return Wander((), duration, 1.0 if up else -1.0)
    return Wander(tuple(map(float, weights)), duration).scaled(1.0)


def _drift(random: np.random.Generator, drift: DriftRange, oil: Wander) -> Wander:
    path = _path(random, drift.shapes, oil.duration)
    shape = oil.times(drift.oil).plus(path.times((1.0 - drift.oil**2) ** 0.5)) if drift.oil else path
    return shape.scaled(float(random.uniform(*drift.size)))


def _draw_nuisance(nuisance: Nuisance, seed: int, oil: Wander) -> tuple[dict[str, float], list[ParameterDrift]]:
    """Draw the values (or factors) and drifts of one nuisance."""
    values: dict[str, float] = {}
    drifts: list[ParameterDrift] = []
    for group in [(name,) for name in nuisance.parameters] if nuisance.each else [nuisance.parameters]:
        random = _random(seed, f"{nuisance.name}/{group[0]}" if nuisance.each else nuisance.name)
        value = float(random.uniform(nuisance.low, nuisance.high)) if nuisance.high > nuisance.low else nuisance.low
        values |= dict.fromkeys(group, value)
        if nuisance.drift is not None:
            shape = _drift(random, nuisance.drift, oil)
            drifts += [ParameterDrift(name, shape, nuisance.drift.absolute) for name in group]
    return values, drifts


def draw(
    profile: Profile | str = "bench",
    seed: int = 0,
    *,
    rig: Rig | str = "thesis",
    duration: float = 180.0,
    family: str = "",
) -> BenchMachine:
    """Draw a healthy machine of a rig's kind from a profile (or its name, or its file).

    One seed, one machine.

    `duration` [s] is the record over which the drifts have their sizes; `family`: of the profile, "" for a machine that
    is of none. Raises InputError for a seed below 0, an unknown family, and where a drawn value is out of its
    parameter's range.
    """
    from sealscope.parameters import load_rig

    nuisances = load_profile(profile) if isinstance(profile, str) else profile
    warms = bool(family) and nuisances.family(family).warms
    nuisances = nuisances.of_family(family) if family else nuisances
    base = load_rig(rig)
    if seed < 0:
        raise InputError(f"seed must be >= 0, got {seed}")
    if not (math.isfinite(duration) and duration > 0):
        raise InputError(f"duration must be > 0 s and finite, got {duration}")
    oil = _path(
        _random(seed, "temperature of the oil"), ("linear",) if warms else ("linear", "wander"), duration, warms=True
    )
    overrides: dict[str, float | str] = {}
    drifts: list[ParameterDrift] = []
    for nuisance in nuisances.nuisances:
        if isinstance(nuisance, NuisanceChoice):
            value = nuisance.values[int(_random(seed, nuisance.name).integers(len(nuisance.values)))]
            overrides |= dict.fromkeys(nuisance.parameters, value)
            continue
        values, drifting = _draw_nuisance(nuisance, seed, oil)
        overrides |= {name: float(base[name]) * value for name, value in values.items()} if nuisance.scales else values
        drifts += drifting
    random, duty = _random(seed, "duty"), nuisances.duty

    def one_of(options: Sequence[T]) -> T:
        return options[int(random.integers(len(options)))]

    command, closed = command_or_target(one_of(duty.commands)), one_of(duty.closed)
    overrides |= {"line.closed_A": closed, "line.closed_B": closed}
    if closed > 0:
        overrides["line.orifices"] = "present"
    amplitude = float(random.uniform(*duty.amplitude))
    if amplitude != 1.0:
        command = replace(command, amplitude=command.amplitude * amplitude)  # type: ignore[type-var, union-attr]
    load = parse_force(one_of(duty.loads)) if duty.loads else None
    controller = one_of(duty.controllers) if duty.controllers else "pi"
    return BenchMachine(
        nuisances.name, seed, base, duration, overrides, tuple(drifts), command, closed, load, controller
    )
