"""Proportional-integral control of the piston's position, with the target's velocity fed forward."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, Self

from sealscope.control.controller import Measured
from sealscope.control.drive import Drive, ValveDrive, check_numbers

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Time [s] over which the pressures that tell the carrying side are averaged.
_PRESSURE_LAG = 0.02
#: How many times its growth a small voltage is moved to where an overlap ends.
_ACROSS_OVERLAP = 4.0


class _Gains(Protocol):
    """What both controllers hold."""

    @property
    def area_A(self) -> float: ...
    @property
    def area_B(self) -> float: ...
    @property
    def u_max(self) -> float: ...
    @property
    def k_v(self) -> float: ...
    @property
    def k_i(self) -> float: ...
    @property
    def dead_band(self) -> float: ...
    @property
    def rate(self) -> float: ...


def _followed(law: _Gains, inverse: Callable[[float, float], float]) -> Callable[[Measured], float]:
    """Return the PI law over the inverse of a drive: from what is measured to the voltage [V], for one run."""
    T = 1.0 / law.rate
    averaged = 1.0 - math.exp(-T / _PRESSURE_LAG)
    integral = dp = 0.0

    def voltage(measured: Measured) -> float:
        nonlocal integral, dp
        dp += averaged * (measured.p_A - measured.p_B - dp)
        error = measured.target - measured.x
        velocity = measured.target_speed + law.k_v * error + integral
        u = inverse(velocity * (law.area_A if dp > 0.0 else law.area_B), dp)
        within = abs(error) <= law.dead_band
        if not within and (abs(u) < law.u_max or u * error < 0.0):
            integral += law.k_i * T * error
        return min(max(u, -law.u_max), law.u_max)

    return voltage


@dataclass(frozen=True)
class PositionPI:
    """A PI controller of the position with feed-forward of velocity, and what it assumes of machine and drive.

    v_c = v_target + k_v e + k_i integral of e, e = target - x; omega_c = v_c A/D with the area A of the side that
    carries the load (the higher pressure) and the pump's displacement D [m^3/rad]; u = omega_d/omega_per_volt, where
    omega_d = omega_c + (C_e/k_p) s/(s + K_i/k_p) omega_c makes good what the drive's own speed loop falls short of
    without a load (eqs. (4.2)-(4.4): omega/omega_d = (k_p s + K_i)/((k_p + C_e) s + K_i)).

    Within `dead_band` [m] of the target the integral stands still, so that it does not hunt a piston at rest about its
    friction or between two counts of its encoder; so it does where the voltage is at its limit `u_max` [V].

    `rate` [Hz], `delay` in whole samples; `k_v` [1/s], `k_i` [1/s^2]; `area_A`, `area_B` [m^2].
    """

    area_A: float
    area_B: float
    displacement: float
    omega_per_volt: float
    drive_shortfall: float
    drive_corner: float
    u_max: float
    k_v: float = 12.0
    k_i: float = 24.0
    dead_band: float = 30e-6
    rate: float = 500.0
    delay: int = 1

    def __post_init__(self) -> None:
        positive = ("area_A", "area_B", "displacement", "omega_per_volt", "u_max", "rate")
        rest = ("drive_shortfall", "drive_corner", "k_v", "k_i", "dead_band", "delay")
        check_numbers(
            "the controller",
            {name: getattr(self, name) for name in positive},
            {name: getattr(self, name) for name in rest},
        )

    @classmethod
    def of(cls, rig: Rig, **gains: float) -> Self:
        """Return the controller for what a rig is said to be; `gains` are further fields."""
        drive, cylinder = Drive.of(rig), rig.cylinder
        gains.setdefault("dead_band", 1.5 * rig.sensors.x.resolution)
        return cls(
            cylinder.A_A,
            cylinder.A_B,
            drive.displacement,
            drive.omega_per_volt,
            drive.shortfall,
            drive.corner,
            rig.daq.u_max,
            **gains,  # type: ignore[arg-type]
        )

    def start(self) -> Callable[[Measured], float]:
        """Return a function from what is measured to the voltage [V], for one run from its beginning."""
        drive = Drive(self.displacement, self.omega_per_volt, self.drive_shortfall, self.drive_corner, 0.0)
        return _followed(self, drive.inverse(self.rate))


@dataclass(frozen=True)
class ValvePI:
    """The PI controller of `PositionPI` for a servo valve: u is the inverse of the valve (`ValveDrive`) of v_c A.

    The pressure difference that the valve works against is measured. Within `dead_volts` [V], the overlap of its
    edges, nothing flows: a small voltage is moved beyond it, four times as quickly as it grows.
    """

    area_A: float
    area_B: float
    drive: ValveDrive
    u_max: float
    dead_volts: float = 0.0
    k_v: float = 12.0
    k_i: float = 24.0
    dead_band: float = 30e-6
    rate: float = 500.0
    delay: int = 1

    def __post_init__(self) -> None:
        positive = ("area_A", "area_B", "u_max", "rate")
        rest = ("dead_volts", "k_v", "k_i", "dead_band", "delay")
        check_numbers(
            "the controller",
            {name: getattr(self, name) for name in positive},
            {name: getattr(self, name) for name in rest},
        )

    @classmethod
    def of(cls, rig: Rig, **gains: float) -> Self:
        """Return the controller for what a rig is said to be; `gains` are further fields."""
        valve, cylinder = rig.valve, rig.cylinder
        gains.setdefault("dead_band", 1.5 * rig.sensors.x.resolution)
        overlap = max(0.0, 0.5 * (min(valve.o_PA, valve.o_BT) + min(valve.o_PB, valve.o_AT)))
        gains.setdefault("dead_volts", valve.u_N * overlap / valve.x_max)
        return cls(cylinder.A_A, cylinder.A_B, ValveDrive.of(rig), rig.daq.u_max, **gains)  # type: ignore[arg-type]

    def start(self) -> Callable[[Measured], float]:
        """Return a function from what is measured to the voltage [V], for one run from its beginning."""
        return _followed(self, self._beyond_overlap(self.drive.inverse(self.rate)))

    def _beyond_overlap(self, inverse: Callable[[float, float], float]) -> Callable[[float, float], float]:
        dead = self.dead_volts

        def voltage(flow: float, dp: float) -> float:
            u = inverse(flow, dp)
            return u + min(max(_ACROSS_OVERLAP * u, -dead), dead)

        return voltage


def position_controller(rig: Rig) -> PositionPI | ValvePI:
    """Return the PI controller for what a rig is said to be, by its pump or by its servo valve."""
    return PositionPI.of(rig) if rig.valve.spool == "absent" else ValvePI.of(rig)
