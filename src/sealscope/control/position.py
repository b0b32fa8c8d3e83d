"""Proportional-integral control of the piston's position, with the target's velocity fed forward."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sealscope.compiled import entry, law, layout_of, record_at, record_of
from sealscope.control.controller import CompiledLaw, Measured, Started, measured_at
from sealscope.control.drive import DRIVE, Drive, ValveDrive, check_numbers, drive_of, drive_voltage

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Time [s] over which the pressures that tell the carrying side are averaged.
_PRESSURE_LAG = 0.02
#: What the law remembers, and its numbers.
FOLLOWING = layout_of(
    *("compensated", "area_A", "area_B", "k_v", "k_i_T", "dead_band", "u_max", "averaged", "integral", "dp"),
    drive=DRIVE,
)
_memory_at = record_at(FOLLOWING)


@law
def following_voltage(m: Any, measured: Any) -> float:
    """Compute the voltage [V] of the PI law and the inverse of a drive; `m`: a record `FOLLOWING`."""
    m.dp += m.averaged * (measured.p_A - measured.p_B - m.dp)
    error = measured.target - measured.x
    velocity = measured.target_speed + m.k_v * error + m.integral
    area = m.area_A if m.dp > 0.0 else m.area_B
    u = drive_voltage(m.drive, velocity * area, m.dp)
    if abs(error) > m.dead_band and (abs(u) < m.u_max or u * error < 0.0):
        m.integral += m.k_i_T * error
    return min(max(u, -m.u_max), m.u_max)  # type: ignore[no-any-return]


@entry
def _position_law(memory: Any, measured: Any) -> Any:
    return following_voltage(_memory_at(memory), measured_at(measured))


@dataclass(frozen=True)
class PositionPI:
    """A PI controller of the position with feed-forward of velocity; its fields are its assumptions of the machine.

    v_c = v_target + k_v e + k_i integral of e, e = target - x; the voltage is the drive's inverse (`Drive`,
    `ValveDrive`) of the flow v_c A, with the area A of the side that carries the load (the higher pressure). A pump's
    drive is taken to carry none: omega_d = omega_c + (C_e/k_p) s/(s + K_i/k_p) omega_c makes good what its own speed
    loop falls short of (eqs. (4.2)-(4.4): omega/omega_d = (k_p s + K_i)/((k_p + C_e) s + K_i)). A servo valve works
    against the measured pressure difference; within `dead_volts` [V], the overlap of its edges, nothing flows, so a
    small voltage is moved beyond it, four times as quickly as it grows.

    Within `dead_band` [m] of the target the integral stands still, so that it does not hunt a piston at standstill
    about its friction or between two counts of its encoder; so it does where the voltage is at its limit `u_max` [V].

    `rate` [Hz], `delay` in whole samples; `k_v` [1/s], `k_i` [1/s^2]; `area_A`, `area_B` [m^2].
    """

    area_A: float
    area_B: float
    drive: Drive | ValveDrive
    u_max: float
    dead_volts: float = 0.0
    k_v: float = 12.0
    k_i: float = 24.0
    dead_band: float = 30e-6
    rate: float = 500.0
    delay: int = 1

    def __post_init__(self) -> None:
        positive, rest = ("area_A", "area_B", "u_max", "rate"), ("dead_volts", "k_v", "k_i", "dead_band", "delay")
        check_numbers("the controller", self, positive, rest)

    @classmethod
    def from_rig(cls, rig: Rig, **gains: float) -> Self:
        """Build the controller from a rig's parameters, for its pump or servo valve; `gains`: further fields."""
        valve, drive = rig.valve, drive_of(rig)
        gains.setdefault("dead_band", 1.5 * rig.sensors.x.resolution)
        if isinstance(drive, Drive):
            drive = replace(drive, droop=0.0)
        else:
            overlap = max(0.0, 0.5 * (min(valve.o_PA, valve.o_BT) + min(valve.o_PB, valve.o_AT)))
            gains.setdefault("dead_volts", valve.u_N * overlap / valve.x_max)
        return cls(rig.cylinder.A_A, rig.cylinder.A_B, drive, rig.daq.u_max, **gains)  # type: ignore[arg-type]

    def start(self) -> Callable[[Measured], float]:
        """Start a run: return the function from a `Measured` to the voltage [V]."""
        return Started(self.compiled())

    def compiled(self) -> CompiledLaw:
        """Start a run: return the law in machine code."""
        return CompiledLaw(_position_law.address, self.memory().view(np.float64))

    def memory(self) -> Any:
        """Make the record (1,) that `following_voltage` takes."""
        T = 1.0 / self.rate
        return record_of(
            FOLLOWING,
            self,
            compensated=math.nan,
            k_i_T=self.k_i * T,
            averaged=1.0 - math.exp(-T / _PRESSURE_LAG),
            drive=self.drive.numbers(self.rate, self.dead_volts),
        )
