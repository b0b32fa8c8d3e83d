"""A controller's model of the drive: the voltage for a flow, by inverting a pump's speed loop or a servo valve."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sealscope.compiled import kernel, law, make_record, record_dtype
from sealscope.errors import InputError
from sealscope.recordings.recording import Array

if TYPE_CHECKING:
    from sealscope.parameters import Rig


#: Smallest pressure drop of a valve that a controller assumes, over the supply's: a higher load cannot be moved.
_MIN_VALVE_FRACTION = 0.1
#: Gain by which a small voltage is increased until the overlap of the valve's edges is passed.
_OVERLAP_GAIN = 4.0
#: Parameters and state of a drive's inverse: those of `Drive`, or of `ValveDrive`, which is the one with Q_N > 0.
DRIVE = record_dtype(
    *("displacement", "omega_per_volt", "shortfall", "decay", "droop", "high_passed", "previous_speed"),
    *("Q_N", "dp_N", "u_N", "p_s", "dead_volts"),
)


@law
def drive_voltage(m: Any, flow: float, dp: float) -> float:
    """Compute the voltage [V] that makes a drive give a flow [m^3/s] against `dp` = p_A - p_B [Pa].

    The equation of `ValveDrive` or of `Drive` is solved for u; s/(s + corner) is a high-pass filter of the speed. `m`:
    a record `DRIVE`; each call advances its filter by one sample.
    """
    if m.Q_N > 0.0:  # a servo valve
        valve_drop = max(m.p_s - math.copysign(dp, dp * flow), _MIN_VALVE_FRACTION * m.p_s)  # p_s - sign(Q) dp
        u = m.u_N * flow / (m.Q_N * math.sqrt(0.5 * valve_drop / m.dp_N))
        return u + min(max(_OVERLAP_GAIN * u, -m.dead_volts), m.dead_volts)  # type: ignore[no-any-return]
    omega = flow / m.displacement
    speed = omega + m.droop * dp
    m.high_passed = m.decay * (m.high_passed + speed - m.previous_speed)
    m.previous_speed = speed
    return (omega + m.shortfall * m.high_passed) / m.omega_per_volt  # type: ignore[no-any-return]


@kernel
def filter_lag(values: np.ndarray, decay: float, state: float, out: np.ndarray) -> None:
    """Filter values (n,) by a first-order lag into `out` (n,), with out[0] = `state`; `decay`: exp(-interval/lag)."""
    for sample in range(values.size):
        out[sample] = state
        state = values[sample] + decay * (state - values[sample])


def check_numbers(what: str, source: object, positive: Sequence[str], not_negative: Sequence[str] = ()) -> None:
    """Check that attributes of `source` are finite numbers in their range.

    `positive`, `not_negative`: names of the attributes that must be > 0 and >= 0. Raises InputError otherwise; its
    message names the object by `what`.
    """
    for name in (*positive, *not_negative):
        value = getattr(source, name)
        if not (math.isfinite(value) and (value > 0 or (value == 0 and name in not_negative))):
            raise InputError(f"{name} of {what} must be {'>' if name in positive else '>='} 0, got {value}")


class _Invertible(ABC):
    """A model of a drive whose flow can be inverted to a voltage."""

    @abstractmethod
    def coefficients(self, rate: float, dead_volts: float = 0.0) -> Any:
        """Make the record (1,) `DRIVE` for a controller at `rate` [Hz]; `dead_volts` [V]: overlap of a valve."""

    def inverse(self, rate: float) -> Callable[[float, float], float]:
        """Build the function (flow [m^3/s], p_A - p_B [Pa]) -> voltage [V], to be called at `rate` [Hz]."""
        (coefficients,) = self.coefficients(rate)
        return lambda flow, dp: float(drive_voltage(coefficients, flow, dp))


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
        if not rig.circuit.pump_feeds_chambers:
            raise InputError(
                f"a pump's drive must have a pump-controlled rig (valve.spool = absent), got {rig.name}; ValveDrive is "
                "for a servo valve"
            )
        motor, displacement = rig.motor, rig.pump.q_b / (2.0 * math.pi)  # for the class's equation
        shortfall, corner = (motor.C_e / motor.k_p, motor.K_i / motor.k_p) if motor.k_p > 0 else (0.0, 0.0)
        droop = motor.R_c * displacement / (motor.C_m * motor.C_e)
        return cls(displacement, motor.omega_per_volt, shortfall, corner, droop)

    @property
    def lag(self) -> float:
        """Time constant [s] with which the speed loop removes its shortfall; infinite without an integral."""
        return (1.0 + self.shortfall) / self.corner if self.corner > 0.0 else math.inf

    def flow(self, u: Array, dp: Array, rate: float, settling: int = 0) -> Array:
        """Compute the drive's flow (n,) [m^3/s] for voltages (n,) [V] at `rate` [Hz] against p_A - p_B (n,) [Pa].

        The class's equation solved for omega: omega = (omega_d + shortfall (y - droop dp))/(1 + shortfall), where y is
        omega_d + droop dp after a first-order lag (`lag`). y starts at standstill under the first dp; for a periodic
        command, whose period is `settling` samples, it starts in the periodic state.
        """
        omega_d, droop_speed = self.omega_per_volt * u, self.droop * dp
        lag_input, y = omega_d + droop_speed, np.empty_like(omega_d)
        exponent, y_0 = -1.0 / (self.lag * rate), float(droop_speed[0])
        if settling and exponent < 0.0:  # from 0 the lag reaches y_0 less the part of y_0 that has decayed
            filter_lag(lag_input[: settling + 1], math.exp(exponent), 0.0, y[: settling + 1])
            y_0 = float(y[settling]) / -math.expm1(settling * exponent)
        filter_lag(lag_input, math.exp(exponent), y_0, y)
        omega = (omega_d + self.shortfall * (y - droop_speed)) / (1.0 + self.shortfall)
        return np.asarray(self.displacement * omega)

    def coefficients(self, rate: float, dead_volts: float = 0.0) -> Any:
        """Make the record (1,) `DRIVE` for a controller at `rate` [Hz]; `dead_volts` is ignored."""
        return make_record(DRIVE, self, decay=math.exp(-self.corner / rate))

    def steady_voltage(self, flow: float) -> float:
        """Compute the voltage [V] of a constant flow [m^3/s], once the drive has reached its commanded speed."""
        return flow / self.displacement / self.omega_per_volt

    def unloaded_flow(self, u: float) -> float:
        """Compute the flow [m^3/s] at a constant voltage `u` [V], without a load."""
        return u * self.omega_per_volt * self.displacement


@dataclass(frozen=True)
class ValveDrive(_Invertible):
    """A controller's model of a servo valve and its supply.

    Q = Q_N u/u_N sqrt((p_s - sign(Q) dp)/(2 dp_N)): each of the two open edges takes half of the pressure (equal edges;
    Merritt, Hydraulic Control Systems, 1967, section 5.2), and the spool follows the command without delay. `Q_N`
    [m^3/s]: flow at `dp_N` [Pa] an edge and `u_N` [V]; `p_s` [Pa]: pressure of the supply above the return.
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
        if not rig.circuit.valve_controlled:
            raise InputError(f"a valve's drive must have a servo valve (valve.spool = present), got rig {rig.name}")
        pump_flow = rig.pump.q_b / (2.0 * math.pi) * supply.omega_P  # all of it through the relief valve
        return cls(valve.Q_N, valve.dp_N, valve.u_N, supply.p_set + pump_flow / supply.G_set)

    def coefficients(self, rate: float, dead_volts: float = 0.0) -> Any:
        """Make the record (1,) `DRIVE`; `dead_volts` [V]: width of the edges' overlap, which `drive_voltage` adds."""
        return make_record(DRIVE, self, dead_volts=dead_volts)

    def steady_voltage(self, flow: float) -> float:
        """Compute the voltage [V] of a constant flow [m^3/s] without load."""
        return self.inverse(1.0)(flow, 0.0)

    def unloaded_flow(self, u: float) -> float:
        """Compute the flow [m^3/s] at a constant voltage `u` [V], without a load."""
        return u / self.steady_voltage(1.0)


def drive_of(rig: Rig) -> Drive | ValveDrive:
    """Build the model of a rig's pump and drive, or of its servo valve."""
    return Drive.from_rig(rig) if rig.circuit.pump_feeds_chambers else ValveDrive.from_rig(rig)
