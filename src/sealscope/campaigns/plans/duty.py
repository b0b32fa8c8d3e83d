"""Levels and faults of a plan on a rig: closings, targets, controllers, loads and faults as text.

The words are those of `sealscope simulate`: `command` as `--command` (a voltage or a target for the piston),
`controller` as `--controller`, `load` as `--load`.
"""

from __future__ import annotations

import numpy as np

from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.control.registry import CONTROLLERS, check_name, controller_named, is_installed
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.simulation.bench.profile import load_profile
from sealscope.simulation.courses import Position, command_or_target, parse_force, parse_position
from sealscope.simulation.experiment import check_target
from sealscope.simulation.faults import Fault, parse_fault
from sealscope.units import parse_quantity

#: Factors whose levels are the duty of a machine, in the words of the command line.
COMMAND, CONTROLLER, LOAD = "command", "controller", "load"
#: Rate [Hz] at which a target is looked at before any run.
_LOOKED = 50.0


def check_duty(name: str, level: str | float, rig: Rig, duration: float) -> None:
    """Raise InputError for a level of `command`, `controller` or `load` that no run of `duration` [s] can have."""
    examples = {COMMAND: "'3 sin(4t)' or 'position 50 mm sin(2t)'", CONTROLLER: "'pi'", LOAD: "'2 kN'"}
    if not isinstance(level, str):
        raise InputError(f"a {name} must be a text such as {examples[name]}, got {level!r}")
    if name == CONTROLLER and level in CONTROLLERS:
        CONTROLLERS[level](rig)
    elif name == CONTROLLER:
        check_name(level)
    elif name == LOAD:
        parse_force(level)
    elif isinstance(command := command_or_target(level), Position):
        check_target(command, np.arange(0.0, duration, 1.0 / _LOOKED), rig.cylinder.L / 2)


def check_controllers(plan: SimulatedPlan, trust: bool) -> None:
    """Make each of the user's controllers before a campaign begins.

    Raises InputError where one cannot be made, and where one is a program that the plan leads to and the caller does
    not `trust` it: a plan may be hostile. Installed controllers are trusted.
    """
    names = [str(level) for level in plan.factors.get(CONTROLLER, ())]
    if plan.profile:
        profile = load_profile(plan.profile)
        duties = (profile.duty, *(family.duty for family in profile.families))
        names += [name for duty in duties if duty is not None for name in duty.controllers]
    for name in dict.fromkeys(names):
        if not (trust or is_installed(name)):
            raise InputError(
                f"a controller must be installed, or the plan be trusted to run it (--trust, when you have read it), "
                f"got {name} ({plan.place})"
            )
        if name not in CONTROLLERS:
            controller_named(name, plan.rig)


def voltage_in(commands: tuple[str | float, ...]) -> str | None:
    """Find the first of these commands that is no target for a piston, None where all are."""
    return next((str(command) for command in commands if parse_position(str(command)) is None), None)


def closing_values(level: str | float) -> dict[str, str | float]:
    """Compute the rig's parameters for both throttles closed by a share; 0 leaves `line.orifices` unchanged."""
    share = parse_quantity(level, "1") if isinstance(level, str) else float(level)
    if not 0.0 <= share < 1.0:
        raise InputError(f"closed must be 0 to under 100 %, got {level!r}")
    values: dict[str, str | float] = {"line.closed_A": share, "line.closed_B": share}
    return {**values, "line.orifices": "present"} if share > 0 else values


def fault_of(text: str, onset_s: float) -> Fault:
    """Parse a fault other than a piston leak; its onset is the plan's unless the text states one."""
    timed = any(f" {word} " in f" {text} " for word in ("from", "growing"))
    fault = parse_fault(text if timed else f"{text} from {onset_s:g} s")
    if fault is None:
        raise InputError(f"a fault must be one, got {text!r}")
    return fault
