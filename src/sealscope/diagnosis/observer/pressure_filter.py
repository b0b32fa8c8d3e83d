"""The extended Kalman filter over the pressures, which sees the leak by its damping and flow in p_A and p_B.

Machine (the equations of the rig without throttles, thesis eqs. (4.1)-(4.5), (4.13)-(4.22), with the leak in them):

    dp_A/dt = k/(1 + c x) (q - A_A v),  dp_B/dt = -k/(1 - c x) (q - A_B v),  q = gain D omega - G (p_A - p_B)
    M dv/dt = A_A p_A - A_B p_B - F(v) - bias_force,  dx/dt = v,  k = stiffness K_oil/V,  c = volume_slope A/V

The speed omega is the recorded one, or follows from the command by the drive's own equations, without a covariance of
its own. The means are integrated by RK4 in steps of at most 1 ms, the sensitivities by the exponential of the Jacobian
at each step's middle. p_A and p_B are measured, one after the other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sealscope.compiled import kernel, law
from sealscope.diagnosis.observer.estimates import SUMS, BlockRows, begin_sums, close_block
from sealscope.diagnosis.observer.model import (
    FLOW_NOISE,
    FORCE_NOISE,
    G_PRIOR,
    G_UNIT,
    PARAMETERS,
    REVERSAL_NOISE,
    REVERSAL_SPEED,
    STIFFNESS,
    walks,
)
from sealscope.physics.cylinder import piston_acceleration, pressure_rate
from sealscope.physics.friction import coulomb_friction, stribeck_friction
from sealscope.physics.motor import controller_voltage, shaft_acceleration, winding_current_rate
from sealscope.physics.pump import pump_flow, pump_torque
from sealscope.physics.rig import RigNumbers
from sealscope.recordings.recording import Array

#: Means: drive (integral, current, speed), then the four states that have a covariance; rows of the covariance.
MEANS = 7
_STATES = 4
COVARIANCE = _STATES + len(PARAMETERS)
#: Longest step of the integration [s].
LONGEST_STEP = 1.0e-3
#: Uncertainty of velocity [m/s] and position [m] at the start.
_VELOCITY, _POSITION = 0.01, 0.05
#: The search of the stiffness: after these seconds this number of candidates goes on.
ROUNDS = ((6.3, 6), (12.6, 1))
#: Length [s] of the beginning that `find_stiffness` reads.
SEARCH_SECONDS = ROUNDS[-1][0]
_NEVER = 1 << 62
#: Arrays of a `PressureFilter` that samples change.
MEMORY = ("z", "q", "P", "sums")


@law
def friction_slopes(v: float, F_C: float, breakaway: float, a: RigNumbers) -> tuple[float, float, float]:
    """Return slope in v, value and slope in b of the friction F_C (1 + b (K_brk - 1) e) sign(v).

    e = exp(-C_c |v|); `physics.friction.stribeck_friction` without the viscous part, F_v = 0.
    """
    speed = abs(v)
    stribeck = a.K_brk - 1.0
    e = math.exp(-a.C_c * max(speed, a.v_th))
    sign = min(max(v / a.v_th, -1.0), 1.0)
    level = F_C * (1.0 + breakaway * stribeck * e)
    slope = level / a.v_th if speed <= a.v_th else -F_C * breakaway * stribeck * a.C_c * e
    return slope, level * sign, F_C * stribeck * e * sign


@law
def _flow(z: np.ndarray, q: np.ndarray, omega: float, a: RigNumbers) -> float:
    """Return the flow [m^3/s] into chamber A: pump flow less leakage."""
    return pump_flow(omega, z[3] - z[4], q[4] * a.q_b, q[0] * G_UNIT)


@law
def _rates(z: np.ndarray, q: np.ndarray, drive: float, commanded: bool, a: RigNumbers, dz: np.ndarray) -> None:
    """Write the rates of the means `z` with parameters `q` to `dz`; `drive`: the command [V], or the speed [rad/s]."""
    dp = z[3] - z[4]
    omega = drive
    if commanded:
        omega = z[2]
        error = a.omega_per_volt * drive - omega
        voltage = controller_voltage(error, z[0], a.k_p, a.K_i, a.V_max)
        dz[0] = error
        dz[1] = winding_current_rate(voltage, z[1], omega, a.R_c, a.L_c, a.C_e, a.i_max)
        dz[2] = shaft_acceleration(z[1], omega, pump_torque(dp, a.q_b), a.C_m, a.B_M, a.J_M)
    else:
        dz[0] = 0.0
        dz[1] = 0.0
        dz[2] = 0.0
    flow = _flow(z, q, omega, a)
    change = 0.5 * q[6] * (a.A_A + a.A_B) / a.V * z[6]
    dz[3] = pressure_rate(flow - a.A_A * z[5], a.V * (1.0 + change), q[3] * a.K_oil)
    dz[4] = pressure_rate(a.A_B * z[5] - flow, a.V * (1.0 - change), q[3] * a.K_oil)
    F_C = q[1] * coulomb_friction(z[3], z[4], a.F_pr, a.F_cfr, False)
    friction = stribeck_friction(z[5], F_C, 1.0 + q[7] * (a.K_brk - 1.0), a.C_c, q[2] * a.F_v, a.v_th, False)
    dz[5] = piston_acceleration(z[3], z[4], friction, q[5], 0.0, a.A_A, a.A_B, a.M_eq)
    dz[6] = z[5]


@law
def _slopes(z: np.ndarray, q: np.ndarray, omega: float, a: RigNumbers, J: np.ndarray, B: np.ndarray) -> None:
    """Write the Jacobians of the rates of (p_A, p_B, v, x): J (4, 4) in themselves, B (3, 8) in the parameters."""
    dp = z[3] - z[4]
    flow = _flow(z, q, omega, a)
    pumped = a.q_b / (2.0 * math.pi) * omega
    stiffness = q[3] * a.K_oil / a.V
    c = 0.5 * (a.A_A + a.A_B) / a.V
    share_A = 1.0 / (1.0 + q[6] * c * z[6])
    share_B = 1.0 / (1.0 - q[6] * c * z[6])
    k_A = stiffness * share_A
    k_B = stiffness * share_B
    rate_A = k_A * (flow - a.A_A * z[5])
    rate_B = -k_B * (flow - a.A_B * z[5])
    G = q[0] * G_UNIT
    slope, coulomb, breakaway = friction_slopes(z[5], coulomb_friction(z[3], z[4], a.F_pr, a.F_cfr, False), q[7], a)
    J[0, 0] = -k_A * G
    J[0, 1] = k_A * G
    J[0, 2] = -k_A * a.A_A
    J[0, 3] = -rate_A * share_A * q[6] * c
    J[1, 0] = k_B * G
    J[1, 1] = -k_B * G
    J[1, 2] = k_B * a.A_B
    J[1, 3] = rate_B * share_B * q[6] * c
    J[2, 0] = a.A_A / a.M_eq
    J[2, 1] = -a.A_B / a.M_eq
    J[2, 2] = -(q[1] * slope + q[2] * a.F_v) / a.M_eq
    J[3, 2] = 1.0
    B[0, 0] = -k_A * G_UNIT * dp
    B[1, 0] = k_B * G_UNIT * dp
    B[2, 1] = -coulomb / a.M_eq
    B[2, 2] = -a.F_v * z[5] / a.M_eq
    B[0, 3] = rate_A / q[3]
    B[1, 3] = rate_B / q[3]
    B[0, 4] = k_A * pumped
    B[1, 4] = -k_B * pumped
    B[2, 5] = -1.0 / a.M_eq
    B[0, 6] = -rate_A * share_A * c * z[6]
    B[1, 6] = rate_B * share_B * c * z[6]
    B[2, 7] = -q[1] * breakaway / a.M_eq


@law
def _carry(J: np.ndarray, B: np.ndarray, h: float, E: np.ndarray, T: np.ndarray, N: np.ndarray, S: np.ndarray) -> None:
    """Carry the sensitivities S (4, 12) over a step of h: exp(hJ) of the states, h phi_1(hJ) B of the parameters."""
    for i in range(_STATES):
        for j in range(_STATES):
            T[i, j] = h / 4.0 * J[i, j]
        T[i, i] += 1.0
    for divisor in (3.0, 2.0, 1.0):  # Horner: phi_1 = 1 + hJ/2 (1 + hJ/3 (1 + hJ/4)), then exp = 1 + hJ phi_1
        for i in range(_STATES):
            for j in range(_STATES):
                total = 0.0
                for m in range(_STATES):
                    total += J[i, m] * T[m, j]
                E[i, j] = h / divisor * total
            E[i, i] += 1.0
        if divisor > 1.0:
            for i in range(_STATES):
                for j in range(_STATES):
                    T[i, j] = E[i, j]
    for i in range(_STATES):
        for j in range(COVARIANCE):
            N[i, j] = E[i, 0] * S[0, j] + E[i, 1] * S[1, j] + E[i, 2] * S[2, j] + E[i, 3] * S[3, j]
        for j in range(COVARIANCE - _STATES):
            N[i, _STATES + j] += h * (T[i, 0] * B[0, j] + T[i, 1] * B[1, j] + T[i, 2] * B[2, j])
    for i in range(_STATES):
        for j in range(COVARIANCE):
            S[i, j] = N[i, j]


class Room(NamedTuple):
    """Arrays that `take_pressures` uses meanwhile."""

    J: np.ndarray
    E: np.ndarray
    T: np.ndarray
    B: np.ndarray
    S: np.ndarray
    W: np.ndarray
    k1: np.ndarray
    k2: np.ndarray
    k3: np.ndarray
    k4: np.ndarray
    mid: np.ndarray
    gain: np.ndarray


#: Their shapes.
ROOM = (
    *((_STATES, _STATES),) * 3,
    (_STATES, len(PARAMETERS)),
    *((_STATES, COVARIANCE),) * 2,
    *((MEANS,),) * 5,
    (COVARIANCE,),
)


@law
def take_pressures(
    drive: float,
    p_A: float,
    p_B: float,
    commanded: bool,
    h: float,
    steps: int,
    a: RigNumbers,
    z: np.ndarray,
    q: np.ndarray,
    P: np.ndarray,
    sums: np.ndarray,
    noise: np.ndarray,
    walk: np.ndarray,
    block: float,
    row: np.ndarray,
    room: Room,
) -> bool:
    """Take a sample, h [s] after the one before; return whether it closed a block, whose estimates are in `row`.

    `drive`: command [V] if `commanded`, else the mean speed [rad/s] since the sample before. Means `z` (7,), parameters
    `q` (8,), covariance `P` (12, 12) and `sums` (see `estimates`) are the filter's memory and are changed in place.
    `noise` (2,): variances of the readings [Pa^2]; `walk` (8,): variances gained from block to block; `block`: length
    of a block [samples].
    """
    J, E, T, B, S, W, k1, k2, k3, k4, mid, gain = room
    step = h / steps
    if sums[5] == 0.0:
        sums[5] = 1.0
        sums[6] = drive
        z[3] = p_A
        z[4] = p_B
        return False
    before, after = (sums[6], drive) if commanded else (drive, drive)
    sums[6] = drive
    for i in range(_STATES):
        for j in range(COVARIANCE):
            S[i, j] = 1.0 if i == j else 0.0
    for part in range(steps):
        left = before + (after - before) * part / steps
        right = before + (after - before) * (part + 1) / steps
        half = 0.5 * (left + right)
        _rates(z, q, left, commanded, a, k1)
        for i in range(MEANS):
            mid[i] = z[i] + 0.5 * step * k1[i]
        _rates(mid, q, half, commanded, a, k2)
        for i in range(MEANS):
            mid[i] = z[i] + 0.5 * step * k2[i]
        _rates(mid, q, half, commanded, a, k3)
        _slopes(mid, q, mid[2] if commanded else half, a, J, B)
        for i in range(MEANS):
            mid[i] = z[i] + step * k3[i]
        _rates(mid, q, right, commanded, a, k4)
        for i in range(MEANS):
            z[i] += step / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
        _carry(J, B, step, E, T, W, S)
    for i in range(_STATES):
        for j in range(COVARIANCE):
            W[i, j] = 0.0
        for m in range(COVARIANCE):
            for j in range(COVARIANCE):
                W[i, j] += S[i, m] * P[m, j]
    for i in range(_STATES):
        for j in range(i, _STATES):
            total = 0.0
            for m in range(COVARIANCE):
                total += W[i, m] * S[j, m]
            P[i, j] = total
            P[j, i] = total
        for j in range(_STATES, COVARIANCE):
            P[i, j] = W[i, j]
            P[j, i] = W[i, j]
    flow = (q[3] * a.K_oil / a.V * FLOW_NOISE) ** 2 * h
    P[0, 0] += flow
    P[1, 1] += flow
    P[0, 1] -= flow
    P[1, 0] -= flow
    force = FORCE_NOISE + REVERSAL_NOISE * math.exp(-abs(z[5]) / REVERSAL_SPEED)
    P[2, 2] += (force / a.M_eq) ** 2 * h
    for c in range(2):
        innovation = (p_A if c == 0 else p_B) - z[3 + c]
        variance = P[c, c] + noise[c]
        white = innovation / math.sqrt(variance)
        sums[1] -= 0.5 * (white * white + math.log(variance))
        sums[2] += 0.5 * white * white
        sums[8] += 0.5 * white * sums[9 + c]
        sums[9 + c] = white
        for i in range(COVARIANCE):
            gain[i] = P[i, c] / variance
        for i in range(_STATES):
            z[3 + i] += gain[i] * innovation
        for j in range(len(PARAMETERS)):
            q[j] += gain[_STATES + j] * innovation
        for i in range(COVARIANCE):
            share = gain[i] * variance
            for j in range(COVARIANCE):
                P[i, j] -= share * gain[j]
    sums[7] += abs(p_A - p_B)
    sums[0] += 1.0
    if sums[0] < block:
        return False
    close_block(q, P, _STATES, 0, sums, walk, G_PRIOR, row)
    return True


@kernel
def advance(
    drive: np.ndarray,
    p_A: np.ndarray,
    p_B: np.ndarray,
    commanded: bool,
    h: float,
    steps: int,
    a: RigNumbers,
    z: np.ndarray,
    q: np.ndarray,
    P: np.ndarray,
    sums: np.ndarray,
    noise: np.ndarray,
    walk: np.ndarray,
    block: int,
    rows: np.ndarray,
) -> int:
    """Take samples, (n,) each, as `take_pressures` does; return the number of `rows` written."""
    s, m = _STATES, len(PARAMETERS)
    J, E, T, B = np.zeros((s, s)), np.zeros((s, s)), np.zeros((s, s)), np.zeros((s, m))
    S, W, gain = np.zeros((s, COVARIANCE)), np.zeros((s, COVARIANCE)), np.zeros(COVARIANCE)
    k1, k2, k3, k4, mid = np.zeros(MEANS), np.zeros(MEANS), np.zeros(MEANS), np.zeros(MEANS), np.zeros(MEANS)
    room = Room(J, E, T, B, S, W, k1, k2, k3, k4, mid, gain)
    row, written = np.zeros(rows.shape[1]), 0
    for n in range(drive.size):
        if take_pressures(
            drive[n], p_A[n], p_B[n], commanded, h, steps, a, z, q, P, sums, noise, walk, block, row, room
        ):
            rows[written] = row
            written += 1
    return written


@law
def start_pressures(
    start: np.ndarray,
    deviations: np.ndarray,
    noise: np.ndarray,
    z: np.ndarray,
    q: np.ndarray,
    P: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Write the memory before a first sample: parameters `start` (8,), known to `deviations` (8,)."""
    for i in range(MEANS):
        z[i] = 0.0
    for i in range(COVARIANCE):
        for j in range(COVARIANCE):
            P[i, j] = 0.0
    for i in range(len(PARAMETERS)):
        q[i] = start[i]
        P[_STATES + i, _STATES + i] = deviations[i] ** 2
    P[0, 0], P[1, 1], P[2, 2], P[3, 3] = noise[0], noise[1], _VELOCITY**2, _POSITION**2
    begin_sums(start[0], deviations[0], sums)


@kernel
def _start(
    start: np.ndarray,
    deviations: np.ndarray,
    noise: np.ndarray,
    z: np.ndarray,
    q: np.ndarray,
    P: np.ndarray,
    sums: np.ndarray,
) -> None:
    start_pressures(start, deviations, noise, z, q, P, sums)


class PressureFilter:
    """The filter with its memory: `update` takes samples in order; `blocks` are its estimates so far.

    `start`: parameters (8,) and their deviations (8,); `noise` (2,): variances of the readings [Pa^2]; `block`: its
    length [samples]; `longest_step` of the integration [s].
    """

    def __init__(
        self,
        a: RigNumbers,
        commanded: bool,
        rate: float,
        block: int,
        start: tuple[Array, Array],
        noise: Array,
        longest_step: float = LONGEST_STEP,
    ) -> None:
        self.a, self.commanded, self.h, self.block, self.noise = a, commanded, 1.0 / rate, block, noise
        self.steps = max(1, math.ceil(self.h / longest_step - 1e-9))
        self.walk = walks(block * self.h)
        self.blocks = BlockRows(len(PARAMETERS))
        self.z, self.q, self.P = np.empty(MEANS), np.empty(len(PARAMETERS)), np.empty((COVARIANCE, COVARIANCE))
        self.sums = np.empty(SUMS)
        _start(*start, noise, self.z, self.q, self.P, self.sums)

    def update(self, drive: Array, p_A: Array, p_B: Array) -> None:
        """Take more samples, (n,) each."""
        rows = self.blocks.buffer(drive.size // self.block + 1)
        written = advance(
            drive, p_A, p_B, self.commanded, self.h, self.steps, self.a,
            self.z, self.q, self.P, self.sums, self.noise, self.walk, self.block, rows,
        )  # fmt: skip
        self.blocks.add(rows[:written])

    @property
    def log_likelihood(self) -> float:
        """Log likelihood of all samples so far; minus infinity where the filter has diverged."""
        value = float(self.sums[1])
        return value if math.isfinite(value) else -math.inf


def find_stiffness(
    a: RigNumbers, commanded: bool, rate: float, start: tuple[Array, Array], noise: Array, samples: tuple[Array, ...]
) -> float:
    """Return the factor on the rig's stiffness under which the first samples are likeliest.

    The filter locks on to the ringing only where its frequency is right within a few per cent; so a bank of filters
    runs over the beginning, each with another stiffness, and the likeliest go on.
    """
    q, deviations = start
    number = PARAMETERS.index("stiffness")
    bank = []
    for factor in np.geomspace(*STIFFNESS):
        begin, spread = q.copy(), deviations.copy()
        begin[number] = factor
        spread[number] = deviations[number] * factor
        bank.append(PressureFilter(a, commanded, rate, _NEVER, (begin, spread), noise, 2.0 * LONGEST_STEP))
    first = 0
    for seconds, left in ROUNDS:
        stop = round(seconds * rate)
        for candidate in bank:
            candidate.update(*(channel[first:stop] for channel in samples))
        bank = sorted(bank, key=lambda candidate: candidate.log_likelihood, reverse=True)[:left]
        first = stop
    return float(bank[0].q[number])
