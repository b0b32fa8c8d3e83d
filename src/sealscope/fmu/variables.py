"""The variables of a unit: what goes in, what can be tuned, what comes out, with units and words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from operator import attrgetter
from typing import Literal

from sealscope.parameters import Rig
from sealscope.parameters.fields import absent_of, leaves, unit_of
from sealscope.physics.rig import DERIVED_FROM, PARAMETERS
from sealscope.physics.state import OUTPUTS
from sealscope.recordings.channels import CHANNEL_UNITS, LONG_NAMES

#: Parameters of a unit in the order of its code: those that the laws take, and those that their numbers follow from.
VALUES = tuple(dict.fromkeys((*PARAMETERS.values(), *DERIVED_FROM)))
#: Inputs in the order of the code: unit, words.
INPUTS = {
    "u": ("V", "command of the servo drive"),
    "G": ("m^3/(s Pa)", "leakage across the piston: conductance of a laminar leak, Q = G (p_A - p_B)"),
    "C": ("m^3/(s Pa^0.5)", "leakage across the piston: coefficient of an orifice, Q = C sqrt(p_A - p_B)"),
    "F": ("N", "load against +x, beside that of the rig"),
    "G_ext_A": ("m^3/(s Pa)", "leakage outwards at chamber A, beside that of the rig"),
    "G_ext_B": ("m^3/(s Pa)", "leakage outwards at chamber B, beside that of the rig"),
}
#: Powers that follow from the outputs.
POWERS = {
    "P_electric": ("W", "electrical power into the motor, V i"),
    "P_hydraulic": ("W", "hydraulic power of the pump, Q_1 (p_1 - p_2)"),
    "P_mechanical": ("W", "mechanical power of the pressures on the piston, (p_A A_A - p_B A_B) v"),
}
_OF_STATES = {
    "I": ("rad", "integral of the speed controller"),
    "i": ("A", "winding current"),
    "v": ("m/s", "piston velocity"),
    "V_up": ("m^3", "oil that the make-up has fed"),
    "z": ("m", "deflection of the bristles of LuGre's friction"),
    "x_s": ("m", "position of a servo valve's spool"),
    "v_s": ("m/s", "speed of a servo valve's spool"),
    "Q_1": ("m^3/s", "flow of the pump into port 1"),
    "Q_A": ("m^3/s", "flow into chamber A"),
    "Q_B": ("m^3/s", "flow out of chamber B"),
    "V": ("V", "winding voltage"),
    "q_ext": ("m^3/s", "leakage outwards"),
    "q_up": ("m^3/s", "flow that the make-up feeds"),
}
#: Outputs in the order of the code: unit, words.
RESULTS = {name: _OF_STATES.get(name) or (CHANNEL_UNITS[name], LONG_NAMES[name]) for name in OUTPUTS} | POWERS
#: Outputs of laws that no unit has.
_NONE = ("x_s", "v_s")
#: Where the references of a kind of variable begin.
INPUT_BASE, VALUE_BASE, RESULT_BASE, START_POSITION, STEP = 1, 1000, 2000, 3000, 3001


@dataclass(frozen=True)
class Variable:
    """A variable of a unit, in the words of FMI; `start` in SI units, None for what the unit computes."""

    reference: int
    name: str
    causality: Literal["input", "parameter", "output"]
    variability: Literal["continuous", "tunable", "fixed"]
    unit: str
    description: str
    start: float | None


def variables(rig: Rig, step: float) -> Iterator[Variable]:
    """Yield the variables of a rig's unit; `step` [s]: the longest of its solver."""
    for k, (name, (unit, words)) in enumerate(INPUTS.items()):
        yield Variable(INPUT_BASE + k, name, "input", "continuous", unit, words, 0.0)
    declared = dict(leaves(Rig))
    for k, name in enumerate(VALUES):
        value, field = attrgetter(name)(rig), declared[name]
        if value != absent_of(field):  # what is absent has no law in the unit
            yield Variable(
                VALUE_BASE + k, name, "parameter", "tunable", unit_of(field), str(field.title or name), value
            )
    yield Variable(
        START_POSITION,
        "start_position",
        "parameter",
        "fixed",
        "m",
        "piston position at the start, from mid-stroke",
        0.0,
    )
    yield Variable(STEP, "step", "parameter", "fixed", "s", "longest step of the solver", step)
    for k, (name, (unit, words)) in enumerate(RESULTS.items()):
        if name in _NONE:
            continue
        yield Variable(RESULT_BASE + k, name, "output", "continuous", unit, words, None)
