"""Integrate a run by either method and write its outputs, under a given command or in a loop with a controller."""

from __future__ import annotations

import numpy as np

from sealscope.compiled import copy_to_stack, kernel
from sealscope.physics.rig import RigNumbers, observe
from sealscope.physics.solvers.imex import IMEX_NODES, implicit_step
from sealscope.physics.solvers.loop import SPACING, Loop, sample_controller
from sealscope.physics.solvers.rk4 import RK4_NODES, explicit_step
from sealscope.physics.state import state_of

#: The method as a compile-time flag: numba specialises on the tuple's length, so the other method is not compiled in.
Implicit = tuple[bool, ...]
EXPLICIT: Implicit = ()
IMPLICIT: Implicit = (True,)


def step_nodes(implicit: Implicit, h: float) -> np.ndarray:
    """Compute the times (nodes,) [s] within a step of `h` [s] at which the integration method needs its inputs.

    The first and the last time lie just inside the step: if an input jumps between two steps, its values there are
    those of this step.
    """
    nodes = np.array(IMEX_NODES if len(implicit) > 0 else RK4_NODES)
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
    numbers: RigNumbers,
    euler_integral: bool,
    every: int,
    rows: np.ndarray,
) -> None:
    """Integrate the state `y` (14,) in place over n steps of h [s], with outputs before each `every`-th step.

    - `implicit`: the integration method, `IMPLICIT` or `EXPLICIT`; `euler_integral`: as in `rk4_step`.
    - `u`, `G`, `C`, `F` (n, nodes): inputs of `rates` at the times within each step that the method needs
      (`step_nodes`). Without an additional load `F` is an empty array of shape (0, 0).
    - `numbers`: parameters of the model. `rows` (n // every, 21): receives the outputs; n is a multiple of `every`.
    """
    z = state_of(y)
    numbers = copy_to_stack(numbers)
    for step in range(u.shape[0]):
        if step % every == 0:
            observe(z, u[step, 0], G[step, 0], C[step, 0], numbers, rows[step // every])
        if len(implicit) > 0:
            z = implicit_step(z, h, u, G, C, F, step, numbers)
        else:
            z = explicit_step(z, h, u, G, C, F, step, numbers, euler_integral)
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
    numbers: RigNumbers,
    euler_integral: bool,
    every: int,
    start: int,
    rows: np.ndarray,
    loop: Loop,
    u: np.ndarray,
) -> int:
    """Integrate a run, or a part of it, whose voltage the controller `loop` sets; return the number of outputs written.

    `start`: number of the output in rows[0], counted from the beginning of the run; `u`: scratch for the voltages of a
    sample of the controller; other arguments: as in `advance`.
    If the controller returns a voltage that is not finite, the integration stops there, with fewer outputs.
    """
    spacing, n_rows = loop.counters[SPACING], rows.shape[0]  # outputs per sample of the controller; all outputs
    first = 0  # first row that is not yet written
    while first < n_rows:
        k = (start + first) // spacing  # the controller's sample
        if (start + first) % spacing == 0 and not sample_controller(loop, k, y):
            break
        u[:] = loop.volts[k]
        last = min((k + 1) * spacing - start, n_rows)  # up to this row `loop.volts[k]` acts
        begin, end = first * every, last * every
        load = F[begin:end] if F.shape[0] > 0 else F
        volts, outputs = u[: end - begin], rows[first:last]
        advance(implicit, y, h, volts, G[begin:end], C[begin:end], load, numbers, euler_integral, every, outputs)
        first = last
    return first
