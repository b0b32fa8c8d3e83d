"""Proportional-integral control of the piston's position, with the target's velocity fed forward."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sealscope.compiled import entry, law, make_record, record_dtype, record_view
from sealscope.control.controller import CompiledLaw, Measured, Started, measured_at
from sealscope.control.drive import DRIVE, Drive, ValveDrive, check_numbers, drive_of, drive_voltage

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_PRESSURE_LAG = 0.02  # time constant [s] of the average of p_A - p_B, whose sign tells which side carries the load
#: State and parameters of the control law: `integral` is k_i times the integral of the error [m/s], `dp` the averaged
#: p_A - p_B [Pa].
FOLLOWING = record_dtype(
    *("compensated", "area_A", "area_B", "k_v", "k_i_T", "dead_band", "u_max", "pressure_gain", "integral", "dp"),
    drive=DRIVE,
)
_memory_at = record_view(FOLLOWING)


@law
def following_voltage(m: Any, measured: Any) -> float:
    """Compute the voltage [V] of a sample by PI control with velocity feed-forward (`PositionPI`), within +-u_max.

    `m`: a record `FOLLOWING`, whose integral and averaged p_A - p_B are updated; `measured`: a `Measured`.
    """
    m.dp += m.pressure_gain * (measured.p_A - measured.p_B - m.dp)
    error = measured.target - measured.x
    velocity = measured.target_speed + m.k_v * error + m.integral
    area = m.area_A if m.dp > 0.0 else m.area_B
    u = drive_voltage(m.drive, velocity * area, m.dp)
    # at the limit of the voltage, the error is integrated only if its sign is opposite to the voltage's
    if abs(error) > m.dead_band and (abs(u) < m.u_max or u * error < 0.0):
        m.integral += m.k_i_T * error  # k_i_T: the gain k_i times the sampling interval
    return min(max(u, -m.u_max), m.u_max)  # type: ignore[no-any-return]


@entry
def _position_law(memory: Any, measured: Any) -> Any:
    """Compute `following_voltage` [V] from the addresses of a record `FOLLOWING` and of the numbers of a `Measured`."""
    return following_voltage(_memory_at(memory), measured_at(measured))


@dataclass(frozen=True)
class PositionPI:
    """A PI controller of the piston's position with velocity feed-forward; its fields are assumptions about the rig.

    The commanded velocity is v_c = v_target + k_v e + k_i integral of e dt, with the error e = target - x. The voltage
    is the one at which the `drive` delivers the flow v_c A; A is the piston area of the chamber with the higher
    pressure, which carries the load. For a pump the load is neglected: the commanded speed of the motor is omega_d =
    omega_c + (C_e/k_p) s/(s + K_i/k_p) omega_c, where omega_c is the speed for the flow. This inverts the speed loop
    omega/omega_d = (k_p s + K_i)/((k_p + C_e) s + K_i), eqs. (4.2)-(4.4) of the thesis. For a servo valve the voltage
    depends on the measured pressure difference. Small voltages are increased by up to `dead_volts` to pass the overlap
    of the valve's edges.

    The integral is frozen within `dead_band` of the target, where it would oscillate against static friction or between
    two encoder counts. It is also frozen while the voltage is at its limit, unless the error has the opposite sign.
    """

    area_A: float  # [m^2] piston areas of the two chambers
    area_B: float
    drive: Drive | ValveDrive
    u_max: float  # [V] limit of the voltage
    dead_volts: float = 0.0  # [V]
    k_v: float = 12.0  # [1/s]
    k_i: float = 24.0  # [1/s^2]
    dead_band: float = 30e-6  # [m]
    rate: float = 500.0  # [Hz] sampling rate
    delay: int = 1  # whole samples from a measurement to the voltage computed from it

    def __post_init__(self) -> None:
        not_negative = ("dead_volts", "k_v", "k_i", "dead_band", "delay")
        positive = ("area_A", "area_B", "u_max", "rate")
        check_numbers("the controller", self, positive=positive, not_negative=not_negative)

    @classmethod
    def from_rig(cls, rig: Rig, **gains: float) -> Self:
        """Build the controller from a rig's pump or servo valve; `gains`: values of other fields, such as `k_v`."""
        valve, drive = rig.valve, drive_of(rig)
        gains.setdefault("dead_band", 1.5 * rig.sensors.x.resolution)  # one and a half encoder counts
        if isinstance(drive, Drive):
            drive = replace(drive, droop=0.0)  # a pump's speed is computed as if there were no load
        else:
            # each direction opens two edges, first the one with less overlap; an underlap (mean < 0) needs no volts
            overlap = max(0.0, 0.5 * (min(valve.o_PA, valve.o_BT) + min(valve.o_PB, valve.o_AT)))
            gains.setdefault("dead_volts", valve.u_N * overlap / valve.x_max)
        return cls(rig.cylinder.A_A, rig.cylinder.A_B, drive, rig.daq.u_max, **gains)  # type: ignore[arg-type]

    def start(self) -> Callable[[Measured], float]:
        """Start a run; return the function that computes the voltage [V] from each `Measured`."""
        return Started(self.compiled())

    def compiled(self) -> CompiledLaw:
        """Return the control law as machine code, with a new memory for one run."""
        return CompiledLaw(_position_law.address, self.make_memory().view(np.float64))

    def make_memory(self) -> Any:
        """Make the parameters and initial state for `following_voltage`, a record (1,) `FOLLOWING`."""
        T = 1.0 / self.rate
        return make_record(
            FOLLOWING,
            self,
            compensated=math.nan,  # this controller compensates no leakage
            k_i_T=self.k_i * T,
            pressure_gain=1.0 - math.exp(-T / _PRESSURE_LAG),
            drive=self.drive.coefficients(self.rate, self.dead_volts),
        )
