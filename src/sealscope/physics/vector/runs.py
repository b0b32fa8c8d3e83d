"""Runs side by side: the same laws and the same two methods over lanes, eight runs to a vector register.

Arrays have their lanes last. A group is WIDTH runs of one kind (the choices of `RigNumbers` are those of all of them);
each lane has numbers, leaks and a gain and offset of the command of its own, and the command's shape is shared.
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

#: Rows that describe a leak of each lane: G [m^3/(s Pa)], C [m^3/(s Pa^0.5)], start [s], slope of the opening [1/s],
#: and the G and C whose flow goes to the account (those of the leak, or of one that is being sized).
LEAK_ROWS = 6
#: Channels that a run writes at each output: p_A, p_B [Pa].
CHANNELS = 2
#: Rows of a lane's account: sum of |Q_L| [m^3/s] over the outputs, sum of the leak's opening, largest |x| [m],
#: lowest pressure [Pa], 0 while all is finite.
ACCOUNTS = 5
Leak = tuple[float, float, float, float, float, float]
Account = tuple[float, float, float, float, float]
FLOW, OPEN, REACH, LEAST, DIVERGED = range(ACCOUNTS)


def _compile(text: str, **scope: Any) -> Any:
    """Compile a law written as text: numba needs every element of a tuple written out."""
    scope["load"] = load
    exec(text, scope)
    return contracted(scope["law"])


def _rows(count: int) -> Any:
    """Build the compiled function (array, at), which loads `count` rows of lanes from row `at` on."""
    return _compile(f"def law(array, at):\n    return ({', '.join(f'load(array, at + {k})' for k in range(count))})")


lane_state, lane_leak, lane_account = _rows(len(STATES)), _rows(LEAK_ROWS), _rows(ACCOUNTS)
_FIELDS = [*(f"{name}=load(table, at + {row})" for row, name in enumerate(NUMBERS)), *(f"{c}=p.{c}" for c in CHOICES)]
#: Of (table, at, p): the choices of `p`, and the group's numbers from rows at, at + 1, ..
lane_numbers = _compile(f"def law(table, at, p):\n    return RigNumbers({', '.join(_FIELDS)})", RigNumbers=RigNumbers)


@contracted
def opening(leak: Leak, t: float) -> float:
    """Compute the opening of a leak (`LEAK_ROWS`) at t [s]: 0 to 1, rising evenly from its start."""
    return min(max((t - leak[2]) * leak[3], 0.0), 1.0)


def _inputs(count: int) -> Any:
    """Build the compiled function (t, nodes, shape, k, drive, leak, p): u, G, C, F at the `count` nodes of step k."""

    def for_nodes(text: str) -> str:
        return ", ".join(text.format(n=n, behind=count + n) for n in range(count))

    return _compile(
        f"""def law(t, nodes, shape, k, drive, leak, p):
    s = ({for_nodes("opening(leak, t + nodes[{n}])")})
    u = ({for_nodes("drive[1] + drive[0] * shape[k, {n}]")})
    G, C = ({for_nodes("leak[0] * s[{n}]")}), ({for_nodes("leak[1] * s[{n}]")})
    F = ({for_nodes("0.0")})
    if len(p.pushed) > 0:
        F = ({for_nodes("shape[k, {behind}]")})
    return u, G, C, F
""",
        opening=opening,
    )


_rk4_inputs, _imex_inputs = _inputs(3), _inputs(6)


@contracted
def _add_output(z: State, leak: Leak, t: float, account: Account, q: RigNumbers) -> Account:
    """Add one output to the account of a run."""
    flow, opened, reach, least, diverged = account
    share = opening(leak, t)
    p_A, p_B, p_1, p_2 = pressures_of(z, q)
    flow = flow + abs(piston_leakage(p_A - p_B, leak[4] * share, leak[5] * share, q.dp_0))
    least = min(least, p_A)
    least = min(least, p_B)
    if len(q.throttled) > 0:
        least = min(least, p_1)
        least = min(least, p_2)
    total = z[0] + z[1] + z[2] + z[3] + z[4] + z[5] + z[6] + z[7] + z[8] + z[9] + z[10] + z[11] + z[12] + z[13]
    return flow, opened + share, max(abs(z[POSITION]), reach), least, diverged + 0.0 * total


@contracted
def advance(
    implicit: Implicit,
    groups: tuple[int, int],
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
    account: np.ndarray,
) -> None:
    """Advance groups of runs in place by n steps of h [s], the first of them step `start` of a run.

    Groups `groups[0]` to before `groups[1]` are advanced, by the implicit-explicit method where `implicit`, else by
    RK4.

    `y`: (groups, 14, WIDTH); `shape`: (n, nodes) the command's shape at `nodes` [s] of each step, or (n, 2 nodes) with
    the load [N] of all runs behind; `drive`: (groups, 2, WIDTH) gain and offset [V]; `leaks`: (groups, LEAK_ROWS,
    WIDTH); `table`: (groups, cells, fields, WIDTH) with `bounds` (cells + 1,) the step at which each cell begins;
    `pressures`: (groups, outputs, CHANNELS, WIDTH), written from output `begin` on, one every `every` steps, before the
    step; `account`: (groups, ACCOUNTS, WIDTH).
    """
    cells, fields, states = table.shape[1], table.shape[2], y.shape[1]
    for g in range(groups[0], groups[1]):
        z = lane_state(y, g * states)
        gain = (load(drive, 2 * g), load(drive, 2 * g + 1))
        leak, noted = lane_leak(leaks, g * LEAK_ROWS), lane_account(account, g * ACCOUNTS)
        out = (g * pressures.shape[1] + begin) * CHANNELS
        for cell in range(cells):
            q = lane_numbers(table, (g * cells + cell) * fields, p)
            due = 0  # steps before the next output; cells begin at one
            for step in range(bounds[cell], bounds[cell + 1]):
                t = (start + step) * h
                if due == 0:
                    due = every
                    store(pressures, out, vapour_floor(z[P_A], q))
                    store(pressures, out + 1, vapour_floor(z[P_B], q))
                    out += CHANNELS
                    noted = _add_output(z, leak, t + nodes[0], noted, q)
                due -= 1
                if len(implicit) > 0:
                    z = imex_step(z, h, *_imex_inputs(t, nodes, shape, step, gain, leak, q), q)  # type: ignore[call-arg]
                else:
                    z = rk4_step(z, h, *_rk4_inputs(t, nodes, shape, step, gain, leak, q), q, False)  # type: ignore[call-arg]
        for m in range(states):
            store(y, g * states + m, z[m])
        for m in range(ACCOUNTS):
            store(account, g * ACCOUNTS + m, noted[m])


@kernel
def advance_lanes_rk4(*run: Any) -> None:
    """Advance by RK4, compiled for lanes (`advance`)."""
    advance(EXPLICIT, *run)


@kernel
def advance_lanes_imex(*run: Any) -> None:
    """Advance throttled rigs by the implicit-explicit method, compiled for lanes (`advance`)."""
    advance(IMPLICIT, *run)
