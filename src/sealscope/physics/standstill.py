"""The state at standstill: pressures that carry the load, and a motor current that holds the pump against them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.compiled import law
from sealscope.errors import InputError
from sealscope.physics.cylinder import hard_stop_force, load_force, opposing_force
from sealscope.physics.pump import friction_torque, pump_flow, pump_torque
from sealscope.physics.restrictors import orifice_flow
from sealscope.physics.rig import RigNumbers, rig_numbers, valve_rates
from sealscope.physics.state import CURRENT, INTEGRAL, OMEGA, P_1, P_2, P_A, P_B, POSITION, STATES, state_of
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig


#: Codes of `stand_still` if there is no standstill: a pressure is below vacuum, or the drive cannot hold the load. They
#: are also codes of an FMU, whose code 1 is a state that is not finite (`fmu/machine.py`).
BELOW_VACUUM, BEYOND_DRIVE = 2, 3


@law
def standstill_force(x: float, p: RigNumbers) -> float:
    """Compute the force [N] along +x with which the chamber pressures must hold the piston at rest at x [m].

    It balances the rig's load, the opposing cylinder and, if the piston touches one, the end stop.
    """
    # at rest, v = 0, the flow coefficient of the opposing cylinder's orifice does not matter: it is set to 1
    load = load_force(x, p.F_l, p.k_load) + opposing_force(0.0, p.A_opp, p.p_opp, 1.0)
    return load - hard_stop_force(x, 0.0, p.L, p.k_stop, p.d_stop)  # type: ignore[no-any-return]


@law
def pressures_at_standstill(force: float, p: RigNumbers) -> tuple[float, float]:
    """Compute the chamber pressures p_A, p_B [Pa] that hold the piston at rest: p_A A_A - p_B A_B = force.

    `force` [N]: load against +x. If the rig has a make-up (`made_up`), the lower pressure is the charge pressure. If
    not, the circuit contains as much oil as with the charge pressure everywhere: the mean of both pressures, weighted
    by the oil volumes of the two sides at mid-stroke, is the charge pressure.
    """
    if p.made_up:
        p_B = max((p.p_charge * p.A_A - force) / p.A_B, p.p_charge)
        p_A = max((p.p_charge * p.A_B + force) / p.A_A, p.p_charge)
        return p_A, p_B
    V_A, V_B = p.V_A, p.V_B
    if len(p.throttled) > 0:  # a rig with lines, whose oil belongs to sides A and B
        V_A, V_B = V_A + p.V_1, V_B + p.V_2
    missing_force = force - p.p_charge * (p.A_A - p.A_B)  # [N] that the charge pressure does not carry
    # bulk modulus times the oil volume that moves from side B to A [Pa m^3]; divided by a side's volume, it is the
    # change of that side's pressure
    modulus_times_volume = missing_force / (p.A_A / V_A + p.A_B / V_B)
    return p.p_charge + modulus_times_volume / V_A, p.p_charge - modulus_times_volume / V_B


@law
def stand_still(y: Any, x: float, force: float, p: RigNumbers) -> int:
    """Set the state `y` (14,), all 0, to standstill of a pump-controlled rig; return 0, or a code if impossible.

    `x` [m]: position; `force` [N]: load against +x. The motor holds the pump with the current i = T_load/C_m, eq.
    (4.5), for which the speed controller's integral is R_c i/K_i, eq. (4.3). The code is `BELOW_VACUUM` for a pressure
    below vacuum, `BEYOND_DRIVE` for a current or voltage beyond the drive's limit.
    """
    p_A, p_B = pressures_at_standstill(force, p)
    y[POSITION] = x
    y[P_A] = y[P_1] = p_A
    y[P_B] = y[P_2] = p_B
    y[CURRENT] = pump_torque(p_A - p_B, p.q_b) / p.C_m
    # with K_i = 0 no voltage holds the current at rest: the pump then begins to turn
    y[INTEGRAL] = p.R_c * y[CURRENT] / p.K_i if p.K_i > 0.0 else 0.0
    if not min(p_A, p_B) >= -P_ATM:  # also for NaN
        return BELOW_VACUUM
    return 0 if abs(y[CURRENT]) <= p.i_max and p.R_c * abs(y[CURRENT]) <= p.V_max else BEYOND_DRIVE


def supply_at_standstill(force: float, x: float, p: RigNumbers) -> tuple[float, float, float]:
    """Compute the supply pressure p_1 and chamber pressures p_A, p_B [Pa] of a rig at rest with a centred servo valve.

    `force` [N]: load against +x; `x` [m]: position. At rest dp_1/dt = 0. As dp_1/dt falls with rising p_1, bisection
    finds this p_1 between the return's pressure and one at which the relief valve takes more than the pump delivers.
    p_A + p_B = p_1 + p_2, because the edges to supply and return are equal and have equal pressure drops (Merritt,
    Hydraulic Control Systems, 1967, section 5.2). The same sum is assumed for an overlapped valve, which may trap oil
    at other pressures.
    """
    y = np.zeros(len(STATES))
    y[POSITION], y[P_2] = x, p.p_return
    low = p.p_return
    high = low + p.p_set + p.q_b * p.omega_P / p.G_set
    p_A, p_B = low, low  # overwritten in the loop
    for _ in range(200):  # more halvings than doubles resolve: `low` and `middle` then agree
        middle = 0.5 * (low + high)
        p_A = (force + p.A_B * (middle + p.p_return)) / (p.A_A + p.A_B)
        p_B = middle + p.p_return - p_A
        y[P_A], y[P_B], y[P_1] = p_A, p_B, middle
        dp = middle - p.p_return
        Q_1 = pump_flow(p.omega_P, dp, p.q_b, p.G_pump) - orifice_flow(dp, p.c_slip, p.dp_0)
        _, _, p_1_rate, _ = valve_rates(state_of(y), Q_1, p)
        if p_1_rate > 0.0:
            low = middle
        else:
            high = middle
    return low, p_A, p_B


def initial_state(rig: Rig, x_0: float, push: float = 0.0) -> np.ndarray:
    """Compute the state (14,) of a rig at rest with the piston at x_0 [m], under its load and `push` [N] against +x.

    The motor holds the pump against the pressures (`stand_still`). In a rig with a servo valve the valve is centred and
    the motor runs at the supply's speed (`supply_at_standstill`). A machine with a leak or an underlapped valve creeps.
    Raises InputError if the pressures or the drive cannot hold the load.
    """
    p, y = rig_numbers(rig), np.zeros(len(STATES))
    force = standstill_force(x_0, p) + push
    if rig.circuit.valve_controlled:
        return _fill_standstill_state(rig, y, x_0, force, p)
    failure = stand_still(y, x_0, force, p)
    if failure == BELOW_VACUUM:
        raise InputError(
            f"a load of {force:.4g} N must be carried at standstill by pressures above vacuum, got p_A = {y[P_A]:.4g} "
            f"Pa and p_B = {y[P_B]:.4g} Pa; raise fluid.p_charge, or let a make-up hold the low side "
            "(makeup.check_valves)"
        )
    if failure == BEYOND_DRIVE:
        max_current = min(p.i_max, p.V_max / p.R_c)
        raise InputError(
            f"the drive must hold the load of {force:.4g} N at standstill, which takes {abs(y[CURRENT]):.4g} A, got at "
            f"most {max_current:.4g} A (motor.i_max, motor.V_max); take a smaller load or pump"
        )
    return y


def _fill_standstill_state(rig: Rig, y: np.ndarray, x: float, force: float, p: RigNumbers) -> np.ndarray:
    """Fill the state `y` (14,), all zeros, with the equilibrium of a rig whose servo valve is centred; return `y`.

    `x` [m]: position; `force` [N]: load against +x. Raises InputError if the supply or the drive cannot hold the load.
    """
    motor = rig.motor
    p_1, p_A, p_B = supply_at_standstill(force, x, p)
    if not rig.supply.p_return <= min(p_A, p_B) <= max(p_A, p_B) <= p_1:
        raise InputError(
            f"a load of {force:.4g} N must be carried at standstill by pressures between the return's "
            f"{rig.supply.p_return:.4g} Pa and the supply's {p_1:.4g} Pa, got p_A = {p_A:.4g} Pa and p_B = {p_B:.4g} "
            "Pa; raise supply.p_set, or take a smaller load"
        )
    y[POSITION], y[P_1], y[P_2], y[P_A], y[P_B] = x, p_1, rig.supply.p_return, p_A, p_B
    y[OMEGA] = rig.supply.omega_P
    y[CURRENT] = pump_torque(p_1 - y[P_2], p.q_b) / motor.C_m + motor.B_M * y[OMEGA] / motor.C_m
    if len(p.lossy) > 0:  # a rig with friction of motor and pump
        y[CURRENT] += friction_torque(y[OMEGA], p_1 - y[P_2], p.q_b, p.T_f, p.C_f, p.k_h, p.omega_f) / motor.C_m
    volts = motor.R_c * y[CURRENT] + motor.C_e * y[OMEGA]
    y[INTEGRAL] = volts / motor.K_i  # `Rig` checks that K_i > 0 where there is a supply
    if y[CURRENT] > motor.i_max or volts > motor.V_max:
        raise InputError(
            f"the drive must hold the supply at {p_1:.4g} Pa and {y[OMEGA]:.4g} rad/s, which takes {y[CURRENT]:.4g} A "
            f"at {volts:.4g} V, got at most {motor.i_max:g} A and {motor.V_max:g} V (motor.i_max, motor.V_max); take a "
            "slower or smaller pump, or a lower pressure (supply.omega_P, pump.q_b, supply.p_set)"
        )
    return y
