"""Models of a drive in controllers: the voltage for a flow, by the inverse of a pump's speed loop or of a valve."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sealscope.compiled import kernel, law, layout_of, record_of
from sealscope.errors import InputError
from sealscope.recordings.recording import Array

if TYPE_CHECKING:
    from sealscope.parameters import Rig


#: Least share of the supply that a controller assumes across a valve: beyond, a load is more than it can move.
_LEAST_ACROSS = 0.1
#: How many times its growth a small voltage is moved to where an overlap ends.
_ACROSS_OVERLAP = 4.0
#: Numbers of the inverse of a drive, and what it remembers: those of `Drive`, or of `ValveDrive`, whose Q_N is > 0.
DRIVE = layout_of(
    *("displacement", "omega_per_volt", "shortfall", "fading", "droop", "high_passed", "needed_before"),
    *("Q_N", "dp_N", "u_N", "p_s", "dead"),
)


@law
def drive_voltage(m: Any, flow: float, dp: float) -> float:
    """Compute the voltage [V] at which a drive gives a flow [m^3/s] against p_A - p_B [Pa], sample by sample.

    `m`: a record `DRIVE`.
    """
    if m.Q_N > 0.0:
        across = max(m.p_s - math.copysign(dp, dp * flow), _LEAST_ACROSS * m.p_s)
        u = m.u_N * flow / (m.Q_N * math.sqrt(0.5 * across / m.dp_N))
        return u + min(max(_ACROSS_OVERLAP * u, -m.dead), m.dead)  # type: ignore[no-any-return]
    omega = flow / m.displacement
    needed = omega + m.droop * dp
    m.high_passed = m.fading * (m.high_passed + needed - m.needed_before)
    m.needed_before = needed
    return (omega + m.shortfall * m.high_passed) / m.omega_per_volt  # type: ignore[no-any-return]


@kernel
def write_lag(values: np.ndarray, fading: float, first: float, out: np.ndarray) -> None:
    """Write the first-order lag of values (n,) into `out` (n,); `fading` of the difference remains after a sample."""
    for sample in range(values.size):
        out[sample] = first
        first = values[sample] + fading * (first - values[sample])


def check_numbers(what: str, source: object, positive: Sequence[str], not_negative: Sequence[str] = ()) -> None:
    """Raise InputError for a number of `source` that is not finite, not > 0, or not >= 0; `what` is its owner."""
    for name in (*positive, *not_negative):
        value = getattr(source, name)
        if not (math.isfinite(value) and (value > 0 or (value == 0 and name in not_negative))):
            raise InputError(f"{name} of {what} must be {'>' if name in positive else '>='} 0, got {value}")


class _Invertible(ABC):
    """A model of a drive whose flow can be inverted to a voltage."""

    @abstractmethod
    def numbers(self, rate: float, dead: float = 0.0) -> Any:
        """Compute the numbers (1,) of the inverse, called at `rate` [Hz], as `drive_voltage` takes them."""

    def inverse(self, rate: float) -> Callable[[float, float], float]:
        """Build the inverse, called at `rate` [Hz]: the voltage [V] for a flow [m^3/s] and p_A - p_B [Pa]."""
        (numbers,) = self.numbers(rate)
        return lambda flow, dp: float(drive_voltage(numbers, flow, dp))


@dataclass(frozen=True)
class Drive(_Invertible):
    """A controller's model of pump and drive.

    Eqs. (4.3), (4.4) without the winding's inductance: k_p (omega_d - omega) + K_i integral = C_e omega + R_c i, so
    that omega_d = omega + (C_e/k_p) s/(s + K_i/k_p) (omega + R_c i/C_e): `shortfall` C_e/k_p, `corner` K_i/k_p [1/s].
    The current carries the torque of the pressures, i = D dp/C_m: `droop` = R_c D/(C_m C_e) [rad/(s Pa)].
    `displacement` D [m^3/rad], `omega_per_volt` [rad/(s V)].
    """

    displacement: float
    omega_per_volt: float
    shortfall: float
    corner: float
    droop: float

    def __post_init__(self) -> None:
        check_numbers("the drive", self, ("displacement", "omega_per_volt"), ("shortfall", "corner", "droop"))

    @classmethod
    def from_rig(cls, rig: Rig) -> Self:
        """Build the model of a rig's pump and drive; raise InputError for a valve-controlled rig."""
        if rig.valve.spool == "present":
            raise InputError(
                f"a pump's drive must have a pump-controlled rig (valve.spool = absent), got {rig.name}; ValveDrive is "
                "for a servo valve"
            )
        motor, displacement = rig.motor, rig.pump.q_b / (2.0 * math.pi)
        shortfall, corner = (motor.C_e / motor.k_p, motor.K_i / motor.k_p) if motor.k_p > 0 else (0.0, 0.0)
        droop = motor.R_c * displacement / (motor.C_m * motor.C_e)
        return cls(displacement, motor.omega_per_volt, shortfall, corner, droop)

    @property
    def lag(self) -> float:
        """Time [s] in which the speed loop takes up what it is short of: infinite without an integral."""
        return (1.0 + self.shortfall) / self.corner if self.corner > 0.0 else math.inf

    def flow(self, u: Array, dp: Array, rate: float, settling: int = 0) -> Array:
        """Compute the flow (n,) [m^3/s] of voltages (n,) [V] at `rate` [Hz] against p_A - p_B (n,) [Pa].

        The drive's law above, solved for omega: with y, omega_d + droop dp after a `lag`, omega = (omega_d + shortfall
        (y - droop dp))/(1 + shortfall). It starts from standstill, where it carries the first dp; or so that y is the
        same after the first `settling` samples as before them.
        """
        commanded, lift = self.omega_per_volt * u, self.droop * dp
        commanded_and_lift, late = commanded + lift, np.empty_like(commanded)
        decay, first = -1.0 / (self.lag * rate), float(lift[0])
        if settling and decay < 0.0:
            write_lag(commanded_and_lift[: settling + 1], math.exp(decay), 0.0, late[: settling + 1])
            first = float(late[settling]) / -math.expm1(settling * decay)
        write_lag(commanded_and_lift, math.exp(decay), first, late)
        return np.asarray(self.displacement * (commanded + self.shortfall * (late - lift)) / (1.0 + self.shortfall))

    def numbers(self, rate: float, dead: float = 0.0) -> Any:
        """Compute the numbers (1,) of the inverse, called at `rate` [Hz]; `dead` is of valves alone."""
        return record_of(DRIVE, self, fading=math.exp(-self.corner / rate))

    def steady(self, flow: float) -> float:
        """Compute the voltage [V] of a flow [m^3/s] that lasts, of a drive that reaches its commanded speed."""
        return flow / self.displacement / self.omega_per_volt

    def largest(self, u_max: float) -> float:
        """Compute the flow [m^3/s] at the voltage `u_max` [V]."""
        return u_max * self.omega_per_volt * self.displacement


@dataclass(frozen=True)
class ValveDrive(_Invertible):
    """A controller's model of a servo valve and its supply.

    Q = Q_N u/u_N sqrt((p_s - sign(Q) dp)/(2 dp_N)) of a valve with equal edges, half of the pressure lost at each of
    the two that are open (Merritt, Hydraulic Control Systems, 1967, section 5.2); its spool is taken to be where the
    command wants it. `Q_N` [m^3/s] at `dp_N` [Pa] an edge and `u_N` [V]; `p_s` [Pa]: supply less return.
    """

    Q_N: float
    dp_N: float
    u_N: float
    p_s: float

    def __post_init__(self) -> None:
        check_numbers("the valve", self, ("Q_N", "dp_N", "u_N", "p_s"))

    @classmethod
    def from_rig(cls, rig: Rig) -> Self:
        """Build the model of a rig's servo valve; raise InputError for a pump-controlled rig."""
        valve, supply = rig.valve, rig.supply
        if valve.spool == "absent":
            raise InputError(f"a valve's drive must have a servo valve (valve.spool = present), got rig {rig.name}")
        pumped = rig.pump.q_b / (2.0 * math.pi) * supply.omega_P
        return cls(valve.Q_N, valve.dp_N, valve.u_N, supply.p_set + pumped / supply.G_set)

    def numbers(self, rate: float, dead: float = 0.0) -> Any:
        """Return the numbers (1,) of the inverse as `drive_voltage` takes them.

        Within `dead` [V], the overlap of the edges, nothing flows: a small voltage is moved beyond it.
        """
        return record_of(DRIVE, self, dead=dead)

    def steady(self, flow: float) -> float:
        """Compute the voltage [V] of a flow [m^3/s] without a load."""
        return self.inverse(1.0)(flow, 0.0)

    def largest(self, u_max: float) -> float:
        """Compute the flow [m^3/s] at the voltage `u_max` [V], without a load."""
        return u_max / self.steady(1.0)


def drive_of(rig: Rig) -> Drive | ValveDrive:
    """Build the model of a rig's pump and drive, or of its servo valve."""
    return Drive.from_rig(rig) if rig.valve.spool == "absent" else ValveDrive.from_rig(rig)
