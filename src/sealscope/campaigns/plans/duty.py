"""What a plan's levels and faults mean on a rig: throttle closings and faults as text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.simulation.faults import Fault


def closing_values(level: str | float) -> dict[str, str | float]:
    """Return the rig's parameters for both throttles closed by a share; 0 leaves `line.orifices` as it is."""
    from sealscope.units import parse_quantity

    share = parse_quantity(level, "1") if isinstance(level, str) else float(level)
    if not 0.0 <= share < 1.0:
        raise InputError(f"closed must be 0 to under 100 %, got {level!r}")
    values: dict[str, str | float] = {"line.closed_A": share, "line.closed_B": share}
    return {**values, "line.orifices": "present"} if share > 0 else values


def fault_of(text: str, onset_s: float) -> Fault:
    """Parse a fault other than a piston leak; it sets in at the plan's onset unless the text says when."""
    from sealscope.simulation.faults import parse_fault

    timed = any(f" {word} " in f" {text} " for word in ("from", "growing"))
    fault = parse_fault(text if timed else f"{text} from {onset_s:g} s")
    if fault is None:
        raise InputError(f"a fault must be one, got {text!r}")
    return fault
