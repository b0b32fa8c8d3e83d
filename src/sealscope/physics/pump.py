"""The fixed-displacement pump, which turns in both directions, and its losses over speed and pressure.

Source of the losses: W. E. Wilson, Positive-displacement pumps and fluid motors, 1950 (laminar slip, viscous drag,
friction by pressure, constant friction), and W. M. J. Schlosser, Mathematical model for displacement pumps and
motors, Hydraulic Power Transmission 7 (1961) 252-257 and 324-328 (turbulent slip, hydrodynamic drag). D = q_b/(2 pi)
[m^3/rad] is the displacement per radian.
"""

from __future__ import annotations

import math
from typing import Any

from sealscope.compiled import contracted, law


@contracted
def pump_flow(omega: float, dp: float, q_b: float, G_pump: float) -> float:
    """Compute the pump's delivery at port 1, Q_1 = q_b omega/(2 pi) - G_pump (p_1 - p_2) [m^3/s], eq. (4.1).

    `omega` [rad/s]: speed; `dp` = p_1 - p_2 [Pa]: pressure difference of the ports; `q_b` [m^3/rev]: displacement;
    `G_pump` [m^3/(s Pa)]: conductance of the internal leakage, 0 in the thesis.
    """
    return q_b / (2.0 * math.pi) * omega - G_pump * dp


@contracted
def pump_torque(dp: float, q_b: float) -> float:
    """Compute the torque [N m] on the pump's shaft under `dp` = p_1 - p_2 [Pa], eqs. (4.5)-(4.6); `q_b` [m^3/rev]."""
    return q_b / (2.0 * math.pi) * dp


@law
def loss_coefficients(q_b: float, C_st: float, C_h: float, rho: float) -> tuple[float, float]:
    """Compute the coefficients (c_slip, k_h) of the pump's turbulent slip and of its hydrodynamic torque.

    c_slip = C_st D^(2/3) sqrt(2/rho) [m^3/(s Pa^0.5)], of a flow back through the pump like that of an orifice, and
    k_h = C_h rho D^(5/3)/2 [N m s^2], with the oil's density `rho` [kg/m^3] (Schlosser 1961). `q_b` [m^3/rev]:
    displacement; `C_st`, `C_h`: dimensionless coefficients.
    """
    D = q_b / (2.0 * math.pi)
    return C_st * D ** (2.0 / 3.0) * math.sqrt(2.0 / rho), 0.5 * C_h * rho * D ** (5.0 / 3.0)


@contracted
def friction_torque(omega: float, dp: float, q_b: float, T_f: float, C_f: float, k_h: float, omega_f: float) -> float:
    """Compute the friction torque [N m] of motor and pump at the speed `omega` [rad/s], without viscous drag.

    T = sat(omega/omega_f) (T_f + C_f D |dp|) + k_h omega |omega|: constant friction `T_f` [N m], friction that grows
    with the pressure difference `dp` [Pa] of the ports, hydrodynamic torque (`loss_coefficients`). sat limits its
    argument to +-1: below the speed `omega_f` [rad/s], friction is linear in the speed.
    """
    smooth_sign = min(max(omega / omega_f, -1.0), 1.0)
    return smooth_sign * (T_f + C_f * abs(pump_torque(dp, q_b))) + k_h * omega * abs(omega)


def hydraulic_power(Q_1: Any, dp: Any) -> Any:
    """Compute the hydraulic power [W] of a pump: flow `Q_1` [m^3/s] out of port 1 times `dp` = p_1 - p_2 [Pa]."""
    return Q_1 * dp
