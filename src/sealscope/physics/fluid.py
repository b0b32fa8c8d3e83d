"""The oil with air in it."""

from __future__ import annotations

import math

from sealscope.compiled import contracted
from sealscope.physics.lanes import anywhere

#: Atmospheric pressure [Pa]; every pressure of the rig is counted from it.
P_ATM = 101325.0
#: Least absolute pressure [Pa] at which the law of the air is evaluated: a bubble has a volume.
_LEAST = 100.0


@contracted
def effective_bulk_modulus(p: float, K_oil: float, air: float, n_air: float) -> float:
    """Bulk modulus [Pa] of oil with free air at the pressure `p` [Pa gauge].

    K = K_oil (1 + r)/(1 + r K_oil/(n p_abs)), r = air (p_atm/p_abs)^(1/n): volume of air over volume of oil, compressed
    polytropically from its share `air` at atmospheric pressure; nothing dissolves. K_oil without air, exactly.

    Source: H. E. Merritt, Hydraulic Control Systems, 1967, effective bulk modulus (1/K is the sum of the compliances of
    liquid and gas); in this form the hydraulic fluid of the Simscape library, from which the thesis took its friction.
    """
    if not anywhere(air > 0.0):
        return K_oil + 0.0 * p
    p_abs = max(p + P_ATM, _LEAST)
    r = air * math.pow(P_ATM / p_abs, 1.0 / n_air)
    return K_oil * (1.0 + r) / (1.0 + r * K_oil / (n_air * p_abs))
