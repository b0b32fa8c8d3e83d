"""The servo motor and its speed loop: PI controller, limited voltage, winding with a limited current, shaft."""

from __future__ import annotations

from typing import Any

from sealscope.compiled import contracted
from sealscope.physics.lanes import select


@contracted
def controller_voltage(error: float, integral: float, k_p: float, K_i: float, V_max: float) -> float:
    """Compute the winding voltage [V] of the PI speed controller, eq. (4.3).

    It is k_p error + K_i integral, limited to the drive's supply +-`V_max` [V]. `error` [rad/s]: that of the speed.
    """
    voltage = k_p * error + K_i * integral
    return min(max(voltage, -V_max), V_max)


@contracted
def winding_current_rate(
    voltage: float, i: float, omega: float, R_c: float, L_c: float, C_e: float, i_max: float
) -> float:
    """Compute the rate of change di/dt [A/s] of the winding current, eq. (4.4), 0 where it would leave +-`i_max` [A].

    `voltage` [V]: winding voltage; `i` [A]: current; `omega` [rad/s]: speed; `R_c` [ohm], `L_c` [H]: resistance and
    inductance of the winding; `C_e` [V s/rad]: back electromotive force constant.
    """
    rate = (voltage - R_c * i - C_e * omega) / L_c
    at_limit = ((i >= i_max) & (rate > 0.0)) | ((i <= -i_max) & (rate < 0.0))
    return select(at_limit, 0.0, rate)  # type: ignore[no-any-return]


@contracted
def shaft_acceleration(i: float, omega: float, load_torque: float, C_m: float, B_M: float, J_M: float) -> float:
    """Compute the angular acceleration domega/dt [rad/s^2] of the motor's shaft, eq. (4.5).

    `i` [A]: current; `omega` [rad/s]: speed; `load_torque` [N m] of the pump; `C_m` [N m/A]: torque constant; `B_M` [N
    m s/rad], `J_M` [kg m^2]: viscous damping and moment of inertia of motor and pump.
    """
    return (C_m * i - B_M * omega - load_torque) / J_M


def electric_power(V: Any, i: Any) -> Any:
    """Compute the electrical power V i [W] into the motor."""
    return V * i
