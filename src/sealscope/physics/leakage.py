"""Internal leakage: oil flowing from chamber A to B past the piston seal, or through a needle valve in its place.

The equations of the thesis have no leakage term; it enters the chamber balances (eqs. 4.18-4.19) as a flow from A to
B. A worn seal is a narrow, laminar gap; the rig's needle valve is an orifice. Both may act at once.
"""

from __future__ import annotations

import numpy as np

from sealscope.compiled import contracted, kernel
from sealscope.physics.restrictors import orifice_flow


@contracted
def laminar_leakage(dp: float, G: float) -> float:
    """Compute the leakage Q_L = G dp [m^3/s] from chamber A to B through a laminar gap.

    `dp` = p_A - p_B [Pa]; `G`: conductance [m^3/(s Pa)] (Merritt, Hydraulic Control Systems, 1967, actuator leakage).
    """
    return G * dp


@contracted
def piston_leakage(dp: float, G: float, C: float, dp_0: float) -> float:
    """Compute the leakage Q_L [m^3/s] from chamber A to B through a laminar gap and an orifice in parallel.

    `dp` = p_A - p_B [Pa]; `G`: conductance of the gap [m^3/(s Pa)]; `C`: flow coefficient of the orifice
    [m^3/(s Pa^0.5)], whose flow is linear in dp for |dp| below about `dp_0` [Pa] (`orifice_flow`).
    """
    if not C > 0.0:  # no orifice
        return laminar_leakage(dp, G)
    return laminar_leakage(dp, G) + orifice_flow(dp, C, dp_0)


@kernel
def leakage_series(dp: np.ndarray, G: np.ndarray, C: np.ndarray, dp_0: float, Q_L: np.ndarray) -> None:
    """Write `piston_leakage` [m^3/s] for n `dp` [Pa], `G` [m^3/(s Pa)] and `C` [m^3/(s Pa^0.5)] to `Q_L` (n,)."""
    for k in range(dp.size):
        Q_L[k] = piston_leakage(dp[k], G[k], C[k], dp_0)
