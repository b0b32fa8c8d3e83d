"""Integration of many runs at once: the same laws and methods on lanes, eight runs to a vector register.

The last axis of an array is the lane, that is the place of a run in the register. A group is WIDTH runs with the same
choices of `RigNumbers` and the same waveform of the command; numbers, leak, and the command's gain and offset may
differ between lanes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sealscope.compiled import contracted, kernel
from sealscope.physics.lanes import load, store
from sealscope.physics.leakage import piston_leakage
from sealscope.physics.rig import CHOICES, NUMBERS, RigNumbers, pressures_of, vapour_floor
from sealscope.physics.solvers.advance import EXPLICIT, IMPLICIT, Implicit
from sealscope.physics.solvers.imex import imex_step
from sealscope.physics.solvers.rk4 import rk4_step
from sealscope.physics.state import P_A, P_B, POSITION, STATES, State

#: Rows that describe the leak of each lane: coefficients G [m^3/(s Pa)] and C [m^3/(s Pa^0.5)] of the leak that acts,
#: start [s] and slope [1/s] of its opening, and G and C of the leak whose flow is summed in the totals. That is the
#: same leak, except while coefficients are searched for.
LEAK_ROWS = 6
#: Channels that a run writes at each output: p_A, p_B [Pa].
CHANNELS = 2
#: Rows of a lane's totals over the outputs: sum of |Q_L| [m^3/s], sum of the leak's opening, largest |x| [m], lowest
#: pressure [Pa], and a flag that is 0 while all states are finite, NaN afterwards.
N_TOTALS = 5
Leak = tuple[float, float, float, float, float, float]
Totals = tuple[float, float, float, float, float]
FLOW, OPENING, MAX_TRAVEL, MIN_PRESSURE, DIVERGED = range(N_TOTALS)


def _compile(text: str, **scope: Any) -> Any:
    """Compile the function `law` from its source `text`, which may use `load` and the names in `scope`.

    The source is generated as text, because numba needs each element of a tuple written out.
    """
    scope["load"] = load
    exec(text, scope)
    return contracted(scope["law"])


def _row_loader(count: int) -> Any:
    """Compile a function (array, row) that loads `count` successive rows from `row` on as a tuple of lanes."""
    elements = ", ".join(f"load(array, row + {k})" for k in range(count))
    return _compile(f"def law(array, row):\n    return ({elements})")


load_state, load_leak, load_totals = _row_loader(len(STATES)), _row_loader(LEAK_ROWS), _row_loader(N_TOTALS)
_FIELDS = [f"{name}=load(table, row + {k})" for k, name in enumerate(NUMBERS)] + [f"{c}=p.{c}" for c in CHOICES]
#: The function (table, row, p) that loads a group's numbers from row `row` on, with the choices of `p`.
load_numbers = _compile(f"def law(table, row, p):\n    return RigNumbers({', '.join(_FIELDS)})", RigNumbers=RigNumbers)


@contracted
def leak_opening(leak: Leak, t: float) -> float:
    """Compute the opening of a `leak` (`LEAK_ROWS`) at t [s]: 0 to 1, rising linearly from the leak's start on."""
    return min(max((t - leak[2]) * leak[3], 0.0), 1.0)  # [2]: start [s]; [3]: slope [1/s]


def _build_inputs_law(count: int) -> Any:
    """Compile the function (t, nodes, shape, k, drive, leak, p) that computes the inputs of a group of runs in step k.

    It returns the inputs u [V], G [m^3/(s Pa)], C [m^3/(s Pa^0.5)] and F [N] of `rates`, each at the `count` times
    within a step (nodes) that the integration method needs. Its arguments are the start `t` [s] of the step, the gain
    and offset `drive` [V] of each run's command, each run's `leak` (`LEAK_ROWS`), and `nodes` and `shape` as in
    `advance`. The row `k` of `shape` is called `step` there, and the numbers `p` of the cell `q`. In the generated
    source, s is the opening of the leak at each node. Only with a load `p.pushed` is not empty and `shape` has columns
    for it. The length of a tuple is part of its type, so that this is decided when the function is compiled.
    """

    def for_nodes(text: str) -> str:
        """Repeat `text` for every node: {n} becomes its number, {load_column} the column of its load in `shape`."""
        return ", ".join(text.format(n=n, load_column=count + n) for n in range(count))

    return _compile(
        f"""def law(t, nodes, shape, k, drive, leak, p):
    s = ({for_nodes("leak_opening(leak, t + nodes[{n}])")})
    u = ({for_nodes("drive[1] + drive[0] * shape[k, {n}]")})
    G, C = ({for_nodes("leak[0] * s[{n}]")}), ({for_nodes("leak[1] * s[{n}]")})
    F = ({for_nodes("0.0")})
    if len(p.pushed) > 0:
        F = ({for_nodes("shape[k, {load_column}]")})
    return u, G, C, F
""",
        leak_opening=leak_opening,
    )


_rk4_inputs, _imex_inputs = _build_inputs_law(3), _build_inputs_law(6)


@contracted
def _add_output(z: State, leak: Leak, t: float, totals: Totals, q: RigNumbers) -> Totals:
    """Add the solver's output at time `t` [s] to the totals of a group of runs (`N_TOTALS`); return the new totals.

    `z`: states of the runs; `leak`: parameters of their leaks (`LEAK_ROWS`); `q`: parameters of the rigs.
    """
    flow_sum, opening_sum, max_travel, min_pressure, diverged = totals
    opening = leak_opening(leak, t)
    p_A, p_B, p_1, p_2 = pressures_of(z, q)
    flow_sum = flow_sum + abs(piston_leakage(p_A - p_B, leak[4] * opening, leak[5] * opening, q.dp_0))
    min_pressure = min(min_pressure, p_A)
    min_pressure = min(min_pressure, p_B)
    # else p_1 and p_2 are p_A and p_B, or those of a supply, which falls no lower than the chamber into which it flows
    if len(q.throttled) > 0:  # rigs with lines
        min_pressure = min(min_pressure, p_1)
        min_pressure = min(min_pressure, p_2)
    state_sum = z[0] + z[1] + z[2] + z[3] + z[4] + z[5] + z[6] + z[7] + z[8] + z[9] + z[10] + z[11] + z[12] + z[13]
    diverged = diverged + 0.0 * state_sum  # NaN once any state is not finite
    return flow_sum, opening_sum + opening, max(abs(z[POSITION]), max_travel), min_pressure, diverged


@contracted
def advance(
    implicit: Implicit,
    y: np.ndarray,
    h: float,
    start: int,
    nodes: np.ndarray,
    shape: np.ndarray,
    drive: np.ndarray,
    leaks: np.ndarray,
    table: np.ndarray,
    bounds: np.ndarray,
    p: RigNumbers,
    every: int,
    pressures: np.ndarray,
    begin: int,
    totals: np.ndarray,
) -> None:
    """Integrate groups of runs in place over n steps of h [s]; write their pressures and add to their totals.

    - `implicit`: `IMPLICIT` or `EXPLICIT`, the integration method.
    - `y` (groups, 14, WIDTH): states, WIDTH runs to a group. `start`: number of the first step.
    - `shape` (n, nodes): the commands' common waveform at the times `nodes` [s] within each step; (n, 2 nodes) if the
      load [N] at the same times follows. `drive` (groups, 2, WIDTH): gain and offset [V] of the command.
    - `leaks` (groups, LEAK_ROWS, WIDTH): numbers of the leaks.
    - `table` (groups, cells, fields, WIDTH): the rigs' numbers, constant within a cell, which is a span of steps;
      `bounds` (cells + 1,): first step of each cell, counted from `start`, and the end. `p`: the rigs' common choices.
    - `pressures` (groups, outputs, CHANNELS, WIDTH): written from output `begin` on, before each `every`-th step.
    - `totals` (groups, N_TOTALS, WIDTH): sums and extremes of each run.
    """
    cells, fields, states = table.shape[1], table.shape[2], y.shape[1]
    for g in range(y.shape[0]):
        z = load_state(y, g * states)
        gain_and_offset = (load(drive, 2 * g), load(drive, 2 * g + 1))
        leak, run_totals = load_leak(leaks, g * LEAK_ROWS), load_totals(totals, g * N_TOTALS)
        pressure_row = (g * pressures.shape[1] + begin) * CHANNELS  # rows are counted over all axes but the lanes
        for cell in range(cells):
            q = load_numbers(table, (g * cells + cell) * fields, p)
            steps_to_output = 0  # a cell begins at an output
            for step in range(bounds[cell], bounds[cell + 1]):
                t = (start + step) * h
                if steps_to_output == 0:
                    steps_to_output = every
                    store(pressures, pressure_row, vapour_floor(z[P_A], q))
                    store(pressures, pressure_row + 1, vapour_floor(z[P_B], q))
                    pressure_row += CHANNELS
                    run_totals = _add_output(z, leak, t + nodes[0], run_totals, q)  # nodes[0]: just inside the step
                steps_to_output -= 1
                if len(implicit) > 0:
                    imex_inputs = _imex_inputs(t, nodes, shape, step, gain_and_offset, leak, q)
                    z = imex_step(z, h, *imex_inputs, q)  # type: ignore[call-arg]
                else:
                    rk4_inputs = _rk4_inputs(t, nodes, shape, step, gain_and_offset, leak, q)
                    z = rk4_step(z, h, *rk4_inputs, q, False)  # type: ignore[call-arg]  # False: no `euler_integral`
        for m in range(states):
            store(y, g * states + m, z[m])
        for m in range(N_TOTALS):
            store(totals, g * N_TOTALS + m, run_totals[m])


@kernel
def advance_lanes_rk4(*run: Any) -> None:
    """Run `advance` by the explicit Runge-Kutta method in compiled code; `run`: its arguments after the first."""
    advance(EXPLICIT, *run)


@kernel
def advance_lanes_imex(*run: Any) -> None:
    """Run `advance` by the implicit-explicit method in compiled code; `run`: its arguments after the first."""
    advance(IMPLICIT, *run)
