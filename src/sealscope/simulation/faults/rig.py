"""Faults of the machine other than a leak across the piston, each by a law of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.changes.drifts import GROUPS
from sealscope.simulation.changes.rig import Effect
from sealscope.simulation.commands import number_text
from sealscope.simulation.faults.faults import SHARE_RESOLUTION, Fault, From, Opening, bends
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig


def _times(name: str, factor: float, opening: Opening) -> Effect:
    """A number that is multiplied by `factor` when the fault is whole."""

    def change(t: Array) -> Array:
        return 1.0 + (factor - 1.0) * opening.share(t)

    return Effect(name, change, SHARE_RESOLUTION * max(abs(factor - 1.0), 1e-3), jumps=bends(opening))


def _plus(name: str, size: float, opening: Opening) -> Effect:
    """A number to which `size` is added when the fault is whole."""

    def change(t: Array) -> Array:
        return size * opening.share(t)

    return Effect(name, change, SHARE_RESOLUTION * size or math.inf, added=True, jumps=bends(opening))


def _check_factor(factor: float, what: str, *, least: float) -> None:
    if not (math.isfinite(factor) and factor >= least):
        raise InputError(f"{what} must change by a factor >= {least:g}, got {factor:g}")


def _check_size(size: float, what: str, unit: str) -> None:
    if not (math.isfinite(size) and size >= 0):
        raise InputError(f"{what} must be >= 0 {unit} and finite, got {size:g}")


@dataclass(frozen=True)
class PumpLeakage(Fault):
    """A worn pump: its internal leakage `pump.G_pump` grows `factor` times, or by `added` [m^3/(s Pa)]."""

    factor: float | None = None
    added: float | None = None
    opening: Opening = field(default_factory=From)
    kind: ClassVar[str] = "pump leakage"

    def __post_init__(self) -> None:
        if (self.factor is None) == (self.added is None):
            raise InputError("a pump leak needs either a factor or a conductance, and not both")
        if self.factor is not None:
            _check_factor(self.factor, "a pump leak", least=0.0)
        if self.added is not None:
            _check_size(self.added, "a pump leak", "m^3/(s Pa)")

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        if self.added is not None:
            return (_plus("G_pump", self.added, self.opening),)
        if rig.pump.G_pump == 0:
            raise InputError(f"a pump leak by a factor needs pump.G_pump > 0, got 0 ({self})")
        return (_times("G_pump", self.factor or 0.0, self.opening),)

    def __str__(self) -> str:
        if self.factor is not None:
            return f"pump leak x{number_text(self.factor)} {self.opening}"
        return f"pump leak G = {number_text(self.added or 0.0)} {self.opening}"


@dataclass(frozen=True)
class ExternalLeakage(Fault):
    """A worn rod seal of side A or B: oil leaves the chamber, Q = G p (laminar).

    Its size is `coefficient` G [m^3/(s Pa)], or `flow` [m^3/s], the flow at the charge pressure. A closed circuit holds
    8e-13 m^3 of oil for each pascal: give the rig a make-up (`makeup.check_valves = "present"`), or it runs empty.
    """

    side: Literal["A", "B"]
    coefficient: float | None = None
    flow: float | None = None
    opening: Opening = field(default_factory=From)
    kind: ClassVar[str] = "external leakage"

    def __post_init__(self) -> None:
        if self.side not in ("A", "B"):
            raise InputError(f"a rod seal must be A or B, got {self.side!r}")
        if (self.coefficient is None) == (self.flow is None):
            raise InputError("a rod seal's leak needs either a coefficient or a flow, and not both")
        _check_size(self.coefficient or self.flow or 0.0, "a rod seal's leak", "m^3/s or m^3/(s Pa)")

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        G = self.coefficient
        if self.flow is not None:
            if rig.fluid.p_charge == 0:
                raise InputError(f"a rod seal's flow is that at fluid.p_charge, which must be > 0 Pa, got 0 ({self})")
            G = self.flow / rig.fluid.p_charge
        return (_plus(f"G_ext_{self.side}", G or 0.0, self.opening),)

    def __str__(self) -> str:
        if self.flow is not None:
            return f"rod seal {self.side} {self.flow / LITRE_PER_MINUTE:g} L/min {self.opening}"
        return f"rod seal {self.side} G = {number_text(self.coefficient or 0.0)} {self.opening}"


@dataclass(frozen=True)
class FrictionChange(Fault):
    """Friction of piston and rod, as a whole, becomes `factor` times what it was (dry or swollen seals, side load)."""

    factor: float
    opening: Opening = field(default_factory=From)
    kind: ClassVar[str] = "friction"

    def __post_init__(self) -> None:
        _check_factor(self.factor, "friction", least=0.0)

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        return tuple(_times(name.rpartition(".")[2], self.factor, self.opening) for name in GROUPS["friction"])

    def __str__(self) -> str:
        return f"friction x{number_text(self.factor)} {self.opening}"


@dataclass(frozen=True)
class AirInOil(Fault):
    """Air drawn into the oil: `share` more of free air, by volume of oil at atmospheric pressure (`fluid.air`)."""

    share: float
    opening: Opening = field(default_factory=From)
    kind: ClassVar[str] = "air"

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 0.5:
            raise InputError(f"air in the oil must be 0 % to 50 % of its volume, got {100 * self.share:g} %")

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        return (_plus("air", self.share, self.opening),)

    def __str__(self) -> str:
        return f"air {number_text(self.share)} {self.opening}"
