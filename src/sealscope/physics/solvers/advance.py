"""The steps of a run, by either method, and its outputs: under a command, or in a loop with a controller."""

from __future__ import annotations

import numpy as np

from sealscope.compiled import kernel
from sealscope.physics.rig import RigNumbers, observe
from sealscope.physics.solvers.imex import IMEX_NODES, implicit_step
from sealscope.physics.solvers.loop import APART, Loop, sample_controller
from sealscope.physics.solvers.rk4 import RK4_NODES, explicit_step
from sealscope.physics.state import state_of

#: A method as compiled code takes it: a tuple, so that the code of the other is left out.
Implicit = tuple[bool, ...]
EXPLICIT: Implicit = ()
IMPLICIT: Implicit = (True,)


def nodes_of(implicit: Implicit, h: float) -> np.ndarray:
    """Compute the times [s] within a step of h [s] at which inputs are looked up, the ends just inside it."""
    nodes = np.array(IMEX_NODES if implicit else RK4_NODES)
    nodes[0], nodes[-1] = 1e-9, 1.0 - 1e-9
    return nodes * h


@kernel
def advance(
    implicit: Implicit,
    y: np.ndarray,
    h: float,
    u: np.ndarray,
    G: np.ndarray,
    C: np.ndarray,
    F: np.ndarray,
    p: RigNumbers,
    euler_integral: bool,
    every: int,
    rows: np.ndarray,
) -> None:
    """Advance `y` (14,) in place by n steps of h [s], and write a row of outputs before each `every`-th step.

    `u`, `G`, `C`: (n, nodes) command [V] and leakage coefficients at the nodes of each step (`nodes_of`); `F`: (n,
    nodes) load [N] beside the rig's own, (0, 0) without one; `rows`: (n // every, 21). `euler_integral` takes eq. (4.2)
    literally: I is held within an explicit step and grows by h (omega_d - omega) once after it.
    """
    z = state_of(y)
    for step in range(u.shape[0]):
        if step % every == 0:
            observe(z, u[step, 0], G[step, 0], C[step, 0], p, rows[step // every])
        if len(implicit) > 0:
            z = implicit_step(z, h, u, G, C, F, step, p)
        else:
            z = explicit_step(z, h, u, G, C, F, step, p, euler_integral)
    for m in range(len(z)):
        y[m] = z[m]


@kernel
def advance_closed(
    implicit: Implicit,
    y: np.ndarray,
    h: float,
    G: np.ndarray,
    C: np.ndarray,
    F: np.ndarray,
    p: RigNumbers,
    euler_integral: bool,
    every: int,
    start: int,
    rows: np.ndarray,
    loop: Loop,
) -> int:
    """Advance as `advance` over the outputs `rows` from `start` on, under a controller.

    Return how many outputs there are: fewer than rows where a voltage is not finite.
    """
    spacing, n = loop.whole[APART], rows.shape[0]
    u = np.empty((spacing * every, G.shape[1]))
    first = 0
    while first < n:
        k = (start + first) // spacing
        if (start + first) % spacing == 0 and not sample_controller(loop, k, y):
            break
        u[:] = loop.volts[k]
        last = min((k + 1) * spacing - start, n)
        begin, end = first * every, last * every
        load = F[begin:end] if F.shape[0] > 0 else F
        volts, part = u[: end - begin], rows[first:last]
        advance(implicit, y, h, volts, G[begin:end], C[begin:end], load, p, euler_integral, every, part)
        first = last
    return first
