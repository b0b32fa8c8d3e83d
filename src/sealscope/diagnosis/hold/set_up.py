"""What the caller of a hold test states of cylinder, valves and oil, parsed to SI units."""

from __future__ import annotations

from typing import Any, NamedTuple

from sealscope.diagnosis.hold.limits import HoldLimit, parse_collected, parse_in_range
from sealscope.diagnosis.priors.hold import HOLD
from sealscope.errors import InputError
from sealscope.units import parse_quantity

#: Courses of a temperature that is not logged, by the words that state them.
COURSES = {"falling": "falling", "cooling": "falling", "rising": "rising", "warming": "rising", "steady": "steady"}


class SetUp(NamedTuple):
    """Statements of the caller on a hold test, in SI units; empty without a statement.

    `areas`, `volumes`: of one side, or of A and B; `valves`: sides with a load-holding valve, None if not stated;
    `capped`: sides whose port is capped; `reference`: pressure [Pa] to which the leak is converted; `oil_temperature`
    [degC], `oil_course`: of oil that is not logged; `collected`: volume [m^3], time [s] and pressure [Pa] or None;
    `loaded`: side, or "";
    `start`, `end` [s]: times of the hold, None to find them.
    """

    areas: tuple[float, ...]
    volumes: tuple[float, ...]
    limit: HoldLimit | None
    valves: frozenset[str] | None
    capped: frozenset[str]
    reference: float | None
    oil_temperature: float | None
    oil_course: str
    collected: tuple[float, float, float | None] | None
    loaded: str
    start: float | None
    end: float | None

    @property
    def reference_pressure(self) -> float | None:
        """Pressure [Pa] to which the leak is converted: that of the limit, or the stated one; None without either."""
        return self.reference if self.limit is None or self.limit.pressure is None else self.limit.pressure

    def area(self, side: str) -> float | None:
        """Return the area of a side [m^2]; None if it is not stated."""
        return None if not self.areas else self.areas[-1 if side == "B" else 0]

    def column(self, side: str, x: float | None) -> tuple[float, float]:
        """Estimate the length of a side's oil column, volume over area [m], and the deviation of its logarithm.

        `x` [m]: mean position, if it is recorded; only that of A says how far the column reaches.
        """
        prior, area = HOLD.column, self.area(side)
        if self.volumes and area is not None:
            return self.volumes[-1 if side == "B" else 0] / area, prior.stated
        if x is None or side == "B" or not x > 0.0:
            return prior.unknown, prior.unknown_deviation
        return x + prior.dead, prior.deviation


def parse_set_up(
    area: Any = None, volume: Any = None, limit: str | None = None, oil: str | None = None, reference: Any = None,
    collected: str | None = None, valve: str | None = None, capped: str | None = None, loaded: str | None = None,
    start: Any = None, end: Any = None,
) -> SetUp:  # fmt: skip
    """Parse the arguments of `hold_test`; raise InputError for one that is out of its range."""
    temperature, course = _parse_oil(oil)
    side = "" if loaded is None else str(loaded).strip().upper()
    if side not in ("", "A", "B"):
        raise InputError(f"loaded must be A or B, got {loaded}")
    first, last = (
        None if moment is None else parse_quantity(moment, "s", name=f"{name} of the hold")
        for name, moment in (("start", start), ("end", end))
    )
    if first is not None and last is not None and not first < last:
        raise InputError(f"start of the hold must be before its end, got {first:g} s and {last:g} s")
    return SetUp(
        _parse_sides(area, "m^2", "area"),
        _parse_sides(volume, "m^3", "volume"),
        None if limit is None else HoldLimit.parse(limit),
        None if valve is None else _parse_side_names(valve, "valve"),
        frozenset() if capped is None else _parse_side_names(capped, "capped"),
        None if reference is None else parse_in_range(reference, "Pa", "reference pressure"),
        temperature,
        course,
        None if collected is None else parse_collected(collected),
        side,
        first,
        last,
    )


def _parse_sides(value: Any, unit: str, name: str) -> tuple[float, ...]:
    """Parse one quantity, or those of the sides A and B; raise InputError for more."""
    if value is None:
        return ()
    entries = [value] if isinstance(value, str | int | float) else list(value)
    if len(entries) not in (1, 2):
        raise InputError(f"{name} must be one, or those of the sides A and B, got {len(entries)}")
    return tuple(parse_in_range(entry, unit, name) for entry in entries)


def _parse_side_names(text: str, name: str) -> frozenset[str]:
    """Parse the names of sides, such as "A" or "A,B"; "none" gives none."""
    sides = [part.strip().upper() for part in str(text).replace(";", ",").split(",")]
    if sides == ["NONE"]:
        return frozenset()
    if not set(sides) <= {"A", "B"}:
        raise InputError(f"{name} must be A, B, 'A,B' or none, got {text}")
    return frozenset(sides)


def _parse_oil(text: str | None) -> tuple[float | None, str]:
    """Parse the oil's temperature [degC] and its course: "falling", "rising", "steady", or "" if it is not stated."""
    if text is None:
        return None, ""
    words = text.split()
    course = COURSES.get(words[-1].lower(), "") if words else ""
    temperature = " ".join(words[:-1] if course else words)
    if not temperature and course:
        return None, course
    try:
        kelvin = parse_quantity(temperature, "K", name="oil")
    except InputError:
        raise InputError(f"oil must be such as '45 degC falling', 'rising' or 'steady', got {text!r}") from None
    return parse_in_range(kelvin, "K", "oil") - 273.15, course
