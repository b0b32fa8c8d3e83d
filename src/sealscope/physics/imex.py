"""An implicit-explicit Runge-Kutta method for the throttled rig: ARK4(3)6L[2]SA of Kennedy and Carpenter.

All stiffness sits in the two throttle flows, each of which couples one line volume to one chamber. They are taken
implicitly, everything else explicitly, so that an implicit stage is no linear system but one scalar equation a side
(`implicit_orifice_drop`). The implicit part is L-stable and stiffly accurate; both parts are of order four.

Source: C. A. Kennedy, M. H. Carpenter, Additive Runge-Kutta schemes for convection-diffusion-reaction equations,
Applied Numerical Mathematics 44 (2003) 139-181, ARK4(3)6L[2]SA. `docs/decisions/0004-solvers.md` has the
work-precision table that chose it.
"""

from __future__ import annotations

import numpy as np

from sealscope.compiled import kernel
from sealscope.physics.cylinder import chamber_volumes, pressure_rate
from sealscope.physics.restrictors import implicit_orifice_drop
from sealscope.physics.rig import (
    CURRENT,
    P_1,
    P_2,
    P_A,
    P_B,
    POSITION,
    RigNumbers,
    bulk_modulus,
    observe,
    rates_without_throttles,
    throttle_flow_A,
    throttle_flow_B,
)

#: Nodes of the step at which the inputs are needed.
IMEX_NODES = (0.0, 1 / 2, 83 / 250, 31 / 50, 17 / 20, 1.0)
GAMMA = 1 / 4
#: With air in the oil an implicit stage is solved anew with the bulk moduli of the pressures that it found, until these
#: move by less than this [Pa], or this many times (each brings them nearer by about a factor of ten).
AIR_SETTLED = 1e-2
AIR_TURNS = 12

EXPLICIT = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0],
        [1 / 2, 0.0, 0.0, 0.0, 0.0],
        [13861 / 62500, 6889 / 62500, 0.0, 0.0, 0.0],
        [
            -116923316275 / 2393684061468,
            -2731218467317 / 15368042101831,
            9408046702089 / 11113171139209,
            0.0,
            0.0,
        ],
        [
            -451086348788 / 2902428689909,
            -2682348792572 / 7519795681897,
            12662868775082 / 11960479115383,
            3355817975965 / 11060851509271,
            0.0,
        ],
        [
            647845179188 / 3216320057751,
            73281519250 / 8382639484533,
            552539513391 / 3454668386233,
            3354512671639 / 8306763924573,
            4040 / 17871,
        ],
    ]
)
#: Implicit tableau below the diagonal, which is GAMMA but for the explicit first stage.
IMPLICIT = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0],
        [1 / 4, 0.0, 0.0, 0.0, 0.0],
        [8611 / 62500, -1743 / 31250, 0.0, 0.0, 0.0],
        [5012029 / 34652500, -654441 / 2922500, 174375 / 388108, 0.0, 0.0],
        [15267082809 / 155376265600, -71443401 / 120774400, 730878875 / 902184768, 2285395 / 8070912, 0.0],
        [82889 / 524892, 0.0, 15625 / 83664, 69875 / 102672, -2260 / 8211],
    ]
)
#: Weights of both parts: the last implicit stage (stiffly accurate).
WEIGHTS = np.array([82889 / 524892, 0.0, 15625 / 83664, 69875 / 102672, -2260 / 8211, 1 / 4])


@kernel
def advance_imex(
    y: np.ndarray,
    h: float,
    u: np.ndarray,
    G: np.ndarray,
    C: np.ndarray,
    p: RigNumbers,
    every: int,
    rows: np.ndarray,
) -> None:
    """Advance `y` (11,) in place by n steps of h [s]; every `every` steps, before the step, write a row of outputs.

    `u`, `G`, `C`: (n, 6) command [V] and leakage coefficients at the nodes of each step; `rows`: (n // every, 17).
    """
    n, stages = u.shape
    size = y.size
    f = np.zeros((stages, size))  # explicit rates
    s = np.zeros((stages, 4))  # implicit rates of p_A, p_B, p_1, p_2
    z = np.empty(size)
    known = np.empty(4)  # a stage's pressures without its own implicit rates
    turns = 1 if len(p.aerated) == 0 else AIR_TURNS
    for step in range(n):
        if step % every == 0:
            observe(y, u[step, 0], G[step, 0], C[step, 0], p, rows[step // every])
        for k in range(stages):
            for m in range(size):
                z[m] = y[m]
            for j in range(k):
                a = h * EXPLICIT[k, j]
                for m in range(size):
                    z[m] += a * f[j, m]
                b = h * IMPLICIT[k, j]
                for m in range(4):
                    z[P_A + m] += b * s[j, m]
            V_A, V_B = chamber_volumes(z[POSITION], p.V, p.A_A, p.A_B, p.position_dependent)
            for m in range(4):
                known[m] = z[P_A + m]
            for _ in range(1 if k == 0 else turns):
                K_A, K_B = bulk_modulus(z[P_A], p), bulk_modulus(z[P_B], p)
                K_1, K_2 = bulk_modulus(z[P_1], p), bulk_modulus(z[P_2], p)
                if k == 0:
                    Q_A = throttle_flow_A(z, p)
                    Q_B = throttle_flow_B(z, p)
                else:
                    g_A = GAMMA * h * (pressure_rate(1.0, V_A, K_A) + pressure_rate(1.0, p.V_1, K_1))
                    g_B = GAMMA * h * (pressure_rate(1.0, V_B, K_B) + pressure_rate(1.0, p.V_2, K_2))
                    total_A = known[2] - known[0]
                    total_B = known[1] - known[3]
                    Q_A = (total_A - implicit_orifice_drop(total_A, g_A, p.c_A_in, p.c_A_out, p.dp_0)) / g_A
                    Q_B = (total_B - implicit_orifice_drop(total_B, g_B, p.c_B_out, p.c_B_in, p.dp_0)) / g_B
                s[k, 0] = pressure_rate(Q_A, V_A, K_A)
                s[k, 1] = pressure_rate(-Q_B, V_B, K_B)
                s[k, 2] = pressure_rate(-Q_A, p.V_1, K_1)
                s[k, 3] = pressure_rate(Q_B, p.V_2, K_2)
                moved = 0.0
                if k > 0:
                    for m in range(4):
                        found = known[m] + GAMMA * h * s[k, m]
                        moved = max(moved, abs(found - z[P_A + m]))
                        z[P_A + m] = found
                if moved < AIR_SETTLED:
                    break
            rates_without_throttles(z, u[step, k], G[step, k], C[step, k], p, f[k])
        for k in range(stages):
            b = h * WEIGHTS[k]
            for m in range(size):
                y[m] += b * f[k, m]
            for m in range(4):
                y[P_A + m] += b * s[k, m]
        y[CURRENT] = min(max(y[CURRENT], -p.i_max), p.i_max)
