"""The actuator as a labelled schematic after ISO 1219, drawn from the rig: rods, throttles, make-up, or its valve."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from math import sqrt
from typing import Any

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.parameters import Rig
from sealscope.recordings.recording import CHANNEL_UNITS, Recording
from sealscope.reporting import messages, template

#: Parameters of the rig that the page names: symbol, unit shown, SI per unit.
_VALUES = {
    "cylinder.A_A": ("A_A", "mm²", 1e-6),
    "cylinder.A_B": ("A_B", "mm²", 1e-6),
    "cylinder.L": ("L", "mm", 1e-3),
    "pump.q_b": ("q_b", "cm³/rev", 1e-6),
    "line.closed_A": ("closed_A", "%", 1e-2),
    "line.closed_B": ("closed_B", "%", 1e-2),
}
#: Two areas that differ by more have the rod on one side only; by less, two rods that are not quite alike.
_ALIKE = 0.95
#: Height of the cylinder's bore in the drawing, and of a rod whose thickness is not known.
_BORE, _ROD = 78.0, 18.0


@dataclass(frozen=True)
class Circuit:
    """What is drawn of a machine.

    `rods`: the sides that the rod leaves, "A", "B" or "AB"; `rod`: its height in the drawing, of a single rod in
    proportion to the bore: sqrt(1 - A_small / A_large); `throttles`, `make_up`, `bypass`: whether the lines have them;
    `known`: whether a rig says so; `values`: symbol -> value with its unit, "" where it is not known; `valve`: whether
    a servo valve drives it.
    """

    rods: str
    rod: float
    throttles: bool
    make_up: bool
    bypass: bool
    known: bool
    values: dict[str, str]
    valve: bool = False

    @property
    def cylinder(self) -> str:
        """The cylinder in words."""
        return "cylinder" if not self.known else "double-rod cylinder" if self.rods == "AB" else "single-rod cylinder"

    @property
    def text(self) -> str:
        """The circuit in sentences, for who does not see the drawing."""
        if self.valve:
            drive = f"A servo valve joins the chambers A and B of a {self.cylinder} to a supply and a return."
            rod = "" if self.rods == "AB" else f" The rod leaves chamber {self.rods}."
            return f"{drive}{rod} A motor turns the supply's pump at a constant speed."
        parts = ["A servo motor turns a bidirectional pump of fixed displacement."]
        ends = f"Its ports 1 and 2 feed the chambers A and B of a {self.cylinder} through a line each"
        parts.append(f"{ends}, with a one-way throttle in each line." if self.throttles else f"{ends}.")
        if self.rods != "AB":
            parts.append(f"The rod leaves chamber {self.rods}.")
        if self.make_up:
            parts.append("An accumulator feeds each line through a check valve.")
        if self.bypass:
            parts.append("A bypass with needle valve and flow meter joins the two lines.")
        return " ".join(parts)


def circuit_of(rig: Rig | None, recorded: Container[str]) -> Circuit:
    """Return what to draw of a machine: of an unknown one only what every pump-controlled actuator has.

    A bypass is drawn where its flow meter was recorded: no rig states it.
    """
    bypass = "q_leak" in recorded
    if rig is None:
        return Circuit("AB", _ROD, False, False, bypass, False, dict.fromkeys((v[0] for v in _VALUES.values()), ""))
    values = {
        label: f"{messages.number(float(rig[name]) / size)} {unit}" for name, (label, unit, size) in _VALUES.items()
    }
    areas = {"A": rig.cylinder.A_A, "B": rig.cylinder.A_B}
    side = min(areas, key=lambda name: areas[name])
    ratio = areas[side] / max(areas.values())
    throttles = rig.line.orifices == "present" or max(rig.line.closed_A, rig.line.closed_B) > 0
    make_up = rig.makeup.check_valves == "present"
    valve = rig.valve.spool == "present"
    if ratio > _ALIKE:
        return Circuit("AB", _ROD, throttles, make_up, bypass, True, values, valve)
    rod = round(min(0.8, sqrt(1.0 - ratio)) * _BORE, 1)
    return Circuit(side, rod, throttles, make_up, bypass, True, values, valve)


def schematic(recording: Recording, diagnosis: Diagnosis, circuit: Circuit) -> str:
    """Return the drawing as SVG: which sensors recorded and under which name, whether oil bypasses the piston."""
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
    """Return channel -> the column of the file that it was read from, where the file has a name of its own for it."""
    columns: Any = recording.provenance.get("columns")
    if not isinstance(columns, dict):
        return {}
    return {str(name): str(column)[:60] for name, column in columns.items() if name in recording}
