"""The classical Runge-Kutta method, the thesis's own (h = 1e-4 s there): exact enough without throttles, unstable
with them."""

from __future__ import annotations

import numpy as np

from sealscope.compiled import kernel
from sealscope.physics.rig import CURRENT, INTEGRAL, OMEGA, RigNumbers, observe, rates

#: Nodes of the step at which the inputs are needed.
RK4_NODES = (0.0, 0.5, 1.0)


@kernel
def advance_rk4(
    y: np.ndarray,
    h: float,
    u: np.ndarray,
    G: np.ndarray,
    C: np.ndarray,
    p: RigNumbers,
    euler_integral: bool,
    every: int,
    rows: np.ndarray,
) -> None:
    """Advance `y` (11,) in place by n steps of h [s]; every `every` steps, before the step, write a row of outputs.

    `u`, `G`, `C`: (n, 3) command [V] and leakage coefficients at t, t + h/2 and t + h of each step; `rows`: (n //
    every, 17). `euler_integral` takes eq. (4.2) literally: I is held within the step and grows by h (omega_d - omega)
    once after it.
    """
    n = u.shape[0]
    size = y.size
    k1, k2, k3, k4, z = np.empty(size), np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    for step in range(n):
        if step % every == 0:
            observe(y, u[step, 0], G[step, 0], C[step, 0], p, rows[step // every])
        error = p.omega_per_volt * u[step, 0] - y[OMEGA]
        rates(y, u[step, 0], G[step, 0], C[step, 0], p, k1)
        if euler_integral:
            k1[INTEGRAL] = 0.0
        for m in range(size):
            z[m] = y[m] + 0.5 * h * k1[m]
        rates(z, u[step, 1], G[step, 1], C[step, 1], p, k2)
        if euler_integral:
            k2[INTEGRAL] = 0.0
        for m in range(size):
            z[m] = y[m] + 0.5 * h * k2[m]
        rates(z, u[step, 1], G[step, 1], C[step, 1], p, k3)
        if euler_integral:
            k3[INTEGRAL] = 0.0
        for m in range(size):
            z[m] = y[m] + h * k3[m]
        rates(z, u[step, 2], G[step, 2], C[step, 2], p, k4)
        if euler_integral:
            k4[INTEGRAL] = 0.0
        for m in range(size):
            y[m] += h / 6.0 * (k1[m] + 2.0 * k2[m] + 2.0 * k3[m] + k4[m])
        if euler_integral:
            y[INTEGRAL] += h * error  # eq. (4.2)
        y[CURRENT] = min(max(y[CURRENT], -p.i_max), p.i_max)
