"""Internal leakage: oil that passes the piston seal, or the bypass needle valve that imitates it, from chamber A to B.

The equations of the thesis have no leakage term; it enters the chamber balances (eqs. 4.18-4.19) as a flow from A to
B. A worn seal is a narrow gap, laminar; the rig's needle valve is an orifice. Both may act at once.
"""

from __future__ import annotations

import numpy as np

from sealscope.compiled import contracted, kernel
from sealscope.physics.lanes import anywhere
from sealscope.physics.restrictors import orifice_flow


@contracted
def laminar_leakage(dp: float, G: float) -> float:
    """Compute Q_L = G (p_A - p_B) [m^3/s] through a laminar gap of leakage conductance G [m^3/(s Pa)].

    Source: Merritt, Hydraulic Control Systems, 1967, leakage of an actuator.
    """
    return G * dp


@contracted
def piston_leakage(dp: float, G: float, C: float, dp_0: float) -> float:
    """Compute Q_L [m^3/s] from chamber A to B: a laminar gap G [m^3/(s Pa)] beside an orifice C [m^3/(s Pa^0.5)]."""
    if not anywhere(C > 0.0):
        return laminar_leakage(dp, G)
    return laminar_leakage(dp, G) + orifice_flow(dp, C, dp_0)


@kernel
def leakage_series(dp: np.ndarray, G: np.ndarray, C: np.ndarray, dp_0: float) -> np.ndarray:
    """Compute `piston_leakage` [m^3/s] for each sample: `dp` [Pa], `G`, `C` are (n,)."""
    flow = np.empty(dp.size)
    for k in range(dp.size):
        flow[k] = piston_leakage(dp[k], G[k], C[k], dp_0)
    return flow
