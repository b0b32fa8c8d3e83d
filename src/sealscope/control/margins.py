"""Margins of a loop: the gain, phase and delay that it tolerates, from rig and controller as they are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.control.controller import Controller, Measured
from sealscope.control.drive import drive_of
from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.parameters import Rig

Array = NDArray[np.float64]
#: Longest memory of a controller [s] that is followed.
_MEMORY = 60.0
#: Impulses that a controller is asked about: position [m], above any dead band, pressures [Pa], angle [rad].
_IMPULSE_X, _IMPULSE_P, _IMPULSE_THETA = 1e-3, 1e4, 1.0
#: Time [s] in which a moving piston settles before the rig is linearised.
_SETTLING = 0.5
_FREQUENCIES = 4000
#: Samples of an answer that are summed at once.
_BLOCK = 64
#: By how much each state is moved for a difference.
_SIZES = (1e-3, 1e-3, 1e-2, 1e-3, 1e-6, 1e-6, 1e2, 1e2, 1e2, 1e2, 1e-9, 1e-9, 1e-7, 1e-4)


@dataclass(frozen=True)
class Margins:
    """Margins of a loop at one speed of the piston.

    `speed` [m/s]; `gain`: factor by which the loop's gain may grow, inf where none ends it; `phase` [rad]: the least
    distance of arg L from -pi where |L| = 1; `crossover` [Hz]: the highest frequency at which the loop's gain is 1;
    `delay` [s]: what the loop may be later, the least over all frequencies at which its gain is 1; `peak`: the
    largest 1/|1 + L|; `damped`: whether the rig rings down by itself (at slow strokes its friction falls with speed,
    and it may not: then gain and phase margin bound a loop that is not stable to begin with).
    """

    speed: float
    gain: float
    phase: float
    crossover: float
    delay: float
    peak: float
    damped: bool


def margins(rig: Rig, controller: Controller, speed: float = 0.0, load: float = 0.0) -> Margins:
    """Compute the margins of the loop of a rig and a controller, cut at the voltage.

    The rig is linearised over one sample of the controller, about a piston that moves at `speed` [m/s], 0: at
    standstill, under `load` [N] beside the rig's own: y(k+1) = A y(k) + B u(k), by differences of the solver's own
    steps. The controller is what its answers to an impulse of each measurement say: C_j(z). Loop: L(z) = -z^-delay
    sum_j C_j(z) c_j (z I - A)^-1 B, j = x, p_A, p_B, theta. Raises InputError for a speed beyond the drive.

    Examples
    --------
    >>> import sealscope as ss
    >>> from sealscope.control import PositionPI, margins
    >>> rig = ss.load_rig("thesis-closed-loop")
    >>> loop = margins(rig, PositionPI.from_rig(rig), speed=0.01)
    >>> loop.gain > 2.0 and loop.phase > 0.7
    True
    """
    f = np.geomspace(0.05, 0.499 * controller.rate, _FREQUENCIES)
    L, damped = open_loop(rig, controller, f, speed, load)
    return margins_of(f, L, speed, damped)


def open_loop(
    rig: Rig, controller: Controller, f: Array, speed: float = 0.0, load: float = 0.0
) -> tuple[NDArray[np.complex128], bool]:
    """Compute L (n,) at the frequencies `f` (n,) [Hz], and whether the rig rings down by itself (`margins`)."""
    A, B, state = _linearised(rig, controller.rate, speed, load)
    z = np.exp(2j * math.pi * f / controller.rate)
    values, vectors = np.linalg.eig(A)
    inputs = np.linalg.solve(vectors, B.astype(complex))
    L = np.zeros(f.size, dtype=complex)
    for row, answer in _answers(controller, state):
        plant = (vectors[row] * inputs / (z[:, None] - values)).sum(axis=1)
        L -= _of_impulse(answer, z) * plant
    return L * z**-controller.delay, bool(np.abs(values).max() < 1.0 + 1e-6)


def _linearised(rig: Rig, rate: float, speed: float, load: float) -> tuple[Array, Array, Array]:
    from sealscope.physics.rig import packed, rig_numbers
    from sealscope.physics.solvers.advance import EXPLICIT, IMPLICIT, advance, nodes_of
    from sealscope.physics.solvers.limits import longest_step
    from sealscope.physics.standstill import initial_state
    from sealscope.physics.state import OUTPUTS, POSITION, VELOCITY

    p = rig_numbers(rig) if load == 0.0 else rig_numbers(rig)._replace(pushed=(True,))
    steps = max(2, math.ceil(1.2 / (rate * min(1e-3, longest_step(p)))))
    h, implicit, euler = 1.0 / (rate * steps), IMPLICIT if p.throttled else EXPLICIT, rig.motor.integrator == "euler"
    nodes = nodes_of(implicit, h).size

    def advance_state(y: Array, u: float, samples: int = 1) -> Array:
        n = samples * steps
        after, rows = np.array(y), np.empty((samples, len(OUTPUTS)))
        volts, none, force = np.full((n, nodes), u), np.zeros((n, nodes)), np.full((n, nodes), load)
        advance(implicit, after, h, volts, none, none, force, packed(p), euler, steps, rows)
        return after

    y, u = initial_state(rig, 0.0, load), 0.0
    if speed != 0.0:
        u = drive_of(rig).steady(speed * rig.cylinder.A_A)
        samples, limit = round(_SETTLING * rate), rig.daq.u_max

        def find_moving_state(u: float) -> tuple[Array, float]:
            """Simulate a piston that moves; return its state, which may ring, and its mean speed."""
            first_state = advance_state(y, u, samples)
            last_state = advance_state(first_state, u, samples)
            return last_state, float(last_state[POSITION] - first_state[POSITION]) * rate / samples

        _, speed_at_rest = find_moving_state(0.0)  # the load may move a piston whose drive gives way
        for _ in range(5):  # the drive falls short of its command
            state, mean_speed = find_moving_state(min(max(u, -limit), limit))
            speed_gain = mean_speed - speed_at_rest
            u *= min(max((speed - speed_at_rest) / speed_gain, 0.2), 5.0) if speed_gain * speed > 0.0 else 1.5
        if not abs(mean_speed - speed) < 0.2 * abs(speed):
            raise InputError(f"speed must be one that the drive can give, got {speed:g} m/s")
        y = state
        y[VELOCITY], y[POSITION] = speed, 0.0
    columns: list[Array] = []
    for k, size in enumerate(_SIZES):
        shift = np.zeros(y.size)
        shift[k] = size
        columns.append((advance_state(y + shift, u) - advance_state(y - shift, u)) / (2.0 * size))
    B = (advance_state(y, u + 1e-3) - advance_state(y, u - 1e-3)) / 2e-3
    return np.stack(columns, axis=1), B, y


def _answers(controller: Controller, state: Array) -> list[tuple[int, Array]]:
    """Compute the controller's answer to a unit impulse of each measured state, with the state's row."""
    from sealscope.physics.state import P_A, P_B, POSITION, THETA

    standstill = Measured(0.0, 0.0, 0.0, 0.0, float(state[P_A]), float(state[P_B]), 0.0)
    n = round(_MEMORY * controller.rate)

    def answer(first: Measured) -> Array:
        voltage = controller.start()
        for _ in range(round(controller.rate)):
            voltage(standstill)
        return np.array([voltage(first), *(voltage(standstill) for _ in range(n - 1))])

    quiet = answer(standstill)
    impulses = (
        (POSITION, _IMPULSE_X, standstill._replace(x=_IMPULSE_X)),
        (P_A, _IMPULSE_P, standstill._replace(p_A=standstill.p_A + _IMPULSE_P)),
        (P_B, _IMPULSE_P, standstill._replace(p_B=standstill.p_B + _IMPULSE_P)),
        (THETA, _IMPULSE_THETA, standstill._replace(theta=_IMPULSE_THETA)),
    )
    answers = [(row, (answer(first) - quiet) / size) for row, size, first in impulses]
    return [(row, values) for row, values in answers if np.any(values)]


def _of_impulse(answer: Array, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Compute sum_n a_n z^-n of an answer that stays at its last value: an integrator's."""
    tail = answer[-1]
    changing = answer - tail
    last = int(np.flatnonzero(np.abs(changing) > 1e-9 * np.abs(answer).max())[-1]) + 1 if np.any(changing) else 0
    blocks = np.zeros((math.ceil(last / _BLOCK), _BLOCK))
    blocks.ravel()[:last] = changing[:last]
    within = z[:, None] ** -np.arange(float(_BLOCK)) @ blocks.T
    total = np.zeros(z.size, dtype=complex)
    for k in range(len(blocks) - 1, -1, -1):  # Horner, a block at a time
        total = total * z**-_BLOCK + within[:, k]
    return np.asarray(total + tail / (1.0 - 1.0 / z))


def margins_of(f: Array, L: NDArray[np.complex128], speed: float = 0.0, damped: bool = True) -> Margins:
    """Compute the margins of a loop L (n,) over frequencies `f` (n,) [Hz], linear between them: see `Margins`."""
    places = np.arange(f.size)
    unit, turned = _crossings(np.abs(L) - 1.0), _crossings(L.imag)
    crossover, ahead = np.interp(unit, places, f), np.angle(-np.interp(unit, places, L))
    real = np.interp(turned, places, L.real)
    gain = float(np.min(-1.0 / real[(real < 0.0) & (real > -1.0)], initial=math.inf))
    phase = float(np.min(np.abs(ahead), initial=math.inf))
    delay = float(np.min(np.mod(ahead, 2.0 * math.pi) / (2.0 * math.pi * crossover), initial=math.inf))
    peak = float(np.max(1.0 / np.abs(1.0 + L)))
    return Margins(speed, gain, phase, float(np.max(crossover, initial=0.0)), delay, peak, damped)


def _crossings(values: Array) -> Array:
    """Find the places, in fractions of an index, at which a line through the values changes its sign."""
    k = np.flatnonzero(np.diff(values > 0.0))
    return k + values[k] / (values[k] - values[k + 1])
