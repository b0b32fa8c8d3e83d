"""The variables of a unit: inputs, tunable parameters and outputs, with units and words."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from importlib.resources import files
from operator import attrgetter
from typing import Any, Literal, NamedTuple

from sealscope.parameters import Rig
from sealscope.parameters.fields import absent_of, leaves, unit_of
from sealscope.physics.rig import VALUES as NAMES_OF_VALUES
from sealscope.physics.state import OUTPUTS
from sealscope.recordings.channels import CHANNEL_UNITS, LONG_NAMES

#: Parameters of a unit in the order of its code: those that the laws take, and those that their numbers follow from.
VALUES = tuple(NAMES_OF_VALUES.values())
_TABLES: dict[str, Any] = tomllib.loads((files("sealscope.fmu") / "variables.toml").read_text("utf-8"))
#: Inputs, outputs and a soft sensor's outputs in the order of the code: unit, words.
INPUTS: Mapping[str, tuple[str, str]] = _TABLES["inputs"]
RESULTS: Mapping[str, tuple[str, str]] = {
    **{name: _TABLES["outputs"].get(name) or (CHANNEL_UNITS[name], LONG_NAMES[name]) for name in OUTPUTS},
    **_TABLES["powers"],
}
SENSOR_RESULTS: Mapping[str, tuple[str, str]] = _TABLES["sensor"]
#: The inputs that an output follows without delay.
DIRECT: Mapping[str, list[str]] = _TABLES["direct"]
#: Where the references of a kind of variable begin.
REFERENCES: Mapping[str, int] = _TABLES["references"]
#: Outputs of laws that no unit has.
_NONE = ("x_s", "v_s")


class Variable(NamedTuple):
    """A variable of a unit, in the words of FMI; `start` in SI units, None for what the unit computes."""

    reference: int
    name: str
    causality: Literal["input", "parameter", "output"]
    variability: Literal["continuous", "tunable", "fixed"]
    unit: str
    description: str
    start: float | None


def inputs(rows: Mapping[str, tuple[str, str]]) -> Iterator[Variable]:
    """Yield inputs of these units and words, by name."""
    for k, (name, (unit, words)) in enumerate(rows.items()):
        yield Variable(REFERENCES["input"] + k, name, "input", "continuous", unit, words, 0.0)


def outputs(rows: Mapping[str, tuple[str, str]]) -> Iterator[Variable]:
    """Yield outputs of these units and words, by name."""
    for k, (name, (unit, words)) in enumerate(rows.items()):
        if name not in _NONE:
            yield Variable(REFERENCES["result"] + k, name, "output", "continuous", unit, words, None)


def parameter(rig: Rig, name: str, variability: Literal["tunable", "fixed"]) -> Variable | None:
    """Describe a parameter of a rig as a variable; None for one without a law in the unit."""
    value, field = float(attrgetter(name)(rig)), dict(leaves(Rig))[name]
    reference, words = REFERENCES["value"] + VALUES.index(name), str(field.title or name)
    absent = value == absent_of(field)
    return None if absent else Variable(reference, name, "parameter", variability, unit_of(field), words, value)


def variables(rig: Rig, step: float) -> Iterator[Variable]:
    """Yield the variables of a rig's unit; `step` [s]: the longest of its solver."""
    yield from inputs(INPUTS)
    yield from filter(None, (parameter(rig, name, "tunable") for name in VALUES))
    reference, words = REFERENCES["start_position"], "piston position at the start, from mid-stroke"
    yield Variable(reference, "start_position", "parameter", "fixed", "m", words, 0.0)
    yield Variable(REFERENCES["step"], "step", "parameter", "fixed", "s", "longest step of the solver", step)
    yield from outputs(RESULTS)
