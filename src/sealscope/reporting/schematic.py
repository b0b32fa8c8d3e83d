"""The actuator as a labelled schematic after ISO 1219, drawn from the rig: rods, throttles, make-up, or its valve."""

from __future__ import annotations

from collections.abc import Container
from math import sqrt
from typing import Any, NamedTuple

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.machine import AssumedMachine
from sealscope.parameters import Rig
from sealscope.recordings.recording import CHANNEL_UNITS, Recording
from sealscope.reporting import messages, template

#: Values of the rig that the page names: parameter, unit shown, SI per unit.
_VALUES = {
    "A_A": ("cylinder.A_A", "mm²", 1e-6),
    "A_B": ("cylinder.A_B", "mm²", 1e-6),
    "L": ("cylinder.L", "mm", 1e-3),
    "q_b": ("pump.q_b", "cm³/rev", 1e-6),
    "closed_A": ("line.closed_A", "%", 1e-2),
    "closed_B": ("line.closed_B", "%", 1e-2),
}
#: Two areas that differ by more have the rod on one side only; by less, two rods that are not quite alike.
_ALIKE = 0.95
#: Height of the cylinder's bore in the drawing, and of a rod whose thickness is not known.
_BORE, _ROD = 78.0, 18.0


class Circuit(NamedTuple):
    """The drawn parts of a machine.

    `cylinder`: its kind in words; `rods`: the sides that the rod leaves, "A", "B" or "AB"; `rod`: its height in the
    drawing, of a single rod in proportion to the bore: sqrt(1 - A_small / A_large); `throttles`, `make_up`, `bypass`:
    whether the lines have them; `valve`: whether a servo valve drives it; `values`: symbol -> value with its unit, ""
    where it is not known.
    """

    cylinder: str
    rods: str
    rod: float
    throttles: bool
    make_up: bool
    bypass: bool
    valve: bool
    values: dict[str, str]


def circuit_of(rig: Rig | None, recorded: Container[str], machine: AssumedMachine | None = None) -> Circuit:
    """Choose the parts to draw; of an unknown machine only those of every pump-controlled actuator.

    `machine`: what is stated of one without a rig. A bypass is drawn where its flow meter was recorded.
    """
    bypass, values = "q_leak" in recorded, dict.fromkeys(_VALUES, "")
    if rig is None:
        cylinder: tuple[str, str, float] = ("cylinder", "AB", _ROD)
        if machine is not None and machine.area_stated and machine.areas is not None:
            cylinder = _cylinder_of(machine.areas)
            values["A_A"], values["A_B"] = (_value_text(area, "mm²", 1e-6) for area in machine.areas)
        if machine is not None and machine.displacement_stated:
            values["q_b"] = _value_text(machine.displacement, "cm³/rev", 1e-6)
        return Circuit(*cylinder, False, False, bypass, False, values)
    return Circuit(
        *_cylinder_of((rig.cylinder.A_A, rig.cylinder.A_B)),
        throttles=rig.line.orifices == "present" or max(rig.line.closed_A, rig.line.closed_B) > 0,
        make_up=rig.makeup.check_valves != "absent",
        bypass=bypass,
        valve=rig.valve.spool == "present",
        values={label: _value_text(float(rig[name]), unit, size) for label, (name, unit, size) in _VALUES.items()},
    )


def _cylinder_of(areas: tuple[float, float]) -> tuple[str, str, float]:
    """Return kind, sides of the rod and its height in the drawing of a cylinder with areas of sides A and B."""
    ratio = min(areas) / max(areas)
    if ratio > _ALIKE:
        return "double-rod cylinder", "AB", _ROD
    rod = round(min(0.8, sqrt(1.0 - ratio)) * _BORE, 1)
    return "single-rod cylinder", "A" if areas[0] <= areas[1] else "B", rod


def _value_text(value: float, unit: str, size: float) -> str:
    """Return a value in its unit, with the digits that a data sheet states."""
    return f"{messages.number(value / size, 4)} {unit}"


def schematic(recording: Recording, diagnosis: Diagnosis, circuit: Circuit) -> str:
    """Draw the machine as SVG: the sensors with their column names, and the oil that bypasses the piston."""
    leaking = diagnosis.verdict == "leak"
    amount = f"{messages.number(diagnosis.leak_lpm)} L/min" if leaking and diagnosis.leak_lpm is not None else ""
    return template.render(
        "schematic.svg.j2",
        leaking=leaking,
        leak_label=f"leak {amount}".strip() if leaking else "",
        recorded={name: name in recording for name in CHANNEL_UNITS},
        column=columns_of(recording),
        c=circuit,
        values=circuit.values,
        verdict=diagnosis.verdict,
    )


def columns_of(recording: Recording) -> dict[str, str]:
    """Map each channel to its column in the file, if the file names it differently."""
    columns: Any = recording.provenance.get("columns")
    if not isinstance(columns, dict):
        return {}
    return {str(name): str(column)[:60] for name, column in columns.items() if name in recording}
