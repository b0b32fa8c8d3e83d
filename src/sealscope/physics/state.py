"""The state of the rig: names and order of its numbers, and the tuple of them that the physical laws take."""

from __future__ import annotations

import numpy as np

from sealscope.compiled import contracted

STATES = ("I", "i", "omega", "theta", "x", "v", "p_A", "p_B", "p_1", "p_2", "V_up", "z", "x_s", "v_s")
INTEGRAL, CURRENT, OMEGA, THETA, POSITION, VELOCITY, P_A, P_B, P_1, P_2, MADE_UP, BRISTLE, SPOOL, SPOOL_SPEED = range(
    len(STATES)
)

#: Oil [m^3] that has passed the clogging filters in lines A and B. A rig with lines has no spool: the same places in
#: the state serve both.
PASSED_A, PASSED_B = SPOOL, SPOOL_SPEED

#: Outputs of a run at each output instant: the states and the quantities that follow from them.
OUTPUTS = (*STATES, "Q_1", "Q_A", "Q_B", "q_leak", "V", "q_ext", "q_up")

#: A state or its rate of change in the order of `STATES`; and p_A, p_B, p_1, p_2 or their rates of change.
State = tuple[float, float, float, float, float, float, float, float, float, float, float, float, float, float]
Pressures = tuple[float, float, float, float]


@contracted
def state_of(y: np.ndarray) -> State:
    """Convert a state from an array (14,) to the tuple of numbers that the physical laws take."""
    return y[0], y[1], y[2], y[3], y[4], y[5], y[6], y[7], y[8], y[9], y[10], y[11], y[12], y[13]


@contracted
def add_step(y: State, h: float, dy: State) -> State:
    """Compute y + h dy, element by element: `dy` are rates of change, `y` is a state, or rates in a weighted sum."""
    return (
        y[0] + h * dy[0],
        y[1] + h * dy[1],
        y[2] + h * dy[2],
        y[3] + h * dy[3],
        y[4] + h * dy[4],
        y[5] + h * dy[5],
        y[6] + h * dy[6],
        y[7] + h * dy[7],
        y[8] + h * dy[8],
        y[9] + h * dy[9],
        y[10] + h * dy[10],
        y[11] + h * dy[11],
        y[12] + h * dy[12],
        y[13] + h * dy[13],
    )


@contracted
def add_to_pressures(y: State, h: float, s: Pressures) -> State:
    """Add h `s` to the four pressures in the state `y`; return the whole state.

    `s`: rates of p_A, p_B, p_1 and p_2 [Pa/s]; `h` [s]: time. With h = 1, `y` may also be rates to which `s` is added.
    """
    p_A, p_B, p_1, p_2 = y[P_A] + h * s[0], y[P_B] + h * s[1], y[P_1] + h * s[2], y[P_2] + h * s[3]
    return y[0], y[1], y[2], y[3], y[4], y[5], p_A, p_B, p_1, p_2, y[10], y[11], y[12], y[13]
