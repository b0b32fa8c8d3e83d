"""What leaves and enters the closed circuit: leakage at the rod seals, and the make-up that replaces it."""

from __future__ import annotations

from sealscope.compiled import contracted
from sealscope.physics.fluid import P_ATM


@contracted
def external_leakage(p: float, G_ext: float) -> float:
    """Return the flow [m^3/s] out of a chamber at `p` [Pa gauge] past its rod seal: Q = G_ext p, laminar.

    No air comes in below atmospheric pressure (Merritt, Hydraulic Control Systems, 1967, external leakage of an
    actuator).
    """
    return G_ext * max(p, 0.0)


@contracted
def accumulator_pressure(V_up: float, p_charge: float, V_gas: float) -> float:
    """Return the pressure [Pa gauge] of a gas accumulator that has given off V_up [m^3] of oil.

    p_abs (V_gas + V_up) is constant (Boyle; it empties slowly), V_gas [m^3] at `p_charge` [Pa gauge].
    """
    return (p_charge + P_ATM) * V_gas / (V_gas + V_up) - P_ATM


@contracted
def check_valve_flow(dp: float, p_crack: float, G_check: float) -> float:
    """Return the flow [m^3/s] through a check valve under dp [Pa].

    Q = G_check (dp - p_crack) above the cracking pressure, none below it.
    """
    return G_check * max(dp - p_crack, 0.0)
