"""What the results of a hold test add to the diagnosis of a recording of a held load."""

from __future__ import annotations

from collections.abc import Sequence

from sealscope.diagnosis.hold.result import HoldResult
from sealscope.diagnosis.verdict.evidence import TotalLeakage
from sealscope.units import BAR

#: Next check where hold tests show a growing leak.
SEPARATE_LEAKS = (
    "Look for oil outside: rod seal, fittings, hoses. If there is none, cap the port of the loaded side at the "
    "cylinder and hold again: if it sinks as before, the piston leaks, else the valve or its line."
)


def describe_holds(holds: Sequence[HoldResult]) -> str:
    """Describe a recording of a held load by the results of its holds."""
    texts = [hold.reason if hold.result is None else f"{hold.result} ({hold.limit}): {hold.reason}" for hold in holds]
    return "a load held by shut valves (`sealscope hold`): " + "; ".join(texts)


def held_leakage(holds: Sequence[HoldResult]) -> TotalLeakage | None:
    """Return the flow out of the loaded chamber in the longest hold; None if its flow or its pressure is unknown."""
    longest = max(holds, key=lambda hold: (hold.end_s or 0.0) - (hold.start_s or 0.0))
    if longest.leak_lpm is None or longest.pressure_bar is None:
        return None
    return TotalLeakage(longest.leak_lpm, longest.leak_interval_lpm, abs(longest.pressure_bar) * BAR)
