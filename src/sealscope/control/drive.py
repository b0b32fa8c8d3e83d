"""A controller's model of the drive, from which the voltage for a flow is computed: pump and motor, or servo valve."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sealscope.compiled import kernel, law, make_record, record_dtype
from sealscope.errors import InputError
from sealscope.parameters.parts import check_circuit_property
from sealscope.recordings.channels import Array

if TYPE_CHECKING:
    from sealscope.parameters import Rig


#: Least assumed pressure drop across a valve, as a fraction of the supply pressure: the voltage stays finite.
_MIN_VALVE_FRACTION = 0.1
_OVERLAP_GAIN = 4.0  # multiple of a small voltage that is added to it to pass the overlap of the valve's edges
#: Parameters and filter state of `drive_voltage`: those of a pump's drive, then those of a servo valve. For a pump Q_N
#: is 0.
DRIVE = record_dtype(
    *("displacement", "omega_per_volt", "shortfall", "decay", "droop", "high_passed", "previous_speed"),
    *("Q_N", "dp_N", "u_N", "p_s", "dead_volts"),
)


@law
def drive_voltage(m: Any, flow: float, dp: float) -> float:
    """Compute the voltage u [V] at which a drive delivers a flow [m^3/s] against `dp` = p_A - p_B [Pa].

    `m`: a record `DRIVE`, the parameters and the filter state of the drive.

    A servo valve (Q_N > 0) needs u = u_N flow/(Q_N sqrt((p_s - sign(flow) dp)/(2 dp_N))), with the parameters of
    `ValveDrive`. The pressure drop p_s - sign(flow) dp is taken as at least 10 % of p_s. To pass the overlap of the
    valve's edges, 4 u is then added to u, limited to +-`dead_volts`.

    A pump needs u = (omega + shortfall H(omega + droop dp))/omega_per_volt, with omega = flow/displacement and the
    parameters of `Drive`. The second term makes up for the motor's speed falling short of its command after a change.
    H is the high-pass filter s/(s + corner), which each call advances by one sample; `m.decay` is exp(-corner/rate).
    """
    if m.Q_N > 0.0:  # a servo valve
        valve_drop = max(m.p_s - math.copysign(dp, dp * flow), _MIN_VALVE_FRACTION * m.p_s)  # copysign: sign(flow) dp
        u = m.u_N * flow / (m.Q_N * math.sqrt(0.5 * valve_drop / m.dp_N))
        return u + min(max(_OVERLAP_GAIN * u, -m.dead_volts), m.dead_volts)  # type: ignore[no-any-return]
    omega = flow / m.displacement
    speed = omega + m.droop * dp  # input of the high-pass filter
    m.high_passed = m.decay * (m.high_passed + speed - m.previous_speed)
    m.previous_speed = speed
    return (omega + m.shortfall * m.high_passed) / m.omega_per_volt  # type: ignore[no-any-return]


@kernel
def filter_lag(values: np.ndarray, decay: float, state: float, out: np.ndarray) -> None:
    """Filter `values` (n,), which are constant between samples, by a first-order lag; write the result to `out` (n,).

    out[0] = `state`, and out[k] = decay out[k-1] + (1 - decay) values[k-1]. `decay`: exp(-interval/time constant).
    """
    for sample in range(values.size):
        out[sample] = state
        state = values[sample] + decay * (state - values[sample])


def check_numbers(what: str, source: object, positive: Sequence[str], not_negative: Sequence[str] = ()) -> None:
    """Raise InputError unless attributes of `source`, called `what`, are finite and > 0 or, if `not_negative`, >= 0."""
    for name in (*positive, *not_negative):
        value = getattr(source, name)
        if not (math.isfinite(value) and (value > 0 or (value == 0 and name in not_negative))):
            raise InputError(f"{name} of {what} must be {'>' if name in positive else '>='} 0, got {value}")


@dataclass(frozen=True)
class Drive:
    """A controller's model of a pump and of the motor that drives it under speed control.

    Without the winding's inductance, the thesis's eqs. (4.3) and (4.4) are k_p (omega_d - omega) + K_i integral of
    (omega_d - omega) dt = C_e omega + R_c i. Here omega_d is the commanded speed, omega the speed, and i = D dp/C_m the
    current, whose torque balances the pressure difference dp = p_A - p_B. Solved for the commanded speed: omega_d =
    omega + (C_e/k_p) s/(s + K_i/k_p) (omega + R_c D dp/(C_m C_e)).
    """

    displacement: float  # [m^3/rad] D
    omega_per_volt: float  # [rad/(s V)] commanded speed over voltage
    shortfall: float  # C_e/k_p, by which the speed falls short of a quickly changing command, relative to the speed
    corner: float  # [1/s] K_i/k_p, above which a change is quick
    droop: float  # [rad/(s Pa)] R_c D/(C_m C_e), speed lost per dp at a constant motor voltage

    def __post_init__(self) -> None:
        not_negative = ("shortfall", "corner", "droop")
        check_numbers("the drive", self, positive=("displacement", "omega_per_volt"), not_negative=not_negative)

    @classmethod
    def from_rig(cls, rig: Rig) -> Self:
        """Build the model of a rig's pump and drive; raise InputError for a valve-controlled rig."""
        subject = "a pump's drive (of a servo valve: ValveDrive)"  # for the error message
        check_circuit_property(subject, rig.name, rig.circuit, flag="pump_feeds_chambers")
        motor = rig.motor
        displacement = rig.pump.q_b / (2.0 * math.pi)  # per radian, from q_b per revolution
        shortfall = corner = 0.0  # without a proportional gain the speed is taken as the commanded one
        if motor.k_p > 0:
            shortfall = motor.C_e / motor.k_p  # back electromotive force over the gain of the speed controller
            corner = motor.K_i / motor.k_p  # corner of the PI controller [1/s]
        droop = motor.R_c * displacement / (motor.C_m * motor.C_e)
        return cls(displacement, motor.omega_per_volt, shortfall=shortfall, corner=corner, droop=droop)

    @property
    def lag(self) -> float:
        """Time constant [s] of the motor's speed loop, (1 + shortfall)/corner; infinite if `corner` is 0."""
        return (1.0 + self.shortfall) / self.corner if self.corner > 0.0 else math.inf

    @property
    def flow_per_volt(self) -> float:
        """Pump's flow over a constant voltage [m^3/(s V)], if the motor turns at its commanded speed."""
        return self.omega_per_volt * self.displacement

    @staticmethod
    def mean_pressure(rig: Rig) -> float:
        """Return the mean pressure [Pa] of a rig's chambers at standstill: the charge pressure."""
        return rig.fluid.p_charge

    def speed(self, u: Array, dp: Array, rate: float) -> Array:
        """Compute the pump's speed (n,) [rad/s] for voltages `u` (n,) [V] against `dp` = p_A - p_B (n,) [Pa].

        `rate` [Hz]: sampling rate of both. The speed is omega = (omega_d + shortfall (y - droop dp))/(1 + shortfall),
        with the commanded speed omega_d. The signal y is omega_d + droop dp after a first-order lag with the time
        constant `lag`. The run begins at standstill under the first dp.
        """
        omega_d, droop_speed = self.omega_per_volt * u, self.droop * dp
        y = np.empty_like(omega_d)
        filter_lag(omega_d + droop_speed, math.exp(-1.0 / (self.lag * rate)), float(droop_speed[0]), y)
        return np.asarray((omega_d + self.shortfall * (y - droop_speed)) / (1.0 + self.shortfall))

    def coefficients(self, rate: float, dead_volts: float = 0.0) -> Any:
        """Make the parameters, a record (1,) `DRIVE`, for calls of `drive_voltage` at `rate` [Hz].

        `dead_volts` is for `ValveDrive` alone.
        """
        return make_record(DRIVE, self, decay=math.exp(-self.corner / rate))


@dataclass(frozen=True)
class ValveDrive:
    """A controller's model of a servo valve and its supply.

    The flow is Q = Q_N (u/u_N) sqrt((p_s - sign(Q) dp)/(2 dp_N)): the two open edges are equal, and half of the
    pressure drops across each (Merritt, Hydraulic Control Systems, 1967, section 5.2). The spool follows the command
    without delay.
    """

    Q_N: float  # [m^3/s] flow at the voltage u_N and the pressure drop dp_N
    dp_N: float  # [Pa] across each edge
    u_N: float  # [V]
    p_s: float  # [Pa] supply pressure above that of the return

    def __post_init__(self) -> None:
        check_numbers("the valve", self, positive=("Q_N", "dp_N", "u_N", "p_s"))

    @classmethod
    def from_rig(cls, rig: Rig) -> Self:
        """Build the model of a rig's servo valve; raise InputError for a pump-controlled rig."""
        valve, supply = rig.valve, rig.supply
        check_circuit_property("a servo valve's drive", rig.name, rig.circuit, "valve_controlled")
        pump_flow = rig.pump.q_b / (2.0 * math.pi) * supply.omega_P
        p_s = supply.p_set + pump_flow / supply.G_set  # while the whole pump flow passes the supply's relief valve
        return cls(valve.Q_N, valve.dp_N, valve.u_N, p_s)

    @property
    def flow_per_volt(self) -> float:
        """Valve's flow over a constant voltage [m^3/(s V)] without load."""
        return self.Q_N * math.sqrt(0.5 * self.p_s / self.dp_N) / self.u_N

    def mean_pressure(self, rig: Rig) -> float:
        """Compute the mean pressure [Pa] of a rig's chambers at standstill: the mean of supply and return."""
        return 0.5 * (self.p_s + 2.0 * rig.supply.p_return)  # the supply is at p_s + p_return

    def coefficients(self, rate: float, dead_volts: float = 0.0) -> Any:
        """Make the parameters for `drive_voltage`, a record (1,) `DRIVE`; `rate` is for `Drive` alone.

        `dead_volts` [V]: largest voltage that is added to pass the overlap of the valve's edges.
        """
        return make_record(DRIVE, self, dead_volts=dead_volts)


def drive_of(rig: Rig) -> Drive | ValveDrive:
    """Build a controller's model of a rig's drive: pump and motor, or the servo valve of a valve-controlled rig."""
    return Drive.from_rig(rig) if rig.circuit.pump_feeds_chambers else ValveDrive.from_rig(rig)
