"""Internal leakage: oil flowing from chamber A to B past the piston seal, or through a needle valve in its place.

The equations of the thesis have no leakage term; it enters the chamber balances (eqs. 4.18-4.19) as a flow from A to
B. A worn seal is a narrow, laminar gap; the rig's needle valve is an orifice. Both may act at once.
"""

from __future__ import annotations

import numpy as np

from sealscope.compiled import contracted, kernel
from sealscope.physics.lanes import any_lane
from sealscope.physics.restrictors import orifice_flow


@contracted
def laminar_leakage(dp: float, G: float) -> float:
    """Compute Q_L = G (p_A - p_B) [m^3/s] through a laminar gap of leakage conductance G [m^3/(s Pa)].

    Source: Merritt, Hydraulic Control Systems, 1967, leakage of an actuator.
    """
    return G * dp


@contracted
def piston_leakage(dp: float, G: float, C: float, dp_0: float) -> float:
    """Compute the leakage Q_L [m^3/s] from chamber A to B through a laminar gap and an orifice in parallel.

    `dp` = p_A - p_B [Pa], conductance `G` [m^3/(s Pa)], orifice coefficient `C` [m^3/(s Pa^0.5)].
    """
    if not any_lane(C > 0.0):
        return laminar_leakage(dp, G)
    return laminar_leakage(dp, G) + orifice_flow(dp, C, dp_0)


@kernel
def leakage_series(dp: np.ndarray, G: np.ndarray, C: np.ndarray, dp_0: float) -> np.ndarray:
    """Compute `piston_leakage` [m^3/s] sample by sample for `dp` [Pa], `G` and `C`, each (n,)."""
    Q_L = np.empty(dp.size)
    for k in range(dp.size):
        Q_L[k] = piston_leakage(dp[k], G[k], C[k], dp_0)
    return Q_L
