"""Leaks across the piston over time, as data and as text; an opening says how far one is open at each instant.

A text such as ``0.0042 L/min from 90 s`` is read by `parse_leak`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import TIME, UNSIGNED, number_text, plain_text, seconds
from sealscope.units import LITRE_PER_MINUTE, parse_quantity

#: Groups of a match.
Part = dict[str, str | None]
#: When, in texts of leaks and faults: `from 90 s`, `growing from 1 min to 120 s`.
WHEN = rf"(?:\s+(?:from\s+(?P<at_time>{TIME})|growing\s+from\s+(?P<start>{TIME})\s+to\s+(?P<stop>{TIME})))?"
_MEAN = rf"(?P<mean>{UNSIGNED}\s*(?:\[[^\]]+\]|[a-zA-Z][a-zA-Z^0-9]*/[a-zA-Z]+))"
_LEAK = rf"(?:{_MEAN}|(?P<letter>[GC])\s*=\s*(?P<coefficient>{UNSIGNED}))(?:\s+(?P<law>laminar|orifice))?{WHEN}"


class Opening(Protocol):
    """How far a fault is open: 0 is closed, 1 is fully open."""

    def share(self, t: Array) -> Array:
        """Return the opening in 0..1 at times t [s] (any shape)."""
        ...

    def bends(self) -> tuple[float, ...]:
        """Return the times [s] at which it jumps or bends, as far as its form tells."""
        ...

    def onset(self) -> float:
        """Return the first time [s] at which it is open."""
        return self.bends()[0]


@dataclass(frozen=True)
class From(Opening):
    """Closed before `at` [s], fully open from then on."""

    at: float = 0.0

    def share(self, t: Array) -> Array:
        """Return the opening at times t [s]."""
        return np.where(t >= self.at, 1.0, 0.0)

    def bends(self) -> tuple[float, ...]:
        """Return the times [s] at which it jumps or bends."""
        return (self.at,)

    def __str__(self) -> str:
        return f"from {self.at:g} s"


@dataclass(frozen=True)
class Growing(Opening):
    """Opens evenly from `start` to `stop` [s] and stays open."""

    start: float
    stop: float

    def __post_init__(self) -> None:
        if not self.stop > self.start:
            raise InputError(
                f"a growing leak must stop growing after it starts, got {self.start:g} s to {self.stop:g} s"
            )

    def share(self, t: Array) -> Array:
        """Return the opening at times t [s]."""
        return np.clip((t - self.start) / (self.stop - self.start), 0.0, 1.0)

    def bends(self) -> tuple[float, ...]:
        """Return the times [s] at which it jumps or bends."""
        return self.start, self.stop

    def __str__(self) -> str:
        return f"growing from {self.start:g} s to {self.stop:g} s"


@dataclass(frozen=True, eq=False)
class Tabulated(Opening):
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
        """Return the opening at times t [s]."""
        return np.interp(t, self.t, self.opening)

    def onset(self) -> float:
        """Return the time [s] of the last point before the first that is open; infinity where none is."""
        opened = np.flatnonzero(self.opening > 0)
        if opened.size == 0:
            return math.inf
        return float(self.t[max(int(opened[0]) - 1, 0)] if opened[0] > 0 else 0.0)

    def bends(self) -> tuple[float, ...]:
        """Return the times [s] at which it jumps or bends."""
        return tuple(map(float, self.t)) if self.t.size < 1000 else (self.onset(),)

    def __str__(self) -> str:
        return f"table of {self.t.size} points over {self.t[0]:g}..{self.t[-1]:g} s"


@dataclass(frozen=True)
class Between(Opening):
    """Opens evenly within `ramp` [s] from `start` on, and shuts as evenly from `stop` [s] on (infinity: never)."""

    start: float
    stop: float = math.inf
    ramp: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.ramp) and self.ramp >= 0.0):
            raise InputError(f"a ramp must be >= 0 s and finite, got {self.ramp:g} s")
        if not self.stop >= self.start + self.ramp:
            raise InputError(
                f"what begins at {self.start:g} s and takes {self.ramp:g} s must end later than that, got "
                f"{self.stop:g} s"
            )

    def share(self, t: Array) -> Array:
        """Return the opening at times t [s]."""
        if self.ramp == 0.0:
            return np.where((t >= self.start) & (t < self.stop), 1.0, 0.0)
        return np.clip(np.minimum(t - self.start, self.stop + self.ramp - t) / self.ramp, 0.0, 1.0)

    def bends(self) -> tuple[float, ...]:
        """Return the times [s] at which it jumps or bends."""
        return self.start, self.start + self.ramp, self.stop, self.stop + self.ramp

    def __str__(self) -> str:
        until = f" to {number_text(self.stop)} s" if math.isfinite(self.stop) else ""
        within = f" within {number_text(self.ramp)} s" if self.ramp else ""
        return f"from {number_text(self.start)} s{until}{within}"


@dataclass(frozen=True, eq=False)
class Thinned(Opening):
    """The `opening` of a laminar gap, as a share of what it passes at the rig's viscosity: over `viscosity` at t."""

    opening: Opening
    viscosity: Callable[[Array], Array]

    def share(self, t: Array) -> Array:
        """Return the opening at times t [s] over the oil's viscosity, that of the rig being 1."""
        return self.opening.share(t) / self.viscosity(t)

    def onset(self) -> float:
        """Return the onset [s] of the gap."""
        return self.opening.onset()

    def bends(self) -> tuple[float, ...]:
        """Return the times [s] at which it jumps or bends."""
        return self.opening.bends()

    def __str__(self) -> str:
        return f"{self.opening}, in oil that changes its temperature"


@dataclass(frozen=True)
class Leak:
    """Leakage across the piston.

    `law`: "laminar", Q = G dp with G [m^3/(s Pa)] (worn seal), or "orifice", Q = C sign(dp) sqrt|dp| with C [m^3/(s
    Pa^0.5)] (needle valve). The size at full opening is either `coefficient` (G or C), or `mean` [m^3/s]: the mean of
    abs(Q_L) that the rig shall show at full opening; the coefficient is then found on the rig at its operating point.
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


def opening_of(part: Part) -> From | Growing:
    """Return the opening that the groups of `WHEN` say; open from the start where they say nothing."""
    if part["start"] is not None and part["stop"] is not None:
        return Growing(seconds(part["start"]), seconds(part["stop"]))
    return From(seconds(part["at_time"]))


def parse_leak(text: str) -> Leak | None:
    """Read a leak from text; None for ``none``.

    The forms are ``0.0042 L/min from 90 s``, ``0.01[L/min] orifice growing from 1 min to 2 min``, ``G = 6.1e-13 from 90
    s``, ``C = 2e-10``, and ``table LEAK.csv`` (columns `t [s]` and `q_leak [L/min]`: the mean flow asked for at each
    time). Raises InputError that shows the forms when the text is none of them.
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
    match = re.fullmatch(_LEAK, plain_text(text, "leak"), re.IGNORECASE)
    if not match:
        raise InputError(
            "leak must be like '0.0042 L/min from 90 s', '0.01 L/min orifice growing from 60 s to 120 s', "
            f"'G = 6.1e-13 from 90 s', 'C = 2e-10', 'table LEAK.csv' or 'none', got {text!r}"
        )
    part, asked = match.groupdict(), (match["law"] or "").lower()
    if letter := (part["letter"] or "").upper():
        law: Literal["laminar", "orifice"] = "laminar" if letter == "G" else "orifice"
        if asked not in ("", law):
            raise InputError(f"{letter} is the coefficient of the {law} law, got law {asked} ({text!r})")
        return Leak(law, coefficient=float(part["coefficient"]), opening=opening_of(part))
    mean = parse_quantity(part["mean"], "m^3/s", name="a leak")
    return Leak(asked or "laminar", mean=mean, opening=opening_of(part))  # type: ignore[arg-type]
