"""Stability margins of a rig's control loop: the additional gain, phase and delay that the loop tolerates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.control.controller import Controller, Measured
from sealscope.control.drive import drive_of
from sealscope.errors import InputError
from sealscope.recordings.channels import Array

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_RESPONSE_DURATION = 60.0  # duration [s] of a controller's impulse response
#: Sizes of the impulses of position [m] (above the built-in controllers' default dead bands), pressure [Pa] and angle
#: [rad].
_IMPULSE_X, _IMPULSE_P, _IMPULSE_THETA = 1e-3, 1e4, 1.0
_SETTLING = 0.5  # time [s] in which a moving piston settles before the rig is linearised
_N_FREQUENCIES = 4000
_BLOCK = 64  # samples of an impulse response that are summed at once
#: Steps of the voltage [V], and of each state [SI] in the order of `STATES`, for the finite differences.
_VOLTAGE_STEP = 1e-3
_STATE_STEPS = (1e-3, 1e-3, 1e-2, 1e-3, 1e-6, 1e-6, 1e2, 1e2, 1e2, 1e2, 1e-9, 1e-9, 1e-7, 1e-4)


@dataclass(frozen=True)
class Margins:
    """Stability margins of a control loop with the open-loop response L, at one speed of the piston.

    The rig may be unstable in slow strokes, where friction falls with speed; the margins then do not prove that the
    loop is stable.
    """

    speed: float  # [m/s] of the piston
    gain: float  # factor by which the loop's gain may grow, inf if unlimited
    phase: float  # [rad] smallest distance of arg L from -pi where |L| = 1; inf if |L| is never 1
    crossover: float  # [Hz] highest frequency at which |L| = 1; 0 if there is none
    delay: float  # [s] smallest additional delay at which the loop becomes unstable; inf if |L| is never 1
    peak: float  # largest sensitivity 1/|1 + L|
    damped: bool  # True if the rig without controller is stable


def margins(rig: Rig, controller: Controller, speed: float = 0.0, load: float = 0.0) -> Margins:
    """Compute the stability margins of the control loop of a rig and a controller, opened at the voltage.

    The piston moves at `speed` [m/s] (0: standstill) under a force `load` [N] in addition to the rig's own load. Raises
    InputError for a speed that the drive cannot reach.

    Examples
    --------
    >>> import sealscope as ss
    >>> from sealscope.control import PositionPI, margins
    >>> rig = ss.load_rig("thesis-closed-loop")
    >>> loop = margins(rig, PositionPI.from_rig(rig), speed=0.01)
    >>> loop.gain > 2.0 and loop.phase > 0.7
    True
    """
    f = np.geomspace(0.05, 0.499 * controller.rate, _N_FREQUENCIES)  # [Hz], to just below the Nyquist frequency
    L, damped = open_loop(rig, controller, f, speed, load)
    return compute_margins(f, L, speed, damped)


def open_loop(
    rig: Rig, controller: Controller, f: Array, speed: float = 0.0, load: float = 0.0
) -> tuple[NDArray[np.complex128], bool]:
    """Compute the open-loop response L (n,) of a rig and its controller at frequencies `f` (n,) [Hz].

    L = -z^-delay sum_j C_j(z) P_j(z) with z = exp(2 pi i f/rate). C_j is the controller's transfer function from
    measurement j (x, p_A, p_B or theta) to the voltage, from its response to an impulse. P_j is that of the rig from
    the voltage to measurement j: c_j (z I - A)^-1 B, where y(k+1) = A y(k) + B u(k) is the rig linearised over one
    sample, and the row c_j picks measurement j from the state. The piston moves at `speed` [m/s] (0: standstill), under
    an additional force `load` [N]. The second result is True if the linearised rig is stable without control.
    """
    A, B, state = _linearise(rig, controller.rate, speed, load)
    z = np.exp(2j * math.pi * f / controller.rate)
    # (z I - A)^-1 B by the eigenvalues of A, for all frequencies at once
    eigenvalues, eigenvectors = np.linalg.eig(A)
    modal_inputs = np.linalg.solve(eigenvectors, B.astype(complex))
    L = np.zeros(f.size, dtype=complex)
    for measured_state, response in _impulse_responses(controller, state):
        plant = (eigenvectors[measured_state] * modal_inputs / (z[:, None] - eigenvalues)).sum(axis=1)
        L -= _frequency_response(response, z) * plant
    # 1e-6: position and angle are integrals, with eigenvalues of 1 up to the error of the finite differences
    damped = bool(np.abs(eigenvalues).max() < 1.0 + 1e-6)
    return L * z**-controller.delay, damped


def _linearise(rig: Rig, rate: float, speed: float, load: float) -> tuple[Array, Array, Array]:
    """Linearise the rig over one sample at the sampling rate `rate` [Hz]: y(k+1) = A y(k) + B u(k).

    Returns A (14, 14), B (14,) [per V] and the state (14,) at which the rig is linearised by finite differences of the
    solver's steps: at standstill, or with the piston at mid-stroke and moving at `speed` [m/s], under the additional
    force `load` [N]. Raises InputError for a speed that the drive cannot reach within 20 %.
    """
    from sealscope.physics.rig import pack_numbers, rig_numbers
    from sealscope.physics.solvers.advance import EXPLICIT, IMPLICIT, advance, step_nodes
    from sealscope.physics.solvers.limits import longest_step
    from sealscope.physics.standstill import initial_state
    from sealscope.physics.state import OUTPUTS, POSITION, VELOCITY

    # pushed=(True,): the equations take an additional load
    p = rig_numbers(rig) if load == 0.0 else rig_numbers(rig)._replace(pushed=(True,))
    steps = max(2, math.ceil(1.2 / (rate * min(1e-3, longest_step(p)))))  # steps of at most 1 ms; 20 % in reserve
    h = 1.0 / (rate * steps)
    implicit = IMPLICIT if p.throttled else EXPLICIT  # throttles make the equations stiff
    euler = rig.motor.integrator == "euler"
    nodes = step_nodes(implicit, h).size  # times within a step at which the solver takes its inputs

    def advance_state(y: Array, u: float, samples: int = 1) -> Array:
        """Integrate the state y (14,) over a number of samples at a constant voltage u [V]; return the new state."""
        n = samples * steps
        state, outputs = np.array(y), np.empty((samples, len(OUTPUTS)))  # `advance` needs a place for the outputs
        volts, no_leak, force = np.full((n, nodes), u), np.zeros((n, nodes)), np.full((n, nodes), load)
        # both coefficients of a leak, laminar and orifice, are 0
        advance(implicit, state, h, volts, no_leak, no_leak, force, pack_numbers(p), euler, steps, outputs)
        return state

    y, u = initial_state(rig, 0.0, load), 0.0
    if speed != 0.0:
        samples, limit = round(_SETTLING * rate), rig.daq.u_max

        def find_moving_state(u: float) -> tuple[Array, float]:
            """Simulate the rig from standstill at u [V], in two parts of `_SETTLING` seconds each.

            Returns the last state, and the piston's mean speed [m/s] in the second part.
            """
            first_state = advance_state(y, u, samples)
            last_state = advance_state(first_state, u, samples)
            return last_state, float(last_state[POSITION] - first_state[POSITION]) * rate / samples

        _, drift_speed = find_moving_state(0.0)  # the load may move the piston at 0 V
        next_u = speed * rig.cylinder.A_A / drive_of(rig).flow_per_volt  # a first guess
        for _ in range(5):  # adjust the voltage to the stated speed: the drive falls short of its command
            u = min(max(next_u, -limit), limit)
            state, mean_speed = find_moving_state(u)
            driven_speed = mean_speed - drift_speed  # due to the voltage
            # a factor from 1/5 to 5, or 1.5 if the voltage does not move the piston in the right direction
            factor = min(max((speed - drift_speed) / driven_speed, 0.2), 5.0) if driven_speed * speed > 0.0 else 1.5
            next_u = factor * u
        if not abs(mean_speed - speed) < 0.2 * abs(speed):
            raise InputError(f"speed must be one that the drive can reach, got {speed:g} m/s")
        y = state
        y[VELOCITY], y[POSITION] = speed, 0.0
    columns: list[Array] = []
    for k, state_step in enumerate(_STATE_STEPS):
        shift = np.zeros(y.size)
        shift[k] = state_step
        columns.append((advance_state(y + shift, u) - advance_state(y - shift, u)) / (2.0 * state_step))
    B = (advance_state(y, u + _VOLTAGE_STEP) - advance_state(y, u - _VOLTAGE_STEP)) / (2.0 * _VOLTAGE_STEP)
    return np.stack(columns, axis=1), B, y


def _impulse_responses(controller: Controller, state: Array) -> list[tuple[int, Array]]:
    """Compute the response of a controller's voltage to a unit impulse of each measurement, with the piston at rest.

    An impulse changes one measurement during one sample. At all other samples target, position and angle are 0, and the
    chamber pressures are those in the rig's `state` (14,). Returns pairs of the measurement's index in the state and
    the response (n,) [V per SI unit of the measurement], without responses that are zero.
    """
    from sealscope.physics.state import P_A, P_B, POSITION, THETA

    p_A, p_B = float(state[P_A]), float(state[P_B])
    standstill = Measured(t=0.0, target=0.0, target_speed=0.0, x=0.0, p_A=p_A, p_B=p_B, theta=0.0)
    n = round(_RESPONSE_DURATION * controller.rate)

    def respond(impulse: Measured) -> Array:
        """Compute the voltages (n,) [V] from the sample `impulse` on; all other samples are at standstill."""
        voltage = controller.start()
        for _ in range(round(controller.rate)):  # settle for a second
            voltage(standstill)
        return np.array([voltage(impulse), *(voltage(standstill) for _ in range(n - 1))])

    baseline = respond(standstill)
    impulses = (
        (POSITION, _IMPULSE_X, standstill._replace(x=_IMPULSE_X)),
        (P_A, _IMPULSE_P, standstill._replace(p_A=standstill.p_A + _IMPULSE_P)),
        (P_B, _IMPULSE_P, standstill._replace(p_B=standstill.p_B + _IMPULSE_P)),
        (THETA, _IMPULSE_THETA, standstill._replace(theta=_IMPULSE_THETA)),
    )
    responses = [(state_index, (respond(impulse) - baseline) / size) for state_index, size, impulse in impulses]
    return [(state_index, values) for state_index, values in responses if np.any(values)]


def _frequency_response(response: Array, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Compute the frequency response (m,) of a controller from its impulse response, by the z-transform sum_k a_k z^-k.

    `response` (n,): the first n values a_k; all later values equal the last one, as for an integrator. `z` (m,).
    """
    last_value = response[-1]
    transient = response - last_value
    is_relevant = np.abs(transient) > 1e-9 * np.abs(response).max()
    n = int(np.flatnonzero(is_relevant)[-1]) + 1 if is_relevant.any() else 0  # up to the last relevant value
    blocks = np.zeros((math.ceil(n / _BLOCK), _BLOCK))  # the transient in rows, the last one padded by zeros
    blocks.ravel()[:n] = transient[:n]
    block_sums = z[:, None] ** -np.arange(float(_BLOCK)) @ blocks.T
    total = np.zeros(z.size, dtype=complex)
    for k in range(len(blocks) - 1, -1, -1):  # Horner's scheme, a block at a time
        total = total * z**-_BLOCK + block_sums[:, k]
    return np.asarray(total + last_value / (1.0 - 1.0 / z))  # a constant is a geometric series


def compute_margins(f: Array, L: NDArray[np.complex128], speed: float = 0.0, damped: bool = True) -> Margins:
    """Compute the stability margins of an open-loop response L (n,) at the frequencies `f` (n,) [Hz].

    Between the frequencies, L is interpolated linearly. `speed` [m/s] and `damped` are copied to the result.
    """
    indices = np.arange(f.size)
    unit_gain = _crossings(np.abs(L) - 1.0)  # fractional indices at which |L| = 1
    crossover = np.interp(unit_gain, indices, f)
    phase_margin = np.angle(-np.interp(unit_gain, indices, L))  # arg L + pi
    real = np.interp(_crossings(L.imag), indices, L.real)  # L where it crosses the real axis
    below_unit_gain = real[(real < 0.0) & (real > -1.0)]  # a larger gain moves these to -1
    gain = float(np.min(-1.0 / below_unit_gain, initial=math.inf))
    phase = float(np.min(np.abs(phase_margin), initial=math.inf))
    delays = np.mod(phase_margin, 2.0 * math.pi) / (2.0 * math.pi * crossover)  # a delay T lowers the phase by 2 pi f T
    delay = float(np.min(delays, initial=math.inf))
    peak = float(np.max(1.0 / np.abs(1.0 + L)))
    return Margins(speed, gain, phase, float(np.max(crossover, initial=0.0)), delay, peak, damped)


def _crossings(values: Array) -> Array:
    """Find where `values` (n,) change their sign, as fractional indices (m,) by linear interpolation."""
    k = np.flatnonzero(np.diff(values > 0.0))
    return k + values[k] / (values[k] - values[k + 1])  # no division by 0: the signs differ
