"""Where the laws meet: the right-hand side of the whole rig, eqs. (4.1)-(4.22).

State y, in the order of `STATES`: controller integral I [rad], winding current i [A], motor speed omega [rad/s] and
angle theta [rad], piston position x [m] and velocity v [m/s], pressures p_A, p_B, p_1, p_2 [Pa]. Without throttles
the pump is connected to the chambers directly: there are no line volumes, p_1 = p_A and p_2 = p_B. With throttles the
stiffness of the equations is in their two flows alone (microseconds, against milliseconds for all else), so the
right-hand side comes in two parts: everything but the throttles, and the throttles.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sealscope.compiled import law
from sealscope.parameters import Rig
from sealscope.physics.cylinder import chamber_volumes, hard_stop_force, piston_acceleration, pressure_rate
from sealscope.physics.friction import coulomb_friction, stribeck_friction
from sealscope.physics.leakage import piston_leakage
from sealscope.physics.motor import controller_voltage, shaft_acceleration, winding_current_rate
from sealscope.physics.pump import pump_flow, pump_torque
from sealscope.physics.restrictors import one_way_coefficient, orifice_coefficient, orifice_flow

STATES = ("I", "i", "omega", "theta", "x", "v", "p_A", "p_B", "p_1", "p_2")
INTEGRAL, CURRENT, OMEGA, THETA, POSITION, VELOCITY, P_A, P_B, P_1, P_2 = range(len(STATES))

#: What a run reports at each output instant: the states and the quantities that follow from them.
OUTPUTS = (*STATES, "Q_1", "Q_A", "Q_B", "q_leak", "V")

#: Most that h |lambda| may be for an oscillation that is to be resolved, and for a decay that is to stay stable
#: (RK4's own limit: Hairer & Wanner, Solving Ordinary Differential Equations II, 1996, IV.2).
OSCILLATION_LIMIT = 1.0
DECAY_LIMIT = 2.785


class RigNumbers(NamedTuple):
    """A rig's parameters as the compiled laws take them: SI floats, choices as truth values."""

    omega_per_volt: float
    k_p: float
    K_i: float
    V_max: float
    i_max: float
    R_c: float
    L_c: float
    C_e: float
    C_m: float
    J_M: float
    B_M: float
    q_b: float
    G_pump: float
    throttled: bool
    c_A_in: float  # throttle A, from the pump to the cylinder
    c_A_out: float
    c_B_in: float
    c_B_out: float
    dp_0: float
    V_1: float
    V_2: float
    A_A: float
    A_B: float
    L: float
    M_eq: float
    V: float
    position_dependent: bool
    k_stop: float
    d_stop: float
    F_l: float
    F_pr: float
    F_cfr: float
    C_c: float
    K_brk: float
    F_v: float
    v_th: float
    coulomb_of_difference: bool
    literal_bracket: bool
    K_oil: float


def throttle_coefficients(rig: Rig) -> tuple[float, float, float, float]:
    """Flow coefficients (c_A_in, c_A_out, c_B_in, c_B_out) [m^3/(s Pa^0.5)] of the one-way throttles, eqs.
    (4.7)-(4.12).

    "Closed" is a share of the area (eq. 4.8) or of the diameter (the text). Metering "meter-out": free flow towards
    the cylinder and throttled return on both sides (the text and Appendix A); "literal": as eqs. (4.9)-(4.12) are
    printed, side B the other way round.
    """
    line = rig.line
    area = math.pi / 4.0 * line.d_line**2  # eq. (4.7)
    exponent = 2.0 if line.closed_means == "diameter" else 1.0
    free = orifice_coefficient(line.C_d, area, rig.fluid.rho)
    throttled_A = free * (1.0 - line.closed_A) ** exponent  # eq. (4.8)
    throttled_B = free * (1.0 - line.closed_B) ** exponent
    if line.metering == "literal":
        return free, throttled_A, throttled_B, free
    return free, throttled_A, free, throttled_B


def rig_numbers(rig: Rig) -> RigNumbers:
    """The rig's parameters for the compiled laws."""
    motor, pump, line, cylinder, friction, fluid = rig.motor, rig.pump, rig.line, rig.cylinder, rig.friction, rig.fluid
    c_A_in, c_A_out, c_B_in, c_B_out = throttle_coefficients(rig)
    return RigNumbers(
        omega_per_volt=motor.omega_per_volt,
        k_p=motor.k_p,
        K_i=motor.K_i,
        V_max=motor.V_max,
        i_max=motor.i_max,
        R_c=motor.R_c,
        L_c=motor.L_c,
        C_e=motor.C_e,
        C_m=motor.C_m,
        J_M=motor.J_M,
        B_M=motor.B_M,
        q_b=pump.q_b,
        G_pump=pump.G_pump,
        throttled=line.orifices == "present",
        c_A_in=c_A_in,
        c_A_out=c_A_out,
        c_B_in=c_B_in,
        c_B_out=c_B_out,
        dp_0=line.dp_0,
        V_1=line.V_1,
        V_2=line.V_2,
        A_A=cylinder.A_A,
        A_B=cylinder.A_B,
        L=cylinder.L,
        M_eq=cylinder.M_eq,
        V=cylinder.V,
        position_dependent=cylinder.volumes == "position",
        k_stop=cylinder.k_stop,
        d_stop=cylinder.d_stop,
        F_l=cylinder.F_l,
        F_pr=friction.F_pr,
        F_cfr=friction.F_cfr,
        C_c=friction.C_c,
        K_brk=friction.K_brk,
        F_v=friction.F_v,
        v_th=friction.v_th,
        coulomb_of_difference=friction.coulomb_pressure == "difference",
        literal_bracket=friction.bracket == "literal",
        K_oil=fluid.K_oil,
    )


def initial_state(rig: Rig, x_0: float) -> np.ndarray:
    """State at rest: every pressure at the charge pressure, the piston at x_0 [m] from mid-stroke, all else zero."""
    y = np.zeros(len(STATES))
    y[POSITION] = x_0
    y[[P_A, P_B, P_1, P_2]] = rig.fluid.p_charge
    return y


@law
def speed_error(y: np.ndarray, u: float, p: RigNumbers) -> float:
    """Commanded less actual motor speed [rad/s]."""
    return p.omega_per_volt * u - float(y[OMEGA])


@law
def friction_force(y: np.ndarray, p: RigNumbers) -> float:
    """Friction [N] on the piston, eqs. (4.20)-(4.22)."""
    F_C = coulomb_friction(y[P_A], y[P_B], p.F_pr, p.F_cfr, p.coulomb_of_difference)
    return stribeck_friction(y[VELOCITY], F_C, p.K_brk, p.C_c, p.F_v, p.v_th, p.literal_bracket)


@law
def throttle_flow_A(y: np.ndarray, p: RigNumbers) -> float:
    """Q_A [m^3/s] from line 1 into chamber A, eqs. (4.9)-(4.10)."""
    dp = y[P_1] - y[P_A]
    return orifice_flow(dp, one_way_coefficient(dp, p.c_A_in, p.c_A_out), p.dp_0)


@law
def throttle_flow_B(y: np.ndarray, p: RigNumbers) -> float:
    """Q_B [m^3/s] from chamber B into line 2, eqs. (4.11)-(4.12)."""
    dp = y[P_B] - y[P_2]
    return orifice_flow(dp, one_way_coefficient(dp, p.c_B_out, p.c_B_in), p.dp_0)


@law
def rates_without_throttles(y: np.ndarray, u: float, G: float, C: float, p: RigNumbers, dy: np.ndarray) -> None:
    """dy/dt of everything but the throttles' flows; `u` [V] command, `G`, `C` leakage coefficients; written into
    `dy`."""
    p_A, p_B = y[P_A], y[P_B]
    dp_pump = (y[P_1] - y[P_2]) if p.throttled else (p_A - p_B)
    error = speed_error(y, u, p)
    voltage = controller_voltage(error, y[INTEGRAL], p.k_p, p.K_i, p.V_max)
    dy[INTEGRAL] = error  # eq. (4.2) as a state
    dy[CURRENT] = winding_current_rate(voltage, y[CURRENT], y[OMEGA], p.R_c, p.L_c, p.C_e, p.i_max)
    dy[OMEGA] = shaft_acceleration(y[CURRENT], y[OMEGA], pump_torque(dp_pump, p.q_b), p.C_m, p.B_M, p.J_M)
    dy[THETA] = y[OMEGA]
    x, v = y[POSITION], y[VELOCITY]
    stop = hard_stop_force(x, v, p.L, p.k_stop, p.d_stop)
    dy[POSITION] = v  # eq. (4.13)
    dy[VELOCITY] = piston_acceleration(p_A, p_B, friction_force(y, p), p.F_l, stop, p.A_A, p.A_B, p.M_eq)
    Q_1 = pump_flow(y[OMEGA], dp_pump, p.q_b, p.G_pump)
    Q_L = piston_leakage(p_A - p_B, G, C, p.dp_0)
    V_A, V_B = chamber_volumes(x, p.V, p.A_A, p.A_B, p.position_dependent)
    if p.throttled:
        dy[P_A] = pressure_rate(-p.A_A * v - Q_L, V_A, p.K_oil)
        dy[P_B] = pressure_rate(p.A_B * v + Q_L, V_B, p.K_oil)
        dy[P_1] = pressure_rate(Q_1, p.V_1, p.K_oil)
        dy[P_2] = pressure_rate(-Q_1, p.V_2, p.K_oil)
    else:
        dy[P_A] = pressure_rate(Q_1 - p.A_A * v - Q_L, V_A, p.K_oil)
        dy[P_B] = pressure_rate(-Q_1 + p.A_B * v + Q_L, V_B, p.K_oil)
        dy[P_1] = dy[P_A]
        dy[P_2] = dy[P_B]


@law
def rates(y: np.ndarray, u: float, G: float, C: float, p: RigNumbers, dy: np.ndarray) -> None:
    """dy/dt of the whole rig, written into `dy`."""
    rates_without_throttles(y, u, G, C, p, dy)
    if p.throttled:
        Q_A = throttle_flow_A(y, p)
        Q_B = throttle_flow_B(y, p)
        V_A, V_B = chamber_volumes(y[POSITION], p.V, p.A_A, p.A_B, p.position_dependent)
        dy[P_A] += pressure_rate(Q_A, V_A, p.K_oil)  # eq. (4.18)
        dy[P_B] += pressure_rate(-Q_B, V_B, p.K_oil)  # eq. (4.19)
        dy[P_1] += pressure_rate(-Q_A, p.V_1, p.K_oil)  # eq. (4.16)
        dy[P_2] += pressure_rate(Q_B, p.V_2, p.K_oil)  # eq. (4.17)


@law
def observe(y: np.ndarray, u: float, G: float, C: float, p: RigNumbers, row: np.ndarray) -> None:
    """Write the states and the derived quantities of `OUTPUTS` into `row`."""
    row[: y.size] = y
    dp_pump = (y[P_1] - y[P_2]) if p.throttled else (y[P_A] - y[P_B])
    Q_1 = pump_flow(y[OMEGA], dp_pump, p.q_b, p.G_pump)
    row[y.size] = Q_1
    row[y.size + 1] = throttle_flow_A(y, p) if p.throttled else Q_1
    row[y.size + 2] = throttle_flow_B(y, p) if p.throttled else Q_1
    row[y.size + 3] = piston_leakage(y[P_A] - y[P_B], G, C, p.dp_0)
    row[y.size + 4] = controller_voltage(speed_error(y, u, p), y[INTEGRAL], p.k_p, p.K_i, p.V_max)


def stiffest_rate(p: RigNumbers) -> float:
    """Fastest decay rate [1/s] of the throttled rig: a line volume against its chamber through the laminar slope at
    dp = 0.

    lambda = K_oil (1/V_1 + 1/V) c / sqrt(dp_0); an explicit method is stable only for h lambda below its own limit
    (2.785 for RK4).
    """
    c = max(p.c_A_in, p.c_A_out, p.c_B_in, p.c_B_out)
    return p.K_oil * (1.0 / min(p.V_1, p.V_2) + 1.0 / p.V) * c / math.sqrt(p.dp_0)


def _longest_for_pair(damping: float, stiffness: float) -> float:
    """Longest step [s] for s^2 + damping s + stiffness = 0: a radian of an oscillation, stability of a decay."""
    square = damping * damping - 4.0 * stiffness
    if square < 0.0:
        return OSCILLATION_LIMIT / math.sqrt(stiffness)
    decay = 0.5 * (damping + math.sqrt(square))
    return DECAY_LIMIT / decay if decay > 0.0 else math.inf


def longest_step(p: RigNumbers, G: float = 0.0, C: float = 0.0) -> float:
    """Longest step [s] at which an explicit method resolves all but the throttles, for leaks up to `G` and `C`.

    The shortest of: speed loop (winding and shaft), piston between its oil columns (running, and within the linear part
    of the friction), pump and motor between the volumes at the pump's ports, leakage between the chambers. An
    oscillation needs h |lambda| <= 1, a decay h lambda <= 2.785 (stability of RK4, which the explicit part of
    ARK4(3)6L[2]SA exceeds). Position-dependent volumes are taken at the end of the stroke, where the oil is stiffest.
    """
    V_A, V_B = p.V, p.V
    if p.position_dependent:
        V_A, V_B = p.V - 0.5 * p.A_A * p.L, p.V + 0.5 * p.A_B * p.L
    chambers = p.K_oil * (1.0 / V_A + 1.0 / V_B)
    ports = p.K_oil * (1.0 / p.V_1 + 1.0 / p.V_2) if p.throttled else chambers
    loop = _longest_for_pair(p.R_c / p.L_c + p.B_M / p.J_M, (p.R_c * p.B_M + p.C_m * (p.C_e + p.k_p)) / (p.L_c * p.J_M))
    column = p.K_oil * (p.A_A**2 / V_A + p.A_B**2 / V_B) / p.M_eq
    standing = p.F_pr * (p.K_brk + (p.F_v * p.v_th if p.literal_bracket else 0.0)) / p.v_th
    standing += 0.0 if p.literal_bracket else p.F_v
    running = _longest_for_pair(p.F_v / p.M_eq, column)
    stuck = _longest_for_pair(standing / p.M_eq, column)
    pump = _longest_for_pair(ports * p.G_pump, ports * (p.q_b / (2.0 * math.pi)) ** 2 / p.J_M)
    leak = _longest_for_pair(chambers * (G + C / math.sqrt(p.dp_0)), 0.0)
    return min(loop, running, stuck, pump, leak)


def longest_step_on_stop(p: RigNumbers) -> float:
    """Longest step [s] that resolves the piston against a cap: M_eq on k_stop and d_stop."""
    return _longest_for_pair(p.d_stop / p.M_eq, p.k_stop / p.M_eq)
