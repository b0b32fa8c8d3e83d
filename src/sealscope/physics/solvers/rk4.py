"""The classical Runge-Kutta method of order four, which the thesis uses with h = 1e-4 s.

It suits rigs without throttles; with throttles, which are stiff, it is unstable at any usable step.
"""

from __future__ import annotations

import numpy as np

from sealscope.compiled import contracted, law
from sealscope.physics.rig import RigNumbers, limit_state, rates
from sealscope.physics.state import State, add_step

#: Nodes of a step, as fractions of it, at which the inputs are needed.
RK4_NODES = (0.0, 0.5, 1.0)
Nodes = tuple[float, float, float]


@contracted
def freeze_integral(dy: State, euler_integral: bool) -> State:
    """Set the rate of the controller's integral to 0 if `euler_integral` (`rk4_step`); return all rates of `dy`."""
    dI = 0.0 * dy[0] if euler_integral else dy[0]  # 0.0 * dy[0]: a number or a vector, as dy[0]
    return dI, dy[1], dy[2], dy[3], dy[4], dy[5], dy[6], dy[7], dy[8], dy[9], dy[10], dy[11], dy[12], dy[13]


@contracted
def rk4_step(y: State, h: float, u: Nodes, G: Nodes, C: Nodes, F: Nodes, p: RigNumbers, euler_integral: bool) -> State:
    """Integrate the state `y` over one step of h [s] by the Runge-Kutta method of order four; return the new state.

    The tuples hold the inputs of `rates` at the `RK4_NODES`. With `euler_integral` the integral of the speed controller
    is constant within the step and then grows by h (omega_d - omega), as eq. (4.2) of the thesis is printed: omega_d is
    the speed that the command sets, omega that of the motor, both [rad/s] at the beginning of the step. Otherwise the
    integral is a state like the others.
    """
    first = rates(y, u[0], G[0], C[0], F[0], p)
    k1 = freeze_integral(first, euler_integral)
    k2 = freeze_integral(rates(add_step(y, 0.5 * h, k1), u[1], G[1], C[1], F[1], p), euler_integral)
    k3 = freeze_integral(rates(add_step(y, 0.5 * h, k2), u[1], G[1], C[1], F[1], p), euler_integral)
    k4 = freeze_integral(rates(add_step(y, h, k3), u[2], G[2], C[2], F[2], p), euler_integral)
    total = add_step(add_step(add_step(k1, 2.0, k2), 2.0, k3), 1.0, k4)
    z = limit_state(add_step(y, h / 6.0, total), p)
    integral = y[0] + h * first[0] if euler_integral else z[0]  # eq. (4.2)
    return integral, z[1], z[2], z[3], z[4], z[5], z[6], z[7], z[8], z[9], z[10], z[11], z[12], z[13]


@law
def explicit_step(
    z: State,
    h: float,
    u: np.ndarray,
    G: np.ndarray,
    C: np.ndarray,
    F: np.ndarray,
    step: int,
    p: RigNumbers,
    euler_integral: bool,
) -> State:
    """Integrate the state `z` over step number `step` by `rk4_step`, with its inputs from row `step` of the arrays.

    `F` is read only if the rig has an additional load.
    """
    volts = (u[step, 0], u[step, 1], u[step, 2])
    laminar, orifice = (G[step, 0], G[step, 1], G[step, 2]), (C[step, 0], C[step, 1], C[step, 2])
    load = (F[step, 0], F[step, 1], F[step, 2]) if len(p.pushed) > 0 else (0.0, 0.0, 0.0)
    return rk4_step(z, h, volts, laminar, orifice, load, p, euler_integral)
