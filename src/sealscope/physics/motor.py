"""The servo motor and its speed loop: PI controller, limited voltage, winding with a limited current, shaft."""

from __future__ import annotations

from typing import Any

from sealscope.compiled import contracted
from sealscope.physics.lanes import select


@contracted
def controller_voltage(error: float, integral: float, k_p: float, K_i: float, V_max: float) -> float:
    """Compute the winding voltage [V] of the PI speed controller, eq. (4.3), limited to the drive's supply +-V_max."""
    voltage = k_p * error + K_i * integral
    return min(max(voltage, -V_max), V_max)


@contracted
def winding_current_rate(
    voltage: float, i: float, omega: float, R_c: float, L_c: float, C_e: float, i_max: float
) -> float:
    """Compute the winding's di/dt = (V - R_c i - C_e omega)/L_c [A/s], eq. (4.4); 0 if it would pass +-i_max."""
    rate = (voltage - R_c * i - C_e * omega) / L_c
    at_limit = ((i >= i_max) & (rate > 0.0)) | ((i <= -i_max) & (rate < 0.0))
    return select(at_limit, 0.0, rate)  # type: ignore[no-any-return]


@contracted
def shaft_acceleration(i: float, omega: float, load_torque: float, C_m: float, B_M: float, J_M: float) -> float:
    """Compute the shaft's domega/dt = (C_m i - B_M omega - T_load)/J_M [rad/s^2], eq. (4.5)."""
    return (C_m * i - B_M * omega - load_torque) / J_M


def electric_power(V: Any, i: Any) -> Any:
    """Compute the electrical power V i [W] into the motor."""
    return V * i
