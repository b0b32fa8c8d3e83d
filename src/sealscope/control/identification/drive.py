"""The speed loop of the drive from command, angle and pressures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.control.identification.estimate import Estimate, least_squares
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

Array = NDArray[np.float64]
#: A row is left out beyond so many medians of the residuals' sizes.
_JUMP = 6.0
#: Least singular value of the columns: below, the counts of the encoder bias what is told.
_LEAST_APART = 3e-3
#: Length of a row [s], long against the counts of the encoder, and rows whose errors may follow each other.
_ROW, _LAGS = 0.1, 20


def drive_loop(recordings: Sequence[Recording], rig: Rig) -> tuple[Estimate, ...] | str:
    """Return omega_per_volt, k_p and K_i of the drive, or why they cannot be told.

    Eqs. (4.2)-(4.5): k_p (omega_d - omega) + K_i (integral of omega_d - theta) + c = C_e omega + R_c i + L_c di/dt with
    C_m i = D (p_A - p_B) + B_M omega + J_M domega/dt and omega_d = omega_per_volt u; what the right-hand side takes is
    the rig's as stated. c, a constant of each recording, stands for the integral's beginning.
    """
    parts = [_rows(recording, rig) for recording in recordings]
    number = np.concatenate([np.full(len(part), k) for k, part in enumerate(parts)])
    table = np.concatenate(parts)
    finite = np.isfinite(table).all(axis=1)
    table, number = table[finite], number[finite]
    if len(table) < 40 or np.std(table[:, 0]) < 1e-3:
        return "the drive's speed loop needs a command that moves for 4 s or more"
    if _alike(table, number) < _LEAST_APART:
        return "the drive's speed loop needs a load that changes: command and speed are too alike in these recordings"
    m = rig.motor
    q = np.array([m.k_p, m.omega_per_volt, max(m.K_i, 1e-3)])
    for _ in range(2):  # rows within a jump of the command, whose transient a row does not resolve, are left out
        q, covariance, rest = least_squares(_residual(table, number), q.tolist(), _LAGS)
        kept = np.abs(rest) <= _JUMP * np.median(np.abs(rest))
        table, number = table[kept], number[kept]
    q, covariance, _ = least_squares(_residual(table, number), q.tolist(), _LAGS)
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    names = ("motor.k_p", "motor.omega_per_volt", "motor.K_i")
    return tuple(Estimate(name, float(v), float(s)) for name, v, s in zip(names, q, sd, strict=True))


def _alike(table: Array, number: NDArray[np.intp]) -> float:
    """Return the smallest singular value of the four columns at unit length, each less its mean in its recording."""
    columns = table[:, :4].copy()
    for k in np.unique(number):
        columns[number == k] -= columns[number == k].mean(axis=0)
    return float(np.linalg.svd(columns / np.linalg.norm(columns, axis=0), compute_uv=False)[-1])


def _residual(table: Array, number: NDArray[np.intp]) -> Callable[[Array], Array]:
    u, omega, u_sum, theta, right = table.T
    groups = [number == k for k in np.unique(number)]

    def residual(q: Array) -> Array:
        k_p, per_volt, K_i = q
        rest = k_p * (per_volt * u - omega) + K_i * (per_volt * u_sum - theta) - right
        for group in groups:
            rest = np.where(group, rest - rest[group].mean(), rest)
        return np.asarray(rest)

    return residual


def _rows(recording: Recording, rig: Rig) -> Array:
    rate, m = recording.rate, rig.motor
    step = max(1, round(_ROW * rate))
    n = (len(recording) - 1) // step
    u, theta = recording["u"], recording["theta"]
    at = np.arange(n + 1) * step

    def mean(values: Array) -> Array:
        middle = 0.5 * (values[1:] + values[:-1])
        return np.asarray(middle[: n * step].reshape(n, step).mean(axis=1))

    omega = np.diff(theta[at]) * rate / step
    held = u[: n * step].reshape(n, step).mean(axis=1)
    u_sum = np.concatenate([[0.0], np.cumsum(u[:-1])]) / rate
    spin = np.gradient(omega) * rate / step
    torque = rig.pump.q_b / (2.0 * math.pi) * mean(recording["p_A"] - recording["p_B"])
    current = (torque + m.B_M * omega + m.J_M * spin) / m.C_m
    right = m.C_e * omega + m.R_c * current + m.L_c * np.gradient(current) * rate / step
    return np.stack([held, omega, mean(u_sum), mean(theta - theta[0]), right], axis=1)[1:-1]
