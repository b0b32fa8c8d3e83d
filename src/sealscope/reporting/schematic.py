"""The actuator as a labelled schematic: the template says what is drawn where, this file what is written there."""

from __future__ import annotations

from typing import Any

from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.recordings.recording import CHANNEL_UNITS, Recording
from sealscope.reporting import messages

#: parameter of the rig -> label, unit shown, SI per unit
_VALUES = {
    "cylinder.A_A": ("A_A", "mm²", 1e-6),
    "cylinder.A_B": ("A_B", "mm²", 1e-6),
    "cylinder.L": ("L", "mm", 1e-3),
    "pump.q_b": ("q_b", "cm³/rev", 1e-6),
    "line.d_line": ("d_line", "mm", 1e-3),
    "line.closed_A": ("closed_A", "%", 1e-2),
    "line.closed_B": ("closed_B", "%", 1e-2),
}


def schematic_context(recording: Recording, diagnosis: Diagnosis, rig: Any | None) -> dict[str, Any]:
    """What the schematic's template needs: which sensors recorded, whether oil bypasses the piston, values of the rig.

    `rig`: anything with the attributes of a Rig (`rig.cylinder.A_A` [m^2], `rig.pump.q_b` [m^3/rev]); a value
    that it does not have is not shown.
    """
    leaking = diagnosis.verdict == "leak"
    amount = f"{messages.number(diagnosis.leak_lpm)} L/min" if leaking and diagnosis.leak_lpm is not None else ""
    return {
        "leaking": leaking,
        "leak_label": f"leak {amount}".strip() if leaking else "",
        "recorded": {name: name in recording for name in CHANNEL_UNITS},
        "values": rig_values(rig),
        "verdict": diagnosis.verdict,
    }


def rig_values(rig: Any | None) -> dict[str, str]:
    """The rig's key values with unit, by symbol; an empty text for what the rig does not state."""
    shown = dict.fromkeys((label for label, _, _ in _VALUES.values()), "")
    for dotted, (label, unit, size) in _VALUES.items():
        part: Any = rig
        for name in dotted.split("."):
            part = getattr(part, name, None)
        if isinstance(part, (int, float)) and not isinstance(part, bool):
            shown[label] = f"{messages.number(part / size)} {unit}"
    return shown
