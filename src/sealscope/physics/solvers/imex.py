"""An implicit-explicit Runge-Kutta method for the throttled rig: ARK4(3)6L[2]SA of Kennedy and Carpenter.

All stiffness is in the two throttle flows, each of which couples one line volume to one chamber. Only they are treated
implicitly, so that an implicit stage is one scalar equation for each side (`implicit_flows`) in place of a linear
system. The implicit part is L-stable and stiffly accurate; both parts are of order four.

Source: C. A. Kennedy, M. H. Carpenter, Additive Runge-Kutta schemes for convection-diffusion-reaction equations,
Applied Numerical Mathematics 44 (2003) 139-181, ARK4(3)6L[2]SA. `docs/decisions/0004-solvers.md` has the
work-precision table that chose it.
"""

from __future__ import annotations

import numpy as np

from sealscope.compiled import contracted, law
from sealscope.physics import rig
from sealscope.physics.cylinder import pressure_rate
from sealscope.physics.lanes import select
from sealscope.physics.rig import RigNumbers
from sealscope.physics.state import P_1, P_2, P_A, P_B, POSITION, Pressures, State, add_step, add_to_pressures
from sealscope.units import P_ATM

#: Nodes of a step, as fractions of it, at which the inputs are needed.
IMEX_NODES = (0.0, 1 / 2, 83 / 250, 31 / 50, 17 / 20, 1.0)
GAMMA = 1 / 4
Nodes = tuple[float, float, float, float, float, float]
#: With air in the oil, boiling oil or a balance of mass, bulk moduli and densities depend on the stage's pressures. The
#: stage is solved repeatedly until the pressures change by less than this tolerance [Pa], at most this many times (each
#: iteration reduces the error about tenfold).
STAGE_TOLERANCE = 1e-2
MAX_STAGE_ITERATIONS = 12

#: Explicit tableau, row by row below the diagonal.
E_2 = (1 / 2,)
E_3 = (13861 / 62500, 6889 / 62500)
E_4 = (-116923316275 / 2393684061468, -2731218467317 / 15368042101831, 9408046702089 / 11113171139209)
E_5 = (
    -451086348788 / 2902428689909,
    -2682348792572 / 7519795681897,
    12662868775082 / 11960479115383,
    3355817975965 / 11060851509271,
)
E_6 = (
    647845179188 / 3216320057751,
    73281519250 / 8382639484533,
    552539513391 / 3454668386233,
    3354512671639 / 8306763924573,
    4040 / 17871,
)
#: Implicit tableau below the diagonal; the diagonal is GAMMA, except 0 in the explicit first stage.
I_2 = (1 / 4,)
I_3 = (8611 / 62500, -1743 / 31250)
I_4 = (5012029 / 34652500, -654441 / 2922500, 174375 / 388108)
I_5 = (15267082809 / 155376265600, -71443401 / 120774400, 730878875 / 902184768, 2285395 / 8070912)
#: Weights of both parts. Stiffly accurate: they are the last row of the implicit tableau.
W = (82889 / 524892, 0.0, 15625 / 83664, 69875 / 102672, -2260 / 8211, GAMMA)


@contracted
def _add_stage(z: State, h: float, e: float, f: State, i: float, s: Pressures) -> State:
    """Add the contribution h (e f + i s) of one Runge-Kutta stage to the state z; return the sum.

    `f`: explicit rates of all states; `s`: implicit rates of the four pressures; `e`, `i`: their coefficients in the
    method's tableau; `h` [s]: length of the step.
    """
    return add_to_pressures(add_step(z, h * e, f), h * i, s)


@contracted
def _solve_stage(z: State, h: float, p: RigNumbers) -> tuple[State, Pressures]:
    """Solve one implicit stage of a step; return its state, and the pressure rates [Pa/s] due to the throttles.

    `h` [s]: length of the step; `z`: the state without the implicit rates of this stage. On each side `implicit_flows`
    solves d + g Q = total, with g = GAMMA h (r_chamber + r_line) [Pa s/m^3], where r [Pa/m^3] is the pressure rate of
    an oil volume per unit flow. Boiling oil keeps its pressure, so its r is 0. If bulk moduli and densities depend on
    the pressures, the stage is solved repeatedly (`MAX_STAGE_ITERATIONS`), each time with those at the pressures
    `solved` last.
    """
    V_A, V_B = rig.volumes_at(z[POSITION], p)
    step = GAMMA * h
    p_A, p_B, p_1, p_2 = rig.pressures_of(z, p)
    total_A, total_B = p_1 - p_A, p_B - p_2
    solved = z
    s = (z[P_A], z[P_B], z[P_1], z[P_2])  # overwritten; numba needs the type of s before the loop
    max_iterations = MAX_STAGE_ITERATIONS if len(p.aerated) + len(p.conserving) + len(p.boiling) > 0 else 1
    for _ in range(max_iterations):
        K_A, K_B = rig.bulk_modulus(solved[P_A], p), rig.bulk_modulus(solved[P_B], p)
        K_1, K_2 = rig.bulk_modulus(solved[P_1], p), rig.bulk_modulus(solved[P_2], p)
        r_A, r_B = pressure_rate(1.0, V_A, K_A), pressure_rate(1.0, V_B, K_B)
        r_1, r_2 = pressure_rate(1.0, p.V_1, K_1), pressure_rate(1.0, p.V_2, K_2)
        if len(p.boiling) > 0:  # volumes that boil at `solved` are at p_boil, others at their state, even below p_boil
            p_boil = p.p_vap - P_ATM
            boils_A, boils_B = solved[P_A] < p_boil, solved[P_B] < p_boil
            boils_1, boils_2 = solved[P_1] < p_boil, solved[P_2] < p_boil
            total_A = select(boils_1, p_boil, z[P_1]) - select(boils_A, p_boil, z[P_A])
            total_B = select(boils_B, p_boil, z[P_B]) - select(boils_2, p_boil, z[P_2])
            r_A, r_B = select(boils_A, 0.0 * r_A, r_A), select(boils_B, 0.0 * r_B, r_B)
            r_1, r_2 = select(boils_1, 0.0 * r_1, r_1), select(boils_2, 0.0 * r_2, r_2)
        g_A, g_B = step * (r_A + r_1), step * (r_B + r_2)
        Q_A, Q_B = rig.implicit_flows(total_A, total_B, g_A, g_B, z, p)
        s = rig.throttle_rates(solved, Q_A, Q_B, p)
        previous = solved
        solved = add_to_pressures(z, step, s)
        if max_iterations > 1:
            change_A = max(abs(solved[P_A] - previous[P_A]), abs(solved[P_1] - previous[P_1]))
            change_B = max(abs(solved[P_B] - previous[P_B]), abs(solved[P_2] - previous[P_2]))
            if max(change_A, change_B) < STAGE_TOLERANCE:
                break
    return solved, s


@contracted
def imex_step(y: State, h: float, u: Nodes, G: Nodes, C: Nodes, F: Nodes, p: RigNumbers) -> State:
    """Integrate the state `y` over one step of h [s] by the implicit-explicit method; return the new state.

    The tuples hold the inputs of `rates` at the six `IMEX_NODES` of the step. Stage 1 is explicit: its state is `y`, at
    which both rates are evaluated. Stage k >= 2 solves for its state z and its implicit rates s_k, then evaluates its
    explicit rates f_k. E_k and I_k are the rows of the tableaus, W the weights.
    """
    Q_A, Q_B = rig.throttle_flows(y, p)
    s1 = rig.throttle_rates(y, Q_A, Q_B, p)
    f1 = rig.rates_without_throttles(y, u[0], G[0], C[0], F[0], p)
    z, s2 = _solve_stage(_add_stage(y, h, E_2[0], f1, I_2[0], s1), h, p)
    f2 = rig.rates_without_throttles(z, u[1], G[1], C[1], F[1], p)
    z = _add_stage(_add_stage(y, h, E_3[0], f1, I_3[0], s1), h, E_3[1], f2, I_3[1], s2)
    z, s3 = _solve_stage(z, h, p)
    f3 = rig.rates_without_throttles(z, u[2], G[2], C[2], F[2], p)
    z = _add_stage(_add_stage(y, h, E_4[0], f1, I_4[0], s1), h, E_4[1], f2, I_4[1], s2)
    z, s4 = _solve_stage(_add_stage(z, h, E_4[2], f3, I_4[2], s3), h, p)
    f4 = rig.rates_without_throttles(z, u[3], G[3], C[3], F[3], p)
    z = _add_stage(_add_stage(y, h, E_5[0], f1, I_5[0], s1), h, E_5[1], f2, I_5[1], s2)
    z = _add_stage(_add_stage(z, h, E_5[2], f3, I_5[2], s3), h, E_5[3], f4, I_5[3], s4)
    z, s5 = _solve_stage(z, h, p)
    f5 = rig.rates_without_throttles(z, u[4], G[4], C[4], F[4], p)
    # W is the implicit row of stage 6, and also has the weights of the step; W[1] = 0, so that s2 does not enter
    z = _add_stage(_add_stage(y, h, E_6[0], f1, W[0], s1), h, E_6[2], f3, W[2], s3)
    z = _add_stage(_add_stage(add_step(z, h * E_6[1], f2), h, E_6[3], f4, W[3], s4), h, E_6[4], f5, W[4], s5)
    z, s6 = _solve_stage(z, h, p)
    f6 = rig.rates_without_throttles(z, u[5], G[5], C[5], F[5], p)
    z = _add_stage(_add_stage(y, h, W[0], f1, W[0], s1), h, W[2], f3, W[2], s3)
    z = _add_stage(_add_stage(_add_stage(z, h, W[3], f4, W[3], s4), h, W[4], f5, W[4], s5), h, W[5], f6, W[5], s6)
    return rig.limit_state(z, p)


@law
def implicit_step(
    z: State, h: float, u: np.ndarray, G: np.ndarray, C: np.ndarray, F: np.ndarray, step: int, p: RigNumbers
) -> State:
    """Integrate the state `z` over step number `step` by `imex_step`, with its inputs from row `step` of the arrays.

    `F` is read only if the rig has an additional load.
    """
    volts = (u[step, 0], u[step, 1], u[step, 2], u[step, 3], u[step, 4], u[step, 5])
    laminar = (G[step, 0], G[step, 1], G[step, 2], G[step, 3], G[step, 4], G[step, 5])
    orifice = (C[step, 0], C[step, 1], C[step, 2], C[step, 3], C[step, 4], C[step, 5])
    load = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if len(p.pushed) > 0:
        load = (F[step, 0], F[step, 1], F[step, 2], F[step, 3], F[step, 4], F[step, 5])
    return imex_step(z, h, volts, laminar, orifice, load, p)
