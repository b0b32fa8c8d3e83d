"""Check the levels (values) of a plan's factors, its controllers and its faults, and parse them.

A text has the same form as the option of `sealscope simulate` with the same name, such as `--command` or `--load`.
"""

from __future__ import annotations

import numpy as np

from sealscope.campaigns.plans.model import SimulatedPlan
from sealscope.control.registry import CONTROLLERS, check_controller_name, controller_named, is_installed
from sealscope.errors import InputError
from sealscope.simulation.experiment import check_target, throttle_values
from sealscope.simulation.faults import Fault, parse_fault
from sealscope.simulation.targets_and_loads import Position, command_or_target, parse_force
from sealscope.units import parse_quantity

#: Names of the factors that are no parameters of the rig.
CLOSED, COMMAND, CONTROLLER, FAMILY, LOAD = "closed", "command", "controller", "family", "load"
#: Label of all families together in the tables of a campaign.
ALL_FAMILIES = "all"
#: Rate [Hz] at which a target is sampled to check that the piston can reach it.
_TARGET_CHECK_RATE = 50.0


def check_level(plan: SimulatedPlan, name: str, level: str | float) -> None:
    """Check that `level` is a valid value of the factor `name` of a plan; raise InputError otherwise.

    A built-in controller must fit the rig; of others, only the name is checked.
    """
    examples = {COMMAND: "'3 sin(4t)' or 'position 50 mm sin(2t)'", CONTROLLER: "'pi'", LOAD: "'2 kN'"}
    if name in examples and not isinstance(level, str):
        raise InputError(f"a {name} must be a text such as {examples[name]}, got {level!r}")
    text = str(level)
    if name == FAMILY:
        if plan.machine_profile is None:
            raise InputError(f"a family needs a profile that defines it, got {level!r} in a plan without profile")
        plan.machine_profile.family(text)
        if text == ALL_FAMILIES:
            raise InputError(f"a family must not be called {text!r}, which stands for all families in the tables")
    elif name == CONTROLLER and text in CONTROLLERS:
        CONTROLLERS[text](plan.rig)  # raises if the controller does not fit the rig
    elif name == CONTROLLER:
        check_controller_name(text)
    elif name == LOAD:
        parse_force(text)
    elif name == COMMAND:
        command = command_or_target(text)
        if isinstance(command, Position):
            times = np.arange(0.0, plan.duration_s, 1.0 / _TARGET_CHECK_RATE)
            check_target(command, times, plan.rig.cylinder.L / 2)  # the position is 0 at mid-stroke
    else:  # a parameter of the rig, or the closed fraction of its throttles
        plan.rig.with_overrides(parse_throttle_values(level) if name == CLOSED else {name: level})


def check_controllers(plan: SimulatedPlan, trust: bool) -> None:
    """Check that every controller of a plan is trusted, and that those not built in can be built for the plan's rig.

    A plan may be hostile, so code that it names (`FILE.py:NAME`, `MODULE:NAME`) is run only if `trust` is True;
    built-in and installed controllers are trusted. Raises InputError otherwise.
    """
    names = [str(level) for level in plan.factors.get(CONTROLLER, ())]
    if plan.machine_profile is not None:
        duties = (plan.machine_profile.duty, *(family.duty for family in plan.machine_profile.families))
        names += [name for duty in duties if duty is not None for name in duty.controllers]
    for name in dict.fromkeys(names):
        if not (trust or is_installed(name)):
            raise InputError(
                f"a controller must be installed, or the plan must be trusted (--trust, after reading its code), "
                f"got {name} ({plan.place})"
            )
        if name not in CONTROLLERS:
            controller_named(name, plan.rig)


def parse_throttle_values(level: str | float) -> dict[str, str | float]:
    """Parse a closed fraction of the throttles, 0.25 or '25 %', to the parameters of a rig (`throttle_values`).

    Raises InputError for a fraction < 0 or >= 1.
    """
    fraction = parse_quantity(level, "1") if isinstance(level, str) else float(level)
    if not 0.0 <= fraction < 1.0:
        raise InputError(f"closed must be 0 to under 100 %, got {level!r}")
    return throttle_values(fraction)


def parse_plan_fault(text: str, onset_s: float) -> Fault:
    """Parse the text of a fault other than a piston leak, such as "pump leak x3", which starts at `onset_s` [s].

    The text may state another time, as in "pump leak x3 from 20 s". Raises InputError if it names no fault.
    """
    # a time is stated as "from 20 s" or "growing from 20 s to 60 s"
    has_time = any(f" {word} " in f" {text} " for word in ("from", "growing"))
    fault = parse_fault(text if has_time else f"{text} from {onset_s:g} s")
    if fault is None:
        raise InputError(f"a fault must be named, such as 'pump leak x3', got {text!r}")
    return fault
