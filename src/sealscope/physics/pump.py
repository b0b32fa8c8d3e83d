"""The fixed-displacement pump, driven both ways."""

from __future__ import annotations

import math

from sealscope.compiled import contracted


@contracted
def pump_flow(omega: float, dp: float, q_b: float, G_pump: float) -> float:
    """Return the flow [m^3/s] that the pump delivers into port 1.

    Q_1 = q_b omega / (2 pi) - G_pump (p_1 - p_2), eq. (4.1) with internal leakage.

    `omega` [rad/s], `dp` = p_1 - p_2 [Pa], `q_b` displacement [m^3/rev], `G_pump` [m^3/(s Pa)] (zero in the thesis).
    """
    return q_b / (2.0 * math.pi) * omega - G_pump * dp


@contracted
def pump_torque(dp: float, q_b: float) -> float:
    """Load torque [N m] of the pressure difference on the shaft: q_b (p_1 - p_2) / (2 pi), eqs. (4.5)-(4.6)."""
    return q_b / (2.0 * math.pi) * dp
