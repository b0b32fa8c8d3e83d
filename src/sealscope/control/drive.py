"""What a drive must be told so that its pump gives a flow: the inverse of its own speed loop."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.parameters import Rig


def check_numbers(what: str, positive: dict[str, float], not_negative: dict[str, float]) -> None:
    """Raise InputError for a number that is not finite, not > 0, or not >= 0; `what` has it."""
    for name, value in positive.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name} of {what} must be > 0, got {value}")
    for name, value in not_negative.items():
        if not (math.isfinite(value) and value >= 0):
            raise InputError(f"{name} of {what} must be >= 0, got {value}")


@dataclass(frozen=True)
class Drive:
    """What a controller assumes of pump and drive.

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
        positive = {"displacement": self.displacement, "omega_per_volt": self.omega_per_volt}
        rest = {"shortfall": self.shortfall, "corner": self.corner, "droop": self.droop}
        check_numbers("the drive", positive, rest)

    @classmethod
    def of(cls, rig: Rig) -> Self:
        """Return the drive that a rig is said to have."""
        motor, displacement = rig.motor, rig.pump.q_b / (2.0 * math.pi)
        shortfall, corner = (motor.C_e / motor.k_p, motor.K_i / motor.k_p) if motor.k_p > 0 else (0.0, 0.0)
        droop = motor.R_c * displacement / (motor.C_m * motor.C_e)
        return cls(displacement, motor.omega_per_volt, shortfall, corner, droop)

    def inverse(self, rate: float) -> Callable[[float, float], float]:
        """Return a function of a flow [m^3/s] and a pressure difference [Pa], called at `rate` [Hz]: the voltage [V].

        The voltage makes the pump give the flow against the pressure difference (p_A - p_B).
        """
        fading = math.exp(-self.corner / rate)
        quick = before = 0.0

        def voltage(flow: float, dp: float) -> float:
            nonlocal quick, before
            omega = flow / self.displacement
            voltages = omega + self.droop * dp
            quick = fading * (quick + voltages - before)
            before = voltages
            return (omega + self.shortfall * quick) / self.omega_per_volt

        return voltage
