"""Faults over time, as data: how far a fault is open at each instant, and how large a leak is when open."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal, Protocol

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.changes.readings import Adjustment, Hold
from sealscope.simulation.changes.rig import Effect
from sealscope.simulation.commands import TIME, UNSIGNED, seconds
from sealscope.units import LITRE_PER_MINUTE, parse_quantity

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.simulation.commands import Command


class Opening(Protocol):
    """How far a leak is open: 0 is closed, 1 is fully open."""

    def share(self, t: Array) -> Array:
        """Opening in 0..1 at times t [s] (any shape)."""
        ...

    def onset(self) -> float:
        """First time [s] at which it is open."""
        ...

    def __str__(self) -> str: ...


@dataclass(frozen=True)
class From:
    """Closed before `at` [s], fully open from then on."""

    at: float = 0.0

    def share(self, t: Array) -> Array:
        return np.where(t >= self.at, 1.0, 0.0)

    def onset(self) -> float:
        return self.at

    def __str__(self) -> str:
        return f"from {self.at:g} s"


@dataclass(frozen=True)
class Growing:
    """Opens evenly from `start` to `stop` [s] and stays open."""

    start: float
    stop: float

    def __post_init__(self) -> None:
        if not self.stop > self.start:
            raise InputError(
                f"a growing leak must stop growing after it starts, got {self.start:g} s to {self.stop:g} s"
            )

    def share(self, t: Array) -> Array:
        return np.clip((t - self.start) / (self.stop - self.start), 0.0, 1.0)

    def onset(self) -> float:
        return self.start

    def __str__(self) -> str:
        return f"growing from {self.start:g} s to {self.stop:g} s"


@dataclass(frozen=True, eq=False)
class Tabulated:
    """Opening linear between the points of a table; constant before the first and after the last."""

    t: Array
    opening: Array

    def __post_init__(self) -> None:
        if self.t.size != self.opening.size or self.t.size < 1 or np.any(np.diff(self.t) < 0):
            raise InputError("a leak table must have one opening for each time, and its times must rise")
        if not (np.all(self.opening >= 0) and np.all(self.opening <= 1)):
            raise InputError(
                f"openings of a leak table must be in 0..1, got {self.opening.min():g}..{self.opening.max():g}"
            )

    def share(self, t: Array) -> Array:
        return np.interp(t, self.t, self.opening)

    def onset(self) -> float:
        opened = np.flatnonzero(self.opening > 0)
        if opened.size == 0:
            return math.inf
        return float(self.t[max(int(opened[0]) - 1, 0)] if opened[0] > 0 else 0.0)

    def __str__(self) -> str:
        return f"table of {self.t.size} points over {self.t[0]:g}..{self.t[-1]:g} s"


class Fault:
    """A fault other than a leak across the piston: what it changes in the machine, at the instruments, or in the duty.

    Its `opening` says when: 0 is a healthy machine, 1 the whole fault; its words are those that `parse_fault` reads.
    """

    #: One word for all faults of a kind, for tables and confusion matrices.
    kind: ClassVar[str]
    opening: Opening

    def onset(self) -> float:
        """First time [s] at which it is there."""
        return self.opening.onset()

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        """What it changes in the machine; InputError where it cannot be on this rig."""
        return ()

    def adjustments(self) -> tuple[Adjustment, ...]:
        """What it changes at the instruments."""
        return ()

    def holds(self) -> tuple[Hold, ...]:
        """Readings that it makes stand still."""
        return ()

    def commanded(self, command: Command) -> Command:
        """The command that the rig gets instead of `command`."""
        return command


#: Most of a fault that comes or goes from one block of the solver to the next.
SHARE_RESOLUTION = 5e-3


def bends(opening: Opening) -> tuple[float, ...]:
    """Times [s] at which an opening jumps or bends, as far as its form tells."""
    if isinstance(opening, Growing):
        return opening.start, opening.stop
    if isinstance(opening, Tabulated) and opening.t.size < 1000:
        return tuple(map(float, opening.t))
    return (opening.onset(),)


@dataclass(frozen=True)
class Leak:
    """Leakage across the piston.

    `law`: "laminar", Q = G dp with G [m^3/(s Pa)] (worn seal), or "orifice", Q = C sign(dp) sqrt|dp| with C [m^3/(s
    Pa^0.5)] (needle valve). The size at full opening is either `coefficient` (G or C), or `mean` [m^3/s]: the mean of
    |Q_L| that the rig shall show at full opening; the coefficient is then found on the rig at its own operating point.
    """

    law: Literal["laminar", "orifice"] = "laminar"
    coefficient: float | None = None
    mean: float | None = None
    opening: Opening = field(default_factory=From)

    def __post_init__(self) -> None:
        if self.law not in ("laminar", "orifice"):
            raise InputError(f"leak law must be laminar or orifice, got {self.law!r}")
        given = [value for value in (self.coefficient, self.mean) if value is not None]
        if len(given) != 1:
            raise InputError("a leak needs either a coefficient or a mean flow, and not both")
        if not (math.isfinite(given[0]) and given[0] >= 0):
            raise InputError(f"a leak must be >= 0 and finite, got {given[0]}")

    def __str__(self) -> str:
        if self.mean is not None:
            return f"{self.mean / LITRE_PER_MINUTE:g} L/min {self.law} {self.opening}"
        return f"{'G' if self.law == 'laminar' else 'C'} = {self.coefficient:g} {self.opening}"


_MEAN = rf"{UNSIGNED}\s*(?:\[[^\]]+\]|[a-zA-Z^0-9]+/[a-zA-Z]+)"
_SIZE = rf"(?:(?P<mean>{_MEAN})|(?P<letter>[GC])\s*=\s*(?P<coefficient>{UNSIGNED}))"
#: When, in texts of leaks and faults: `from 90 s`, `growing from 1 min to 120 s`.
WHEN = rf"(?:from\s+(?P<at>{TIME})|growing\s+from\s+(?P<start>{TIME})\s+to\s+(?P<stop>{TIME}))"


def opening_from(part: dict[str, str | None]) -> Opening:
    """The opening that the groups of `WHEN` say; open from the start where they say nothing."""
    if part["start"] is not None and part["stop"] is not None:
        return Growing(seconds(part["start"]), seconds(part["stop"]))
    return From(seconds(part["at"]))


def parse_leak(text: str) -> Leak | None:
    """A leak from words: `0.0042 L/min from 90 s`, `0.01 L/min orifice growing from 60 s to 120 s`, `G = 6.1e-13 from
    90 s`, `C = 2e-10`, `table LEAK.csv` (columns `t [s]` and `q_leak [L/min]`: the mean flow asked for at each time),
    or `none`.

    Raises InputError that shows the forms when the text is none of them.
    """
    stripped = text.strip()
    if stripped.lower() in ("none", "0", "no leak"):
        return None
    if stripped.lower().startswith("table "):
        from sealscope.recordings import read

        table = read(stripped[6:].strip())
        flow = table["q_leak"]
        peak = float(np.max(flow, initial=0.0))
        if not (np.all(np.isfinite(flow)) and peak > 0 and flow.min() >= 0):
            raise InputError(f"q_leak of a leak table must be finite, >= 0 and somewhere > 0 ({stripped[6:].strip()})")
        return Leak("laminar", mean=peak, opening=Tabulated(table.t, flow / peak))
    found = re.fullmatch(rf"{_SIZE}(?:\s+(?P<law>laminar|orifice))?(?:\s+{WHEN})?", stripped)
    if not found:
        raise InputError(
            "leak must be like '0.0042 L/min from 90 s', '0.01 L/min orifice growing from 60 s to 120 s', "
            f"'G = 6.1e-13 from 90 s', 'C = 2e-10', 'table LEAK.csv' or 'none', got {text!r}"
        )
    part = found.groupdict()
    opening = opening_from(part)
    if part["letter"]:
        law: Literal["laminar", "orifice"] = "laminar" if part["letter"] == "G" else "orifice"
        if part["law"] not in (None, law):
            raise InputError(f"{part['letter']} is the coefficient of the {law} law, got law {part['law']} ({text!r})")
        return Leak(law, coefficient=float(part["coefficient"]), opening=opening)
    mean = parse_quantity(part["mean"], "m^3/s", name="a leak")
    return Leak(part["law"] or "laminar", mean=mean, opening=opening)  # type: ignore[arg-type]
