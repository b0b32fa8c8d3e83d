"""Leaks across the piston over time, as data and as text; an opening states how far one is open at each instant.

A text such as ``0.0042 L/min from 90 s`` is read by `parse_leak`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, Literal, TypeAlias

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import (
    TIME,
    UNSIGNED,
    Polyline,
    number_text,
    plain_text,
    polyline,
    seconds,
    tabulated,
)
from sealscope.units import LITRE_PER_MINUTE, parse_quantity

#: Groups of a match.
Part = dict[str, str | None]
#: When, in texts of leaks and faults: `from 90 s`, `growing from 1 min to 120 s`.
WHEN = rf"(?:\s+(?:from\s+(?P<since>{TIME})|growing\s+from\s+(?P<start>{TIME})\s+to\s+(?P<stop>{TIME})))?"
_MEAN = rf"(?P<mean>{UNSIGNED}\s*(?:\[[^\]]+\]|[a-zA-Z][a-zA-Z^0-9]*/[a-zA-Z]+))"
_LEAK = rf"(?:{_MEAN}|(?P<letter>[GC])\s*=\s*(?P<coefficient>{UNSIGNED}))(?:\s+(?P<law>laminar|orifice))?{WHEN}"


def from_time(start: float = 0.0, stop: float = math.inf, ramp: float = 0.0) -> Polyline:
    """Make an opening that rises linearly within `ramp` [s] from `start` on, and falls likewise from `stop` [s] on."""
    if not (math.isfinite(ramp) and ramp >= 0.0):
        raise InputError(f"a ramp must be >= 0 s and finite, got {ramp:g} s")
    if not stop >= start + ramp:
        raise InputError(f"what begins at {start:g} s and takes {ramp:g} s must end later than that, got {stop:g} s")
    words = f"from {number_text(start)} s"
    points = [(start, 0.0), (start + ramp, 1.0)]
    if math.isfinite(stop):
        words += f" to {number_text(stop)} s"
        points += [(stop, 1.0), (stop + ramp, 0.0)]
    return polyline(points, words + (f" within {number_text(ramp)} s" if ramp else ""))


def growing(start: float, stop: float) -> Polyline:
    """Make an opening that rises linearly from `start` to `stop` [s] and stays open."""
    if not stop > start:
        raise InputError(f"a growing leak must stop growing after it starts, got {start:g} s to {stop:g} s")
    words = f"growing from {number_text(start)} s to {number_text(stop)} s"
    return polyline([(start, 0.0), (stop, 1.0)], words)


@dataclass(frozen=True, eq=False)
class Thinned:
    """The `opening` of a laminar gap over the oil's `viscosity` at t, that of the rig being 1."""

    opening: Opening
    viscosity: Callable[[Array], Array]
    rise: ClassVar[None] = None

    def value_at(self, t: Array) -> Array:
        """Compute the opening at times t [s] over the oil's viscosity, that of the rig being 1."""
        return self.opening.value_at(t) / self.viscosity(t)

    def onset(self) -> float:
        """Return the onset [s] of the gap."""
        return self.opening.onset()

    def __str__(self) -> str:
        return f"{self.opening}, in oil that changes its temperature"


#: How far a fault is open over time: 0 is closed, 1 is fully open.
Opening: TypeAlias = Polyline | Thinned


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
    opening: Opening = field(default_factory=from_time)

    def __post_init__(self) -> None:
        if self.law not in ("laminar", "orifice"):
            raise InputError(f"leak law must be laminar or orifice, got {self.law!r}")
        stated = [value for value in (self.coefficient, self.mean) if value is not None]
        if len(stated) != 1:
            raise InputError("a leak needs either a coefficient or a mean flow, and not both")
        if not (math.isfinite(stated[0]) and stated[0] >= 0):
            raise InputError(f"a leak must be >= 0 and finite, got {stated[0]}")
        if isinstance(self.opening, Polyline) and not np.all((self.opening.y >= 0) & (self.opening.y <= 1)):
            raise InputError(f"openings of a leak must be in 0..1, got {self.opening}")

    def __str__(self) -> str:
        if self.mean is not None:
            return f"{self.mean / LITRE_PER_MINUTE:g} L/min {self.law} {self.opening}"
        return f"{'G' if self.law == 'laminar' else 'C'} = {self.coefficient:g} {self.opening}"


def opening_of(part: Part) -> Polyline:
    """Read the opening from the groups of a text; open from the start where they state nothing."""
    if part.get("start") is not None:
        return growing(seconds(part["start"]), seconds(part["stop"]))
    until = part.get("until")
    return from_time(
        seconds(part.get("since")), math.inf if until is None else seconds(until), seconds(part.get("ramp"))
    )


def parse_leak(text: str) -> Leak | None:
    """Read a leak from text; None for ``none``.

    The columns of a table are `t [s]` and `q_leak [L/min]`, the mean flow asked for at each time. Raises InputError
    that shows the forms when the text is none of them.
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
        return Leak("laminar", mean=peak, opening=tabulated(table.t, flow / peak))
    match = re.fullmatch(_LEAK, plain_text(text, "leak"), re.IGNORECASE)
    if not match:
        raise InputError(
            "leak must be like '0.0042 L/min from 90 s', '0.01 L/min orifice growing from 60 s to 120 s', "
            f"'G = 6.1e-13 from 90 s', 'C = 2e-10', 'table LEAK.csv' or 'none', got {text!r}"
        )
    part, stated_law = match.groupdict(), (match["law"] or "").lower()
    if letter := (part["letter"] or "").upper():
        law: Literal["laminar", "orifice"] = "laminar" if letter == "G" else "orifice"
        if stated_law not in ("", law):
            raise InputError(f"{letter} is the coefficient of the {law} law, got law {stated_law} ({text!r})")
        return Leak(law, coefficient=float(part["coefficient"]), opening=opening_of(part))
    mean = parse_quantity(part["mean"], "m^3/s", name="a leak")
    return Leak(stated_law or "laminar", mean=mean, opening=opening_of(part))  # type: ignore[arg-type]
