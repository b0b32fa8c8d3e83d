"""Limits of a hold test, as workshops state them, and the decision rule of ISO 14253-1 against them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from sealscope.errors import InputError
from sealscope.units import BAR, ML_PER_MINUTE, MM_PER_MINUTE, parse_quantity, same_dimension

Result = Literal["pass", "fail", "undecided"]
#: The parts of a limit: name, amount, time and pressure, as in `boom: 24 mm in 3 min at 200 bar`.
_LIMIT = re.compile(
    r"(?:(?P<name>[^:]+):)?\s*(?P<amount>.+?)(?:\s+in\s+(?P<time>.+?))?(?:\s+at\s+(?P<pressure>.+?))?\s*", re.IGNORECASE
)
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
        pressure = None if match["pressure"] is None else parse_quantity(match["pressure"], "Pa", name="limit")
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
            return cls(text, value, kind, pressure)  # type: ignore[arg-type]
        raise InputError(f"limit must be such as {_EXAMPLES}, got {text}")

    @property
    def figure(self) -> str:
        """The limit as a number with its unit."""
        if self.kind == "creep":
            return f"{self.value / MM_PER_MINUTE:.3g} mm/min"
        place = "" if self.pressure is None else f" at {self.pressure / BAR:.3g} bar"
        return f"{self.value / ML_PER_MINUTE:.3g} mL/min{place}"


def parse_duration(text: str, name: str) -> float:
    """Parse a time [s] above 0 such as "3 min"; raise InputError otherwise."""
    seconds = parse_quantity(text, "s", name=name)
    if not seconds > 0.0:
        raise InputError(f"{name} must have a time above 0, got {text}")
    return seconds


def parse_collected(text: str) -> tuple[float, float]:
    """Parse a collected volume such as "12 mL in 10 min" to m^3 and s; raise InputError for another text."""
    volume, separator, time = text.partition(" in ") if isinstance(text, str) else ("", "", "")
    if not separator:
        raise InputError(f"collected must be a volume in a time, such as '12 mL in 10 min', got {text!r}")
    amount = parse_quantity(volume, "m^3", name="collected")
    if amount < 0.0:
        raise InputError(f"collected must be a volume of 0 or more, got {text}")
    return amount, parse_duration(time, "collected")


def decide_result(interval: tuple[float, float], limit: float) -> Result:
    """Decide a test by the rule of ISO 14253-1, from a 95 % `interval` and a `limit` of the same unit.

    It passes only if the whole interval is inside the limit, and fails only if the whole interval is outside.
    """
    low, high = interval
    if high <= limit:
        return "pass"
    return "fail" if low > limit else "undecided"
