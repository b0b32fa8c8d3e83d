"""Draw the actuator as a schematic with symbols of ISO 1219: cylinder, rods, throttles, make-up and servo valve."""

from __future__ import annotations

from collections.abc import Container, Mapping
from math import sqrt
from typing import Any, NamedTuple

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.machine_sizes import AssumedMachine
from sealscope.parameters import Rig
from sealscope.recordings.recording import CHANNEL_UNITS, Recording
from sealscope.reporting import messages, template

#: By label in the drawing: parameter of the rig, its display unit, and the size of that unit in SI.
_VALUES = {
    "A_A": ("cylinder.A_A", "mm²", 1e-6),
    "A_B": ("cylinder.A_B", "mm²", 1e-6),
    "L": ("cylinder.L", "mm", 1e-3),
    "q_b": ("pump.q_b", "cm³/rev", 1e-6),
    "closed_A": ("line.closed_A", "%", 1e-2),
    "closed_B": ("line.closed_B", "%", 1e-2),
}
#: Smallest ratio of the areas of a double-rod cylinder: they differ by 10 % of their mean, as in `Cylinder.single_rod`.
_MIN_DOUBLE_ROD_RATIO = 0.95 / 1.05
#: Height of the cylinder's bore in the drawing, and of a rod of unknown diameter.
_BORE, _ROD = 78.0, 18.0


class Circuit(NamedTuple):
    """The parts of a machine that the schematic shows.

    `cylinder`: name of its type; `rods`: sides of the piston with a rod, "A", "B" or "AB"; `rod`: drawn rod height;
    `throttles`, `make_up`, `bypass`, `valve`: whether there are throttles in the lines, make-up valves, a bypass with a
    flow meter, a servo valve; `values`: by label, the value with its unit, "" if unknown.
    """

    cylinder: str
    rods: str
    rod: float
    throttles: bool
    make_up: bool
    bypass: bool
    valve: bool
    values: dict[str, str]


def build_circuit(rig: Rig | None, recorded: Container[str], machine: AssumedMachine | None = None) -> Circuit:
    """Choose the parts of a machine to draw in the schematic, of which channels are `recorded`.

    Without `rig`, these are the parts of every pump-controlled actuator, labelled with the sizes that `machine` states.
    """
    bypass = "q_leak" in recorded
    values = dict.fromkeys(_VALUES, "")
    if rig is None:
        cylinder: tuple[str, str, float] = ("cylinder", "AB", _ROD)
        if machine is not None and machine.area_stated and machine.areas is not None:
            cylinder = _cylinder_parts(machine.areas)
            values["A_A"], values["A_B"] = (_value_text(area, "mm²", scale=1e-6) for area in machine.areas)
        if machine is not None and machine.displacement_stated:
            values["q_b"] = _value_text(machine.displacement, "cm³/rev", scale=1e-6)
        return Circuit(*cylinder, throttles=False, make_up=False, bypass=bypass, valve=False, values=values)
    return Circuit(
        *_cylinder_parts((rig.cylinder.A_A, rig.cylinder.A_B)),
        throttles=rig.line.orifices == "present" or max(rig.line.closed_A, rig.line.closed_B) > 0,
        make_up=rig.makeup.check_valves != "absent",
        bypass=bypass,
        valve=rig.circuit.valve_controlled,
        values={label: _value_text(float(rig[name]), unit, scale) for label, (name, unit, scale) in _VALUES.items()},
    )


def _cylinder_parts(areas: tuple[float, float]) -> tuple[str, str, float]:
    """Determine the type of a cylinder, its sides with a rod ("A", "B" or "AB"), and the drawn height of the rod.

    The height of a single rod over that of the bore is the ratio of their diameters, sqrt(1 - smaller/larger area).
    """
    ratio = min(areas) / max(areas)
    if ratio >= _MIN_DOUBLE_ROD_RATIO:
        return "double-rod cylinder", "AB", _ROD
    rod = round(min(0.8, sqrt(1.0 - ratio)) * _BORE, 1)  # at most 0.8 of the bore, so that both remain visible
    return "single-rod cylinder", "A" if areas[0] <= areas[1] else "B", rod


def _value_text(value: float, unit: str, scale: float) -> str:
    """Format a value in SI with four significant digits in `unit`, whose size in SI is `scale`."""
    return f"{messages.number(value / scale, 4)} {unit}"


def schematic(recording: Recording, diagnosis: Diagnosis, circuit: Circuit) -> str:
    """Draw the schematic of a machine as SVG, with its sensors, their columns in the file, and the leak if any."""
    leaking = diagnosis.verdict == "leak"
    amount = f"{messages.number(diagnosis.leak_lpm)} L/min" if leaking and diagnosis.leak_lpm is not None else ""
    leak_label = f"leak {amount}".strip() if leaking else ""
    return draw_circuit(circuit, recording.channels, channel_columns(recording), diagnosis.verdict, leak_label)


def draw_circuit(
    circuit: Circuit,
    recorded: Container[str],
    columns: Mapping[str, str] | None = None,
    verdict: str = "",
    leak_label: str = "",
) -> str:
    """Draw a machine as SVG: its parts, its sensors by the channels that are `recorded`, and their `columns` in a file.

    `verdict`: words of the seal's state, "" for none; `leak_label`: words of the leak if the verdict is "leak". Each
    sensor has its channel as the attribute `data-channel`.
    """
    return template.render(
        "schematic.svg.j2",
        leaking=verdict == "leak",
        leak_label=leak_label,
        recorded={name: name in recorded for name in CHANNEL_UNITS},
        column=columns or {},
        c=circuit,
        values=circuit.values,
        verdict=verdict,
    )


def channel_columns(recording: Recording) -> dict[str, str]:
    """Return the name (up to 60 characters) of each channel's column in the file; {} if it is not stated."""
    columns: Any = recording.provenance.get("columns")
    if not isinstance(columns, dict):
        return {}
    return {str(name): str(column)[:60] for name, column in columns.items() if name in recording}
