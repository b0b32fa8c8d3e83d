"""Severity of a leak: as a flow, as a fraction of the pump's flow, as a piston speed, and over a repair limit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sealscope.diagnosis.priors.verdict import VERDICT
from sealscope.diagnosis.verdict.evidence import LEAK, Evidence, RelativeLeak
from sealscope.diagnosis.verdict.machine import AssumedMachine
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording
from sealscope.units import LITRE_PER_MINUTE, ML_PER_MINUTE, MM_PER_MINUTE, parse_quantity

#: Leak relative to the limit: surely over it ("repair"), surely under half of it ("monitor"), else "plan".
Level = Literal["repair", "plan", "monitor"]
#: A figure with its 95 % interval, None if it is not known.
_Figure = tuple[float, float, float] | None


@dataclass(frozen=True)
class RepairLimit:
    """Leak at which a machine must be repaired.

    Attributes
    ----------
    value : float
        A flow [m^3/s], or the speed at which the piston creeps with its lines shut [m/s].
    kind : {"flow", "creep"}
        Which of the two `value` is.
    stated : bool
        True if the caller gave the limit, False for the default creep speed of `priors.toml`, which applies to any
        piston area.
    """

    value: float
    kind: Literal["flow", "creep"]
    stated: bool

    @classmethod
    def parse(cls, text: str | None) -> RepairLimit:
        """Parse a repair limit such as "5 mL/min" or "8 mm/min"; None gives the default limit.

        Raises InputError unless the text is a positive flow or speed with its unit.
        """
        if text is None:
            return cls(VERDICT.repair.creep * MM_PER_MINUTE, "creep", stated=False)
        for kind, unit in (("flow", "m^3/s"), ("creep", "m/s")):
            try:
                value = parse_quantity(text, unit, name="limit")
            except InputError:
                continue
            has_unit = isinstance(text, str) and any(character.isalpha() for character in text)
            if not (has_unit and value > 0):
                break
            return cls(value, kind, stated=True)  # type: ignore[arg-type]
        raise InputError(f"limit must be a flow or a speed > 0 with its unit, such as 5 mL/min or 8 mm/min, got {text}")

    def __str__(self) -> str:
        if self.kind == "flow":
            return f"{self.value / ML_PER_MINUTE:.3g} mL/min"
        return f"{self.value / MM_PER_MINUTE:.3g} mm/min of creep"

    def flow_lpm(self, area: float | None) -> float | None:
        """Convert the limit to a flow [L/min]; None if it is a speed and the piston's `area` [m^2] is None."""
        if self.kind == "flow":
            return self.value / LITRE_PER_MINUTE
        return None if area is None else self.value * area / LITRE_PER_MINUTE

    def as_dict(self) -> dict[str, Any]:
        """Return the limit as plain values for JSON.

        It is either a flow or a creep speed; the other of the two is None.
        """
        return {
            "mL_per_min": self.value / ML_PER_MINUTE if self.kind == "flow" else None,
            "creep_mm_per_min": self.value / MM_PER_MINUTE if self.kind == "creep" else None,
            "stated": self.stated,
        }


@dataclass(frozen=True)
class Severity:
    """Severity of a leak, as far as it is known.

    Attributes
    ----------
    mL_per_min : tuple of float, or None
        Mean flow while the leak is open [mL/min].
    pump_share : tuple of float, or None
        This flow as a fraction of the pump's mean flow.
    creep_mm_per_min : tuple of float, or None
        Speed at which the piston would creep with its lines shut under the same pressure difference [mm/min].
    of_limit : tuple of float, or None
        The leak divided by the repair limit.

    Each figure is a tuple of value and 95 % interval (value, low, high), or None if it is not known.
    """

    mL_per_min: _Figure
    pump_share: _Figure
    creep_mm_per_min: _Figure
    of_limit: _Figure

    @property
    def level(self) -> Level | None:
        """Urgency of the repair, from the 95 % interval of the leak divided by the repair limit.

        It is "repair" if the whole interval is above the limit, "monitor" if all of it is below half the limit, else
        "plan". It is None if the leak is not known in the limit's unit.
        """
        if self.of_limit is None:
            return None
        _, low, high = self.of_limit
        return "repair" if low > 1.0 else "monitor" if high < VERDICT.repair.watch else "plan"

    def as_dict(self) -> dict[str, Any]:
        """Return the severity as plain values for JSON: `level`, and two entries for each figure.

        The figure has its name, such as `creep_mm_per_min`; its 95 % interval has this name with `_interval` at the
        end. Both are None if unknown.
        """
        plain: dict[str, Any] = {"level": self.level}
        for name in ("mL_per_min", "pump_share", "creep_mm_per_min", "of_limit"):
            figure = getattr(self, name)
            plain[name] = None if figure is None else figure[0]
            plain[f"{name}_interval"] = None if figure is None else list(figure[1:])
        return plain


def severity(evidence: Evidence, limit: RepairLimit) -> Severity | None:
    """Compute the severity of a detected leak relative to a repair limit.

    The result is None if there is no leak or its size is unknown.
    """
    if evidence.verdict != LEAK or (evidence.leak_lpm is None and evidence.relative is None):
        return None
    relative = evidence.relative or RelativeLeak()
    flow_lpm, creep = (evidence.leak_lpm, evidence.leak_interval_lpm), (relative.creep, relative.creep_interval)
    if limit.kind == "flow":
        of_limit = _convert_figure(*flow_lpm, LITRE_PER_MINUTE / limit.value)
    else:
        of_limit = _convert_figure(*creep, 1.0 / limit.value)
    return Severity(
        mL_per_min=_convert_figure(*flow_lpm, LITRE_PER_MINUTE / ML_PER_MINUTE),
        pump_share=_convert_figure(relative.pump_share, relative.pump_share_interval),
        creep_mm_per_min=_convert_figure(*creep, 1.0 / MM_PER_MINUTE),
        of_limit=of_limit,
    )


def relative_leak(evidence: Evidence, recording: Recording, machine: AssumedMachine) -> RelativeLeak | None:
    """Convert a leak in L/min to a fraction of the pump's flow and to a creep speed of the piston.

    `machine` states displacement and piston area. The result is None if no L/min are stated. The fraction is None if
    neither speed nor angle of the pump is recorded.
    """
    if evidence.leak_lpm is None or evidence.leak_interval_lpm is None:
        return None
    flows = LITRE_PER_MINUTE * np.array([evidence.leak_lpm, *evidence.leak_interval_lpm])
    pump_flow = _mean_speed(recording) / (2.0 * math.pi) * machine.displacement
    creep, *creep_ends = (flows / machine.area).tolist()
    share, *share_ends = (flows / pump_flow).tolist() if pump_flow > 0.0 else (None,)
    return RelativeLeak(share, tuple(share_ends) or None, creep, tuple(creep_ends))


def _mean_speed(recording: Recording) -> float:
    """Compute the pump's mean absolute speed [rad/s]; 0 if neither speed nor angle is recorded in SI units."""
    if "omega" in recording and recording.units["omega"] == "rad/s":
        return float(np.nanmean(np.abs(recording["omega"])))
    if "theta" in recording and recording.units["theta"] == "rad" and len(recording) > 1:
        return float(np.nanmean(np.abs(np.diff(recording["theta"])))) * recording.rate
    return 0.0


def _convert_figure(value: float | None, interval: tuple[float, float] | None, factor: float = 1.0) -> _Figure:
    """Multiply a value and its interval by a factor; None if a number is missing or not finite.

    Returns (value, low, high).
    """
    if value is None or interval is None or not all(math.isfinite(number) for number in (value, *interval)):
        return None
    return factor * value, factor * interval[0], factor * interval[1]
