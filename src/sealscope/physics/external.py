"""Flows out of and into the circuit: leakage at the rod seals, and the make-up's valves and accumulator."""

from __future__ import annotations

import math

from sealscope.compiled import contracted
from sealscope.physics.lanes import select
from sealscope.units import P_ATM


@contracted
def external_leakage(p: float, G_ext: float) -> float:
    """Compute the laminar leakage G_ext p [m^3/s] past the rod seal out of a chamber at the pressure `p` [Pa gauge].

    It is 0 below atmospheric pressure: no air enters (Merritt, Hydraulic Control Systems, 1967, external leakage).
    """
    return G_ext * max(p, 0.0)


@contracted
def accumulator_pressure(V_up: float, p_charge: float, V_gas: float) -> float:
    """Compute the pressure [Pa gauge] of a gas accumulator that has delivered the oil V_up [m^3], < 0 if taken in.

    The gas has the volume `V_gas` [m^3] at `p_charge` [Pa gauge], and p_abs (V_gas + V_up) is constant (isothermal).
    """
    return (p_charge + P_ATM) * V_gas / (V_gas + V_up) - P_ATM


@contracted
def polytropic_pressure(V_up: float, p_charge: float, V_gas: float, n_gas: float) -> float:
    """Compute the pressure [Pa gauge] of a gas accumulator whose gas changes its volume polytropically.

    p_abs (V_gas + V_up)^n = constant, with the exponent n = `n_gas`: 1 is isothermal, 1.4 is adiabatic nitrogen. Other
    arguments: as in `accumulator_pressure`. Source: Merritt, Hydraulic Control Systems, 1967, accumulators.
    """
    return (p_charge + P_ATM) * math.pow(V_gas / (V_gas + V_up), n_gas) - P_ATM


@contracted
def gas_volume(p: float, p_pre: float, V_acc: float, n_acc: float) -> float:
    """Compute the gas volume [m^3] of an accumulator on a line at the pressure `p` [Pa gauge].

    It is V_acc (p_pre_abs/p_abs)^(1/n), the inverse of `polytropic_pressure`, with the polytropic exponent n = `n_acc`
    and absolute pressures. Up to the precharge pressure `p_pre` [Pa gauge] the accumulator contains no oil, and its gas
    fills the whole volume `V_acc` [m^3].
    """
    return V_acc * math.pow((p_pre + P_ATM) / (max(p, p_pre) + P_ATM), 1.0 / n_acc)


@contracted
def accumulator_compliance(p: float, p_pre: float, V_gas: float, n_acc: float) -> float:
    """Compute the compliance [m^3/Pa] of an accumulator: the oil it takes in per unit rise of the line's pressure.

    It is V_gas/(n p_abs), the negative slope of `gas_volume`, and 0 up to the precharge pressure `p_pre` [Pa gauge].
    `V_gas` [m^3]: volume of the gas at the pressure `p` [Pa gauge]; `n_acc`: polytropic exponent n.
    """
    return select(p > p_pre, V_gas / (n_acc * (max(p, p_pre) + P_ATM)), 0.0)  # type: ignore[no-any-return]


@contracted
def check_valve_flow(dp: float, p_crack: float, G_check: float) -> float:
    """Compute the flow G_check (dp - p_crack) [m^3/s] through a check valve, or 0 while it is shut, dp < p_crack.

    `dp` [Pa]: pressure drop in the direction in which the valve opens; `p_crack` [Pa]: drop at which it opens;
    `G_check` [m^3/(s Pa)]: conductance of the open valve.
    """
    return G_check * max(dp - p_crack, 0.0)


@contracted
def pilot_valve_flow(
    dp: float, dp_pilot: float, p_crack: float, G_check: float, k_pilot: float, p_open: float
) -> float:
    """Compute the flow [m^3/s] through a pilot-operated check valve, positive in the free direction.

    It is G_check dp times the opening (dp + k_pilot dp_pilot - p_crack)/p_open, limited to 0..1:

    - `dp`, `dp_pilot` [Pa]: inlet minus outlet pressure; pilot minus inlet pressure, of which < 0 acts like 0.
    - `p_crack` [Pa]: pressure at which the valve begins to open; `p_open` [Pa]: further rise until it is fully open.
    - `G_check` [m^3/(s Pa)]: conductance of the fully open valve.
    - `k_pilot`: pilot ratio, the piston area of the pilot over the area of the valve's seat.

    Source: the pilot-operated check valve of the Simscape Fluids library (area linear in the pressure on the poppet).
    """
    opening = min(max((dp + k_pilot * max(dp_pilot, 0.0) - p_crack) / p_open, 0.0), 1.0)
    return G_check * dp * opening
