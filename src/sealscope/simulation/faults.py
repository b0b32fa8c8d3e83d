"""Faults of machine, sensors and duty over time, as data and as text: the table `faults.toml`, and one class.

A text such as ``pump leak x3 growing from 1 min to 2 min`` is read by `parse_fault`; leaks across the piston stand in
`leaks`.
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
from sealscope.recordings.recording import CHANNEL_UNITS, Array
from sealscope.simulation.changes import RESOLUTION, SHORTEST_BLOCK, THROTTLES, Effect, Hold, fields_of
from sealscope.simulation.commands import NUMBER, TIME, UNSIGNED, Command, Polyline, number_text, plain_text
from sealscope.simulation.leaks import WHEN, Part, from_time, opening_of
from sealscope.units import LITRE_PER_MINUTE, parse_quantity

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Most of a fault that comes or goes from one block of the solver to the next.
SHARE_RESOLUTION = 5e-3
#: Channels whose sensors can be faulty, and the parameter of each sensor that holds its relative error of gain.
GAINS = {
    **dict.fromkeys(("p_1", "p_2", "p_A", "p_B"), "gain_error"),
    "x": "scale_error",
    "q_leak": "gain_error",
}
#: A valve that moves is held within blocks of one output of the solver, whatever their length [s].
_VALVE_BLOCK = 0.0
_SPAN = rf"(?:\s+from\s+(?P<since>{TIME})(?:\s+to\s+(?P<until>{TIME}))?)?"
#: When a fault is there: `from 60 s`, `growing from ..`; `from 60 s to 90 s` of a stuck sensor, `within 0.5 s` of a
#: valve that is operated.
_WHEN = {"grows": WHEN, "lasts": _SPAN, "operated": rf"{_SPAN}(?:\s+within\s+(?P<ramp>{TIME}))?"}
#: What stands in braces in the patterns of `faults.toml`.
_PATTERNS = {
    "number": NUMBER,
    "factor": rf"(?:x\s*(?P<times>{NUMBER})|(?P<percent>[-+]\s*{UNSIGNED})\s*%)",
    "share": rf"(?P<share>{NUMBER})\s*(?P<sign>%?)",
    "size": rf"(?P<size>{NUMBER}\s*(?:\[[^\]]+\]|[a-zA-Z][a-zA-Z0-9^/_]*))",
    "difference": rf"(?P<value>[-+]\s*{UNSIGNED})",
    "sensor": r"sensor\s+(?P<at>\w+)",
    "seal": r"(?:rod\s+seal|external\s+leak(?:age)?)\s+(?P<at>[ABab])",
}


def _number(text: str | None) -> float:
    return float((text or "0").replace(" ", ""))


@dataclass(frozen=True)
class FaultRow:
    """The effects and words of a kind of fault: an entry of `faults.toml`, whose head explains its keys."""

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
    def of_sensor(self) -> bool:
        """True for a fault of a sensor."""
        return self.kind.startswith("sensor")

    def read(self, text: str) -> Fault | None:
        """Read the fault of a text; None where it is another kind."""
        pattern = self.pattern.format(**_PATTERNS).replace(" ", r"\s+") + _WHEN[self.when]
        match = re.fullmatch(pattern, text, re.IGNORECASE)
        if match is None:
            return None
        part = match.groupdict()
        place = part.get("at") or ""
        place = place if self.of_sensor else place.upper()
        return Fault(self.name, self._value(part), place, opening_of(part), _number(part.get("pace") or "1"))

    def _value(self, part: Part) -> float:
        if part.get("size") is not None:
            unit = CHANNEL_UNITS.get(part["at"] or "", "Pa") if self.of_sensor else self.unit
            return parse_quantity(part["size"] or "", unit, name=self.what)
        if part.get("percent") is not None:
            return 1.0 + _number(part["percent"]) / 100.0
        if part.get("share") is not None:
            return _number(part["share"]) / (100.0 if part["sign"] else 1.0)
        return _number(part.get("times") or part.get("value") or ("1" if self.factor else "0"))


@dataclass(frozen=True)
class Fault:
    """A fault other than a leak across the piston: the row `name` of `FAULTS`.

    `value` is a factor or what is added, in SI units; `at` the side or the channel; `pace` of a duty: how many times as
    fast it runs. Its `opening` says when: 0 is a healthy machine, 1 the whole fault; its text is what `parse_fault`
    reads.
    """

    name: str
    value: float = 0.0
    at: str = ""
    opening: Polyline = field(default_factory=from_time)
    pace: float = 1.0

    def __post_init__(self) -> None:
        row = self.row
        if row.of_sensor and self.at not in GAINS:
            raise InputError(f"a faulty sensor must be one of {', '.join(GAINS)}, got {self.at!r}")
        if not row.of_sensor and "{at}" in row.words and self.at not in ("A", "B"):
            raise InputError(f"a {self.name} must be A or B, got {self.at!r}")
        if not (math.isfinite(self.value) and row.least <= self.value <= row.most):
            raise InputError(f"{row.what} must {row.allowed}, got {self.value:g}")
        if not 0.0 <= self.pace <= sys.float_info.max:
            raise InputError(f"a duty's frequency must change by a factor >= 0, got {self.pace:g}")
        if self.name == "duty" and self.opening.rise is None:
            raise InputError(f"a duty must change at one time or grow from one to another, got {self.opening}")

    @property
    def row(self) -> FaultRow:
        """The table's row of this kind of fault."""
        return FAULTS[self.name]

    @property
    def kind(self) -> str:
        """One name for all faults of a kind, for tables and confusion matrices."""
        return self.row.kind

    def onset(self) -> float:
        """Return the first time [s] at which the fault is present."""
        return self.opening.onset()

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        """Build the effects on the machine or a sensor; raise InputError where the fault cannot be on this rig."""
        row = self.row
        if row.needs is not None and rig[name := row.needs[0].format(at=self.at)] == 0:
            raise InputError(f"{row.needs[1]} {name} > 0, got 0 ({self})")
        if self.name in _EFFECTS:
            return _EFFECTS[self.name](self, rig)
        if row.factor:
            size, step = self.value - 1.0, SHARE_RESOLUTION * max(abs(self.value - 1.0), 1e-3)
        else:
            size = float(rig[row.adds]) if row.adds else self.value / (float(rig[row.over]) if row.over else 1.0)
            step = SHARE_RESOLUTION * size or math.inf
        whole = 1.0 if row.factor else 0.0
        return tuple(
            Effect(
                name.format(at=self.at, gain=GAINS.get(self.at)),
                lambda t: whole + size * self.opening.value_at(t),
                step,
                added=not row.factor,
                jumps=self.opening.bends(),
                shortest=_VALVE_BLOCK if row.when == "operated" else SHORTEST_BLOCK,
            )
            for name in row.parameters
        )

    def holds(self) -> tuple[Hold, ...]:
        """List the readings that repeat themselves because of the fault."""
        if self.name != "sensor stuck":
            return ()
        stop = math.inf if self.opening.y[-1] > 0 else float(self.opening.t[-1])
        return (Hold(self.at, self.onset(), stop),)

    def commanded(self, command: Command) -> Command:
        """Build the command that the rig receives in place of `command`."""
        return ChangedDuty(command, self) if self.name == "duty" else command

    def viscosity(self, rig: Rig) -> Callable[[Array], Array] | None:
        """Build the function of times [s] for the oil's viscosity over the rig's; None for a constant one."""
        if self.name != "oil":
            return None
        from sealscope.physics.fluid import kinematic_viscosity, thermal_density

        oil = rig.fluid
        at_rig = float(kinematic_viscosity(np.asarray(oil.T_oil), oil.nu_40, oil.nu_100))

        def ratio(t: Array) -> Array:
            T = self._warmth(rig, t)
            thick = kinematic_viscosity(T, oil.nu_40, oil.nu_100) / at_rig
            return np.asarray(thick * thermal_density(T, oil.T_oil, oil.alpha))

        return ratio

    def _warmth(self, rig: Rig, t: Array) -> Array:
        return np.asarray(rig.fluid.T_oil + self.value * self.opening.value_at(t))

    def __str__(self) -> str:
        words = self.row.words
        if self.name == "duty":
            paced = self.pace != 1.0
            words = "duty amplitude x{value}" if self.value != 1.0 or not paced else "duty"
            words += f" frequency x{number_text(self.pace)}" if paced else ""
        value, lpm = number_text(self.value), self.value / LITRE_PER_MINUTE
        shares = {"percent": number_text(100.0 * self.value), "signed": f"{self.value:+.12g}"}
        words = words.format(at=self.at, value=value, lpm=lpm, unit=CHANNEL_UNITS.get(self.at), **shares)
        return f"{words} {self.opening}"


@dataclass(frozen=True)
class ChangedDuty:
    """The command `before`, made larger and faster as `change` states, without a jump in its phase."""

    before: Command
    change: Fault

    def clock(self, t: Array) -> Array:
        """Compute the time on the command's own clock: t + (pace - 1) x integral of the opening."""
        start, stop = self.change.opening.rise or (math.inf, math.inf)
        since = np.maximum(t - start, 0.0)
        if stop > start:
            grown = np.minimum(since, stop - start)
            since = grown**2 / (2.0 * (stop - start)) + np.maximum(t - stop, 0.0)
        return np.asarray(t + (self.change.pace - 1.0) * since)

    def volts(self, t: Array) -> Array:
        """Compute u [V] at times t [s]."""
        size = 1.0 + (self.change.value - 1.0) * self.change.opening.value_at(t)
        return np.asarray(size * self.before.volts(self.clock(t)))

    def __str__(self) -> str:
        return f"{self.before}, {self.change}"


def _shut_off(fault: Fault, rig: Rig) -> tuple[Effect, ...]:
    """Build the change of the coefficients of the line's throttle; raise InputError for a rig without a line."""
    from sealscope.physics.restrictors import behind_shut_off, orifice_coefficient
    from sealscope.physics.rig import throttle_coefficients

    line = rig.line
    if line.orifices == "absent":
        raise InputError(f"a shut-off valve must be in a line (line.orifices = present), got absent ({fault})")
    c_line = orifice_coefficient(line.C_d, math.pi / 4.0 * line.d_line**2, rig.fluid.rho)
    open_coefficients = throttle_coefficients(rig.with_overrides({"line.open_A": 1.0, "line.open_B": 1.0}))
    before = line.open_A if fault.at == "A" else line.open_B

    def effect(name: str, c: float) -> Effect:
        initial = c if before >= 1.0 else behind_shut_off(c, c_line, before)

        def change(t: Array) -> Array:
            s = before + (fault.value - before) * fault.opening.value_at(t)
            return np.asarray(np.where(s >= 1.0, c, behind_shut_off(c, c_line, s)) - initial)

        return Effect(name, change, 1e-6 * c, added=True, jumps=fault.opening.bends(), shortest=_VALVE_BLOCK)

    return tuple(effect(name, c) for name, c in zip(THROTTLES, open_coefficients, strict=True) if name[2] == fault.at)


def _warmer(fault: Fault, rig: Rig) -> tuple[Effect, ...]:
    """Build the change of all numbers that follow the oil: its viscosity, density and bulk modulus.

    Laminar gaps (pump, rod seals, piston, filters: R = 1/G) pass oil as 1/viscosity, viscous friction of piston and
    shaft goes with it.
    """
    from sealscope.physics.fluid import thermal_density, thermal_stiffness

    thick, T_0 = fault.viscosity(rig), rig.fluid.T_oil
    assert thick is not None

    def lighter(power: float) -> Callable[[Array], Array]:
        return lambda t: np.asarray(thermal_density(fault._warmth(rig, t), T_0, rig.fluid.alpha) ** power)

    factors: list[tuple[str, Callable[[Array], Array]]] = [(name, thick) for name in ("F_v", "B_M", "R_A", "R_B")]
    factors += [(name, lambda t: 1.0 / thick(t)) for name in ("G_pump", "G_ext_A", "G_ext_B")]
    factors += [("K_oil", lambda t: thermal_stiffness(fault._warmth(rig, t), T_0))]
    factors += [(name, lighter(power)) for name, power in fields_of("fluid.rho")]
    return tuple(Effect(name, factor, RESOLUTION, jumps=fault.opening.bends()) for name, factor in factors)


#: Faults that change more than a parameter or two.
_EFFECTS = {"shut-off": _shut_off, "oil": _warmer}
#: What faults change, by name.
FAULTS: Mapping[str, FaultRow] = {
    name: FaultRow(name, **row)
    for name, row in tomllib.loads(Path(__file__).with_name("faults.toml").read_text(encoding="utf-8")).items()
}


def parse_fault(text: str) -> Fault | None:
    """Read a fault from text; None for ``none``.

    A rod seal's flow is that at the charge pressure; operations such as `circulation` are no faults. Raises InputError
    that shows the forms when the text is none of them.
    """
    stripped = plain_text(text, "fault")
    if stripped.lower() in ("none", "no fault"):
        return None
    for row in FAULTS.values():
        if fault := row.read(stripped):
            return fault
    raise InputError(
        "fault must be like 'pump leak x3 from 90 s', 'pump leak G = 5e-13', 'rod seal A 0.01 L/min from 90 s', "
        "'friction +20 % growing from 60 s to 120 s', 'air 1 % from 90 s', 'sensor p_A offset 2 psi from 90 s', "
        "'sensor p_A gain 1 %', 'sensor p_A stuck from 90 s to 100 s', 'duty amplitude x1.5 frequency x0.8 from 90 s', "
        "'shut-off A to 0 % from 60 s to 90 s within 0.5 s', 'circulation from 60 s', 'filter A x10 from 90 s', 'oil "
        f"+20 K from 90 s' or 'none', got {text!r}"
    )
