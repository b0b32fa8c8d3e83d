"""Faults over time, as data and as text: leaks across the piston, and faults of machine, sensors and duty.

An opening says how far a fault is open at each instant. A text such as ``0.0042 L/min from 90 s`` or ``pump leak x3
growing from 1 min to 2 min`` is read by `parse_leak` and `parse_fault`.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Literal, Protocol

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import CHANNEL_UNITS, Array
from sealscope.simulation.changes import GROUPS, RESOLUTION, THROTTLES, Adjustment, Effect, Hold, fields_of
from sealscope.simulation.commands import NUMBER, TIME, UNSIGNED, Command, number_text, plain_text, seconds
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


class Opening(Protocol):
    """How far a fault is open: 0 is closed, 1 is fully open."""

    def share(self, t: Array) -> Array:
        """Return the opening in 0..1 at times t [s] (any shape)."""
        ...

    def onset(self) -> float:
        """Return the first time [s] at which it is open."""
        ...

    def __str__(self) -> str: ...


@dataclass(frozen=True)
class From:
    """Closed before `at` [s], fully open from then on."""

    at: float = 0.0

    def share(self, t: Array) -> Array:
        """Return the opening at times t [s]."""
        return np.where(t >= self.at, 1.0, 0.0)

    def onset(self) -> float:
        """Return `at` [s]."""
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
        """Return the opening at times t [s]."""
        return np.clip((t - self.start) / (self.stop - self.start), 0.0, 1.0)

    def onset(self) -> float:
        """Return `start` [s]."""
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
        """Return the opening at times t [s]."""
        return np.interp(t, self.t, self.opening)

    def onset(self) -> float:
        """Return the time [s] of the last point before the first that is open; infinity where none is."""
        opened = np.flatnonzero(self.opening > 0)
        if opened.size == 0:
            return math.inf
        return float(self.t[max(int(opened[0]) - 1, 0)] if opened[0] > 0 else 0.0)

    def __str__(self) -> str:
        return f"table of {self.t.size} points over {self.t[0]:g}..{self.t[-1]:g} s"


@dataclass(frozen=True)
class Between:
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

    def onset(self) -> float:
        """Return `start` [s]."""
        return self.start

    def __str__(self) -> str:
        until = f" to {number_text(self.stop)} s" if math.isfinite(self.stop) else ""
        within = f" within {number_text(self.ramp)} s" if self.ramp else ""
        return f"from {number_text(self.start)} s{until}{within}"


@dataclass(frozen=True, eq=False)
class Thinned:
    """The `opening` of a laminar gap, as a share of what it passes at the rig's viscosity: over `viscosity` at t."""

    opening: Opening
    viscosity: Callable[[Array], Array]

    def share(self, t: Array) -> Array:
        """Return the opening at times t [s] over the oil's viscosity, that of the rig being 1."""
        return self.opening.share(t) / self.viscosity(t)

    def onset(self) -> float:
        """Return the onset [s] of the gap."""
        return self.opening.onset()

    def __str__(self) -> str:
        return f"{self.opening}, in oil that changes its temperature"


def bends(opening: Opening) -> tuple[float, ...]:
    """Return the times [s] at which an opening jumps or bends, as far as its form tells."""
    if isinstance(opening, Growing):
        return opening.start, opening.stop
    if isinstance(opening, Between):
        return opening.start, opening.start + opening.ramp, opening.stop, opening.stop + opening.ramp
    if isinstance(opening, Tabulated) and opening.t.size < 1000:
        return tuple(map(float, opening.t))
    return (opening.onset(),)


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


class Fault:
    """A fault other than a leak across the piston: what it changes in the machine, at the instruments, or in the duty.

    Its `opening` says when: 0 is a healthy machine, 1 the whole fault; its text is what `parse_fault` reads.
    """

    #: One name for all faults of a kind, for tables and confusion matrices.
    kind: ClassVar[str]
    opening: Opening

    def onset(self) -> float:
        """Return the first time [s] at which it is there."""
        return self.opening.onset()

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        """Return what it changes in the machine; InputError where it cannot be on this rig."""
        return ()

    def adjustments(self) -> tuple[Adjustment, ...]:
        """Return what it changes at the instruments."""
        return ()

    def holds(self) -> tuple[Hold, ...]:
        """Return the readings that it makes repeat themselves."""
        return ()

    def commanded(self, command: Command) -> Command:
        """Return the command that the rig gets instead of `command`."""
        return command

    def viscosity(self, rig: Rig) -> Callable[[Array], Array] | None:
        """Return the oil's viscosity over that of the rig, as a function of times [s]; None where it stays."""
        return None

    def _times(self, name: str, factor: float) -> Effect:
        """Return a number that is multiplied by `factor` when the fault is whole."""
        step = SHARE_RESOLUTION * max(abs(factor - 1.0), 1e-3)
        return Effect(name, lambda t: 1.0 + (factor - 1.0) * self.opening.share(t), step, jumps=bends(self.opening))

    def _plus(self, name: str, size: float) -> Effect:
        """Return a number to which `size` is added when the fault is whole."""
        step = SHARE_RESOLUTION * size or math.inf
        return Effect(name, lambda t: size * self.opening.share(t), step, added=True, jumps=bends(self.opening))


def _check_factor(factor: float, what: str) -> None:
    if not (math.isfinite(factor) and factor >= 0):
        raise InputError(f"{what} must change by a factor >= 0, got {factor:g}")


@dataclass(frozen=True)
class ChangeOfParameters:
    """What a fault of a kind changes, in what words: a row of `CHANGES`.

    `words` have places for `{value}` (or `{lpm}`, `{unit}`) and for `{at}`, a side or a channel, as have `parameters`.
    These are multiplied by the value where it is a `factor`; otherwise it is added to them, over the rig's parameter
    `over`. `needs`: a parameter that must be > 0 on the rig, and who needs it; `least`, `most`: of the value, as
    `allowed` says after `what`.
    """

    kind: str
    words: str
    parameters: tuple[str, ...]
    what: str
    factor: bool = False
    needs: tuple[str, str] | None = None
    over: str | None = None
    least: float = 0.0
    most: float = sys.float_info.max
    allowed: str = "change by a factor >= 0"


_PUMP_LEAK, _SEAL_LEAK = "a pump leak", "a rod seal's leak"
#: What faults that change parameters change. Adding friction: dry or swollen seals, a side load. Rod seals lose oil as
#: Q = G p, their `flow` is that at the charge pressure; a closed circuit holds 8e-13 m^3 of oil for each pascal: give
#: the rig a make-up (`makeup.check_valves = "present"`), or it runs empty. A filter that grows evenly under a steady
#: duty is cake filtration, R = R_0 (1 + V/V_c) over the volume V that has passed (J. Hermia, Constant pressure blocking
#: filtration laws, Trans. IChemE 60 (1982) 183-187). Sensors read an offset in the channel's SI unit too much, or a
#: share.
CHANGES: Mapping[str, ChangeOfParameters] = {
    "pump leak": ChangeOfParameters(
        "pump leakage", "pump leak x{value}", ("G_pump",), _PUMP_LEAK, factor=True,
        needs=("pump.G_pump", "a pump leak by a factor needs"),
    ),
    "pump leak G": ChangeOfParameters(
        "pump leakage", "pump leak G = {value}", ("G_pump",), _PUMP_LEAK, allowed="be >= 0 m^3/(s Pa) and finite"
    ),
    "rod seal": ChangeOfParameters(
        "external leakage", "rod seal {at} {lpm:g} L/min", ("G_ext_{at}",), _SEAL_LEAK, over="fluid.p_charge",
        needs=("fluid.p_charge", "a rod seal's flow needs"), allowed="be >= 0 m^3/s and finite",
    ),
    "rod seal G": ChangeOfParameters(
        "external leakage", "rod seal {at} G = {value}", ("G_ext_{at}",), _SEAL_LEAK,
        allowed="be >= 0 m^3/(s Pa) and finite",
    ),
    "friction": ChangeOfParameters(
        "friction", "friction x{value}", tuple(of.rpartition(".")[2] for of in GROUPS["friction"]), "friction",
        factor=True,
    ),
    "air": ChangeOfParameters(
        "air", "air {value}", ("air",), "air in the oil", most=0.5, allowed="be 0 to 0.5 (0 % to 50 %) of its volume"
    ),
    "filter": ChangeOfParameters(
        "filter", "filter {at} x{value}", ("R_{at}",), "a filter's resistance", factor=True,
        needs=("line.R_{at}", "a filter that clogs must have"),
    ),
    "sensor offset": ChangeOfParameters(
        "sensor offset", "sensor {at} offset {value} {unit}", ("sensors.{at}.offset",), "the offset of a faulty sensor",
        least=-sys.float_info.max, allowed="be finite",
    ),
    "sensor gain": ChangeOfParameters(
        "sensor gain", "sensor {at} gain {value}", ("sensors.{at}.{gain}",), "the gain error of a sensor",
        least=math.nextafter(-1.0, 0.0), allowed="be > -100 % and finite",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class ParameterFault(Fault):
    """A fault that changes parameters of the machine or of a sensor: the row `name` of `CHANGES`.

    `value` is a factor or what is added, in SI units; `at` the side or the channel.
    """

    name: str
    value: float
    at: str = ""
    opening: Opening = field(default_factory=From)

    def __post_init__(self) -> None:
        if self.name.startswith("sensor"):
            _check_channel(self.at)
        elif "{at}" in self._row.words and self.at not in ("A", "B"):
            raise InputError(f"a {self.name} must be A or B, got {self.at!r}")
        if not self._row.least <= self.value <= self._row.most:
            raise InputError(f"{self._row.what} must {self._row.allowed}, got {self.value:g}")

    @property
    def _row(self) -> ChangeOfParameters:
        return CHANGES[self.name]

    @property
    def kind(self) -> str:  # type: ignore[override]
        """The kind that this fault is one of."""
        return self._row.kind

    def _parameters(self) -> tuple[str, ...]:
        return tuple(name.format(at=self.at, gain=GAINS.get(self.at)) for name in self._row.parameters)

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        """Return the change of the machine's parameters."""
        if self.name.startswith("sensor"):
            return ()
        row = self._row
        if row.needs is not None and rig[name := row.needs[0].format(at=self.at)] == 0:
            raise InputError(f"{row.needs[1]} {name} > 0, got 0 ({self})")
        if row.factor:
            return tuple(self._times(name, self.value) for name in self._parameters())
        size = self.value if row.over is None else self.value / float(rig[row.over])
        return tuple(self._plus(name, size) for name in self._parameters())

    def adjustments(self) -> tuple[Adjustment, ...]:
        """Return the change of the sensor's parameters."""
        if not self.name.startswith("sensor"):
            return ()
        return tuple(
            Adjustment(name, lambda t: self.value * self.opening.share(t), added=True) for name in self._parameters()
        )

    def __str__(self) -> str:
        unit, lpm = CHANNEL_UNITS.get(self.at), self.value / LITRE_PER_MINUTE
        words = self._row.words.format(at=self.at, value=number_text(self.value), lpm=lpm, unit=unit)
        return f"{words} {self.opening}"


#: A valve that moves is held within blocks of one output of the solver, whatever their length [s].
_VALVE_BLOCK = 0.0


@dataclass(frozen=True)
class ShutOff(Fault):
    """The shut-off valve in line A or B moves to the opening `to` (0: shut), and back when its opening ends.

    It is no fault of the machine, but an operation of it; `line.open_A`, `line.open_B` are where the valves stand
    before.
    """

    side: Literal["A", "B"]
    to: float = 0.0
    opening: Opening = field(default_factory=From)
    kind: ClassVar[str] = "shut-off valve"

    def __post_init__(self) -> None:
        if self.side not in ("A", "B"):
            raise InputError(f"a shut-off valve must be in line A or B, got {self.side!r}")
        if not 0.0 <= self.to <= 1.0:
            raise InputError(f"a shut-off valve must open 0 % to 100 %, got {100.0 * self.to:g} %")

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        """Return the change of the coefficients of the line's throttle; a valve needs a line."""
        from sealscope.physics.restrictors import behind_shut_off, orifice_coefficient
        from sealscope.physics.rig import throttle_coefficients

        line = rig.line
        if line.orifices == "absent":
            raise InputError(f"a shut-off valve must be in a line (line.orifices = present), got absent ({self})")
        c_line = orifice_coefficient(line.C_d, math.pi / 4.0 * line.d_line**2, rig.fluid.rho)
        whole = throttle_coefficients(rig.with_overrides({"line.open_A": 1.0, "line.open_B": 1.0}))
        before = line.open_A if self.side == "A" else line.open_B

        def effect(name: str, c: float) -> Effect:
            own = c if before >= 1.0 else behind_shut_off(c, c_line, before)

            def change(t: Array) -> Array:
                s = before + (self.to - before) * self.opening.share(t)
                return np.asarray(np.where(s >= 1.0, c, behind_shut_off(c, c_line, s)) - own)

            jumps = bends(self.opening)
            return Effect(name, change, 1e-6 * c, added=True, jumps=jumps, shortest=_VALVE_BLOCK)

        return tuple(effect(name, c) for name, c in zip(THROTTLES, whole, strict=True) if name[2] == self.side)

    def __str__(self) -> str:
        return f"shut-off {self.side} to {number_text(100.0 * self.to)} % {self.opening}"


@dataclass(frozen=True)
class Circulation(Fault):
    """The circulation valve between the ports of the pump opens: Q = `line.G_circ` (p_1 - p_2) beside the pump's slip.

    It is no fault of the machine, but an operation of it. Q_1 is then what is left of the pump's flow.
    """

    opening: Opening = field(default_factory=From)
    kind: ClassVar[str] = "circulation valve"

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        """Return the change of `G_pump`; the rig must have such a valve."""
        G = rig.line.G_circ
        if G == 0:
            raise InputError(f"a circulation valve must have line.G_circ > 0, got 0 ({self})")
        return (replace(self._plus("G_pump", G), shortest=_VALVE_BLOCK),)

    def __str__(self) -> str:
        return f"circulation {self.opening}"


@dataclass(frozen=True)
class OilTemperature(Fault):
    """The oil becomes `change` [K] warmer than `fluid.T_oil`: its viscosity, density and bulk modulus move.

    Laminar gaps (pump, rod seals, piston, filters: R = 1/G) pass oil as 1/viscosity, viscous friction of piston and
    shaft goes with it. It is no fault of the machine, but looks like one.
    """

    change: float
    opening: Opening = field(default_factory=From)
    kind: ClassVar[str] = "oil temperature"

    def __post_init__(self) -> None:
        if not abs(self.change) <= 100.0:
            raise InputError(f"the oil's temperature must change by at most 100 K, got {self.change:g} K")

    def _warmth(self, rig: Rig, t: Array) -> Array:
        return np.asarray(rig.fluid.T_oil + self.change * self.opening.share(t))

    def viscosity(self, rig: Rig) -> Callable[[Array], Array]:
        """Return the dynamic viscosity over that of the rig, as a function of times [s]."""
        from sealscope.physics.fluid import kinematic_viscosity, thermal_density

        oil = rig.fluid
        at_rig = float(kinematic_viscosity(np.asarray(oil.T_oil), oil.nu_40, oil.nu_100))

        def ratio(t: Array) -> Array:
            T = self._warmth(rig, t)
            thick = kinematic_viscosity(T, oil.nu_40, oil.nu_100) / at_rig
            return np.asarray(thick * thermal_density(T, oil.T_oil, oil.alpha))

        return ratio

    def effects(self, rig: Rig) -> tuple[Effect, ...]:
        """Return the change of all numbers that go with the oil."""
        from sealscope.physics.fluid import thermal_density, thermal_stiffness

        thick, T_0 = self.viscosity(rig), rig.fluid.T_oil
        effects = []

        def add(name: str, factor: Callable[[Array], Array]) -> None:
            effects.append(Effect(name, factor, RESOLUTION, jumps=bends(self.opening)))

        for name in ("F_v", "B_M", "R_A", "R_B"):
            add(name, thick)
        for name in ("G_pump", "G_ext_A", "G_ext_B"):
            add(name, lambda t: 1.0 / thick(t))
        add("K_oil", lambda t: thermal_stiffness(self._warmth(rig, t), T_0))

        def lighter(power: float) -> Callable[[Array], Array]:
            return lambda t: np.asarray(thermal_density(self._warmth(rig, t), T_0, rig.fluid.alpha) ** power)

        for name, power in fields_of("fluid.rho"):
            add(name, lighter(power))
        return tuple(effects)

    def __str__(self) -> str:
        return f"oil {self.change:+.12g} K {self.opening}"


def _check_channel(channel: str) -> None:
    if channel not in GAINS:
        raise InputError(f"a faulty sensor must be one of {', '.join(GAINS)}, got {channel!r}")


@dataclass(frozen=True)
class SensorStuck(Fault):
    """The sensor of a channel repeats its reading of `at` until `until` [s]."""

    channel: str
    at: float = 0.0
    until: float = math.inf
    kind: ClassVar[str] = "sensor stuck"

    def __post_init__(self) -> None:
        _check_channel(self.channel)
        if not math.isfinite(self.at):
            raise InputError(f"the time of a faulty sensor must be finite, got {self.at} ({self.channel})")
        if not self.until > self.at:
            raise InputError(f"a sensor must be stuck until later than {self.at:g} s, got {self.until:g} s")

    @property
    def opening(self) -> Opening:  # type: ignore[override]
        """From when on the reading repeats itself."""
        return From(self.at)

    def holds(self) -> tuple[Hold, ...]:
        """Return the one reading that repeats itself."""
        return (Hold(self.channel, self.at, self.until),)

    def __str__(self) -> str:
        until = f" to {number_text(self.until)} s" if math.isfinite(self.until) else ""
        return f"sensor {self.channel} stuck from {number_text(self.at)} s{until}"


@dataclass(frozen=True)
class DutyChange(Fault):
    """The command becomes `amplitude` times as large and runs `speed` times as fast, without a jump in its phase.

    It is no fault of the machine, but looks like one.
    """

    amplitude: float = 1.0
    speed: float = 1.0
    opening: From | Growing = field(default_factory=From)
    kind: ClassVar[str] = "duty"

    def __post_init__(self) -> None:
        _check_factor(self.amplitude, "a duty's amplitude")
        _check_factor(self.speed, "a duty's frequency")
        if not isinstance(self.opening, From | Growing):
            raise InputError("a duty must change at one time or grow from one to another, got a table")

    def clock(self, t: Array) -> Array:
        """Return the time on the command's own clock: t + (speed - 1) x integral of the opening."""
        growing = isinstance(self.opening, Growing)
        start, stop = (self.opening.start, self.opening.stop) if growing else (self.opening.at, self.opening.at)  # type: ignore[union-attr]
        since = np.maximum(t - start, 0.0)
        if stop > start:
            grown = np.minimum(since, stop - start)
            since = grown**2 / (2.0 * (stop - start)) + np.maximum(t - stop, 0.0)
        return np.asarray(t + (self.speed - 1.0) * since)

    def commanded(self, command: Command) -> Command:
        """Return the changed command."""
        return ChangedDuty(command, self)

    def __str__(self) -> str:
        parts = []
        if self.amplitude != 1.0 or self.speed == 1.0:
            parts.append(f"amplitude x{number_text(self.amplitude)}")
        if self.speed != 1.0:
            parts.append(f"frequency x{number_text(self.speed)}")
        return f"duty {' '.join(parts)} {self.opening}"


@dataclass(frozen=True)
class ChangedDuty:
    """The command `before`, changed as `change` says."""

    before: Command
    change: DutyChange

    def volts(self, t: Array) -> Array:
        """Return u [V] at times t [s]."""
        size = 1.0 + (self.change.amplitude - 1.0) * self.change.opening.share(t)
        return np.asarray(size * self.before.volts(self.change.clock(t)))

    def __str__(self) -> str:
        return f"{self.before}, {self.change}"


#: When, in texts of leaks and faults: `from 90 s`, `growing from 1 min to 120 s`.
_WHEN = rf"(?:\s+(?:from\s+(?P<at>{TIME})|growing\s+from\s+(?P<start>{TIME})\s+to\s+(?P<stop>{TIME})))?"
#: When a valve is operated: `from 60 s`, `from 60 s to 90 s within 0.5 s`.
_SPAN = rf"(?:\s+from\s+(?P<since>{TIME})(?:\s+to\s+(?P<until>{TIME}))?)?(?:\s+within\s+(?P<ramp>{TIME}))?"
_MEAN = rf"(?P<mean>{UNSIGNED}\s*(?:\[[^\]]+\]|[a-zA-Z][a-zA-Z^0-9]*/[a-zA-Z]+))"
_LEAK = rf"(?:{_MEAN}|(?P<letter>[GC])\s*=\s*(?P<coefficient>{UNSIGNED}))(?:\s+(?P<law>laminar|orifice))?{_WHEN}"
_FACTOR = rf"(?:x\s*(?P<times>{NUMBER})|(?P<percent>[-+]\s*{UNSIGNED})\s*%)"
_SHARE = rf"(?P<share>{NUMBER})\s*(?P<sign>%?)"
_SIZE = rf"(?P<size>{NUMBER}\s*(?:\[[^\]]+\]|[a-zA-Z][a-zA-Z0-9^/_]*))"
_SENSOR = r"sensor\s+(?P<place>\w+)"
_SEAL = r"(?:rod\s+seal|external\s+leak(?:age)?)\s+(?P<place>[ABab])"
_Part = dict[str, str | None]


def _opening(part: _Part) -> From | Growing:
    """Return the opening that the groups of `_WHEN` say; open from the start where they say nothing."""
    if part["start"] is not None and part["stop"] is not None:
        return Growing(seconds(part["start"]), seconds(part["stop"]))
    return From(seconds(part["at"]))


def _between(part: _Part) -> Between:
    """Return the opening that the groups of `_SPAN` say."""
    until = math.inf if part["until"] is None else seconds(part["until"])
    return Between(seconds(part["since"]), until, seconds(part["ramp"]))


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
    match = re.fullmatch(_LEAK, plain_text(text, "leak"))
    if not match:
        raise InputError(
            "leak must be like '0.0042 L/min from 90 s', '0.01 L/min orifice growing from 60 s to 120 s', "
            f"'G = 6.1e-13 from 90 s', 'C = 2e-10', 'table LEAK.csv' or 'none', got {text!r}"
        )
    part = match.groupdict()
    if part["letter"]:
        law: Literal["laminar", "orifice"] = "laminar" if part["letter"] == "G" else "orifice"
        if part["law"] not in (None, law):
            raise InputError(f"{part['letter']} is the coefficient of the {law} law, got law {part['law']} ({text!r})")
        return Leak(law, coefficient=float(part["coefficient"]), opening=_opening(part))
    mean = parse_quantity(part["mean"], "m^3/s", name="a leak")
    return Leak(part["law"] or "laminar", mean=mean, opening=_opening(part))  # type: ignore[arg-type]


def _number(text: str | None) -> float:
    return float((text or "0").replace(" ", ""))


def _factor(part: _Part) -> float:
    return _number(part["times"]) if part["times"] is not None else 1.0 + _number(part["percent"]) / 100.0


def _share(part: _Part) -> float:
    return _number(part["share"]) / (100.0 if part["sign"] else 1.0)


def _size(part: _Part, unit: str, name: str) -> float:
    return parse_quantity(part["size"] or "", unit, name=name)


def _stuck(part: _Part) -> Fault:
    until = math.inf if part["until"] is None else seconds(part["until"])
    return SensorStuck(part["place"] or "", seconds(part["since"]), until)


#: A row of `CHANGES`: its words, and the value that they say.
_CHANGED: tuple[tuple[str, str, Callable[[_Part], float]], ...] = (
    ("pump leak", rf"pump\s+leak(?:age)?\s+{_FACTOR}", _factor),
    ("pump leak G", rf"pump\s+leak(?:age)?\s+G\s*=\s*(?P<G>{NUMBER})", lambda p: _number(p["G"])),
    ("rod seal G", rf"{_SEAL}\s+G\s*=\s*(?P<G>{NUMBER})", lambda p: _number(p["G"])),
    ("rod seal", rf"{_SEAL}\s+{_SIZE}", lambda p: _size(p, "m^3/s", "a rod seal's leak")),
    ("friction", rf"friction\s+{_FACTOR}", _factor),
    ("air", rf"air\s+{_SHARE}", _share),
    ("filter", rf"filter\s+(?P<place>[AB])\s+{_FACTOR}", _factor),
    (
        "sensor offset",
        rf"{_SENSOR}\s+offset\s+{_SIZE}",
        lambda p: _size(p, CHANNEL_UNITS.get(p["place"] or "", "Pa"), "a sensor's offset"),
    ),
    ("sensor gain", rf"{_SENSOR}\s+gain\s+{_SHARE}", _share),
)


def _changed(name: str, value: Callable[[_Part], float]) -> Callable[[_Part], Fault]:
    def fault(part: _Part) -> Fault:
        place = part.get("place") or ""
        return ParameterFault(name, value(part), place if name.startswith("sensor") else place.upper(), _opening(part))

    return fault


_FORMS: tuple[tuple[str, Callable[[_Part], Fault]], ...] = (
    *((pattern + _WHEN, _changed(name, value)) for name, pattern, value in _CHANGED),
    (
        rf"shut-off\s+(?P<side>[AB])\s+to\s+{_SHARE}{_SPAN}",
        lambda p: ShutOff("A" if p["side"] == "A" else "B", _share(p), _between(p)),
    ),
    (rf"circulation{_SPAN}", lambda p: Circulation(_between(p))),
    (rf"oil\s+(?P<kelvin>[-+]\s*{UNSIGNED})\s*K{_WHEN}", lambda p: OilTemperature(_number(p["kelvin"]), _opening(p))),
    (rf"{_SENSOR}\s+stuck(?:\s+from\s+(?P<since>{TIME})(?:\s+to\s+(?P<until>{TIME}))?)?", _stuck),
    (
        rf"duty(?=\s+[af])(?:\s+amplitude\s+x\s*(?P<amplitude>{NUMBER}))?"
        rf"(?:\s+frequency\s+x\s*(?P<speed>{NUMBER}))?{_WHEN}",
        lambda p: DutyChange(_number(p["amplitude"] or "1"), _number(p["speed"] or "1"), _opening(p)),
    ),
)


def parse_fault(text: str) -> Fault | None:
    """Read a fault from text; None for ``none``.

    The forms are ``pump leak x3 from 90 s``, ``pump leak G = 5e-13``, ``rod seal A 0.01 L/min from 90 s`` (flow at the
    charge pressure), ``friction +20 % growing from 60 s to 120 s``, ``air 1 % from 90 s``, ``sensor p_A offset 2 psi
    from 90 s``, ``sensor p_A gain -1 %``, ``sensor p_A stuck from 90 s to 100 s``, and ``duty amplitude x1.5 frequency
    x0.8 from 90 s``. Operations that are no faults: ``shut-off A to 0 % from 60 s to 90 s within 0.5 s``, ``circulation
    from 60 s to 90 s within 0.5 s``, ``filter A x10 growing from 1 min to 5 min``, ``oil +20 K growing from 0 s to 10
    min``. Raises InputError that shows the forms when the text is none of them.
    """
    stripped = plain_text(text, "fault")
    if stripped.lower() in ("none", "no fault"):
        return None
    for pattern, make in _FORMS:
        if match := re.fullmatch(pattern, stripped):
            return make(match.groupdict())
    raise InputError(
        "fault must be like 'pump leak x3 from 90 s', 'rod seal A 0.01 L/min from 90 s', 'friction +20 % growing from "
        "60 s to 120 s', 'air 1 % from 90 s', 'sensor p_A offset 2 psi from 90 s', 'sensor p_A gain 1 %', 'sensor p_A "
        "stuck from 90 s', 'duty amplitude x1.5 from 90 s', 'shut-off A to 0 % from 60 s to 90 s within 0.5 s', "
        f"'circulation from 60 s', 'filter A x10 from 90 s', 'oil +20 K from 90 s' or 'none', got {text!r}"
    )
