"""Flows out of and into the circuit: leakage at the rod seals, and the make-up's valves and accumulator."""

from __future__ import annotations

import math

from sealscope.compiled import contracted
from sealscope.physics.lanes import select
from sealscope.units import P_ATM


@contracted
def external_leakage(p: float, G_ext: float) -> float:
    """Compute the laminar leakage Q = G_ext p [m^3/s] past the rod seal of a chamber at `p` [Pa gauge].

    It is 0 below atmospheric pressure: the seal lets no air in (Merritt, Hydraulic Control Systems, 1967, external
    leakage of an actuator).
    """
    return G_ext * max(p, 0.0)


@contracted
def accumulator_pressure(V_up: float, p_charge: float, V_gas: float) -> float:
    """Compute the pressure [Pa gauge] of a gas accumulator that has delivered the oil V_up [m^3].

    Boyle's law, p_abs (V_gas + V_up) = constant: the gas V_gas [m^3] at `p_charge` [Pa gauge] expands isothermally.
    """
    return (p_charge + P_ATM) * V_gas / (V_gas + V_up) - P_ATM


@contracted
def polytropic_pressure(V_up: float, p_charge: float, V_gas: float, n_gas: float) -> float:
    """Compute the pressure [Pa gauge] of a gas accumulator that has delivered the oil V_up [m^3] (< 0: received).

    p_abs (V_gas + V_up)^n = constant; n = 1 is isothermal (`accumulator_pressure`), n = 1.4 is adiabatic nitrogen
    (Merritt, Hydraulic Control Systems, 1967, accumulators).
    """
    return (p_charge + P_ATM) * math.pow(V_gas / (V_gas + V_up), n_gas) - P_ATM


@contracted
def gas_volume(p: float, p_pre: float, V_acc: float, n_acc: float) -> float:
    """Compute the gas volume [m^3] of an accumulator on a line at `p` [Pa gauge]: V_acc (p_pre_abs/p_abs)^(1/n).

    The inverse of `polytropic_pressure`. Up to the precharge `p_pre` [Pa gauge] it is V_acc: the accumulator is empty.
    """
    return V_acc * math.pow((p_pre + P_ATM) / (max(p, p_pre) + P_ATM), 1.0 / n_acc)


@contracted
def accumulator_compliance(p: float, p_pre: float, V_gas: float, n_acc: float) -> float:
    """Compute the compliance [m^3/Pa] of an accumulator on a line at `p` [Pa gauge]: V_gas/(n p_abs).

    It is the slope of `gas_volume`, with V_gas [m^3] of gas at p, and 0 below the precharge `p_pre` [Pa gauge].
    """
    return select(p > p_pre, V_gas / (n_acc * (max(p, p_pre) + P_ATM)), 0.0)  # type: ignore[no-any-return]


@contracted
def check_valve_flow(dp: float, p_crack: float, G_check: float) -> float:
    """Compute the flow [m^3/s] through a check valve under dp [Pa]: G_check (dp - p_crack), 0 for dp < p_crack."""
    return G_check * max(dp - p_crack, 0.0)


@contracted
def pilot_opening(dp: float, dp_pilot: float, p_crack: float, k_pilot: float, p_open: float) -> float:
    """Compute the opening of a pilot-operated check valve: (dp + k_pilot dp_pilot - p_crack)/p_open, within 0 .. 1.

    dp [Pa]: drop across the valve in its free direction; dp_pilot [Pa]: pilot pressure above the inlet's, which can
    only open the valve. Oil flows back (dp < 0) once k_pilot dp_pilot > p_crack - dp.

    Source: the pilot-operated check valve of the Simscape Fluids library (area linear in the pressure on the poppet).
    """
    return min(max((dp + k_pilot * max(dp_pilot, 0.0) - p_crack) / p_open, 0.0), 1.0)


@contracted
def pilot_valve_flow(
    dp: float, dp_pilot: float, p_crack: float, G_check: float, k_pilot: float, p_open: float
) -> float:
    """Compute the flow G_check dp [m^3/s] times the opening of a pilot-operated check valve, in either direction."""
    return G_check * dp * pilot_opening(dp, dp_pilot, p_crack, k_pilot, p_open)
