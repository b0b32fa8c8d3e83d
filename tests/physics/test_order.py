"""How fast the error falls with the step: RK4 on a closed form, the other method against a converged run."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from ..representatives import SLOW, few

#: No Coulomb force: friction is F_v v at every speed, and the whole rig without throttles is linear.
LINEAR = {"F_pr": 0.0, "F_cfr": 0.0}


def exact(rig, volts: float, G: float, t: np.ndarray) -> np.ndarray:
    """States (I, i, omega, theta, x, v, p_A, p_B) of the linear rig after a step of the command, by expm."""
    m, c, k = rig.motor, rig.cylinder, rig.fluid.K_oil / rig.cylinder.V
    d = rig.pump.q_b / (2 * np.pi)
    A = np.zeros((9, 9))  # the ninth state is the constant 1
    demand = m.omega_per_volt * volts
    A[0, [2, 8]] = -1.0, demand
    A[1, [0, 1, 2, 8]] = np.array([m.K_i, -m.R_c, -(m.C_e + m.k_p), m.k_p * demand]) / m.L_c
    A[2, [1, 2, 6, 7]] = np.array([m.C_m, -m.B_M, -d, d]) / m.J_M
    A[3, 2] = 1.0
    A[4, 5] = 1.0
    A[5, [5, 6, 7]] = np.array([-rig.friction.F_v, c.A_A, -c.A_B]) / c.M_eq
    leak = G + rig.pump.G_pump
    A[6, [2, 5, 6, 7]] = k * np.array([d, -c.A_A, -leak, leak])
    A[7, [2, 5, 6, 7]] = k * np.array([-d, c.A_B, leak, -leak])
    start = np.r_[np.zeros(6), np.full(2, rig.fluid.p_charge), 1.0]
    states, over = [start], expm(A * (t[1] - t[0]))
    for _ in t[1:]:
        states.append(over @ states[-1])
    return np.array(states)[:, :8]


def test_rk4_is_of_order_four_on_the_linear_rig(check_rig, drive):
    rig = check_rig(**LINEAR, G_pump=3e-13)
    steps = np.array([1.25e-4, 6.25e-5, 3.125e-5])
    names = ("I", "i", "omega", "theta", "x", "v", "p_A", "p_B")
    errors = []
    for h in steps:
        run = drive(rig, 0.5, u=lambda t: np.full_like(t, 2.0), G=5e-13, rate=100.0, step=h)
        truth = exact(rig, 2.0, 5e-13, run.t)
        result = np.column_stack([run[name] for name in names])
        scale = np.abs(truth).max(axis=0)
        errors.append(np.sqrt(np.mean(((result - truth) / scale) ** 2, axis=0)))
    assert np.all(errors[0] < 1e-5)
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, 4.0, atol=0.1, err_msg=f"columns {names}")


def pressure_errors(rig, drive, steps, converged: float) -> np.ndarray:
    truth = drive(rig, 1.0, rate=100.0, method="rk4", step=converged)["p_A"]
    runs = [drive(rig, 1.0, rate=100.0, method="imex", step=h) for h in steps]
    return np.array([np.sqrt(np.mean((run["p_A"] - truth) ** 2)) for run in runs])


def test_imex_is_of_order_four_where_the_throttles_are_not_stiff(check_rig, drive):
    # bores of 2 mm, laminar below 1 MPa, lines of a litre: line volumes answer in 2 ms; fully open: no kink
    rig = check_rig(orifices="present", d_line=2e-3, dp_0=1e6, V_1=1e-3, V_2=1e-3, **LINEAR)
    errors = pressure_errors(rig, drive, [1e-3, 5e-4, 2.5e-4, 1.25e-4], 2e-5)
    orders = np.log2(errors[:-1] / errors[1:])
    assert np.all((orders > 3.9) & (orders < 4.6)), orders
    assert abs(orders[-1] - 4.0) < 0.25, orders


@pytest.mark.parametrize("values", few([{}, LINEAR], 1, SLOW), ids=["the check rig", "no Coulomb force"])
def test_imex_is_accurate_and_converges_where_the_throttles_are_stiff(check_rig, drive, values):
    # The line volumes answer in 1.6 us. Stiffly, the stages are only of order two (and the one-way throttle kinks at
    # dp = 0): the order falls to between one and two, on an error that is small already.
    errors = pressure_errors(check_rig(True, **values), drive, [1e-3, 5e-4, 2.5e-4, 1.25e-4], 1e-6)
    assert errors[0] < 10.0, errors
    orders = np.log2(errors[:-1] / errors[1:])
    assert np.all(orders > 0.9), orders
    assert np.log2(errors[0] / errors[-1]) / 3 > 1.2, errors
