"""Severity of a leak: as a flow, relative to the pump's flow, as a piston speed, and against a repair limit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import LEAK, Evidence, RelativeLeak
from sealscope.diagnosis.verdict.machine import AssumedMachine
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording
from sealscope.units import LITRE_PER_MINUTE, ML_PER_MINUTE, MM_PER_MINUTE, parse_quantity

#: How much of the limit a leak takes: surely all of it, maybe half of it or more, surely less than half of it.
Level = Literal["repair", "plan", "monitor"]
#: A figure with its 95 % interval, None where it is not known.
_Figure = tuple[float, float, float] | None


@dataclass(frozen=True)
class RepairLimit:
    """Leak from which a machine is to be repaired.

    By default the creep of `priors.toml`: as a speed it holds for a piston of any area.

    `value`: flow [m^3/s], or speed at which the piston creeps with its lines shut [m/s], by `kind`; `stated` by the
    caller.
    """

    value: float
    kind: Literal["flow", "creep"]
    stated: bool

    @classmethod
    def of(cls, text: str | None) -> RepairLimit:
        """Parse a repair limit, a flow or a speed with its unit; the default one for None."""
        if text is None:
            return cls(priors("verdict")["repair"]["creep"] * MM_PER_MINUTE, "creep", stated=False)
        for kind, unit in (("flow", "m^3/s"), ("creep", "m/s")):
            try:
                value = parse_quantity(text, unit, name="limit")
            except InputError:
                continue
            if not isinstance(text, str) or not any(sign.isalpha() for sign in text) or not value > 0:
                break
            return cls(value, kind, stated=True)  # type: ignore[arg-type]
        raise InputError(f"limit must be a flow or a speed > 0 with its unit, such as 5 mL/min or 8 mm/min, got {text}")

    def __str__(self) -> str:
        if self.kind == "flow":
            return f"{self.value / ML_PER_MINUTE:.3g} mL/min"
        return f"{self.value / MM_PER_MINUTE:.3g} mm/min of creep"

    def as_dict(self) -> dict[str, Any]:
        """Return the limit as plain JSON values; the kind not stated is null."""
        return {
            "mL_per_min": self.value / ML_PER_MINUTE if self.kind == "flow" else None,
            "creep_mm_per_min": self.value / MM_PER_MINUTE if self.kind == "creep" else None,
            "stated": self.stated,
        }


@dataclass(frozen=True)
class Severity:
    """Severity of a leak, as far as recording and machine tell.

    Each figure is None, where it is not known, or the figure and its 95 % interval: `mL_per_min`, mean flow while the
    leak is open; `pump_share`, that flow over the pump's mean flow; `creep_mm_per_min`, the speed at which the piston
    would creep with its lines shut under the same pressure difference; `of_limit`, the leak over the repair limit.
    """

    mL_per_min: _Figure
    pump_share: _Figure
    creep_mm_per_min: _Figure
    of_limit: _Figure

    @property
    def level(self) -> Level | None:
        """Level by the interval: `repair` if all over the limit, `monitor` if all under half of it.

        Else `plan`; None where the leak cannot be held against the limit.
        """
        if self.of_limit is None:
            return None
        _, low, high = self.of_limit
        return "repair" if low > 1.0 else "monitor" if high < 0.5 else "plan"

    def as_dict(self) -> dict[str, Any]:
        """Return the severity as plain JSON values: each figure, its `_interval`, and the level."""
        plain: dict[str, Any] = {"level": self.level}
        for name in ("mL_per_min", "pump_share", "creep_mm_per_min", "of_limit"):
            figure = getattr(self, name)
            plain[name] = None if figure is None else figure[0]
            plain[f"{name}_interval"] = None if figure is None else list(figure[1:])
        return plain


def severity(evidence: Evidence, limit: RepairLimit) -> Severity | None:
    """Compute the severity of the leak in the evidence; None without a leak, or without its size."""
    if evidence.verdict != LEAK or (evidence.leak_lpm is None and evidence.relative is None):
        return None
    relative = evidence.relative or RelativeLeak()
    flow = _figure(evidence.leak_lpm, evidence.leak_interval_lpm, LITRE_PER_MINUTE)
    creep = _figure(relative.creep, relative.creep_interval)
    return Severity(
        mL_per_min=_over(flow, ML_PER_MINUTE),
        pump_share=_figure(relative.pump_share, relative.pump_share_interval),
        creep_mm_per_min=_over(creep, MM_PER_MINUTE),
        of_limit=_over(flow if limit.kind == "flow" else creep, limit.value),
    )


def beside_the_pump(evidence: Evidence, recording: Recording, machine: AssumedMachine) -> RelativeLeak | None:
    """Compare a leak of a stated L/min with the assumed pump's flow; compute its speed of the assumed piston.

    None where no L/min is stated; without the share of the pump where neither its speed nor its angle is recorded.
    """
    if evidence.leak_lpm is None or evidence.leak_interval_lpm is None:
        return None
    ends = LITRE_PER_MINUTE * np.array([evidence.leak_lpm, *evidence.leak_interval_lpm])
    pump = _mean_speed(recording) / (2.0 * math.pi) * machine.displacement
    creep, *creeps = (ends / machine.area).tolist()
    share, *shares = (ends / pump).tolist() if pump > 0.0 else (None,)
    return RelativeLeak(share, tuple(shares) or None, creep, tuple(creeps))


def _mean_speed(recording: Recording) -> float:
    """Return the mean size of the pump's speed [rad/s], 0 where it is not recorded in its unit."""
    if "omega" in recording and recording.units["omega"] == "rad/s":
        return float(np.nanmean(np.abs(recording["omega"])))
    if "theta" in recording and recording.units["theta"] == "rad" and len(recording) > 1:
        return float(np.nanmean(np.abs(np.diff(recording["theta"])))) * recording.rate
    return 0.0


def _figure(value: float | None, interval: tuple[float, float] | None, factor: float = 1.0) -> _Figure:
    """Return a figure with its interval, times a factor; None where a number is missing or infinite."""
    if value is None or interval is None or not all(math.isfinite(number) for number in (value, *interval)):
        return None
    return factor * value, factor * interval[0], factor * interval[1]


def _over(figure: _Figure, unit: float) -> _Figure:
    return figure and (figure[0] / unit, figure[1] / unit, figure[2] / unit)
