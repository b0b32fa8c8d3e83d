"""The longest steps with which the solver resolves a rig, from the rig's fastest oscillations and decays."""

from __future__ import annotations

import math

import numpy as np

from sealscope.physics.rig import RigNumbers

#: Upper limit of h |lambda|: for an oscillation, so that it is resolved (one radian a step); for a decay, so that it
#: stays stable (RK4: Hairer & Wanner, Solving Ordinary Differential Equations II, 1996, IV.2).
OSCILLATION_LIMIT = 1.0
DECAY_LIMIT = 2.785


def _end_volumes(p: RigNumbers) -> tuple[tuple[float, float], ...]:
    """Compute the oil volumes (V_A, V_B) [m^3] at each end of the stroke; a single pair if volumes are constant."""
    if not p.position_dependent:
        return ((p.V_A, p.V_B),)
    return tuple((p.V_A + p.A_A * x, p.V_B - p.A_B * x) for x in (-0.5 * p.L, 0.5 * p.L))


def _longest_mode_step(damping: float, stiffness: float) -> float:
    """Compute the longest step [s] that resolves the two modes of s^2 + damping s + stiffness = 0.

    `damping` [1/s], `stiffness` [1/s^2]. Modes that oscillate may advance by one radian a step: 1/sqrt(stiffness). If
    they decay without oscillation, the faster one, of rate lambda, must be stable: 2.785/lambda. The result is infinite
    if they do neither.
    """
    discriminant = damping * damping - 4.0 * stiffness
    if discriminant < 0.0:
        return OSCILLATION_LIMIT / math.sqrt(stiffness)
    decay = 0.5 * (damping + math.sqrt(discriminant))
    return DECAY_LIMIT / decay if decay > 0.0 else math.inf


def _steepest_rise(breakpoints: np.ndarray) -> float:
    """Compute the steepest positive slope of a `piecewise_linear_force`, or 0 if it never rises.

    Column 1 of its `breakpoints` (n, 2) has the first slope, then the changes of the slope.
    """
    return max(0.0, float(np.cumsum(breakpoints[:, 1]).max()))


def stiffest_rate(p: RigNumbers) -> float:
    """Compute the fastest decay rate lambda [1/s] of a rig with throttles; RK4 is stable for h lambda < 2.785.

    lambda = K_oil (1/V_1 + 1/V) c/sqrt(dp_0): the pressures of a line volume V_1 and of a chamber V equalise through a
    throttle, whose slope dQ/dp at dp = 0 is c/sqrt(dp_0). The smallest volumes and the largest c are taken.
    """
    c = max(p.c_A_in, p.c_A_out, p.c_B_in, p.c_B_out)
    min_chamber = min(volume for volumes in _end_volumes(p) for volume in volumes)
    return float(p.K_oil * (1.0 / min(p.V_1, p.V_2) + 1.0 / min_chamber) * c / math.sqrt(p.dp_0))


def longest_step(p: RigNumbers, G: float = 0.0, C: float = 0.0) -> float:
    """Compute the longest step [s] that resolves a rig without its throttles, end stops and opposing cylinder.

    `G` [m^3/(s Pa)], `C` [m^3/(s Pa^0.5)]: leakage coefficients of the piston. The result is the shortest of the steps
    that resolve these parts (`_longest_mode_step`):

    - the speed loop of winding and shaft, and pump and motor between the volumes at the pump's ports;
    - the piston between its oil columns, with the load's spring and damper, both while it slides and near standstill,
      where friction acts like a steep damper (about K_brk F_C/v_th at the charge pressure) or like LuGre's spring;
    - the leakage between the chambers, external leakage and make-up, and a servo valve with its supply.

    The stability limit of a decay is that of RK4; the explicit part of ARK4(3)6L[2]SA is stable beyond it. Air is left
    out because it only softens the oil.
    """
    ends = _end_volumes(p)
    # stiffness of the oil in both chambers, and in the volumes at the pump's ports [Pa/m^3]
    chamber_stiffness = p.K_oil * max(1.0 / V_A + 1.0 / V_B for V_A, V_B in ends)
    port_stiffness = p.K_oil * (1.0 / p.V_1 + 1.0 / p.V_2) if len(p.throttled) > 0 else chamber_stiffness
    B_M, G_pump = p.B_M, p.G_pump
    if len(p.lossy) > 0:  # steepest slopes: of friction at rest under the largest torque, of slip at no pressure
        B_M += (p.T_f + p.C_f * p.C_m * p.i_max) / p.omega_f
        G_pump += p.c_slip / math.sqrt(p.dp_0)
    loop_stiffness = (p.R_c * B_M + p.C_m * (p.C_e + p.k_p)) / (p.L_c * p.J_M)
    speed_loop_step = _longest_mode_step(p.R_c / p.L_c + B_M / p.J_M, loop_stiffness)
    # stiffness of the oil columns and the load's spring, over the mass [1/s^2]
    column_stiffness = (p.K_oil * max(p.A_A**2 / V_A + p.A_B**2 / V_B for V_A, V_B in ends) + p.k_load) / p.M_eq
    F_C = p.F_pr + (0.0 if p.coulomb_of_difference else p.F_cfr * 2.0 * p.p_charge)  # p_A = p_B = p_charge
    friction_slope = F_C * p.K_brk / p.v_th + p.F_v
    if p.literal_bracket:  # eq. (4.22) as printed
        friction_slope = F_C * (p.K_brk + p.F_v * p.v_th) / p.v_th
    damper = p.d_load
    if len(p.pushed) > 1:  # the tables of a load over position and velocity
        column_stiffness += _steepest_rise(p.pushed[0]) / p.M_eq
        damper += _steepest_rise(p.pushed[1])
    sliding_step = _longest_mode_step((p.F_v + damper) / p.M_eq, column_stiffness)
    # near standstill, in the direction of the larger friction
    sticking_step = _longest_mode_step((max(1.0, p.backward) * friction_slope + damper) / p.M_eq, column_stiffness)
    if len(p.bristled) > 0:
        bristle_stiffness = column_stiffness + p.sigma_0 / p.M_eq
        sticking_step = _longest_mode_step((p.sigma_1 + p.F_v + damper) / p.M_eq, bristle_stiffness)
    if len(p.valved) > 0:
        port_stiffness = 0.0  # the pump feeds the supply (`_longest_valve_step`)
    pump_step = _longest_mode_step(port_stiffness * G_pump, port_stiffness * (p.q_b / (2.0 * math.pi)) ** 2 / p.J_M)
    leak_step = _longest_mode_step(chamber_stiffness * (G + C / math.sqrt(p.dp_0)), stiffness=0.0)
    # dQ/dp over G: Q = G dp (dp - p_crack)/p_open of a pilot-operated valve is steepest where it just opens fully
    steepest = 2.0 + p.p_crack / p.p_open if len(p.piloted) > 0 else 1.0
    max_valve_slope = max(p.G_check * steepest * p.made_up, p.G_relief * (len(p.relieved) > 0))
    external_decay = chamber_stiffness * max(p.G_ext_A, p.G_ext_B) + port_stiffness * max_valve_slope
    external_step = _longest_mode_step(external_decay, stiffness=0.0)
    step = min(speed_loop_step, sliding_step, sticking_step, pump_step, leak_step, external_step)
    if len(p.valved) > 0:
        step = min(step, _longest_valve_step(p, ends))
    return float(step)


def _longest_valve_step(p: RigNumbers, end_volumes: tuple[tuple[float, float], ...]) -> float:
    """Compute the longest step [s] that resolves a servo valve with its supply, the smallest of three limits.

    - The spool, a second-order lag.
    - A chamber: its pressure decays through the two metering edges that connect it with supply and return. Their slope
      dQ/dp is taken where it is largest, at full stroke and a small pressure drop.
    - The supply line: its oil oscillates with the inertia of motor and pump, and is damped by the pump's leakage, the
      relief valve and the edges of both chambers.

    `end_volumes`: (V_A, V_B) [m^3] at each end of the stroke.
    """
    overlaps = (p.o_PA, p.o_AT, p.o_PB, p.o_BT)
    edge_slope = p.Q_N / math.sqrt(p.dp_N * p.dp_lam)  # dQ/dp of one edge at full stroke, laminar
    largest_underlap = max(0.0, *(-overlap for overlap in overlaps))
    # upper limit for both edges of a chamber together: the underlap adds to the opening of each
    chamber_slope = edge_slope * (1.0 + 2.0 * largest_underlap / p.x_max)
    # stiffness of the oil in the smaller chamber and in the supply line, whose accumulator may be empty [Pa/m^3]
    chamber_stiffness = p.K_oil * max(1.0 / volume for volumes in end_volumes for volume in volumes)
    supply_stiffness = p.K_oil / p.V_1
    spool_step = _longest_mode_step(2.0 * p.zeta_s * p.omega_s, p.omega_s**2)
    chamber_step = _longest_mode_step(chamber_slope * chamber_stiffness, stiffness=0.0)
    slip_slope = p.c_slip / math.sqrt(p.dp_0)
    supply_damping = supply_stiffness * (p.G_pump + slip_slope + p.G_set + 2.0 * chamber_slope)
    supply_step = _longest_mode_step(supply_damping, supply_stiffness * (p.q_b / (2.0 * math.pi)) ** 2 / p.J_M)
    return min(spool_step, chamber_step, supply_step)


def longest_step_on_stop(p: RigNumbers) -> float:
    """Compute the longest step [s] that resolves the mass M_eq on spring and damper of an end stop."""
    return _longest_mode_step(p.d_stop / p.M_eq, p.k_stop / p.M_eq)
