"""How long a step may be: the fastest oscillations and decays of a rig, from its numbers."""

from __future__ import annotations

import math

import numpy as np

from sealscope.physics.rig import RigNumbers

#: Most that h |lambda| may be for an oscillation that is to be resolved, and for a decay that is to stay stable
#: (RK4's own limit: Hairer & Wanner, Solving Ordinary Differential Equations II, 1996, IV.2).
OSCILLATION_LIMIT = 1.0
DECAY_LIMIT = 2.785


def _end_volumes(p: RigNumbers) -> tuple[tuple[float, float], ...]:
    """Compute the volumes (V_A, V_B) [m^3] at either end of the stroke, where one of them is smallest."""
    if not p.position_dependent:
        return ((p.V_A, p.V_B),)
    half = 0.5 * p.L
    return (p.V_A - p.A_A * half, p.V_B + p.A_B * half), (p.V_A + p.A_A * half, p.V_B - p.A_B * half)


def _longest_for_pair(damping: float, stiffness: float) -> float:
    """Compute the longest step [s] for s^2 + damping s + stiffness = 0: a radian, or stability of a decay."""
    square = damping * damping - 4.0 * stiffness
    if square < 0.0:
        return OSCILLATION_LIMIT / math.sqrt(stiffness)
    decay = 0.5 * (damping + math.sqrt(square))
    return DECAY_LIMIT / decay if decay > 0.0 else math.inf


def _steepest_rise(bends: np.ndarray) -> float:
    """Compute the steepest rise [N/m] or [N s/m] of a load that is linear between bends (`force_over`), 0 if none."""
    return max(0.0, float(np.cumsum(bends[:, 1]).max()))


def stiffest_rate(p: RigNumbers) -> float:
    """Compute the fastest decay rate [1/s] of the throttled rig.

    It is that of a line volume against its chamber through the throttle's laminar slope at dp = 0, lambda = K_oil
    (1/V_1 + 1/V) c / sqrt(dp_0), with the chamber at the end of the stroke where it is smallest. An explicit method is
    stable only for h lambda below its own limit (2.785 for RK4).
    """
    c = max(p.c_A_in, p.c_A_out, p.c_B_in, p.c_B_out)
    smallest = min(volume for volumes in _end_volumes(p) for volume in volumes)
    return float(p.K_oil * (1.0 / min(p.V_1, p.V_2) + 1.0 / smallest) * c / math.sqrt(p.dp_0))


def longest_step(p: RigNumbers, G: float = 0.0, C: float = 0.0) -> float:
    """Compute the longest step [s] of an explicit method for all but the throttles, for leaks up to `G`, `C`.

    The shortest of: speed loop (winding and shaft), piston between its oil columns (running, and within the linear part
    of the friction, F_C/v_th with F_C = F_pr + F_cfr (p_A + p_B) at the charge pressure, with the load's spring and
    damper), pump and motor between the volumes at the pump's ports, leakage between the chambers, leakage outwards and
    make-up. An oscillation needs h |lambda| <= 1, a decay h lambda <= 2.785 (stability of RK4, which the explicit part
    of ARK4(3)6L[2]SA exceeds).
    Position-dependent volumes are taken at the end of the stroke where the oil is stiffer; air only makes it softer.
    """
    ends = _end_volumes(p)
    chambers = p.K_oil * max(1.0 / V_A + 1.0 / V_B for V_A, V_B in ends)
    ports = p.K_oil * (1.0 / p.V_1 + 1.0 / p.V_2) if len(p.throttled) > 0 else chambers
    B_M, G_pump = p.B_M, p.G_pump
    if len(p.lossy) > 0:  # friction at standstill, under the largest torque of the motor; slip at no pressure
        B_M += (p.T_f + p.C_f * p.C_m * p.i_max) / p.omega_f
        G_pump += p.c_slip / math.sqrt(p.dp_0)
    loop = _longest_for_pair(p.R_c / p.L_c + B_M / p.J_M, (p.R_c * B_M + p.C_m * (p.C_e + p.k_p)) / (p.L_c * p.J_M))
    column = (p.K_oil * max(p.A_A**2 / V_A + p.A_B**2 / V_B for V_A, V_B in ends) + p.k_load) / p.M_eq
    F_C = p.F_pr + (0.0 if p.coulomb_of_difference else p.F_cfr * 2.0 * p.p_charge)
    breakaway = F_C * (p.K_brk + (p.F_v * p.v_th if p.literal_bracket else 0.0)) / p.v_th
    breakaway += 0.0 if p.literal_bracket else p.F_v
    damper = p.d_load
    if len(p.pushed) > 1:
        column += _steepest_rise(p.pushed[0]) / p.M_eq
        damper += _steepest_rise(p.pushed[1])
    running = _longest_for_pair((p.F_v + damper) / p.M_eq, column)
    stuck = _longest_for_pair((max(1.0, p.backward) * breakaway + damper) / p.M_eq, column)
    if len(p.bristled) > 0:
        stuck = _longest_for_pair((p.sigma_1 + p.F_v + damper) / p.M_eq, column + p.sigma_0 / p.M_eq)
    ports = 0.0 if len(p.valved) > 0 else ports  # the pump works on the supply: see there
    pump = _longest_for_pair(ports * G_pump, ports * (p.q_b / (2.0 * math.pi)) ** 2 / p.J_M)
    leak = _longest_for_pair(chambers * (G + C / math.sqrt(p.dp_0)), 0.0)
    # Q = G dp (dp - p_crack)/p_open of a pilot-operated valve is steepest where it is fully open
    steepest = 2.0 + p.p_crack / p.p_open if len(p.piloted) > 0 else 1.0
    valves = max(p.G_check * steepest * p.made_up, p.G_relief * (len(p.relieved) > 0))
    outward = _longest_for_pair(chambers * max(p.G_ext_A, p.G_ext_B) + ports * valves, 0.0)
    fastest = min(loop, running, stuck, pump, leak, outward)
    if len(p.valved) > 0:
        fastest = min(fastest, _longest_of_valve(p, ends))
    return float(fastest)


def _longest_of_valve(p: RigNumbers, ends: tuple[tuple[float, float], ...]) -> float:
    """Compute the longest step [s] for a servo valve: its spool, a chamber behind its laminar edges, the supply."""
    overlaps = (p.o_PA, p.o_AT, p.o_PB, p.o_BT)
    steepest = p.Q_N / math.sqrt(p.dp_N * p.dp_lam)  # of an edge at full stroke
    most = steepest * (1.0 + 2.0 * max(0.0, *(-o for o in overlaps)) / p.x_max)  # both edges of a chamber
    chamber = p.K_oil * max(1.0 / volume for volumes in ends for volume in volumes)
    supply = p.K_oil / p.V_1  # the accumulator may be empty
    spool = _longest_for_pair(2.0 * p.zeta_s * p.omega_s, p.omega_s**2)
    edges = _longest_for_pair(most * chamber, 0.0)
    pump = supply * (p.q_b / (2.0 * math.pi)) ** 2 / p.J_M
    slip = p.c_slip / math.sqrt(p.dp_0)
    line = _longest_for_pair(supply * (p.G_pump + slip + p.G_set + 2.0 * most), pump)
    return min(spool, edges, line)


def longest_step_on_stop(p: RigNumbers) -> float:
    """Compute the longest step [s] that resolves the piston against a cap: M_eq on k_stop and d_stop."""
    return _longest_for_pair(p.d_stop / p.M_eq, p.k_stop / p.M_eq)
