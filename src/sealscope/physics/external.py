"""What leaves and enters the circuit: leakage at the rod seals, and valves between each side and an accumulator."""

from __future__ import annotations

import math

from sealscope.compiled import contracted
from sealscope.physics.lanes import select
from sealscope.units import P_ATM


@contracted
def external_leakage(p: float, G_ext: float) -> float:
    """Compute the flow [m^3/s] out of a chamber at `p` [Pa gauge] past its rod seal: Q = G_ext p, laminar.

    No air comes in below atmospheric pressure (Merritt, Hydraulic Control Systems, 1967, external leakage of an
    actuator).
    """
    return G_ext * max(p, 0.0)


@contracted
def accumulator_pressure(V_up: float, p_charge: float, V_gas: float) -> float:
    """Compute the pressure [Pa gauge] of a gas accumulator that has given off V_up [m^3] of oil.

    p_abs (V_gas + V_up) is constant (Boyle; it empties slowly), V_gas [m^3] at `p_charge` [Pa gauge].
    """
    return (p_charge + P_ATM) * V_gas / (V_gas + V_up) - P_ATM


@contracted
def polytropic_pressure(V_up: float, p_charge: float, V_gas: float, n_gas: float) -> float:
    """Compute the pressure [Pa gauge] of a gas accumulator that has given off V_up [m^3] of oil (taken in: V_up < 0).

    p_abs (V_gas + V_up)^n is constant, n = 1 in equilibrium of heat (`accumulator_pressure`), 1.4 of nitrogen without
    exchange of heat (Merritt, Hydraulic Control Systems, 1967, accumulators).
    """
    return (p_charge + P_ATM) * math.pow(V_gas / (V_gas + V_up), n_gas) - P_ATM


@contracted
def gas_volume(p: float, p_pre: float, V_acc: float, n_acc: float) -> float:
    """Compute the gas [m^3] in an accumulator on a line at `p` [Pa gauge]: V_acc (p_pre_abs/p_abs)^(1/n).

    The inverse of `polytropic_pressure`; V_acc at `p_pre` [Pa gauge] and below it, where the accumulator is empty.
    """
    return V_acc * math.pow((p_pre + P_ATM) / (max(p, p_pre) + P_ATM), 1.0 / n_acc)


@contracted
def accumulator_compliance(p: float, p_pre: float, V_gas: float, n_acc: float) -> float:
    """Compute the oil [m^3/Pa] that an accumulator takes in as its line's pressure `p` [Pa gauge] rises.

    V_gas/(n p_abs), the slope of `gas_volume`, which is V_gas [m^3] at p; none below `p_pre`, where it is empty.
    """
    return select(p > p_pre, V_gas / (n_acc * (max(p, p_pre) + P_ATM)), 0.0)  # type: ignore[no-any-return]


@contracted
def check_valve_flow(dp: float, p_crack: float, G_check: float) -> float:
    """Compute the flow [m^3/s] through a check valve under dp [Pa].

    Q = G_check (dp - p_crack) above the cracking pressure, none below it.
    """
    return G_check * max(dp - p_crack, 0.0)


@contracted
def pilot_opening(dp: float, dp_pilot: float, p_crack: float, k_pilot: float, p_open: float) -> float:
    """Compute the opening of a pilot-operated check valve: (dp + k_pilot dp_pilot - p_crack)/p_open within 0 .. 1.

    dp [Pa] across the valve in its free direction, dp_pilot [Pa] of the pilot over the inlet, which only opens. So oil
    flows back against dp < 0 once k_pilot dp_pilot > p_crack - dp.

    Source: the pilot-operated check valve of the Simscape Fluids library (area linear in the pressure on the poppet).
    """
    return min(max((dp + k_pilot * max(dp_pilot, 0.0) - p_crack) / p_open, 0.0), 1.0)


@contracted
def pilot_valve_flow(
    dp: float, dp_pilot: float, p_crack: float, G_check: float, k_pilot: float, p_open: float
) -> float:
    """Compute the flow [m^3/s] through a pilot-operated check valve: Q = G_check dp times its opening, either way."""
    return G_check * dp * pilot_opening(dp, dp_pilot, p_crack, k_pilot, p_open)
