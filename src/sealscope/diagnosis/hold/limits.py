"""Limits of a hold test, as workshops state them, and the decision rule of ISO 14253-1 against them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from sealscope.errors import InputError
from sealscope.units import BAR, ML_PER_MINUTE, MM_PER_MINUTE, from_si, parse_quantity, same_dimension

Result = Literal["pass", "fail", "undecided"]
#: An amount in a time, as in `24 mm in 3 min` or `12 mL/10 min`.
_AMOUNT = r"(?P<amount>.+?)(?:(?:\s+in\s+|\s*/\s*)(?P<time>\d.*?))"
_PRESSURE = r"(?:\s+at\s+(?P<pressure>.+?))?\s*"
#: The parts of a limit: name, amount, time and pressure, as in `boom: 24 mm in 3 min at 200 bar`.
_LIMIT = re.compile(rf"(?:(?P<name>[^:]+):)?\s*{_AMOUNT}?{_PRESSURE}", re.IGNORECASE)
#: Least and largest of what is stated, in the unit of messages, by its SI unit: rods of 4 mm to bores of 1.1 m.
RANGES = {
    **{"m^2": (1e-5, 1.0, "m^2"), "m^3": (1e-6, 1.0, "m^3"), "m": (0.0, 1e5, "mm")},
    **{"Pa": (1.0, 5000.0, "bar"), "K": (-60.0, 200.0, "degC")},
}
_EXAMPLES = "'24 mm in 3 min', '15 mL/min' or 'NAME: 0.3 mL/min at 200 bar'"


@dataclass(frozen=True)
class HoldLimit:
    """Largest creep or leak that passes a hold test.

    Attributes
    ----------
    text : str
        The limit as it was stated.
    value : float
        Speed of the piston [m/s] or flow [m^3/s].
    kind : {"creep", "flow"}
        Which of these `value` is.
    pressure : float or None
        Pressure [Pa] to which a flow is converted before it is compared; None for the pressure that was held.
    """

    text: str
    value: float
    kind: Literal["creep", "flow"]
    pressure: float | None = None

    @classmethod
    def parse(cls, text: str) -> HoldLimit:
        """Parse a limit such as "24 mm in 3 min"; raise InputError for another text."""
        match = _LIMIT.fullmatch(text) if isinstance(text, str) else None
        if match is None:
            raise InputError(f"limit must be such as {_EXAMPLES}, got {text!r}")
        pressure = None if match["pressure"] is None else parse_in_range(match["pressure"], "Pa", "pressure of limit")
        units = {"creep": ("m/s", "m"), "flow": ("m^3/s", "m^3")}
        for kind, (rate_unit, amount_unit) in units.items():
            unit = rate_unit if match["time"] is None else amount_unit
            written = re.sub(r"^[\d.,eE+-]+\s*", "", match["amount"].strip("[] "))
            if not written or not same_dimension(written.strip("[]"), unit):
                continue
            value = parse_quantity(match["amount"], unit, name="limit")
            if match["time"] is not None:
                value /= parse_duration(match["time"], "limit")
            if not value > 0.0:
                raise InputError(f"limit must be above 0, got {text}")
            if kind == "creep" and pressure is not None:
                raise InputError(f"limit of creep must have no pressure, which converts a flow alone, got {text}")
            return cls(text, value, kind, pressure)  # type: ignore[arg-type]
        raise InputError(f"limit must be such as {_EXAMPLES}, got {text}")

    @property
    def figure(self) -> str:
        """The limit as a number with its unit."""
        if self.kind == "creep":
            return f"{self.value / MM_PER_MINUTE:.3g} mm/min"
        place = "" if self.pressure is None else f" at {self.pressure / BAR:.3g} bar"
        return f"{self.value / ML_PER_MINUTE:.3g} mL/min{place}"


def parse_in_range(value: str | float, si_unit: str, name: str) -> float:
    """Parse a quantity to its SI unit; raise InputError if it is out of its range (`RANGES`), as by a wrong unit."""
    quantity = parse_quantity(value, si_unit, name=name)
    low, high, unit = RANGES[si_unit]
    number = from_si(quantity, unit, si_unit)
    if not low <= number <= high:
        raise InputError(f"{name} must be {low:g} to {high:g} {unit}, got {number:g} {unit}: is its unit right?")
    return quantity


def parse_duration(text: str, name: str) -> float:
    """Parse a time [s] above 0 with its unit, such as "3 min"; raise InputError otherwise."""
    seconds = parse_quantity(text, "s", name=name)
    if not (seconds > 0.0 and text.strip(" []")[-1:].isalpha()):
        raise InputError(f"{name} must have a time above 0 with its unit, such as 3 min, got {text}")
    return seconds


def parse_collected(text: str) -> tuple[float, float, float | None]:
    """Parse a collected volume such as "12 mL in 10 min at 200 bar" to m^3, s and, None if not stated, Pa.

    Raises InputError for another text.
    """
    match = re.fullmatch(rf"{_AMOUNT}{_PRESSURE}", text, re.IGNORECASE) if isinstance(text, str) else None
    if match is None:
        raise InputError(f"collected must be a volume in a time, such as '12 mL in 10 min at 200 bar', got {text!r}")
    amount = parse_quantity(match["amount"], "m^3", name="collected")
    if amount < 0.0:
        raise InputError(f"collected must be a volume of 0 or more, got {text}")
    pressure = None if match["pressure"] is None else parse_in_range(match["pressure"], "Pa", "pressure of collected")
    return amount, parse_duration(match["time"], "collected"), pressure


def decide_result(interval: tuple[float, float], limit: float) -> Result:
    """Decide a test by the rule of ISO 14253-1, from a 95 % `interval` and a `limit` of the same unit.

    It passes only if the whole interval is inside the limit, and fails only if the whole interval is outside.
    """
    low, high = interval
    if high <= limit:
        return "pass"
    return "fail" if low > limit else "undecided"
