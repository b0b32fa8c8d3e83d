"""Faults of machine, sensors and duty over time, as data and as text (``pump leak x3 growing from 1 min to 2 min``).

The kinds of faults are the entries of `faults.toml`; leaks across the piston are in `leaks`.
"""

from __future__ import annotations

import math
import re
import sys
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.channels import PRESSURES
from sealscope.recordings.recording import CHANNEL_UNITS, Array
from sealscope.simulation.changes import (
    MAX_RELATIVE_CHANGE,
    SHORTEST_BLOCK,
    THROTTLES,
    Effect,
    model_parameters_derived_from,
)
from sealscope.simulation.commands import NUMBER, TIME, UNSIGNED, Command, Polyline, format_number, normalize_blanks
from sealscope.simulation.leaks import WHEN, Groups, opening_from, parse_opening
from sealscope.units import LITRE_PER_MINUTE, parse_quantity

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Largest change of a fault from one block of the solver to the next, as a fraction of its full size.
FAULT_MAX_CHANGE = 5e-3
#: Channels whose sensors can be faulty, with the parameter that is the sensor's relative gain error.
GAIN_PARAMETERS = {**dict.fromkeys(PRESSURES, "gain_error"), "x": "scale_error", "q_leak": "gain_error"}
#: Shortest block [s] for a moving valve: as short as one output of the solver.
_VALVE_BLOCK = 0.0
_SPAN = rf"(?:\s+from\s+(?P<since>{TIME})(?:\s+to\s+(?P<until>{TIME}))?)?"
#: Times of a fault in its text: `from 60 s`, `growing from ..`, `from 60 s to 90 s`, and with `within 0.5 s`.
_WHEN = {"grows": WHEN, "lasts": _SPAN, "operated": rf"{_SPAN}(?:\s+within\s+(?P<ramp>{TIME}))?"}
#: Patterns that are inserted for the names in braces in `faults.toml`.
_PATTERNS = {
    "number": NUMBER,
    "factor": rf"(?:x\s*(?P<times>{NUMBER})|(?P<percent>[-+]\s*{UNSIGNED})\s*%)",
    "share": rf"(?P<share>{NUMBER})\s*(?P<sign>%?)",
    "size": rf"(?P<size>{NUMBER}\s*(?:\[[^\]]+\]|[a-zA-Z][a-zA-Z0-9^/_]*))",
    "difference": rf"(?P<value>[-+]\s*{UNSIGNED})",
    "sensor": r"sensor\s+(?P<at>\w+)",
    "seal": r"(?:rod\s+seal|external\s+leak(?:age)?)\s+(?P<at>[ABab])",
}


def _parse_number(text: str) -> float:
    """Convert a text such as "3", "-1.5" or "+ 20" to a number."""
    return float(text.replace(" ", ""))


@dataclass(frozen=True)
class FaultRow:
    """A kind of fault: an entry of `faults.toml`, whose head explains the fields.

    `name`: the entry's key; `kind`: name under which the fault is counted; `cause`: what a diagnosis should name, ""
    for none; `pattern`, `words`: regular expression and template of the fault's text. If `factor`, the fault's value
    multiplies the `parameters`, else it is added to them: divided by the rig's parameter `over` if that is named, or
    replaced by the rig's parameter `adds`. `needs`: parameter that must be > 0 on the rig, and start of the message;
    `unit`: unit of a size in the text; `least`, `most`: limits of the value, which `what` and `allowed` state in
    messages; `when`: form of the times in the text (`_WHEN`).
    """

    name: str
    kind: str
    pattern: str
    words: str
    cause: str = ""
    what: str = ""
    parameters: tuple[str, ...] = ()
    factor: bool = False
    needs: tuple[str, str] | None = None
    over: str | None = None
    adds: str | None = None
    unit: str = ""
    least: float = 0.0
    most: float = sys.float_info.max
    allowed: str = "change by a factor >= 0"
    when: str = "grows"

    @property
    def is_sensor_fault(self) -> bool:
        """True for a fault of a sensor, False for one of the machine or its commanded motion (duty)."""
        return self.kind.startswith("sensor")

    def parse(self, text: str) -> Fault | None:
        """Parse a text such as "pump leak x3 from 90 s" as a fault of this kind; return None for any other text."""
        pattern = self.pattern.format(**_PATTERNS).replace(" ", r"\s+") + _WHEN[self.when]  # a blank stands for several
        match = re.fullmatch(pattern, text, re.IGNORECASE)
        if match is None:
            return None
        groups = match.groupdict()
        channel_or_side = groups.get("at") or ""  # the channel of a faulty sensor, or the side A or B of a part
        return Fault(
            self.name,
            value=self._parse_value(groups),
            at=channel_or_side if self.is_sensor_fault else channel_or_side.upper(),
            opening=parse_opening(groups),
            frequency_factor=_parse_number(groups.get("frequency") or "1"),
        )

    def _parse_value(self, groups: Groups) -> float:
        """Read the size of a fault from the named groups of its matched text, in SI units.

        "x3" gives 3, "+20 %" gives 1.2, and "1 %" of a gain or of air gives 0.01. Without a number, a factor is 1 and
        any other size 0.
        """
        if size := groups.get("size"):
            # "Pa" is a stand-in for an unknown channel, which `Fault` refuses
            unit = CHANNEL_UNITS.get(groups["at"] or "", "Pa") if self.is_sensor_fault else self.unit
            return parse_quantity(size, unit, name=self.what)
        if percent := groups.get("percent"):
            return 1.0 + _parse_number(percent) / 100.0
        if share := groups.get("share"):
            return _parse_number(share) / (100.0 if groups["sign"] else 1.0)  # `sign`: a % after the number
        return _parse_number(groups.get("times") or groups.get("value") or ("1" if self.factor else "0"))


@dataclass(frozen=True)
class Fault:
    """A fault of machine, sensor or duty (the commanded motion) other than a leak across the piston.

    `name`: its key in `FAULTS`; `value`: a factor on the faulty parameter, or an addend in SI units; `at`: side (A or
    B) or channel that is faulty, "" for neither; `opening`: extent of the fault over time, 0 (healthy) to 1 (full
    size); `frequency_factor`: factor on the frequency of the command. `str` gives the text that `parse_fault` reads.
    """

    name: str
    value: float = 0.0
    at: str = ""
    opening: Polyline = field(default_factory=opening_from)
    frequency_factor: float = 1.0

    def __post_init__(self) -> None:
        row = self.row
        if row.is_sensor_fault and self.at not in GAIN_PARAMETERS:
            raise InputError(f"a faulty sensor must be one of {', '.join(GAIN_PARAMETERS)}, got {self.at!r}")
        has_side = not row.is_sensor_fault and "{at}" in row.words  # the text of such a fault names the side
        if has_side and self.at not in ("A", "B"):
            raise InputError(f"a {self.name} must be A or B, got {self.at!r}")
        if not (math.isfinite(self.value) and row.least <= self.value <= row.most):
            raise InputError(f"{row.what} must {row.allowed}, got {self.value:g}")
        if not 0.0 <= self.frequency_factor <= sys.float_info.max:
            raise InputError(f"a duty's frequency must change by a factor >= 0, got {self.frequency_factor:g}")
        if self.name == "duty" and self.opening.rise is None:
            raise InputError(f"a duty must change at one time or grow from one to another, got {self.opening}")

    @property
    def row(self) -> FaultRow:
        """The entry of `faults.toml` that describes this kind of fault."""
        return FAULTS[self.name]

    @property
    def kind(self) -> str:
        """Name under which tables and confusion matrices count the fault, such as "pump leakage"."""
        return self.row.kind

    def onset(self) -> float:
        """Return the time [s] at which the fault begins."""
        return self.opening.onset()

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        """Build the changes of the machine's or a sensor's parameters over time that the fault causes (`FaultRow`).

        They grow with the fault's opening (0 to 1). Raises InputError if this rig cannot have the fault: a part is
        absent, or a needed parameter is 0.
        """
        row = self.row
        if row.needs is not None:
            pattern, rule = row.needs
            if rig[name := pattern.format(at=self.at)] == 0:
                raise InputError(f"{rule} {name} > 0, got 0 ({self})")
        if self.name in _EFFECTS:
            return _EFFECTS[self.name](self, rig)
        if row.factor:
            healthy, size = 1.0, self.value - 1.0
            max_change = FAULT_MAX_CHANGE * max(abs(size), 1e-3)  # above 0 for a factor of 1
        else:
            healthy, size = 0.0, self.value
            if row.adds:
                size = float(rig[row.adds])
            elif row.over:
                size /= float(rig[row.over])
            # infinite for size 0, which changes nothing; size < 0 occurs for sensors only, where it is not used
            max_change = FAULT_MAX_CHANGE * size or math.inf
        return tuple(
            Effect(
                name.format(at=self.at, gain=GAIN_PARAMETERS.get(self.at)),
                lambda t: healthy + size * self.opening.value_at(t),
                max_change,
                additive=not row.factor,
                breakpoints=self.opening.breakpoints(),
                min_block=_VALVE_BLOCK if row.when == "operated" else SHORTEST_BLOCK,
            )
            for name in row.parameters
        )

    def stuck_span(self) -> tuple[float, float] | None:
        """Find the time span [s] over which a stuck sensor repeats its reading; None for any other fault."""
        if self.name != "sensor stuck":
            return None
        never_ends = self.opening.y[-1] > 0  # the opening stays as at its last point
        return self.onset(), math.inf if never_ends else float(self.opening.t[-1])

    def change_command(self, command: Command) -> Command:
        """Apply a fault of the duty to a command's amplitude and frequency; return it unchanged for any other fault."""
        return ChangedDuty(command, self) if self.name == "duty" else command

    def viscosity_ratio(self, rig: Rig) -> Callable[[Array], Array] | None:
        """Build a function that computes the oil's dynamic viscosity at times t [s], relative to that in the rig.

        Returns None unless this is a fault of the oil's temperature.
        """
        if self.name != "oil":
            return None
        from sealscope.physics.fluid import kinematic_viscosity, thermal_density_ratio

        oil = rig.fluid
        rig_nu = float(kinematic_viscosity(np.asarray(oil.T_oil), oil.nu_40, oil.nu_100))

        def dynamic_viscosity_ratio(t: Array) -> Array:
            """Compute kinematic viscosity times density at times t [s], over those at the rig's temperature."""
            T = self.oil_temperature(rig, t)
            nu_ratio = kinematic_viscosity(T, oil.nu_40, oil.nu_100) / rig_nu
            return np.asarray(nu_ratio * thermal_density_ratio(T, oil.T_oil, oil.alpha))

        return dynamic_viscosity_ratio

    def oil_temperature(self, rig: Rig, t: Array) -> Array:
        """Compute the oil's temperature [K] at times t [s]: that of the rig, plus the part by this fault."""
        return np.asarray(rig.fluid.T_oil + self.value * self.opening.value_at(t))

    def __str__(self) -> str:
        template = self.row.words
        if self.name == "duty":
            changes_frequency = self.frequency_factor != 1.0
            template += " amplitude x{value}" if self.value != 1.0 or not changes_frequency else ""
            template += f" frequency x{format_number(self.frequency_factor)}" if changes_frequency else ""
        value, percent, signed = format_number(self.value), format_number(100.0 * self.value), f"{self.value:+.12g}"
        lpm, unit = self.value / LITRE_PER_MINUTE, CHANNEL_UNITS.get(self.at)
        text = template.format(at=self.at, value=value, lpm=lpm, unit=unit, percent=percent, signed=signed)
        return f"{text} {self.opening}"


@dataclass(frozen=True)
class ChangedDuty:
    """A command, `before`, whose amplitude and frequency a fault, `change`, changes without a jump of its phase."""

    before: Command
    change: Fault

    def original_time(self, t: Array) -> Array:
        """Compute the times [s] at which the original command has the phase of the changed one at times t [s].

        They are t + (frequency_factor - 1) times the integral of the fault's opening.
        """
        start, stop = self.change.opening.rise or (math.inf, math.inf)  # a fault of the duty always has a rise
        opening_integral = np.maximum(t - start, 0.0)  # for a jump of the opening at `start`
        if stop > start:
            ramp_time = np.minimum(opening_integral, stop - start)
            opening_integral = ramp_time**2 / (2.0 * (stop - start)) + np.maximum(t - stop, 0.0)
        return np.asarray(t + (self.change.frequency_factor - 1.0) * opening_integral)

    def volts(self, t: Array) -> Array:
        """Compute the voltage u [V] of the changed command at times t [s]."""
        amplitude_factor = 1.0 + (self.change.value - 1.0) * self.change.opening.value_at(t)
        return np.asarray(amplitude_factor * self.before.volts(self.original_time(t)))

    def __str__(self) -> str:
        return f"{self.before}, {self.change}"


def _shut_off_effects(fault: Fault, rig: Rig) -> tuple[Effect, ...]:
    """Build the changes of the flow coefficients of one line's throttle by the shut-off valve in series with it.

    The throttle has a coefficient for each direction of flow. Raises InputError if the rig's lines have no throttles.
    """
    from sealscope.physics.restrictors import orifice_coefficient, series_coefficient
    from sealscope.physics.rig import throttle_coefficients

    line = rig.line
    if line.orifices == "absent":
        raise InputError(f"a shut-off valve must be in a line (line.orifices = present), got absent ({fault})")
    c_line = orifice_coefficient(line.C_d, math.pi / 4.0 * line.d_line**2, rig.fluid.rho)  # line without throttle
    open_coefficients = throttle_coefficients(rig.with_overrides({"line.open_A": 1.0, "line.open_B": 1.0}))
    initial_opening = line.open_A if fault.at == "A" else line.open_B

    def build_effect(name: str, c_open: float) -> Effect:
        """Build the effect on the coefficient `name`, `c_open` [m^3/(s Pa^0.5)] with a fully open valve."""
        c_initial = c_open if initial_opening >= 1.0 else series_coefficient(c_open, c_line, initial_opening)

        def change(t: Array) -> Array:
            """Compute the change of the coefficient [m^3/(s Pa^0.5)] at times t [s]."""
            opening = initial_opening + (fault.value - initial_opening) * fault.opening.value_at(t)
            # exactly `c_open` while fully open, as for `c_initial`, without the rounding of `series_coefficient`
            return np.asarray(np.where(opening >= 1.0, c_open, series_coefficient(c_open, c_line, opening)) - c_initial)

        max_change = 1e-6 * c_open  # so small that the coefficient of a moving valve changes at each solver output
        return Effect(
            name, change, max_change, additive=True, breakpoints=fault.opening.breakpoints(), min_block=_VALVE_BLOCK
        )

    pairs = zip(THROTTLES, open_coefficients, strict=True)
    return tuple(build_effect(name, c_open) for name, c_open in pairs if name.startswith(f"c_{fault.at}_"))


def _oil_temperature_effects(fault: Fault, rig: Rig) -> tuple[Effect, ...]:
    """Build the changes of the model's parameters over time that a fault of the oil's temperature causes."""
    from sealscope.physics.fluid import thermal_density_ratio, thermal_stiffness_ratio

    viscosity, T_0 = fault.viscosity_ratio(rig), rig.fluid.T_oil
    assert viscosity is not None

    def density_power(power: float) -> Callable[[Array], Array]:
        """Build a function that computes, at times t [s], the `power` of the oil's density relative to that at T_0."""
        alpha = rig.fluid.alpha
        return lambda t: np.asarray(thermal_density_ratio(fault.oil_temperature(rig, t), T_0, alpha) ** power)

    # viscous friction of piston and motor, filter resistances
    factors: list[tuple[str, Callable[[Array], Array]]] = [(name, viscosity) for name in ("F_v", "B_M", "R_A", "R_B")]
    # leakage conductances of the pump and past the rod seals
    factors += [(name, lambda t: 1.0 / viscosity(t)) for name in ("G_pump", "G_ext_A", "G_ext_B")]
    factors += [("K_oil", lambda t: thermal_stiffness_ratio(fault.oil_temperature(rig, t), T_0))]
    factors += [(name, density_power(power)) for name, power in model_parameters_derived_from("fluid.rho")]
    return tuple(
        Effect(name, factor, MAX_RELATIVE_CHANGE, breakpoints=fault.opening.breakpoints()) for name, factor in factors
    )


#: Functions that build the effects of faults that do not simply multiply or add to the parameters in their row.
_EFFECTS = {"shut-off": _shut_off_effects, "oil": _oil_temperature_effects}
#: The kinds of faults, by name.
FAULTS: Mapping[str, FaultRow] = {
    name: FaultRow(name, **row)
    for name, row in tomllib.loads(Path(__file__).with_name("faults.toml").read_text(encoding="utf-8")).items()
}


def parse_fault(text: str) -> Fault | None:
    """Parse the text of a fault, such as "pump leak x3 from 90 s"; return None for ``none``.

    Operations of the rig, such as `circulation`, are faults, too. Raises InputError, which lists the forms, for any
    other text.
    """
    stripped = normalize_blanks(text, "fault")
    if stripped.lower() in ("none", "no fault"):
        return None
    for row in FAULTS.values():
        if fault := row.parse(stripped):
            return fault
    raise InputError(
        "fault must be like 'pump leak x3 from 90 s', 'pump leak G = 5e-13', 'rod seal A 0.01 L/min from 90 s', "
        "'friction +20 % growing from 60 s to 120 s', 'air 1 % from 90 s', 'sensor p_A offset 2 psi from 90 s', "
        "'sensor p_A gain 1 %', 'sensor p_A stuck from 90 s to 100 s', 'duty amplitude x1.5 frequency x0.8 from 90 s', "
        "'shut-off A to 0 % from 60 s to 90 s within 0.5 s', 'circulation from 60 s', 'filter A x10 from 90 s', 'oil "
        f"+20 K from 90 s' or 'none', got {text!r}"
    )
