"""The state at standstill: pressures that carry the load, and a motor that holds them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sealscope.compiled import law
from sealscope.errors import InputError
from sealscope.physics.cylinder import hard_stop_force, load_force, opposing_force
from sealscope.physics.fluid import P_ATM
from sealscope.physics.pump import friction_torque, pump_flow, pump_torque, turbulent_slip
from sealscope.physics.rig import RigNumbers, rig_numbers, valve_rates
from sealscope.physics.state import CURRENT, INTEGRAL, OMEGA, P_1, P_2, P_A, P_B, POSITION, STATES, state_of

if TYPE_CHECKING:
    from sealscope.parameters import Cylinder, Rig


@law
def carried_at_standstill(
    x: float, F_l: float, k_load: float, A_opp: float, p_opp: float, L: float, k_stop: float, d_stop: float
) -> float:
    """Force [N] against +x that the pressures carry at standstill at x [m]: the load less that of a stop."""
    load = load_force(x, F_l, k_load) + opposing_force(0.0, A_opp, p_opp, 1.0)
    return load - hard_stop_force(x, 0.0, L, k_stop, d_stop)


@law
def holding_current(dp: float, q_b: float, C_m: float) -> float:
    """Winding current [A] that holds the pump against dp [Pa]: T_load/C_m, eq. (4.5) at standstill."""
    return pump_torque(dp, q_b) / C_m


@law
def holding_integral(i: float, R_c: float, K_i: float) -> float:
    """Integral [rad] of the speed controller that gives the winding i [A] at standstill: R_c i/K_i, eq. (4.3)."""
    return R_c * i / K_i if K_i > 0.0 else 0.0


@law
def pressures_at_standstill(
    force: float, A_A: float, A_B: float, V_A: float, V_B: float, p_charge: float, made_up: bool
) -> tuple[float, float]:
    """Return p_A, p_B [Pa] that carry `force` [N] against +x at standstill: p_A A_A - p_B A_B = force.

    With a make-up the lower of both is at the accumulator's charge pressure. Without one the circuit holds as much oil
    as at the charge pressure throughout: the mean of both, weighted by the volumes V_A, V_B of the sides [m^3], stays.
    """
    if made_up:
        p_B = max((p_charge * A_A - force) / A_B, p_charge)
        p_A = max((p_charge * A_B + force) / A_A, p_charge)
        return p_A, p_B
    lack = force - p_charge * (A_A - A_B)  # of force, at the charge pressure
    moved = lack / (A_A / V_A + A_B / V_B)
    return p_charge + moved / V_A, p_charge - moved / V_B


@law
def pressures_behind_valve(force: float, A_A: float, A_B: float, p_1: float, p_2: float) -> tuple[float, float]:
    """Return p_A, p_B [Pa] that carry `force` [N] against +x behind a servo valve with equal edges at null.

    p_A + p_B = p_1 + p_2: as much is lost at the supply's edges as at those to the return (Merritt, Hydraulic Control
    Systems, 1967, section 5.2). An overlapped valve may trap any mean; this one is taken.
    """
    p_A = (force + A_B * (p_1 + p_2)) / (A_A + A_B)
    return p_A, p_1 + p_2 - p_A


def supply_at_standstill(force: float, x: float, p: RigNumbers) -> tuple[float, float, float]:
    """Return p_1, p_A, p_B [Pa] at which pump, relief valve and a servo valve at null let the supply's pressure stay.

    By bisection: dp_1/dt falls as p_1 rises. `force` [N] against +x, `x` [m] of the piston.
    """
    y = np.zeros(len(STATES))
    y[POSITION], y[P_2] = x, p.p_return
    low = p.p_return
    high = low + p.p_set + p.q_b * p.omega_P / p.G_set  # the relief valve alone takes more
    p_A, p_B = low, low
    for _ in range(200):
        middle = 0.5 * (low + high)
        p_A, p_B = pressures_behind_valve(force, p.A_A, p.A_B, middle, p.p_return)
        y[P_A], y[P_B], y[P_1] = p_A, p_B, middle
        over = middle - p.p_return
        Q_1 = pump_flow(p.omega_P, over, p.q_b, p.G_pump) - turbulent_slip(over, p.c_slip, p.dp_0)
        rises = valve_rates(state_of(y), Q_1, p)[2] > 0.0
        low, high = (middle, high) if rises else (low, middle)
    return low, p_A, p_B


def _carried(c: Cylinder, x: float) -> float:
    return carried_at_standstill(x, c.F_l, c.k_load, c.A_opp, c.p_opp, c.L, c.k_stop, c.d_stop)  # type: ignore[no-any-return]


def side_volumes(rig: Rig) -> tuple[float, float]:
    """Oil volumes [m^3] of both sides at mid-stroke: chamber, hose, and the line where there is one."""
    c, line = rig.cylinder, rig.line
    V_1, V_2 = (line.V_1, line.V_2) if line.orifices == "present" else (0.0, 0.0)
    return c.V + c.V_hose_A + V_1, c.V - c.V_rod + c.V_hose_B + V_2


def standstill_pressures(rig: Rig, force: float) -> tuple[float, float]:
    """Return p_A, p_B [Pa] that carry `force` [N] against +x at standstill (`pressures_at_standstill`).

    Raises InputError where one of them is below vacuum.
    """
    c, made_up = rig.cylinder, rig.makeup.check_valves != "absent"
    p_A, p_B = pressures_at_standstill(force, c.A_A, c.A_B, *side_volumes(rig), rig.fluid.p_charge, made_up)
    if min(p_A, p_B) < -P_ATM:
        raise InputError(
            f"a load of {force:.4g} N must be carried at standstill by pressures above vacuum, got p_A = {p_A:.4g} Pa "
            f"and p_B = {p_B:.4g} Pa; raise fluid.p_charge, or let a make-up hold the low side (makeup.check_valves)"
        )
    return p_A, p_B


def initial_state(rig: Rig, x_0: float, push: float = 0.0) -> np.ndarray:
    """State (14,) at standstill with the piston at x_0 [m] from mid-stroke, under `push` [N] beside the rig's own load.

    The pressures carry the load (`standstill_pressures`), the motor holds the pump against them: i = T_load/C_m, with
    the speed controller's integral at R_c i/K_i, which gives that current. A machine that leaks creeps from there.
    Without a load and with equal areas all pressures are at the charge pressure and all else is zero.

    Behind a servo valve at null the motor turns at the supply's speed, whose pressure stays (`supply_at_standstill`).
    An underlapped valve lets a loaded piston creep from there.

    Raises InputError where the pressures are below vacuum or beyond the supply's, or the drive cannot hold them.
    """
    c, m = rig.cylinder, rig.motor
    y = np.zeros(len(STATES))
    y[POSITION] = x_0
    if rig.valve.spool == "present":
        return _at_valve(rig, y, push)
    force = _carried(c, x_0) + push
    p_A, p_B = standstill_pressures(rig, force)
    y[[P_A, P_1]], y[[P_B, P_2]] = p_A, p_B
    y[CURRENT] = holding_current(p_A - p_B, rig.pump.q_b, m.C_m)
    if abs(y[CURRENT]) > m.i_max or m.R_c * abs(y[CURRENT]) > m.V_max:
        most = min(m.i_max, m.V_max / m.R_c)
        raise InputError(
            f"the drive must hold the load of {force:.4g} N at standstill, which takes {abs(y[CURRENT]):.4g} A, got at "
            f"most {most:.4g} A (motor.i_max, motor.V_max); take a smaller load or pump"
        )
    y[INTEGRAL] = holding_integral(y[CURRENT], m.R_c, m.K_i)
    return y


def _at_valve(rig: Rig, y: np.ndarray, push: float) -> np.ndarray:
    """Return the state `y` at standstill behind a servo valve, under `push` [N] beside the rig's own load."""
    c, m, p = rig.cylinder, rig.motor, rig_numbers(rig)
    force = _carried(c, y[POSITION]) + push
    p_1, p_A, p_B = supply_at_standstill(force, y[POSITION], p)
    if not rig.supply.p_return <= min(p_A, p_B) <= max(p_A, p_B) <= p_1:
        raise InputError(
            f"a load of {force:.4g} N must be carried at standstill by pressures between the return's "
            f"{rig.supply.p_return:.4g} Pa and the supply's {p_1:.4g} Pa, got p_A = {p_A:.4g} Pa and p_B = {p_B:.4g} "
            "Pa; raise supply.p_set, or take a smaller load"
        )
    y[P_1], y[P_2], y[P_A], y[P_B] = p_1, rig.supply.p_return, p_A, p_B
    y[OMEGA] = rig.supply.omega_P
    y[CURRENT] = holding_current(p_1 - y[P_2], rig.pump.q_b, m.C_m) + m.B_M * y[OMEGA] / m.C_m
    if len(p.lossy) > 0:
        y[CURRENT] += friction_torque(y[OMEGA], p_1 - y[P_2], p.q_b, p.T_f, p.C_f, p.k_h, p.omega_f) / m.C_m
    volts = m.R_c * y[CURRENT] + m.C_e * y[OMEGA]
    y[INTEGRAL] = volts / m.K_i
    if y[CURRENT] > m.i_max or volts > m.V_max:
        raise InputError(
            f"the drive must hold the supply at {p_1:.4g} Pa and {y[OMEGA]:.4g} rad/s, which takes {y[CURRENT]:.4g} A "
            f"at {volts:.4g} V, got at most {m.i_max:g} A and {m.V_max:g} V (motor.i_max, motor.V_max); take a slower "
            "or smaller pump, or a lower pressure (supply.omega_P, pump.q_b, supply.p_set)"
        )
    return y
