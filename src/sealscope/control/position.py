"""Proportional-integral control of the piston's position, with the target's velocity fed forward."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np

from sealscope.compiled import entry, law, pointer_at
from sealscope.control.controller import P_A, P_B, TARGET, TARGET_SPEED, CompiledLaw, Measured, Started, X
from sealscope.control.drive import DRIVE_BLOCK, Drive, ValveDrive, check_numbers, drive_voltage
from sealscope.recordings.recording import Array

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Time [s] over which the pressures that tell the carrying side are averaged.
_PRESSURE_LAG = 0.02
#: Places of the law's numbers in its block; the last are those of the drive's inverse.
_AREA_A, _AREA_B, _K_V, _K_I_T, _DEAD_BAND, _U_MAX, _AVERAGED, _INTEGRAL, _DP, _DRIVE = range(1, 11)
POSITION_BLOCK = _DRIVE + DRIVE_BLOCK


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


@law
def followed(m: Any, measured: Any) -> float:
    """Return the voltage [V] of the PI law over the inverse of a drive, from the law's block and what is measured."""
    m[_DP] += m[_AVERAGED] * (measured[P_A] - measured[P_B] - m[_DP])
    error = measured[TARGET] - measured[X]
    velocity = measured[TARGET_SPEED] + m[_K_V] * error + m[_INTEGRAL]
    area = m[_AREA_A] if m[_DP] > 0.0 else m[_AREA_B]
    u = drive_voltage(pointer_at(m, _DRIVE), velocity * area, m[_DP])
    if abs(error) > m[_DEAD_BAND] and (abs(u) < m[_U_MAX] or u * error < 0.0):
        m[_INTEGRAL] += m[_K_I_T] * error
    return min(max(u, -m[_U_MAX]), m[_U_MAX])  # type: ignore[no-any-return]


@entry
def _position_law(memory: Any, measured: Any) -> Any:
    return followed(memory, measured)


def _block(law: _Gains, drive: Array) -> Array:
    """Return the block of the PI law, `drive` the one of its inverse."""
    T = 1.0 / law.rate
    averaged = 1.0 - math.exp(-T / _PRESSURE_LAG)
    numbers = (law.area_A, law.area_B, law.k_v, law.k_i * T, law.dead_band, law.u_max, averaged, 0.0, 0.0)
    return np.array([math.nan, *numbers, *drive])


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
        return Started(self.compiled())

    def compiled(self) -> CompiledLaw:
        """Return the law in machine code, for one run from its beginning."""
        return CompiledLaw(_position_law.address, self.block())

    def block(self) -> Array:
        """Return the numbers of the law as `followed` takes them."""
        drive = Drive(self.displacement, self.omega_per_volt, self.drive_shortfall, self.drive_corner, 0.0)
        return _block(self, drive.block(self.rate))


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
        return Started(self.compiled())

    def compiled(self) -> CompiledLaw:
        """Return the law in machine code, for one run from its beginning."""
        return CompiledLaw(_position_law.address, self.block())

    def block(self) -> Array:
        """Return the numbers of the law as `followed` takes them."""
        return _block(self, self.drive.block(self.rate, self.dead_volts))


def position_controller(rig: Rig) -> PositionPI | ValvePI:
    """Return the PI controller for what a rig is said to be, by its pump or by its servo valve."""
    return PositionPI.of(rig) if rig.valve.spool == "absent" else ValvePI.of(rig)
