"""Leaks across the piston, with their openings over time, as data and as text (``0.0042 L/min from 90 s``)."""

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
    format_number,
    normalize_blanks,
    parse_seconds,
    polyline,
    polyline_from_table,
)
from sealscope.units import LITRE_PER_MINUTE, parse_quantity

#: Named groups of a match, as texts.
Groups = dict[str, str | None]
#: Pattern of the times in texts of leaks and faults: `from 90 s`, `growing from 1 min to 120 s`.
WHEN = rf"(?:\s+(?:from\s+(?P<since>{TIME})|growing\s+from\s+(?P<start>{TIME})\s+to\s+(?P<stop>{TIME})))?"
_MEAN = rf"(?P<mean>{UNSIGNED}\s*(?:\[[^\]]+\]|[a-zA-Z][a-zA-Z^0-9]*/[a-zA-Z]+))"
_LEAK = rf"(?:{_MEAN}|(?P<letter>[GC])\s*=\s*(?P<coefficient>{UNSIGNED}))(?:\s+(?P<law>laminar|orifice))?{WHEN}"


def opening_from(start: float = 0.0, stop: float = math.inf, ramp: float = 0.0) -> Polyline:
    """Make the opening of a leak or fault over time: from 0 (shut) at `start` to 1 (full) at `start` + `ramp` [s].

    It falls from 1 at `stop` to 0 at `stop` + `ramp`, unless `stop` is infinite. Raises InputError if `ramp` is
    negative or infinite, or if `stop` is before `start` + `ramp`.
    """
    if not (math.isfinite(ramp) and ramp >= 0.0):
        raise InputError(f"a ramp must be >= 0 s and finite, got {ramp:g} s")
    if not stop >= start + ramp:
        raise InputError(f"an opening from {start:g} s within {ramp:g} s must end after that, got an end at {stop:g} s")
    text = f"from {format_number(start)} s"
    points = [(start, 0.0), (start + ramp, 1.0)]
    if math.isfinite(stop):
        text += f" to {format_number(stop)} s"
        points += [(stop, 1.0), (stop + ramp, 0.0)]
    if ramp:
        text += f" within {format_number(ramp)} s"
    return polyline(points, text)


def growing_opening(start: float, stop: float) -> Polyline:
    """Make the opening of a leak or fault that grows linearly from 0 (shut) at `start` to 1 (full) at `stop` [s]."""
    if not stop > start:
        raise InputError(f"a growing leak must stop growing after it starts, got {start:g} s to {stop:g} s")
    text = f"growing from {format_number(start)} s to {format_number(stop)} s"
    return polyline([(start, 0.0), (stop, 1.0)], text)


@dataclass(frozen=True, eq=False)
class Thinned:
    """The opening of a laminar leak in oil of changing viscosity: `opening` divided by the relative viscosity.

    `viscosity`: function that computes the relative viscosity at times t [s]; `rise`: None, as the quotient is no
    linear rise (`Polyline.rise`).
    """

    opening: Opening
    viscosity: Callable[[Array], Array]
    rise: ClassVar[None] = None

    def value_at(self, t: Array) -> Array:
        """Compute the opening of the leak at times t [s], divided by the oil's relative viscosity."""
        return self.opening.value_at(t) / self.viscosity(t)

    def onset(self) -> float:
        """Return the onset [s] of `opening`."""
        return self.opening.onset()

    def __str__(self) -> str:
        return f"{self.opening}, in oil that changes its temperature"


#: The extent of a leak or a fault over time: 0 is healthy, 1 is its full size.
Opening: TypeAlias = Polyline | Thinned


@dataclass(frozen=True)
class Leak:
    """A leak across the piston, from chamber A to B.

    `law`: "laminar", Q = G dp with G [m^3/(s Pa)] (worn seal), or "orifice", Q = C sign(dp) sqrt(abs(dp)) with C
    [m^3/(s Pa^0.5)] (needle valve); `opening`: how far the leak is open over time, 0 to 1. Either `coefficient` or
    `mean` states the size at full opening. `coefficient` is G or C. `mean` [m^3/s] is the mean of abs(Q) while the leak
    is open (`sizing.mean_while_open`), for which `sizing.size_leaks` finds the coefficient.
    """

    law: Literal["laminar", "orifice"] = "laminar"
    coefficient: float | None = None
    mean: float | None = None
    opening: Opening = field(default_factory=opening_from)

    def __post_init__(self) -> None:
        if self.law not in ("laminar", "orifice"):
            raise InputError(f"leak law must be laminar or orifice, got {self.law!r}")
        sizes = [value for value in (self.coefficient, self.mean) if value is not None]
        if len(sizes) != 1:
            raise InputError("a leak needs either a coefficient or a mean flow, and not both")
        if not (math.isfinite(sizes[0]) and sizes[0] >= 0):
            raise InputError(f"a leak must be >= 0 and finite, got {sizes[0]}")
        # thin oil may open a `Thinned` leak beyond 1
        if isinstance(self.opening, Polyline) and not np.all((self.opening.y >= 0) & (self.opening.y <= 1)):
            raise InputError(f"openings of a leak must be in 0..1, got {self.opening}")

    def __str__(self) -> str:
        if self.mean is not None:
            return f"{self.mean / LITRE_PER_MINUTE:g} L/min {self.law} {self.opening}"
        return f"{'G' if self.law == 'laminar' else 'C'} = {self.coefficient:g} {self.opening}"


def parse_opening(groups: Groups) -> Polyline:
    """Build the opening of a leak or fault from the times in its text, the named groups of a pattern such as `WHEN`.

    It grows from `start` to `stop` if they are stated. Otherwise it begins at `since`, by default at 0 s, ends at
    `until`, by default never, and takes `ramp` to open and to shut, by default no time.
    """
    if groups.get("start") is not None:
        return growing_opening(parse_seconds(groups["start"]), parse_seconds(groups["stop"]))
    stop = parse_seconds(groups["until"]) if groups.get("until") else math.inf
    return opening_from(parse_seconds(groups.get("since")), stop, parse_seconds(groups.get("ramp")))


def parse_leak(text: str) -> Leak | None:
    """Parse the text of a leak across the piston, such as "0.0042 L/min from 90 s"; return None for ``none``.

    ``table FILE`` names a file with the columns `t [s]` and `q_leak [L/min]`: a laminar leak, with the largest `q_leak`
    as its mean flow at full opening, and `q_leak` over this maximum as its opening. Raises InputError, which lists all
    forms, for any other text.
    """
    stripped = text.strip()
    if stripped.lower() in ("none", "0", "no leak"):
        return None
    if stripped.lower().startswith("table "):
        from sealscope.recordings import read

        path = stripped[len("table ") :].strip()
        table = read(path)
        flow = table["q_leak"]
        max_flow = float(np.max(flow, initial=0.0))
        if not (np.all(np.isfinite(flow)) and max_flow > 0 and flow.min() >= 0):
            raise InputError(f"q_leak of a leak table must be finite, >= 0 and somewhere > 0 ({path})")
        return Leak("laminar", mean=max_flow, opening=polyline_from_table(table.t, flow / max_flow))
    match = re.fullmatch(_LEAK, normalize_blanks(text, "leak"), re.IGNORECASE)
    if not match:
        raise InputError(
            "leak must be like '0.0042 L/min from 90 s', '0.01 L/min orifice growing from 60 s to 120 s', "
            f"'G = 6.1e-13 from 90 s', 'C = 2e-10', 'table LEAK.csv' or 'none', got {text!r}"
        )
    opening = parse_opening(match.groupdict())
    stated_law = (match["law"] or "").lower()
    if letter := (match["letter"] or "").upper():
        law: Literal["laminar", "orifice"] = "laminar" if letter == "G" else "orifice"
        if stated_law not in ("", law):
            raise InputError(f"{letter} is the coefficient of the {law} law, got law {stated_law} ({text!r})")
        return Leak(law, coefficient=float(match["coefficient"]), opening=opening)
    mean = parse_quantity(match["mean"], "m^3/s", name="a leak")
    return Leak(stated_law or "laminar", mean=mean, opening=opening)  # type: ignore[arg-type]
