"""The variables of a functional mock-up unit (FMU): inputs, parameters and outputs, with units and descriptions."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from importlib.resources import files
from operator import attrgetter
from typing import Any, Literal, NamedTuple

from sealscope.emit.stream_program import RESULT_UNITS
from sealscope.parameters import Rig
from sealscope.parameters.fields import absent_of, iter_fields, unit_of
from sealscope.physics.rig import VALUES as NAMES_OF_VALUES
from sealscope.physics.state import OUTPUTS
from sealscope.recordings.channels import CHANNEL_UNITS, LONG_NAMES

#: Parameters of an FMU in the order of its code: those of the equations, then those from which numbers are derived.
VALUES = tuple(NAMES_OF_VALUES.values())
_TABLES: dict[str, Any] = tomllib.loads((files("sealscope.fmu") / "variables.toml").read_text("utf-8"))
#: (unit, description) of inputs and outputs of a rig's FMU, and of a soft sensor's outputs, in the code's order.
INPUTS: Mapping[str, tuple[str, str]] = _TABLES["inputs"]
RESULTS: Mapping[str, tuple[str, str]] = {
    **{name: _TABLES["outputs"].get(name) or (CHANNEL_UNITS[name], LONG_NAMES[name]) for name in OUTPUTS},
    **_TABLES["powers"],
}
SENSOR_RESULTS: Mapping[str, tuple[str, str]] = RESULT_UNITS
#: The inputs on which an output depends without delay.
DIRECT: Mapping[str, list[str]] = _TABLES["direct"]
#: First value reference of each kind of variable.
REFERENCES: Mapping[str, int] = _TABLES["references"]
#: Outputs of the servo valve, which no FMU has.
_VALVE_OUTPUTS = ("x_s", "v_s")


class Variable(NamedTuple):
    """A variable of an FMU as in the FMI standard; `unit`: an SI unit; `start`: initial value, None for outputs."""

    reference: int
    name: str
    causality: Literal["input", "parameter", "output"]
    variability: Literal["continuous", "tunable", "fixed"]
    unit: str
    description: str
    start: float | None


def input_variables(rows: Mapping[str, tuple[str, str]]) -> Iterator[Variable]:
    """Yield the input variables of an FMU, with the initial value 0. `rows`: (unit, description) of each, by name."""
    for k, (name, (unit, description)) in enumerate(rows.items()):
        yield Variable(REFERENCES["input"] + k, name, "input", "continuous", unit, description, start=0.0)


def output_variables(rows: Mapping[str, tuple[str, str]]) -> Iterator[Variable]:
    """Yield the output variables of an FMU, without a servo valve's. `rows`: (unit, description) of each, by name."""
    for k, (name, (unit, description)) in enumerate(rows.items()):  # k: index in the code's results, valve included
        if name not in _VALVE_OUTPUTS:
            yield Variable(REFERENCES["result"] + k, name, "output", "continuous", unit, description, start=None)


def rig_variable(rig: Rig, name: str, variability: Literal["tunable", "fixed"]) -> Variable | None:
    """Make the FMU variable of a rig's parameter, such as "pump.q_b"; None if the rig lacks the part it describes."""
    value = float(attrgetter(name)(rig))
    field = dict(iter_fields(Rig))[name]
    if value == absent_of(field):  # the value that stands for an absent part
        return None
    reference, description = REFERENCES["value"] + VALUES.index(name), str(field.title or name)
    return Variable(reference, name, "parameter", variability, unit_of(field), description, value)


def variables(rig: Rig, step: float) -> Iterator[Variable]:
    """Yield all variables of the FMU that simulates a rig; `step` [s]: longest step of its solver."""
    yield from input_variables(INPUTS)
    yield from filter(None, (rig_variable(rig, name, "tunable") for name in VALUES))
    reference, description = REFERENCES["start_position"], "piston position at the start, from mid-stroke"
    yield Variable(reference, "start_position", "parameter", "fixed", "m", description, 0.0)
    yield Variable(REFERENCES["step"], "step", "parameter", "fixed", "s", "longest step of the solver", step)
    yield from output_variables(RESULTS)
